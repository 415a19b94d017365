"""The way from each row of an odometer to the next: by its distance where that says it, else by its speeds.

Rows may hold the one or the other by turns. Between rows far apart distances lie on curves that a train can drive.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.stages.odometry.odd_steps import OddRun, driven_within_m, odd_runs
from schemas.arrays import Bools, Floats, Ints
from schemas.config import AlignConfig

# G holds for an emergency brake right after as hard acceleration: a Gaussian error comes as far in 3 of 1000 cases.
_BOUND_SIGMAS = 3.0


class Ways(NamedTuple):
    """Per step: way [m], NaN where not known; whether it is of the recorded distance; sigma over a bridged reset [m].

    `odd`: where the count may be off; `driven_m`: by the speeds, NaN where not recorded; `resets`: the rows to which it
    was set.
    """

    way_m: Floats
    counted: Bools
    bridged_m: Floats
    odd: Bools
    driven_m: Floats
    resets: tuple[int, ...] = ()


def ways_between(
    t_s: Floats, distance_m: Floats, speed_mps: Floats, counts_m: Floats, limit_s: Floats, config: AlignConfig
) -> Ways:
    """Ways between rows at these times [s]; `distance_m` and `speed_mps` as recorded, NaN where not.

    `counts_m`: the step of the counter as known at each row. Over a leap of the distance the speeds count, if they
    agreed with the distance before. By turns, nothing is interpolated over more than `limit_s`, of each step.
    """
    runs = odd_runs(t_s, distance_m, counts_m, config)
    resets = [run for run in runs.odd if not run.kept]
    distance_m = _interpolated(t_s, distance_m, [run for run in runs.odd if run.kept])
    leap = np.zeros(t_s.size - 1, dtype=np.bool_)
    for run in resets:
        distance_m[run.first + 1 : run.last] = np.nan
        leap[run.first : run.last] = True
    recorded = np.where(leap, np.nan, np.diff(distance_m))
    by_speeds = _driven(t_s, speed_mps)
    driven = _trusted(by_speeds, recorded, leap, config)
    way_m = np.where(np.isnan(recorded), driven, recorded)
    unknown = np.isnan(way_m)
    places = tuple(run.last for run in resets)
    odd = np.zeros_like(leap)
    for run in (*runs.odd, *runs.near):
        odd[run.first : run.last] = True
    if not unknown.any():
        return Ways(way_m, ~np.isnan(recorded), np.zeros(way_m.size), odd, by_speeds, places)
    # Rows by turns: fill the gaps of either column between its own rows, then decide again.
    carried_m = _carried(t_s, distance_m, limit_s)
    recorded = np.where(unknown & ~leap, np.diff(carried_m), recorded)
    driven = _trusted(_driven(t_s, _carried(t_s, speed_mps, limit_s)), recorded, leap, config)
    counted = ~np.isnan(recorded)
    way_m = np.where(counted, recorded, driven)
    bridged_m = np.zeros(way_m.size)
    for run in resets:
        _bridge(run, t_s, way_m, bridged_m, config)
    return Ways(way_m, counted, bridged_m, odd, by_speeds, places)


def _bridge(run: OddRun, t_s: Floats, way_m: Floats, sigma_m: Floats, config: AlignConfig) -> None:
    """Sets the way over a reset by the mean speed about it, and its sigma.

    Where speeds at the two rows could be off by more than `reset_doubt_m` (b T^2 / 4), the distance is lost.
    """
    part = slice(run.first, run.last)
    time_s = float(t_s[run.last] - t_s[run.first])
    short = 0.25 * config.braking_mps2 * time_s**2 <= config.reset_doubt_m
    if short and np.isfinite(run.mean_mps) and np.isnan(way_m[part]).any():
        dt_s = np.diff(t_s[run.first : run.last + 1])
        way_m[part] = run.mean_mps * dt_s
        sigma_m[part] = driven_within_m(time_s, config) / _BOUND_SIGMAS * np.sqrt(dt_s / time_s)


def _interpolated(t_s: Floats, distance_m: Floats, wrong: list[OddRun]) -> Floats:
    """The distance with straight lines over runs of wrong rows."""
    distance_m = distance_m.copy()
    for run in wrong:
        ends = [run.first, run.last]
        inside = slice(run.first + 1, run.last)
        known = np.isfinite(distance_m[inside])
        line_m = np.interp(t_s[inside], t_s[ends], distance_m[ends])
        distance_m[inside] = np.where(known, line_m, np.nan)
    return distance_m


def _trusted(driven_m: Floats, recorded_m: Floats, leap: Bools, config: AlignConfig) -> Floats:
    """None over leaps if speeds and counter disagreed before (a wrong unit, sign or sensor)."""
    if not leap.any():
        return driven_m
    both = np.isfinite(recorded_m) & np.isfinite(driven_m)
    recorded_sum_m, driven_sum_m, way_m = (
        np.cumsum(np.where(both, values, 0.0)) for values in (recorded_m, driven_m, np.abs(recorded_m))
    )
    # The steps of a leap add nothing to these sums: they are those of the time before.
    disagreed = np.abs(recorded_sum_m - driven_sum_m) > config.speed_agreement * way_m
    return np.where(leap & disagreed, np.nan, driven_m)


def _driven(t_s: Floats, speed_mps: Floats) -> Floats:
    """By trapezoids [m]."""
    steps: Floats = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s)
    return steps


def _carried(t_s: Floats, values: Floats, limit_s: Floats) -> Floats:
    """Interpolated between known rows no farther apart than the limit known before the later one; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return values
    after = np.searchsorted(known, np.arange(values.size)).clip(1, known.size - 1)
    near = t_s[known[after]] - t_s[known[after - 1]] <= limit_s[known[after] - 1]
    inside = (t_s >= t_s[known[0]]) & (t_s <= t_s[known[-1]])
    return np.where(
        np.isfinite(values), values, np.where(near & inside, np.interp(t_s, t_s[known], values[known]), np.nan)
    )


def filled_in(
    t_s: Floats, distance_m: Floats, speed_mps: Floats, rows: Ints, config: AlignConfig
) -> tuple[Floats, Floats, Ints]:
    """Samples with finer ones between the given rows and the next, on cubic curves: times, distances, row of each.

    Slopes at the rows are the speeds where these agree with the way between, else of a monotone curve (PCHIP), and at
    most three times the mean slope, so that the cubic does not turn back (Fritsch and Carlson).
    """
    from scipy.interpolate import PchipInterpolator  # hardly a log needs it, and it takes long to load

    smooth = PchipInterpolator(t_s, distance_m).derivative()(t_s)
    slopes = np.where(np.isfinite(speed_mps), speed_mps, smooth)
    span = t_s[rows + 1] - t_s[rows]
    way = distance_m[rows + 1] - distance_m[rows]
    # With acceleration and braking up to b, mean speed x dt differs from the way by at most b dt^2 / 4.
    true = np.abs(0.5 * (slopes[rows] + slopes[rows + 1]) * span - way) <= 0.25 * config.braking_mps2 * span**2
    low = np.minimum(0.0, 3.0 * way)
    high = np.maximum(0.0, 3.0 * way)
    start, end = (np.clip(np.where(true, slopes[at], smooth[at]) * span, low, high) for at in (rows, rows + 1))
    # Three points in each `straight_s`: the error of a straight line falls with the square of its length, to a ninth.
    fine = np.ceil(3.0 * span / config.straight_s).astype(np.int64)
    which = np.repeat(np.arange(rows.size), fine - 1)
    part = np.concatenate([np.arange(1, count) / count for count in fine.tolist()])
    rest = 1.0 - part
    # Cubic Hermite polynomial.
    curve = part**2 * (3.0 - 2.0 * part) * way[which] + part * rest * (rest * start[which] - part * end[which])
    at_s = np.concatenate([t_s, t_s[rows][which] + part * span[which]])
    order = np.argsort(at_s, kind="stable")
    source = np.concatenate([np.arange(t_s.size), rows[which]])[order]
    return at_s[order], np.concatenate([distance_m, distance_m[rows][which] + curve])[order], source
