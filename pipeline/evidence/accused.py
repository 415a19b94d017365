"""Carrying the last accepted virtual balise by the odometer: an anchor that is the accused's own (DOMAIN 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.evidence.carrying import Interval, Trust
from pipeline.odometry import Odometry
from schemas.arrays import Bools, Floats, Ints


def carried_forward(
    accepted_ns: Ints,
    path_m: Floats,
    t_ns: Ints,
    odometer: Odometry,
    stood: Sequence[tuple[int, int]],
    trust: Trust,
    limit_m: float,
) -> Interval:
    """Least and largest path position of the train [m], NaN where no accepted balise reaches.

    5 m + 5 % of the way since the last balise accepted (`accepted_ns`, in order, at `path_m` of the solution's own
    path), never bridged. It can show that something was wrong, never that it was right. A balise that was accepted
    beyond the limit by the one before is no anchor. `odometer` grows with the path.
    """
    used = _consistent(accepted_ns, path_m, odometer, trust, limit_m)
    low, high = np.full((2, t_ns.size), np.nan)
    if used.size:
        last = np.searchsorted(accepted_ns[used], t_ns, side="right") - 1
        rows = np.flatnonzero(last >= 0)
        own = used[last[rows]]
        found = _carried(accepted_ns[own], path_m[own], t_ns[rows], odometer, trust)
        void = _stood_since(accepted_ns[own], t_ns[rows], stood)
        low[rows], high[rows] = (np.where(void, np.nan, values) for values in found)
    return low, high


def _carried(since_ns: Ints, at_m: Floats, t_ns: Ints, odometer: Odometry, trust: Trust) -> Interval:
    centre = at_m + odometer.between(since_ns, t_ns).distance_m
    half = trust.beside_m(np.abs(odometer.travelled_at(t_ns) - odometer.travelled_at(since_ns)), 0.0)
    return centre - half, centre + half


def _consistent(accepted_ns: Ints, path_m: Floats, odometer: Odometry, trust: Trust, limit_m: float) -> Ints:
    """Accepted balises, but for those that the odometer since the one before puts beyond the limit."""
    used: list[int] = []
    for number in range(path_m.size):
        here = slice(number, number + 1)
        if used:
            before = np.array(used[-1:])
            low, high = _carried(accepted_ns[before], path_m[before], accepted_ns[here], odometer, trust)
            if path_m[number] < low[0] - limit_m or path_m[number] > high[0] + limit_m:
                continue
        if odometer.known_at(accepted_ns[here])[0]:
            used.append(number)
    return np.array(used, dtype=np.int64)


def _stood_since(begin_ns: Ints, t_ns: Ints, stood: Sequence[tuple[int, int]]) -> Bools:
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for from_ns, until_ns in stood:
        void |= (t_ns >= from_ns) & (begin_ns <= until_ns)
    return void
