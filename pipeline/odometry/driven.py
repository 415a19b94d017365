"""The odometer's distance without quantisation noise, which is neither way nor turn.

A train that stands beside the edge of two counts, or whose odometer's reading is noisy, drives to and fro in the rows
alone. The distance follows them with a hysteresis as wide as they scatter, so that only what leaves it counts.
"""

from __future__ import annotations

import numpy as np

from pipeline.figures.bounds import SURE_SIGMAS
from schemas.arrays import Floats

# Within so many of them a row is where the train stood; a counter's edges are 1.7 of its own apart from their middle.
_NEAR_SIGMAS = 2.0


def hysteresis_m(sigma_m: Floats) -> Floats:
    """By how much the distance may leave what is held of it before it has moved [m]."""
    return SURE_SIGMAS * sigma_m


def with_hysteresis(distance_m: Floats, width_m: Floats) -> Floats:
    """The distance with a hysteresis to both sides [m], causal; NaN where it is not known.

    Behind a movement it stays `width_m` back, and turns once the distance came back by twice that.
    """
    held = np.full(distance_m.size, np.nan)
    rows = np.flatnonzero(np.isfinite(distance_m))
    if rows.size == 0:
        return held
    at = float(distance_m[rows[0]])
    low, high = (distance_m - width_m)[rows].tolist(), (distance_m + width_m)[rows].tolist()
    values = []
    for least, most in zip(low, high, strict=True):
        at = min(max(at, least), most)
        values.append(at)
    held[rows] = values
    return held


def way_m(distance_m: Floats, width_m: Floats) -> float:
    """Way driven, to and fro [m], by a known distance that scatters within the hysteresis."""
    held = with_hysteresis(distance_m, width_m)
    steps = np.diff(held)
    moves = np.flatnonzero(steps)
    turns = moves[1:][np.sign(steps[moves[1:]]) != np.sign(steps[moves[:-1]])]
    return float(np.abs(steps).sum() + 2.0 * width_m[turns + 1].sum() + abs(distance_m[-1] - held[-1]))


def evenly_driven(t_s: Floats, distance_m: Floats, width_m: Floats, least_mps: float) -> tuple[Floats, Floats]:
    """Times and distances [m] between which the train drove evenly, after the fact; slower than this it stood.

    From one row that moves the held distance to the next. Where that is a stand, it moved no sooner than from the last
    row about where it stood.
    """
    held = with_hysteresis(distance_m, width_m)
    steps = np.diff(held, prepend=np.nan)
    moves = np.flatnonzero(steps != 0)
    at_s, at_m = t_s[moves].tolist(), distance_m[moves].tolist()
    gaps, ways = np.diff(t_s[moves]), np.abs(np.diff(distance_m[moves]))
    # A turn, and the first way, show after the hysteresis alone.
    turned = steps[moves[1:]] * np.nan_to_num(steps[moves[:-1]]) <= 0
    stood = ways - np.where(turned, 2.0 * width_m[moves[1:]], 0.0) <= least_mps * gaps
    for gap in np.flatnonzero(stood & (gaps > 0))[::-1].tolist():
        between = slice(int(moves[gap]), int(moves[gap + 1]))
        stood_m = float(np.median(distance_m[between]))
        near = np.abs(distance_m[between] - stood_m) <= _NEAR_SIGMAS / SURE_SIGMAS * width_m[between]
        last = between.start + int(np.flatnonzero(near)[-1]) if near.any() else between.start
        at_s.insert(gap + 1, float(t_s[last]))
        at_m.insert(gap + 1, stood_m)
    return np.array([*at_s, t_s[-1]]), np.array([*at_m, at_m[-1]])
