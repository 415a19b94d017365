"""How far apart physical balises may be: the distance on which no unnoticed fault can have reached the failure limit.

A fault that begins after a later instant is also one that begins after an earlier one. So what the run allows from one
start on is as much as from any later start, and the starts that are tried bound all those between them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pipeline.studies.undetected.error import Errors, largest_errors, splits_after_tests
from pipeline.studies.undetected.figures import Spacing
from pipeline.studies.undetected.splits import best_splits, bound_growth_with
from pipeline.studies.undetected.stretch import stretch_after
from pipeline.studies.undetected.watched import Watched
from schemas.arrays import Floats
from schemas.config import Configuration, UndetectedConfig


def largest_spacing(rows: Watched, driven_m: Floats, config: Configuration) -> tuple[Spacing, Floats]:
    """The spacing of the run, and of each row how far before it a physical balise may lie [m].

    `driven_m`: distance driven at each row. Never too large; the second is NaN where no balise of this run is too far
    before.
    """
    if rows.count < 2:
        return Spacing(), np.full(rows.count, np.nan)
    step_s = config.undetected.spacing_step_s
    both = (rows, rows.in_other_direction())
    grow = partial(bound_growth_with, splits=splits_anywhere(rows))
    errors = partial(
        largest_errors, config=config.undetected, grow=grow, after=splits_after_tests(rows, config.undetected)
    )
    search = partial(_first_beyond, both, errors=errors, limit_m=config.hazards.limits.failure_m, ahead_s=step_s)
    starts = np.unique(np.searchsorted(rows.t_s, np.arange(rows.t_s[0], rows.t_s[-1], step_s))).tolist()
    first_beyond = _first_rows_beyond([start for start in starts if start + 1 < rows.count], rows.count, search)
    shortest = partial(_shortest_spacing, first_beyond, rows.t_s, config=config.undetected, search=search)
    distances, times = (shortest(place) for place in (driven_m, rows.t_s))
    reached = sum(row < rows.count for row in first_beyond.values())
    return Spacing(distances, times, len(first_beyond), reached), _distances_before_m(first_beyond, driven_m)


def _first_rows_beyond(starts: list[int], rows: int, search: Callable[[int], int]) -> dict[int, int]:
    """First row beyond the limit from each start; if none is reached from one, none from later ones."""
    found: dict[int, int] = {}
    reached = True
    for start in starts:
        found[start] = search(start) if reached else rows
        reached = found[start] < rows
    return found


def _shortest_spacing(
    first_beyond: dict[int, int], t_s: Floats, place: Floats, config: UndetectedConfig, search: Callable[[int], int]
) -> float | None:
    """The shortest distance (or time) from any row to the last one within the limit; `first_beyond`: first row beyond.

    From between two starts it is no shorter than from the second one to where the first reaches the limit. More starts
    are tried until the two agree to `spacing_close_share`, or lie within `spacing_resolution_s`; where the limit is
    reached as soon as that, it is 0.
    """
    close = 1.0 - config.spacing_close_share
    while True:
        starts = sorted(first_beyond)
        if any(_is_too_near(start, first_beyond[start], t_s, place, config) for start in starts):
            return 0.0
        pairs = zip(starts, [*starts[1:], place.size - 1], strict=True)
        sure = [(float(place[first_beyond[before] - 1] - place[after]), before, after) for before, after in pairs]
        least, before, after = min((item for item in sure if first_beyond[item[1]] < place.size), default=(None, 0, 0))
        if least is None:
            return None
        near = after <= before + 1 or t_s[after] - t_s[before] <= config.spacing_resolution_s
        if near or least >= close * (place[first_beyond[before] - 1] - place[before]):
            return max(least, 0.0)
        first_beyond[(before + after) // 2] = search((before + after) // 2)


def _is_too_near(start: int, beyond: int, t_s: Floats, place: Floats, config: UndetectedConfig) -> bool:
    """Whether the limit is reached too soon after a start, or too near, for any spacing to be given."""
    if beyond == place.size:
        return False
    last = beyond - 1
    return bool(place[last] <= place[start] or t_s[last] - t_s[start] <= config.spacing_resolution_s)


def _distances_before_m(first_beyond: dict[int, int], driven_m: Floats) -> Floats:
    """How far before each row a balise keeps it within the limit: the first start that does, NaN where all do."""
    starts = np.array(sorted(first_beyond))
    beyond = np.maximum.accumulate([first_beyond[start] for start in starts])
    rows = np.arange(driven_m.size)
    first = np.searchsorted(beyond, rows, side="right")
    at = np.minimum(starts[np.minimum(first, starts.size - 1)], rows)
    return np.where(first == 0, np.nan, driven_m - driven_m[np.where(first < starts.size, at, rows)])


def _first_beyond(
    both: tuple[Watched, Watched], start: int, errors: Callable[[Watched], Errors], limit_m: float, ahead_s: float
) -> int:
    """The first row after `start` at which the error may be beyond the limit, in either direction; else their number.

    `ahead_s`: first end of the search; it goes on twice as far as long as the limit is not reached.
    """
    rows = both[0]
    while True:
        end = min(int(np.searchsorted(rows.t_s, rows.t_s[start] + ahead_s)), rows.count - 1)
        end = max(end, start + 1)
        most = np.maximum(*(errors(travel.after_fix(start, end)).most_m for travel in both))
        beyond = np.flatnonzero(most > limit_m)
        if beyond.size:
            return start + 1 + int(beyond[0])
        if end == rows.count - 1:
            return rows.count
        ahead_s *= 2.0


def splits_anywhere(rows: Watched) -> list[Floats]:
    """Best splits of a long stretch, for any start: the best split depends on thresholds, and these change little."""
    first, last = rows.longest_stretch
    return list(best_splits(stretch_after(rows, first + (last - first) // 8, last, known=True)))
