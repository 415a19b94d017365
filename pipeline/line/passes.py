"""What became of each pass: one run over one piece in one direction, the worst of its positions there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy.spatial import cKDTree

from pipeline.export.places import Stretches, ground_of, stretches_of
from pipeline.line.pieces import Pieces, plane_of
from pipeline.line.spans import FIRST_LOSS, State, spans_of, states_of
from schemas.arrays import Floats, Ints, floats
from schemas.config import Configuration
from schemas.enums import BaliseKind, Judgement, PassageStatus
from schemas.line import LineCause, LineCriteria
from schemas.run import Site

CAUSES = {
    State.UNKNOWN: LineCause.NOT_JUDGED,
    State.AFTER_ALARM: LineCause.AFTER_ALARM,
    State.ALARM: LineCause.ALARM,
    State.CONFIDENCE: LineCause.CONFIDENCE,
    State.AMBIGUOUS: LineCause.AMBIGUOUS,
    State.OUTAGE: LineCause.OUTAGE,
    State.WRONG: LineCause.WRONG,
    State.WRONG_TRACK: LineCause.WRONG_TRACK,
    State.WRONG_IN_USE: LineCause.WRONG,
}
_PASSES = {
    "piece": pl.Int64,
    "growing": pl.Boolean,
    "state": pl.Int64,
    "cause": pl.String,
    "claimed": pl.Boolean,
    "monitor": pl.String,
    "t": pl.Datetime("ns", "UTC"),
}


@dataclass(frozen=True)
class Ground:
    """The pieces with their middles in the plane, to find those beside a place."""

    site: Site
    pieces: Pieces
    tree: cKDTree

    @classmethod
    def of(cls, site: Site, pieces: Pieces, middles_m: Floats) -> Ground:
        return cls(site, pieces, cKDTree(np.nan_to_num(middles_m, nan=1e12)))

    def beside(self, rows: pl.DataFrame, reach_m: float) -> Ints:
        """Pieces within reach of the places of some epochs."""
        place = plane_of(self.site, ground_of(self.site.track, rows["netelement_id"], floats(rows, "measure_m")))
        place = place[np.isfinite(place).all(axis=1)]
        half_m = 0.5 * float((self.pieces.to_m - self.pieces.from_m).max())
        found = self.tree.query_ball_point(place, float(np.hypot(reach_m, half_m)))
        return np.unique(np.array([number for near in found for number in near], dtype=np.int64))


def passes_of(
    epochs: pl.DataFrame,
    passages: pl.DataFrame,
    alarms: pl.DataFrame,
    ground: Ground,
    criteria: LineCriteria,
    config: Configuration,
) -> pl.DataFrame:
    """One row per piece and direction that a run of one solution touched: `piece, growing, state, cause, claimed,
    monitor, t`.

    The place is the train's by the evidence. `claimed`: the train was elsewhere when a position in use, judged wrong,
    said that it was here.
    """
    epochs = epochs.sort("t")
    if epochs.height < 2:
        return pl.DataFrame(schema=_PASSES)
    legs, states = stretches_of(epochs), states_of(epochs, alarms["t_start"], config)
    spans = spans_of(epochs, states, 2.0 * config.hazards.failure_limit_m)
    hits = laid_on(spans, legs, ground.pieces)
    parts = [_worst(hits, ground.pieces, criteria), _unsafe(passages, legs, ground.pieces)]
    parts += _misleading(epochs, states, legs, ground, criteria)
    return _with_monitors(_merged(pl.concat(parts)), hits, alarms)


def laid_on(spans: pl.DataFrame, legs: Stretches, pieces: Pieces) -> pl.DataFrame:
    """The spans' columns per piece and direction that they touch, with `begin_m, end_m`: the likely way on the piece.

    A right span counts on the net elements of its own positions only, so that nothing good is said of a track
    that runs beside it on the path.
    """
    found: list[pl.DataFrame] = []
    for number, name in enumerate(legs.elements):
        element = pieces.track.index.get(name)
        if element is None:
            continue
        at = _measures(spans, int(legs.sign[number]), float(legs.offset_m[number]))
        rows = pieces.track.vertices(element)
        first_m, last_m = pieces.track.measure_m[rows][0], pieces.track.measure_m[rows][-1]
        own = (pl.col("state") > int(State.AFTER_ALARM)) | (pl.col("one") == name) | (pl.col("other") == name)
        kept = at.filter((pl.col("high") >= first_m) & (pl.col("low") <= last_m) & own.fill_null(value=False))
        begin, end = pieces.at(element, floats(kept, "low")), pieces.at(element, floats(kept, "high"))
        index = np.repeat(np.arange(kept.height), end - begin + 1)
        ahead = np.arange(len(index)) - np.repeat(np.cumsum(end - begin + 1) - (end - begin + 1), end - begin + 1)
        piece = begin[index] + ahead
        hit = kept[index].with_columns(piece=pl.Series(piece, dtype=pl.Int64))
        begin_m, end_m = (
            np.maximum(floats(hit, "begin"), pieces.from_m[piece]),
            np.minimum(floats(hit, "end"), pieces.to_m[piece]),
        )
        found.append(hit.with_columns(begin_m=begin_m, end_m=end_m))
    empty = _measures(spans.clear(), 1, 0.0).with_columns(piece=pl.lit(0), begin_m=pl.lit(0.0), end_m=pl.lit(0.0))
    return pl.concat(found) if found else empty


def _measures(spans: pl.DataFrame, sign: int, offset_m: float) -> pl.DataFrame:
    """Spans as measures of an element on which `path = offset + sign * measure`."""
    order = ("low_m", "high_m", "from_m", "to_m") if sign > 0 else ("high_m", "low_m", "to_m", "from_m")
    names = ("low", "high", "begin", "end")
    places = {name: sign * (pl.col(column) - offset_m) for name, column in zip(names, order, strict=True)}
    return spans.select("state", "t", "one", "other", growing=pl.col("direction") * sign > 0, **places)


def _worst(hits: pl.DataFrame, pieces: Pieces, criteria: LineCriteria) -> pl.DataFrame:
    """One row per piece and direction; a right one that saw too little of the piece becomes unknown."""
    worst = hits.group_by("piece", "growing").agg(
        state=pl.col("state").max(),
        seen_m=pl.col("end_m").max() - pl.col("begin_m").min(),
        t=pl.col("t").min(),
    )
    length_m = (pieces.to_m - pieces.from_m)[worst["piece"].to_numpy()]
    short = (pl.col("state") == int(State.RIGHT)) & (pl.col("seen_m") < criteria.coverage * pl.Series(length_m))
    state = pl.when(short).then(int(State.UNKNOWN)).otherwise(pl.col("state"))
    return _rows(worst.with_columns(state=state))


def _rows(frame: pl.DataFrame, cause: LineCause | None = None) -> pl.DataFrame:
    """Rows of `_PASSES` with the cause that the state has, or another."""
    names = {int(state): found.value for state, found in CAUSES.items()}
    own = pl.col("state").replace_strict(names, default=LineCause.NONE.value, return_dtype=pl.String)
    told = own if cause is None else pl.lit(cause.value)
    claimed = cause is LineCause.CLAIMED_WRONGLY
    monitor = pl.lit(None, pl.String)
    return frame.with_columns(cause=told, claimed=pl.lit(claimed), monitor=monitor).select(
        pl.col(name).cast(dtype) for name, dtype in _PASSES.items()
    )


def _unsafe(passages: pl.DataFrame, legs: Stretches, pieces: Pieces) -> pl.DataFrame:
    """Pieces of virtual balises that were accepted at a wrong place."""
    unsafe = passages.filter(
        (pl.col("status") == PassageStatus.ACCEPTED.value)
        & (pl.col("judgement") == Judgement.WRONG.value)
        & (pl.col("kind") == BaliseKind.VIRTUAL.value)
        & pl.col("netelement_id").is_in(list(pieces.track.index))
    )
    places = zip(unsafe["netelement_id"].to_list(), floats(unsafe, "measure_m").tolist(), strict=True)
    piece = [int(pieces.at(pieces.track.index[name], np.array([at]))[0]) for name, at in places]
    rows = unsafe.select(t=pl.coalesce("t_offered", "t_true"), state=pl.lit(int(State.WRONG_IN_USE)))
    rows = rows.with_columns(piece=pl.Series(piece, dtype=pl.Int64))
    return _rows(_both_ways(rows), LineCause.UNSAFE_ACCEPTANCE)


def _misleading(
    epochs: pl.DataFrame, states: Ints, legs: Stretches, ground: Ground, criteria: LineCriteria
) -> list[pl.DataFrame]:
    """Pieces that wrong positions in use claimed, and those beside a position on a wrong track."""
    wrong = (states == State.WRONG_IN_USE) | (states == State.WRONG_TRACK)
    track = ~np.isfinite(floats(epochs, "error_low_m"))
    named = epochs["netelement_id"].is_not_null().to_numpy()
    parts = []
    for rows, reach_m, cause in (
        (wrong & ~track & named & (states == State.WRONG_IN_USE), None, LineCause.CLAIMED_WRONGLY),
        (wrong & track & named, criteria.beside_m, LineCause.WRONG_TRACK),
    ):
        for state in np.unique(states[rows]):
            told = epochs.filter(pl.Series(rows & (states == state)))
            piece = _claimed(told, ground.pieces) if reach_m is None else ground.beside(told, reach_m)
            frame = pl.DataFrame({"piece": piece}).with_columns(state=pl.lit(int(state)), t=pl.lit(told["t"][0]))
            parts.append(_rows(_both_ways(frame), cause))
    return parts


def _claimed(epochs: pl.DataFrame, pieces: Pieces) -> Ints:
    """The pieces that positions name."""
    found = [
        pieces.at(pieces.track.index[str(name)], floats(rows, "measure_m"))
        for (name,), rows in epochs.group_by("netelement_id")
        if name in pieces.track.index
    ]
    return np.unique(np.concatenate(found)) if found else np.empty(0, dtype=np.int64)


def _both_ways(frame: pl.DataFrame) -> pl.DataFrame:
    """What misleads condemns a place for both directions."""
    return pl.concat([frame.with_columns(growing=pl.lit(True)), frame.with_columns(growing=pl.lit(False))])


def _merged(rows: pl.DataFrame) -> pl.DataFrame:
    """One row per piece and direction: the worst state with its cause; a mere claim stands beside that."""
    claims = rows.filter("claimed").select("piece", "growing").unique().with_columns(has_claim=pl.lit(value=True))
    own = rows.filter(~pl.col("claimed"))
    worst = (
        own.sort("state", "cause", descending=[True, False]).group_by("piece", "growing", maintain_order=True).first()
    )
    both = worst.join(claims, on=["piece", "growing"], how="left")
    lone = rows.filter("claimed").join(own, on=["piece", "growing"], how="anti").unique(["piece", "growing"])
    kept = both.with_columns(claimed=pl.col("has_claim").fill_null(value=False)).drop("has_claim")
    return pl.concat([kept, lone.with_columns(state=pl.lit(int(State.UNKNOWN)).cast(pl.Int64))])


def _with_monitors(passes: pl.DataFrame, hits: pl.DataFrame, alarms: pl.DataFrame) -> pl.DataFrame:
    """The monitor that failed first in an alarm that began on the piece."""
    first = alarms.select(t="t_start", failed=pl.col("monitors").list.first()).unique("t")
    begun = hits.filter(pl.col("state") >= int(FIRST_LOSS)).join(first, on="t", how="inner")
    told = begun.sort("t").group_by("piece", "growing", maintain_order=True).agg(pl.col("failed").first())
    return passes.join(told, on=["piece", "growing"], how="left").with_columns(monitor="failed").drop("failed")
