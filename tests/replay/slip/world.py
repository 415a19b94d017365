"""A straight line with three stations, a train that stops at each, and wheels that slip when it starts.

Nothing of the program makes it: stamps, ways and noise are reckoned here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl
from pyproj import Geod

from schemas.config import Vehicle
from schemas.inputs import BaliseReads, Gnss, Links, Odometer, Reference
from schemas.run import RunLog, Site
from tests.tables import WHEEL

Floats = npt.NDArray[np.float64]

HZ = 10.0
STAND_S, RISE_S, CRUISE_S = 40.0, 25.0, 55.0
ACCELERATION = 0.8
STARTS = 3
LEG_S = STAND_S + 2 * RISE_S + CRUISE_S
LEG_M = ACCELERATION * RISE_S * (RISE_S + CRUISE_S)
BALISES = {f"V{k}": 150.0 + 400.0 * k for k in range(12)}
READ_M = 2250.0
VEHICLE = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002)
_BEGIN_NS = 1_780_000_000_000_000_000
_GEOD = Geod(ellps="WGS84")
_ORIGIN = (4.3, 50.6)
_AZIMUTH = 33.0


@dataclass(frozen=True)
class Slip:
    """Wheels count `share` too much over the first `lasts_s` of each start; `flag`: and say so, or by `sigma_mps`."""

    share: float = 0.02
    lasts_s: float = 12.0
    flag: bool = True
    sigma_mps: float | None = None


@dataclass(frozen=True)
class Fault:
    """The position is `size_m` ahead from `begin_s` to `end_s`."""

    begin_s: float
    size_m: float
    end_s: float = 1e9


def times() -> Floats:
    return np.arange(round((STARTS * LEG_S + STAND_S) * HZ)) / HZ


def chainage_m(t_s: Floats) -> Floats:
    """Stand, speed up, cruise, slow down, for each leg; 50 m behind the origin at first."""
    leg, into = np.divmod(t_s, LEG_S)
    moving = into - STAND_S
    up = np.clip(moving, 0.0, RISE_S)
    cruise = np.clip(moving - RISE_S, 0.0, CRUISE_S)
    down = np.clip(moving - RISE_S - CRUISE_S, 0.0, RISE_S)
    fast = ACCELERATION * RISE_S
    return 50.0 + leg * LEG_M + ACCELERATION * up**2 / 2 + fast * cruise + fast * down - ACCELERATION * down**2 / 2


def since_start_s(t_s: Floats) -> Floats:
    """Time since the train last started; negative while it stands before."""
    return np.asarray(t_s % LEG_S - STAND_S)


def site() -> Site:
    measure = np.arange(0.0, 5200.0, 100.0)
    latitude, longitude = _placed(measure, np.zeros(measure.size))
    track = pl.DataFrame(
        {
            "netelement_id": ["line"] * measure.size,
            "measure_m": measure,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": [100.0] * measure.size,
            "sigma_m": [0.3] * measure.size,
        }
    )
    names, places = zip(*(BALISES | {"P1": READ_M}).items(), strict=True)
    balises = pl.DataFrame(
        {
            "balise_id": names,
            "netelement_id": ["line"] * len(names),
            "measure_m": places,
            "kind": ["virtual"] * len(BALISES) + ["physical"],
            "location_accuracy_m": [5.0] * len(names),
            "linked": [True] * len(names),
            "link_reaction": ["service_brake"] * len(names),
            "direction": ["both"] * len(names),
        }
    )
    return Site(track=track, links=Links.create_empty(), balises=balises)


def ride(
    slip: Slip | None = None,
    fault: Fault | None = None,
    *,
    read: bool = False,
    white_m: float = 0.0,
    scale: float = 1.0,
    radar: Slip | None = None,
    seed: int = 1,
) -> RunLog:
    """One journey; `read`: the physical balise after the second start is read; `white_m`: of positions, not stated;
    `scale`: true over counted distance; `radar`: a second odometer counts backwards and 0.5 % short, with this slip.
    """
    rng = np.random.default_rng(seed)
    t_s = times()
    true_m = chainage_m(t_s)
    off_m = np.zeros(t_s.size)
    if fault is not None:
        off_m[(t_s >= fault.begin_s) & (t_s < fault.end_s)] = fault.size_m
    noise = [_smooth(rng, t_s.size) + white_m * rng.standard_normal(t_s.size) for _ in range(3)]
    gnss = _gnss(t_s, true_m + off_m + noise[0], noise[1], noise[2])
    streams = {"reference": _reference(t_s[::2], true_m[::2])}
    if read:
        at_s = float(np.interp(READ_M, true_m, t_s))
        streams["balise_reads"] = BaliseReads.validate(
            pl.DataFrame({"t": _stamps([at_s]), "balise_id": ["P1"]}), cast=True
        )
    odometer = _odometer(rng, t_s, true_m / scale, slip)
    if radar is not None:
        second = _odometer(rng, t_s, -0.995 * true_m, radar).with_columns(sensor=pl.lit("radar"))
        odometer = pl.concat([odometer, second]).sort("t", "sensor")
    return RunLog(run_id=f"ride{seed}", gnss=gnss, odometer=odometer).with_streams(**streams)


def _smooth(rng: np.random.Generator, size: int, sigma_m: float = 0.5, tau_s: float = 100.0) -> Floats:
    """First-order Gauss-Markov noise, as the receiver states it."""
    keep = np.exp(-1.0 / HZ / tau_s)
    steps = rng.standard_normal(size) * sigma_m * np.sqrt(1 - keep**2)
    steps[0] = sigma_m * rng.standard_normal()
    out = np.empty(size)
    value = 0.0
    for k in range(size):
        value = keep * value + steps[k]
        out[k] = value
    return out


def _gnss(t_s: Floats, along_m: Floats, left_m: Floats, up_m: Floats) -> pl.DataFrame:
    latitude, longitude = _placed(along_m, left_m)
    size = t_s.size
    frame = pl.DataFrame(
        {
            "t": _stamps(t_s),
            "solution": ["primary"] * size,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": 100.0 + up_m,
            **{f"cov_{pair}_m2": [0.25] * size for pair in ("ee", "nn", "uu")},
            **{f"cov_{pair}_m2": [0.0] * size for pair in ("en", "eu", "nu")},
            **dict.fromkeys(("vel_e_mps", "vel_n_mps", "vel_u_mps", "hpl_m", "vpl_m", "sbas_age_s"), [None] * size),
            "fix": ["sbas"] * size,
            "satellites": [10] * size,
            "sbas_prn": [None] * size,
        }
    )
    return Gnss.validate(frame.select(list(Gnss.columns())), cast=True)


def _odometer(rng: np.random.Generator, t_s: Floats, true_m: Floats, slip: Slip | None) -> pl.DataFrame:
    steps = np.diff(true_m, prepend=true_m[0])
    slips = np.zeros(t_s.size, dtype=bool)
    if slip is not None:
        since = since_start_s(t_s)
        slips = (since > 0.0) & (since <= slip.lasts_s)
        steps = np.where(slips, (1.0 + slip.share) * steps, steps)
    noise = np.where(steps != 0.0, 0.02 / np.sqrt(HZ) * rng.standard_normal(t_s.size), 0.0)
    said = slips & (slip is not None and slip.flag)
    sigma = None if slip is None or slip.sigma_mps is None else np.where(slips, slip.sigma_mps, 0.02)
    frame = pl.DataFrame(
        {
            "t": _stamps(t_s),
            "sensor": ["primary"] * t_s.size,
            "distance_m": np.cumsum(steps + noise),
            "speed_mps": steps * HZ,
            "sigma_speed_mps": pl.Series(sigma if sigma is not None else [None] * t_s.size, dtype=pl.Float64),
            "slip": said,
        }
    ).with_columns(WHEEL)
    return Odometer.validate(frame, cast=True)


def _reference(t_s: Floats, true_m: Floats) -> pl.DataFrame:
    latitude, longitude = _placed(true_m, np.zeros(t_s.size))
    columns = {"t": _stamps(t_s), "latitude_deg": latitude, "longitude_deg": longitude}
    frame = pl.DataFrame(columns).with_columns(height_m=pl.lit(100.0), sigma_m=pl.lit(0.1))
    return Reference.validate(frame, cast=True)


def _placed(along_m: Floats, left_m: Floats) -> tuple[Floats, Floats]:
    """Latitude and longitude of places along the line and left of it."""
    ones = np.ones(along_m.size)
    longitude, latitude, back = _GEOD.fwd(_ORIGIN[0] * ones, _ORIGIN[1] * ones, _AZIMUTH * ones, along_m)
    longitude, latitude, _ = _GEOD.fwd(longitude, latitude, back + 90.0, left_m)
    return np.asarray(latitude), np.asarray(longitude)


def _stamps(t_s: Floats | list[float]) -> pl.Series:
    nanoseconds = _BEGIN_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
    return pl.Series("t", nanoseconds).cast(pl.Datetime("ns", "UTC"))
