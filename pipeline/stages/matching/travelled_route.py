"""The travelled path as a route that somebody who knows the track can correct and hand in (CONTRACT section 2)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import least_belief
from pipeline.stages.matching.claims import Possible
from pipeline.stages.matching.match import Match
from pipeline.stages.track.leg import Leg, segments_at
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Bools, Ints
from schemas.stages import ONE_TRACK_LEFT

ROUTE_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "netelement_id": pl.String,
    "direction": pl.String,
    "leg": pl.Int64,
    "doubtful": pl.Boolean,
    "gate_probability": pl.Float64,
    "path_probability": pl.Float64,
    "rivals": pl.String,
    "cross_bias_m": pl.Float64,
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
}


def travelled_route(match: Match) -> pl.DataFrame:
    """One row per net element in the order of growing path, leg by leg: the route, and what of it is in doubt.

    `doubtful`: the track was, at the time or in hindsight (the least probabilities of both stand beside it), or no
    position tells of it. `rivals`: other elements possible
    meanwhile, the most probable first, each with its highest probability, in words. `cross_bias_m`: by how much the
    positions lie left of growing path there (median), which survey and antenna do and no GNSS fault.
    """
    leg = match.epochs.leg
    rows = [
        _row(match, number, one, visits, leg == number)
        for number, one in enumerate(match.path.legs)
        for visits in _passages(match.path.track, one)
    ]
    return pl.DataFrame(rows, schema=ROUTE_COLUMNS, orient="row")


def _passages(track: SurveyedTrack, leg: Leg) -> list[list[int]]:
    """Visits that are one passage of an element: its pieces, one after the other. Each lap of a ring is another."""
    passages: list[list[int]] = []
    ended: object = None
    for number, visit in enumerate(leg.visits):
        measure = track.measure_m[track.vertices(visit.element)]
        begin, end = (measure[0], measure[-1]) if visit.forward else (measure[-1], measure[0])
        if passages and ended == (track.ids[visit.element], visit.forward, begin):
            passages[-1].append(number)
        else:
            passages.append([number])
        ended = (track.ids[visit.element], visit.forward, end)
    return passages


def _row(match: Match, number: int, leg: Leg, visits: list[int], on_leg: Bools) -> tuple[object, ...]:
    path_m = match.epochs.path_m
    segment, _ = segments_at(leg, np.nan_to_num(path_m))
    known = np.isfinite(match.epochs.path_probability)
    inside = np.flatnonzero(on_leg & np.isin(leg.visit[segment], visits) & known)
    epochs = match.epochs.table[inside]
    least = epochs.select(least_belief().min()).item()
    first_visit = leg.visits[visits[0]]
    times = match.epochs.table["t"]
    return (
        match.path.track.ids[first_visit.element],
        "AB" if first_visit.forward else "BA",
        number,
        least is None or least < ONE_TRACK_LEFT,
        epochs["gate_probability"].min(),
        epochs["path_probability"].min(),
        _rivals(match, inside, 1.0 - ONE_TRACK_LEFT),
        float(np.median(match.epochs.cross_track_m[inside])) if len(inside) else None,
        times[int(inside[0])] if len(inside) else None,
        times[int(inside[-1])] if len(inside) else None,
    )


def _rivals(match: Match, rows: Ints, least: float) -> str:
    """Elements off the path that are possible at some of these epochs."""
    if len(rows) == 0:
        return ""
    highest = _highest(match.possible, int(rows[0]), int(rows[-1]))
    ids = match.path.track.ids
    on_path = set(match.path.elements())
    order = sorted((-probability, ids[element]) for element, probability in highest.items())
    return "; ".join(f"{name} {-value:.3f}" for value, name in order if -value > least and name not in on_path)


def _highest(possible: Possible, first: int, last: int) -> dict[int, float]:
    """The highest confidence in each element at the steps from one epoch to another."""
    begin, end = np.searchsorted(possible.epoch, [first, last + 1])
    part = slice(int(possible.first[max(int(begin) - 1, 0)]), int(possible.first[int(end)]))
    found = pl.DataFrame({"element": possible.element[part], "probability": possible.confidence[part]})
    return dict(found.group_by("element").agg(pl.col("probability").max()).iter_rows())
