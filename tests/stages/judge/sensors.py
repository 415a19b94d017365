"""What the train's instruments write down: GNSS, odometer, reference, balise reads, each with its own errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import polars as pl

from schemas.inputs import BaliseReads, Gnss, Odometer, Reference
from tests.stages.judge.faults import Fault, Slip
from tests.stages.judge.ground import Balise, Floats, Ground, Route, geodetic
from tests.stages.judge.ride import Ride
from tests.tables import WHEEL

START_NS = 1_772_352_000_000_000_000  # 2026-03-01T08:00:00Z
CUT = 2.5  # every random error of the evidence ends here [sigma], so that none is beyond 3 sigma by chance
NOISE_TAUS_S = (100.0, 3600.0)  # DIAG Table 1: user, and orbit and clock
NOISE_SHARES = (0.75, 0.25)


@dataclass(frozen=True)
class Receiver:
    """`sigma_m` is how the receiver errs per axis, `stated_sigma_m` what it says (none: the same)."""

    rate_hz: float = 1.0
    sigma_m: float = 0.6
    white_m: float = 0.02
    stated_sigma_m: float | None = None
    latency_s: float = 0.0
    velocity_sigma_mps: float = 0.05
    with_velocity: bool = True
    antenna_ahead_m: float = 0.0
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True)
class Counter:
    """An odometer: true distance is `scale` times what it counts."""

    rate_hz: float = 5.0
    scale: float = 1.0
    noise_mps: float = 0.02
    polarity: int = 1
    slips: tuple[Slip, ...] = ()


@dataclass(frozen=True)
class Better:
    """The reference: `stated` false leaves its sigma null; it is silent in `pauses` (begin, end) [s].

    `aside`: (begin, end, metres) in which it stands ahead of the train, as none should.
    """

    rate_hz: float = 1.0
    sigma_m: float = 0.1
    stated: bool = True
    pauses: tuple[tuple[float, float], ...] = ()
    aside: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Place:
    """Where a receiver says it is: the along-track part and the rest."""

    time_s: Floats
    along_m: Floats
    frame: pl.DataFrame = field(repr=False)


def stamps(time_s: Floats) -> pl.Series:
    nanoseconds = START_NS + np.round(time_s * 1e9).astype(np.int64)
    return pl.Series("t", nanoseconds).cast(pl.Datetime("ns", "UTC"))


def seconds(times: pl.Series) -> Floats:
    """Stamps as seconds from the start of the run; null becomes NaN."""
    return times.dt.epoch("ns").cast(pl.Float64).fill_null(np.nan).to_numpy() / 1e9 - START_NS / 1e9


def _ticks(length_s: float, rate_hz: float) -> Floats:
    return np.arange(int(length_s * rate_hz) + 1) / rate_hz


def _cut_normal(rng: np.random.Generator, size: int | tuple[int, ...]) -> Floats:
    return np.clip(rng.standard_normal(size), -CUT, CUT)


def gauss_markov(rng: np.random.Generator, time_s: Floats, sigma_m: float, tau_s: float) -> Floats:
    """First-order Gauss-Markov noise at increasing times."""
    draws = rng.standard_normal(len(time_s))
    kept = np.exp(-np.diff(time_s, prepend=time_s[0]) / tau_s)
    noise = np.empty(len(time_s))
    noise[0] = draws[0]
    for k in range(1, len(time_s)):
        noise[k] = kept[k] * noise[k - 1] + np.sqrt(1 - kept[k] ** 2) * draws[k]
    return sigma_m * noise


def _noise(rng: np.random.Generator, time_s: Floats, of: Receiver) -> Floats:
    shares = zip(NOISE_SHARES, NOISE_TAUS_S, strict=True)
    slow = sum(gauss_markov(rng, time_s, of.sigma_m * np.sqrt(share), tau) for share, tau in shares)
    return np.asarray(slow + of.white_m * rng.standard_normal(len(time_s)))


def gnss(rng: np.random.Generator, ride: Ride, ground: Ground, of: Receiver) -> Place:
    """Epochs of the receiver; `along_m` is the way of the balise antenna as its position says it."""
    time = _ticks(ride.length_s, of.rate_hz)
    late = of.latency_s + sum((fault.late_s(time) for fault in of.faults), np.zeros_like(time))
    fault = sum((fault.along_m(time) for fault in of.faults), np.zeros_like(time))
    other = np.nan_to_num(ground.other_left_m(ride.chainage_m(time - late) + fault))
    left = sum((fault.left_m(time, other) for fault in of.faults), np.zeros_like(time))
    along = ride.chainage_m(time - late) + fault + _noise(rng, time, of)
    enu, tangent = ground.route.points(
        along + of.antenna_ahead_m, left + _noise(rng, time, of), 1.5 * _noise(rng, time, of)
    )
    speed = ride.speed_mps(time - late) + _carried(of.faults, time, of.rate_hz)
    velocity = speed[:, None] * tangent + of.velocity_sigma_mps * rng.standard_normal((len(time), 2))
    heard = ~np.any([fault.silent(time) for fault in of.faults] or [np.zeros(len(time), bool)], axis=0)
    frame = _fixes(time, enu, velocity, of).filter(pl.Series(heard))
    return Place(time[heard], along[heard], Gnss.validate(frame, cast=True))


def _carried(faults: tuple[Fault, ...], time_s: Floats, rate_hz: float) -> Floats:
    """What the faults add to the velocity: their growth over the last period."""
    carried = [fault for fault in faults if fault.in_velocity]
    growth = [(fault.along_m(time_s) - fault.along_m(time_s - 1 / rate_hz)) * rate_hz for fault in carried]
    return sum(growth, np.zeros_like(time_s))


def _fixes(time_s: Floats, enu_m: Floats, velocity_mps: Floats, of: Receiver) -> pl.DataFrame:
    latitude, longitude, height = geodetic(enu_m)
    variance = (of.stated_sigma_m if of.stated_sigma_m is not None else max(of.sigma_m, of.white_m)) ** 2
    rows = len(time_s)
    columns = {
        "t": stamps(time_s),
        "solution": ["primary"] * rows,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        **{f"cov_{pair}_m2": np.full(rows, variance * share) for pair, share in _COVARIANCE.items()},
        "vel_e_mps": velocity_mps[:, 0] if of.with_velocity else [None] * rows,
        "vel_n_mps": velocity_mps[:, 1] if of.with_velocity else [None] * rows,
        "vel_u_mps": np.zeros(rows) if of.with_velocity else [None] * rows,
        "hpl_m": [None] * rows,
        "vpl_m": [None] * rows,
        "fix": ["sbas"] * rows,
        "satellites": [12] * rows,
        "sbas_prn": [123] * rows,
        "sbas_age_s": [2.0] * rows,
    }
    return pl.DataFrame(columns)


_COVARIANCE = {"ee": 1.0, "en": 0.0, "eu": 0.0, "nn": 1.0, "nu": 0.0, "uu": 2.25}


def odometer(rng: np.random.Generator, ride: Ride, of: Counter) -> pl.DataFrame:
    """Distance and speed as counted, with noise that stands when the train stands."""
    steps = np.diff(ride.track_m, prepend=ride.track_m[0]) / of.scale
    gained = np.zeros_like(steps)
    for slip in of.slips:
        inside = slip.inside(ride.time_s)
        ways = np.abs(steps) * inside
        if slip.kind == "slip" and ways.sum() > 0:
            gained += np.sign(steps) * slip.extra_m * ways / ways.sum()
        if slip.kind == "freeze":
            steps = np.where(inside, 0.0, steps)
    tick_s = ride.time_s[1] - ride.time_s[0]
    white = of.noise_mps * np.sqrt(tick_s) * rng.standard_normal(len(steps)) * (steps != 0)
    counted = steps + gained + white
    distance = np.cumsum(counted)
    time = _ticks(ride.length_s, of.rate_hz)
    rows = np.clip(np.round(time / tick_s).astype(int), 0, len(steps) - 1)
    speed_mps = (counted - white)[rows] / tick_s
    speed_mps += np.where(speed_mps != 0, of.noise_mps * rng.standard_normal(len(time)), 0.0)
    none = np.zeros(len(time), bool)
    flags = np.any([slip.inside(time) & slip.flagged for slip in of.slips] or [none], axis=0)
    silent = np.any([slip.inside(time) & (slip.kind == "outage") for slip in of.slips] or [none], axis=0)
    frame = pl.DataFrame(
        {
            "t": stamps(time),
            "sensor": ["primary"] * len(time),
            "distance_m": of.polarity * distance[rows],
            "speed_mps": of.polarity * speed_mps,
            "sigma_speed_mps": [None] * len(time),
            "slip": flags,
        }
    ).with_columns(WHEEL)
    return Odometer.validate(frame.filter(pl.Series(~silent)), cast=True)


def reference(rng: np.random.Generator, ride: Ride, route: Route, of: Better, antenna_ahead_m: float) -> pl.DataFrame:
    """The GNSS antenna by a better instrument."""
    time = _ticks(ride.length_s, of.rate_hz)
    errors = of.sigma_m * _cut_normal(rng, (3, len(time)))
    if of.aside is not None:
        begin, end, metres = of.aside
        errors[0] += np.where((time >= begin) & (time < end), metres, 0.0)
    enu, _ = route.points(ride.chainage_m(time) + errors[0] + antenna_ahead_m, errors[1], errors[2])
    latitude, longitude, height = geodetic(enu)
    frame = pl.DataFrame(
        {
            "t": stamps(time),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "sigma_m": [of.sigma_m if of.stated else None] * len(time),
        },
        schema_overrides={"sigma_m": pl.Float64},
    )
    heard = ~np.any([(time >= a) & (time < b) for a, b in of.pauses] or [np.zeros(len(time), bool)], axis=0)
    return Reference.validate(frame.filter(pl.Series(heard)), cast=True)


def reads(rng: np.random.Generator, ride: Ride, route: Route, balises: list[Balise], sigma_m: float) -> pl.DataFrame:
    """One telegram per passing of a physical balise of the route; the place is off by `sigma_m`, hence the time."""
    found: list[tuple[float, str]] = []
    for balise in balises:
        way = route.chainage_m(balise.netelement_id, balise.measure_m)
        if balise.kind != "physical" or way is None:
            continue
        found += [
            (
                time + sigma_m * float(_cut_normal(rng, 1)[0]) / max(abs(float(ride.speed_mps(np.array(time)))), 5.0),
                balise.balise_id,
            )
            for time in ride.passings_s(way)
        ]
    found.sort()
    frame = {"t": stamps(np.array([time for time, _ in found])), "balise_id": [name for _, name in found]}
    return BaliseReads.validate(pl.DataFrame(frame, schema_overrides={"balise_id": pl.String}), cast=True)
