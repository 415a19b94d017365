"""Net elements and measures of the train at instants, as the tables give them (CONTRACT section 3, `true_*`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.evidence.evidence import Alternative, EvidenceSet
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Floats, Ints
from schemas.frozen import frozen
from schemas.stages import gathered


@frozen
class TruePlaces:
    """Where the train was at each instant by the evidence; shape (instants,)."""

    netelement_ids: pl.Series
    """Every net element that the evidence leaves, in the order of the survey; null where nothing is known."""
    low_m: Floats
    """Least measure where one net element is left [m]."""
    high_m: Floats
    """Largest measure there [m]."""

    def at(self, rows: Ints) -> TruePlaces:
        """The places at some of the instants, by their numbers or a mask."""
        return TruePlaces(self.netelement_ids[rows], self.low_m[rows], self.high_m[rows])

    def columns(self) -> list[pl.Series]:
        """The places as columns of `epochs`."""
        return [
            self.netelement_ids.alias("true_netelement_ids"),
            pl.Series("true_measure_low_m", self.low_m, nan_to_null=True),
            pl.Series("true_measure_high_m", self.high_m, nan_to_null=True),
        ]


def true_places(evidence: EvidenceSet, track: SurveyedTrack) -> TruePlaces:
    """Every net element that one of the alternatives touches, with the measures on it.

    Args:
        evidence: where the train was, at n instants.
        track: the survey, whose elements the evidence numbers.

    Returns:
        Net elements and measures [m] of n instants.
    """
    parts = [_touched_elements(alternative) for alternative in evidence.alternatives]
    row, element = (np.concatenate([np.zeros(0, np.int64), *(getattr(part, name) for part in parts)]) for name in _KEYS)
    ends_m = [np.concatenate([np.zeros(0), *(getattr(part, name) for part in parts)]) for name in ("low_m", "high_m")]
    order = np.lexsort((element, row))
    row, element, low_m, high_m = (values[order] for values in (row, element, *ends_m))
    size = evidence.kind.size
    begins = np.flatnonzero(np.diff(row, prepend=-1))
    # Each net element once an instant, however often the train's routes lead over it.
    once = np.diff(row * len(track.ids) + element, prepend=-1) != 0
    counts = np.bincount(row[once], minlength=size)
    places_m = np.full((2, size), np.nan)
    if begins.size:
        places_m[:, row[begins]] = np.minimum.reduceat(low_m, begins), np.maximum.reduceat(high_m, begins)
    ids = _element_lists(element[once], counts, track.ids)
    return TruePlaces(ids, *np.where(counts == 1, places_m, np.nan))


def _element_lists(element: Ints, counts: Ints, ids: Sequence[str]) -> pl.Series:
    """Lists of names of so many net elements each, one list after the other in `element`; null for none."""
    # Few sets of net elements stand at many instants: each list is made once.
    sets: dict[tuple[int, ...], int] = {}
    place = np.full(counts.size, -1)
    ends = np.cumsum(counts)
    alone = np.flatnonzero(counts == 1)
    different, number = np.unique(element[ends[alone] - 1], return_inverse=True)
    sets.update({(one,): at for at, one in enumerate(different.tolist())})
    place[alone] = number
    for row in np.flatnonzero(counts > 1).tolist():
        several = tuple(element[ends[row] - counts[row] : ends[row]].tolist())
        place[row] = sets.setdefault(several, len(sets))
    lists = [*([ids[one] for one in several] for several in sets), None]
    return gathered(pl.Series(lists, dtype=pl.List(pl.String)), place)


_KEYS = ("row", "element")


class _Touched(NamedTuple):
    """Net elements that an interval touches: one each instant and visit."""

    row: Ints
    element: Ints
    low_m: Floats
    high_m: Floats


def _touched_elements(there: Alternative) -> _Touched:
    """The net elements that each interval of an alternative touches, with the measures on them."""
    route = there.route
    first, last = (
        np.maximum(np.searchsorted(route.entry_m, at_m, side="right") - 1, 0) for at_m in (there.low_m, there.high_m)
    )
    count = last - first + 1
    # Each instant `count` times, and with it the visits from its first on.
    numbers = np.repeat(np.arange(there.rows.size), count)
    visit = np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())
    low = route.low_m[visit]
    high = route.high_m[visit]
    begin, end = (
        np.clip(at_m[numbers] - route.entry_m[visit], 0.0, high - low) for at_m in (there.low_m, there.high_m)
    )
    forward = route.forward[visit]
    return _Touched(
        row=there.rows[numbers],
        element=route.element[visit],
        low_m=np.where(forward, low + begin, high - end),
        high_m=np.where(forward, low + end, high - begin),
    )
