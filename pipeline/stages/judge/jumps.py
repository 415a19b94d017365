"""Jumps: steps of GNSS minus evidence accumulated over at most a second (DOMAIN section 5.3; DIAG, Hazards)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.odometry import Odometry
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints, spans_of, times_ns
from schemas.config import HazardConfig


@dataclass(frozen=True)
class Steps:
    """How position minus evidence changed from each valid position to the next, along growing path [m].

    Arrays over valid positions; `excess_m`: sum of the changes; `linked`: the change from the position before is
    known, and no gap lies between.
    """

    t_ns: Ints
    excess_m: Floats
    linked: Bools


@dataclass(frozen=True)
class Jump:
    """A jump from valid position `first - 1` to `last`; `step_m` in the direction of travel."""

    first: int
    last: int
    step_m: float


def jumps_of(positions: pl.DataFrame, odometry: Odometry | None, gap_ns: int, config: HazardConfig) -> list[Jump]:
    """All jumps of the positions, in order of time; numbers are rows of `positions`."""
    at_ns, path_m = times_ns(positions, "at"), floats(positions, "path_m")
    counted_m = np.full(max(at_ns.size - 1, 0), np.nan)
    if odometry is not None:
        counted_m = odometry.between(at_ns[:-1], at_ns[1:]).distance_m
    steps = steps_of(times_ns(positions), path_m, floats(positions, "reference_m"), counted_m, gap_ns)
    return find_jumps(steps, ints(positions["direction"]), config)


def steps_of(t_ns: Ints, path_m: Floats, train_m: Floats, counted_m: Floats, gap_ns: int) -> Steps:
    """`train_m`: path position by the reference, NaN elsewhere; there `counted_m`, the odometer's steps, serves."""
    by_reference, by_odometer = np.diff(path_m - train_m), np.diff(path_m) - counted_m
    change = np.where(np.isfinite(by_reference), by_reference, by_odometer)
    linked = np.isfinite(change) & (np.diff(t_ns) <= gap_ns)
    excess = np.concatenate([[0.0], np.cumsum(np.where(linked, change, 0.0))])
    return Steps(t_ns, excess[: t_ns.size], np.concatenate([[False], linked])[: t_ns.size])


def find_jumps(steps: Steps, direction: Ints, config: HazardConfig) -> list[Jump]:
    """All jumps in order of time."""
    largest = _largest_step(steps, config)
    jumps: list[Jump] = []
    for sign in (1.0, -1.0):
        for begin, end in spans_of(largest * sign > config.jump_limit_m):
            first, last = _extent(steps, begin, end, sign, config)
            step_m = float(steps.excess_m[last] - steps.excess_m[first - 1]) * float(direction[last])
            jumps.append(Jump(first, last, step_m))
    return sorted(jumps, key=lambda jump: (jump.first, jump.last))


def _largest_step(steps: Steps, config: HazardConfig) -> Floats:
    """For each position the largest change since one at most the window before, signed.

    The position just before always counts: a slower log has no other.
    """
    excess, size = steps.excess_m, steps.t_ns.size
    largest = np.zeros(size)
    if size < 2 or np.ptp(excess) <= config.jump_limit_m:
        return largest
    window_ns = round(config.jump_window_s * NS_PER_S)
    chain = np.cumsum(~steps.linked)
    for lag in range(1, size):
        near = chain[lag:] == chain[:-lag]
        if lag > 1:
            near &= steps.t_ns[lag:] - steps.t_ns[:-lag] <= window_ns
        if not near.any():
            break
        step = np.where(near, excess[lag:] - excess[:-lag], 0.0)
        part = largest[lag:]
        part[:] = np.where(np.abs(step) > np.abs(part), step, part)
    return largest


def _extent(steps: Steps, begin: int, end: int, sign: float, config: HazardConfig) -> tuple[int, int]:
    """First and last position of the increments that make the jump seen at positions `begin..end`."""
    window_ns = round(config.jump_window_s * NS_PER_S)
    earliest = int(np.searchsorted(steps.t_ns, steps.t_ns[begin] - window_ns, side="left"))
    start = max(min(earliest + 1, begin), 1)
    increments = np.diff(steps.excess_m[start - 1 : end + 1]) * sign
    increments[~steps.linked[start : end + 1]] = 0.0
    part = np.flatnonzero(increments >= config.jump_share * increments.max())
    return start + int(part[0]), start + int(part[-1])
