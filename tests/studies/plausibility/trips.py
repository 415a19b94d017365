"""Journeys drawn with noise and faults of their own, for the fit of a run: nothing of `datasets` is in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.inputs import Balises, Links, Track
from schemas.run import RunLog, Site

# A day that is another one with day and month exchanged; each trip adds up to 5 h.
START_NS = 1_741_154_400 * NS_PER_S  # 2025-03-05 06:00 UTC
_TICK_S = 0.1
_EARTH_M = 6_371_000.0


@dataclass(frozen=True)
class Trip:
    """A run, its site, and what was drawn."""

    run: RunLog
    site: Site
    scale: float
    latency_s: float
    moving_s: float
    stops: int
    reverses: bool
    hours: float


def trip(seed: int, faulty: bool = True, place: tuple[float, float] | None = None) -> Trip:
    """The trip of a seed: 5 min to 2 h, up to 60 m/s, with stops, curves, at 1, 5 or 10 Hz, and faults in it."""
    rng = np.random.default_rng([7, seed])
    hours = float(rng.choice([0.1, 0.2, 0.4, 1.0, 2.0], p=[0.3, 0.3, 0.2, 0.12, 0.08]))
    speed, stops, reverses = _speeds(rng, hours)
    t_s: Floats = np.arange(speed.size, dtype=np.float64) * _TICK_S
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) * _TICK_S])
    line = _Line.drawn(rng, float(way.min()) - 500.0, float(way.max()) + 500.0)
    line = line if place is None else replace(line, latitude_deg=place[0], longitude_deg=place[1])
    rate = float(rng.choice([1.0, 5.0, 10.0], p=[0.6, 0.2, 0.2] if hours < 1.0 else [0.9, 0.05, 0.05]))
    latency_s, scale = (
        float(rng.uniform(0.0, 2.0) if faulty else 0.0),
        float(rng.uniform(0.97, 1.03) if faulty else 1.0),
    )
    begin_ns = START_NS + int(rng.integers(0, 5 * 3600)) * NS_PER_S
    gnss = _gnss(rng, line, t_s, way, rate, latency_s, begin_ns, faulty)
    odometer = _odometer(rng, t_s, speed, scale, begin_ns, faulty)
    reference = _reference(rng, line, t_s, way, begin_ns) if rng.random() < 0.5 else None
    balises_m = np.arange(line.begin_m + 600.0, line.end_m - 600.0, 900.0)
    reads = _reads(t_s, way, balises_m, begin_ns) if rng.random() < 0.5 else None
    run = RunLog(f"trip{seed}", gnss, odometer=odometer, reference=reference, balise_reads=reads)
    return Trip(run, line.site(balises_m), scale, latency_s, float((speed != 0).mean()), stops, reverses, hours)


def _speeds(rng: np.random.Generator, hours: float) -> tuple[Floats, int, bool]:
    """Speed every 0.1 s [m/s]: cruises that waver, stops, perhaps a reversal."""
    wanted = int(hours * 3600 / _TICK_S)
    parts, size, now, stops, sense = [np.zeros(int(rng.uniform(50, 600)))], 0, 0.0, 0, 1.0
    while size < wanted:
        target = float(rng.uniform(8.0, 60.0)) if rng.random() < 0.7 or now == 0.0 else 0.0
        steps = max(int(abs(target - now) / float(rng.uniform(0.3, 1.0)) / _TICK_S), 1)
        hold = int(rng.uniform(15, 180) / _TICK_S) if target else int(rng.uniform(20, 90) / _TICK_S)
        waver = 0.6 * np.sin(np.arange(hold) * _TICK_S / 17.0) if target else np.zeros(hold)
        parts += [sense * np.linspace(now, target, steps), sense * (target + waver)]
        if target == 0.0:
            stops += 1
            sense = -sense if rng.random() < 0.15 else sense
        size, now = size + steps + hold, target
    parts += [sense * np.linspace(now, 0.0, int(now / 0.7 / _TICK_S) + 1), np.zeros(300)]
    speed = np.concatenate(parts)
    return speed, stops, bool((speed > 1.0).any() and (speed < -1.0).any())


@dataclass(frozen=True)
class _Line:
    """A line of straights and arcs on a plane at a place on a sphere; heights by a slow wave."""

    begin_m: float
    end_m: float
    at_m: Floats
    east_m: Floats
    north_m: Floats
    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, begin_m: float, end_m: float) -> _Line:
        at = np.arange(begin_m, end_m + 5.0, 5.0)
        bend = np.zeros(at.size)
        place = 0
        while place < at.size:
            straight, arc = int(rng.uniform(60, 400)), int(rng.uniform(30, 200))
            bend[place + straight : place + straight + arc] = rng.choice([-1, 1]) / rng.uniform(500.0, 3000.0)
            place += straight + arc
        heading = float(rng.uniform(0, 2 * np.pi)) + np.cumsum(bend) * 5.0
        # A line keeps its general direction.
        heading = heading[0] + 0.7 * np.sin((heading - heading[0]) / 0.7)
        east, north = np.cumsum(np.sin(heading)) * 5.0, np.cumsum(np.cos(heading)) * 5.0
        where = float(rng.uniform(40.0, 60.0)), float(rng.choice([rng.uniform(2.0, 25.0), rng.uniform(-9.0, -3.0)]))
        return cls(begin_m, end_m, at, east, north, *where, float(rng.uniform(80.0, 600.0)))

    def places(self, chainage_m: Floats, off: Floats | None = None) -> tuple[Floats, Floats, Floats]:
        """Latitude, longitude [deg] and height [m] of ways along the line, moved by east and north."""
        off = np.zeros((chainage_m.size, 2)) if off is None else off
        east = np.interp(chainage_m, self.at_m, self.east_m) + off[:, 0]
        north = np.interp(chainage_m, self.at_m, self.north_m) + off[:, 1]
        latitude = np.radians(self.latitude_deg) + north / _meridian_m(self.latitude_deg)
        longitude = self.longitude_deg + np.degrees(east / (_normal_m(np.degrees(latitude)) * np.cos(latitude)))
        return np.degrees(latitude), longitude, self.height_m + 40.0 * np.sin(chainage_m / 2500.0)

    def heading(self, chainage_m: Floats) -> Floats:
        ahead = np.column_stack([np.interp(chainage_m + 2.5, self.at_m, one) for one in (self.east_m, self.north_m)])
        behind = np.column_stack([np.interp(chainage_m - 2.5, self.at_m, one) for one in (self.east_m, self.north_m)])
        return np.asarray((ahead - behind) / 5.0)

    def site(self, balises_m: Floats) -> Site:
        latitude, longitude, height = self.places(self.at_m[::3])
        track = {
            "netelement_id": ["L"] * latitude.size,
            "measure_m": self.at_m[::3] - self.begin_m,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "sigma_m": [0.2] * latitude.size,
        }
        names = [f"B{number}" for number in range(balises_m.size)]
        balises = {
            "balise_id": names,
            "netelement_id": ["L"] * len(names),
            "measure_m": balises_m - self.begin_m,
            "kind": ["physical"] * len(names),
            "location_accuracy_m": [5.0] * len(names),
            "linked": [True] * len(names),
            "link_reaction": ["service_brake"] * len(names),
            "direction": ["both"] * len(names),
        }
        links = Links.create_empty()
        return Site(
            Track.validate(pl.DataFrame(track), cast=True), links, Balises.validate(pl.DataFrame(balises), cast=True)
        )


def _meridian_m(latitude_deg: float) -> float:
    return float(6_335_439.0 / (1 - 0.00669438 * np.sin(np.radians(latitude_deg)) ** 2) ** 1.5)


def _normal_m(latitude_deg: Floats) -> Floats:
    return np.asarray(6_378_137.0 / np.sqrt(1 - 0.00669438 * np.sin(np.radians(latitude_deg)) ** 2))


def _walk(rng: np.random.Generator, t_s: Floats, sigma: float, tau_s: float) -> Floats:
    """Correlated noise by a sum of slow sines: no Gauss-Markov process, as the program's own model is one."""
    waves = rng.uniform(0.3 * tau_s, 6.0 * tau_s, 12)
    phases = rng.uniform(0, 2 * np.pi, 12)
    return np.asarray(sigma * np.sqrt(2 / 12) * np.sin(2 * np.pi * t_s[:, None] / waves + phases).sum(axis=1))


def _stamps(begin_ns: int, t_s: Floats) -> pl.Series:
    return pl.Series("t", begin_ns + np.round(t_s * NS_PER_S).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def _gnss(
    rng: np.random.Generator,
    line: _Line,
    t_s: Floats,
    way: Floats,
    rate: float,
    latency_s: float,
    begin_ns: int,
    faulty: bool,
) -> pl.DataFrame:
    at = t_s[:: round(10 / rate)]
    there = np.interp(at - latency_s, t_s, way)
    sigma = float(rng.uniform(0.3, 3.0))
    off = np.column_stack([_walk(rng, at, sigma, 100.0) for _ in range(2)])
    off += rng.normal(0.0, 0.3 * sigma, off.shape) + rng.uniform(-2.0, 2.0, 2)
    speed = np.gradient(there, at)
    lost = np.zeros(at.size, dtype=np.bool_)
    if faulty:
        there, off, lost = _gnss_faults(rng, line, at, there, off)
    latitude, longitude, height = line.places(there, off)
    along = line.heading(there)
    velocity = speed[:, None] * along + rng.normal(0.0, 0.1, along.shape)
    climb = 40.0 / 2500.0 * np.cos(there / 2500.0) * speed + rng.normal(0.0, 0.05, at.size)
    with_velocity, with_height = rng.random() < 0.8, rng.random() < 0.9
    nothing = np.full(at.size, np.nan)
    columns = {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height + _walk(rng, at, 1.5 * sigma, 100.0) if with_height else nothing,
        "vel_e_mps": velocity[:, 0] if with_velocity else nothing,
        "vel_n_mps": velocity[:, 1] if with_velocity else nothing,
        "vel_u_mps": climb if with_velocity else nothing,
    }
    frame = pl.DataFrame([_stamps(begin_ns, at), *(pl.Series(name, values) for name, values in columns.items())])
    empty = [pl.lit(None, dtype=pl.Float64).alias(name) for name in _EMPTY]
    return frame.with_columns(
        pl.col(pl.Float64).fill_nan(None),
        *empty,
        solution=pl.lit("primary"),
        fix=pl.Series(np.where(lost, "none", "sbas")).cast(pl.Enum(_FIXES)),
        satellites=pl.lit(9, dtype=pl.Int64),
        sbas_prn=pl.lit(None, dtype=pl.Int64),
    )


_FIXES = ["none", "autonomous", "differential", "sbas", "rtk_float", "rtk_fixed", "estimated"]
_EMPTY = (*(f"cov_{axes}_m2" for axes in ("ee", "en", "eu", "nn", "nu", "uu")), "hpl_m", "vpl_m", "sbas_age_s")


def _gnss_faults(
    rng: np.random.Generator, line: _Line, at: Floats, there: Floats, off: Floats
) -> tuple[Floats, Floats, Bools]:
    """Up to three of: outage, step along or across, drift along, frozen position, noise, bias after an outage."""
    lost = np.zeros(at.size, dtype=np.bool_)
    there, off = there.copy(), off.copy()
    for kind in rng.choice(["outage", "step", "cross", "drift", "frozen", "noise", "bias", "none"], 3):
        begin = float(rng.uniform(0.1, 0.9)) * at[-1]
        span = float(rng.uniform(5.0, 0.25 * at[-1]))
        now = (at >= begin) & (at < begin + span)
        if kind == "outage":
            lost |= now
        elif kind == "step":
            there[now] += rng.choice([-1, 1]) * rng.uniform(20.0, 2000.0)
        elif kind == "cross":
            off[now] += rng.uniform(-60.0, 60.0, 2)
        elif kind == "drift":
            there[now] += rng.uniform(-2.0, 2.0) * (at[now] - begin)
        elif kind == "frozen" and now.any():
            span = min(span, 60.0)
            now = (at >= begin) & (at < begin + span)
            there[now], off[now] = there[now.argmax()], off[now.argmax()]
        elif kind == "noise":
            off[now] += rng.normal(0.0, 10.0, (int(now.sum()), 2))
        elif kind == "bias":
            after = at >= begin + min(span, 60.0)
            lost |= now & ~after
            there[after] += rng.uniform(-150.0, 150.0)
    return np.clip(there, line.begin_m + 10.0, line.end_m - 10.0), off, lost


def _odometer(
    rng: np.random.Generator, t_s: Floats, speed: Floats, scale: float, begin_ns: int, faulty: bool
) -> pl.DataFrame:
    driven = speed * scale
    if faulty:
        for kind in rng.choice(["slip", "slide", "frozen", "scale", "none"], 2):
            begin = int(rng.uniform(0.05, 0.95) * t_s.size)
            now = slice(begin, begin + int(rng.uniform(2.0, 60.0) / _TICK_S))
            if kind == "slip":
                driven[now] += np.sign(speed[now]) * rng.uniform(0.3, 10.0)
            elif kind == "slide":
                driven[now] *= rng.uniform(0.0, 0.9)
            elif kind == "frozen":
                driven[now] = 0.0
            elif kind == "scale":
                driven[begin:] *= rng.uniform(0.97, 1.03) / scale
    noisy = driven + np.where(driven != 0, rng.normal(0.0, 0.15, t_s.size), 0.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (noisy[1:] + noisy[:-1])) * _TICK_S])
    step = int(rng.choice([1, 2, 10], p=[0.5, 0.3, 0.2]))
    rows = slice(int(rng.integers(0, 10)), None, step)
    counted = np.round(way / 0.1) * 0.1 if rng.random() < 0.3 else way
    kind = rng.choice(["both", "distance", "speed"], p=[0.5, 0.25, 0.25])
    nothing = np.full(t_s.size, np.nan)
    columns = {
        "distance_m": counted if kind != "speed" else nothing,
        "speed_mps": driven + rng.normal(0.0, 0.02, t_s.size) if kind != "distance" else nothing,
        "sigma_speed_mps": nothing,
    }
    series = [pl.Series(name, values[rows]).fill_nan(None) for name, values in columns.items()]
    slip = pl.lit(None, dtype=pl.Boolean).alias("slip")
    return pl.DataFrame([_stamps(begin_ns, t_s[rows]), *series]).with_columns(slip, origin=pl.lit("wheel"))


def _reference(rng: np.random.Generator, line: _Line, t_s: Floats, way: Floats, begin_ns: int) -> pl.DataFrame:
    at = t_s[::10]
    latitude, longitude, height = line.places(way[::10], rng.normal(0.0, 0.05, (at.size, 2)))
    columns = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height, "sigma_m": 0.05 + 0 * at}
    return pl.DataFrame([_stamps(begin_ns, at), *(pl.Series(name, values) for name, values in columns.items())])


def _reads(t_s: Floats, way: Floats, balises_m: Floats, begin_ns: int) -> pl.DataFrame:
    times, names = [], []
    for number, at_m in enumerate(balises_m):
        passed: Ints = np.flatnonzero(np.diff(np.sign(way - at_m)) != 0)
        times += [float(t_s[row]) for row in passed]
        names += [f"B{number}"] * passed.size
    order = np.argsort(times, kind="stable")
    stamps = _stamps(begin_ns, np.array(times)[order] if times else np.zeros(0))
    return pl.DataFrame([stamps, pl.Series("balise_id", [names[index] for index in order], dtype=pl.String)])
