"""Odometer scale and GNSS latency along a run: from the vehicle file, or learned causally and held under alarm."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise

import numpy as np

from pipeline.stages.alignment.odometer_filter import Estimates, FilterState, ScaleLatencyFilter, estimates_of, prior_of
from pipeline.stages.epochs.clock import gap_limits_s, periods_before_s
from pipeline.stages.monitors.axis import (
    BLOCK,
    FIRST_BLOCK,
    AlongEpochs,
    AxisSeries,
    AxisState,
    along_series,
    error_model,
    run_axis,
)
from pipeline.stages.monitors.noise import NoiseMeter
from pipeline.stages.odometry.bound import RecoveryRule
from pipeline.stages.odometry.driven import is_moving
from pipeline.stages.odometry.odometry import Odometry
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.frozen import frozen

Hold = tuple[int, int]
"""From the epoch of an alarm along the track to that of recovery (past the last one if there is none): nothing is
learned.
"""


@frozen
class ToLearn:
    """What is learned from, of each epoch of a solution; arrays of shape (epochs,)."""

    t_ns: Ints
    """Stamp of the epoch [ns]."""
    usable: Bools
    """There is a position on the track."""
    along_m: Floats
    """Position along the track, for increments (`AlignedEpochs.along_m`) [m]."""
    calibrated_m: Floats
    """Deviation of its errors with memory [m]."""
    digits_m: Floats
    """Deviation by the digits that it is written with [m]."""
    jitter_s: Floats
    """Deviation of the stamp about the receiver's clock [s]."""


def learn(
    positions: ToLearn,
    odometry: Odometry,
    vehicle: Vehicle,
    config: Configuration,
) -> tuple[Estimates, list[Hold]]:
    """Scale and latency at each epoch: from the vehicle file, or learned from earlier epochs only.

    Args:
        positions: what is learned from, arrays of shape (n,).
        odometry: the odometer, growing with the path of the positions.
        vehicle: scale and latency, as far as the file gives them.
        config: the configuration; used are `align`, `monitors` and `hazards.limits`.

    Returns:
        Estimates of shape (n,), and the holds: epochs of alarm and recovery.
    """
    prior = prior_of(vehicle, config.align)
    learned = prior.over(positions.t_ns.size)
    learner = _Learner(positions, odometry, vehicle, config, learned)
    learner.run(prior)
    if vehicle.odometer_scale is not None:
        learned.scale_sigma[:] = prior.scale_sigma
    if vehicle.gnss_latency_s is not None:
        learned.latency_sigma_s[:] = prior.latency_sigma_s
    return learned, learner.holds


class _Learner:
    """Runs the filter along the run, once the noise is known, and freezes it under alarm of the along-track monitors.

    A row is an epoch with a usable position and a known odometer distance; `_rows` has its place among all epochs.
    From the first failing epoch on the estimates stand still until the rule of recovery holds: a lasting fault must not
    be learned as scale, nor an offset with which the position comes back (`ScaleLatencyFilter.resume`).
    """

    def __init__(
        self,
        positions: ToLearn,
        odometry: Odometry,
        vehicle: Vehicle,
        config: Configuration,
        learned: Estimates,
    ) -> None:
        self._config = config
        self._odometry = odometry
        self._scatters = odometry.known_noise.scatters
        self._vehicle = vehicle
        self._learned = learned
        self._filter = ScaleLatencyFilter(*error_model(config.monitors), odometry, config.align)
        self._alphas = np.array(config.monitors.ewma_alphas)
        self._factor = config.monitors.threshold_factor
        self.holds: list[Hold] = []
        self._moved_m = config.hazards.limits.moved_m
        self._rule = RecoveryRule(config)
        # The filter reads the odometer up to a latency of five sigmas earlier.
        margin_ns = round(5e9 * config.align.latency_prior_sigma_s)
        t_ns = positions.t_ns
        usable = positions.usable
        t_s = odometry.seconds(t_ns)
        at = odometry.read(t_s)
        self._rows = np.flatnonzero(usable & at.known & odometry.known_at(t_ns - margin_ns) & at.noise_shown)
        self._path_m = positions.along_m[self._rows]
        self._calibrated_m = positions.calibrated_m[self._rows]
        self._digits_m = positions.digits_m[self._rows]
        self._sigma_m = np.hypot(self._calibrated_m, self._digits_m)
        self._t_ns = t_ns[self._rows]
        self._t_s = t_s[self._rows]
        self._doubt_m = odometry.cumulative_doubt_m(self._t_s)
        # Single times are looked up in a list, which is several times faster than in an array.
        self._times: list[float] = self._t_s.tolist()
        self._jitter_s = positions.jitter_s[self._rows]
        scattered_s = config.align.scattered_gap_sigmas * positions.jitter_s
        gap_s = gap_limits_s(periods_before_s(t_ns), config.align.gap_reset_s) + scattered_s
        self._breaks = _gaps_before(self._t_s, self._t_s, gap_s[self._rows])
        self._outages = _gaps_before(self._t_s, t_s[usable], gap_s[usable])
        if self._rows.size:
            travelled_m = odometry.travelled_at(self._t_ns)
            deadband_mps = config.matching.deadband_mps
            moving = is_moving(self._t_s, travelled_m, deadband_mps, config.align.speed_window_s)
            series = self._series(0, self._rows.size, 0)
            self._meter = NoiseMeter(series, moving, config.monitors.noise_along_m, config)

    def run(self, prior: Estimates) -> None:
        """Learn from the first row with known noise until an alarm, hold until recovery, learn on; fills `learned`."""
        row = self._meter.known_from() if self._rows.size else 0
        if row >= self._rows.size:
            return
        state = self._filter.start(self._to_learn(prior), *self._observation(row))
        while row < self._rows.size:
            state, alarm = self._learn_until_alarm(state, row)
            if alarm >= self._rows.size:
                break
            self._meter.freeze(alarm)
            row, unsettled_m2 = self._hold(float(estimates_of(state.joint).scale_sigma), alarm)
            epochs = np.append(self._rows, self._learned.scale.size)
            self.holds.append((int(epochs[alarm]), int(epochs[row])))
            self._meter.restart(row)
            if row < self._rows.size:
                state = self._filter.restart(state, *self._observation(row), unsettled_m2)

    def _to_learn(self, prior: Estimates) -> Estimates:
        """The prior without uncertainty in what the vehicle file gives, so that it is not learned."""
        if self._vehicle.odometer_scale is not None:
            prior = prior._replace(scale_sigma=np.zeros(()))
        if self._vehicle.gnss_latency_s is not None:
            prior = prior._replace(latency_sigma_s=np.zeros(()))
        return prior

    def _observation(self, row: int) -> tuple[float, float]:
        """Time [s] and path position [m] of a row."""
        return float(self._t_s[row]), float(self._path_m[row])

    def _learn_until_alarm(self, state: FilterState, begin: int) -> tuple[FilterState, int]:
        """The state in use at the first failing row, and this row."""
        bank: AxisState | None = None
        use_from = np.array([begin])
        joints = state.joint[None]
        row = begin
        block = FIRST_BLOCK
        while row < self._rows.size:
            end = min(row + block, self._rows.size)
            current = _in_use(use_from, row)
            state, new_from, new_joints = self._updates(state, row, end)
            use_from = np.concatenate([use_from[current:], new_from])
            joints = np.concatenate([joints[current:], new_joints])
            self._fill_estimates(np.maximum(use_from, row), joints)
            series = self._series(row, end, begin)
            value, sigma, bank = run_axis(series, self._alphas, bank, self._meter.variance_m2(row, end))
            beyond = ~(np.abs(value) <= self._factor * sigma)  # what cannot be compared is no pass
            failing = np.flatnonzero(beyond.any(axis=1) & ~series.fresh)
            if failing.size:
                alarm = row + int(failing[0])
                held = joints[_in_use(use_from, alarm)]
                self._fill_estimates(np.array([alarm]), held[None])
                # The block's last state may lie behind the alarm: what it has to settle is not carried over.
                return FilterState(held, self._times[alarm], state.origin_m), alarm
            row = end
            block = min(2 * block, BLOCK)
        return state, row

    def _updates(self, state: FilterState, begin: int, end: int) -> tuple[FilterState, Ints, Floats]:
        """The filter over rows [begin, end): its last state, first use of each joint state, joint states."""
        due = self._update_rows(state.t_s, begin, end)
        before = np.concatenate([[self._next(state.t_s, 0)], due])[:-1]
        broken = (self._doubt_m[before] != self._doubt_m[due]) | (self._breaks[before] != self._breaks[due])
        joints = np.empty((due.size, *state.joint.shape))
        for first, last in pairwise((0, *np.flatnonzero(broken).tolist(), due.size)):
            if first == last:
                continue
            if broken[first]:
                state = self._beyond_break(state, int(before[first]), int(due[first]))
            part = due[first:last]
            observed = self._t_s[part], self._path_m[part], self._sigma_m[part]
            joints[first:last] = self._filter.run(state, *observed, self._jitter_s[part])
            state = self._filter.state_after(state, joints[last - 1], float(self._t_s[part[-1]]))
        # An update reads the odometer up to `latency_span_s` after its epoch: causal is its use from then on.
        use_from = np.searchsorted(self._t_s, self._t_s[due] + self._config.align.latency_span_s)
        return state, np.maximum(use_from, due + 1), joints

    def _beyond_break(self, state: FilterState, before: int, row: int) -> FilterState:
        """Begin the offset anew where the odometer lost its distance: nothing shows whether the position moved."""
        if self._doubt_m[before] == self._doubt_m[row]:
            observed = *self._observation(row), float(self._sigma_m[row]), float(self._jitter_s[row])
            return self._filter.resume(state, *observed, self._moved_m)
        away = self._outages[before] != self._outages[row]
        return self._filter.restart(state, *self._observation(row), self._moved_m**2 if away else 0.0)

    def _update_rows(self, last_s: float, begin: int, end: int) -> Ints:
        """Rows of [begin, end) at which the filter is updated: a filter period apart, the first after `last_s` [s]."""
        period_s = self._config.align.filter_period_s * (1.0 - 1e-6)
        due: list[int] = []
        row = self._next(last_s + period_s, begin)
        while row < end:
            due.append(row)
            row = self._next(self._times[row] + period_s, row + 1)
        return np.array(due, dtype=np.int64)

    def _fill_estimates(self, use_from: Ints, joints: Floats) -> None:
        """Enter the estimates of these joint states into the result, each from the row `use_from` on."""
        epochs = np.append(self._rows, self._learned.scale.size)  # a row past the last is past all epochs
        self._learned.fill(epochs[use_from], estimates_of(joints))

    def _next(self, t_s: float, at_least: int) -> int:
        """The first row from `at_least` on that is not before a time."""
        return max(at_least, bisect_left(self._times, t_s))

    def _series(self, begin: int, end: int, restart: int) -> AxisSeries:
        """Increments of rows [begin, end); the one at `restart` has none before it."""
        part = slice(max(begin - 1, restart), end)
        in_use = self._learned.at(self._rows[part])
        read = self._odometry.read(self._t_s[part] - in_use.latency_s)
        epochs = AlongEpochs(
            epoch=self._rows[part],
            t_s=self._t_s[part],
            along_m=self._path_m[part],
            doubt_m=read.doubt_m,
            sigma_m=self._calibrated_m[part],
            digits_m=self._digits_m[part],
            jitter_s=self._jitter_s[part],
            scale_sigma=in_use.scale_sigma,
            latency_sigma_s=in_use.latency_sigma_s,
            white_m2_per_s=read.white_m2_per_s,
            rows_m=np.minimum(read.row_sigma_m, self._config.scatter_limit_m) if self._scatters else None,
            period_s=read.period_s,
        )
        odometer = self._odometry.increments(self._t_ns[part], in_use.scale, in_use.latency_s, read)
        return along_series(epochs, odometer, self._config).rows_between(begin - part.start, end - part.start)

    def _hold(self, scale_sigma: float, alarm: int) -> tuple[int, float]:
        """Row from which learning goes on after the alarm, and what the offset has still to settle by [m^2].

        That is where GNSS minus odometer is back within the recovery bound, `recovery_s` after the last failure; else
        the number of rows.
        """
        begin = row = alarm - 1  # the first row of all cannot fail
        bank: AxisState | None = None
        away_m = np.zeros(1)
        failed_s = np.full(1, -np.inf)
        block = FIRST_BLOCK
        while row < self._rows.size:
            end = min(row + block, self._rows.size)
            t_s = self._t_s[row:end]
            series = self._series(row, end, begin)
            noise_m2 = self._meter.variance_m2(row, end)[:, :2]
            value, sigma, bank = run_axis(series, self._alphas[:1], bank, noise_m2)
            failing = ~(np.abs(value) <= self._factor * sigma).all(axis=1)
            failing |= np.arange(row, end) <= begin + 1
            failed_s = np.maximum.accumulate(np.where(failing, t_s, failed_s[-1]))
            away_m = away_m[-1] + np.cumsum(series.rate_mps * series.dt_s)
            variance_m2 = self._drift_m2(begin, row, end, scale_sigma)
            near = np.abs(away_m) <= self._rule.bound_m(variance_m2)
            back = np.flatnonzero(near & self._rule.recovery_is_over(t_s - failed_s))
            if back.size:
                first = int(back[0])
                return row + first, float(away_m[first] ** 2 + variance_m2[first])
            row = end
            block = min(2 * block, BLOCK)
        return self._rows.size, 0.0

    def _drift_m2(self, anchor: int, begin: int, end: int, scale_sigma: float) -> Floats:
        """What GNSS minus odometer moves by from the anchor to rows [begin, end) without a fault [m^2]."""
        sigma_m = self._sigma_m
        t_ns = self._t_ns
        driven_m = np.diff(self._odometry.travelled_at(np.append(t_ns[anchor], t_ns[begin:end])))
        positions_m2 = sigma_m[anchor] ** 2 + sigma_m[begin:end] ** 2
        elapsed_s = self._t_s[begin:end] - self._t_s[anchor]
        sigma_scale = self._vehicle.odometer_scale_sigma or 0.0
        return self._rule.variance_m2(positions_m2, elapsed_s, np.cumsum(driven_m), max(scale_sigma, sigma_scale))


def _gaps_before(at_s: Floats, t_s: Floats, gap_s: Floats) -> Ints:
    """How many gaps in the times `t_s` have ended at each of `at_s`; `gap_s`: the longest step to each that is none."""
    ends = t_s[1:][np.diff(t_s) > gap_s[1:]]
    return np.searchsorted(ends, at_s, side="right")


def _in_use(use_from: Ints, row: int) -> int:
    """Which of the states is in use at a row: the last one whose use has begun."""
    return int(np.searchsorted(use_from, row, side="right")) - 1
