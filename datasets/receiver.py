"""The `gnss` and `reference` streams of a journey."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.faults import NS_PER_S, FaultSpec, PositionEffect, position_effect
from datasets.gnss_errors import position_errors
from datasets.line import LineAxis, RailPlaces, offset_places, shift_places
from datasets.motion import Motion
from datasets.odometer import sample_times_ns
from datasets.scenario import GnssSpec, ReferenceSpec
from datasets.sky import ObservedSky, observe_sky
from datasets.solution import protection_levels
from schemas.arrays import Floats
from schemas.config import Vehicle
from schemas.conform import conform
from schemas.enums import Fix
from schemas.frozen import frozen
from schemas.inputs import Gnss, Reference

# The SBAS satellite that the synthetic receiver uses, and the age of what it sends.
_SBAS_PRN = 123
_SBAS_AGE_S = 3.0
_MARGIN_S = 1.0
_COVARIANCES = (
    ("cov_ee_m2", 0, 0),
    ("cov_en_m2", 0, 1),
    ("cov_eu_m2", 0, 2),
    ("cov_nn_m2", 1, 1),
    ("cov_nu_m2", 1, 2),
    ("cov_uu_m2", 2, 2),
)
_VELOCITIES = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
_LEVELS = ("hpl_m", "vpl_m")


@frozen
class TrainOnLine:
    """One train on its line: where its GNSS antenna is at any time."""

    line: LineAxis
    motion: Motion
    vehicle: Vehicle

    def antenna_places(self, t_s: Floats, ahead_m: Floats | float = 0.0, left_m: Floats | float = 0.0) -> RailPlaces:
        """Antenna places; `ahead_m` follows the track towards the leading end, `left_m` is left of that end."""
        lever_m = self.vehicle.gnss_antenna_ahead_m + ahead_m
        rail = self.line.places_at(self.motion.chainage_m(t_s) + self.motion.sign * lever_m)
        over_ground = offset_places(rail, self.motion.sign * left_m)
        zeros = np.zeros(t_s.size)
        return shift_places(over_ground, zeros, zeros, zeros + self.vehicle.antenna_height_m)


def gnss_streams(
    spec: GnssSpec, journey: TrainOnLine, faults: Sequence[FaultSpec], first_ns: int, rng: np.random.Generator
) -> tuple[pl.DataFrame, pl.DataFrame | None]:
    """The `gnss` stream, and `satellites` where the errors come from geometry; displaced and thinned by faults."""
    t_ns = sample_times_ns(journey.motion.duration_s, spec.rate_hz)
    if spec.sky is None:
        observed = [_observe_without_sky(spec, t_ns.size, rng)]
        ranges = None
    else:
        start = journey.antenna_places(np.zeros(1))
        place = (float(start.latitude_deg[0]), float(start.longitude_deg[0]), float(start.height_m[0]))
        observed, ranges = observe_sky(spec.sky, place, first_ns, t_ns, 1.0 / spec.rate_hz, faults, rng)
    velocity_rng = rng.spawn(1)[0]
    tables = [_solution_table(spec, journey, faults, first_ns, t_ns, one, rng, velocity_rng) for one in observed]
    return pl.concat(tables).sort("t", "solution", maintain_order=True), ranges


def _observe_without_sky(spec: GnssSpec, epochs: int, rng: np.random.Generator) -> ObservedSky:
    """Position errors without satellites."""
    sigmas = (spec.sigma_east_m, spec.sigma_north_m, spec.sigma_up_m)
    covariance = np.broadcast_to(np.diag(np.square(sigmas)), (epochs, 3, 3))
    satellites = None if spec.satellites is None else np.full(epochs, spec.satellites)
    errors = position_errors(sigmas, epochs, 1.0 / spec.rate_hz, rng)
    levels = protection_levels(covariance)
    return ObservedSky(
        "primary", errors, covariance, levels.hpl_npa_m, levels.vpl_m, satellites, np.zeros(epochs, dtype=np.bool_)
    )


def _solution_table(
    spec: GnssSpec,
    journey: TrainOnLine,
    faults: Sequence[FaultSpec],
    first_ns: int,
    t_ns: npt.NDArray[np.int64],
    observed: ObservedSky,
    rng: np.random.Generator,
    velocity_rng: np.random.Generator,
) -> pl.DataFrame:
    """Positions of one solution."""
    t_s = t_ns / NS_PER_S
    own = [fault for fault in faults if fault.solution in (None, observed.solution)]
    effect = position_effect(own, t_s, rng)
    bias = np.array([spec.bias_east_m, spec.bias_north_m, spec.bias_up_m])
    old_s = t_s - spec.latency_s - effect.latency_s
    rail = journey.antenna_places(old_s, effect.along_m, effect.cross_m)
    places = displace(rail, effect, observed.error_m + bias)
    velocity = _reported_velocity(spec, journey, old_s, velocity_rng)
    return _gnss_table(spec, first_ns + t_ns, places, velocity, observed, effect.lost | observed.lost)


def displace(places: RailPlaces, effect: PositionEffect, errors_m: Floats) -> RailPlaces:
    """Places with errors and the part of the faults that does not follow the track."""
    east, north, up = errors_m.T
    return shift_places(places, east + effect.east_m, north + effect.north_m, up + effect.up_m)


def reference_stream(
    spec: ReferenceSpec, journey: TrainOnLine, first_ns: int, rng: np.random.Generator
) -> pl.DataFrame:
    """The truth, at its own rate and with its own small noise.

    It begins and ends a second beyond the receiver's recording: late positions are of times before their stamps.
    """
    t_ns = sample_times_ns(journey.motion.duration_s + 2.0 * _MARGIN_S, spec.rate_hz) - round(_MARGIN_S * NS_PER_S)
    noise = spec.sigma_m * rng.standard_normal((3, t_ns.size))
    places = shift_places(journey.antenna_places(t_ns / NS_PER_S), *noise)
    table = pl.DataFrame(
        {
            "t": first_ns + t_ns,
            "latitude_deg": places.latitude_deg,
            "longitude_deg": places.longitude_deg,
            "height_m": places.height_m,
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")), sigma_m=pl.lit(spec.sigma_m))
    return conform(table, Reference)


def true_velocity(journey: TrainOnLine, t_s: Floats) -> Floats:
    """Velocity east, north, up [m/s], shape (epochs, 3)."""
    places = journey.antenna_places(t_s)
    speed = journey.motion.sign * journey.motion.speed_mps(t_s)
    heading = np.radians(places.heading_deg)
    angle = np.arctan(places.slope)
    level = speed * np.cos(angle)
    return np.column_stack([level * np.sin(heading), level * np.cos(heading), speed * np.sin(angle)])


def _reported_velocity(spec: GnssSpec, journey: TrainOnLine, t_s: Floats, rng: np.random.Generator) -> Floats | None:
    """Velocities that a receiver reports, if it does."""
    noise = spec.velocity_sigma_mps * rng.standard_normal((t_s.size, 3))
    return true_velocity(journey, t_s) + noise if spec.velocity else None


def _gnss_table(
    spec: GnssSpec,
    t_ns: npt.NDArray[np.int64],
    places: RailPlaces,
    velocity: Floats | None,
    observed: ObservedSky,
    lost: npt.NDArray[np.bool_],
) -> pl.DataFrame:
    """The stream `gnss` of one solution."""
    unknown = np.full(t_ns.size, np.nan)
    covariance = spec.reported_factor**2 * observed.covariance_m2
    levels = [spec.reported_factor * level for level in (observed.hpl_m, observed.vpl_m)]
    values = {
        "latitude_deg": places.latitude_deg,
        "longitude_deg": places.longitude_deg,
        "height_m": places.height_m,
        **{name: covariance[:, i, j] if spec.covariance else unknown for name, i, j in _COVARIANCES},
        **dict(zip(_VELOCITIES, [unknown] * 3 if velocity is None else velocity.T, strict=True)),
        **dict(zip(_LEVELS, levels if spec.protection_levels else [unknown] * 2, strict=True)),
    }
    columns = {name: pl.Series(np.where(lost, np.nan, value), nan_to_null=True) for name, value in values.items()}
    by_sbas = pl.lit(spec.fix is Fix.SBAS) & ~pl.col("lost")
    table = (
        pl.DataFrame({"t": t_ns, "lost": lost, **columns})
        .with_columns(
            t=pl.col("t").cast(pl.Datetime("ns", "UTC")),
            solution=pl.lit(observed.solution),
            fix=pl.when("lost").then(pl.lit(Fix.NONE.value)).otherwise(pl.lit(spec.fix.value)),
            satellites=pl.lit(None, pl.Int64) if observed.satellites is None else pl.Series(observed.satellites),
            sbas_prn=pl.when(by_sbas).then(_SBAS_PRN),
            sbas_age_s=pl.when(by_sbas).then(_SBAS_AGE_S),
        )
        .filter(~pl.col("lost") | pl.lit(spec.keep_lost))
    )
    return conform(table, Gnss)
