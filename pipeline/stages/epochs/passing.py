"""When what moves along a coordinate passes a place: one finder for positions, evidence and the reckoning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from schemas.arrays import Floats


class Passing(NamedTuple):
    """A step to row `after` passes `place`; `share` of it lies before the place, `sense` is +1 where it grows."""

    after: int
    place: int
    sense: int
    share: float

    def instant_ns(self, before_ns: int, after_ns: int) -> int:
        """The instant, in whole nanoseconds."""
        return before_ns + round(self.share * (after_ns - before_ns))


def passings(at_m: Floats, places_m: Floats | Sequence[float]) -> list[Passing]:
    """Steps of a series of known coordinates that pass places in order of growing coordinate.

    Growing from before a place to it or beyond, falling from there to before it: touching it and turning back are two.
    Those of one step are in the order of being passed.
    """
    places = np.asarray(places_m, dtype=np.float64)
    behind = np.searchsorted(places, at_m, side="right")
    found: list[Passing] = []
    for row in (np.flatnonzero(np.diff(behind)) + 1).tolist():
        before, after = int(behind[row - 1]), int(behind[row])
        begin_m, end_m = at_m[row - 1 : row + 1].tolist()
        passed = range(before, after) if after > before else range(before - 1, after - 1, -1)
        sense = 1 if after > before else -1
        found += [Passing(row, place, sense, float((places[place] - begin_m) / (end_m - begin_m))) for place in passed]
    return found
