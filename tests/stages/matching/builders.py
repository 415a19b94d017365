"""Sites and runs laid out in metres about one place, for tests with answers known beforehand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.matching import Match, match
from pipeline.stages.odometry import odometry_of
from schemas.arrays import Floats
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import Links, Track
from schemas.run import Site
from tests.stages.matching.ladder import degrees
from tests.tables import WHEEL

Link = tuple[str, int, str, int, str]


def line(start: tuple[float, float], end: tuple[float, float], spacing_m: float = 10.0) -> Floats:
    """Points (x east, y north) of a straight element."""
    count = max(1, round(float(np.hypot(end[0] - start[0], end[1] - start[1])) / spacing_m))
    return np.linspace(start, end, count + 1)


def site(
    elements: dict[str, Floats],
    links: Sequence[Link] = (),
    route: Sequence[tuple[str, str]] | None = None,
    heights_m: dict[str, Floats] | None = None,
    sigma_m: float | None = 0.02,
) -> Site:
    """Elements of points in metres; measures are plane distances."""
    parts = []
    for name, points in elements.items():
        latitude, longitude = degrees(points[:, 0], points[:, 1])
        steps = np.hypot(*np.diff(points, axis=0).T)
        height = None if heights_m is None else heights_m[name]
        parts.append(
            pl.DataFrame(
                {
                    "netelement_id": [name] * len(points),
                    "measure_m": np.concatenate([[0.0], np.cumsum(steps)]),
                    "latitude_deg": latitude,
                    "longitude_deg": longitude,
                    "height_m": pl.Series([None] * len(points) if height is None else height, dtype=pl.Float64),
                    "sigma_m": pl.Series([sigma_m] * len(points), dtype=pl.Float64),
                }
            )
        )
    relations = pl.DataFrame(list(links), schema=list(Links.columns()), orient="row")
    frame = None if route is None else pl.DataFrame(list(route), schema=["netelement_id", "direction"], orient="row")
    return Site(conform(pl.concat(parts), Track), conform(relations, Links), route=frame)


def run(x_m: Floats, y_m: Floats, rate_hz: float = 1.0, sigma_m: float | None = 1.0, **columns: object) -> pl.DataFrame:
    """A `gnss` stream through places in metres."""
    count = len(x_m)
    latitude, longitude = degrees(np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float))
    variance = None if sigma_m is None else sigma_m**2
    frame = pl.DataFrame(
        {
            "t": times(count, rate_hz),
            "solution": ["primary"] * count,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": pl.Series([None] * count, dtype=pl.Float64),
            "cov_ee_m2": pl.Series([variance] * count, dtype=pl.Float64),
            "cov_en_m2": pl.Series([0.0 if variance else None] * count, dtype=pl.Float64),
            "cov_nn_m2": pl.Series([variance] * count, dtype=pl.Float64),
            "fix": ["sbas"] * count,
        }
    )
    return frame.with_columns(**{name: pl.Series(values) for name, values in columns.items()})


def odometer(distance_m: Floats, rate_hz: float = 1.0) -> pl.DataFrame:
    """An odometer stream with the same stamps as a run."""
    distance = np.asarray(distance_m, dtype=float)
    frame = pl.DataFrame({"t": times(len(distance), rate_hz), "distance_m": distance})
    return frame.with_columns(
        pl.Series("speed_mps", np.gradient(distance) * rate_hz),
        pl.lit(None, dtype=pl.Float64).alias("sigma_speed_mps"),
        pl.lit(None, dtype=pl.Boolean).alias("slip"),
        WHEEL,
    )


def times(count: int, rate_hz: float) -> pl.Series:
    return pl.Series("t", np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def matched(
    fixes: pl.DataFrame,
    place: Site,
    distance: pl.DataFrame | None = None,
    vehicle: Vehicle | None = None,
    reads: pl.DataFrame | None = None,
) -> Match:
    odometry = odometry_of(distance, vehicle or Vehicle(), Configuration())
    return match(fixes, odometry, place, vehicle or Vehicle(), MatchingConfig(), FixSigma(), reads)
