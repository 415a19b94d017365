"""The three axes of the bank from aligned epochs: which are usable, and what leads from one to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import (
    DISABLED,
    FAIL,
    NO_POSITION,
    NO_SIGMA,
    NOT_EVALUATED,
    NUMBER,
    PASS,
    Verdicts,
    first_reason,
    no_verdicts,
    otherwise,
    states_of,
    verdicts,
)
from pipeline.stages.monitors.axis import (
    BLOCK,
    FIRST_BLOCK,
    AlongEpochs,
    AxisSeries,
    AxisState,
    Source,
    along_series,
    errors_of,
    run_axis,
    time_steps,
)
from pipeline.stages.monitors.noise import OF_WALK, OF_WHITE_NOISE, NoiseMeter
from pipeline.stages.odometry.driven import is_moving
from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, MonitorConfig
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.stages import NO_REASON, AlignedEpochs
from schemas.tables import SCALES

OFF_TRACK = NotEvaluated.OFF_TRACK
NO_HEIGHT = NotEvaluated.NO_HEIGHT
FIRST_EPOCH = NotEvaluated.FIRST_EPOCH
_STRAIGHT_PER_M = 1e-6


@frozen
class Axis:
    """Its increments, at which of them the train moves, and per epoch why there is none (`NO_REASON`: there is)."""

    name: str
    series: AxisSeries
    moving: Bools
    reasons: Ints


def along_axis(epochs: AlignedEpochs, config: Configuration) -> Axis:
    """GNSS minus odometer along the track (DIAG eq. 1-3); arguments as of `axes_of`."""
    t_s = (epochs.t_ns - epochs.t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    reasons = otherwise(matched, epochs.odometer_reason)
    series = _along(epochs, t_s, reasons, config)
    return Axis("along", series, _moving(epochs, t_s, config)[series.epoch], reasons)


def axes_of(epochs: AlignedEpochs, config: Configuration) -> tuple[Axis, Axis, Axis]:
    """The three axes of the bank.

    Args:
        epochs: aligned epochs of one solution, arrays of shape (n,).
        config: the configuration.

    Returns:
        Along, across the track and up.

    Source:
        DIAG eq. 1-3 and 10-15.
    """
    t_s = (epochs.t_ns - epochs.t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    up_reasons = otherwise(matched, first_reason((np.isnan(epochs.vertical_m), NO_HEIGHT)))
    moving = _moving(epochs, t_s, config)
    built = (
        ("cross", _across(epochs, t_s, matched, "cross", config), matched),
        ("up", _across(epochs, t_s, up_reasons, "up", config), up_reasons),
    )
    cross, up = (Axis(name, series, moving[series.epoch], reasons) for name, series, reasons in built)
    return along_axis(epochs, config), cross, up


def _moving(epochs: AlignedEpochs, t_s: Floats, config: Configuration) -> Bools:
    """Whether the train moves, by the odometer: noise of its rows at a stand is no distance driven."""
    travelled_m = epochs.travelled_m
    deadband_mps = config.matching.deadband_mps
    known = np.isfinite(travelled_m)
    if not known.any():
        return np.asarray(np.abs(np.nan_to_num(epochs.speed_mps)) > deadband_mps)
    return is_moving(t_s, np.interp(t_s, t_s[known], travelled_m[known]), deadband_mps, config.align.speed_window_s)


def _match_reasons(epochs: AlignedEpochs) -> Ints:
    """Why the match gives no position that the bank could use."""
    no_sigma = np.isnan(epochs.sigma_along_m) | np.isnan(epochs.sigma_cross_m)
    return first_reason((~epochs.fix_valid, NO_POSITION), (~epochs.near_track, OFF_TRACK), (no_sigma, NO_SIGMA))


def _along(epochs: AlignedEpochs, t_s: Floats, reasons: Ints, config: Configuration) -> AxisSeries:
    """The epochs that are compared along the track, and what they are compared by."""
    rows = np.flatnonzero(reasons == NO_REASON)
    at_rows = AlongEpochs(
        epoch=rows,
        t_s=t_s[rows],
        along_m=epochs.along_m[rows],
        doubt_m=epochs.odometer_doubt_m[rows],
        sigma_m=epochs.calibrated_along_m[rows],
        digits_m=epochs.digits_along_m[rows],
        jitter_s=epochs.stamp_jitter_s[rows],
        scale_sigma=epochs.scale_sigma[rows],
        latency_sigma_s=epochs.latency_sigma_s[rows],
        white_m2_per_s=epochs.odometer_white_m2_per_s[rows],
        rows_m=epochs.odometer_rows_m[rows],
        period_s=epochs.odometer_period_s[rows],
    )
    return along_series(at_rows, Increments(_steps(epochs.odometer_m[rows]), _steps(epochs.speed_mps[rows])), config)


def _across(
    epochs: AlignedEpochs, t_s: Floats, reasons: Ints, axis: Literal["cross", "up"], config: Configuration
) -> AxisSeries:
    """Cross-track or vertical; the chord error of a coarse survey is one more correlated source."""
    rows = np.flatnonzero(reasons == NO_REASON)
    dt, fresh = time_steps(t_s[rows], config.align.gap_reset_s)
    visit = np.cumsum(np.diff(epochs.element, prepend=epochs.element[:1]) != 0)[rows]
    survey = np.nan_to_num(epochs.survey_sigma_m[rows], nan=config.matching.survey_sigma_default_m)
    if axis == "cross":
        position_m, sigma_m, digits_m = epochs.cross_track_m, epochs.calibrated_cross_m, epochs.digits_cross_m
    else:
        position_m, sigma_m, digits_m = epochs.vertical_m, epochs.calibrated_up_m, epochs.digits_up_m
    coarse = digits_m[rows], np.ones(rows.size)
    # Mostly there is at most one of them.
    further = [
        source
        for source in (_chord_error(epochs, rows), _wander(epochs, rows, config.monitors), coarse)
        if source[0].any()
    ]
    return AxisSeries(
        epoch=rows,
        fresh=fresh,
        border=np.diff(visit, prepend=visit[:1]) != 0,
        dt_s=dt,
        rate_mps=_steps(position_m[rows]) / dt,
        **errors_of(sigma_m[rows], dt, further, config.monitors),
        white_m2=np.zeros(rows.size),
        border_m2=2.0 * survey**2,
        lasting_mps=_turned_mps(epochs, rows) if axis == "cross" else np.zeros((rows.size, 0)),
    )


def _turned_mps(epochs: AlignedEpochs, rows: Ints) -> Floats:
    """What one sigma along the track makes across it while a curve turns the axes [m/s]; (rows, 1)."""
    turning = epochs.curvature_per_m[rows] * epochs.speed_mps[rows]
    return (np.nan_to_num(turning) * epochs.calibrated_along_m[rows])[:, None]


def _wander(epochs: AlignedEpochs, rows: Ints, config: MonitorConfig) -> Source:
    """How the survey's error changes along the elements [m], and its decorrelation over the distance of each step.

    A 2-D survey of no stated accuracy wanders; a stated sigma is constant in place, unless configured otherwise.
    """
    survey = epochs.survey_sigma_m[rows]
    unstated = np.isnan(survey) & np.isnan(epochs.vertical_m[rows])
    stated_m = np.nan_to_num(survey)
    length_m = config.survey_length_m
    if length_m is None:
        stated_m = np.zeros(survey.size)
        length_m = config.survey_wander_length_m
    error = np.where(unstated, config.survey_wander_m, stated_m)
    return error, -np.expm1(-_path_steps_m(epochs, rows) / np.where(unstated, config.survey_wander_length_m, length_m))


def _chord_error(epochs: AlignedEpochs, rows: Ints) -> Source:
    """How far chords lie off their curve [m], and its decorrelation over the distance of each step."""
    error = np.nan_to_num(epochs.interpolation_error_m[rows])
    curvature = np.abs(np.nan_to_num(epochs.curvature_per_m[rows]))
    length = np.sqrt(8.0 * error / np.maximum(curvature, _STRAIGHT_PER_M))  # chord of an arc with this sagitta
    return error, -np.expm1(-_path_steps_m(epochs, rows) / np.maximum(length, 1.0))


def _path_steps_m(epochs: AlignedEpochs, rows: Ints) -> Floats:
    """Distance along the path from the row before [m], 0 at the first."""
    path_m = np.nan_to_num(epochs.path_m[rows])
    return np.abs(np.diff(path_m, prepend=path_m[:1]))


def _steps(values: Floats) -> Floats:
    """Differences from the row before, 0 at the first; shape (n,)."""
    return np.diff(values, prepend=values[:1])


NOISE_UNKNOWN = NotEvaluated.NOISE_UNKNOWN
NOISE_TOO_LARGE = NotEvaluated.NOISE_TOO_LARGE
WHITE_PART = float(np.sqrt(OF_WALK / OF_WHITE_NOISE))
"""White noise over what is measured, which is taken for a random walk."""


class AxisBank:
    """One axis of the bank over all epochs of a solution; rows are evaluated up to `_done`.

    `series`: its increments, `fresh` where a restart was too. `value`, `threshold`, `noise_m` (fast noise in the
    thresholds): per epoch and monitor (raw, then the EWMAs), NaN where there is none. `noise_known`: no failure can
    hide in it; true where the axis has no row. `enabled`: which of the monitors are. `blind`: why none of them can say
    that all is well, None where they can.
    """

    def __init__(self, axis: Axis, epochs: int, config: Configuration, blind: NotEvaluated | None = None) -> None:
        self.axis = axis
        self._blind = blind
        self.series = axis.series
        self._config = config
        self._alphas = np.array(config.monitors.ewma_alphas)
        self.enabled = np.array([f"{axis.name}_{scale}" not in config.monitors.disabled for scale in SCALES])
        shape = epochs, len(SCALES)
        self.value = np.full(shape, np.nan, order="F")
        self.threshold = np.full(shape, np.nan, order="F")
        self.noise_m = np.full(shape, np.nan, order="F")
        self.state = np.full(shape, NOT_EVALUATED, dtype=np.int8, order="F")
        self.begins = np.zeros(epochs, dtype=np.bool_)
        # Rows of the odometer scatter by nobody knows how much yet.
        self.noise_known: Bools = axis.reasons != NUMBER[NOISE_UNKNOWN]
        given_m: tuple[float, ...] | None = getattr(config.monitors, f"noise_{axis.name}_m")
        self._meter = NoiseMeter(axis.series, axis.moving, given_m, config)
        self._begin_at(0, None, BLOCK)

    def _begin_at(self, row: int, state: AxisState | None, block: int) -> None:
        """Evaluate from this row on, at first so many at once; state None: a restart."""
        self._done = row
        self._state = state
        self._block = block
        self._last_block = row, state

    def advance(self, epoch: int) -> int:
        """Evaluate up to this epoch; returns the last one that is evaluated now."""
        rows = self.series.epoch
        while self._done < rows.size and rows[self._done] <= epoch:
            end = min(self._done + self._block, rows.size)
            self._last_block = self._done, self._state
            part = self.series.between(self._done, end)
            noise_m2 = self._meter.variance_m2(self._done, end)
            value, sigma, self._state = run_axis(part, self._alphas, self._state, noise_m2)
            self._store(part, value, self._config.monitors.threshold_factor * sigma, np.sqrt(noise_m2))
            self._done, self._block = end, min(2 * self._block, BLOCK)
        return int(rows[self._done]) - 1 if self._done < rows.size else self.value.shape[0] - 1

    def _store(self, part: AxisSeries, value: Floats, threshold: Floats, noise_m: Floats) -> None:
        """Write what was evaluated of some rows into the arrays by epoch."""
        present = ~part.fresh[:, None] & self.enabled[None, :]
        # One noise too large, and the axis has a blind spot: none of its monitors says that all is well.
        known: Bools = np.all((noise_m <= self._config.noise_limit_m) | ~self.enabled.any(), axis=1)
        judged = present & known[:, None]
        state = states_of(value, threshold, judged)
        if self._blind is not None:
            state[state == PASS] = NOT_EVALUATED
            judged &= state == FAIL
        self.state[part.epoch] = state
        self.value[part.epoch] = np.where(present, value, np.nan)
        self.threshold[part.epoch] = np.where(judged, threshold, np.nan)
        self.noise_m[part.epoch] = noise_m
        self.begins[part.epoch] = part.fresh
        self.noise_known[part.epoch] = known

    def freeze(self, epoch: int) -> None:
        """No row from this epoch on enters the noise, until a restart; evaluated anew from the last block on.

        Noise that is not known yet, or too large, goes on being measured: it would never be known, or smaller.
        """
        row = int(np.searchsorted(self.series.epoch, epoch))
        before = int(np.searchsorted(self.series.epoch, epoch, side="right")) - 1
        if before >= 0 and np.all(self.noise_m[self.series.epoch[before]] <= self._config.noise_limit_m):
            self._meter.freeze(row)
            self._begin_at(*self._last_block, FIRST_BLOCK)

    def restart(self, epoch: int) -> None:
        """Forget all but the noise; the first increment is from the first usable epoch on."""
        row = int(np.searchsorted(self.series.epoch, epoch))
        self.series = replace(self.series, fresh=self.series.fresh | (np.arange(self.series.fresh.size) == row))
        self._meter.restart(row)
        self._begin_at(row, None, FIRST_BLOCK)

    def white_noise_m(self) -> float | None:
        """sqrt(4 M / 6) of one epoch at the end; None where never known (DOMAIN section 3)."""
        known = self.noise_m[:, 0][np.isfinite(self.noise_m[:, 0])]
        return float(known[-1]) * WHITE_PART if known.size else None

    def median_noise_m(self) -> tuple[float, ...]:
        """Median noise in the thresholds of each monitor [m]; empty where it never was known."""
        known = self.noise_m[np.isfinite(self.noise_m).all(axis=1)]
        return tuple(np.median(known, axis=0).tolist()) if known.size else ()

    def verdicts(self) -> dict[str, Verdicts]:
        """Verdicts of the monitors of this axis by name, as far as they are evaluated."""
        unknown = np.zeros(self.value.shape[0], dtype=np.bool_)
        unknown[self.series.epoch] = np.isnan(self.noise_m[self.series.epoch]).any(axis=1)
        too_large: Bools = np.any(self.noise_m > self._config.noise_limit_m, axis=1)
        of_noise = first_reason((unknown, NOISE_UNKNOWN), (too_large, NOISE_TOO_LARGE))
        reasons = otherwise(self.axis.reasons, of_noise)
        if self._blind is not None:
            reasons = otherwise(reasons, first_reason((np.isfinite(self.value).any(axis=1), self._blind)))
        reasons = otherwise(reasons, FIRST_EPOCH)
        disabled = otherwise(self.axis.reasons, DISABLED)
        return {
            f"{self.axis.name}_{scale}": verdicts(
                self.value[:, index],
                self.threshold[:, index],
                reasons if self.enabled[index] else disabled,
                self.state[:, index],
            )
            for index, scale in enumerate(SCALES)
        }


class MonitorBank:
    """The bank as the location determination system sees it: monitors of one solution, from the last restart on.

    Epochs are rows of the solution's epochs. Answers for an epoch may change with `freeze` or `restart` at or before
    it, never through later ones. `watched`: epochs with a row along the track. A fail of any monitor is an alarm.

    Args:
        epochs: aligned epochs of the solution, arrays of shape (n,).
        single: verdicts of the monitors without memory, by name, each of n rows.
        config: the configuration.
        blind_along: why those along the track cannot say that all is well, None where they can: an odometer made of the
            positions agrees with them whatever they say (DOMAIN section 5.0).

    Source:
        DIAG eq. 1-17; DOMAIN section 3.
    """

    def __init__(
        self,
        epochs: AlignedEpochs,
        single: Mapping[str, Verdicts],
        config: Configuration,
        blind_along: NotEvaluated | None = None,
    ):
        self._count = epochs.height
        disabled = config.monitors.disabled
        self._axes = tuple(
            AxisBank(axis, self._count, config, blind_along if axis.name == "along" else None)
            for axis in axes_of(epochs, config)
        )
        along, across, _ = self._axes
        # In a run without an odometer the axis across the track has to say where the bank begins.
        self._begins = (along if along.series.epoch.size else across).begins
        self._noise_known = along.noise_known
        self.watched: Ints = along.series.epoch
        self._single = {
            name: no_verdicts(self._count, DISABLED) if name in disabled else found for name, found in single.items()
        }
        fails = [found.fails for found in self._single.values()]
        self._single_fails = np.logical_or.reduce([np.zeros(self._count, dtype=np.bool_), *fails])
        self._any, self._stops, self._fast, self._along = (np.zeros(self._count, dtype=np.bool_) for _ in range(4))
        self._known_to = -1

    def _look(self, epoch: int) -> None:
        """Evaluate all axes up to this epoch at least, and note what the LDS asks for."""
        if epoch <= self._known_to:
            return
        begin = self._known_to + 1
        self._known_to = min(axis.advance(epoch) for axis in self._axes)
        part = slice(begin, self._known_to + 1)
        fails = np.logical_or.reduce([axis.state[part] == FAIL for axis in self._axes])
        self._any[part] = fails.any(axis=1) | self._single_fails[part]
        self._fast[part] = fails[:, :2].any(axis=1) | self._single_fails[part]
        self._stops[part] = self._any[part] | self._begins[part] | ~self._noise_known[part]
        self._along[part] = self._axes[0].state[part, 0] != NOT_EVALUATED

    def _look_to_the_end(self) -> None:
        """Look at all epochs given so far."""
        self._look(self._count - 1)

    def failed(self, epoch: int) -> bool:
        """A monitor of the bank fails at this epoch."""
        self._look(epoch)
        return bool(self._any[epoch])

    def fast_failed(self, epoch: int) -> bool:
        """A monitor fails that does not ring: raw, fastest EWMA, or without memory. Only these hold back recovery.

        One without memory does not outlive its fault; a return while it fails would restart the bank every `recovery_s`
        and so blind its slow averages.
        """
        self._look(epoch)
        return bool(self._fast[epoch])

    def along_evaluated(self, epoch: int) -> bool:
        """`along_raw` has a verdict; an average alone says nothing of a step."""
        self._look(epoch)
        return bool(self._along[epoch])

    def quiet_until(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on, at most `end`, at which something fails, begins or is not known yet."""
        self._look(epoch)
        ahead = self._stops[epoch : min(self._known_to + 1, end)]
        first = int(ahead.argmax())
        return epoch + (first if ahead[first] else ahead.size)

    def hidden_until(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on, at most `end`, at which the fast noise is known or something fails."""
        self._look(epoch)
        part = slice(epoch, min(self._known_to + 1, end))
        shown = self._noise_known[part] | self._any[part]
        first = int(shown.argmax())
        return epoch + (first if shown[first] else shown.size)

    def along_evaluated_between(self, epoch: int, end: int) -> Bools:
        """Whether the axis along is evaluated at epochs for which `quiet_until` answered."""
        return self._along[epoch:end]

    def noise_known_at(self, epoch: int) -> bool:
        """The fast noise along the track is known, and no failure can hide in it."""
        self._look(epoch)
        return bool(self._noise_known[epoch])

    def begins_at(self, epoch: int) -> bool:
        """Nothing leads here: start, gap, lost distance, restart."""
        self._look(epoch)
        return bool(self._begins[epoch])

    def freeze(self, epoch: int) -> None:
        """Negated from this epoch on: until a restart nothing enters the measured noise."""
        for axis in self._axes:
            axis.freeze(epoch)
        self._known_to = min(self._known_to, epoch)

    def restart(self, epoch: int) -> None:
        """Begin anew at this epoch, as after a gap: nothing but the measured noise is kept."""
        for axis in self._axes:
            axis.restart(epoch)
        self._known_to = epoch - 1

    def along(self) -> AxisBank:
        """What the monitors along the track saw, after the walk."""
        self._look_to_the_end()
        return self._axes[0]

    def white_noise(self) -> dict[str, float | None]:
        """`white_noise_*_m` of the run [m]."""
        return {f"white_noise_{axis.axis.name}_m": axis.white_noise_m() for axis in self._axes}

    def median_noise_m(self) -> dict[str, tuple[float, ...]]:
        """`noise_*_m` of the configuration, as this run shows them."""
        self._look_to_the_end()
        shown = {f"noise_{axis.axis.name}_m": axis.median_noise_m() for axis in self._axes}
        return {name: noise_m for name, noise_m in shown.items() if noise_m}

    def verdicts(self) -> dict[str, Verdicts]:
        """Verdicts of each monitor of the bank by name, in the order of the columns of `epochs`."""
        self._look_to_the_end()
        return {name: found for axis in self._axes for name, found in axis.verdicts().items()} | self._single

    def columns(self) -> list[pl.Series]:
        """The same as columns of `epochs`."""
        return [column for name, found in self.verdicts().items() for column in found.columns(name)]
