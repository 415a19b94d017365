"""Odometer scale and GNSS latency along a run: from the vehicle file, or learned causally and held under alarm."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from pipeline.increments import EpochArrays, Learned, along_series, odometer_steps
from pipeline.monitors.axis import AxisSeries, run_axis
from pipeline.monitors.recursion import AxisState
from pipeline.odometer import OdometerTrack
from pipeline.odometer_filter import (
    SPEED_SPAN_S,
    Estimate,
    FilterState,
    ScaleLatencyFilter,
    error_model,
    estimates_of,
    prior_of,
)
from pipeline.statistics import threshold_factor
from schemas.config import Configuration, Vehicle

# Positions learned at once: few after a restart, for what lies behind an alarm is learned in vain; then more.
_FIRST_BLOCK, _BLOCK = 2048, 8192


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
    before the alarm (DOMAIN section 3 and 4); a fault that persists is never learned as scale.
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
        # What a single update reads is looked up in lists, which is several times faster than in arrays.
        self._times: list[float] = self._t_s.tolist()
        self._stretches: list[int] = track.stretch_at(self._t_s).tolist()
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
        state, position = self._start(prior), 0
        while position < self._rows.size:
            state, alarm = self._learn_until_alarm(state, position)
            if alarm >= self._rows.size:
                break
            position = self._hold(state.estimate(), alarm)
            if position < self._rows.size:
                state = self._filter.restart(state, *self._observation(position)[:2])

    def _observation(self, position: int) -> tuple[float, float, float]:
        """Time [s], GNSS path position and sigma [m] at a position."""
        return float(self._t_s[position]), float(self._path_m[position]), float(self._sigma_m[position])

    def _start(self, prior: Estimate) -> FilterState:
        t_s, path_m, _ = self._observation(0)
        return self._filter.start(prior, t_s, path_m)

    def _learn_until_alarm(self, state: FilterState, begin: int) -> tuple[FilterState, int]:
        """Learn block by block; returns the state in use at the first failing epoch, and its position."""
        bank = AxisState.at_restart(self._alphas.size, self._filter.shares.size + 1)
        history = [(begin, state)]
        position, block = begin, _FIRST_BLOCK
        while position < self._rows.size:
            end = min(position + block, self._rows.size)
            current = max(index for index, (effective, _) in enumerate(history) if effective <= position)
            history = history[current:] + self._updates(history[-1][1], position, end)
            self._put(history, position)
            series = self._series(position, end, begin)
            result, bank = run_axis(series, self._alphas, bank)
            beyond = ~(np.abs(result.value) <= self._factor * result.sigma)  # what cannot be compared is no pass
            failing = np.flatnonzero(beyond.any(axis=1) & ~series.fresh)
            if failing.size:
                alarm = position + int(failing[0])
                in_use = [item for effective, item in history if effective <= alarm][-1]
                self._put([(alarm, in_use)], alarm)
                return in_use, alarm
            position, block = end, min(2 * block, _BLOCK)
        return history[-1][1], position

    def _updates(self, state: FilterState, begin: int, end: int) -> list[tuple[int, FilterState]]:
        """States of the filter's updates in these positions, each with the position from which it may be used."""
        period_s = self._config.align.filter_period_s * (1.0 - 1e-6)
        states: list[tuple[int, FilterState]] = []
        before = self._next(state.t_s, 0)
        position = self._next(state.t_s + period_s, begin)
        while position < end:
            t_s, path_m, sigma_m = self._observation(position)
            if self._broken(before, position):
                state = self._filter.restart(state, t_s, path_m)
            state = self._filter.update(state, t_s, path_m, sigma_m, self._arrays.jitter_s)
            states.append((self._next(t_s + SPEED_SPAN_S, position + 1), state))
            before, position = position, self._next(t_s + period_s, position + 1)
        return states

    def _put(self, history: list[tuple[int, FilterState]], begin: int) -> None:
        """Fill the estimates in use from position `begin` on, where the first of these is in use."""
        effective = np.array([position for position, _ in history])
        epochs = np.append(self._rows, self._learned.scale.size)  # a position past the last is past all epochs
        self._learned.put(epochs[np.maximum(effective, begin)], estimates_of([state for _, state in history]))

    def _broken(self, before: int, now: int) -> bool:
        """Whether the odometer's distance was lost, or too much time passed, between two positions."""
        lost = self._stretches[before] != self._stretches[now]
        return lost or self._times[now] - self._times[before] > self._config.align.gap_reset_s

    def _next(self, t_s: float, at_least: int) -> int:
        """First position at or after this time, and not before `at_least`."""
        return max(at_least, bisect_left(self._times, t_s))

    def _series(self, begin: int, end: int, restart: int) -> AxisSeries:
        """Along-track increments of these positions; the one at `restart` has none before it."""
        first = max(begin - 1, restart)
        rows = self._rows[first:end]
        series = along_series(rows, self._arrays, self._track, self._learned, self._config)
        return series.between(begin - first, rows.size)

    def _hold(self, estimate: Estimate, alarm: int) -> int:
        """Position from which learning goes on after the alarm at `alarm`; the number of positions if never."""
        begin = max(alarm - 1, 0)
        config, rows = self._config, self._rows[begin:]
        t_s, path_m, sigma_m = self._t_s[begin:], self._path_m[begin:], self._sigma_m[begin:]
        steps = odometer_steps(rows, self._arrays.t_s, self._track, self._learned)
        away = path_m - path_m[0] - np.cumsum(steps.distance_m)
        series = self._series(begin, self._rows.size, begin)
        state = AxisState.at_restart(self._alphas.size, self._filter.shares.size + 1)
        result, _ = run_axis(series, self._alphas, state)
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
        return begin + int(back[0]) if back.size else self._rows.size
