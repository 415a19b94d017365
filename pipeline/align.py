"""Alignment: the odometer at each GNSS epoch's time of validity, scale and latency known or learned causally.

Adds to the matched epochs: `along_m, odometer_m, odometer_reason, odometer_stretch, speed_mps, direction,
odometer_scale, scale_sigma, latency_s, latency_sigma_s, stamp_jitter_s, odometer_white_m2_per_s`. A reason says why
an epoch has no odometer.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl
from scipy.special import ndtri

from pipeline.monitors.axis import AxisSeries, along_errors, run_axis
from pipeline.monitors.recursion import Array, AxisState
from pipeline.odometer import OdometerTrack, odometer_track, polarity
from pipeline.odometer_filter import SPEED_SPAN_S, Estimate, FilterState, ScaleLatencyFilter, error_model, prior_of
from schemas.config import Configuration, Vehicle

Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

NO_ODOMETER = "no odometer"
BEYOND_SPAN = "outside the odometer's time span"
INTERRUPTED = "odometer interrupted or slipping"
_BLOCK = 2048
_REGULAR_PERIODS = 3


def threshold_factor(false_alarm_probability: float) -> float:
    """k_T: two-sided Gaussian quantile of the false-alarm probability (DIAG eq. 17); 5.3267 for 1e-7."""
    return float(-ndtri(false_alarm_probability / 2.0))


@dataclass(frozen=True)
class EpochArrays:
    """What alignment reads of the matched epochs: times [s] on the odometer's scale, positions, usability.

    `jitter_s`: by how much the stamps scatter about the receiver's regular times (see `stamp_jitter_s`).
    """

    t_s: Array
    path_m: Array
    sigma_m: Array
    usable: Mask
    jitter_s: float


def stamp_jitter_s(t_s: Array) -> float:
    """Standard deviation of the stamps about a regular clock [s].

    A receiver measures at regular times; a recorder that stamps on receipt scatters them, and at 40 m/s ten
    milliseconds are 0.4 m from one epoch to the next. Only the stamps are looked at, never a position.
    """
    dt = np.diff(t_s)
    period = float(np.median(dt))
    periods = np.round(dt / period)
    regular = (periods >= 1) & (periods <= _REGULAR_PERIODS)
    away = (dt - periods * period)[regular]
    return float(np.sqrt(np.mean(away**2) / 2.0)) if away.size else 0.0


@dataclass(frozen=True)
class Learned:
    """Estimates in use at each epoch; shapes (n,)."""

    scale: Array
    scale_sigma: Array
    latency_s: Array
    latency_sigma_s: Array

    @classmethod
    def constant(cls, estimate: Estimate, n: int) -> Learned:
        values = (estimate.scale, estimate.scale_sigma, estimate.latency_s, estimate.latency_sigma_s)
        return cls(*(np.full(n, value) for value in values))

    def put(self, changes: list[tuple[int, Estimate]]) -> None:
        """Set estimates: each change holds from its epoch to the next, the last for good."""
        begins = [epoch for epoch, _ in changes]
        lengths = np.diff([*begins, self.scale.size])
        values = np.array([(e.scale, e.scale_sigma, e.latency_s, e.latency_sigma_s) for _, e in changes])
        columns = (self.scale, self.scale_sigma, self.latency_s, self.latency_sigma_s)
        for column, value in zip(columns, values.T, strict=True):
            column[begins[0] :] = np.repeat(value, lengths)


def align(epochs: pl.DataFrame, odometer: pl.DataFrame | None, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """Matched epochs of one solution with the odometer's columns (see the module's head)."""
    if odometer is None:
        return _without_odometer(epochs, vehicle, config)
    sigma_mps = config.monitors.odometer_sigma_mps
    track = odometer_track(odometer, config.align.odometer_gap_s, sigma_mps)
    t_s = track.seconds(epochs["t"].dt.timestamp("ns").to_numpy())
    path_m = _floats(epochs["path_m"])
    matched = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy() & np.isfinite(path_m)
    sign = polarity(track, t_s, np.where(matched, path_m, np.nan), config.matching.orientation_distance_m)
    track = track.oriented(sign)
    along_m = unrolled(epochs, matched)
    arrays = EpochArrays(t_s, along_m, _floats(epochs["sigma_along_m"]), matched, stamp_jitter_s(t_s))
    learned = _learn(arrays, track, vehicle, config)
    return epochs.with_columns(
        *_columns(arrays, track, learned, config), pl.Series("along_m", along_m, nan_to_null=True)
    )


def unrolled(epochs: pl.DataFrame, matched: Mask) -> Array:
    """Path position with the way taken out that a curve adds to a position beside the track [m]; NaN elsewhere.

    A point y left of a track that turns left by its curvature k moves dx / (1 - k y) along it while the train moves
    dx, whether y is an error of the position or of the survey. Both are known, so this is no noise of the monitor.
    """
    along = np.full(matched.size, np.nan)
    rows = np.flatnonzero(matched)
    path_m = _floats(epochs["path_m"])[rows]
    beside = np.nan_to_num(_floats(epochs["curvature_per_m"])[rows] * _floats(epochs["cross_track_m"])[rows])
    along[rows] = path_m - np.cumsum(beside * np.diff(path_m, prepend=path_m[:1]))
    return along


def odometer_at(times: pl.Series, aligned: pl.DataFrame, odometer: pl.DataFrame, config: Configuration) -> pl.Series:
    """Odometer distance at any times [m], on the scale of `aligned`'s `odometer_m`; null beyond what is known.

    Carried on from the nearest epoch before (or the first one) with the scale in use there.
    """
    anchors = aligned.drop_nulls("odometer_m")
    if anchors.is_empty():
        return pl.Series("odometer_m", [None] * times.len(), dtype=pl.Float64)
    track = odometer_track(odometer, config.align.odometer_gap_s, config.monitors.odometer_sigma_mps)
    anchor_s = track.seconds(anchors["t"].dt.timestamp("ns").to_numpy()) - _floats(anchors["latency_s"])
    travelled = _floats(anchors["odometer_m"])
    forward = np.sum(np.diff(travelled) * np.diff(track.distance_at(anchor_s)))
    track = track.oriented(-1 if forward < 0 else 1)
    at_s = track.seconds(times.dt.timestamp("ns").to_numpy())
    near = (np.searchsorted(anchor_s, at_s, side="right") - 1).clip(0)
    way = track.distance_at(at_s) - track.distance_at(anchor_s[near])
    known = track.known_at(at_s) & (track.stretch_at(at_s) == track.stretch_at(anchor_s[near]))
    distance = np.where(known, travelled[near] + _floats(anchors["odometer_scale"])[near] * way, np.nan)
    return pl.Series("odometer_m", distance, nan_to_null=True)


def _floats(series: pl.Series) -> Array:
    """A nullable float column as an array with NaN for null."""
    values: Array = series.to_numpy().astype(np.float64)
    return values


def _columns(arrays: EpochArrays, track: OdometerTrack, learned: Learned, config: Configuration) -> list[pl.Series]:
    at = arrays.t_s - learned.latency_s
    known = track.known_at(at)
    inside = (at >= track.t_s[0]) & (at <= track.t_s[-1])
    reason = (
        pl.when(pl.Series(known))
        .then(None)
        .when(pl.Series(inside))
        .then(pl.lit(INTERRUPTED))
        .otherwise(pl.lit(BEYOND_SPAN))
    )
    steps = _steps(np.flatnonzero(known), arrays.t_s, track, learned)
    step = np.full(known.size, np.nan)
    step[known] = steps.distance_m
    speed = np.where(known, learned.scale * track.speed_at(at), np.nan)
    total = np.where(known, np.cumsum(np.nan_to_num(step)), np.nan)
    return [
        pl.Series("odometer_m", total, nan_to_null=True),
        pl.select(reason.alias("odometer_reason")).to_series(),
        pl.Series("odometer_stretch", track.stretch_at(at)),
        pl.Series("stamp_jitter_s", np.full(known.size, arrays.jitter_s)),
        pl.Series("odometer_white_m2_per_s", np.full(known.size, track.white_rate_m2_per_s)),
        pl.Series("speed_mps", speed, nan_to_null=True),
        pl.Series("direction", _direction(speed, config.matching.deadband_mps)),
        pl.Series("odometer_scale", learned.scale),
        pl.Series("scale_sigma", learned.scale_sigma),
        pl.Series("latency_s", learned.latency_s),
        pl.Series("latency_sigma_s", learned.latency_sigma_s),
    ]


def _direction(speed_mps: Array, deadband_mps: float) -> pl.Series:
    """+1 or -1 along growing path, held inside the dead band and where the speed is not known."""
    moving = np.where(np.abs(np.nan_to_num(speed_mps)) > deadband_mps, np.sign(np.nan_to_num(speed_mps)), 0.0)
    signs = pl.Series(moving).replace(0.0, None).forward_fill().backward_fill().fill_null(1.0)
    return signs.cast(pl.Int8)


def _without_odometer(epochs: pl.DataFrame, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """No odometer: speed and direction from GNSS (velocity, else positions over the second before)."""
    nothing = pl.lit(None, pl.Float64)
    t_s = epochs["t"].dt.timestamp("ns").to_numpy() * 1e-9
    t_s = t_s - t_s[0]
    valid = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy()
    by_position = speed_of_positions(t_s, np.where(valid, _floats(epochs["path_m"]), np.nan))
    by_doppler = _floats(epochs["velocity_along_mps"])
    speed = np.where(np.isfinite(by_doppler), by_doppler, by_position)
    latency = vehicle.gnss_latency_s
    return epochs.with_columns(
        along_m=nothing,
        odometer_m=nothing,
        odometer_reason=pl.lit(NO_ODOMETER),
        odometer_stretch=pl.lit(0, pl.Int64),
        stamp_jitter_s=nothing,
        odometer_white_m2_per_s=nothing,
        speed_mps=pl.Series(speed, nan_to_null=True),
        direction=_direction(speed, config.matching.deadband_mps),
        odometer_scale=nothing,
        scale_sigma=nothing,
        latency_s=pl.lit(latency, pl.Float64),
        latency_sigma_s=pl.lit(None if latency is None else vehicle.gnss_latency_sigma_s or 0.0, pl.Float64),
    )


def speed_of_positions(t_s: Array, path_m: Array, window_s: float = 1.0) -> Array:
    """Speed [m/s] from positions at least `window_s` apart, causal; NaN where there are none."""
    speed = np.full(t_s.size, np.nan)
    valid = np.flatnonzero(np.isfinite(path_m))
    if valid.size < 2:
        return speed
    t, x = t_s[valid], path_m[valid]
    before = np.searchsorted(t, t - window_s, side="right") - 1
    before = np.maximum(before, 0)
    span = t - t[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        speed[valid] = np.where(span > 0, (x - x[before]) / span, np.nan)
    return speed


@dataclass(frozen=True)
class _Steps:
    """Corrected odometer distance and speed change from the row before; the first row has none (zero)."""

    distance_m: Array
    speed_mps: Array


def _steps(rows: Index, t_s: Array, track: OdometerTrack, learned: Learned) -> _Steps:
    """Steps between consecutive rows, both ends with the estimates in use at the later one."""
    latency, scale = learned.latency_s[rows], learned.scale[rows]
    now = t_s[rows] - latency
    before = np.concatenate([now[:1], t_s[rows][:-1] - latency[1:]])
    distance = scale * (track.distance_at(now) - track.distance_at(before))
    speed = scale * (track.speed_at(now) - track.speed_at(before))
    return _Steps(distance, speed)


def _learn(arrays: EpochArrays, track: OdometerTrack, vehicle: Vehicle, config: Configuration) -> Learned:
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
        # Single times are looked up in lists, which is several times faster than in arrays.
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
        position = begin
        while position < self._rows.size:
            end = min(position + _BLOCK, self._rows.size)
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
                self._learned.put([(self._epoch(alarm), in_use.estimate())])
                return in_use, alarm
            position = end
        return history[-1][1], position

    def _updates(self, state: FilterState, begin: int, end: int) -> list[tuple[int, FilterState]]:
        """States of the filter's updates in these positions, each with the position from which it may be used."""
        period_s = self._config.align.filter_period_s * (1.0 - 1e-6)
        states: list[tuple[int, FilterState]] = []
        position = self._next(state.t_s + period_s, begin)
        while position < end:
            t_s, path_m, sigma_m = self._observation(position)
            if self._broken(self._next(state.t_s, 0), position):
                state = self._filter.restart(state, t_s, path_m)
            state = self._filter.update(state, t_s, path_m, sigma_m, self._arrays.jitter_s)
            states.append((self._next(t_s + SPEED_SPAN_S, position + 1), state))
            position = self._next(t_s + period_s, position + 1)
        return states

    def _put(self, history: list[tuple[int, FilterState]], begin: int) -> None:
        """Fill the estimates in use from position `begin` on, where the first of these is in use."""
        self._learned.put([(self._epoch(max(effective, begin)), state.estimate()) for effective, state in history])

    def _epoch(self, position: int) -> int:
        """Index among all epochs; the end for a position past the last."""
        return int(self._rows[position]) if position < self._rows.size else int(self._learned.scale.size)

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
        steps = _steps(rows, self._arrays.t_s, self._track, self._learned)
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


def along_series(
    rows: Index, arrays: EpochArrays, track: OdometerTrack, learned: Learned, config: Configuration
) -> AxisSeries:
    """Increments of GNSS minus odometer between consecutive rows (DIAG eq. 1-3)."""
    steps = _steps(rows, arrays.t_s, track, learned)
    t, x = arrays.t_s[rows], arrays.path_m[rows]
    dt = np.diff(t, prepend=t[0] - 1.0)
    stretch = track.stretch_at(t - learned.latency_s[rows])
    fresh = (dt > config.align.gap_reset_s) | (np.diff(stretch, prepend=stretch[0]) != 0)
    fresh[0] = True
    shares, taus_s = error_model(config.monitors)
    zero = np.zeros(rows.size)
    distance = np.diff(x, prepend=x[0])
    return AxisSeries(
        epoch=rows,
        fresh=fresh,
        border=np.zeros(rows.size, dtype=np.bool_),
        dt_s=dt,
        rate_mps=(distance - steps.distance_m) / dt,
        **along_errors(arrays.sigma_m[rows], arrays.jitter_s * steps.distance_m / dt, dt, shares, taus_s),
        white_m2=track.white_rate_m2_per_s * dt,
        border_m2=zero,
        steady_mps=learned.scale_sigma[rows] * steps.distance_m / dt,
        latency_mps=learned.latency_sigma_s[rows] * steps.speed_mps / dt,
    )
