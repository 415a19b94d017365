"""Causal estimate of odometer scale and GNSS latency inside a run: an extended Kalman filter.

Observed is the GNSS path position against the odometer's distance at the time of validity:

    x(t) = offset + (1 + scale error) * (D(t - latency) - D_0) + sigma(t) * sum_j sqrt(share_j) e_j(t)

with unit first-order Gauss-Markov errors e_j of the monitor bank's own model, so that the estimate's covariance
tells what the data really say about scale and latency; the offset walks with the odometer's white noise.

After a break a position may come back off its place, and return to it or stay there, by no more than the monitors
let pass. So the offset may have moved over the break, and walks on until a position has settled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from pipeline.stages.odometry.odometry import Odometry
from pipeline.stages.odometry.quantisation import KnownNoise
from pipeline.stages.odometry.scale_lag import slopes
from schemas.arrays import Floats, Ints
from schemas.config import AlignConfig, Vehicle
from schemas.frozen import frozen


class Estimates(NamedTuple):
    """Scale (true over odometer distance) and latency [s] with standard deviations."""

    scale: Floats
    scale_sigma: Floats
    latency_s: Floats
    latency_sigma_s: Floats

    def over(self, epochs: int) -> Estimates:
        """The same at so many epochs."""
        return Estimates(*(np.full(epochs, value) for value in self))

    def at(self, rows: Ints) -> Estimates:
        """The estimates at some epochs."""
        return Estimates(*(column[rows] for column in self))

    def fill(self, begins: Ints, changes: Estimates) -> None:
        """Overwrite from epoch `begins[i]` on by change i: each holds up to the next begin, the last to the end."""
        lengths = np.diff(begins, append=self.scale.size)
        for column, value in zip(self, changes, strict=True):
            column[begins[0] :] = np.repeat(value, lengths)


def stamp_jitter_s(t_s: Floats, period_s: Floats, clock_periods: float) -> Floats:
    """Standard deviation of the stamps so far about a regular clock [s], at each of them.

    `period_s`: at each stamp as known before it, 0 where it is not. Steps over more than `clock_periods` are left out.
    A recorder that stamps on receipt scatters them: ten milliseconds are 0.4 m at 40 m/s.
    """
    dt_s = np.diff(t_s, prepend=t_s[:1])
    known = period_s > 0.0
    periods = np.round(np.divide(dt_s, period_s, out=np.zeros(t_s.size), where=known))
    regular = known & (periods >= 1) & (periods <= clock_periods)
    away_s = np.where(regular, dt_s - periods * period_s, 0.0)
    return np.asarray(np.sqrt(np.cumsum(away_s**2) / (2.0 * np.maximum(np.cumsum(regular), 1))))


_OFFSET = 0
_SCALE = 1
_LATENCY = 2
_ERRORS = 3
_OFFSET_PRIOR_M2 = 1e6
# Half the square of so many sigmas that no doubt is left; beyond it the exponential would overflow.
_CERTAIN = 100.0


class FilterState(NamedTuple):
    """State of (offset, scale error, latency, e_j...) at a time and from an odometer origin.

    `joint`: covariance and, as last column, mean, (states, states + 1). `unsettled_m2`: the offset has still to walk.
    """

    joint: Floats
    t_s: float
    origin_m: float
    unsettled_m2: float = 0.0


def estimates_of(joints: Floats) -> Estimates:
    """Scale and latency with their sigmas of joint states, shape (..., states, states + 1)."""
    means = joints[..., -1]
    deviations = np.sqrt(np.diagonal(joints, axis1=-2, axis2=-1))
    return Estimates(1.0 + means[..., _SCALE], deviations[..., _SCALE], means[..., _LATENCY], deviations[..., _LATENCY])


class _Scatter(NamedTuple):
    """Of stamps and of the odometer's rows at one epoch (`KnownNoise`)."""

    still_m2: float
    moving_s2: float
    faster_s2: float
    shown_mps: float


def _scatters(known: KnownNoise, jitter_s: Floats) -> list[_Scatter]:
    """Scatters of each epoch, as plain numbers: the filter runs row by row."""
    columns = known.still_m2, jitter_s**2 + known.moving_s2, known.faster_s2, known.shown_mps
    return [_Scatter(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


@frozen
class ScaleLatencyFilter:
    """Extended Kalman filter of offset, scale error, latency and errors e_j; states are passed in and out.

    `shares`, `taus_s`: part of the variance and correlation time of each error e_j; times are seconds since the
    odometer's `epoch_ns`, path positions metres.
    """

    shares: Floats
    taus_s: Floats
    odometry: Odometry
    config: AlignConfig

    def start(self, prior: Estimates, t_s: float, path_m: float) -> FilterState:
        """Offset and GNSS errors unknown, scale and latency as in `prior`."""
        errors = self.shares.size
        origin_m = float(self.odometry.distance_at_s(np.array([t_s - prior.latency_s]))[0])
        mean = np.concatenate([[path_m, prior.scale - 1.0, prior.latency_s], np.zeros(errors)])
        variances = [_OFFSET_PRIOR_M2, prior.scale_sigma**2, prior.latency_sigma_s**2]
        covariance = np.diag(np.concatenate([variances, np.ones(errors)]))
        return FilterState(np.column_stack([covariance, mean]), t_s, origin_m)

    def restart(self, state: FilterState, t_s: float, path_m: float, unsettled_m2: float = 0.0) -> FilterState:
        """As `start`, but what was learned of scale and latency stays; `unsettled_m2`: the offset has still to walk."""
        fresh = self.start(estimates_of(state.joint), t_s, path_m)
        kept = slice(_SCALE, _ERRORS)
        fresh.joint[kept, kept] = state.joint[kept, kept]
        return fresh._replace(unsettled_m2=max(unsettled_m2, self._unsettled_m2(state, t_s)))

    def resume(
        self, state: FilterState, t_s: float, path_m: float, sigma_m: float, jitter_s: float, limit_m: float
    ) -> FilterState:
        """The state at the first position after a break, before anything is learned from it.

        The offset may have moved by about `limit_m`, as far as the position shows, and as much again as it settles.
        """
        joint = np.empty_like(state.joint)
        row = self._rows(np.array([sigma_m]))[0]
        left_m2 = self._unsettled_m2(state, t_s)
        step_ns = _nanoseconds(t_s - state.t_s)
        known = self.odometry.noise_at_s(np.array([t_s]))
        walked_m2 = state.unsettled_m2 - left_m2 + known.white_m2_per_s.item() * step_ns * 1e-9
        self._predict(state.joint, step_ns, walked_m2, joint)
        innovation, speed_mps = self._innovation(joint, row, t_s, path_m, state.origin_m)
        (scatter,) = _scatters(known, np.array([jitter_s]))
        variance_m2 = row.dot(innovation[:-1]).item() + self.config.white_share * sigma_m**2
        variance_m2 += self._scatter_m2(scatter, speed_mps)
        probability = self.config.break_moved_probability * -math.expm1((state.t_s - t_s) / self.config.break_moving_s)
        # Beyond the prior of the offset nothing changes, but the digits of the position's noise would be lost.
        brought_m2 = min(moved_m2(innovation.item(-1), variance_m2, limit_m, probability), _OFFSET_PRIOR_M2)
        joint[_OFFSET, _OFFSET] += brought_m2
        return FilterState(joint, t_s, state.origin_m, left_m2 + brought_m2)

    def state_after(self, state: FilterState, joint: Floats, t_s: float) -> FilterState:
        """The state at the epoch `t_s` [s]: its updated `joint`, and less left to settle than in the `state` before."""
        return state._replace(joint=joint, t_s=t_s, unsettled_m2=self._unsettled_m2(state, t_s))

    def run(self, state: FilterState, t_s: Floats, path_m: Floats, sigma_m: Floats, jitter_s: Floats) -> Floats:
        """The joint state after each of these epochs, (epochs, states, states + 1)."""
        joints = np.empty((t_s.size, *state.joint.shape))
        times_s = t_s.tolist()
        rows = self._rows(sigma_m)
        dt_s = np.diff(t_s, prepend=state.t_s)
        steps_ns = [_nanoseconds(step_s) for step_s in dt_s.tolist()]
        known = self.odometry.noise_at_s(t_s)
        unsettled_m2 = state.unsettled_m2 * np.exp((state.t_s - t_s) / self.config.settling_tau_s)
        bridged_m2 = np.diff(self.odometry.bridged_m2_at(np.concatenate([[state.t_s], t_s])))
        walked_m2 = bridged_m2 + known.white_m2_per_s * dt_s - np.diff(unsettled_m2, prepend=state.unsettled_m2)
        white_m2 = (self.config.white_share * sigma_m**2).tolist()
        before = state.joint
        scatters = _scatters(known, jitter_s)
        walks_m2 = walked_m2.tolist()
        epochs = zip(joints, rows, times_s, path_m.tolist(), white_m2, scatters, steps_ns, walks_m2, strict=True)
        for joint, row, now_s, place_m, noise_m2, scatter, step_ns, walk_m2 in epochs:
            self._predict(before, step_ns, walk_m2, joint)
            innovation, speed_mps = self._innovation(joint, row, now_s, place_m, state.origin_m)
            spread = innovation[:-1]
            # Kalman update of covariance and mean at once: minus gain times (H P, predicted minus observed).
            variance_m2 = row.dot(spread).item() + noise_m2 + self._scatter_m2(scatter, speed_mps)
            joint -= (spread / variance_m2)[:, None] * innovation
            before = joint
        return joints

    def _rows(self, sigma_m: Floats) -> Floats:
        """Observation matrix: d(position) / d(state); scale and latency are filled in by `_innovation`."""
        rows: Floats = sigma_m[:, None] * np.concatenate([np.zeros(_ERRORS), np.sqrt(self.shares)])
        rows[:, _OFFSET] = 1.0
        return rows

    def _predict(self, before: Floats, step_ns: int, walked_m2: float, joint: Floats) -> None:
        """Decay, noise, and the offset that walks and settles over the step."""
        decay, noise = self._transition(step_ns)
        np.multiply(before, decay, out=joint)
        joint += noise
        joint[_OFFSET, _OFFSET] += walked_m2

    def _innovation(
        self, joint: Floats, row: Floats, now_s: float, place_m: float, origin_m: float
    ) -> tuple[Floats, float]:
        """H P and, as its last element, predicted minus observed position; and the speed. Completes `row` (H).

        The distance is already read at the mean latency, whose part in H is taken out again.
        """
        scale = 1.0 + joint.item(_SCALE, -1)
        latency_s = joint.item(_LATENCY, -1)
        distance_m, speed_mps = self._odometer_at(now_s - latency_s, origin_m)
        row[_SCALE], row[_LATENCY] = slopes(distance_m, speed_mps, scale)
        innovation: Floats = row.dot(joint)
        innovation[-1] += distance_m + scale * speed_mps * latency_s - place_m
        return innovation, speed_mps

    @staticmethod
    def _scatter_m2(scatter: _Scatter, speed_mps: float) -> float:
        """Variance of stamps and of the odometer's rows, both without memory [m^2]."""
        faster = max(speed_mps**2 - scatter.shown_mps**2, 0.0)
        return scatter.still_m2 + scatter.moving_s2 * speed_mps**2 + scatter.faster_s2 * faster

    def _unsettled_m2(self, state: FilterState, t_s: float) -> float:
        """What of the offset has still to settle at a later time [m^2]."""
        return state.unsettled_m2 * math.exp((state.t_s - t_s) / self.config.settling_tau_s)

    def _odometer_at(self, at_s: float, origin_m: float) -> tuple[float, float]:
        """Distance [m], and speed centred on the instant: one of the second before would bias a latency [m/s]."""
        times_s = self.odometry.t_s
        span_s = self.config.latency_span_s
        begin_s = max(at_s - span_s, times_s.item(0))
        end_s = min(at_s + span_s, times_s.item(-1))
        before, distance, after = np.interp((begin_s, at_s, end_s), times_s, self.odometry.distance_m).tolist()
        return distance - origin_m, (after - before) / (end_s - begin_s)

    @cached_property
    def _transition(self) -> Callable[[int], tuple[Floats, Floats]]:
        """The transition of one step, remembered: a receiver's epochs are mostly the same time apart."""
        return lru_cache(maxsize=32)(self._transition_over)

    def _transition_over(self, dt_ns: int) -> tuple[Floats, Floats]:
        """Decay of the joint state over this time, and the noise that comes in."""
        dt_s = dt_ns * 1e-9
        decay = np.concatenate([np.ones(_ERRORS), np.exp(-dt_s / self.taus_s)])
        noise = 1.0 - decay * decay
        noise[_OFFSET] = 0.0
        return np.outer(decay, np.append(decay, 1.0)), np.column_stack([np.diag(noise), np.zeros(decay.size)])


def moved_m2(offset_m: float, variance_m2: float, limit_m: float, probability: float) -> float:
    """Mean square of a move over a break, given that the position appears `offset_m` from its place (Bayes).

    Prior: moved with `probability`, then normally distributed with a sigma of `limit_m`.
    """
    gain = limit_m**2 / (limit_m**2 + variance_m2)
    evidence = math.exp(min(0.5 * gain * offset_m**2 / variance_m2, _CERTAIN))
    odds = probability / (1.0 - probability) * math.sqrt(1.0 - gain) * evidence
    return odds / (1.0 + odds) * gain * (gain * offset_m**2 + variance_m2)


def _nanoseconds(seconds: float) -> int:
    """Whole nanoseconds."""
    return round(seconds * 1e9)


def prior_of(vehicle: Vehicle, config: AlignConfig) -> Estimates:
    """Prior of scale and latency by the vehicle file, else the configured one around 1 and 0."""
    scale = 1.0, config.scale_prior_sigma
    latency_s = 0.0, config.latency_prior_sigma_s
    if vehicle.odometer_scale is not None:
        scale = vehicle.odometer_scale, vehicle.odometer_scale_sigma or 0.0
    if vehicle.gnss_latency_s is not None:
        latency_s = vehicle.gnss_latency_s, vehicle.gnss_latency_sigma_s or 0.0
    return Estimates(*(np.asarray(value) for value in (*scale, *latency_s)))
