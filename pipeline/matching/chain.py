"""Sites where the path cannot be in doubt: one chain of net elements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.matching.diagnosis import off_the_network
from pipeline.matching.epochs import Assignment
from pipeline.matching.fixes import Fixes
from pipeline.odometry import Odometry
from pipeline.odometry.polarity import grows_with
from pipeline.track.geodesy import Points
from pipeline.track.leg import Leg, Visit, leg_of, nearest_on_leg, path_at
from pipeline.track.path import TravelledPath
from pipeline.track.segments import Feet, no_feet
from pipeline.track.survey import Track
from schemas.config import MatchingConfig
from schemas.enums import Navigability


def path_on_chain(
    fixes: Fixes, odometry: Odometry | None, track: Track, leg: Leg, config: MatchingConfig
) -> tuple[TravelledPath, Assignment]:
    """The part of a chain that the run covers, oriented as the run began; nothing is in doubt on it."""
    known = np.flatnonzero(fixes.valid)
    feet = nearest_on_leg(fixes.points.take(known), leg)
    near = feet.distance_m <= config.reach_m
    if not near.any():
        raise off_the_network(fixes, track, config)
    position = np.full(len(fixes), np.nan)
    position[known] = np.where(near, path_at(leg, feet), np.nan)
    used = leg.visit[feet.segment[near]]
    part = slice(int(used.min()), int(used.max()) + 1)
    forward = grows_with(position, fixes.t_ns, odometry, config.orientation_distance_m)
    if forward and len(leg.visits[part]) == len(leg.visits):
        covered = leg
    else:
        covered = leg_of(track, leg.visits[part] if forward else turned(leg.visits[part]))
        feet = _carried_over(fixes.points.take(known), feet, leg, covered, part, forward)
    everywhere = no_feet(len(fixes))
    everywhere.put(known, feet)
    ones, zeros = np.ones(len(fixes)), np.zeros(len(fixes), dtype=np.int64)
    return TravelledPath(track, (covered,)), Assignment(zeros, None, ones, ones, everywhere)


def turned(visits: Sequence[Visit]) -> list[Visit]:
    """The same elements run the other way round."""
    return [Visit(visit.element, not visit.forward) for visit in reversed(visits)]


def _carried_over(points: Points, feet: Feet, leg: Leg, covered: Leg, part: slice, forward: bool) -> Feet:
    """Feet on a whole chain as feet on its covered part; those at that part's ends are sought anew."""
    segment = feet.segment - int(np.searchsorted(leg.visit, part.start))
    last = len(covered.line) - 1
    new = Feet(
        np.clip(segment if forward else last - segment, 0, last),
        feet.fraction if forward else 1.0 - feet.fraction,
        feet.offset_m if forward else -feet.offset_m,
        feet.distance_m.copy(),
    )
    again = np.flatnonzero((segment <= 0) | (segment >= last))
    new.put(again, nearest_on_leg(points.take(again), covered))
    return new


def whole_chain(track: Track, links: pl.DataFrame) -> list[Visit] | None:
    """All elements in a row, each in its sense along the row; none where the track branches or is parted."""
    joined: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, position_a, b, position_b, navigability in links.iter_rows():
        if navigability != Navigability.NONE.value:
            one, other = (track.index[a], int(position_a)), (track.index[b], int(position_b))
            joined.setdefault(one, []).append(other)
            joined.setdefault(other, []).append(one)
    ends = [(element, position) for element in range(len(track.ids)) for position in (0, 1)]
    if any(len(set(others)) > 1 for others in joined.values()):
        return None
    free = [end for end in ends if end not in joined]
    if len(free) != 2:
        return None
    visits: list[Visit] = []
    end: tuple[int, int] | None = free[0]
    while end is not None:
        element, position = end
        visits.append(Visit(element, forward=position == 0))
        onward = joined.get((element, 1 - position))
        end = onward[0] if onward else None
    return visits if len(visits) == len(track.ids) else None
