"""Speed and calibration of map matching: `python -m benchmarks.matching [--seeds N] [--no-shapely]`.

Speeds are given as multiples of what scipy's KD-tree takes to find the nearest vertex of the same points, so
that they mean the same on every machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import polars as pl
from scipy.spatial import cKDTree

from pipeline.geodesy import points_of
from pipeline.matching import match
from pipeline.matching.leg import Visit, leg_of, nearest_on_leg, path_at
from pipeline.track import geometric_measures_m, track_of
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.inputs import Links, Track
from schemas.run import Site

EPOCHS = 36_000
ORIGIN_DEG = (50.0, 14.0)
METRES_PER_DEGREE = (111_229.0, 71_695.0)


def best_of(times: int, work: Callable[[], object]) -> float:
    """Least of several timings [s]."""
    taken = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return min(taken)


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


def shapely_s(site: Site, fixes: pl.DataFrame, count: int = 500) -> float | None:
    """`line_locate_point` on the single line, from a part of the epochs; none without shapely."""
    try:
        import shapely
    except ImportError:
        return None
    line, points = shapely.LineString(planar(site.track)), shapely.points(planar(fixes[:: EPOCHS // count]))
    return best_of(1, lambda: shapely.line_locate_point(line, points)) * EPOCHS / len(points)


def say(what: str, seconds: float, yardstick: float, target: float) -> None:
    ratio = seconds / yardstick
    verdict = "met" if ratio < target else "MISSED"
    print(f"{what:<58} {seconds * 1e3:8.1f} ms {ratio:7.2f} x KD-tree (target < {target:g}) {verdict}")


def speeds(with_shapely: bool) -> None:
    site = single_line()
    fixes, odometer = journey(site)
    track = track_of(site.track)
    leg = leg_of(track, [Visit(0, True)])
    latitude, longitude = fixes["latitude_deg"].to_numpy(), fixes["longitude_deg"].to_numpy()

    def project() -> np.ndarray:
        return path_at(leg, nearest_on_leg(points_of(latitude, longitude), leg))

    def whole(place: Site) -> Callable[[], object]:
        return lambda: match(run, distance, place, Vehicle(), MatchingConfig(), FixSigma())

    yardstick = kd_tree_s(site, fixes)
    print(f"{EPOCHS} epochs on 100 km, vertices 5 m apart; KD-tree {yardstick * 1e3:.1f} ms")
    projected = best_of(5, project)
    say("projection on the line", projected, yardstick, 4.0)
    run, distance = fixes, odometer
    say("the whole stage: path, posterior, all columns", best_of(3, whole(site)), yardstick, 12.0)
    if with_shapely and (by_shapely := shapely_s(site, fixes)) is not None:
        print(f"shapely line_locate_point {by_shapely:.1f} s: {by_shapely / projected:.0f} times the projection")
    big = network()
    run, distance = journey(big)
    yardstick = kd_tree_s(big, run)
    count = big.track["netelement_id"].n_unique()
    print(f"network of {count} elements, {big.track.height} vertices; KD-tree {yardstick * 1e3:.1f} ms")
    say("the whole stage on the network", best_of(3, whole(big)), yardstick, 20.0)


def calibration(seeds: int) -> None:
    """Parallel tracks 4 m apart with a crossover, Gauss-Markov errors of 100 s."""
    from tests.matching.ladder import journey as trip_of
    from tests.matching.ladder import ladder, matched_lateral_m

    site = ladder()
    for sigma_m in (1.0, 2.0):
        claims, rights, wrong = [], [], 0
        for seed in range(seeds):
            trip = trip_of(seed, sigma_m)
            epochs = match(trip.fixes, trip.odometer, site, Vehicle(), MatchingConfig(), FixSigma()).epochs
            right = np.abs(matched_lateral_m(epochs) - trip.lateral_m) < 1.0
            claim = epochs["path_probability"].to_numpy()
            wrong += bool(((claim > 0.99) & ~right).mean() > 0.01)
            claims.append(claim)
            rights.append(right)
        claim, right = np.concatenate(claims), np.concatenate(rights)
        print(f"{seeds} seeds at {sigma_m} m: {wrong} claim a wrong track above 0.99 for over 1 % of epochs;")
        print(f"  mean claim {claim.mean():.3f}, right {right.mean():.3f}")
        for low, high in ((0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 0.99), (0.99, 1.01)):
            inside = (claim >= low) & (claim < high)
            if inside.any():
                print(f"  claimed {claim[inside].mean():.3f}: right {right[inside].mean():.3f} ({inside.sum()} epochs)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--no-shapely", action="store_true")
    options = parser.parse_args()
    speeds(not options.no_shapely)
    calibration(options.seeds)


if __name__ == "__main__":
    main()
