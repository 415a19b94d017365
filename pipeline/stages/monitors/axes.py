"""What the bank looks at along, across and above the track: increments of positions, and their errors."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np

from pipeline.stages.epochs.verdicts import NO_POSITION, NO_SIGMA, fill_reasons, first_reason
from pipeline.stages.monitors.axis import AlongEpochs, AxisSeries, Source, along_series, errors_of, time_steps
from pipeline.stages.monitors.noise import NoiseMeter, Sampler
from pipeline.stages.odometry.driven import is_moving
from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, MonitorConfig
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.stages import NO_REASON, AlignedEpochs

OFF_TRACK = NotEvaluated.OFF_TRACK
NO_HEIGHT = NotEvaluated.NO_HEIGHT
_STRAIGHT_PER_M = 1e-6


@frozen
class Axis:
    """One axis of the bank, `along`, `cross` or `up`: its increments, and at which of them the train moves.

    `reasons`: per epoch why it has no increment (`NO_REASON`: it has one).
    """

    name: str
    series: AxisSeries
    moving: Bools
    reasons: Ints
    config: Configuration

    @cached_property
    def _sampler(self) -> Sampler:
        """The second differences of the series, shared by all meters of its noise."""
        return Sampler(self.series, self.moving, self.config.monitors)

    def noise_meter(self, given_m: tuple[float, ...] | None) -> NoiseMeter:
        """Measures the fast noise, unless it is given by monitor [m]."""
        return NoiseMeter(self.series, self.moving, given_m, self.config, self._sampler)


def along_axis(epochs: AlignedEpochs, config: Configuration) -> Axis:
    """GNSS minus odometer along the track (DIAG eq. 1-3); arguments as of `axes_of`."""
    t_s = (epochs.t_ns - epochs.t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    reasons = fill_reasons(matched, epochs.odometer_reason)
    series = _along(epochs, t_s, reasons, config)
    return Axis("along", series, _moving(epochs, t_s, config)[series.epoch], reasons, config)


def axes_of(epochs: AlignedEpochs, config: Configuration, along: Axis | None = None) -> tuple[Axis, Axis, Axis]:
    """The three axes of the bank.

    Args:
        epochs: aligned epochs of one solution, arrays of shape (n,).
        config: the configuration.
        along: the axis along the track, where it was made already.

    Returns:
        Along, across the track and up.

    Source:
        DIAG eq. 1-3 and 10-15.
    """
    t_s = (epochs.t_ns - epochs.t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    up_reasons = fill_reasons(matched, first_reason((np.isnan(epochs.vertical_m), NO_HEIGHT)))
    moving = _moving(epochs, t_s, config)
    built = (
        ("cross", _across(epochs, t_s, matched, "cross", config), matched),
        ("up", _across(epochs, t_s, up_reasons, "up", config), up_reasons),
    )
    cross, up = (Axis(name, series, moving[series.epoch], reasons, config) for name, series, reasons in built)
    return along or along_axis(epochs, config), cross, up


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
    """Increments of GNSS minus odometer along the track, of the epochs without a reason (`NO_REASON`); `t_s`: [s]."""
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
        rows_m=epochs.odometer_rows_m[rows] if epochs.odometer_rows_m.any() else None,
        period_s=epochs.odometer_period_s[rows],
    )
    return along_series(at_rows, Increments(_steps(epochs.odometer_m[rows]), _steps(epochs.speed_mps[rows])), config)


def _across(
    epochs: AlignedEpochs, t_s: Floats, reasons: Ints, axis: Literal["cross", "up"], config: Configuration
) -> AxisSeries:
    """Increments of the cross-track or vertical deviation, of the epochs without a reason (`NO_REASON`).

    The chord error of a coarse survey is one more correlated source.
    """
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
