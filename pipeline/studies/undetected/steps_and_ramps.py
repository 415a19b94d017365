"""The largest unnoticed step and ramp: what a fault of a given shape, begun at the worst moment, could have become.

Both are smaller than the largest profile, which may follow the recorded noise and every threshold. Each shape has one
size, in which all monitors are linear: the least room over its response decides.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from pipeline.studies.undetected.watched import NO_ROW, Watched
from schemas.arrays import Floats, Ints

Shape = Literal["step", "ramp"]


def largest_of_shape(window: Watched, shape: Shape, starts: Ints | None = None) -> float:
    """The error ahead at the last row by the largest step or ramp that began after the first unnoticed [m].

    `starts`: rows by which it has begun, by default one a second.
    """
    starts = _starting_rows(window) if starts is None else starts
    response = np.zeros((starts.size, window.weight.shape[1]))
    largest = np.full(starts.size, np.inf)
    faults = np.zeros((window.count, starts.size))
    for row in range(1, window.count):
        faults[row], rate = _fault_and_rate(window, row, starts, faults[row - 1], shape)
        if window.fresh[row]:
            response[:] = 0.0
            jump = faults[row] - faults[row - 1]
            largest = np.minimum(largest, _largest_size(jump, window.fastest_m[row], -window.fastest_m[row]))
        else:
            response = (1.0 - window.weight[row]) * response + window.weight[row] * rate[:, None]
            upper = window.threshold_mps[row] - window.average_mps[row]
            lower = -window.threshold_mps[row] - window.average_mps[row]
            largest = np.minimum(largest, _largest_size(response, upper, lower).min(axis=1, initial=np.inf))
            u = window.rate_mps[row]
            largest = np.minimum(largest, _largest_size(rate, window.most_mps[row] - u, window.least_mps[row] - u))
        largest = np.minimum(largest, _largest_size(faults[row], window.high_m[row], window.low_m[row]))
        if np.isfinite(window.held_high_m[row]):
            anchor = window.anchor[row]
            moved = faults[row] - (faults[anchor] if anchor != NO_ROW else 0.0)
            largest = np.minimum(largest, _largest_size(moved, window.held_high_m[row], window.held_low_m[row]))
    return float(np.max(faults[-1] * largest, initial=0.0))


def _starting_rows(window: Watched) -> Ints:
    """Rows at which a shape begins: the first after each second, and where the bank began anew.

    Noise and thresholds change little in less than a second.
    """
    seconds = np.floor(window.t_s)
    first = np.flatnonzero(np.diff(seconds, prepend=seconds[0] - 1.0) > 0.0)
    return np.union1d(first[first > 0], np.union1d(np.flatnonzero(window.fresh[1:]) + 1, [1]))


def _fault_and_rate(window: Watched, row: int, starts: Ints, before: Floats, shape: Shape) -> tuple[Floats, Floats]:
    """The fault of each start at a row, of size one, and the rate at which the bank sees it change."""
    if shape == "step":
        step = np.where(starts == row, 1.0, 0.0)
    else:
        step = np.where(starts <= row, window.t_s[row] - window.t_s[row - 1], 0.0)
    return before + step, step / window.gain_s[row]


def _largest_size(response: Floats, upper: Floats | float, lower: Floats | float) -> Floats:
    """The largest size at which a response stays between its bounds."""
    size = np.where(response > 0.0, upper, lower) / np.where(response == 0.0, 1.0, response)
    room: Floats = np.where(response == 0.0, np.inf, size)
    return room
