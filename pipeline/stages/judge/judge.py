"""The judge of one solution; its passages with the train's own crossings (CONTRACT section 3, `t_true`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns, passings
from pipeline.stages.epochs.verdicts import failure_log
from pipeline.stages.evidence.evidence import KINDS, NOTHING, Alternative, EvidenceSet, Span, inside_spans
from pipeline.stages.judge.episodes import alarms_table, find_episodes
from pipeline.stages.judge.epochs import judged_epochs, judged_offers, odometer_steps, speed_at_mps
from pipeline.stages.judge.failures import Failure, error_history, find_failures
from pipeline.stages.judge.hazards import HazardRow, hazard_rows, hazards_table
from pipeline.stages.judge.judged import JudgedEpochs, JudgedOffers
from pipeline.stages.judge.judgement import JudgeInput
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, ints, truths
from schemas.config import Configuration, LdsConfig
from schemas.conform import dtypes
from schemas.enums import (
    BaliseKind,
    Cause,
    Direction,
    Evidence,
    FailureMode,
    Judgement,
    LinkingError,
    PassageStatus,
    Reaction,
)
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs
from schemas.tables import Passages

# Numerics: so many instants before and after a track show where the train came from and went on to.
_NEIGHBOURS = 100


class TrueCrossing(NamedTuple):
    """Instant [ns] by the middle of the interval; `sense` +1 with the measure of the balise's net element, else -1.

    `clear`: the train came from beyond the re-arming distance and went on beyond it.
    """

    t_ns: int
    sense: int
    clear: bool


Crossings = dict[str, list[TrueCrossing]]
"""Of each balise, in order of time."""


def crossings_of(given: JudgeInput) -> Crossings:
    """Crossings of each balise of the path by the train, in a direction in which the balise is valid.

    Args:
        given: the balises of the path, and the evidence.

    Returns:
        Crossings of each balise in order of time.
    """
    balises = given.solution.balises.unique("balise_id", keep="first")
    index = given.evidence.network.track.index
    elements = [index.get(name, -1) for name in balises["netelement_id"]]
    spots = zip(balises["balise_id"], elements, balises["measure_m"], strict=True)
    places = {name: Place(element, measure_m) for name, element, measure_m in spots}
    at_ns = with_instants_between(given.epochs_valid_at_ns(), given.config.align.speed_window_s)
    crossings = true_crossings(at_ns, given.evidence.at(at_ns), places, given.config)
    # `valid_direction` is along the path, `sense` of a crossing along the measure; 0 is both directions.
    valid = dict(balises.select("balise_id", pl.col("valid_direction") * pl.col("sense")).iter_rows())
    return {
        name: [crossing for crossing in crossed if valid[name] in (0, crossing.sense)]
        for name, crossed in crossings.items()
    }


def with_instants_between(at_ns: Ints, step_s: float) -> Ints:
    """The instants of the positions [ns], and others every `step_s` between those that are farther apart."""
    step_ns = round(step_s * NS_PER_S)
    far = np.flatnonzero(np.diff(at_ns) > 1.5 * step_ns)
    gaps = zip(at_ns[far].tolist(), at_ns[far + 1].tolist(), strict=True)
    between = [np.arange(begin, end, step_ns, dtype=np.int64)[1:] for begin, end in gaps]
    return np.unique(np.concatenate([at_ns, *between]))


class _Train(NamedTuple):
    """Where the train was at each instant, NaN where not known: net element, measure, half the interval."""

    t_ns: Ints
    element: Floats
    measure_m: Floats
    half_m: Floats


def true_crossings(t_ns: Ints, evidence: EvidenceSet, places: dict[str, Place], config: Configuration) -> Crossings:
    """Crossings of balises at `places` by the train, where the evidence (at instants `t_ns`) leaves one track.

    Where the half interval is at most `known_error_m`, its middle counts; else the whole interval has to pass from one
    side of the balise to the other.
    """
    alternatives = np.bincount(
        np.concatenate([track.rows for track in evidence.alternatives] or [np.zeros(0, np.int64)]), minlength=t_ns.size
    )
    tracks = [track.some_rows(alternatives[track.rows] == 1) for track in evidence.alternatives]
    train = _Train(t_ns, *np.full((3, t_ns.size), np.nan))
    for track in tracks:
        train.element[track.rows], train.measure_m[track.rows], _ = track.route.locate(track.middle_m)
        train.half_m[track.rows] = 0.5 * (track.high_m - track.low_m)
    names = list(places)
    elements = np.array([place.element for place in places.values()])
    measures_m = np.array([place.measure_m for place in places.values()])
    crossings: Crossings = {name: [] for name in names}
    for track in tracks:
        if track.rows.size == 0:
            continue
        rows, at_m = _rows_about_track(track, train)
        on_track = np.isin(rows, track.rows)
        for balise, visit_m, sense in zip(*track.route.visits_of_places(elements, measures_m), strict=True):
            if at_m.min() <= visit_m <= at_m.max():
                crossed = _crossings_of_place(train, rows, on_track, at_m - visit_m, config)
                turned = [crossing._replace(sense=int(crossing.sense * sense)) for crossing in crossed]
                crossings[names[balise]] += turned
    return {name: sorted(crossed) for name, crossed in crossings.items()}


def _rows_about_track(track: Alternative, train: _Train) -> tuple[Ints, Floats]:
    """Rows of the train on a track and of the instants just before and after, with their coordinates on it [m]."""
    rows = track.rows
    around = np.arange(max(rows[0] - _NEIGHBOURS, 0), min(rows[-1] + _NEIGHBOURS + 1, train.t_ns.size))
    neighbours = np.setdiff1d(around, rows)
    element = np.nan_to_num(train.element[neighbours], nan=-1).astype(np.int64)
    near_m = track.middle_m[np.searchsorted(rows, neighbours).clip(0, rows.size - 1)]
    there_m, _ = track.route.coordinates_of(element, train.measure_m[neighbours], near_m)
    known = np.isfinite(there_m)
    both = np.concatenate([rows, neighbours[known]])
    order = np.argsort(both, kind="stable")
    return both[order], np.concatenate([track.middle_m, there_m[known]])[order]


def _crossings_of_place(
    train: _Train, rows: Ints, on_track: Bools, away_m: Floats, config: Configuration
) -> list[TrueCrossing]:
    """The train's crossings of one balise, `away_m` from it, at those of the rows that are `on_track`.

    A train that came no farther than `rearm_m` from a balise since it passed it has not passed it again.
    """
    half_m = train.half_m[rows]
    close = half_m <= config.hazards.known_error_m
    beyond = np.abs(away_m) >= np.maximum(config.lds.rearm_m, half_m)
    ahead = away_m >= 0.0
    crossings: list[TrueCrossing] = []
    armed_from = 0
    passed = False
    far = np.flatnonzero(beyond)
    for passing in passings(away_m, [0.0]):
        change = passing.after
        if rows[change] - rows[change - 1] != 1:
            continue
        armed = bool((beyond & (ahead != ahead[change]))[armed_from:change].any())
        # However often its middle wavers at the balise: on which side the train is next known to be beyond it.
        next_far = int(np.searchsorted(far, change))
        clear = armed and next_far < far.size and bool(ahead[far[next_far]] == ahead[change])
        if not clear and not (close[change - 1 : change + 1].all() and (armed or not passed)):
            continue
        armed_from = change
        passed = True
        if on_track[change]:
            instant_ns = passing.instant_ns(*train.t_ns[rows[change - 1 : change + 1]].tolist())
            crossings.append(TrueCrossing(instant_ns, passing.sense, clear))
    return crossings


def passages_table(
    given: JudgeInput,
    epochs: JudgedEpochs,
    offers: JudgedOffers,
    rows: Sequence[HazardRow],
    undetected: Sequence[Span],
) -> pl.DataFrame:
    """Passages of the LDS, and those of the train that it knows nothing of, with the columns of the evidence.

    Args:
        given: the solution and its evidence.
        epochs: its epochs as judged.
        offers: its offers as judged; a passage finds its own by `crossing_id`.
        rows: hazards, for the numbers of those that hit a passage.
        undetected: spans from each fault's onset to its detection [ns].

    Returns:
        Rows of `schemas.tables.Passages`, in order of time.

    Source:
        CONTRACT section 3; SUBSET-026 3.4.4.
    """
    stamps = epochs.t_ns[epochs.positioned]
    crossings = crossings_of(given)
    known = given.solution.passages.with_columns(_take_true_times(given.solution.passages, crossings))
    passages = _with_unoffered_passages(known, given, crossings, stamps)
    t_true = passages["t_true"]
    virtual = _equal_to(passages["kind"], BaliseKind.VIRTUAL)
    accepted = virtual & _equal_to(passages["status"], PassageStatus.ACCEPTED)
    offered_ns = ints(passages["t_offered"].dt.timestamp("ns"))
    positioned = _is_interpolated(stamps, ints(t_true), given.config.lds) & t_true.is_not_null().to_numpy()
    of_offers, inserted = _offer_columns(passages, offers, rows)
    frame = passages.with_columns(
        t_true.cast(pl.Datetime("ns", "UTC")),
        *of_offers,
        _passage_speeds_mps(passages, t_true, epochs, given.config.lds),
        pl.Series("suspect_after_the_fact", accepted & inside_spans(offered_ns, undetected)),
    )
    return frame.with_columns(failure_columns(frame, inserted, positioned)).select(Passages.column_names())


def _equal_to(words: pl.Series, word: StrEnum) -> Bools:
    """Rows at which a column of words holds this one; null is false."""
    return truths(words == word.value)


def _offer_columns(
    passages: pl.DataFrame, offers: JudgedOffers, rows: Sequence[HazardRow]
) -> tuple[list[pl.Series], Bools]:
    """Columns of judgement, error and hazard of the offer of each passage, and which passages are insertions.

    Of a telegram the error alone. Inserted: by a jump, on another track, or early and wrong.
    """
    judged = offers.judged
    hazard = np.full(offers.size, NOTHING)
    inserted = judged.is_wrong & ((judged.low_m > 0.0) | judged.wrong_track)
    for number, row in reversed(list(enumerate(rows))):
        hazard[row.hits] = number
        inserted[row.crossed] = True
    place = {crossing: number for number, crossing in enumerate(offers.crossing_id.tolist())}
    at = np.array([place.get(crossing, NOTHING) for crossing in passages["crossing_id"]], dtype=np.int64)
    of_offer = _null_for_nothing(at)
    of_virtual = _null_for_nothing(np.where(np.append(offers.virtual, False)[at], at, NOTHING))
    columns = [
        pl.Series("location_error_m", offers.location_error_m, nan_to_null=True).gather(of_offer),
        _null_for_nothing(hazard).alias("hazard_id").gather(of_offer),
        *(column.gather(of_virtual) for column in judged.columns()),
        pl.Series("proof_margin_m", offers.proof_margin_m, nan_to_null=True).gather(of_virtual),
    ]
    return columns, np.append(inserted, False)[at]


def _null_for_nothing(numbers: Ints) -> pl.Series:
    """Numbers as a column, null for `NOTHING`."""
    return pl.Series(numbers, dtype=pl.Int64).replace(NOTHING, None)


def _take_true_times(passages: pl.DataFrame, crossings: Crossings) -> pl.Series:
    """The train's crossing of each passage [ns], taken out of `crossings`; the nearest to its offer or reckoning.

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


def _is_interpolated(stamps: Ints, t_ns: Ints, lds: LdsConfig) -> Bools:
    """Whether positions lie on both sides of each instant, no farther apart than a crossing is interpolated over."""
    if stamps.size < 2:
        return np.zeros(t_ns.size, dtype=np.bool_)
    after = np.searchsorted(stamps, t_ns).clip(1, stamps.size - 1)
    inside = (t_ns >= stamps[0]) & (t_ns <= stamps[-1])
    return np.asarray(inside & (stamps[after] - stamps[after - 1] <= crossing_gaps_ns(stamps, lds)[after]))


def _passage_speeds_mps(passages: pl.DataFrame, t_true: pl.Series, epochs: AlignedEpochs, lds: LdsConfig) -> pl.Series:
    """Speed of the train at the offer, else where it passed [m/s]; null in a gap of the epochs."""
    at = passages["t_offered"].dt.timestamp("ns").fill_null(t_true)
    stamps = epochs.t_ns[np.isfinite(epochs.speed_mps)]
    known = at.is_not_null().to_numpy() & _is_interpolated(stamps, ints(at), lds)
    return pl.Series("speed_mps", np.where(known, speed_at_mps(epochs, ints(at)), np.nan), nan_to_null=True)


def failure_columns(passages: pl.DataFrame, inserted: Bools, positioned: Bools) -> list[pl.Series]:
    """Columns of the ETCS failure mode and its cause, of each passage.

    Insertion where offered where it is not, deletion where not offered in time. `inserted`: by what the judge says of
    the offer; `positioned`: the train had positions where it passed.
    """
    beyond_window = truths(passages["odometer_distance_m"] > passages["window_close_m"])
    offered = passages["t_offered"].is_not_null().to_numpy()
    wrong = _equal_to(passages["judgement"], Judgement.WRONG)
    absent = _equal_to(passages["status"], PassageStatus.NOT_AVAILABLE)
    insertion = offered & inserted
    deletion = absent | ~offered | beyond_window
    by_position = insertion | (beyond_window & wrong) | (~offered & ~absent & positioned)
    without = absent | (~offered & ~positioned)
    modes: dict[StrEnum, Bools] = {FailureMode.INSERTION: insertion, FailureMode.DELETION: deletion}
    causes: dict[StrEnum, Bools] = {Cause.POSITION: by_position, Cause.NO_POSITION: without}
    return [_first_word("failure_mode", modes, FailureMode.NONE), _first_word("cause", causes, Cause.NONE)]


def _first_word(name: str, conditions: Mapping[StrEnum, Bools], otherwise: StrEnum) -> pl.Series:
    """A column of words: of each row that of the first condition that holds."""
    words = [*conditions, otherwise]
    first = np.select(list(conditions.values()), range(len(conditions)), default=len(conditions))
    return pl.Series(name, [words[number].value for number in first], dtype=dtypes(Passages)[name])


def _with_unoffered_passages(
    passages: pl.DataFrame, given: JudgeInput, crossings: Crossings, stamps: Ints
) -> pl.DataFrame:
    """The passages, and one for each true crossing of a virtual balise that the LDS knows nothing of.

    `crossings`: those that belong to no passage; `stamps`: of valid positions [ns].
    """
    virtual = given.solution.balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.VIRTUAL.value)
    missed = [
        (balise, crossing)
        for balise in virtual.unique("balise_id", keep="first", maintain_order=True).iter_rows(named=True)
        for crossing in crossings.get(balise["balise_id"], ())
        if crossing.clear
    ]
    if not missed:
        return passages
    times = np.array([crossing.t_ns for _, crossing in missed])
    positioned = _is_interpolated(stamps, times, given.config.lds).tolist()
    rows = [_unoffered_row(*pair, given.solution.name, known) for pair, known in zip(missed, positioned, strict=True)]
    added = pl.DataFrame(rows, schema=passages.schema)
    when = pl.coalesce("t_offered", "t_reckoned")
    ordered = passages.with_columns(_when=when.forward_fill().backward_fill())
    return pl.concat([ordered, added.with_columns(_when=when)]).sort("_when", maintain_order=True).drop("_when")


def _unoffered_row(balise: dict[str, Any], crossing: TrueCrossing, solution: str, positioned: bool) -> dict[str, Any]:
    """The row of a passage that was not offered; `positioned`: the train had positions where it passed.

    `sense` of crossing and balise are along the measure, `direction` along the path.
    """
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


@frozen
class Judged:
    """Tables by the contract, and the arrays that they were read from.

    `distance_m`: driven; `evidence`: what most epochs rest on.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    failures: Sequence[Failure]
    epochs: JudgedEpochs
    offers: JudgedOffers
    suspect_after_the_fact: Bools
    distance_m: float | None
    evidence: Evidence | None


def judge(given: JudgeInput) -> Judged:
    """Judge one solution: epochs, offers, jumps, failures, episodes, then the rows.

    Args:
        given: the solution as it was replayed, the evidence of its run, and its odometer.

    Returns:
        Hazards, alarms and passages as tables, and what was judged in arrays.

    Source:
        DOMAIN sections 5.2 to 5.5; DIAG, hazards.
    """
    config = given.config
    steps = odometer_steps(given)
    given = replace(given, evidence=replace(given.evidence, standstills=steps.standstills))
    epochs = judged_epochs(given, steps)
    offers = judged_offers(given, epochs)
    history = error_history(epochs, offers, given.odometry, config)
    failures = find_failures(history)
    log = failure_log(epochs.t_ns, epochs.negated, epochs.verdicts, config.lds.recovery_s)
    episodes = find_episodes(history, failures, log, given.faults)
    rows = hazard_rows(episodes, history)
    # From a fault's onset to its detection.
    undetected = [episode.undetected_span_ns for episode in episodes]
    return Judged(
        hazards=hazards_table(rows, given, epochs, history),
        alarms=alarms_table(given.solution.name, epochs, log, [row.episode for row in rows], config),
        passages=passages_table(given, epochs, offers, rows, undetected),
        failures=failures,
        epochs=epochs,
        offers=offers,
        suspect_after_the_fact=inside_spans(epochs.t_ns, undetected) & epochs.tvb,
        distance_m=_driven_distance_m(given, epochs),
        evidence=_main_evidence(epochs.judgements.kind),
    )


def _driven_distance_m(given: JudgeInput, epochs: JudgedEpochs) -> float | None:
    """Distance driven [m] by the odometer, else by the reference, else by the positions; None if none shows it."""
    if given.odometry is not None:
        begin_m, end_m = given.odometry.travelled_at(epochs.at_ns[[0, -1]]).tolist()
        return float(end_m - begin_m) * (given.odometry.scale or 1.0)
    train_m = epochs.train_m[np.isfinite(epochs.train_m)]
    place_m = train_m if train_m.size > 1 else epochs.path_m[epochs.positioned]
    return float(pl.Series(place_m).diff().abs().sum()) if place_m.size > 1 else None


def _main_evidence(kinds: Ints) -> Evidence | None:
    """The kind of evidence that most epochs rest on; of equally many the first in the order of the enum."""
    counts = np.bincount(kinds[kinds != NOTHING], minlength=len(KINDS))
    return KINDS[int(counts.argmax())] if counts.any() else None
