"""How far apart physical balises may be: the way on which no unnoticed fault can have reached the failure limit."""

from __future__ import annotations

from functools import partial

import numpy as np

from pipeline.figures.undetected import Spacing
from pipeline.undetected.error import largest_errors
from pipeline.undetected.growth import growth_with, horizons
from pipeline.undetected.shares import best_shares
from pipeline.undetected.stretch import stretch_after
from pipeline.undetected.watched import Watched
from schemas.arrays import Floats
from schemas.config import Configuration

# First end of the search [s]; it goes on twice as far as long as the limit is not reached.
_FIRST_S = 300.0


def largest_spacing(rows: Watched, way_m: Floats, config: Configuration) -> Spacing:
    """Physical balises thought of every so often (`spacing_step_s`); `way_m`: way driven at each row."""
    limit_m, step_s = config.hazards.failure_limit_m, config.undetected.spacing_step_s
    if rows.rows < 2:
        return Spacing()
    starts = np.unique(np.searchsorted(rows.t_s, np.arange(rows.t_s[0], rows.t_s[-1], step_s)))
    splits = _splits_anywhere(rows)
    both = (rows, rows.mirrored())
    found = [(start, _first_beyond(both, start, limit_m, splits)) for start in starts.tolist() if start + 1 < rows.rows]
    reached = [(start, row) for start, row in found if row is not None]
    ways = [float(way_m[row - 1] - way_m[start]) for start, row in reached]
    times = [float(rows.t_s[row - 1] - rows.t_s[start]) for start, row in reached]
    return Spacing(min(ways, default=None), min(times, default=None), len(found), len(reached))


def _first_beyond(both: tuple[Watched, Watched], start: int, limit_m: float, splits: list[Floats]) -> int | None:
    """The first row after `start` at which the error may be beyond the limit, in either direction."""
    rows, ahead_s = both[0], _FIRST_S
    while True:
        end = min(int(np.searchsorted(rows.t_s, rows.t_s[start] + ahead_s)), rows.rows - 1)
        end = max(end, start + 1)
        grow = partial(growth_with, splits=splits)
        most = np.maximum(*(largest_errors(one, start, end, grow).most_m for one in both))
        beyond = np.flatnonzero(most > limit_m)
        if beyond.size:
            return start + 1 + int(beyond[0])
        if end == rows.rows - 1:
            return None
        ahead_s *= 2.0


def _splits_anywhere(rows: Watched) -> list[Floats]:
    """Best splits of a long stretch, for any start: what is best hangs on thresholds, and these change little."""
    edges = np.append(np.flatnonzero(rows.fresh | (np.arange(rows.rows) == 0)), rows.rows)
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]), int(edges[longest + 1]) - 1
    if last - first < 2:
        return []
    stretch = stretch_after(rows, first + (last - first) // 8, last, known=True)
    return [best_shares(stretch.first(count)) for count in horizons(stretch.rows)]
