"""Positions as steps of a second: what the paths of a set are tested against."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.track.geodesy import Points
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, median
from schemas.frozen import frozen

# Steps on each side with which one is compared before it counts.
_NEIGHBOURS = 3
# The usual time between steps is that of so many before.
_PERIOD_STEPS = 31
# The direction of the way is that over so many steps before.
_HEADING_STEPS = 5


@frozen
class PathSteps:
    """Means of a second of positions, shapes (n,); `points` (n, 3).

    `t_ns`: mean time; `begin_s`, `end_s`: of its first and last position, since `start_ns`, the first of all;
    `sigma_m` of the position across; `way_m`: since the step before, the larger of odometer and positions; `counted`:
    it moved by a metre, and is no outlier; `along_m`: position along the track minus an independent odometer, NaN
    without one; `with_odometer`: some odometer has told of the way by then; `pinned`: element of a balise read then,
    else -1.
    """

    t_ns: Ints
    start_ns: int
    begin_s: Floats
    end_s: Floats
    points: Points
    sigma_m: Floats
    way_m: Floats
    counted: Bools
    along_m: Floats
    with_odometer: Bools
    pinned: Ints

    def __len__(self) -> int:
        return len(self.end_s)

    @property
    def begin_ns(self) -> Ints:
        return np.round(self.begin_s * NS_PER_S).astype(np.int64) + self.start_ns

    @cached_property
    def period_s(self) -> Floats:
        """Usual time from one to the next, a second at least: median of the last half minute of steps [s].

        Of those before alone: what feeds detection knows nothing of later ones.
        """
        since_s = np.diff(self.end_s)
        period_s = np.ones(len(self.end_s))
        for step in range(1, min(_PERIOD_STEPS, len(period_s))):
            period_s[step] = median(since_s[:step])
        if since_s.size >= _PERIOD_STEPS:
            period_s[_PERIOD_STEPS:] = np.median(sliding_window_view(since_s, _PERIOD_STEPS), axis=1)
        return np.maximum(period_s, 1.0)


def path_steps(
    t_ns: Ints,
    points: Points,
    sigma_m: Floats,
    way: Callable[[Ints, Ints], Floats] | None = None,
    independent: bool = False,
    pinned: Ints | None = None,
) -> PathSteps:
    """Means of a second of positions, in order of time; slower logs: single positions.

    `sigma_m`: of each, across the track; `way`: distance between instants by an odometer [m], NaN where unknown;
    `independent`: it is not made of the positions; `pinned`: element of a balise read at a position, else -1.
    """
    t_s = (t_ns - t_ns[0]) / NS_PER_S if t_ns.size else np.zeros(0)
    second = np.floor(t_s + 1e-6).astype(np.int64)
    first = np.flatnonzero(np.diff(second, prepend=-1))
    size = np.diff(first, append=t_ns.size)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values, first, axis=0).T / size).T

    means = Points(*(mean(vectors) for vectors in (points.surface, points.east, points.north)))
    chord_m = np.linalg.norm(np.diff(means.surface, axis=0, prepend=means.surface[:1]), axis=1)
    counted_m = np.full(len(means), np.nan)
    start_ns = int(t_ns[0]) if t_ns.size else 0
    middle_ns = np.round(mean(t_s) * NS_PER_S).astype(np.int64) + start_ns
    if way is not None:
        counted_m[1:] = way(middle_ns[:-1], middle_ns[1:])
    known = np.isfinite(counted_m)
    moved_m = np.where(known, np.abs(counted_m), chord_m)
    mean_sigma_m = np.sqrt(mean(sigma_m**2))
    counted = np.diff(np.floor(np.cumsum(moved_m)), prepend=-1.0) > 0
    pins = np.full(len(means), -1, dtype=np.int64)
    if pinned is not None:
        read = np.flatnonzero(pinned >= 0)
        pins[np.searchsorted(first, read, side="right") - 1] = pinned[read]
    return PathSteps(
        t_ns=middle_ns,
        start_ns=start_ns,
        begin_s=t_s[first],
        end_s=t_s[first + size - 1],
        points=means,
        sigma_m=mean_sigma_m,
        way_m=np.where(known, np.maximum(moved_m, chord_m), chord_m),
        counted=counted & ~outliers(means, mean_sigma_m),
        along_m=_along_m(means, counted_m) if independent else np.full(len(means), np.nan),
        with_odometer=np.logical_or.accumulate(known),
        pinned=pins,
    )


def outliers(points: Points, sigma_m: Floats) -> Bools:
    """Steps far from the middle of their neighbours: reflections follow no model of errors."""
    count = len(points)
    reach = _NEIGHBOURS
    if count <= 2 * reach:
        return np.zeros(count, dtype=np.bool_)
    around = sliding_window_view(points.surface, 2 * reach + 1, axis=0)
    middles = [0.5 * (around[:, :, reach - k] + around[:, :, reach + k]) for k in range(1, reach + 1)]
    middle = np.median(np.stack(middles), axis=0)
    far = np.zeros(count, dtype=np.bool_)
    away_m = np.linalg.norm(points.surface[reach:-reach] - middle, axis=1)
    far[reach:-reach] = away_m > 4.0 * sigma_m[reach:-reach] + 3.0
    return far


def _along_m(points: Points, counted_m: Floats) -> Floats:
    """Position along the way minus an independent odometer [m]; NaN where it does not count."""
    if len(points) < _HEADING_STEPS:
        return np.full(len(points), np.nan)
    surface = points.surface
    rows = np.arange(len(points))
    # The direction of the way, by positions before: the same for every path.
    ahead = surface - surface[np.maximum(rows - _HEADING_STEPS, 0)]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-6)
    moved_m = np.einsum("ij,ij->i", np.diff(surface, axis=0, prepend=surface[:1]), ahead)
    apart_m = np.where(np.isfinite(counted_m), moved_m - np.abs(counted_m), 0.0)
    return np.where(np.isfinite(counted_m), np.cumsum(apart_m), np.nan)
