"""What the evidence says of each passage: when the train was there, how wrong the offer was, what failed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns, met
from pipeline.stages.evidence.evidence import NOTHING, Span, within_spans
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.hazards import HazardRow
from pipeline.stages.judge.judgement import Judgements
from pipeline.stages.judge.travel import speed_at
from pipeline.stages.judge.true_crossings import Crossings, TrueCrossing, crossings_of
from schemas.arrays import Bools, Ints, ints, times_ns
from schemas.config import LdsConfig
from schemas.enums import BaliseKind, Cause, Direction, FailureMode, LinkingError, PassageStatus, Reaction
from schemas.tables import Passages


def passages_table(
    case: Case, epochs: pl.DataFrame, offers: pl.DataFrame, rows: Sequence[HazardRow], undetected: Sequence[Span]
) -> pl.DataFrame:
    """Passages of the LDS, and those of the train that it knows nothing of, with the columns of the evidence.

    `epochs`, `offers`: judged; `undetected`: from each fault's onset to its detection.
    """
    stamps = times_ns(epochs.filter(pl.col("path_m").is_not_null()))
    crossings = crossings_of(case)
    known = case.solution.passages.with_columns(_true_times(case.solution.passages, crossings))
    passages = _with_unoffered(known, case, crossings, stamps)
    t_true = passages["t_true"]
    accepted = (pl.col("status") == PassageStatus.ACCEPTED.value) & (pl.col("kind") == BaliseKind.VIRTUAL.value)
    offered_ns = ints(passages["t_offered"].dt.timestamp("ns"))
    frame = passages.with_columns(
        pl.col("t_true").cast(pl.Datetime("ns", "UTC")),
        *_of_offers(passages, offers, rows),
        _speeds(passages, t_true, epochs, case.config.lds),
        _positioned=pl.Series(_within_gap(stamps, ints(t_true), case.config.lds)) & t_true.is_not_null(),
        suspect_after_the_fact=pl.Series(met(passages, accepted) & within_spans(offered_ns, undetected)),
    )
    return _with_failures(frame).select(Passages.column_names())


def _of_offers(passages: pl.DataFrame, offers: pl.DataFrame, rows: Sequence[HazardRow]) -> pl.DataFrame:
    """Judgement, error, hazard and insertion from the offer of each passage; from a telegram its error alone.

    Inserted: by a jump, on another track, or early and wrong.
    """
    judged = Judgements.of(offers)
    hazard = np.full(offers.height, NOTHING)
    inserted = judged.is_wrong & ((judged.low_m > 0.0) | judged.wrong_track)
    for number, row in reversed(list(enumerate(rows))):
        hazard[row.hits] = number
        inserted[row.crossed] = True
    of_virtual = ("judgement", "error_low_m", "error_high_m", "evidence", "proof_margin_m")
    columns = offers.select(
        *("crossing_id", "location_error_m"),
        *(pl.when("virtual").then(pl.col(name)).alias(name) for name in of_virtual),
        hazard_id=pl.Series(hazard).replace(NOTHING, None),
        _inserted=pl.Series(inserted),
    )
    joined = passages.select("crossing_id").join(columns, on="crossing_id", how="left", maintain_order="left")
    return joined.drop("crossing_id").with_columns(pl.col("_inserted").fill_null(value=False))


def _true_times(passages: pl.DataFrame, crossings: Crossings) -> pl.Series:
    """The train's crossing of each passage [ns], taken out of `crossings`: the nearest to its offer or reckoning.

    A passage with neither takes what is left, in order.
    """
    about = passages.select(pl.coalesce("t_offered", "t_reckoned")).to_series().dt.timestamp("ns").to_list()
    balises = passages["balise_id"].to_list()
    pairs = sorted(
        (abs(crossing.t_ns - t_ns), row, crossing)
        for row, (balise, t_ns) in enumerate(zip(balises, about, strict=True))
        if t_ns is not None
        for crossing in crossings.get(balise, ())
    )
    times: list[int | None] = [None] * len(balises)
    for _, row, crossing in pairs:
        if times[row] is None and crossing in crossings[balises[row]]:
            crossings[balises[row]].remove(crossing)
            times[row] = crossing.t_ns
    for row, (balise, t_ns) in enumerate(zip(balises, about, strict=True)):
        if t_ns is None and crossings.get(balise):
            times[row] = crossings[balise].pop(0).t_ns
    return pl.Series("t_true", times, dtype=pl.Int64)


def _within_gap(stamps: Ints, t_ns: Ints, lds: LdsConfig) -> Bools:
    """Positions on both sides of each instant, no farther apart than a crossing is interpolated over."""
    if stamps.size < 2:
        return np.zeros(t_ns.size, dtype=np.bool_)
    after = np.searchsorted(stamps, t_ns).clip(1, stamps.size - 1)
    inside = (t_ns >= stamps[0]) & (t_ns <= stamps[-1])
    return np.asarray(inside & (stamps[after] - stamps[after - 1] <= crossing_gaps_ns(stamps, lds)[after]))


def _speeds(passages: pl.DataFrame, t_true: pl.Series, epochs: pl.DataFrame, lds: LdsConfig) -> pl.Series:
    """Speed of the train at the offer, else where it passed [m/s]; null in a gap of the epochs."""
    at = passages["t_offered"].dt.timestamp("ns").fill_null(t_true)
    stamps = times_ns(epochs.filter(pl.col("speed_mps").is_not_null()))
    known = at.is_not_null().to_numpy() & _within_gap(stamps, ints(at), lds)
    return pl.Series("speed_mps", np.where(known, speed_at(epochs, ints(at)), np.nan), nan_to_null=True)


def _with_failures(frame: pl.DataFrame) -> pl.DataFrame:
    """ETCS failure mode and cause: insertion where offered where it is not, deletion where not offered in time."""
    beyond_window = (pl.col("odometer_distance_m") > pl.col("window_close_m")).fill_null(value=False)
    offered = pl.col("t_offered").is_not_null()
    wrong = (pl.col("judgement") == "wrong").fill_null(value=False)
    absent = pl.col("status") == PassageStatus.NOT_AVAILABLE.value
    insertion = offered & pl.col("_inserted")
    deletion = absent | ~offered | beyond_window
    by_position = insertion | (beyond_window & wrong) | (~offered & ~absent & pl.col("_positioned"))
    without = absent | (~offered & ~pl.col("_positioned"))
    mode = _first_of(insertion, FailureMode.INSERTION, deletion, FailureMode.DELETION)
    cause = _first_of(by_position, Cause.POSITION, without, Cause.NO_POSITION)
    kinds = frame.schema
    return frame.with_columns(failure_mode=mode.cast(kinds["failure_mode"]), cause=cause.cast(kinds["cause"]))


def _first_of(first: pl.Expr, word: FailureMode | Cause, second: pl.Expr, other: FailureMode | Cause) -> pl.Expr:
    """The word of the first condition that holds, `none` where neither does."""
    return pl.when(first).then(pl.lit(word.value)).when(second).then(pl.lit(other.value)).otherwise(pl.lit("none"))


def _with_unoffered(passages: pl.DataFrame, case: Case, crossings: Crossings, stamps: Ints) -> pl.DataFrame:
    """Adds a passage for each true crossing of a virtual balise without one: the LDS, misled by the position, has none.

    `crossings`: those that belong to no passage; `stamps`: of valid positions.
    """
    virtual = case.solution.balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.VIRTUAL.value)
    missed = [
        (balise, crossing)
        for balise in virtual.unique("balise_id", keep="first", maintain_order=True).iter_rows(named=True)
        for crossing in crossings.get(balise["balise_id"], ())
        if crossing.clear
    ]
    if not missed:
        return passages
    times = np.array([crossing.t_ns for _, crossing in missed])
    positioned = _within_gap(stamps, times, case.config.lds).tolist()
    rows = [_unoffered(*pair, case.solution.name, seen) for pair, seen in zip(missed, positioned, strict=True)]
    added = pl.DataFrame(rows, schema=passages.schema)
    when = pl.coalesce("t_offered", "t_reckoned")
    ordered = passages.with_columns(_when=when.forward_fill().backward_fill())
    return pl.concat([ordered, added.with_columns(_when=when)]).sort("_when", maintain_order=True).drop("_when")


def _unoffered(balise: dict[str, Any], crossing: TrueCrossing, solution: str, positioned: bool) -> dict[str, Any]:
    """The row of such a passage; `sense` of crossing and balise are along the measure, `direction` along the path."""
    names = ("balise_id", "kind", "netelement_id", "measure_m", "path_m", "location_accuracy_m")
    growing = crossing.sense * balise["sense"] > 0
    return {name: balise[name] for name in names} | {
        "solution": solution,
        "direction": (Direction.GROWING if growing else Direction.FALLING).value,
        "status": (PassageStatus.MISSED if positioned else PassageStatus.NOT_AVAILABLE).value,
        "linking_error": LinkingError.NONE.value,
        "reaction": Reaction.NONE.value,
        "initialising": False,
        "t_reckoned": crossing.t_ns,
        "t_true": crossing.t_ns,
    }
