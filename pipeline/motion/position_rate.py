"""How fast the positions of one solution moved on along the path, whatever they leaped in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.figures.bounds import SURE_SIGMAS
from schemas.arrays import NS_PER_S, Bools, Floats, flags, floats, ints, times_ns

_CELL_S = 1.0
# Cells of the moving median: a leap is in one of them, so it does not count; a train is no faster for five seconds.
_CELLS = 11
# Positions farther apart tell where the train came to, not how.
HOLE_S = 3.0


@dataclass(frozen=True)
class PositionRate:
    """Speed along growing path [m/s] by cells of time, NaN before the first position and after the last.

    `edges_s`, `place_m`: borders of the cells since the first epoch, and positions there, without spikes but with
    leaps; `seen`: cells in which there are positions. `at_mps`, `step_mps`: the speed at each epoch, and from it on.
    """

    edges_s: Floats
    place_m: Floats
    rate_mps: Floats
    seen: Bools
    at_mps: Floats
    step_mps: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, stood: Bools) -> PositionRate:
        """`epochs`: `t, path_m, fix_valid, on_track`, aligned, at least two of them; `stood`: to the next."""
        t_ns = times_ns(epochs)
        t_s = (t_ns - t_ns[0]) / NS_PER_S
        path_m = floats(epochs, "path_m")
        known = flags(epochs, "fix_valid") & flags(epochs, "on_track") & np.isfinite(path_m)
        cell_s = max(_CELL_S, float(np.median(np.diff(t_s))))
        edges = np.append(np.arange(0.0, t_s[-1], cell_s), t_s[-1])
        place = np.full(edges.size, np.nan)
        seen = np.zeros(edges.size - 1, dtype=np.bool_)
        if known.sum() > 1:
            hole_s = max(HOLE_S, 1.5 * cell_s)
            x_m = _through_holes(epochs, t_s, np.where(known, path_m, np.nan), stood, hole_s)
            there = np.isfinite(x_m)
            place = np.interp(edges, t_s[there], x_m[there], left=np.nan, right=np.nan)
            seen = _seen(t_s[known], edges, hole_s)
        rate = _smooth(np.diff(place) / np.diff(edges))
        centres = 0.5 * (edges[1:] + edges[:-1])
        steps_s = 0.5 * (t_s + np.append(t_s[1:], t_s[-1]))
        at, step = (_nearest(centres, rate, times) for times in (t_s, steps_s))
        return cls(edges, _without_spikes(place), rate, seen, at, step)


def _through_holes(epochs: pl.DataFrame, t_s: Floats, path_m: Floats, stood: Bools, hole_s: float) -> Floats:
    """Positions, and inside their holes what odometer and positions tell together.

    From end to end the positions are right. In between the train went as the odometer counted; what that leaves out,
    beyond the doubt of its scale, it drove while the odometer stood. Straight on where the odometer tells nothing.
    """
    odometer, stretch = floats(epochs, "odometer_m"), ints(epochs["odometer_segment"])
    scale_sigma = np.nan_to_num(floats(epochs, "scale_sigma"))
    known = np.flatnonzero(np.isfinite(path_m))
    holes = np.flatnonzero((np.diff(known) > 1) & (np.diff(t_s[known]) > hole_s))
    filled = path_m.copy()
    for a, b in zip(known[holes].tolist(), known[holes + 1].tolist(), strict=True):
        rows = slice(a, b + 1)
        counted = odometer[rows] - odometer[a]
        if not np.isfinite(counted).all() or np.ptp(stretch[rows]) > 0:
            continue
        left_m = path_m[b] - path_m[a] - counted[-1]
        doubt_m = SURE_SIGMAS * float(scale_sigma[a]) * abs(counted[-1])
        by_scale = float(np.clip(left_m, -doubt_m, doubt_m)) / counted[-1] if doubt_m > 0.0 else 0.0
        steps_s = np.diff(t_s[rows])
        lost_s = np.where(stood[a:b], steps_s, 0.0) if stood[a:b].any() else steps_s
        shares = np.concatenate([[0.0], np.cumsum(lost_s)]) / lost_s.sum()
        filled[rows] = path_m[a] + (1.0 + by_scale) * counted + (left_m - by_scale * counted[-1]) * shares
    return filled


def _smooth(rate_mps: Floats) -> Floats:
    """Moving median of the known rates; at their ends of what there is."""
    known = np.flatnonzero(np.isfinite(rate_mps))
    if known.size == 0:
        return rate_mps
    smooth = rate_mps.copy()
    padded = np.pad(rate_mps[known], _CELLS // 2, constant_values=np.nan)
    smooth[known] = np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, _CELLS), axis=1)
    return smooth


def _without_spikes(place_m: Floats) -> Floats:
    """Moving median of the known places; what they do before their ends goes on beyond them."""
    known = np.flatnonzero(np.isfinite(place_m))
    if known.size < 2:
        return place_m
    calm = place_m.copy()
    padded = np.pad(place_m[known], _CELLS // 2, mode="reflect", reflect_type="odd")
    calm[known] = np.median(np.lib.stride_tricks.sliding_window_view(padded, _CELLS), axis=1)
    return calm


def _seen(x_s: Floats, edges_s: Floats, hole_s: float) -> Bools:
    centres = 0.5 * (edges_s[1:] + edges_s[:-1])
    right = np.searchsorted(x_s, centres).clip(1, x_s.size - 1)
    inside = (centres >= x_s[0]) & (centres <= x_s[-1])
    seen: Bools = inside & (x_s[right] - x_s[right - 1] <= hole_s)
    return seen


def _nearest(centres_s: Floats, rate_mps: Floats, at_s: Floats) -> Floats:
    cell = np.searchsorted(0.5 * (centres_s[1:] + centres_s[:-1]), at_s)
    return rate_mps[cell]
