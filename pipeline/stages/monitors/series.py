"""The three axes of the bank from aligned epochs: which are usable, and what leads from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import NO_POSITION, NO_SIGMA, first_reason
from pipeline.stages.monitors.axis import AlongEpochs, AxisSeries, Source, along_series, errors_of, time_steps
from pipeline.stages.odometry.driven import under_way
from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration, MonitorConfig
from schemas.enums import NotEvaluated

OFF_TRACK = NotEvaluated.OFF_TRACK
NO_HEIGHT = NotEvaluated.NO_HEIGHT
FIRST_EPOCH = NotEvaluated.FIRST_EPOCH
_STRAIGHT_PER_M = 1e-6


@dataclass(frozen=True)
class Axis:
    """Its increments, at which of them the train moves, and per epoch why there is none (null: there is)."""

    name: str
    series: AxisSeries
    moving: Bools
    reasons: pl.Series


def along_axis(epochs: pl.DataFrame, config: Configuration) -> Axis:
    """DIAG eq. 1-3; `epochs`: `schemas.stages.Aligned`."""
    t_ns = times_ns(epochs)
    t_s = (t_ns - t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    reasons = matched.zip_with(matched.is_not_null(), epochs["odometer_reason"])
    series = _along(epochs, t_s, reasons, config)
    return Axis("along", series, _moving(epochs, t_s, config)[series.epoch], reasons)


def axes_of(epochs: pl.DataFrame, config: Configuration) -> tuple[Axis, Axis, Axis]:
    """DIAG eq. 1-3 and 10-15."""
    t_ns = times_ns(epochs)
    t_s = (t_ns - t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    up_reasons = first_reason((matched.is_not_null(), matched), (epochs["vertical_m"].is_null(), NO_HEIGHT))
    moving = _moving(epochs, t_s, config)
    built = (
        ("cross", _across(epochs, t_s, matched, "cross_track_m", "cross", config), matched),
        ("up", _across(epochs, t_s, up_reasons, "vertical_m", "up", config), up_reasons),
    )
    cross, up = (Axis(name, series, moving[series.epoch], reasons) for name, series, reasons in built)
    return along_axis(epochs, config), cross, up


def _moving(epochs: pl.DataFrame, t_s: Floats, config: Configuration) -> Bools:
    """By the odometer: noise of the rows at a stand is no way driven."""
    way_m = floats(epochs, "travelled_m")
    deadband_mps = config.matching.deadband_mps
    known = np.isfinite(way_m)
    if not known.any():
        return np.asarray(np.abs(np.nan_to_num(floats(epochs, "speed_mps"))) > deadband_mps)
    return under_way(t_s, np.interp(t_s, t_s[known], way_m[known]), deadband_mps, config.align.speed_window_s)


def _match_reasons(epochs: pl.DataFrame) -> pl.Series:
    """Why the match gives no position that the bank could use."""
    no_sigma = epochs["sigma_along_m"].is_null() | epochs["sigma_cross_m"].is_null()
    return first_reason((~epochs["fix_valid"], NO_POSITION), (~epochs["near_track"], OFF_TRACK), (no_sigma, NO_SIGMA))


def _along(epochs: pl.DataFrame, t_s: Floats, reasons: pl.Series, config: Configuration) -> AxisSeries:
    rows, used = _without_reason(epochs, reasons)
    at_rows = AlongEpochs(
        epoch=rows,
        t_s=t_s[rows],
        along_m=floats(used, "along_m"),
        doubt_m=floats(used, "odometer_doubt_m"),
        sigma_m=floats(used, "calibrated_along_m"),
        digits_m=floats(used, "digits_along_m"),
        jitter_s=floats(used, "stamp_jitter_s"),
        scale_sigma=floats(used, "scale_sigma"),
        latency_sigma_s=floats(used, "latency_sigma_s"),
        white_m2_per_s=floats(used, "odometer_white_m2_per_s"),
        rows_m=floats(used, "odometer_rows_m"),
        period_s=floats(used, "odometer_period_s"),
    )
    return along_series(at_rows, Increments(_steps(used, "odometer_m"), _steps(used, "speed_mps")), config)


def _across(
    epochs: pl.DataFrame, t_s: Floats, reasons: pl.Series, position: str, axis: str, config: Configuration
) -> AxisSeries:
    """Cross-track or vertical; the chord error of a coarse survey is one more correlated source."""
    rows, used = _without_reason(epochs, reasons)
    dt, fresh = time_steps(t_s[rows], config.align.gap_reset_s)
    element = epochs["netelement_id"].rle_id().to_numpy()[rows]
    survey = np.nan_to_num(floats(used, "survey_sigma_m"), nan=config.matching.survey_sigma_default_m)
    coarse = floats(used, f"digits_{axis}_m"), np.ones(rows.size)
    # Mostly there is at most one of them.
    beside = [source for source in (_chord_error(used), _wander(used, config.monitors), coarse) if source[0].any()]
    return AxisSeries(
        epoch=rows,
        fresh=fresh,
        border=np.diff(element, prepend=element[:1]) != 0,
        dt_s=dt,
        rate_mps=_steps(used, position) / dt,
        **errors_of(floats(used, f"calibrated_{axis}_m"), dt, beside, config.monitors),
        white_m2=np.zeros(rows.size),
        border_m2=2.0 * survey**2,
        lasting_mps=_turned_mps(used) if axis == "cross" else np.zeros((rows.size, 0)),
    )


def _without_reason(epochs: pl.DataFrame, reasons: pl.Series) -> tuple[Ints, pl.DataFrame]:
    """The epochs without a reason against them: their rows, and what stands there."""
    used = reasons.is_null()
    return np.flatnonzero(used.to_numpy()), epochs.filter(used)


def _turned_mps(used: pl.DataFrame) -> Floats:
    """What one sigma along the track makes across it while a curve turns the axes [m/s]; (rows, 1)."""
    turning = floats(used, "curvature_per_m") * floats(used, "speed_mps")
    return (np.nan_to_num(turning) * floats(used, "calibrated_along_m"))[:, None]


def _wander(used: pl.DataFrame, config: MonitorConfig) -> Source:
    """How the survey's error changes along the elements [m], and its decorrelation over the way of each step.

    A 2-D survey of no stated accuracy wanders; a stated sigma is constant in place, unless configured otherwise.
    """
    survey = floats(used, "survey_sigma_m")
    unstated = np.isnan(survey) & np.isnan(floats(used, "vertical_m"))
    stated_m = np.nan_to_num(survey)
    length_m = config.survey_length_m
    if length_m is None:
        stated_m = np.zeros(survey.size)
        length_m = config.survey_wander_length_m
    error = np.where(unstated, config.survey_wander_m, stated_m)
    return error, -np.expm1(-_way_m(used) / np.where(unstated, config.survey_wander_length_m, length_m))


def _chord_error(used: pl.DataFrame) -> Source:
    error = np.nan_to_num(floats(used, "interpolation_error_m"))
    curvature = np.abs(np.nan_to_num(floats(used, "curvature_per_m")))
    length = np.sqrt(8.0 * error / np.maximum(curvature, _STRAIGHT_PER_M))  # chord of an arc with this sagitta
    return error, -np.expm1(-_way_m(used) / np.maximum(length, 1.0))


def _way_m(used: pl.DataFrame) -> Floats:
    path_m = np.nan_to_num(floats(used, "path_m"))
    return np.abs(np.diff(path_m, prepend=path_m[:1]))


def _steps(used: pl.DataFrame, name: str) -> Floats:
    values = floats(used, name)
    return np.diff(values, prepend=values[:1])
