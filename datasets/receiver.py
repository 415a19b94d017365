"""The `gnss` and `reference` streams of a journey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.faults import NS_PER_S, FaultSpec, PositionEffect, position_effect
from datasets.gnss_errors import position_errors
from datasets.line import Line, Places, offset_places, shifted
from datasets.motion import Motion
from datasets.odometer import sample_times_ns
from datasets.scenario import GnssSpec, ReferenceSpec
from schemas.config import Vehicle
from schemas.enums import Fix
from schemas.inputs import Gnss, Reference

Floats = npt.NDArray[np.float64]

# DO-229 J.1: HPL factor for non-precision approach and VPL factor.
_K_H_NPA = 6.18
_K_V = 5.33
# The SBAS satellite that the synthetic receiver uses, and the age of what it sends.
_SBAS_PRN = 123
_SBAS_AGE_S = 3.0


@dataclass(frozen=True)
class Journey:
    """One train on its line: where its GNSS antenna is at any time."""

    line: Line
    motion: Motion
    vehicle: Vehicle

    def antenna(self, t_s: Floats, ahead_m: Floats | float = 0.0, left_m: Floats | float = 0.0) -> Places:
        """Antenna places; `ahead_m` follows the track towards the leading end, `left_m` is left of that end."""
        lever_m = self.vehicle.gnss_antenna_ahead_m + ahead_m
        rail = self.line.at(self.motion.chainage_m(t_s) + self.motion.sign * lever_m)
        beside = offset_places(rail, self.motion.sign * left_m)
        zeros = np.zeros(t_s.size)
        return shifted(beside, zeros, zeros, zeros + self.vehicle.antenna_height_m)


def gnss_stream(
    spec: GnssSpec, journey: Journey, faults: Sequence[FaultSpec], first_ns: int, rng: np.random.Generator
) -> pl.DataFrame:
    """Positions with correlated errors of known covariance, displaced by faults; lost epochs have no row."""
    t_ns = sample_times_ns(journey.motion.duration_s, spec.rate_hz)
    t_s = t_ns / NS_PER_S
    effect = position_effect(faults, t_s, rng)
    sigmas = (spec.sigma_east_m, spec.sigma_north_m, spec.sigma_up_m)
    bias = np.array([spec.bias_east_m, spec.bias_north_m, spec.bias_up_m])
    errors = bias + position_errors(sigmas, t_s.size, 1.0 / spec.rate_hz, rng)
    old_s = t_s - spec.latency_s - effect.latency_s
    places = displaced(journey.antenna(old_s, effect.along_m, effect.cross_m), effect, errors)
    velocity = _velocity(spec, journey, old_s, rng)
    return _table(spec, first_ns + t_ns, places, velocity).filter(pl.Series(~effect.lost))


def displaced(places: Places, effect: PositionEffect, errors_m: Floats) -> Places:
    """Places with errors and the part of the faults that does not follow the track."""
    east, north, up = errors_m.T
    return shifted(places, east + effect.east_m, north + effect.north_m, up + effect.up_m)


def reference_stream(spec: ReferenceSpec, journey: Journey, first_ns: int, rng: np.random.Generator) -> pl.DataFrame:
    """The truth, at its own rate and with its own small noise."""
    t_ns = sample_times_ns(journey.motion.duration_s, spec.rate_hz)
    noise = spec.sigma_m * rng.standard_normal((3, t_ns.size))
    places = shifted(journey.antenna(t_ns / NS_PER_S), *noise)
    table = pl.DataFrame(
        {
            "t": first_ns + t_ns,
            "latitude_deg": places.latitude_deg,
            "longitude_deg": places.longitude_deg,
            "height_m": places.height_m,
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")), sigma_m=pl.lit(spec.sigma_m))
    return Reference.validate(table, cast=True)


def true_velocity(journey: Journey, t_s: Floats) -> Floats:
    """Velocity east, north, up [m/s], shape (epochs, 3)."""
    places = journey.antenna(t_s)
    speed = journey.motion.sign * journey.motion.speed_mps(t_s)
    heading, angle = np.radians(places.heading_deg), np.arctan(places.slope)
    level = speed * np.cos(angle)
    return np.column_stack([level * np.sin(heading), level * np.cos(heading), speed * np.sin(angle)])


def _velocity(spec: GnssSpec, journey: Journey, t_s: Floats, rng: np.random.Generator) -> Floats | None:
    noise = spec.velocity_sigma_mps * rng.standard_normal((t_s.size, 3))
    return true_velocity(journey, t_s) + noise if spec.velocity else None


def _table(spec: GnssSpec, t_ns: npt.NDArray[np.int64], places: Places, velocity: Floats | None) -> pl.DataFrame:
    unknown = pl.lit(None, pl.Float64)
    stated = np.array([spec.sigma_east_m, spec.sigma_north_m, spec.sigma_up_m]) * spec.reported_factor
    variances = [pl.lit(float(sigma**2)) if spec.covariance else unknown for sigma in stated]
    covariances = [pl.lit(0.0) if spec.covariance else unknown] * 3
    speeds = [unknown] * 3 if velocity is None else [pl.lit(pl.Series(column)) for column in velocity.T]
    levels = (_K_H_NPA * max(stated[:2]), _K_V * stated[2]) if spec.protection_levels else (None, None)
    sbas = spec.fix is Fix.SBAS
    table = pl.DataFrame({"t": t_ns}).with_columns(
        t=pl.col("t").cast(pl.Datetime("ns", "UTC")),
        solution=pl.lit("primary"),
        latitude_deg=pl.Series(places.latitude_deg),
        longitude_deg=pl.Series(places.longitude_deg),
        height_m=pl.Series(places.height_m),
        **_named(("cov_ee_m2", "cov_nn_m2", "cov_uu_m2"), variances),
        **_named(("cov_en_m2", "cov_eu_m2", "cov_nu_m2"), covariances),
        **_named(("vel_e_mps", "vel_n_mps", "vel_u_mps"), speeds),
        hpl_m=pl.lit(levels[0], pl.Float64),
        vpl_m=pl.lit(levels[1], pl.Float64),
        fix=pl.lit(spec.fix.value),
        satellites=pl.lit(spec.satellites, pl.Int64),
        sbas_prn=pl.lit(_SBAS_PRN if sbas else None, pl.Int64),
        sbas_age_s=pl.lit(_SBAS_AGE_S if sbas else None, pl.Float64),
    )
    return Gnss.validate(table, cast=True)


def _named(names: tuple[str, ...], values: Sequence[pl.Expr]) -> dict[str, pl.Expr]:
    return dict(zip(names, values, strict=True))
