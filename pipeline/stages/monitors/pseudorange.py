"""Satellites as a receiver sees them: lines of sight (DO-229 appendix J, G_i) and how good ranges are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import polars as pl
from scipy.special import chdtri

from pipeline.stages.epochs.verdicts import NO_POSITION, Verdicts, first_reason, no_verdicts, verdicts
from pipeline.stages.monitors.axis import BLOCK
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats
from schemas.config import Configuration
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.stages import MatchedEpochs

# DIAG Table 1, variances that do not depend on elevation [m^2].
_ORBIT_CLOCK_M2 = 0.3
_USER_M2 = 1.5
# DO-229 A.4.4.10.4 (obliquity) and A.4.2.4 (troposphere); 0.3 m at zenith stands for the paper's lost value.
_EARTH_RADIUS_KM = 6378.1363
_IONOSPHERE_HEIGHT_KM = 350.0
_ZENITH_IONOSPHERE_M = 0.3
_ZENITH_TROPOSPHERE_M = 0.12


def line_of_sight_rows(azimuth_deg: Floats, elevation_deg: Floats) -> Floats:
    """Change of range per metre east, north, up; shape (..., 3)."""
    azimuth = np.radians(azimuth_deg)
    elevation = np.radians(elevation_deg)
    return np.stack(
        [-np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), -np.sin(elevation)],
        axis=-1,
    )


def clock_columns(svs: Sequence[str]) -> Floats:
    """One receiver clock per constellation, shape (n, clocks)."""
    systems = sorted({sv[:1] for sv in svs})
    return np.array([[float(sv.startswith(system)) for system in systems] for sv in svs])


def ionosphere_m2(elevation_deg: Floats, zenith_m: float) -> Floats:
    """Variance of a vertical error at an elevation (DO-229 A.4.4.10.4, obliquity) [m^2]."""
    elevation = np.radians(np.maximum(elevation_deg, 0.0))
    ratio = _EARTH_RADIUS_KM * np.cos(elevation) / (_EARTH_RADIUS_KM + _IONOSPHERE_HEIGHT_KM)
    variance: Floats = zenith_m**2 / (1.0 - ratio**2)
    return variance


def troposphere_m2(elevation_deg: Floats, zenith_m: float) -> Floats:
    """The same of the troposphere (DO-229 A.4.2.4) [m^2]."""
    elevation = np.radians(np.maximum(elevation_deg, 0.0))
    variance: Floats = (zenith_m * 1.001) ** 2 / (0.002001 + np.sin(elevation) ** 2)
    return variance


def range_variances_m2(elevation_deg: Floats) -> Floats:
    """Ionosphere, troposphere, orbit and clock, user [m^2]; shape (..., 4).

    DIAG Table 1 for a range corrected by SBAS.
    """
    ionosphere = ionosphere_m2(elevation_deg, _ZENITH_IONOSPHERE_M)
    troposphere = troposphere_m2(elevation_deg, _ZENITH_TROPOSPHERE_M)
    level = np.ones_like(troposphere)
    return np.stack([ionosphere, troposphere, _ORBIT_CLOCK_M2 * level, _USER_M2 * level], axis=-1)


NO_RANGES = NotEvaluated.NO_RANGES
NO_RANGES_AT_EPOCH = NotEvaluated.NO_RANGES_AT_EPOCH
TOO_FEW = NotEvaluated.TOO_FEW_RANGES
AMBIGUOUS = NotEvaluated.AMBIGUOUS
_RIDGE = 1e-13


def pseudorange_monitor(epochs: MatchedEpochs, satellites: pl.DataFrame | None, config: Configuration) -> Verdicts:
    """Ranges to the satellites against the position on the track: the weighted sum of squares of their residuals.

    Args:
        epochs: matched epochs of one solution, arrays of shape (n,).
        satellites: residuals [m] of its satellites by epoch, or None.
        config: the configuration; used are `monitors`, `matching` and `fix_sigma`.

    Returns:
        Verdicts of n rows; value: weighted sum of squares [1], threshold: its chi-square quantile for the epoch's
        degrees of freedom.

    Source:
        DO-229 appendix J; DOMAIN section 3.
    """
    if satellites is None or satellites.is_empty():
        return no_verdicts(epochs.height, NO_RANGES)
    ranges = _ranges_by_epoch(epochs, satellites, config.monitors.satellite_stamp_s)
    track = _track_of(epochs, config)
    value = np.full(epochs.height, np.nan)
    freedom = np.zeros(epochs.height, dtype=np.int64)
    for part in _chunks(ranges, track):
        value[part.epoch] = _left_over(part)
        freedom[part.epoch] = part.freedom
    tested = freedom > 0
    threshold = np.full(epochs.height, np.nan)
    threshold[tested] = chdtri(freedom[tested], config.monitors.false_alarm_probability)
    with_ranges = np.isin(np.arange(epochs.height), ranges.epoch)
    reasons = first_reason(
        (~track.matched, NO_POSITION),
        (~track.usable, AMBIGUOUS),
        (~with_ranges, NO_RANGES_AT_EPOCH),
        (~tested, TOO_FEW),
    )
    return verdicts(value, threshold, reasons)


@frozen
class _Ranges:
    """Used satellites with a residual, by epoch; `system` numbers the constellations."""

    epoch: Ints
    system: Ints
    rows: Floats
    residual_m: Floats
    variance_m2: Floats

    @property
    def systems(self) -> int:
        """How many constellations."""
        return int(self.system.max(initial=-1)) + 1


@frozen
class _TrackFrame:
    """At each epoch: unit vectors east, north, up, and the position's offset [m]."""

    along: Floats
    cross: Floats
    offset_m: Floats
    sigma_m: Floats
    height_known: Bools
    usable: Bools
    matched: Bools


def _ranges_by_epoch(epochs: MatchedEpochs, satellites: pl.DataFrame, apart_s: float) -> _Ranges:
    """Each range with the nearest epoch, no farther from it than `apart_s`."""
    at = pl.DataFrame({"t_ns": epochs.t_ns}).with_row_index("epoch")
    kept = (
        satellites.filter(pl.col("residual_m").is_not_null() & pl.col("used").fill_null(True))
        .unique(["t", "sv"], keep="first", maintain_order=True)
        .sort("t", maintain_order=True)
        .with_columns(t_ns=pl.col("t").to_physical())
        .join_asof(at, on="t_ns", strategy="nearest", tolerance=round(apart_s * NS_PER_S))
        .drop_nulls("epoch")
    )
    azimuth, elevation, stated = (floats(kept, name) for name in ("azimuth_deg", "elevation_deg", "sigma_m"))
    _, system = np.unique(kept["sv"].str.slice(0, 1).to_numpy(), return_inverse=True)
    return _Ranges(
        kept["epoch"].to_numpy().astype(np.int64),
        system,
        line_of_sight_rows(azimuth, elevation),
        kept["residual_m"].to_numpy(),
        np.where(np.isfinite(stated), stated**2, range_variances_m2(elevation).sum(axis=-1)),
    )


def _track_of(epochs: MatchedEpochs, config: Configuration) -> _TrackFrame:
    """Direction of the track at each epoch, and the offset of the position from it."""
    cross_m, vertical_m, survey_m = epochs.cross_track_m, epochs.vertical_m, epochs.survey_sigma_m
    angle = np.radians(epochs.heading_deg)
    rise = np.arctan(np.nan_to_num(epochs.slope))
    level = np.cos(rise)
    zero = np.zeros_like(angle)
    survey_m = np.where(np.isfinite(survey_m), survey_m, config.matching.survey_sigma_default_m)
    survey_m = np.hypot(
        np.maximum(survey_m, config.fix_sigma.digits_least_m), np.nan_to_num(epochs.interpolation_error_m)
    )
    matched = epochs.on_track & np.isfinite(cross_m) & np.isfinite(epochs.heading_deg)
    known = np.isfinite(vertical_m)
    left = np.stack([-np.cos(angle), np.sin(angle), zero], axis=-1)
    offset = cross_m[:, None] * left + np.where(known, vertical_m, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    return _TrackFrame(
        along=np.stack([level * np.sin(angle), level * np.cos(angle), np.sin(rise)], axis=-1),
        cross=left,
        offset_m=offset,
        sigma_m=survey_m,
        height_known=known,
        usable=matched & epochs.unambiguous,
        matched=matched,
    )


@frozen
class Equations:
    """The ranges of some epochs against a position on the track; shapes (epochs, satellites, ...).

    `rows`: change of range per metre east, north, up; `design`: what may be wrong (along, across, up, clocks) with
    `prior` as precision. `along` (epochs, 3): the track's direction.
    """

    epoch: Ints
    held: Bools
    rows: Floats
    clocks: Floats
    weight: Floats
    residual_m: Floats
    design: Floats
    prior: Floats
    freedom: Ints
    along: Floats


def equations_of(epochs: MatchedEpochs, satellites: pl.DataFrame, config: Configuration) -> Iterator[Equations]:
    """Some thousand epochs at once."""
    ranges = _ranges_by_epoch(epochs, satellites, config.monitors.satellite_stamp_s)
    return _chunks(ranges, _track_of(epochs, config))


def _chunks(ranges: _Ranges, track: _TrackFrame) -> Iterator[Equations]:
    """Equations of usable epochs with ranges, `BLOCK` at a time."""
    usable = np.flatnonzero(track.usable)
    chosen = usable[np.isin(usable, ranges.epoch)]
    for begin in range(0, chosen.size, BLOCK):
        yield _equations(ranges, track, chosen[begin : begin + BLOCK])


def _equations(ranges: _Ranges, track: _TrackFrame, epochs: Ints) -> Equations:
    """The ranges of these epochs, one slot per satellite; slots of epochs with fewer have weight 0 (not `held`)."""
    first = np.searchsorted(ranges.epoch, epochs)
    count = np.searchsorted(ranges.epoch, epochs, side="right") - first
    slot = np.arange(int(count.max()))
    held = slot < count[:, None]
    place = np.where(held, first[:, None] + slot, first[:, None])
    rows = ranges.rows[place]
    system = ranges.system[place]
    weight = np.where(held, 1.0 / ranges.variance_m2[place], 0.0)
    clocks = (system[:, :, None] == np.arange(ranges.systems)).astype(np.float64)
    # A receiver's residual is against its own position: moved onto the track by the offset.
    residual = ranges.residual_m[place] + np.einsum("eni,ei->en", rows, track.offset_m[epochs])
    along = np.einsum("eni,ei->en", rows, track.along[epochs])
    cross = np.einsum("eni,ei->en", rows, track.cross[epochs])
    design = np.concatenate([along[..., None], cross[..., None], rows[..., 2:], clocks], axis=-1)
    prior, free = _priors(track, epochs, (clocks * held[..., None]).any(axis=1))
    return Equations(epochs, held, rows, clocks, weight, residual, design, prior, count - free, track.along[epochs])


def _priors(track: _TrackFrame, epochs: Ints, present: Bools) -> tuple[Floats, Ints]:
    """Prior precision of along, cross, up and clocks [1/m^2], and how many of them are free.

    Along, clocks and, without heights in the survey, the height. A constellation without satellites gets a precision
    that keeps the equations solvable and changes nothing.
    """
    precision = 1.0 / track.sigma_m[epochs] ** 2
    height = np.where(track.height_known[epochs], precision, 0.0)
    prior = np.column_stack([np.zeros(epochs.size), precision, height, np.where(present, 0.0, 1.0)])
    free = 1 + present.sum(axis=1) + ~track.height_known[epochs]
    return prior, free


def _left_over(part: Equations) -> Floats:
    """Least weighted sum of squares over the unknowns, priors included."""
    right = np.einsum("eni,en->ei", part.design * part.weight[..., None], part.residual_m)
    solution = np.linalg.solve(normal_of(part.design, part.weight, part.prior), right[..., None])[..., 0]
    # r' W r - (A' W r)' x, with x of the normal equations N x = A' W r.
    total = np.einsum("en,en->e", part.weight, part.residual_m**2) - np.einsum("ei,ei->e", solution, right)
    return np.asarray(np.maximum(total, 0.0))


def normal_of(design: Floats, weight: Floats, prior: Floats) -> Floats:
    """Normal matrices A' W A + P of some epochs, shape (epochs, unknowns, unknowns).

    Args:
        design: A, shape (epochs, satellites, unknowns).
        weight: diagonal of W [1/m^2], shape (epochs, satellites).
        prior: diagonal of P [1/m^2], shape (epochs, unknowns).
    """
    normal = np.einsum("eni,enj->eij", design * weight[..., None], design)
    index = np.arange(prior.shape[1])
    normal[:, index, index] += prior
    # Badly placed satellites may leave a direction open; the ridge is far below any information in a range.
    normal[:, index, index] += _RIDGE * normal[:, index, index].max(axis=1, keepdims=True)
    return np.asarray(normal)
