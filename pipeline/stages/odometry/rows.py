"""Where the figures of an odometer come from, as declared (DOMAIN section 5.0)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.odometry.bound import OddRun, driven_within_m, odd_runs
from schemas.arrays import Bools, Floats, Ints, floats, spans_of, truths
from schemas.config import AlignConfig, Vehicle
from schemas.enums import Origin

_WORST_LAST = (Origin.WHEEL, Origin.RADAR, Origin.INERTIAL, Origin.UNKNOWN, Origin.FUSED, Origin.GNSS)


def declared_origin(stream: pl.DataFrame, vehicle: Vehicle) -> Origin:
    """Origin that the rows of one sensor state, or the vehicle file for rows that state none.

    Of rows that say different things the origin that proves least: GNSS before a filter before unknown.
    """
    declared = stream["origin"].unique().cast(pl.String).to_list() if "origin" in stream.columns else [None]
    unsaid = vehicle.odometer_origin or Origin.UNKNOWN
    origins = {unsaid if name in (None, Origin.UNKNOWN.value) else Origin(name) for name in declared}
    return max(origins, key=_WORST_LAST.index, default=unsaid)


# Numerics: how far a change may be from a multiple of the step, in steps, since written numbers are rounded.
_TOLERANCE = 0.02
# Fewer changes of the change are chance.
FEWEST_BENDS = 8


def step_of(changes: Floats, single: Floats, least: float, rounded: float) -> float:
    """The step that all these changes are multiples of, in their unit; 0 where there is none of at least `least`.

    `single`: differences of which some are of one step; up to `rounded` is none, as decimal numbers are not whole in
    binary. A change that is always the same shows no step.
    """
    single = np.abs(single)
    single = single[single > rounded]
    if not single.size or (step := float(single.min())) < least:
        return 0.0
    steps, multiples = multiples_of(changes, step)
    return step if multiples.all() and np.count_nonzero(np.diff(steps)) >= FEWEST_BENDS else 0.0


def multiples_of(changes: Floats, step: float) -> tuple[Floats, Bools]:
    """How many steps each change is, and whether it is a whole number of them."""
    counts = changes / step
    steps = np.rint(counts)
    whole: Bools = np.abs(counts - steps) < _TOLERANCE
    return steps, whole


# Less is rounding of decimal numbers, which are not whole in binary; far below any `counter_step_m`.
_ROUNDED_M = 1e-3
# Numerics: steps before each that show what is usual, and that are looked at first.
_USUAL_ROWS, _NEAR_ROWS = 100, 200


class CountStep(NamedTuple):
    """The step of the counter as known at each row [m], 0 where none is; `shown`: a step would have shown by then.

    Of a counter that stands, or moves on evenly, nothing is to be seen, and nothing scatters.
    """

    step_m: Floats
    shown: Bools


def count_step(distance_m: Floats, config: AlignConfig) -> CountStep:
    """Rows without a distance (NaN) know what the last one did.

    All usual steps so far are multiples of the step, one is a single step; 0 where there is none, or one finer than
    `counter_step_m`. Steps that no train drives do not count: next to those before them they are leaps.
    """
    rows = np.flatnonzero(np.isfinite(distance_m))
    known = CountStep(np.zeros(distance_m.size), np.ones(distance_m.size, dtype=np.bool_))
    if rows.size < 2:
        return known
    moves_m = np.abs(np.diff(distance_m[rows]))
    usual = np.flatnonzero(_usual(moves_m, config))
    last = np.searchsorted(rows[usual + 1], np.arange(distance_m.size), side="right") - 1
    after = last >= 0
    known.step_m[after] = _steps_known_m(moves_m[usual], config.counter_step_m)[last[after]]
    known.shown[after] = _shown(moves_m[usual])[last[after]]
    return known


def _shown(moves_m: Floats) -> Bools:
    """Movements differ from those before as often as makes a step, or never; or so many equal ones in motion."""
    written = np.rint(moves_m / _ROUNDED_M)
    bent = np.concatenate([[False], np.diff(written) != 0.0])
    bends = np.cumsum(bent)
    # Rows since the last bend: the row less the greatest row of a bend up to it.
    since_bend = np.arange(written.size) - np.maximum.accumulate(np.where(bent, np.arange(written.size), 0))
    even = np.logical_or.accumulate((since_bend >= FEWEST_BENDS) & (written > 0.0))
    shown: Bools = (bends == 0) | (bends >= FEWEST_BENDS) | even
    return shown


def _usual(moves_m: Floats, config: AlignConfig) -> Bools:
    """Movements no longer than twice the median of those before, and a margin for bunched stamps."""
    medians_m = pl.Series(moves_m).rolling_median(_USUAL_ROWS, min_samples=1).to_numpy()
    usual: Bools = moves_m <= config.bunched_stamps_m + 2.0 * np.concatenate([[0.0], medians_m[:-1]])
    return usual


def _steps_known_m(moves_m: Floats, least_m: float) -> Floats:
    """The step of which all movements up to each are multiples [m]; 0 where there is none."""
    single_m = np.minimum.accumulate(np.where(moves_m > _ROUNDED_M, moves_m, np.inf))
    begins = np.flatnonzero(single_m < np.concatenate([[np.inf], single_m[:-1]]))
    steps_m = np.zeros(moves_m.size)
    ends = np.append(begins[1:], moves_m.size)
    for begin, end in zip(begins.tolist(), ends[: begins.size].tolist(), strict=True):
        step_m = float(single_m[begin])
        if step_m < least_m:
            break
        # The last ones first: where the smallest movement shrinks row by row, all of them would be looked at each time.
        if multiples_of(moves_m[max(begin - _NEAR_ROWS, 0) : begin + 1], step_m)[1].all():
            steps_m[begin:end] = np.where(_is_step(moves_m[:end], step_m)[begin:], step_m, 0.0)
    return steps_m


def _is_step(moves_m: Floats, step_m: float) -> Bools:
    """Whether all movements up to each are multiples, of which enough differ from the one before."""
    counts, multiples = multiples_of(moves_m, step_m)
    bends = np.concatenate([[0], np.cumsum(np.diff(counts) != 0.0)])
    shown: Bools = np.logical_and.accumulate(multiples) & (bends >= FEWEST_BENDS)
    return shown


class Contradiction(NamedTuple):
    """Per step: in a run that the speeds contradict; by how much [m]; what of that is known by then, all at once."""

    steps: Bools
    off_m: Floats
    doubt_m: Floats


def contradicted_by_speeds(
    t_s: Floats, recorded_m: Floats, driven_m: Floats, rows_m: Floats, deadband_mps: float, config: AlignConfig
) -> Contradiction:
    """Runs of rows over which speeds (`driven_m`) and distance (`recorded_m`, per step) part by more than a leap.

    `rows_m`: what the noise of two rows makes of a distance, as known at each. A second before each row counts: more
    than `speed_agreement` of the distance, the dead band and that. A run counts where it sums up to `leap_m` beyond the
    same. Speeds that never agreed with the distance contradict nothing.
    """
    both = np.isfinite(recorded_m) & np.isfinite(driven_m)
    found = Contradiction(np.zeros(both.size, dtype=np.bool_), *np.zeros((2, both.size)))
    if not both.any():
        return found
    recorded_sum_m, driven_sum_m, moved_m = (
        np.concatenate([[0.0], np.cumsum(np.where(both, values, 0.0))])
        for values in (recorded_m, driven_m, np.maximum(np.abs(recorded_m), np.abs(driven_m)))
    )
    share = config.speed_agreement
    agreed = (moved_m >= config.leap_m / share) & (np.abs(driven_sum_m - recorded_sum_m) <= share * moved_m)
    before = np.searchsorted(t_s, t_s - config.speed_window_s * (1.0 + 1e-9))
    apart_m = np.abs((driven_sum_m - recorded_sum_m) - (driven_sum_m - recorded_sum_m)[before])
    allowed_m = share * (moved_m - moved_m[before]) + deadband_mps * (t_s - t_s[before]) + rows_m
    parts = (apart_m > allowed_m) & np.concatenate([[False], both])
    for first, last in spans_of(parts):
        run = slice(int(before[first]), last)
        if not agreed[run.start]:
            continue
        so_far_m = np.abs(np.cumsum(np.where(both, driven_m - recorded_m, 0.0)[run]))
        allowed_so_far_m = config.leap_m + rows_m[run] + share * np.cumsum(np.diff(moved_m[run.start : last + 1]))
        beyond = np.flatnonzero(so_far_m > allowed_so_far_m)
        if beyond.size:
            found.steps[run] = True
            found.off_m[run] = np.abs(np.diff(np.concatenate([[0.0], so_far_m])))
            # Known at the row where it is too much: from there on each step as it comes.
            at = run.start + int(beyond[0])
            found.doubt_m[at] = so_far_m[beyond[0]]
            found.doubt_m[at + 1 : last] = found.off_m[at + 1 : last]
    return found


# G holds for an emergency brake right after as hard acceleration: a Gaussian error comes as far in 3 of 1000 cases.
_BOUND_SIGMAS = 3.0


class StepDistances(NamedTuple):
    """Per step: distance [m], NaN where not known; whether it is of the recorded distance; sigma over a bridged reset
    [m].

    `odd`: where the count may be off; `driven_m`: by the speeds, NaN where not recorded; `resets`: the rows to which it
    was set.
    """

    moved_m: Floats
    counted: Bools
    bridged_m: Floats
    odd: Bools
    driven_m: Floats
    resets: tuple[int, ...] = ()


def step_distances(
    t_s: Floats, distance_m: Floats, speed_mps: Floats, counts_m: Floats, limit_s: Floats, config: AlignConfig
) -> StepDistances:
    """Distances between rows at these times [s]; `distance_m` and `speed_mps` as recorded, NaN where not.

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
    moved_m = np.where(np.isnan(recorded), driven, recorded)
    unknown = np.isnan(moved_m)
    places = tuple(run.last for run in resets)
    odd = np.zeros_like(leap)
    for run in (*runs.odd, *runs.near):
        odd[run.first : run.last] = True
    if not unknown.any():
        return StepDistances(moved_m, ~np.isnan(recorded), np.zeros(moved_m.size), odd, by_speeds, places)
    # Rows by turns: fill the gaps of either column between its own rows, then decide again.
    carried_m = _carried(t_s, distance_m, limit_s)
    recorded = np.where(unknown & ~leap, np.diff(carried_m), recorded)
    driven = _trusted(_driven(t_s, _carried(t_s, speed_mps, limit_s)), recorded, leap, config)
    counted = ~np.isnan(recorded)
    moved_m = np.where(counted, recorded, driven)
    bridged_m = np.zeros(moved_m.size)
    for run in resets:
        _bridge(run, t_s, moved_m, bridged_m, config)
    return StepDistances(moved_m, counted, bridged_m, odd, by_speeds, places)


def _bridge(run: OddRun, t_s: Floats, moved_m: Floats, sigma_m: Floats, config: AlignConfig) -> None:
    """Sets the distance over a reset by the mean speed about it, and its sigma.

    Where speeds at the two rows could be off by more than `reset_doubt_m` (b T^2 / 4), the distance is lost.
    """
    part = slice(run.first, run.last)
    time_s = float(t_s[run.last] - t_s[run.first])
    short = 0.25 * config.braking_mps2 * time_s**2 <= config.reset_doubt_m
    if short and np.isfinite(run.mean_mps) and np.isnan(moved_m[part]).any():
        dt_s = np.diff(t_s[run.first : run.last + 1])
        moved_m[part] = run.mean_mps * dt_s
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
    recorded_sum_m, driven_sum_m, moved_m = (
        np.cumsum(np.where(both, values, 0.0)) for values in (recorded_m, driven_m, np.abs(recorded_m))
    )
    # The steps of a leap add nothing to these sums: they are those of the time before.
    disagreed = np.abs(recorded_sum_m - driven_sum_m) > config.speed_agreement * moved_m
    return np.where(leap & disagreed, np.nan, driven_m)


def _driven(t_s: Floats, speed_mps: Floats) -> Floats:
    """Distance by trapezoids of the speeds [m]."""
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

    Slopes at the rows are the speeds where these agree with the distance between, else of a monotone curve (PCHIP), and
    at most three times the mean slope, so that the cubic does not turn back (Fritsch and Carlson).
    """
    from scipy.interpolate import PchipInterpolator  # hardly a log needs it, and it takes long to load

    smooth = PchipInterpolator(t_s, distance_m).derivative()(t_s)
    slopes = np.where(np.isfinite(speed_mps), speed_mps, smooth)
    span = t_s[rows + 1] - t_s[rows]
    moved_m = distance_m[rows + 1] - distance_m[rows]
    # With acceleration and braking up to b, mean speed x dt differs from the distance by at most b dt^2 / 4.
    true = np.abs(0.5 * (slopes[rows] + slopes[rows + 1]) * span - moved_m) <= 0.25 * config.braking_mps2 * span**2
    low = np.minimum(0.0, 3.0 * moved_m)
    high = np.maximum(0.0, 3.0 * moved_m)
    start, end = (np.clip(np.where(true, slopes[at], smooth[at]) * span, low, high) for at in (rows, rows + 1))
    # Three points in each `straight_s`: the error of a straight line falls with the square of its length, to a ninth.
    fine = np.ceil(3.0 * span / config.straight_s).astype(np.int64)
    which = np.repeat(np.arange(rows.size), fine - 1)
    part = np.concatenate([np.arange(1, count) / count for count in fine.tolist()])
    rest = 1.0 - part
    # Cubic Hermite polynomial.
    curve = part**2 * (3.0 - 2.0 * part) * moved_m[which] + part * rest * (rest * start[which] - part * end[which])
    at_s = np.concatenate([t_s, t_s[rows][which] + part * span[which]])
    order = np.argsort(at_s, kind="stable")
    source = np.concatenate([np.arange(t_s.size), rows[which]])[order]
    return at_s[order], np.concatenate([distance_m, distance_m[rows][which] + curve])[order], source


def slips_of(stream: pl.DataFrame, config: AlignConfig) -> Bools:
    """Whether a row is slip, by its flag or by a sigma of the speed beyond any use."""
    declared = stream["sigma_speed_mps"]
    slips = truths(stream["slip"])
    if declared.null_count() < declared.len():
        slips |= floats(stream, "sigma_speed_mps") > config.slip_sigma_mps
    return slips


# Numerics: of so many rows the declared sigma is usual.
_DECLARED_ROWS = 100


def declared_mps(stream: pl.DataFrame) -> Floats:
    """The usual sigma of the speed as declared up to each row [m/s]; NaN where none is."""
    declared = stream["sigma_speed_mps"].cast(pl.Float64)
    if declared.null_count() == declared.len():
        return np.full(declared.len(), np.nan)
    return declared.rolling_median(_DECLARED_ROWS, min_samples=1).to_numpy()
