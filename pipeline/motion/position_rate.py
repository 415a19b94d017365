"""How fast the positions of one solution moved on along the path, whatever they leaped in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.columns import NS_PER_S, Bools, Floats, flags, floats, times_ns

_CELL_S = 1.0
# Cells of the moving median: a leap is in one of them, so it does not count; a train is no faster for five seconds.
_CELLS = 11
# Positions farther apart tell where the train came to, not how.
HOLE_S = 3.0


@dataclass(frozen=True)
class PositionRate:
    """Speed along growing path [m/s] by cells of time, NaN before the first position and after the last.

    `edges_s`: borders of the cells since the first epoch; `seen`: cells in which there are positions. `at_mps`,
    `step_mps`: the same at each epoch, and from it to the next.
    """

    edges_s: Floats
    rate_mps: Floats
    seen: Bools
    at_mps: Floats
    step_mps: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame) -> PositionRate:
        """`epochs`: `t, path_m, fix_valid, on_track`, at least two of them."""
        t_ns = times_ns(epochs)
        t_s = (t_ns - t_ns[0]) / NS_PER_S
        path_m = floats(epochs, "path_m")
        known = flags(epochs, "fix_valid") & flags(epochs, "on_track") & np.isfinite(path_m)
        cell_s = max(_CELL_S, float(np.median(np.diff(t_s))))
        edges = np.append(np.arange(0.0, t_s[-1], cell_s), t_s[-1])
        rate = np.full(edges.size - 1, np.nan)
        seen = np.zeros(edges.size - 1, dtype=np.bool_)
        if known.sum() > 1:
            x_s, x_m = t_s[known], path_m[known]
            rate = _smooth(np.diff(np.interp(edges, x_s, x_m, left=np.nan, right=np.nan)) / np.diff(edges))
            seen = _seen(x_s, edges, max(HOLE_S, 1.5 * cell_s))
        centres = 0.5 * (edges[1:] + edges[:-1])
        steps_s = 0.5 * (t_s + np.append(t_s[1:], t_s[-1]))
        at, step = (_nearest(centres, rate, times) for times in (t_s, steps_s))
        return cls(edges, rate, seen, at, step)


def _smooth(rate_mps: Floats) -> Floats:
    """Moving median of the known rates; at their ends of what there is."""
    known = np.flatnonzero(np.isfinite(rate_mps))
    if known.size == 0:
        return rate_mps
    smooth = rate_mps.copy()
    padded = np.pad(rate_mps[known], _CELLS // 2, constant_values=np.nan)
    smooth[known] = np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, _CELLS), axis=1)
    return smooth


def _seen(x_s: Floats, edges_s: Floats, hole_s: float) -> Bools:
    centres = 0.5 * (edges_s[1:] + edges_s[:-1])
    right = np.searchsorted(x_s, centres).clip(1, x_s.size - 1)
    inside = (centres >= x_s[0]) & (centres <= x_s[-1])
    seen: Bools = inside & (x_s[right] - x_s[right - 1] <= hole_s)
    return seen


def _nearest(centres_s: Floats, rate_mps: Floats, at_s: Floats) -> Floats:
    cell = np.searchsorted(0.5 * (centres_s[1:] + centres_s[:-1]), at_s)
    return rate_mps[cell]
