"""What a receiver makes of the satellites over a place: positions of one or more solutions, and their ranges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from datasets.constellation import GALILEO, GPS, look_angles
from datasets.faults import NS_PER_S, FaultKind, FaultSpec, fault_offset_m, in_sector, is_active
from datasets.range_errors import range_errors_m, range_sigma_m
from datasets.scenario import SkySpec
from datasets.solution import PositionSolution, protection_levels, solve_positions
from schemas.arrays import Bools, Floats, Ints
from schemas.conform import conform
from schemas.frozen import frozen
from schemas.inputs import Satellites

_SLOTS = {"gps": GPS, "galileo": GALILEO}


@frozen
class ObservedSky:
    """One solution per epoch: error east, north, up with the covariance and protection levels stated for it."""

    solution: str
    error_m: Floats
    covariance_m2: Floats
    hpl_m: Floats
    vpl_m: Floats
    satellites: Ints | None
    lost: Bools


@frozen
class SimulatedRanges:
    """All satellites of the constellations in use, per epoch; `range_error_m` includes the faults."""

    svs: tuple[str, ...]
    azimuth_deg: Floats
    elevation_deg: Floats
    sigma_m: Floats
    range_error_m: Floats
    tracked: Bools


def observe_sky(
    spec: SkySpec,
    place: tuple[float, float, float],
    first_ns: int,
    t_ns: Ints,
    step_s: float,
    faults: Sequence[FaultSpec],
    rng: np.random.Generator,
) -> tuple[list[ObservedSky], pl.DataFrame | None]:
    """Solutions of the same ranges, and the `satellites` stream.

    The sky is that of `place` (latitude, longitude, height) all along: over a line of 30 km directions change
    by no more than a tenth of a degree. Residuals are measured minus computed at the published position.
    A satellite that comes or goes moves the position at once, as in a receiver that does not smooth; the raw
    monitors may see that as the step it is.
    """
    ranges = track_satellites(spec, place, first_ns, t_ns, step_s, faults, rng)
    observed = []
    tables = []
    for name, constellations in spec.solutions.items():
        initials = {_SLOTS[constellation][0].sv[0] for constellation in constellations}
        usable = ranges.tracked & np.array([sv[0] in initials for sv in ranges.svs])
        angles = (ranges.azimuth_deg, ranges.elevation_deg)
        solution = solve_positions(ranges.svs, *angles, ranges.sigma_m, ranges.range_error_m, usable, ranges.tracked)
        observed.append(_observed_sky(spec, name, solution))
        tables.append(_satellites_table(name, first_ns + t_ns, ranges, solution))
    stream = pl.concat(tables).sort("t", "solution", "sv", maintain_order=True) if spec.record_ranges else None
    return observed, stream


def track_satellites(
    spec: SkySpec,
    place: tuple[float, float, float],
    first_ns: int,
    t_ns: Ints,
    step_s: float,
    faults: Sequence[FaultSpec],
    rng: np.random.Generator,
) -> SimulatedRanges:
    """Directions and range errors of all satellites, with the faults that hit ranges."""
    used = sorted({name for names in spec.solutions.values() for name in names}, reverse=True)
    slots = [slot for name in used for slot in _SLOTS[name]]
    svs = tuple(slot.sv for slot in slots)
    azimuth, elevation = look_angles(slots, first_ns + t_ns, *place)
    errors = range_errors_m(spec.ranges, elevation, step_s, rng)
    tracked = elevation >= spec.mask_deg
    t_s = t_ns / NS_PER_S
    for fault in faults:
        if not fault.hits_ranges:
            continue
        hit = in_sector(fault, svs, azimuth, elevation)
        if fault.kind is FaultKind.OUTAGE:
            tracked = tracked & ~(hit & is_active(fault, t_s)[:, None])
        elif fault.kind is FaultKind.NOISE:
            noise = (fault.sigma_m or 0.0) * rng.standard_normal(errors.shape)
            errors = errors + np.where(hit & is_active(fault, t_s)[:, None], noise, 0.0)
        else:
            errors = errors + np.where(hit, fault_offset_m(fault, t_s, rng)[:, None], 0.0)
    sigma = range_sigma_m(spec.ranges, elevation)
    return SimulatedRanges(svs, azimuth, elevation, sigma, errors, tracked)


def _observed_sky(spec: SkySpec, name: str, solution: PositionSolution) -> ObservedSky:
    """Errors and protection levels as the receiver has them."""
    levels = protection_levels(solution.covariance_m2)
    horizontal = levels.hpl_pa_m if spec.protection == "pa" else levels.hpl_npa_m
    count = solution.used.sum(axis=1)
    error = np.where(solution.solved[:, None], solution.error_m, 0.0)
    return ObservedSky(name, error, solution.covariance_m2, horizontal, levels.vpl_m, count, ~solution.solved)


def _satellites_table(name: str, t_ns: Ints, ranges: SimulatedRanges, solution: PositionSolution) -> pl.DataFrame:
    """Residuals of the satellites tracked."""
    epoch, satellite = np.nonzero(ranges.tracked & np.isfinite(solution.residual_m))
    svs = np.array(ranges.svs)
    table = pl.DataFrame(
        {
            "t": t_ns[epoch],
            "sv": svs[satellite],
            "azimuth_deg": ranges.azimuth_deg[epoch, satellite],
            "elevation_deg": ranges.elevation_deg[epoch, satellite],
            "residual_m": solution.residual_m[epoch, satellite],
            "sigma_m": ranges.sigma_m[epoch, satellite],
            "used": solution.used[epoch, satellite],
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")), solution=pl.lit(name))
    return conform(table, Satellites)
