"""Estimated speed against the speed that the evidence leaves, as means over windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.claim.front import Front
from pipeline.claim.profile import KMH_PER_MPS
from pipeline.claim.tally import codes, within
from schemas.arrays import NS_PER_S, Floats, Ints


@dataclass(frozen=True)
class SpeedErrors:
    """Per window: its end, length, largest estimated speed, and the mean of estimate minus truth as an interval.

    NaN where the evidence does not know it. The mean is beyond the limit at the largest speed only if some instant is
    beyond the limit at its own speed (limits grow with speed); a mean within says nothing of the instants.
    """

    t_ns: Ints
    length_s: Floats
    fastest_kmh: Floats
    low_kmh: Floats
    high_kmh: Floats

    def within(self, over_kmh: Floats | float, under_kmh: Floats | float) -> Ints:
        """Whether the estimate is at most so much above the train's speed and so much below it (`codes`)."""
        return codes(*within(self.low_kmh, self.high_kmh, over_kmh, under_kmh))


def speed_errors(front: Front, window_s: float) -> SpeedErrors:
    """One window after the other; none over a gap, a reversal, or epochs without a speed."""
    clock = front.clock
    pairs = _windows(front, round(window_s * NS_PER_S))
    first, last = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    length = (clock.t_ns[last] - clock.t_ns[first]) / NS_PER_S
    steps = 0.5 * (front.speed_mps[1:] + front.speed_mps[:-1]) * clock.held_s[:-1]
    way = np.concatenate(([0.0], np.cumsum(np.nan_to_num(steps))))
    sense = front.direction[first]
    estimated = sense * (way[last] - way[first])
    run_m = sense * (front.path_m[last] - front.path_m[first])
    # The evidence calls the position itself right at both ends, so path less error is where the train was.
    known = front.proved[first] & front.proved[last]
    # The estimate is a mean over the time before each epoch: how late that is while the speed changes is not known.
    late_m = front.speed_late_s * np.abs(front.speed_mps[last] - front.speed_mps[first])
    least = run_m - (front.high_m[last] - front.low_m[first]) - late_m
    most = run_m - (front.low_m[last] - front.high_m[first]) + late_m
    low, high = (np.where(known, (estimated - way_m) / length, np.nan) for way_m in (most, least))
    fastest = np.array([np.abs(front.speed_mps[begin : end + 1]).max() for begin, end in pairs], dtype=np.float64)
    return SpeedErrors(clock.t_ns[last], length, *(speed * KMH_PER_MPS for speed in (fastest, low, high)))


def _windows(front: Front, window_ns: int) -> list[tuple[int, int]]:
    held, t_ns, sense = front.clock.held_s, front.clock.t_ns, front.direction
    usable = np.isfinite(front.speed_mps) & np.isfinite(sense) & (sense != 0)
    joined = usable[:-1] & usable[1:] & (held[:-1] > 0) & (sense[:-1] == sense[1:])
    found: list[tuple[int, int]] = []
    begin = 0
    for row, together in enumerate(joined, start=1):
        if not together:
            begin = row
        elif t_ns[row] - t_ns[begin] >= window_ns:
            found.append((begin, row))
            begin = row
    return found
