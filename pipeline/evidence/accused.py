"""Carrying the last accepted virtual balise by the odometer: an anchor that is the accused's own (DOMAIN 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.evidence.carrying import Figures, Readings
from schemas.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class OwnAnchors:
    """Virtual balises that the LDS accepted, in order of time; `path_m` on the solution's own path."""

    path_m: Floats
    readings: Readings


def carried_forward(
    anchors: OwnAnchors,
    readings: Readings,
    sign: int,
    stood: Sequence[tuple[int, int]],
    figures: Figures,
    limit_m: float,
) -> tuple[Floats, Floats]:
    """Least and largest path position of the train [m], NaN where no anchor reaches.

    5 m + 5 % of the way since the last accepted balise, never bridged. It can show that something was wrong, never
    that it was right. A balise that was accepted beyond the limit by the one before is no anchor. `sign`: +1 where the
    odometer grows with the path.
    """
    used = _consistent(anchors, sign, figures, limit_m)
    low, high = np.full((2, readings.t_ns.size), np.nan)
    if used.size == 0:
        return low, high
    last = np.searchsorted(anchors.readings.t_ns[used], readings.t_ns, side="right") - 1
    rows = np.flatnonzero(last >= 0)
    own = used[last[rows]]
    rows_low, rows_high = _interval(anchors, own, readings.take(rows), sign, figures)
    void = _stood_since(anchors.readings.t_ns[own], readings.t_ns[rows], stood)
    low[rows], high[rows] = np.where(void, np.nan, rows_low), np.where(void, np.nan, rows_high)
    return low, high


def _interval(anchors: OwnAnchors, own: Ints, readings: Readings, sign: int, figures: Figures) -> tuple[Floats, Floats]:
    there = anchors.readings.take(own)
    centre = anchors.path_m[own] + sign * figures.scale * (readings.distance_m - there.distance_m)
    half = figures.fixed_m + figures.share * np.abs(readings.travelled_m - there.travelled_m)
    counted = (readings.segment == there.segment) & (readings.segment >= 0)
    return np.where(counted, centre - half, np.nan), np.where(counted, centre + half, np.nan)


def _consistent(anchors: OwnAnchors, sign: int, figures: Figures, limit_m: float) -> Ints:
    """Accepted balises, but for those that the odometer since the one before puts beyond the limit."""
    used: list[int] = []
    for number in range(anchors.path_m.size):
        if used:
            here = np.array([number])
            low, high = _interval(anchors, np.array(used[-1:]), anchors.readings.take(here), sign, figures)
            place = anchors.path_m[number]
            if place < low[0] - limit_m or place > high[0] + limit_m:
                continue
        if anchors.readings.segment[number] >= 0:
            used.append(number)
    return np.array(used, dtype=np.int64)


def _stood_since(begin_ns: Ints, t_ns: Ints, stood: Sequence[tuple[int, int]]) -> Bools:
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for from_ns, until_ns in stood:
        void |= (t_ns >= from_ns) & (begin_ns <= until_ns)
    return void
