"""What became of each pass: one run over one piece in one direction, the worst of its positions there."""

from __future__ import annotations

import numpy as np
import polars as pl
from scipy.spatial import cKDTree

from pipeline.results.places import ground_of, stretches_of
from pipeline.studies.line.pieces import Pieces, places_in_plane_m
from pipeline.studies.line.spans import FIRST_LOSS, SpanState, spans_of, states_of
from schemas.arrays import Floats, Ints, floats
from schemas.config import Configuration
from schemas.enums import BaliseKind, Judgement, PassageStatus
from schemas.frozen import frozen
from schemas.line import LineCause, LineCriteria
from schemas.run import Site

CAUSES = {
    SpanState.NOT_COVERED: LineCause.NOT_JUDGED,
    SpanState.UNKNOWN: LineCause.NOT_JUDGED,
    SpanState.AFTER_ALARM: LineCause.AFTER_ALARM,
    SpanState.ALARM: LineCause.ALARM,
    SpanState.CONFIDENCE: LineCause.CONFIDENCE,
    SpanState.AMBIGUOUS: LineCause.AMBIGUOUS,
    SpanState.OUTAGE: LineCause.OUTAGE,
    SpanState.WRONG: LineCause.WRONG,
    SpanState.WRONG_TRACK: LineCause.WRONG_TRACK,
    SpanState.WRONG_IN_USE: LineCause.WRONG,
}
_ANYWHERE = [int(SpanState.OUTAGE), int(SpanState.UNKNOWN)]
_OUTCOMES: dict[str, pl.DataType | type[pl.DataType]] = {
    "piece": pl.Int64,
    "growing": pl.Boolean,
    "state": pl.Int64,
    "cause": pl.String,
    "claimed": pl.Boolean,
    "t": pl.Datetime("ns", "UTC"),
}
_PASSES = _OUTCOMES | {"monitor": pl.String, "satellites": pl.Float64}


@frozen
class PieceIndex:
    """The pieces with their middles in the plane, to find those near a place."""

    site: Site
    pieces: Pieces
    tree: cKDTree

    @classmethod
    def of_pieces(cls, site: Site, pieces: Pieces, middles_m: Floats) -> PieceIndex:
        """The index over pieces with these middles [m]."""
        return cls(site, pieces, cKDTree(np.nan_to_num(middles_m, nan=1e12)))

    def pieces_near(self, rows: pl.DataFrame, reach_m: float) -> Ints:
        """Pieces within reach of the places of some epochs."""
        place = places_in_plane_m(
            self.site, ground_of(self.site.track, rows["netelement_id"], floats(rows, "measure_m"))
        )
        place = place[np.isfinite(place).all(axis=1)]
        half_m = 0.5 * float((self.pieces.to_m - self.pieces.from_m).max())
        hits = self.tree.query_ball_point(place, float(np.hypot(reach_m, half_m)))
        return np.unique(np.array([number for hit in hits for number in hit], dtype=np.int64))


def passes_of(
    epochs: pl.DataFrame,
    passages: pl.DataFrame,
    alarms: pl.DataFrame,
    ground: PieceIndex,
    criteria: LineCriteria,
    config: Configuration,
) -> pl.DataFrame:
    """One row per piece and direction that a run of one solution touched: `piece, growing, state, cause, claimed,
    t, monitor, satellites`.

    The place is the train's by the evidence. `claimed`: the train was elsewhere when a position in use, judged wrong,
    said that it was here. `satellites`: the fewest used where the pass was at its worst.
    """
    epochs = epochs.sort("t")
    if epochs.height < 2:
        return pl.DataFrame(schema=_PASSES)
    stretches = stretches_of(epochs)
    states = states_of(epochs, alarms["t_start"], config)
    spans = spans_of(epochs, states, stretches, config)
    hits = spans_on_pieces(spans, stretches, ground.pieces)
    parts = [
        _worst_passes(hits, ground.pieces, criteria),
        _unsafe_acceptances(passages, epochs, stretches, ground.pieces),
    ]
    parts += _misled_pieces(epochs, states, stretches, ground, criteria)
    return _with_monitors(_merge_passes(pl.concat(parts)), hits, alarms)


def spans_on_pieces(spans: pl.DataFrame, stretches: pl.DataFrame, pieces: Pieces) -> pl.DataFrame:
    """The spans' columns per piece and direction that they touch, with `begin_m, end_m`: the likely stretch on the
    piece.

    A span counts on the net elements of the train only, not on a track that runs next to them on the path. An outage,
    and what is unknown, count on all of them: nobody saw which of them it led over.
    """
    laid: list[pl.DataFrame] = []
    for name, sign, offset_m in stretches.select("netelement_id", "sign", "offset_m").iter_rows():
        element = pieces.track.index.get(name)
        if element is None:
            continue
        at = _spans_as_measures(spans, sign, offset_m)
        rows = pieces.track.vertex_range(element)
        first_m = pieces.track.measure_m[rows][0]
        last_m = pieces.track.measure_m[rows][-1]
        on_element = pl.col("state").is_in(_ANYWHERE) | pl.col("elements").list.contains(name)
        kept = at.filter((pl.col("high") >= first_m) & (pl.col("low") <= last_m) & on_element.fill_null(value=False))
        begin = pieces.pieces_at(element, floats(kept, "low"))
        end = pieces.pieces_at(element, floats(kept, "high"))
        index = np.repeat(np.arange(kept.height), end - begin + 1)
        # Number of each piece within its span.
        ahead = np.arange(len(index)) - np.repeat(np.cumsum(end - begin + 1) - (end - begin + 1), end - begin + 1)
        piece = begin[index] + ahead
        hit = kept[index].with_columns(piece=pl.Series(piece, dtype=pl.Int64))
        begin_m = np.maximum(floats(hit, "begin"), pieces.from_m[piece])
        end_m = np.minimum(floats(hit, "end"), pieces.to_m[piece])
        laid.append(hit.with_columns(begin_m=begin_m, end_m=end_m))
    empty = _spans_as_measures(spans.clear(), 1, 0.0).with_columns(
        piece=pl.lit(0), begin_m=pl.lit(0.0), end_m=pl.lit(0.0)
    )
    return pl.concat(laid) if laid else empty


def _spans_as_measures(spans: pl.DataFrame, sign: int, offset_m: float) -> pl.DataFrame:
    """Spans as measures of an element on which `path = offset + sign * measure`."""
    order = ("low_m", "high_m", "from_m", "to_m") if sign > 0 else ("high_m", "low_m", "to_m", "from_m")
    names = ("low", "high", "begin", "end")
    places = {name: sign * (pl.col(column) - offset_m) for name, column in zip(names, order, strict=True)}
    return spans.select("state", "t", "elements", "satellites", growing=pl.col("direction") * sign > 0, **places)


def _worst_passes(hits: pl.DataFrame, pieces: Pieces, criteria: LineCriteria) -> pl.DataFrame:
    """One row per piece and direction; a right one that covered too little of the piece is not counted."""
    worst = hits.group_by("piece", "growing").agg(
        state=pl.col("state").max(),
        covered_m=pl.col("end_m").max() - pl.col("begin_m").min(),
        t=pl.col("t").min(),
    )
    length_m = (pieces.to_m - pieces.from_m)[worst["piece"].to_numpy()]
    short = (pl.col("state") == int(SpanState.RIGHT)) & (pl.col("covered_m") < criteria.coverage * pl.Series(length_m))
    state = pl.when(short).then(int(SpanState.NOT_COVERED)).otherwise(pl.col("state"))
    return _with_cause(worst.with_columns(state=state))


def _with_cause(frame: pl.DataFrame, cause: LineCause | None = None) -> pl.DataFrame:
    """Rows of `_OUTCOMES` with the cause that the state has, or another."""
    names = {int(state): code_of.value for state, code_of in CAUSES.items()}
    cause_of_state = pl.col("state").replace_strict(names, default=LineCause.NONE.value, return_dtype=pl.String)
    code = cause_of_state if cause is None else pl.lit(cause.value)
    claimed = cause is LineCause.CLAIMED_WRONGLY
    return frame.with_columns(cause=code, claimed=pl.lit(claimed)).select(
        pl.col(name).cast(dtype) for name, dtype in _OUTCOMES.items()
    )


def _unsafe_acceptances(
    passages: pl.DataFrame, epochs: pl.DataFrame, stretches: pl.DataFrame, pieces: Pieces
) -> pl.DataFrame:
    """Pieces of virtual balises that were accepted at a wrong place, in the direction in which the train went."""
    unsafe = passages.filter(
        (pl.col("status") == PassageStatus.ACCEPTED.value)
        & (pl.col("judgement") == Judgement.WRONG.value)
        & (pl.col("kind") == BaliseKind.VIRTUAL.value)
    ).with_columns(t=pl.coalesce("t_offered", "t_true"))
    there = unsafe.sort("t").join_asof(epochs.select("t", ahead="direction"), on="t")
    return _with_cause(_pieces_of_places(there, stretches, pieces), LineCause.UNSAFE_ACCEPTANCE)


def _misled_pieces(
    epochs: pl.DataFrame, states: Ints, stretches: pl.DataFrame, ground: PieceIndex, criteria: LineCriteria
) -> list[pl.DataFrame]:
    """Pieces that wrong positions in use claimed, and those near a position on a wrong track."""
    placed = epochs.with_columns(state=pl.Series(states), ahead="direction").filter(
        pl.col("netelement_id").is_not_null()
    )
    track = pl.col("error_low_m").is_null()
    in_use = pl.col("state") == int(SpanState.WRONG_IN_USE)
    claims = _pieces_of_places(placed.filter(in_use & ~track), stretches, ground.pieces)
    parts = [_with_cause(claims, LineCause.CLAIMED_WRONGLY)]
    for state in (SpanState.WRONG_TRACK, SpanState.WRONG_IN_USE):
        rows = placed.filter(track & (pl.col("state") == int(state)))
        if rows.height:
            # On which of these tracks it was, and so in which direction over each, nobody knows.
            piece = pl.DataFrame({"piece": ground.pieces_near(rows, criteria.beside_m)})
            both = piece.join(pl.DataFrame({"growing": [True, False]}), how="cross")
            lone = both.with_columns(state=pl.lit(int(state)), t=pl.lit(rows["t"][0]))
            parts.append(_with_cause(lone, LineCause.WRONG_TRACK))
    return parts


def _pieces_of_places(rows: pl.DataFrame, stretches: pl.DataFrame, pieces: Pieces) -> pl.DataFrame:
    """`piece, growing, state, t` of the places that rows name; `ahead`: their direction on growing path.

    Both directions where that is not known.
    """
    signs: dict[str, set[int]] = {}
    for name, sign in stretches.select("netelement_id", "sign").iter_rows():
        signs.setdefault(name, set()).add(sign)
    first_times: dict[tuple[int, bool], object] = {}
    for name, at, ahead, t in rows.select("netelement_id", "measure_m", "ahead", "t").iter_rows():
        if (piece := pieces.piece_holding(name, at)) is None:
            continue
        senses = {sign * ahead > 0 for sign in signs.get(name, ())} if ahead in (1, -1) else set()
        for growing in senses or {True, False}:
            first_times.setdefault((piece, growing), t)
    schema = {name: _OUTCOMES[name] for name in ("piece", "growing", "state", "t")}
    table = [(piece, growing, int(SpanState.WRONG_IN_USE), t) for (piece, growing), t in first_times.items()]
    return pl.DataFrame(table, schema=schema, orient="row")


def _merge_passes(rows: pl.DataFrame) -> pl.DataFrame:
    """One row per piece and direction: the worst state with its cause; a mere claim stands next to that."""
    claims = rows.filter("claimed").select("piece", "growing").unique().with_columns(has_claim=pl.lit(value=True))
    unclaimed = rows.filter(~pl.col("claimed"))
    worst = (
        unclaimed.sort("state", "cause", descending=[True, False])
        .group_by("piece", "growing", maintain_order=True)
        .first()
    )
    both = worst.join(claims, on=["piece", "growing"], how="left")
    lone = rows.filter("claimed").join(unclaimed, on=["piece", "growing"], how="anti").unique(["piece", "growing"])
    kept = both.with_columns(claimed=pl.col("has_claim").fill_null(value=False)).drop("has_claim")
    return pl.concat([kept, lone.with_columns(state=pl.lit(int(SpanState.NOT_COVERED)).cast(pl.Int64))])


def _with_monitors(passes: pl.DataFrame, hits: pl.DataFrame, alarms: pl.DataFrame) -> pl.DataFrame:
    """Passes with the monitor that failed first in an alarm on the piece, and the satellites at the worst place."""
    keys = ["piece", "growing"]
    worst = hits.filter(pl.col("state") == pl.col("state").max().over(keys)).group_by(keys).agg(pl.min("satellites"))
    first = alarms.select(t="t_start", monitor=pl.col("monitors").list.first()).unique("t")
    begun = hits.filter(pl.col("state") >= int(FIRST_LOSS)).join(first, on="t", how="inner")
    failed = begun.sort("t").group_by(keys, maintain_order=True).agg(pl.first("monitor"))
    return passes.join(failed, on=keys, how="left").join(worst, on=keys, how="left")
