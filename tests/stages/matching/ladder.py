"""Two parallel tracks with a crossover, and runs over it whose track is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from schemas.arrays import Floats
from schemas.conform import conform
from schemas.enums import Fix
from schemas.inputs import Links, Track
from schemas.run import Site
from tests.tables import WHEEL

ORIGIN_DEG = (50.0, 14.0)
SPACING_M = 4.0
SWITCH_M, CROSSOVER_M, END_M = 1000.0, 60.0, 3000.0
ROUTES = {"A": ("A1", "A2"), "B": ("B1", "B2"), "AB": ("A1", "X", "B2")}


@dataclass(frozen=True)
class Journey:
    """A run, the lateral place of the train [m], and the route it took."""

    fixes: pl.DataFrame
    odometer: pl.DataFrame
    lateral_m: Floats
    route: tuple[str, ...]


def degrees(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
    """Places east and north of the origin [m] as latitude and longitude; right to 1e-6 of the distance within 3 km."""
    latitude = ORIGIN_DEG[0] + np.degrees(y_m / 6_372_955.9)
    return latitude, ORIGIN_DEG[1] + np.degrees(x_m / (6_390_702.0 * np.cos(np.radians(ORIGIN_DEG[0]))))


def lateral_m(x_m: Floats) -> Floats:
    """The crossover's offset along its length: a smooth S from one track to the other."""
    share = np.clip((x_m - SWITCH_M) / CROSSOVER_M, 0.0, 1.0)
    return SPACING_M * (3.0 * share**2 - 2.0 * share**3)


def ladder(sigma_m: float | None = 0.02) -> Site:
    """A1-A2 and B1-B2 run east, B 4 m north of A; X leads from A to B."""
    joint = SWITCH_M + CROSSOVER_M
    parts = {
        "A1": (0.0, SWITCH_M, 0.0), "A2": (SWITCH_M, END_M, 0.0),
        "B1": (0.0, joint, SPACING_M), "B2": (joint, END_M, SPACING_M), "X": (SWITCH_M, joint, None),
    }  # fmt: skip
    frames = []
    for name, (start, end, y) in parts.items():
        x = np.arange(start, end + 1.0, 5.0)
        latitude, longitude = degrees(x, lateral_m(x) if y is None else np.full_like(x, y))
        columns = {"measure_m": x - start, "latitude_deg": latitude, "longitude_deg": longitude}
        frames.append(pl.DataFrame({"netelement_id": [name] * len(x), **columns}))
    blank = pl.lit(None, dtype=pl.Float64)
    track = pl.concat(frames).with_columns(blank.alias("height_m"), pl.lit(sigma_m, dtype=pl.Float64).alias("sigma_m"))
    rows = [("A1", 1, "A2", 0), ("A1", 1, "X", 0), ("X", 1, "B2", 0), ("B1", 1, "B2", 0)]
    links = pl.DataFrame([(*row, "both") for row in rows], schema=list(Links.columns()), orient="row")
    return Site(conform(track, Track), conform(links, Links))


def journey(seed: int, sigma_m: float = 1.0, tau_s: float = 100.0, rate_hz: float = 2.0) -> Journey:
    """A run at 20 m/s over one of the routes by chance, position errors Gauss-Markov, covariance given."""
    rng = np.random.default_rng(seed)
    route = ("A", "AB", "B")[int(rng.integers(3))]
    t_s = np.arange(0.0, 145.0, 1.0 / rate_hz)
    x = 50.0 + 20.0 * t_s
    y = {"A": np.zeros_like(x), "B": np.full_like(x, SPACING_M), "AB": lateral_m(x)}[route]
    error = np.column_stack([gauss_markov(rng, len(x), 1.0 / rate_hz, sigma_m, tau_s) for _ in range(2)])
    latitude, longitude = degrees(x + error[:, 0], y + error[:, 1])
    time = pl.Series("t", (t_s * 1e9).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))
    fixes = pl.DataFrame(
        {
            "t": time,
            "solution": ["primary"] * len(x),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": pl.Series([None] * len(x), dtype=pl.Float64),
            "cov_ee_m2": np.full(len(x), sigma_m**2),
            "cov_en_m2": np.zeros(len(x)),
            "cov_nn_m2": np.full(len(x), sigma_m**2),
            "fix": [Fix.SBAS.value] * len(x),
        }
    )
    odometer = pl.DataFrame({"t": time, "distance_m": 1.004 * (x - x[0]), "speed_mps": np.full(len(x), 20.08)})
    blank = [pl.lit(None, dtype=pl.Float64).alias("sigma_speed_mps"), pl.lit(None, dtype=pl.Boolean).alias("slip")]
    return Journey(fixes, odometer.with_columns(*blank, WHEEL), y, ROUTES[route])


def gauss_markov(rng: np.random.Generator, count: int, step_s: float, sigma_m: float, tau_s: float) -> Floats:
    """First-order Gauss-Markov noise, stationary from the start."""
    keep = float(np.exp(-step_s / tau_s))
    shocks = rng.normal(size=count) * sigma_m
    noise = np.empty(count)
    noise[0] = shocks[0]
    for k in range(1, count):
        noise[k] = keep * noise[k - 1] + np.sqrt(1.0 - keep**2) * shocks[k]
    return noise


def matched_lateral_m(epochs: pl.DataFrame) -> Floats:
    """Lateral place of the matched element at each epoch [m]."""
    name, measure = epochs["netelement_id"].to_numpy(), epochs["measure_m"].to_numpy()
    constant = np.where(np.isin(name, ["B1", "B2"]), SPACING_M, 0.0)
    return np.where(name == "X", lateral_m(SWITCH_M + measure), constant)
