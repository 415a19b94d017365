"""What a return costs: slow drifts of the position, and how long they are in use beyond the failure limit after it; and
how long sound positions are out of use again after a jump or an outage.

The noise is made here and shares nothing with the generator of synthetic trials: Gauss-Markov errors of the position
with the shares and times of DIAG Table 1, an odometer with a random walk of 0.05 m over one second and a scale error
of 1e-4 that the vehicle file knows no better. The track is the equator, so path position is radius times longitude.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import dataframely as dy
import numpy as np
import polars as pl

from benchmarks.results import Figure
from pipeline.stages.alignment.align import align
from pipeline.stages.lds import LdsResult, run_lds
from pipeline.stages.lds.link_monitors import Relink
from pipeline.stages.matching import match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry import odometry_of
from schemas.arrays import NS_PER_S, Floats
from schemas.config import Configuration, LdsConfig, Vehicle
from schemas.conform import shaped
from schemas.inputs import Balises, Gnss, Links, Odometer, Track
from schemas.run import RunLog, Site
from schemas.stages import AlignedEpochs

CASES = 50
# Sound journeys with one jump of 3 s, and with one outage of 90 s, in the middle of 2,400 s.
JUMPED, INTERRUPTED = 24, 40
RADIUS_M = 6_378_137.0
SPEED_MPS = 30.0
SCALE_SIGMA = 1e-4
LIMIT_M = 20.0
SIZE_M = 40.0
# DIAG Table 1: share of the variance and correlation time [s] of ionosphere, troposphere, orbit and clock, user.
SOURCES = ((0.083, 360.0), (0.014, 1800.0), (0.150, 3600.0), (0.752, 100.0))


@dataclass(frozen=True)
class Journey:
    """A run on the equator and what the generator knows: the train's path positions at each epoch, and the drift."""

    run: RunLog
    site: Site
    vehicle: Vehicle
    true_m: Floats
    drift_mps: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """One run: was the position negated, did it return, and how long was it in use beyond the limit afterwards [s]."""

    drift_mps: float
    negated: bool
    returned: bool
    beyond_s: float


def ramp(seed: int, sigma_m: float) -> Journey:
    """A drift of 0.01 to 0.1 m/s, either way, to 40 m, between 600 and 1,200 s after the start."""
    dice = np.random.default_rng(seed)
    rate_mps = dice.uniform(0.01, 0.1) * float(dice.choice([-1.0, 1.0]))
    onset_s = dice.uniform(600.0, 1_200.0)
    t_s = np.arange(onset_s + SIZE_M / abs(rate_mps) + 600.0)
    drift_m = np.clip(rate_mps * np.maximum(t_s - onset_s, 0.0), -SIZE_M, SIZE_M)
    return replace(journey(dice, t_s, drift_m, sigma_m), drift_mps=rate_mps)


def sound(seed: int, sigma_m: float, jump: bool) -> Journey:
    """Healthy but for a jump of 40 m for 3 s, or an outage of 90 s, after 800 s of 2,400 s."""
    t_s = np.arange(2_400.0)
    event = (t_s >= 800.0) & (t_s < 800.0 + (3.0 if jump else 90.0))
    fault_m = np.where(event, SIZE_M if jump else np.nan, 0.0)
    return journey(np.random.default_rng([seed, 7]), t_s, fault_m, sigma_m)


def journey(dice: np.random.Generator, t_s: Floats, fault_m: Floats, sigma_m: float) -> Journey:
    """Steady at 30 m/s; `fault_m` is added along the track at each epoch (NaN: no position)."""
    true_m = 200.0 + SPEED_MPS * t_s
    east_m = true_m + fault_m + _gauss_markov(dice, t_s, sigma_m)
    north_m, up_m = _gauss_markov(dice, t_s, sigma_m), _gauss_markov(dice, t_s, 1.5 * sigma_m)
    lost = np.isnan(fault_m)
    gnss = pl.DataFrame(
        {
            "t": _instants(t_s),
            "solution": "primary",
            "latitude_deg": np.degrees(north_m / (RADIUS_M * (1.0 - 6.694_379_990_14e-3))),
            "longitude_deg": np.degrees(east_m / RADIUS_M),
            "height_m": 100.0 + up_m,
            "cov_ee_m2": sigma_m**2,
            "cov_nn_m2": sigma_m**2,
            "cov_uu_m2": (1.5 * sigma_m) ** 2,
            "cov_en_m2": 0.0,
            "fix": "autonomous",
        }
    ).filter(~lost)
    run = RunLog("drift", _stream(gnss, Gnss), _odometer(dice, float(t_s[-1])))
    vehicle = Vehicle(
        odometer_scale=1.0, odometer_scale_sigma=SCALE_SIGMA, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002
    )
    return Journey(run, _site(float(true_m[-1]) + 2_000.0), vehicle, true_m[~lost])


def lds_of(made: Journey, config: Configuration, vehicle: Vehicle | None = None) -> tuple[AlignedEpochs, LdsResult]:
    """Aligned epochs and what the LDS makes of them; `vehicle` stands in for that of the journey."""
    vehicle = vehicle or made.vehicle
    run, site = made.run, made.site
    odometry = odometry_of(run.odometer, vehicle, config)
    found = match(run.gnss, odometry, site, vehicle, config.matching, config.fix_sigma, None)
    along = None if odometry is None else odometry.growing_along_path(found.odometer_sign)
    aligned = align(found.epochs, along, vehicle, config)
    bank = MonitorBank(aligned, {}, config)
    scale_sigma = None if odometry is None else odometry.scale_sigma
    return aligned, run_lds(aligned, bank, found.path.balises_on_path(site.balises), None, scale_sigma, config)


def outcome(made: Journey, config: Configuration) -> Outcome:
    """Replay the positions and hold those in use against the train's own path positions."""
    aligned, lds = lds_of(made, config)
    path_m = aligned.path_m
    error_m = np.abs(path_m - made.true_m - np.median(path_m[:300] - made.true_m[:300]))
    negated = lds.epochs.negated
    withheld = lds.epochs.withheld
    in_use = ~negated & ~withheld & (aligned.confidence_m <= config.lds.ci_limit_m)
    returns = np.flatnonzero(negated[:-1] & ~negated[1:]) + 1
    after = np.arange(path_m.size) >= (returns[0] if returns.size else path_m.size)
    beyond_s = float((in_use & after & (error_m > LIMIT_M)).sum())
    return Outcome(made.drift_mps, bool(negated.any()), bool(returns.size), beyond_s)


def unused_s(made: Journey, config: Configuration) -> float:
    """For how long the position of a sound journey is out of use from 1,000 s on, when its event is over [s]."""
    aligned, lds = lds_of(made, config)
    t_s = (aligned.t_ns - aligned.t_ns[0]) // NS_PER_S
    unused = lds.epochs.negated | lds.epochs.withheld
    return float((unused & (t_s >= 1_000.0)).sum())


def measure(out: Path, cases: int = CASES) -> list[Figure]:
    """Figures at 1 and 2 m sigma; beside the rule: the last TVB as anchor after an alarm too, and no re-link at all."""
    rule = Configuration()
    runs = {"re-link": (rule, True), "last TVB": (rule, False)}
    runs["no re-link"] = Configuration(lds=LdsConfig(relink=False)), True
    figures: list[Figure] = []
    for name, (config, first) in runs.items():
        with _anchored(first):
            found = [outcome(ramp(seed, 1.0 + seed % 2), config) for seed in range(cases)]
        figures += _figures(name, found, (0.0, 0.0) if name == "re-link" else None)
    for name, count, jump in (("a jump of 3 s", JUMPED, True), ("an outage of 90 s", INTERRUPTED, False)):
        times_s = [unused_s(sound(seed, 1.0 + seed % 2, jump), rule) for seed in range(count)]
        figures += [
            Figure(f"sound, {name}: journeys", count, "cases"),
            Figure(f"sound, {name}: out of use again", sum(time_s > 0 for time_s in times_s), "cases"),
            Figure(f"sound, {name}: longest of 1,400 s", max(times_s), "s"),
        ]
    return figures


@contextmanager
def _anchored(first: bool) -> Iterator[None]:
    """After an alarm the anchor is the first TVB as the rule says, else the last one before it."""
    rule = Relink.withhold
    if not first:
        Relink.withhold = lambda self, epoch, suspected: rule(self, epoch, False)  # type: ignore[method-assign]
    try:
        yield
    finally:
        Relink.withhold = rule  # type: ignore[method-assign]


def _figures(name: str, found: list[Outcome], most: tuple[float, float] | None = None) -> list[Figure]:
    beyond_s = [one.beyond_s for one in found]
    most_cases, most_s = most or (None, None)
    return [
        Figure(f"{name}: drifts", len(found), "cases"),
        Figure(f"{name}: negated", sum(one.negated for one in found), "cases"),
        Figure(f"{name}: returned", sum(one.returned for one in found), "cases"),
        Figure(f"{name}: beyond 20 m after a return", sum(s > 0 for s in beyond_s), "cases", most_cases),
        Figure(f"{name}: longest beyond 20 m", max(beyond_s), "s", most_s),
    ]


def _gauss_markov(dice: np.random.Generator, t_s: Floats, sigma_m: float) -> Floats:
    """Sum of stationary first-order Gauss-Markov processes at 1 Hz [m]."""
    total = np.zeros(t_s.size)
    for share, tau_s in SOURCES:
        decay, scale_m = np.exp(-1.0 / tau_s), sigma_m * np.sqrt(share)
        value = dice.normal(0.0, scale_m)
        for k, push in enumerate(dice.normal(0.0, scale_m * np.sqrt(1.0 - decay**2), t_s.size).tolist()):
            value = decay * value + push
            total[k] += value
    return total


def _odometer(dice: np.random.Generator, end_s: float) -> pl.DataFrame:
    """5 Hz; distance with a scale error and a random walk of 0.05 m over one second."""
    t_s = np.arange(0.0, end_s + 1.0, 0.2)
    walk_m = np.cumsum(dice.normal(0.0, 0.05 * np.sqrt(0.2), t_s.size))
    scale = 1.0 + dice.normal(0.0, SCALE_SIGMA)
    frame = pl.DataFrame({"t": _instants(t_s), "distance_m": scale * SPEED_MPS * t_s + walk_m, "speed_mps": SPEED_MPS})
    frame = frame.with_columns(origin=pl.lit("wheel"))
    return _stream(frame, Odometer)


def _site(length_m: float) -> Site:
    measure_m = np.arange(0.0, length_m + 1_000.0, 1_000.0)
    track = pl.DataFrame(
        {
            "netelement_id": "E",
            "measure_m": measure_m,
            "latitude_deg": 0.0,
            "longitude_deg": np.degrees(measure_m / RADIUS_M),
            "height_m": 100.0,
            "sigma_m": 0.1,
        }
    )
    places_m = np.arange(700.0, length_m, 1_000.0)
    balises = pl.DataFrame(
        {
            "balise_id": [f"VB{number:04}" for number in range(places_m.size)],
            "netelement_id": "E",
            "measure_m": places_m,
            "kind": "virtual",
            "location_accuracy_m": 12.0,
            "linked": True,
            "link_reaction": "service_brake",
            "direction": "both",
        }
    )
    return Site(_stream(track, Track), Links.create_empty(), _stream(balises, Balises))


def _stream(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """Columns that the frame has not are null."""
    missing = [pl.lit(None).alias(name) for name in schema.columns() if name not in frame.columns]
    return shaped(frame.with_columns(missing), schema)


def _instants(t_s: Floats) -> pl.Series:
    stamps = 1_700_000_000 * NS_PER_S + np.round(t_s * NS_PER_S).astype(np.int64)
    return pl.Series("t", stamps).cast(pl.Datetime("ns", "UTC"))
