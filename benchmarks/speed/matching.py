"""Speed and calibration of map matching: `python -m benchmarks.speed.matching [--seeds N]`.

Speeds are given as multiples of what scipy's KD-tree takes to find the nearest vertex of the same points, so
that they mean the same on every machine.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import polars as pl
from scipy.spatial import cKDTree

from benchmarks.results import Figure, best_of
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.segments import Visit, leg_of, nearest_on_leg, path_at
from pipeline.stages.track.survey import geometric_measures_m, track_of
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.inputs import Links, Track
from schemas.run import Site

EPOCHS = 36_000
ORIGIN_DEG = (50.0, 14.0)
METRES_PER_DEGREE = (111_229.0, 71_695.0)


def degrees(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return ORIGIN_DEG[0] + y / METRES_PER_DEGREE[0], ORIGIN_DEG[1] + x / METRES_PER_DEGREE[1]


def centre_line(length_m: float, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A winding line as railways are: curves of 1.5 km radius and more."""
    distance = np.arange(0.0, length_m + spacing_m / 2, spacing_m)
    heading = 0.7 * np.sin(distance / 3000.0)
    x = np.concatenate([[0.0], np.cumsum(np.cos(heading[:-1]) * spacing_m)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(heading[:-1]) * spacing_m)])
    return x, y


def element(name: str, x: np.ndarray, y: np.ndarray) -> pl.DataFrame:
    latitude, longitude = degrees(x, y)
    return pl.DataFrame(
        {
            "netelement_id": [name] * len(x),
            "measure_m": geometric_measures_m(latitude, longitude, np.full(len(x), np.nan)),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": pl.Series([None] * len(x), dtype=pl.Float64),
            "sigma_m": np.full(len(x), 0.05),
        }
    )


def single_line(length_m: float = 100_000.0) -> Site:
    return Site(Track.validate(element("line", *centre_line(length_m, 5.0)), cast=True), Links.create_empty())


def network() -> Site:
    """2000 elements: a double track of 100 km in pieces of 400 m with a crossover or a siding in every
    fifth, and seven other lines of its region.
    """
    x, y = centre_line(100_000.0, 5.0)
    frames: list[pl.DataFrame] = []
    links: list[tuple[str, int, str, int, str]] = []
    cuts = np.linspace(0, len(x) - 1, 251).astype(int)
    for k, (begin, end) in enumerate(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)):
        part = slice(begin, end + 1)
        frames += [element(f"a{k}", x[part], y[part]), element(f"b{k}", x[part], y[part] + 4.5)]
        links += [(f"{t}{k - 1}", 1, f"{t}{k}", 0, "both") for t in "ab"] if k else []
        if k % 5 == 2:
            across = 4.5 * np.linspace(0.0, 1.0, end + 1 - begin)
            frames.append(element(f"x{k}", x[part], y[part] + across))
            frames.append(element(f"s{k}", x[part], y[part] - 2 * across))
            links += [(f"a{k - 1}", 1, f"{t}{k}", 0, "both") for t in "xs"]
            links.append((f"x{k}", 1, f"b{k + 1}", 0, "both"))
    x, y = x[::4], y[::4]
    others = [(line, k) for line in range(7) for k in range(200)]
    for line, k in others:
        part = slice(25 * k, 25 * k + 26)
        frames.append(element(f"o{line}_{k}", x[part], y[part] + 3000.0 * (line + 1)))
        links += [(f"o{line}_{k - 1}", 1, f"o{line}_{k}", 0, "both")] if k else []
    relations = pl.DataFrame(links, schema=list(Links.columns()), orient="row")
    return Site(Track.validate(pl.concat(frames), cast=True), Links.validate(relations, cast=True))


def journey(site: Site, noise_m: float = 1.0) -> tuple[pl.DataFrame, pl.DataFrame]:
    """10 Hz along the first track, one hour at 27.8 m/s, with an odometer at the same stamps."""
    rng = np.random.default_rng(1)
    main = site.track.filter(pl.col("netelement_id").str.contains("^(line|a)"))
    step = np.hypot(
        main["latitude_deg"].diff().fill_null(0.0) * METRES_PER_DEGREE[0],
        main["longitude_deg"].diff().fill_null(0.0) * METRES_PER_DEGREE[1],
    )
    at = np.cumsum(step)
    distance = np.linspace(20.0, float(at[-1]) - 20.0, EPOCHS)
    keep = np.exp(-0.1 / 100.0)
    shocks = rng.normal(size=(EPOCHS, 2)) * noise_m * np.sqrt(1 - keep**2)
    error = np.empty_like(shocks)
    error[0] = rng.normal(size=2) * noise_m
    for k in range(1, EPOCHS):
        error[k] = keep * error[k - 1] + shocks[k]
    t = pl.Series("t", np.arange(EPOCHS) * 100_000_000).cast(pl.Datetime("ns", "UTC"))
    latitude = np.interp(distance, at, main["latitude_deg"]) + error[:, 0] / METRES_PER_DEGREE[0]
    longitude = np.interp(distance, at, main["longitude_deg"]) + error[:, 1] / METRES_PER_DEGREE[1]
    fixes = pl.DataFrame(
        {
            "t": t,
            "solution": ["primary"] * EPOCHS,
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": pl.Series([None] * EPOCHS, dtype=pl.Float64),
            "cov_ee_m2": np.full(EPOCHS, noise_m**2),
            "cov_en_m2": np.zeros(EPOCHS),
            "cov_nn_m2": np.full(EPOCHS, noise_m**2),
            "fix": ["sbas"] * EPOCHS,
            "hpl_m": pl.Series([None] * EPOCHS, dtype=pl.Float64),
        }
    )
    odometer = pl.DataFrame({"t": t, "distance_m": distance * 1.002, "speed_mps": np.gradient(distance) * 10.0})
    blank = [pl.lit(None, dtype=pl.Float64).alias("sigma_speed_mps"), pl.lit(None, dtype=pl.Boolean).alias("slip")]
    return fixes, odometer.with_columns(blank)


def planar(frame: pl.DataFrame) -> np.ndarray:
    return np.column_stack(
        [frame["longitude_deg"] * METRES_PER_DEGREE[1], frame["latitude_deg"] * METRES_PER_DEGREE[0]]
    )


def kd_tree_s(site: Site, fixes: pl.DataFrame) -> float:
    """The yardstick: nearest vertex of the track for every epoch."""
    tree, points = cKDTree(planar(site.track)), planar(fixes)
    return best_of(5, lambda: tree.query(points))


def speeds() -> list[Figure]:
    """Projection, the whole stage on a line, and on a network, as multiples of the KD-tree's time."""
    site = single_line()
    fixes, odometer = journey(site)
    track = track_of(site.track)
    leg = leg_of(track, [Visit(0, True)])
    latitude, longitude = fixes["latitude_deg"].to_numpy(), fixes["longitude_deg"].to_numpy()

    def project() -> np.ndarray:
        return path_at(leg, nearest_on_leg(points_of(latitude, longitude), leg))

    yardstick, projected = kd_tree_s(site, fixes), best_of(5, project)
    figures = [
        Figure("KD-tree, nearest vertex of 36,000 epochs on 100 km", yardstick, "s"),
        Figure("projection on the line", projected / yardstick, "x KD-tree", 4.0),
        Figure("whole stage on the line", whole_s(site, fixes, odometer) / yardstick, "x KD-tree", 12.0),
    ]
    big = network()
    fixes, odometer = journey(big)
    yardstick, taken = kd_tree_s(big, fixes), whole_s(big, fixes, odometer)
    return [*figures, Figure("whole stage on a network of 2000 elements", taken / yardstick, "x KD-tree", 20.0)]


def whole_s(site: Site, fixes: pl.DataFrame, odometer: pl.DataFrame) -> float:
    """Path, claims, projection and all columns."""
    return best_of(
        3,
        lambda: match(
            fixes, odometry_of(odometer, Vehicle(), Configuration()), site, Vehicle(), MatchingConfig(), FixSigma()
        ),
    )


def calibration(seeds: int) -> list[Figure]:
    """Parallel tracks 4 m apart with a crossover, Gauss-Markov errors of 100 s."""
    from tests.stages.matching.ladder import journey as trip_of
    from tests.stages.matching.ladder import ladder, matched_lateral_m

    site, figures = ladder(), []
    for sigma_m in (1.0, 2.0):
        claims, rights, wrong = [], [], 0
        for seed in range(seeds):
            trip = trip_of(seed, sigma_m)
            epochs = match(
                trip.fixes,
                odometry_of(trip.odometer, Vehicle(), Configuration()),
                site,
                Vehicle(),
                MatchingConfig(),
                FixSigma(),
            ).epochs.table
            rights.append(np.abs(matched_lateral_m(epochs) - trip.lateral_m) < 1.0)
            claims.append(epochs["path_probability"].to_numpy())
            wrong += bool(((claims[-1] > 0.99) & ~rights[-1]).mean() > 0.01)
        claim, right = np.concatenate(claims), np.concatenate(rights)
        noise = f"at {sigma_m:g} m noise"
        target = 0.0 if sigma_m == 1.0 else None
        figures.append(Figure(f"seeds sure of a wrong track {noise}, of {seeds}", float(wrong), "", target))
        figures.append(Figure(f"mean claim {noise}", float(claim.mean()), ""))
        figures.append(Figure(f"share right {noise}", float(right.mean()), ""))
        for low, high in ((0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 0.99)):
            inside = (claim >= low) & (claim < high)
            if inside.any():
                name = f"right where {claim[inside].mean():.3f} is claimed {noise}"
                figures.append(Figure(name, float(right[inside].mean()), f"of {inside.sum()} epochs"))
    return figures


def measure(out: Path) -> list[Figure]:
    """All figures; nothing is written."""
    return [*speeds(), *calibration(200)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    options = parser.parse_args()
    for figure in [*speeds(), *calibration(options.seeds)]:
        limit = f" (target {figure.better} {figure.target:g})" if figure.target is not None else ""
        verdict = {True: " met", False: " MISSED", None: ""}[figure.met]
        print(f"{figure.name:<58} {figure.value:9.3f} {figure.unit}{limit}{verdict}")


if __name__ == "__main__":
    main()
