"""Jumps: steps of GNSS minus evidence accumulated over at most a second (DOMAIN section 5.3; DIAG, Hazards)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.odometry import Odometry
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints, spans_of, times_ns
from schemas.config import HazardConfig


class PositionChanges(NamedTuple):
    """Per position: sum of the changes of position minus evidence up to it [m], along growing path.

    `linked`: the change since the position before is known, and no gap lies between.
    """

    t_ns: Ints
    excess_m: Floats
    linked: Bools


class Jump(NamedTuple):
    """A jump from position `first - 1` to `last`; `step_m` in the direction of travel."""

    first: int
    last: int
    step_m: float


def jumps_of(positions: pl.DataFrame, odometry: Odometry | None, gap_ns: Ints, config: HazardConfig) -> list[Jump]:
    """All jumps of the positions, in order of time; numbers are rows of `positions`."""
    at_ns = times_ns(positions, "at")
    counted_m = np.full(max(at_ns.size - 1, 0), np.nan)
    if odometry is not None:
        counted_m = odometry.steps_m(at_ns)
    places = floats(positions, "path_m"), floats(positions, "reference_m")
    steps = steps_of(times_ns(positions), *places, counted_m, gap_ns)
    return find_jumps(steps, ints(positions["direction"]), config)


def steps_of(t_ns: Ints, path_m: Floats, reference_m: Floats, counted_m: Floats, gap_ns: Ints) -> PositionChanges:
    """`reference_m`: path position by the reference, NaN elsewhere; there the odometer's steps `counted_m` serve."""
    by_reference_m = np.diff(path_m - reference_m)
    change_m = np.where(np.isfinite(by_reference_m), by_reference_m, np.diff(path_m) - counted_m)
    linked = np.isfinite(change_m) & (np.diff(t_ns) <= gap_ns[1:])
    excess_m = np.concatenate([[0.0], np.cumsum(np.where(linked, change_m, 0.0))])
    return PositionChanges(t_ns, excess_m[: t_ns.size], np.concatenate([[False], linked])[: t_ns.size])


def find_jumps(steps: PositionChanges, direction: Ints, config: HazardConfig) -> list[Jump]:
    """All jumps in order of time."""
    largest_m = _largest_step(steps, config)
    jumps: list[Jump] = []
    for sign in (1.0, -1.0):
        for begin, end in spans_of(largest_m * sign > config.limits.jump_m):
            first, last = _extent(steps, begin, end, sign, config)
            step_m = float(steps.excess_m[last] - steps.excess_m[first - 1]) * float(direction[last])
            jumps.append(Jump(first, last, step_m))
    return sorted(jumps, key=lambda jump: jump[:2])


def _largest_step(steps: PositionChanges, config: HazardConfig) -> Floats:
    """The largest signed change up to each position, from those in the window before it, always from the last before.

    Lag by lag: as soon as no pair of positions so far apart is in the window, no longer lag has one.
    """
    excess_m = steps.excess_m
    largest_m = np.zeros(excess_m.size)
    if excess_m.size < 2 or np.ptp(excess_m) <= config.limits.jump_m:
        return largest_m
    window_ns = round(config.jump_window_s * NS_PER_S)
    chain = np.cumsum(~steps.linked)
    for lag in range(1, excess_m.size):
        near = chain[lag:] == chain[:-lag]
        if lag > 1:
            near &= steps.t_ns[lag:] - steps.t_ns[:-lag] <= window_ns
        if not near.any():
            break
        step_m = np.where(near, excess_m[lag:] - excess_m[:-lag], 0.0)
        part = largest_m[lag:]
        part[:] = np.where(np.abs(step_m) > np.abs(part), step_m, part)
    return largest_m


def _extent(steps: PositionChanges, begin: int, end: int, sign: float, config: HazardConfig) -> tuple[int, int]:
    """First and last position of the increments that make up the jump over the limit at positions `begin..end`.

    Those of at least `jump_share` of the largest count, from one window before `begin` on.
    """
    window_ns = round(config.jump_window_s * NS_PER_S)
    earliest = int(np.searchsorted(steps.t_ns, steps.t_ns[begin] - window_ns, side="left"))
    start = max(min(earliest + 1, begin), 1)
    increments_m = np.diff(steps.excess_m[start - 1 : end + 1]) * sign
    increments_m[~steps.linked[start : end + 1]] = 0.0
    part = np.flatnonzero(increments_m >= config.jump_share * increments_m.max())
    return start + int(part[0]), start + int(part[-1])
