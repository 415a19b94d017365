"""Odometer scale and GNSS latency along a run: from the vehicle file, or learned causally and held under alarm."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise

import numpy as np

from pipeline.alignment.increments import EpochArrays, Learned, along_series, odometer_steps
from pipeline.alignment.odometer_filter import (
    SPEED_SPAN_S,
    Estimate,
    FilterState,
    ScaleLatencyFilter,
    error_model,
    estimates_of,
    prior_of,
)
from pipeline.epochs.timeline import gap_limit_s
from pipeline.figures.bounds import threshold_factor
from pipeline.monitors.axis import AxisSeries, run_axis
from pipeline.monitors.recursion import AxisState
from pipeline.odometry.odometer import OdometerTrack
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, Vehicle

# Positions learned at once: few after a restart, for what lies behind an alarm is learned in vain; then more.
_FIRST_BLOCK, _BLOCK = 2048, 8192
# Stamps that scatter make no gap by themselves: the first position after one that they made is always late.
_SCATTERED = 3.0


def learn(arrays: EpochArrays, track: OdometerTrack, vehicle: Vehicle, config: Configuration) -> Learned:
    """Scale and latency at each epoch: from the vehicle file, or learned from earlier epochs only."""
    prior = prior_of(vehicle, config.align)
    learned = Learned.constant(prior, arrays.t_s.size)
    if vehicle.odometer_scale is not None and vehicle.gnss_latency_s is not None:
        return learned
    _Learner(arrays, track, vehicle, config, learned).run(prior)
    if vehicle.odometer_scale is not None:
        learned.scale_sigma[:] = prior.scale_sigma
    if vehicle.gnss_latency_s is not None:
        learned.latency_sigma_s[:] = prior.latency_sigma_s
    return learned


class _Learner:
    """Runs the filter along the run and freezes it under alarm of the along-track monitors.

    Estimates in use at an epoch come from epochs before it. From the first failing epoch on they stand still until
    the raw and fastest monitors have been quiet for `recovery_s` and GNSS minus odometer is back where it was
    before the alarm (DOMAIN section 3 and 4); a fault that persists is never learned as scale. Nor is an offset that
    a position brings back from a break or an alarm, or its decay: see `ScaleLatencyFilter.resume`.
    """

    def __init__(
        self, arrays: EpochArrays, track: OdometerTrack, vehicle: Vehicle, config: Configuration, learned: Learned
    ) -> None:
        self._config = config
        self._track = track
        self._learned = learned
        self._arrays = arrays
        shares, taus_s = error_model(config.monitors)
        self._filter = ScaleLatencyFilter(shares, taus_s, track)
        self._alphas = np.array(config.monitors.ewma_alphas)
        self._factor = threshold_factor(config.monitors.false_alarm_probability)
        margin_s = 5.0 * config.align.latency_prior_sigma_s
        known = track.known_at(arrays.t_s) & track.known_at(arrays.t_s - margin_s)
        self._rows = np.flatnonzero(arrays.usable & known)
        self._t_s, self._path_m, self._sigma_m = (
            values[self._rows] for values in (arrays.t_s, arrays.path_m, arrays.sigma_m)
        )
        self._stretch = track.stretch_at(self._t_s)
        # Single times are looked up in a list, which is several times faster than in an array.
        self._times: list[float] = self._t_s.tolist()
        self._limit_m = config.hazards.failure_limit_m
        period_s = float(np.median(np.diff(arrays.t_s)))
        gap_s = gap_limit_s(period_s, config.align.gap_reset_s) + _SCATTERED * arrays.jitter_s
        self._breaks = _gaps_before(self._t_s, self._t_s, gap_s)
        self._outages = _gaps_before(self._t_s, arrays.t_s[arrays.usable], gap_s)
        self._scale_known = vehicle.odometer_scale is not None
        self._latency_known = vehicle.gnss_latency_s is not None

    def run(self, prior: Estimate) -> None:
        if self._rows.size == 0:
            return
        prior = Estimate(
            prior.scale,
            0.0 if self._scale_known else prior.scale_sigma,
            prior.latency_s,
            0.0 if self._latency_known else prior.latency_sigma_s,
        )
        state, position = self._filter.start(prior, *self._observation(0)), 0
        while position < self._rows.size:
            state, alarm = self._learn_until_alarm(state, position)
            if alarm >= self._rows.size:
                break
            position, unsettled_m2 = self._hold(state.estimate(), alarm)
            if position < self._rows.size:
                state = self._filter.restart(state, *self._observation(position), unsettled_m2)

    def _observation(self, position: int) -> tuple[float, float]:
        """Time [s] and GNSS path position [m] at a position."""
        return float(self._t_s[position]), float(self._path_m[position])

    def _learn_until_alarm(self, state: FilterState, begin: int) -> tuple[FilterState, int]:
        """Learn block by block; returns the state in use at the first failing epoch, and its position."""
        bank: AxisState | None = None
        use_from, joints = np.array([begin]), state.joint[None]
        position, block = begin, _FIRST_BLOCK
        while position < self._rows.size:
            end = min(position + block, self._rows.size)
            current = _in_use(use_from, position)
            state, new_from, new_joints = self._updates(state, position, end)
            use_from = np.concatenate([use_from[current:], new_from])
            joints = np.concatenate([joints[current:], new_joints])
            self._put(np.maximum(use_from, position), joints)
            series = self._series(position, end, begin)
            result, bank = run_axis(series, self._alphas, bank)
            beyond = ~(np.abs(result.value) <= self._factor * result.sigma)  # what cannot be compared is no pass
            failing = np.flatnonzero(beyond.any(axis=1) & ~series.fresh)
            if failing.size:
                alarm = position + int(failing[0])
                held = joints[_in_use(use_from, alarm)]
                self._put(np.array([alarm]), held[None])
                # Of what the block's last state has still to settle the alarm knows nothing: it may lie behind it.
                return FilterState(held, self._times[alarm], state.origin_m), alarm
            position, block = end, min(2 * block, _BLOCK)
        return state, position

    def _updates(self, state: FilterState, begin: int, end: int) -> tuple[FilterState, Ints, Floats]:
        """The filter's last state in these positions; from where each of its states may be used; the joint states."""
        due = self._due(state.t_s, begin, end)
        before = np.concatenate([[self._next(state.t_s, 0)], due])[:-1]
        broken = (self._stretch[before] != self._stretch[due]) | (self._breaks[before] != self._breaks[due])
        joints = np.empty((due.size, *state.joint.shape))
        for first, last in pairwise((0, *np.flatnonzero(broken).tolist(), due.size)):
            if first == last:
                continue
            if broken[first]:
                state = self._beyond_break(state, int(before[first]), int(due[first]))
            part = due[first:last]
            observed = self._t_s[part], self._path_m[part], self._sigma_m[part]
            joints[first:last] = self._filter.run(state, *observed, self._arrays.jitter_s)
            state = self._filter.after(state, joints[last - 1], float(self._t_s[part[-1]]))
        use_from = np.searchsorted(self._t_s, self._t_s[due] + SPEED_SPAN_S)
        return state, np.maximum(use_from, due + 1), joints

    def _beyond_break(self, state: FilterState, before: int, position: int) -> FilterState:
        """The state at the first position after a break; where the odometer lost its way, nothing tells of a move."""
        if self._stretch[before] == self._stretch[position]:
            observed = *self._observation(position), float(self._sigma_m[position]), self._arrays.jitter_s
            return self._filter.resume(state, *observed, self._limit_m)
        away = self._outages[before] != self._outages[position]
        return self._filter.restart(state, *self._observation(position), self._limit_m**2 if away else 0.0)

    def _due(self, last_s: float, begin: int, end: int) -> Ints:
        """Positions of the updates: the first a filter period after the last one, and so on."""
        period_s = self._config.align.filter_period_s * (1.0 - 1e-6)
        due: list[int] = []
        position = self._next(last_s + period_s, begin)
        while position < end:
            due.append(position)
            position = self._next(self._times[position] + period_s, position + 1)
        return np.array(due, dtype=np.int64)

    def _put(self, use_from: Ints, joints: Floats) -> None:
        """Fill the estimates in use, each from its position on."""
        epochs = np.append(self._rows, self._learned.scale.size)  # a position past the last is past all epochs
        self._learned.put(epochs[use_from], estimates_of(joints))

    def _next(self, t_s: float, at_least: int) -> int:
        """First position at or after this time, and not before `at_least`."""
        return max(at_least, bisect_left(self._times, t_s))

    def _series(self, begin: int, end: int, restart: int) -> AxisSeries:
        """Along-track increments of these positions; the one at `restart` has none before it."""
        first = max(begin - 1, restart)
        rows = self._rows[first:end]
        series = along_series(rows, self._arrays, self._track, self._learned, self._config)
        return series.between(begin - first, rows.size)

    def _hold(self, estimate: Estimate, alarm: int) -> tuple[int, float]:
        """Position from which learning goes on after the alarm at `alarm`, and what it has still to settle [m2].

        The number of positions if it never goes on. What may settle is how far the position is from its place then.
        """
        begin = max(alarm - 1, 0)
        config, rows = self._config, self._rows[begin:]
        t_s, path_m, sigma_m = self._t_s[begin:], self._path_m[begin:], self._sigma_m[begin:]
        steps = odometer_steps(rows, self._arrays.t_s, self._track, self._learned)
        away = path_m - path_m[0] - np.cumsum(steps.distance_m)
        series = self._series(begin, self._rows.size, begin)
        result, _ = run_axis(series, self._alphas)
        beyond = ~(np.abs(result.value[:, :2]) <= self._factor * result.sigma[:, :2])
        fast = beyond.any(axis=1) | (np.arange(rows.size) <= 1)
        last_fail = np.maximum.accumulate(np.where(fast, t_s, -np.inf))
        quiet = t_s - last_fail >= config.lds.recovery_s
        elapsed = t_s - t_s[0]
        spread = np.sqrt(
            2.0 * sigma_m**2
            + self._track.white_rate_m2_per_s * elapsed
            + (estimate.scale_sigma * np.cumsum(np.abs(steps.distance_m))) ** 2
        )
        near = np.abs(away) <= np.minimum(config.hazards.failure_limit_m, self._factor * spread)
        may_return = self._factor * spread <= config.hazards.failure_limit_m
        back = np.flatnonzero(quiet & near & may_return)
        if not back.size:
            return self._rows.size, 0.0
        first = int(back[0])
        return begin + first, float(away[first] ** 2 + spread[first] ** 2)


def _gaps_before(at_s: Floats, t_s: Floats, gap_s: float) -> Ints:
    """How many gaps of a series of times end up to each of these times."""
    ends = t_s[1:][np.diff(t_s) > gap_s]
    return np.searchsorted(ends, at_s, side="right")


def _in_use(use_from: Ints, position: int) -> int:
    """Index of the last state that may be used at a position."""
    return int(np.searchsorted(use_from, position, side="right")) - 1
