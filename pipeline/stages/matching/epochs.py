"""One solution's positions as arrays with their sigmas (`fixes_of`), and as epochs on the path (`matched_epochs`)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import polars as pl

from pipeline.stages.odometry.rows import step_of
from pipeline.stages.track.geodesy import MEAN_RADIUS_M, Points, points_of
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.segments import Feet, segments_at
from schemas.arrays import Bools, Floats, Ints, floats, ints, times_ns
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.enums import Fix, SigmaSource
from schemas.frozen import frozen
from schemas.stages import SIGMA_SOURCES, MatchedEpochs


@frozen
class Fixes:
    """Epochs of one solution in order; NaN where not known.

    `valid` has a position and a fix; `from_receiver` says that the (co)variances [m2] are the receiver's; `estimated`
    that the position was carried on without satellites.
    """

    t_ns: Ints
    valid: Bools
    points: Points
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    cov_ee_m2: Floats
    cov_en_m2: Floats
    cov_nn_m2: Floats
    cov_uu_m2: Floats
    from_receiver: Bools
    estimated: Bools
    vel_e_mps: Floats
    vel_n_mps: Floats
    hpl_m: Floats

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def t_s(self) -> Floats:
        """Seconds since the first epoch."""
        return np.asarray((self.t_ns - self.t_ns[:1]) * 1e-9, dtype=np.float64)


def fixes_of(frame: pl.DataFrame, sigma: FixSigma) -> Fixes:
    """Arrays of a `gnss` stream of one solution.

    A receiver's covariance counts where both horizontal variances are positive (zero means not known in
    many logs); else the configuration's sigma by kind of fix stands in (DOMAIN section 3). A correlation that no
    covariance can have is not known: the variances stand alone.

    Args:
        frame: rows of one solution in order of time, shape (n,).
        sigma: standard deviations by kind of fix [m].

    Returns:
        Arrays of shape (n,), NaN where not known.
    """
    column = {name: _optional_floats(frame, name) for name in _NUMBERS}
    fix = _fix_numbers(frame["fix"])
    table_m = np.array([*(sigma.horizontal_m(kind) for kind in Fix), None], dtype=np.float64)
    valid = np.isfinite(column["latitude_deg"]) & np.isfinite(column["longitude_deg"])
    valid &= fix != _KINDS.index(Fix.NONE.value)
    with np.errstate(invalid="ignore"):
        receiver = valid & (column["cov_ee_m2"] > 0) & (column["cov_nn_m2"] > 0)
        height_known = receiver & (column["cov_uu_m2"] > 0)
        correlated = receiver & (column["cov_en_m2"] ** 2 < column["cov_ee_m2"] * column["cov_nn_m2"])
    table = np.where(valid, (table_m**2)[fix], np.nan)
    ee = np.where(receiver, column["cov_ee_m2"], table)
    nn = np.where(receiver, column["cov_nn_m2"], table)
    up = np.where(height_known, column["cov_uu_m2"], 0.5 * (ee + nn) * sigma.vertical_factor**2)
    latitude = np.where(valid, column["latitude_deg"], np.nan)
    longitude = np.where(valid, column["longitude_deg"], np.nan)
    return Fixes(
        t_ns=times_ns(frame),
        valid=valid,
        points=points_of(latitude, longitude),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=np.where(valid, column["height_m"], np.nan),
        cov_ee_m2=ee,
        cov_en_m2=np.where(correlated, column["cov_en_m2"], np.where(valid, 0.0, np.nan)),
        cov_nn_m2=nn,
        cov_uu_m2=up,
        from_receiver=receiver,
        estimated=fix == _KINDS.index(Fix.ESTIMATED.value),
        vel_e_mps=column["vel_e_mps"],
        vel_n_mps=column["vel_n_mps"],
        hpl_m=column["hpl_m"],
    )


def count_contradictory_covariances(frame: pl.DataFrame) -> int:
    """How many epochs of a `gnss` stream have a `cov_en_m2` that no covariance with these variances can have."""
    ee, en, nn = (floats(frame, f"cov_{axes}_m2") for axes in ("ee", "en", "nn"))
    return int(((ee > 0.0) & (nn > 0.0) & (en**2 >= ee * nn)).sum())


_KINDS = [kind.value for kind in Fix]
_NUMBERS = (
    *("latitude_deg", "longitude_deg", "height_m"),
    *("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "cov_uu_m2", "vel_e_mps", "vel_n_mps", "hpl_m"),
)


def _optional_floats(frame: pl.DataFrame, name: str) -> Floats:
    """A column with null as NaN; an optional column that is absent is not known."""
    if name not in frame.columns:
        return np.full(frame.height, np.nan)
    return frame[name].cast(pl.Float64).to_numpy()


def _fix_numbers(fix: pl.Series) -> Ints:
    """Kinds of fix by their number in `Fix`; the number after the last where not known."""
    return ints(fix.cast(pl.Enum(_KINDS)).to_physical(), len(_KINDS))


# Numerics: less than this is rounding.
_ROUNDED_M = 1e-4


def digit_deviations_m(fixes: pl.DataFrame, least_m: float) -> tuple[float, float, float]:
    """Deviations by the last digit of the recorded coordinates [m]: north, east, height.

    Five decimals of a degree, NMEA of four decimals of a minute, or single precision move each position by up to half a
    step, the next one by something else: at 10 Hz metres per second. Only the digits are looked at, so no fault of the
    position can pass for it. `fixes`: those of one solution. `least_m`: finer steps count for nothing.
    """
    latitude = floats(fixes, "latitude_deg")
    known = latitude[np.isfinite(latitude)]
    north_per_deg = np.radians(1.0) * MEAN_RADIUS_M
    east_per_deg = north_per_deg * np.cos(np.radians(known.mean())) if known.size else north_per_deg
    north, east, up = (
        coordinate_step_m(values[np.isfinite(values)], scale, least_m) / np.sqrt(12.0)
        for values, scale in (
            (latitude, north_per_deg),
            (floats(fixes, "longitude_deg"), east_per_deg),
            (floats(fixes, "height_m"), 1.0),
        )
    )
    return north, east, up


def coordinate_step_m(values: Floats, metres: float, least_m: float) -> float:
    """The step of a recorded coordinate [m], 0 where none is as large as `least_m`; `metres`: of one unit of it."""
    changes = np.diff(values)
    # At speed the changes themselves are many steps each, but the change of the change is one at times.
    return metres * step_of(changes, np.diff(changes), least_m / metres, _ROUNDED_M / metres)


_RECEIVER, _TABLE = (SIGMA_SOURCES.index(source) for source in (SigmaSource.RECEIVER, SigmaSource.TABLE))


@frozen
class Assignment:
    """What the search found per epoch: leg, path position near which it lies [m], and how sure it is."""

    leg: Ints
    near_path_m: Floats
    path_probability: Floats
    gate_probability: Floats


@frozen
class PlacedEpochs:
    """Every epoch on its leg: its foot, path position of the antenna and height over the track [m], NaN if unknown."""

    feet: Feet
    antenna_m: Floats
    vertical_m: Floats

    @classmethod
    def on_path(cls, fixes: Fixes, path: TravelledPath, assignment: Assignment) -> PlacedEpochs:
        """Project every epoch onto its leg."""
        feet = path.nearest_feet(fixes.points, assignment.leg, fixes.valid, assignment.near_path_m)
        return cls(feet, *path.path_positions(assignment.leg, feet, fixes.height_m))


@frozen
class TrackShape:
    """Direction [deg], slope, curvature [1/m] and quality of the survey [m] at places of the path."""

    heading_deg: Floats
    slope: Floats
    curvature_per_m: Floats
    interpolation_error_m: Floats
    survey_sigma_m: Floats

    @cached_property
    def direction(self) -> tuple[Floats, Floats]:
        """East and north part of the track's direction."""
        heading = np.radians(self.heading_deg)
        return np.sin(heading), np.cos(heading)


@frozen
class RecordedDigits:
    """Name of a solution, and deviations by the last digit of its coordinates (`digit_deviations_m`)."""

    solution: str
    north_m: float
    east_m: float
    up_m: float

    def along_cross_up_m(self, shape: TrackShape) -> tuple[Floats, Floats, Floats]:
        """The deviations along and across the track, and of the height [m]; shapes (epochs,)."""
        turned = np.radians(np.nan_to_num(shape.heading_deg))
        along = np.hypot(self.north_m * np.cos(turned), self.east_m * np.sin(turned))
        cross = np.hypot(self.north_m * np.sin(turned), self.east_m * np.cos(turned))
        return along, cross, np.full(turned.size, self.up_m)


def matched_epochs(
    fixes: Fixes,
    written: RecordedDigits,
    path: TravelledPath,
    assignment: Assignment,
    placed: PlacedEpochs,
    vehicle: Vehicle,
    config: MatchingConfig,
) -> MatchedEpochs:
    """The epochs on the path, positions referred to the balise antenna.

    `path_m` is the raw position projected, never smoothed: a jump of the GNSS stays a jump. It is given off
    track too (`on_track` false), and goes on straight beyond the ends of the path.

    Args:
        fixes: positions of one solution, arrays of shape (n,).
        written: name of the solution and steps of its recorded coordinates [m].
        path: the path shown.
        assignment: leg and confidences of each epoch.
        placed: foot of each epoch on its leg.
        vehicle: the place of the GNSS antenna ahead of the balise antenna [m].
        config: the section `matching` of the configuration.

    Returns:
        The matched epochs, arrays of shape (n,).
    """
    feet = placed.feet
    antenna_m = placed.antenna_m
    path_m = antenna_m - vehicle.gnss_antenna_ahead_m
    piece, measure_m = path.locate_index(assignment.leg, path_m)
    # The path's track may hold a net element in pieces, one after the other.
    numbers = {name: number for number, name in enumerate(dict.fromkeys(path.track.ids))}
    of_piece = [numbers[name] for name in path.track.ids]
    # The track's direction counts where the GNSS antenna is, not the balise antenna.
    shape = track_shape_at(path, assignment.leg, antenna_m)
    sigma_along_m, sigma_cross_m = track_sigmas_m(fixes, shape)
    allowed_m = on_track_limit_m(sigma_cross_m, shape.survey_sigma_m, config)
    distance_m = np.nan_to_num(feet.distance_m, nan=np.inf)
    on_track = fixes.valid & (distance_m <= np.nan_to_num(allowed_m))
    source = np.where(fixes.from_receiver, _RECEIVER, _TABLE)
    digits_along_m, digits_cross_m, digits_up_m = written.along_cross_up_m(shape)
    return MatchedEpochs(
        t_ns=fixes.t_ns,
        solution=written.solution,
        leg=np.where(fixes.valid, assignment.leg, -1),
        element=np.array([*of_piece, -1])[piece],
        elements=list(numbers),
        measure_m=measure_m,
        path_m=path_m,
        cross_track_m=feet.offset_m,
        vertical_m=placed.vertical_m,
        on_track=on_track,
        near_track=fixes.valid & (distance_m <= config.reach_m),
        path_probability=np.where(on_track, assignment.path_probability, np.nan),
        gate_probability=np.where(on_track, assignment.gate_probability, np.nan),
        heading_deg=shape.heading_deg,
        slope=shape.slope,
        curvature_per_m=shape.curvature_per_m,
        interpolation_error_m=shape.interpolation_error_m,
        survey_sigma_m=shape.survey_sigma_m,
        sigma_along_m=sigma_along_m,
        sigma_cross_m=sigma_cross_m,
        sigma_up_m=np.sqrt(fixes.cov_uu_m2),
        sigma_source=np.where(fixes.valid, source, -1),
        fix_valid=fixes.valid,
        velocity_along_mps=velocity_along_mps(fixes, shape),
        hpl_m=fixes.hpl_m,
        digits_along_m=digits_along_m,
        digits_cross_m=digits_cross_m,
        digits_up_m=digits_up_m,
    )


def track_shape_at(path: TravelledPath, leg: Ints, path_m: Floats) -> TrackShape:
    """Direction, slope, curvature and survey quality of the track at places of the path."""
    shape = TrackShape(*(np.full(len(path_m), np.nan) for _ in range(5)))
    for index, line in enumerate(path.legs):
        rows = np.flatnonzero((leg == index) & np.isfinite(path_m))
        segment, fraction = segments_at(line, path_m[rows])
        held = np.clip(fraction, 0.0, 1.0)
        length = line.path_end_m - line.path_start_m
        before = np.concatenate([length[:1], length[:-1]])
        after = np.concatenate([length[1:], length[-1:]])
        curve_start = 2.0 * line.turn_start_rad / (before + length)
        curve_end = 2.0 * line.turn_end_rad / (length + after)
        bend = 0.5 * (np.abs(line.turn_start_rad) + np.abs(line.turn_end_rad))
        shape.heading_deg[rows] = line.heading_deg[segment]
        shape.slope[rows] = _slope(line.height_end_m - line.height_start_m, length)[segment]
        shape.curvature_per_m[rows] = (curve_start[segment] * (1 - held)) + curve_end[segment] * held
        # Sagitta of an arc: length times the angle it turns over 8.
        shape.interpolation_error_m[rows] = (length * bend / 8.0)[segment]
        shape.survey_sigma_m[rows] = line.sigma_m[segment]
    return shape


def track_sigmas_m(fixes: Fixes, shape: TrackShape) -> tuple[Floats, Floats]:
    """The horizontal covariance turned into the track's frame: sigma along and across [m]."""
    sin, cos = shape.direction
    ee = fixes.cov_ee_m2
    en = fixes.cov_en_m2
    nn = fixes.cov_nn_m2
    along = sin * sin * ee + 2.0 * sin * cos * en + cos * cos * nn
    cross = cos * cos * ee - 2.0 * sin * cos * en + sin * sin * nn
    return np.sqrt(np.maximum(along, 0.0)), np.sqrt(np.maximum(cross, 0.0))


def on_track_limit_m(sigma_cross_m: Floats, survey_sigma_m: Floats, config: MatchingConfig) -> Floats:
    """How far off a track its own sigma, the survey's and the bias allow a position to lie [m]."""
    survey_m = np.where(np.isfinite(survey_sigma_m), survey_sigma_m, config.survey_sigma_default_m)
    spread_m = np.sqrt(sigma_cross_m**2 + survey_m**2 + config.on_track_bias_m**2)
    return np.asarray(np.minimum(config.on_track_sigmas * spread_m, config.reach_m))


def velocity_along_mps(fixes: Fixes, shape: TrackShape) -> Floats:
    """GNSS velocity along growing path [m/s], on the slope where the track has one."""
    east, north = shape.direction
    level = fixes.vel_e_mps * east + fixes.vel_n_mps * north
    return np.asarray(level * np.sqrt(1.0 + np.nan_to_num(shape.slope) ** 2))


def _slope(rise_m: Floats, length_m: Floats) -> Floats:
    """Rise over run, from rise and 3-D length [m]; NaN without heights."""
    run = np.sqrt(np.maximum(length_m * length_m - rise_m * rise_m, 1e-12))
    return np.asarray(rise_m / run)
