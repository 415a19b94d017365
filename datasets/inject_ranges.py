"""Faults in the ranges of single satellites of a recorded run.

A range error moves the published position and the residuals as the receiver's own weighted least squares
would: only the change is computed, so whatever else made the recorded position stays in it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.faults import NS_PER_S, FaultKind, FaultSpec, fault_offset_m, in_sector, is_active
from datasets.line import RailPlaces, shift_places
from datasets.solution import PositionSolution, protection_levels, solve_positions
from schemas.arrays import Bools, Floats
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog

_COVARIANCE = (("ee", 0, 0), ("en", 0, 1), ("eu", 0, 2), ("nn", 1, 1), ("nu", 1, 2), ("uu", 2, 2))


@frozen
class _RecordedRanges:
    """The recorded satellites of one solution as arrays of shape (epochs, satellites); NaN: not recorded."""

    t_ns: npt.NDArray[np.int64]
    svs: list[str]
    azimuth_deg: Floats
    elevation_deg: Floats
    sigma_m: Floats
    residual_m: Floats
    recorded: Bools
    used: Bools

    def solved(self, range_error_m: Floats, usable: Bools) -> PositionSolution:
        """The position errors that errors of ranges make, (epochs, satellites)."""
        angles = (np.nan_to_num(self.azimuth_deg), np.nan_to_num(self.elevation_deg))
        return solve_positions(self.svs, *angles, self.sigma_m, range_error_m, usable, self.recorded)


def inject_ranges(run: RunLog, fault: FaultSpec, first_ns: int, rng: np.random.Generator) -> RunLog:
    """The run with a step, bias, ramp or noise in ranges, or without satellites (outage)."""
    if run.satellites is None or run.satellites.is_empty():
        raise InputError("has no satellites stream for this fault", place=run.run_id, expected="a satellites stream")
    gnss = []
    satellites = []
    hit_any = False
    for solution in run.gnss["solution"].unique(maintain_order=True):
        fixes = run.gnss.with_row_index("row").filter(pl.col("solution") == solution)
        rows = run.satellites.with_row_index("row").filter(pl.col("solution") == solution)
        if fault.solution in (None, solution) and rows.height:
            fixes, rows, hit = _solution_with_fault(fixes, rows, fault, first_ns, rng)
            hit_any |= hit
        gnss.append(fixes)
        satellites.append(rows)
    if not hit_any:
        expected = f"{fault.target} recorded at that time"
        raise InputError("has no satellite for this fault", place=run.run_id, expected=expected)
    others = run.satellites.with_row_index("row").filter(~pl.col("solution").is_in(run.gnss["solution"].unique()))
    return run.with_streams(
        gnss=pl.concat(gnss).sort("row").drop("row"),
        satellites=pl.concat([*satellites, others]).sort("row").drop("row"),
    )


def _solution_with_fault(
    fixes: pl.DataFrame, rows: pl.DataFrame, fault: FaultSpec, first_ns: int, rng: np.random.Generator
) -> tuple[pl.DataFrame, pl.DataFrame, bool]:
    """Positions and residuals of one solution with a fault of satellites."""
    ranges = _recorded_arrays(rows)
    t_s = (ranges.t_ns - first_ns) / NS_PER_S
    hit = in_sector(fault, ranges.svs, ranges.azimuth_deg, ranges.elevation_deg) & ranges.recorded
    profile = _range_errors_m(fault, t_s, hit.shape, rng)
    lost = hit & is_active(fault, t_s)[:, None] & (fault.kind is FaultKind.OUTAGE)
    error = np.where(hit, profile, 0.0)
    touched = (error != 0.0).any(axis=1) | lost.any(axis=1)
    residual = np.nan_to_num(ranges.residual_m)
    before = ranges.solved(residual, ranges.used)
    after = ranges.solved(residual + error, ranges.used & ~lost)
    _require_solved(fixes, ranges, touched & ~before.solved)
    new_residual = np.where(touched[:, None], after.residual_m + (residual - before.residual_m), ranges.residual_m)
    new_residual = np.where(np.isnan(ranges.residual_m), np.nan, new_residual)
    moved = _move_positions(fixes, ranges, before, after, touched)
    return moved, _satellite_rows(rows, ranges, new_residual, lost), bool(touched.any())


def _range_errors_m(fault: FaultSpec, t_s: Floats, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """Range errors that a fault makes [m], broadcast to (epochs, satellites)."""
    if fault.kind is FaultKind.OUTAGE:
        return np.zeros(shape)
    if fault.kind is FaultKind.NOISE:
        return np.where(is_active(fault, t_s)[:, None], (fault.sigma_m or 0.0) * rng.standard_normal(shape), 0.0)
    return np.broadcast_to(fault_offset_m(fault, t_s, rng)[:, None], shape)


def _recorded_arrays(rows: pl.DataFrame) -> _RecordedRanges:
    """Residuals by epoch and satellite."""
    t_ns, epoch = np.unique(rows["t"].to_physical().to_numpy(), return_inverse=True)
    svs = sorted(rows["sv"].unique().to_list())
    satellite = np.searchsorted(svs, rows["sv"].to_list())

    def matrix(name: str, empty: float) -> Floats:
        """A column as (epochs, satellites), with `empty` where nothing is recorded."""
        values = np.full((t_ns.size, len(svs)), empty)
        values[epoch, satellite] = rows[name].to_numpy().astype(np.float64)
        return values

    sigma = matrix("sigma_m", np.nan)
    # Where a receiver states no sigma for some satellite of an epoch, all of the epoch weigh the same.
    used = matrix("used", 0.0) == 1.0
    unweighted = (used & ~np.isfinite(sigma)).any(axis=1)
    sigma = np.where(unweighted[:, None] | ~np.isfinite(sigma), 1.0, sigma)
    recorded = np.isfinite(matrix("azimuth_deg", np.nan))
    angles = (matrix("azimuth_deg", np.nan), matrix("elevation_deg", np.nan))
    return _RecordedRanges(t_ns, svs, *angles, sigma, matrix("residual_m", np.nan), recorded, used)


def _require_solved(fixes: pl.DataFrame, ranges: _RecordedRanges, unsolved: Bools) -> None:
    """A position whose recorded satellites are too few cannot be moved by one of them."""
    stamps = ranges.t_ns[unsolved]
    known = fixes.filter(pl.col("latitude_deg").is_not_null())["t"].to_physical().to_numpy()
    bad = np.intersect1d(stamps, known)
    if bad.size:
        raise InputError(
            "too few satellites are recorded to put a range fault into a position",
            place="satellites",
            found=f"{bad.size} epochs, the first {(bad[0] - ranges.t_ns[0]) / NS_PER_S:.1f} s after the first",
            expected="at least 3 and one per constellation",
        )


def _move_positions(
    fixes: pl.DataFrame, ranges: _RecordedRanges, before: PositionSolution, after: PositionSolution, touched: Bools
) -> pl.DataFrame:
    """Positions, covariances, protection levels and satellites used of touched epochs; those without solution go."""
    stamps = fixes["t"].to_physical().to_numpy()
    place = np.searchsorted(ranges.t_ns, stamps).clip(max=ranges.t_ns.size - 1)
    here = (ranges.t_ns[place] == stamps) & touched[place]
    step = np.where(here[:, None], np.nan_to_num(after.error_m[place] - before.error_m[place]), 0.0)
    fewer = (before.used.sum(axis=1) - after.used.sum(axis=1))[place] * here
    wider = np.nan_to_num(after.covariance_m2[place] - before.covariance_m2[place]) * here[:, None, None]
    latitude, longitude, height = (
        fixes[name].to_numpy().astype(np.float64) for name in ("latitude_deg", "longitude_deg", "height_m")
    )
    nothing = np.zeros(0)
    places = shift_places(RailPlaces(latitude, longitude, np.nan_to_num(height), nothing, nothing), *step.T)
    columns = {
        "latitude_deg": places.latitude_deg,
        "longitude_deg": places.longitude_deg,
        "height_m": height + step[:, 2],
        **{f"cov_{n}_m2": fixes[f"cov_{n}_m2"].to_numpy() + wider[:, i, j] for n, i, j in _COVARIANCE},
        **_protection_levels(fixes, before, after, place, here),
    }
    series = [pl.Series(name, values, nan_to_null=True) for name, values in columns.items()]
    counted = (pl.col("satellites") - pl.Series(fewer)).clip(lower_bound=0)
    return fixes.with_columns(*series, satellites=counted).filter(pl.Series(~(here & ~after.solved[place])))


def _protection_levels(
    fixes: pl.DataFrame, before: PositionSolution, after: PositionSolution, place: npt.NDArray[np.int64], here: Bools
) -> dict[str, Floats]:
    """Recorded protection levels grow as those of the geometry do."""
    old = protection_levels(before.covariance_m2[place])
    new = protection_levels(after.covariance_m2[place])
    horizontal = np.where(here & after.solved[place], new.hpl_npa_m / old.hpl_npa_m, 1.0)
    vertical = np.where(here & after.solved[place], new.vpl_m / old.vpl_m, 1.0)
    return {
        "hpl_m": fixes["hpl_m"].to_numpy().astype(np.float64) * horizontal,
        "vpl_m": fixes["vpl_m"].to_numpy().astype(np.float64) * vertical,
    }


def _satellite_rows(rows: pl.DataFrame, ranges: _RecordedRanges, residual_m: Floats, lost: Bools) -> pl.DataFrame:
    """Rows of satellites with new residuals, without those lost."""
    epoch = np.searchsorted(ranges.t_ns, rows["t"].to_physical().to_numpy())
    satellite = np.searchsorted(ranges.svs, rows["sv"].to_list())
    new = pl.Series("residual_m", residual_m[epoch, satellite], nan_to_null=True)
    return rows.with_columns(new).filter(pl.Series(~lost[epoch, satellite]))
