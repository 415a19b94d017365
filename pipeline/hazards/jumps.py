"""Jumps: steps of GNSS minus truth accumulated over at most a second (DOMAIN section 5; DIAG, Hazards)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.hazards.arrays import runs_of
from pipeline.hazards.crossings import Beacons, Crossing, crossing_at
from pipeline.hazards.series import Series
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import HazardConfig

# A jump spread over several epochs reaches from its first to its last increment of at least this
# share of the largest: noise before and after it is no part of it.
_SHARE_OF_LARGEST = 0.3
# A slip is the same number up to rounding.
_SAME_DECIMALS = 3


@dataclass(frozen=True)
class Jump:
    """A jump from usable epoch `first - 1` to `last`; `first` is the first epoch after it began.

    `step_m` and the errors are in the direction of travel. `crossed`: VBs in order that the jump
    crosses and the true movement does not.
    """

    first: int
    last: int
    step_m: float
    error_before_m: float
    error_after_m: float
    crossed: tuple[Crossing, ...]


def find_jumps(series: Series, beacons: tuple[Beacons, ...], config: HazardConfig) -> list[Jump]:
    """All jumps in order of time, whether they cross a VB or not.

    What the reads around prove to be a slip of the odometer (`_slipped`) is none.
    """
    largest = _largest_step(series, config)
    jumps: list[Jump] = []
    for sign in (1.0, -1.0):
        begins, ends = runs_of(largest * sign > config.jump_limit_m)
        spans = [_span(series, begin, end, sign, config) for begin, end in zip(begins, ends, strict=True)]
        slipped = _excused(series, [span for span in spans if _slipped(series, *span)])
        jumps += [_jump(series, beacons, *span) for span in spans if span not in slipped]
    return sorted(jumps, key=lambda jump: (jump.first, jump.last))


def _largest_step(series: Series, config: HazardConfig) -> Floats:
    """For each epoch the largest step of `excess_m` from an epoch at most the window before, signed.

    The epoch just before always counts where the movement is linked (a slower log).
    """
    largest = np.zeros(series.size)
    if series.size < 2 or np.ptp(series.excess_m) <= config.jump_limit_m:
        return largest
    window_ns = round(config.jump_window_s * NS_PER_S)
    chain = np.cumsum(~series.linked)
    for lag in range(1, series.size):
        dt = series.t_ns[lag:] - series.t_ns[:-lag]
        near: Bools = chain[lag:] == chain[:-lag]
        if lag > 1:
            near &= dt <= window_ns
        if not near.any():
            break
        step = np.where(near, series.excess_m[lag:] - series.excess_m[:-lag], 0.0)
        part = largest[lag:]
        part[:] = np.where(np.abs(step) > np.abs(part), step, part)
    return largest


def _span(series: Series, begin: int, end: int, sign: float, config: HazardConfig) -> tuple[int, int]:
    """First and last epoch of the increments that make the jump flagged over `begin..end`."""
    window_ns = round(config.jump_window_s * NS_PER_S)
    earliest = int(np.searchsorted(series.t_ns, series.t_ns[begin] - window_ns, side="left"))
    start = max(min(earliest + 1, begin), 1)
    increments = np.diff(series.excess_m[start - 1 : end + 1]) * sign
    increments[~series.linked[start : end + 1]] = 0.0
    part_of_it: Ints = np.flatnonzero(increments >= _SHARE_OF_LARGEST * increments.max())
    return start + int(part_of_it[0]), start + int(part_of_it[-1])


def _slipped(series: Series, first: int, last: int) -> bool:
    """A step that the slip between two reads accounts for: of its direction, and within noise no larger.

    Where the odometer counts too far, GNSS minus odometer falls. A slip that lasts over a read is one of each side.
    """
    step = float(series.excess_m[last] - series.excess_m[first - 1])
    proved = sum(_proved(series, (first, last)))
    return proved > 0.0 and abs(step) <= proved + float(series.noise_m[first - 1 : last + 1].max())


def _proved(series: Series, span: tuple[int, int]) -> frozenset[float]:
    """Sizes of the slips around a step that are of its direction, each once: counted for two, one excuses too much."""
    first, last = span
    step = series.excess_m[last] - series.excess_m[first - 1]
    slips = np.round(series.slip_m[first - 1 : last + 1], _SAME_DECIMALS)
    return frozenset(np.abs(slips[slips * step < 0.0]).tolist())


def _excused(series: Series, spans: list[tuple[int, int]]) -> set[tuple[int, int]]:
    """Those of the steps of one direction that the slips account for together: one slip excuses no two jumps."""
    proved = [_proved(series, span) for span in spans]
    kept = set()
    for span, own in zip(spans, proved, strict=True):
        beside = [(other, slips) for other, slips in zip(spans, proved, strict=True) if own & slips]
        steps = np.unique(np.concatenate([np.arange(first, last + 1) for (first, last), _ in beside]))
        together = abs(float((series.excess_m[steps] - series.excess_m[steps - 1]).sum()))
        slipped = sum(frozenset().union(*(slips for _, slips in beside)))
        if together <= slipped + float(series.noise_m[steps].max()):
            kept.add(span)
    return kept


def _jump(series: Series, beacons: tuple[Beacons, ...], first: int, last: int) -> Jump:
    before = first - 1
    step = float(series.excess_m[last] - series.excess_m[before]) * float(series.direction[last])
    after_m = float(series.error_m[last])
    return Jump(first, last, step, after_m - step, after_m, _crossed(series, beacons, first, last))


def _crossed(series: Series, beacons: tuple[Beacons, ...], first: int, last: int) -> tuple[Crossing, ...]:
    before = first - 1
    a, b = float(series.path_m[before]), float(series.path_m[last])
    travelled = (b - a) - float(series.excess_m[last] - series.excess_m[before])
    found = []
    for part in beacons:
        if part.leg not in (int(series.leg[before]), int(series.leg[last])):
            continue
        for index in part.between(a, b) - part.between(a, a + travelled):
            epoch = _epoch_of(series, float(part.path_m[index]), before, last)
            found.append(crossing_at(series, part, index, epoch))
    return tuple(sorted(found, key=lambda c: (c.t_ns, c.balise_id)))


def _epoch_of(series: Series, place_m: float, before: int, last: int) -> int:
    """The epoch in `before + 1 .. last` whose movement passes `place_m` first."""
    passed = series.path_m[before : last + 1] >= place_m
    return before + 1 + int(np.flatnonzero(passed[1:] != passed[:-1])[0])
