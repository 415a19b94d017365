"""The three axes of the bank from aligned epochs: which epochs are usable, and what leads from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.epochs.verdicts import NO_POSITION, NO_SIGMA, first_reason
from pipeline.stages.monitors.axis import AlongEpochs, AxisSeries, Source, along_series, errors_of, time_steps
from pipeline.stages.odometry.driven import under_way
from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration
from schemas.enums import NotEvaluated

OFF_TRACK = NotEvaluated.OFF_TRACK
NO_HEIGHT = NotEvaluated.NO_HEIGHT
FIRST_EPOCH = NotEvaluated.FIRST_EPOCH
_STRAIGHT_PER_M = 1e-6


@dataclass(frozen=True)
class Axis:
    """One axis: its increments, at which of them the train moves, and per epoch why there is none (null: there is)."""

    name: str
    series: AxisSeries
    moving: Bools
    reasons: pl.Series


def axes_of(epochs: pl.DataFrame, config: Configuration) -> tuple[Axis, Axis, Axis]:
    """Along, cross and up (DIAG eq. 1-3 and 10-15) from aligned epochs of one solution."""
    t_ns = times_ns(epochs)
    t_s = (t_ns - t_ns[0]) * 1e-9
    matched = _match_reasons(epochs)
    along_reasons = matched.zip_with(matched.is_not_null(), epochs["odometer_reason"])
    up_reasons = first_reason((matched.is_not_null(), matched), (epochs["vertical_m"].is_null(), NO_HEIGHT))
    builder = _Builder(epochs, t_s, config)
    moving = _moving(epochs, t_s, config)
    across = builder.across(matched, "cross_track_m", "calibrated_cross_m", "digits_cross_m")
    built = (
        ("along", builder.along(along_reasons), along_reasons),
        ("cross", across, matched),
        ("up", builder.across(up_reasons, "vertical_m", "calibrated_up_m", "digits_up_m"), up_reasons),
    )
    along, cross, up = (Axis(name, series, moving[series.epoch], reasons) for name, series, reasons in built)
    return along, cross, up


def _moving(epochs: pl.DataFrame, t_s: Floats, config: Configuration) -> Bools:
    """Whether the train moves, by its odometer: noise of the rows at a stand is no way driven."""
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


class _Builder:
    """Increments of an axis between consecutive epochs without a reason against it."""

    def __init__(self, epochs: pl.DataFrame, t_s: Floats, config: Configuration) -> None:
        self._epochs = epochs
        self._t_s = t_s
        self._config = config

    def _column(self, name: str, rows: Ints) -> Floats:
        return floats(self._epochs, name)[rows]

    def along(self, reasons: pl.Series) -> AxisSeries:
        rows = np.flatnonzero(reasons.is_null().to_numpy())
        rows_m = self._column("odometer_rows_m", rows)
        odometer = Increments(_steps(self._column("odometer_m", rows)), _steps(self._column("speed_mps", rows)))
        epochs = AlongEpochs(
            epoch=rows,
            t_s=self._t_s[rows],
            along_m=self._column("along_m", rows),
            segment=self._epochs["odometer_segment"].to_numpy()[rows],
            sigma_m=self._column("calibrated_along_m", rows),
            digits_m=self._column("digits_along_m", rows),
            jitter_s=self._column("stamp_jitter_s", rows),
            scale_sigma=self._column("scale_sigma", rows),
            latency_sigma_s=self._column("latency_sigma_s", rows),
            white_m2_per_s=self._column("odometer_white_m2_per_s", rows),
            rows_m=rows_m if rows_m.any() else None,
            period_s=self._column("odometer_period_s", rows),
        )
        return along_series(epochs, odometer, self._config)

    def across(self, reasons: pl.Series, position: str, sigma: str, digits: str) -> AxisSeries:
        """Cross-track or vertical; the chord error of a coarse survey counts as one more correlated source."""
        rows = np.flatnonzero(reasons.is_null().to_numpy())
        dt, fresh = time_steps(self._t_s[rows], self._config.align.gap_reset_s)
        border = _changes(self._epochs["netelement_id"].rle_id().to_numpy()[rows])
        survey = np.nan_to_num(self._column("survey_sigma_m", rows), nan=self._config.matching.survey_sigma_default_m)
        coarse = self._column(digits, rows), np.ones(rows.size)
        # Mostly there is at most one of them.
        beside = [source for source in (self._chord_error(rows), self._wander(rows), coarse) if source[0].any()]
        zero = np.zeros(rows.size)
        return AxisSeries(
            epoch=rows,
            fresh=fresh,
            border=border,
            dt_s=dt,
            rate_mps=_steps(self._column(position, rows)) / dt,
            **errors_of(self._column(sigma, rows), dt, beside, self._config.monitors),
            white_m2=zero,
            border_m2=2.0 * survey**2,
            lasting_mps=self._turned_mps(rows) if position == "cross_track_m" else np.zeros((rows.size, 0)),
        )

    def _turned_mps(self, rows: Ints) -> Floats:
        """What one sigma of the error along the track makes across it while a curve turns the axes [m/s]; (rows, 1)."""
        turning = self._column("curvature_per_m", rows) * self._column("speed_mps", rows)
        return (np.nan_to_num(turning) * self._column("calibrated_along_m", rows))[:, None]

    def _wander(self, rows: Ints) -> Source:
        """How the survey's error changes along the elements [m], and its decorrelation over the way of each step.

        A 2-D survey of no stated accuracy wanders; one that states its sigma is off by the same in place, unless the
        configuration says over which length it changes.
        """
        config = self._config.monitors
        survey = self._column("survey_sigma_m", rows)
        way = self._way(rows)
        unstated = np.isnan(survey) & np.isnan(self._column("vertical_m", rows))
        stated_m = np.nan_to_num(survey)
        length_m = config.survey_length_m
        if length_m is None:
            stated_m = np.zeros(rows.size)
            length_m = config.survey_wander_length_m
        error = np.where(unstated, config.survey_wander_m, stated_m)
        return error, -np.expm1(-way / np.where(unstated, config.survey_wander_length_m, length_m))

    def _chord_error(self, rows: Ints) -> Source:
        """The polyline's chord error [m] and its decorrelation over the way of each step."""
        error = np.nan_to_num(self._column("interpolation_error_m", rows))
        curvature = np.abs(np.nan_to_num(self._column("curvature_per_m", rows)))
        length = np.sqrt(8.0 * error / np.maximum(curvature, _STRAIGHT_PER_M))  # chord of an arc with this sagitta
        return error, -np.expm1(-self._way(rows) / np.maximum(length, 1.0))

    def _way(self, rows: Ints) -> Floats:
        """Along the path from each row to the next [m]."""
        return np.abs(_steps(np.nan_to_num(self._column("path_m", rows))))


def _steps(values: Floats) -> Floats:
    return np.diff(values, prepend=values[:1])


def _changes(values: npt.NDArray[np.generic]) -> Bools:
    changed = np.zeros(values.size, dtype=np.bool_)
    changed[1:] = values[1:] != values[:-1]
    return changed
