"""Are claims of a track as right as they say? `python -m benchmarks.calibration [--runs N] [--seed S]`.

Runs on parallel tracks whose own track is known. The generator knows nothing of the matcher's model: a bias per run of
1.5 m, a survey error per element, errors of four Gauss-Markov processes (DIAG Table 1), stated sigmas right, half of
the truth, double, or not stated at all. A run is one trial, since its claim hardly changes.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from pipeline.matching import match
from pipeline.odometry import odometry_of
from schemas.arrays import floats
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import Links, Track
from schemas.run import Site

ORIGIN_DEG = (50.0, 14.0)
LENGTH_M, ELEMENT_M = 6_000.0, 1_500.0
# Share of the variance and time constant [s] (DIAG Table 1 at 45 degrees).
NOISE = ((0.083, 360.0), (0.014, 1800.0), (0.150, 3600.0), (0.752, 100.0))
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True)
class Trial:
    """A run, its site, and the name of its track's elements."""

    fixes: pl.DataFrame
    odometer: pl.DataFrame
    site: Site
    track: str


@dataclass(frozen=True)
class Claim:
    """What a run claims of its own track at its end (causal) and in its middle (smoothed), and whether it is right."""

    gate: float
    path: float
    right: bool


def trial(seed: int) -> Trial:
    """One run by chance; the same seed gives the same run."""
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(3.4, 6.0)
    lateral = spacing * np.arange(rng.choice([2, 3], p=[0.75, 0.25]))
    names = "abc"[: len(lateral)]
    own = int(rng.integers(len(lateral)))
    survey_m = float(rng.choice([0.02, 0.2, 0.5]))
    sigma_m = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    rate_hz, speed = float(rng.choice([1.0, 10.0])), rng.uniform(15.0, 35.0)
    t_s = np.arange(0.0, rng.uniform(60.0, (LENGTH_M - 100.0) / speed), 1.0 / rate_hz)
    x = 50.0 + speed * t_s
    error = np.column_stack([noise(rng, len(x), 1.0 / rate_hz, sigma_m) for _ in range(2)])
    y = lateral[own] + rng.normal() * 1.5
    return Trial(
        fixes_at(x + error[:, 0], y + error[:, 1], t_s, stated(rng, sigma_m)),
        odometer_at(t_s, x * (1.0 + 0.004 * rng.normal())),
        parallel(rng, dict(zip(names, lateral.tolist(), strict=True)), survey_m),
        names[own],
    )


def stated(rng: np.random.Generator, sigma_m: float) -> float | None:
    """The sigma that the receiver gives: right, half, double, or none."""
    factor = rng.choice([1.0, 0.5, 2.0, 0.0])
    return sigma_m * factor if factor else None


def noise(rng: np.random.Generator, count: int, step_s: float, sigma_m: float) -> np.ndarray:
    """Four first-order Gauss-Markov processes, stationary from the start [m]."""
    from scipy.signal import lfilter  # takes long to load

    total = np.zeros(count)
    for share, tau_s in NOISE:
        keep = float(np.exp(-step_s / tau_s))
        shocks = rng.normal(size=count) * sigma_m * np.sqrt(share)
        shocks[1:] *= np.sqrt(1.0 - keep**2)
        total += lfilter([1.0], [1.0, -keep], shocks)
    return total


def degrees(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places east and north of the origin [m] on the ellipsoid of WGS 84."""
    sin = np.sin(np.radians(ORIGIN_DEG[0]))
    meridian = 6_378_137.0 * (1.0 - 0.00669437999) / (1.0 - 0.00669437999 * sin**2) ** 1.5
    normal = 6_378_137.0 / np.sqrt(1.0 - 0.00669437999 * sin**2) * np.cos(np.radians(ORIGIN_DEG[0]))
    return ORIGIN_DEG[0] + np.degrees(y / meridian), ORIGIN_DEG[1] + np.degrees(x / normal)


def parallel(rng: np.random.Generator, tracks: dict[str, float], survey_m: float) -> Site:
    """Straight tracks in elements, each surveyed with an error of its own; nothing joins the tracks."""
    frames, links = [], []
    cuts = np.arange(0.0, LENGTH_M + 1.0, ELEMENT_M)
    for track, y in tracks.items():
        for number, (start, end) in enumerate(itertools.pairwise(cuts.tolist())):
            x = np.linspace(start, end, 31)
            latitude, longitude = degrees(x, np.full(31, y + survey_m * rng.normal()))
            columns = {"measure_m": x - start, "latitude_deg": latitude, "longitude_deg": longitude}
            frames.append(pl.DataFrame({"netelement_id": [f"{track}{number}"] * 31, **columns}))
            if number:
                links.append((f"{track}{number - 1}", 1, f"{track}{number}", 0, "both"))
    height, sigma = pl.lit(None, dtype=pl.Float64).alias("height_m"), pl.lit(survey_m).alias("sigma_m")
    relations = pl.DataFrame(links, schema=list(Links.columns()), orient="row")
    track_table = pl.concat(frames).with_columns(height, sigma)
    return Site(conform(track_table, Track), conform(relations, Links))


def fixes_at(x: np.ndarray, y: np.ndarray, t_s: np.ndarray, sigma_m: float | None) -> pl.DataFrame:
    latitude, longitude = degrees(x, y)
    variance = pl.lit(None if sigma_m is None else sigma_m**2, dtype=pl.Float64)
    frame = pl.DataFrame({"t": stamps(t_s), "latitude_deg": latitude, "longitude_deg": longitude})
    return frame.with_columns(
        pl.lit("primary").alias("solution"),
        pl.lit(None, dtype=pl.Float64).alias("height_m"),
        variance.alias("cov_ee_m2"),
        (0.0 * variance).alias("cov_en_m2"),
        variance.alias("cov_nn_m2"),
        pl.lit("sbas").alias("fix"),
        pl.lit(None, dtype=pl.Float64).alias("hpl_m"),
    )


def odometer_at(t_s: np.ndarray, distance_m: np.ndarray) -> pl.DataFrame:
    frame = pl.DataFrame({"t": stamps(t_s), "distance_m": distance_m - distance_m[0]})
    blank = (pl.lit(None, dtype=pl.Float64).alias("sigma_speed_mps"), pl.lit(None, dtype=pl.Boolean).alias("slip"))
    return frame.with_columns(pl.Series("speed_mps", np.gradient(distance_m, t_s)), *blank)


def stamps(t_s: np.ndarray) -> pl.Series:
    return pl.Series("t", np.round(t_s * 1e9).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def claim(one: Trial) -> Claim:
    odometry = odometry_of(one.odometer, Vehicle(), Configuration())
    found = match(one.fixes, odometry, one.site, Vehicle(), MatchingConfig(), FixSigma()).epochs
    right = bool(np.mean((found["netelement_id"].str.head(1) == one.track).to_numpy()) > 0.5)
    gate, path = (np.nan_to_num(floats(found, f"{name}_probability")) for name in ("gate", "path"))
    return Claim(float(gate.max()), float(np.median(path)), right)


def claims(runs: int, seed: int) -> list[Claim]:
    return [claim(trial(seed * 1_000_000 + number)) for number in range(runs)]


def reliability(found: list[Claim], name: str) -> pl.DataFrame:
    """Per class of claims how many runs, the mean claim, and how many were right."""
    claimed, right = np.array([getattr(one, name) for one in found]), np.array([one.right for one in found])
    rows = []
    for low, high in zip((0.0, *LEVELS[:-1]), LEVELS, strict=True):
        inside = (claimed >= low) & ((claimed < high) | (high == LEVELS[-1]))
        if inside.any():
            rows.append((low, high, int(inside.sum()), float(claimed[inside].mean()), float(right[inside].mean())))
    return pl.DataFrame(rows, schema=["from", "to", "runs", "mean_claim", "right"], orient="row")


def figures(found: list[Claim]) -> list[Figure]:
    """Wrong shares among the runs that claim at least so much; targets are what is claimed."""
    out = []
    right = np.array([one.right for one in found])
    for name in ("gate", "path"):
        claimed = np.array([getattr(one, name) for one in found])
        for level in (0.9, 0.95, 0.99):
            count = int((claimed >= level).sum())
            share = float((~right[claimed >= level]).mean()) if count else 0.0
            out.append(Figure(f"wrong runs of {count} with {name} >= {level:g}", share, "", 1.0 - level))
    out.append(Figure(f"right of all {len(found)} runs", float(right.mean()), ""))
    return out


def measure(out: Path) -> list[Figure]:
    """All figures over 2,000 runs; nothing is written."""
    return figures(claims(2000, 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    found = claims(options.runs, options.seed)
    for name in ("gate", "path"):
        print(f"\n{name}_probability, {options.runs} runs, seed {options.seed}")
        print("  claim          runs   mean claim   right")
        for low, high, count, mean, right in reliability(found, name).iter_rows():
            print(f"  {low:4.2f} to {high:4.2f} {count:7d} {mean:12.3f} {right:7.3f}")
    for figure in figures(found):
        verdict = {True: " met", False: " MISSED", None: ""}[figure.met]
        target = "" if figure.target is None else f" (target at most {figure.target:.2f})"
        print(f"{figure.name:<40} {figure.value:7.4f}{target}{verdict}")


if __name__ == "__main__":
    main()
