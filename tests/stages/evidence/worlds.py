"""Small worlds for the evidence: a train's true way over tracks in a plane, and what its recorders write of it.

Nothing here shares anything with the program but the frames of the contract and the plane of `tests.stages.matching`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.stages.evidence import EvidenceSet, TrainEvidence, evidence_of
from pipeline.stages.evidence.anchors import read_anchors
from pipeline.stages.odometry import odometry_of
from pipeline.stages.reference import reference_stretches
from pipeline.stages.track.network import network_in_pieces, site_network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.run import Site
from tests.stages.matching.builders import line, site
from tests.stages.matching.ladder import degrees
from tests.tables import WHEEL

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 100.0
KNOWN = Vehicle(odometer_scale=1.0, odometer_scale_sigma=2e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002)


def ns(t_s: Floats | Sequence[float]) -> Ints:
    return START_NS + np.round(np.asarray(t_s, dtype=float) * 1e9).astype(np.int64)


def stamps(t_s: Floats) -> pl.Series:
    return pl.Series("t", ns(t_s)).cast(pl.Datetime("ns", "UTC"))


@dataclass(frozen=True)
class Ride:
    """True way along the x axis over time [m]."""

    knots_s: tuple[float, ...]
    speeds_mps: tuple[float, ...]
    from_m: float = 100.0
    t_s: Floats = field(init=False)
    x_m: Floats = field(init=False)

    def __post_init__(self) -> None:
        t_s = np.arange(self.knots_s[0], self.knots_s[-1], 1.0 / RATE_HZ)
        speed = np.interp(t_s, self.knots_s, self.speeds_mps)
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "x_m", self.from_m + np.concatenate([[0.0], np.cumsum(speed[:-1]) / RATE_HZ]))

    def at(self, t_s: Floats) -> Floats:
        return np.interp(t_s, self.t_s, self.x_m)


def wavy(top_mps: float, length_s: float = 400.0, from_m: float = 100.0) -> Ride:
    """Speeds between a third of the top and the top, so that clocks can be compared."""
    inner = np.arange(20.0, length_s - 20.0, 40.0)
    speeds = [top_mps if number % 2 else top_mps / 3.0 for number in range(inner.size)]
    return Ride((0.0, *inner.tolist(), length_s), (0.0, *speeds, 0.0), from_m)


def reference(
    ride: Ride,
    rng: np.random.Generator,
    sigma_m: float = 0.05,
    rate_hz: float = 10.0,
    late_s: float = 0.0,
    ahead_m: Floats | None = None,
    aside_m: float = 0.0,
) -> pl.DataFrame:
    """Places of the train; the stamps are `late_s` late. `ahead_m`: what each sample is off along the track; `aside_m`:
    all of them across it.
    """
    t_s = np.arange(ride.t_s[0], ride.t_s[-1] - 1.0, 1.0 / rate_hz)
    noise = sigma_m * np.clip(rng.standard_normal((2, t_s.size)), -2.5, 2.5)
    off_m = 0.0 if ahead_m is None else np.interp(t_s, np.arange(ahead_m.size) / rate_hz, ahead_m)
    latitude, longitude = degrees(ride.at(t_s) + noise[0] + off_m, noise[1] + aside_m)
    unknown = pl.Series("height_m", [None] * t_s.size, dtype=pl.Float64)
    columns = [stamps(t_s + late_s), pl.Series("latitude_deg", latitude), pl.Series("longitude_deg", longitude)]
    return pl.DataFrame([*columns, unknown, pl.Series("sigma_m", np.full(t_s.size, sigma_m))])


def odometer(ride: Ride, rng: np.random.Generator, lost_m: Floats | None = None, rate_hz: float = 10.0) -> pl.DataFrame:
    """Counted distance; `lost_m`: what has been lost at each instant of the ride."""
    t_s = np.arange(ride.t_s[0], ride.t_s[-1], 1.0 / rate_hz)
    walk = np.cumsum(0.02 * np.sqrt(1.0 / rate_hz) * rng.standard_normal(t_s.size))
    lost = 0.0 if lost_m is None else np.interp(t_s, ride.t_s, lost_m)
    nothing = pl.lit(None, dtype=pl.Float64)
    frame = pl.DataFrame([stamps(t_s), pl.Series("distance_m", ride.at(t_s) - ride.from_m + walk - lost)])
    return frame.with_columns(WHEEL, speed_mps=nothing, sigma_speed_mps=nothing, slip=pl.lit(None, dtype=pl.Boolean))


def balises(ground: Site, every_m: float = 500.0) -> Site:
    """Physical balises P0, P1, ... on element `a`."""
    high = float(ground.track.filter(pl.col("netelement_id") == "a")["measure_m"].max())  # type: ignore[arg-type]
    measures = np.arange(200.0, high, every_m)
    frame = pl.DataFrame({"balise_id": [f"P{number}" for number in range(measures.size)], "measure_m": measures})
    return Site(ground.track, ground.links, frame.with_columns(netelement_id=pl.lit("a"), kind=pl.lit("physical")))


def reads(
    ride: Ride, ground: Site, rng: np.random.Generator, late_s: float = 0.0, sigma_m: float = 0.5
) -> pl.DataFrame:
    """A read as the train passes each balise."""
    assert ground.balises is not None
    rows = ground.balises.filter(pl.col("measure_m").is_between(ride.x_m[0] + 1.0, ride.x_m[-1] - 1.0))
    off_m = sigma_m * np.clip(rng.standard_normal(rows.height), -2.5, 2.5)
    t_s = np.interp(rows["measure_m"].to_numpy() + off_m, ride.x_m, ride.t_s)
    return pl.DataFrame([stamps(t_s + late_s), rows["balise_id"]])


def straight(length_m: float = 40_000.0) -> Site:
    """One track along the x axis, its measure the coordinate."""
    return balises(site({"a": line((0.0, 0.0), (length_m, 0.0), 1000.0)}))


def known(
    ground: Site,
    *odometers: pl.DataFrame,
    of_reference: pl.DataFrame | None = None,
    of_reads: pl.DataFrame | None = None,
    vehicle: Vehicle = KNOWN,
    config: Configuration | None = None,
) -> TrainEvidence:
    config = config or Configuration()
    network = site_network(ground)
    stretches = reference_stretches(of_reference, network_in_pieces(ground), network.track.index, config)
    made = [odometry_of(one, vehicle if not number else Vehicle(), config) for number, one in enumerate(odometers)]
    counters = [one for one in made if one is not None]
    reads = read_anchors(of_reads, ground.balises, network.track, config.hazards)
    return evidence_of(stretches, [reads], counters, network, vehicle, config)


def bounds(found: EvidenceSet, x_m: Floats) -> tuple[Floats, Floats, Bools]:
    """Least and largest true x on element 0 that the evidence leaves, and whether some alternative holds the truth."""
    low, high = np.full(x_m.size, np.inf), np.full(x_m.size, -np.inf)
    holds = np.zeros(x_m.size, dtype=np.bool_)
    for one in found.alternatives:
        ends = np.stack([one.route.locate(at_m)[1] for at_m in (one.low_m, one.high_m)])
        low[one.rows] = np.minimum(low[one.rows], ends.min(axis=0))
        high[one.rows] = np.maximum(high[one.rows], ends.max(axis=0))
        holds[one.rows] |= (ends.min(axis=0) <= x_m[one.rows]) & (x_m[one.rows] <= ends.max(axis=0))
    return low, high, holds
