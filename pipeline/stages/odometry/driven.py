"""The odometer's distance without quantisation noise, by a hysteresis as wide as its rows scatter."""

from __future__ import annotations

import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, runs_of
from schemas.config import AlignConfig

# Numerics: rows that are looked at together, and fewer than which are not worth it.
_BLOCK, _FEW = 4096, 64


def hysteresis_m(sigma_m: Floats, config: AlignConfig) -> Floats:
    """How far the distance may leave the held distance before that follows [m]."""
    return config.sure_sigmas * sigma_m


def with_hysteresis(distance_m: Floats, width_m: Floats) -> Floats:
    """The distance with a hysteresis to both sides [m], causal; NaN where it is not known.

    It stays `width_m` behind a movement, and turns once the distance came back by twice that.
    """
    if not width_m.any():
        return distance_m
    held_m = np.full(distance_m.size, np.nan)
    rows = np.flatnonzero(np.isfinite(distance_m))
    if rows.size == 0:
        return held_m
    at_m = float(distance_m[rows[0]])
    least_m, most_m = (distance_m - width_m)[rows], (distance_m + width_m)[rows]
    values = np.empty(rows.size)
    begin, ahead, few = 0, True, _FEW
    while begin < rows.size:
        # Ahead it follows the lower edge, back the upper one, up to the row at which the other edge takes it along.
        block = slice(begin, begin + _BLOCK)
        low_m, high_m = least_m[block], most_m[block]
        edge_m, other_m = (low_m, high_m) if ahead else (high_m, low_m)
        follow, beyond = (np.fmax, np.greater) if ahead else (np.fmin, np.less)
        part_m = follow(follow.accumulate(edge_m), at_m)
        taken = beyond(part_m, other_m)
        count = int(np.argmax(taken)) if taken.any() else taken.size
        values[begin : begin + count] = part_m[:count]
        at_m = float(part_m[count - 1]) if count else at_m
        begin += count
        ahead ^= count < taken.size
        # The more often movements are short, the longer no block is tried.
        few = _FEW if count >= _FEW else min(2 * few, _BLOCK)
        if count < _FEW:
            end = min(begin + few, rows.size)
            values[begin:end] = _row_by_row(at_m, least_m[begin:end], most_m[begin:end])
            at_m = float(values[end - 1])
            begin = end
    held_m[rows] = values
    return held_m


def _row_by_row(at_m: float, least_m: Floats, most_m: Floats) -> list[float]:
    """The distance with hysteresis row by row, where movements to and fro are shorter than a block is worth."""
    values = []
    for low_m, high_m in zip(least_m.tolist(), most_m.tolist(), strict=True):
        at_m = min(max(at_m, low_m), high_m)
        values.append(at_m)
    return values


def turns_of(distance_m: Floats, back_m: float) -> list[tuple[int, int, int]]:
    """Turns: row of the farthest place, row at which it had come back by `back_m`, sense from then on; +1 at first."""
    turns: list[tuple[int, int, int]] = []
    start, sense = 0, 1
    while start < distance_m.size:
        ahead_m = sense * distance_m[start:]
        came_back_m = np.maximum.accumulate(ahead_m) - ahead_m
        row = int(np.argmax(came_back_m >= back_m))
        if came_back_m[row] < back_m:
            break
        sense = -sense
        turns.append((start + int(np.argmax(ahead_m[: row + 1])), start + row, sense))
        start += row
    return turns


def travelled_m(t_s: Floats, distance_m: Floats, width_m: Floats, deadband_mps: float, window_s: float) -> Floats:
    """Distance driven up to each row, to and fro [m]; of a stand only the farthest it was from its place.

    `width_m`: of the hysteresis that takes the noise of rows away, infinite where it is not known yet.
    """
    held_m = with_hysteresis(distance_m, width_m)
    driven = driven_or_left_m(held_m, moving_steps(t_s, held_m, deadband_mps, window_s))
    steps = np.diff(held_m)
    moves = np.flatnonzero(steps)
    turned = np.sign(steps[moves[1:]]) != np.sign(steps[moves[:-1]])
    # Before a turn the held distance lags behind, after it too (`with_hysteresis`): both were driven all the same.
    lags_m = np.zeros(held_m.size)
    lags_m[moves[1:][turned] + 1] = width_m[moves[:-1][turned] + 1] + width_m[moves[1:][turned] + 1]
    # While it is not known how wide the hysteresis is, the distance is that from the place held.
    away_m = np.where(np.isinf(width_m), np.abs(distance_m - held_m), 0.0)
    return np.asarray(np.maximum.accumulate(driven + np.cumsum(lags_m) + away_m))


def is_moving(t_s: Floats, driven_m: Floats, deadband_mps: float, window_s: float) -> Bools:
    """Whether more was driven over the window before each time than the dead band."""
    moving: Bools = driven_m - np.interp(t_s - window_s, t_s, driven_m) > deadband_mps * window_s
    return moving


def moving_steps(t_s: Floats, distance_m: Floats, deadband_mps: float, window_s: float) -> Bools:
    """Mean speed of each step beyond the dead band, over `window_s` at least, centred on the step."""
    half_s = 0.5 * np.maximum(np.diff(t_s), window_s)
    centre_s = 0.5 * (t_s[1:] + t_s[:-1])
    begin_m, end_m = (np.interp(at_s, t_s, distance_m) for at_s in (centre_s - half_s, centre_s + half_s))
    moving: Bools = np.abs(end_m - begin_m) > deadband_mps * 2.0 * half_s
    return moving


def driven_or_left_m(distance_m: Floats, moving: Bools) -> Floats:
    """Distance driven up to each sample [m]; of a stand only the farthest it was from its place, as noise would add
    up.
    """
    driven_m = np.abs(np.diff(distance_m))
    firsts, lasts = runs_of(~moving)
    lengths = lasts + 1 - firsts
    stand = np.repeat(np.arange(firsts.size), lengths)
    away_m = np.abs(distance_m[1:][~moving] - np.repeat(distance_m[firsts], lengths))
    # By polars: an offset for each stand would round by what the log holds later.
    stands = pl.DataFrame({"away_m": away_m, "stand": stand})
    farthest_m = stands.select(pl.col("away_m").cum_max().over("stand")).to_series().to_numpy()
    begins = np.diff(stand, prepend=-1) > 0
    driven_m[~moving] = np.where(begins, farthest_m, np.diff(farthest_m, prepend=0.0))
    return np.concatenate([[0.0], np.cumsum(driven_m)])


def evenly_driven(
    t_s: Floats, distance_m: Floats, sigma_m: Floats, least_mps: float, config: AlignConfig
) -> tuple[Floats, Floats]:
    """Support points (times, distances [m]) of a distance without quantisation noise, linear between; not causal.

    The rows that move the held distance; where the movement to the next is slower than `least_mps` the train stood, and
    the last row near the place of the stand, from which it departs, is one more.
    """
    width_m = hysteresis_m(sigma_m, config)
    steps = np.diff(with_hysteresis(distance_m, width_m), prepend=np.nan)
    # A hysteresis that narrows with the speed moves the held distance too: only rows that move themselves count.
    moves = np.flatnonzero((steps != 0) & (np.diff(distance_m, prepend=np.nan) != 0))
    elapsed_s = np.diff(t_s[moves])
    step_m = np.abs(np.diff(distance_m[moves]))
    # At a turn, and at first, the hysteresis delays the row by twice the width: the movement to it is longer by that.
    turned = steps[moves[1:]] * np.nan_to_num(steps[moves[:-1]]) <= 0
    at_standstill = step_m - np.where(turned, 2.0 * width_m[moves[1:]], 0.0) <= least_mps * elapsed_s
    points = list(zip(t_s[moves].tolist(), distance_m[moves].tolist(), strict=True))
    # From the last stand to the first, so that the places of those before stay where they are in the list.
    for gap in np.flatnonzero(at_standstill & (elapsed_s > 0))[::-1].tolist():
        between = slice(int(moves[gap]), int(moves[gap + 1]))
        points.insert(gap + 1, _departure(t_s[between], distance_m[between], sigma_m[between]))
    points.append((float(t_s[-1]), points[-1][1]))
    at_s, at_m = np.array(points).T
    return at_s, at_m


def _departure(t_s: Floats, distance_m: Floats, sigma_m: Floats) -> tuple[float, float]:
    """The last time of a stand near its place, and the place."""
    place_m = float(np.median(distance_m))
    # A uniform error of sigma s has its edges at sqrt(3) s.
    near = np.flatnonzero(np.abs(distance_m - place_m) <= np.sqrt(3.0) * sigma_m)
    return float(t_s[near[-1] if near.size else 0]), place_m
