"""Are claims of a track as right as they say?

`python -m benchmarks.truth.calibration [--claims N] [--seed S] [--family F]`.

Runs on tracks beside each other whose own track is known. The generator knows nothing of the matcher's model: lines
cut alike or on one track only, turnouts and yards on one side, survey errors per track, per element or by distance, a
bias of the run, errors of four Gauss-Markov processes (DIAG Table 1) of which the receiver's own may be quicker or
slower, stated sigmas right, half of the truth, double, or not stated at all. A run is one trial, since its claim hardly
changes.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from schemas.arrays import floats
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import Links, Track
from schemas.run import Site

ORIGIN_DEG = (50.0, 14.0)
LENGTH_M = 6_000.0
# Share of the variance and time constant [s] (DIAG Table 1 at 45 degrees); the last is the receiver's own.
NOISE = ((0.083, 360.0), (0.014, 1800.0), (0.150, 3600.0), (0.752, 100.0))
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
SURE, LIKELY = 0.99, 0.9


@dataclass(frozen=True)
class Family:
    """How the tracks of a family of runs are cut (`cuts`), surveyed (`law`), and what their positions suffer.

    `cuts`: alike, joints or turnouts on the first track only, or a yard on its side. `law`: survey errors constant per
    track, per element, or by distance; none stands for any of them.
    """

    cuts: str = "joints"
    law: str | None = None
    tau_s: tuple[float, float] = (100.0, 100.0)
    bias_m: float | None = None


FAMILIES = {
    "cut alike": Family("alike", "element"),
    "joints on one track": Family("joints", "element"),
    "joints, survey by distance": Family("joints", "distance"),
    "joints, survey per track": Family("joints", "track"),
    "turnouts on one track": Family("turnouts"),
    "yard on one side": Family("yard"),
    "receiver's errors of 10 to 200 s": Family(tau_s=(10.0, 200.0)),
    "bias of 2.5 m": Family(bias_m=2.5),
}


@dataclass(frozen=True)
class Trial:
    """A run, its site, and the name of its track: the first letter of its elements."""

    fixes: pl.DataFrame
    odometer: pl.DataFrame
    site: Site
    track: str


@dataclass(frozen=True)
class Claim:
    """The largest claims of a run, live and in hindsight, and whether no wrong track was claimed."""

    track: str
    gate: float
    gate_right: bool
    path: float
    path_right: bool


def trial(seed: int, family: Family = FAMILIES["cut alike"]) -> Trial:
    """One run by chance; the same seed gives the same run."""
    rng = np.random.default_rng([seed, *repr(family).encode()])
    spacing = rng.uniform(3.4, 6.0)
    # A third track beside two that are cut alike; else two, of which either is the train's as often.
    lateral = spacing * np.arange(3 if family.cuts == "alike" and rng.random() < 0.25 else 2)
    own = int(rng.integers(len(lateral)))
    survey_m = float(rng.choice([0.02, 0.3, 1.0], p=[0.35, 0.4, 0.25]))
    sigma_m = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    speed = rng.uniform(15.0, 35.0)
    t_s = np.arange(0.0, rng.uniform(60.0, (LENGTH_M - 100.0) / speed), 1.0)
    x = 50.0 + speed * t_s
    tau_s = float(np.exp(rng.uniform(*np.log(family.tau_s))))
    error = np.column_stack([noise(rng, len(x), 1.0, sigma_m, tau_s) for _ in range(2)])
    bias_m = 1.5 * rng.normal() if family.bias_m is None else rng.choice([-1.0, 1.0]) * family.bias_m
    site = tracks(rng, dict(zip("abc", lateral.tolist(), strict=False)), survey_m, family)
    places = x + error[:, 0], lateral[own] + bias_m + error[:, 1]
    odometer = odometer_at(t_s, x * (1.0 + 0.004 * rng.normal()))
    return Trial(fixes_at(*places, t_s, stated(rng, sigma_m)), odometer, site, "abc"[own])


def stated(rng: np.random.Generator, sigma_m: float) -> float | None:
    """The sigma that the receiver gives: right, half, double, or none."""
    factor = rng.choice([1.0, 0.5, 2.0, 0.0])
    return sigma_m * factor if factor else None


def noise(
    rng: np.random.Generator, count: int, step_s: float, sigma_m: float, own_tau_s: float = NOISE[-1][1]
) -> np.ndarray:
    """Four first-order Gauss-Markov processes, stationary from the start [m]."""
    from scipy.signal import lfilter  # takes long to load

    total = np.zeros(count)
    for share, tau_s in (*NOISE[:-1], (NOISE[-1][0], own_tau_s)):
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


def tracks(rng: np.random.Generator, lateral: dict[str, float], survey_m: float, family: Family) -> Site:
    """Straight tracks beside each other, surveyed with errors; nothing joins them."""
    law = family.law or str(rng.choice(["track", "element", "distance"]))
    crooked = np.sort(rng.uniform(200.0, LENGTH_M - 200.0, int(rng.integers(2, 9))))
    even = np.arange(1_500.0, LENGTH_M, 1_500.0)
    pieces: dict[str, np.ndarray] = {}
    links: list[tuple[str, int, str, int, str]] = []
    for track, y in lateral.items():
        cuts = even if family.cuts == "alike" else crooked if track == "a" else np.zeros(0)
        error = survey_error(rng, law, survey_m)
        ends = [0.0, *cuts.tolist(), LENGTH_M]
        for number, (start, end) in enumerate(itertools.pairwise(ends)):
            name, x = f"{track}{number}", np.linspace(start, end, max(2, round((end - start) / 50.0) + 1))
            pieces[name] = np.column_stack([x, y + error(x, number)])
            if number:
                links.append((f"{track}{number - 1}", 1, name, 0, "both"))
            if number and track == "a" and family.cuts in ("turnouts", "yard"):
                siding = number if family.cuts == "yard" else 0
                pieces[f"t{number}"] = turnout(start, y + float(error(x[:1], number)[0]), siding)
                links.append((f"a{number - 1}", 1, f"t{number}", 0, "both"))
    return survey_of(pieces, links, survey_m)


def survey_error(rng: np.random.Generator, law: str, survey_m: float) -> Callable[[np.ndarray, int], np.ndarray]:
    """Errors of the survey of one track at places x, by its element's number [m]."""
    if law == "track":
        constant = survey_m * rng.normal()
        return lambda x, number: np.full(len(x), constant)
    if law == "element":
        each = survey_m * rng.normal(size=20)
        return lambda x, number: np.full(len(x), each[number])
    at = np.arange(0.0, LENGTH_M + 50.0, 50.0)
    values = gauss_markov(rng, len(at), 50.0 / float(np.exp(rng.uniform(np.log(100.0), np.log(1000.0)))))
    return lambda x, number: survey_m * np.interp(x, at, values)


def gauss_markov(rng: np.random.Generator, count: int, steps_per_tau: float) -> np.ndarray:
    """First-order Gauss-Markov noise of variance one, stationary from the start."""
    from scipy.signal import lfilter  # takes long to load

    keep = float(np.exp(-steps_per_tau))
    shocks = rng.normal(size=count)
    shocks[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], shocks))


def turnout(start: float, y: float, siding: int) -> np.ndarray:
    """A branch to the right at 1 in 12, away for good, or into a siding so many times 4.5 m aside."""
    x = np.arange(0.0, 601.0 if not siding else LENGTH_M - start, 20.0)
    # A curve of 1000 m radius up to that angle, then straight on.
    aside = np.where(x < 83.0, x**2 / 2_000.0, 83.0**2 / 2_000.0 + (x - 83.0) / 12.0)
    return np.column_stack([start + x, y - np.minimum(aside, 4.5 * siding or np.inf)])


def survey_of(pieces: dict[str, np.ndarray], links: list[tuple[str, int, str, int, str]], survey_m: float) -> Site:
    """Elements of points in metres as a site."""
    frames = []
    for name, points in pieces.items():
        latitude, longitude = degrees(*points.T)
        measure = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        columns = {"measure_m": measure, "latitude_deg": latitude, "longitude_deg": longitude}
        frames.append(pl.DataFrame({"netelement_id": [name] * len(points), **columns}))
    height, sigma = pl.lit(None, dtype=pl.Float64).alias("height_m"), pl.lit(survey_m).alias("sigma_m")
    relations = pl.DataFrame(links, schema=list(Links.columns()), orient="row")
    return Site(conform(pl.concat(frames).with_columns(height, sigma), Track), conform(relations, Links))


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
    found = match(one.fixes, odometry, one.site, Vehicle(), MatchingConfig(), FixSigma()).epochs.table
    right = (found["netelement_id"].str.head(1) == one.track).fill_null(False).to_numpy()
    known = found["netelement_id"].is_not_null().to_numpy()
    gate, gate_right = largest(floats(found, "gate_probability"), right, known & ~right)
    path, path_right = largest(floats(found, "path_probability"), right, known & ~right)
    return Claim(one.track, gate, gate_right, path, path_right)


def largest(claimed: np.ndarray, right: np.ndarray, wrong: np.ndarray) -> tuple[float, bool]:
    """The largest claim of a run, and whether none of a wrong track was likely, or as large as the right one's."""
    best, worst = (float(np.nan_to_num(claimed[rows]).max(initial=0.0)) for rows in (right, wrong))
    return max(best, worst), worst < min(best, LIKELY)


def claims(runs: int, seed: int, family: Family = FAMILIES["cut alike"]) -> list[Claim]:
    return [claim(trial(seed * 1_000_000 + number, family)) for number in range(runs)]


def enough_claims(wanted: int, seed: int, family: Family, most: int) -> list[Claim]:
    """Runs until so many are sure of a track, live; at most so many runs."""
    found: list[Claim] = []
    while len(found) < most and sum(one.gate >= SURE for one in found) < wanted:
        found += [claim(trial(seed * 1_000_000 + len(found) + k, family)) for k in range(20)]
    return found


def reliability(found: list[Claim], name: str) -> pl.DataFrame:
    """Per class of claims how many runs, the mean claim, and how many were right."""
    claimed, right = _claimed(found, name)
    rows = []
    for low, high in zip((0.0, *LEVELS[:-1]), LEVELS, strict=True):
        inside = (claimed >= low) & ((claimed < high) | (high == LEVELS[-1]))
        if inside.any():
            rows.append((low, high, int(inside.sum()), float(claimed[inside].mean()), float(right[inside].mean())))
    return pl.DataFrame(rows, schema=["from", "to", "runs", "mean_claim", "right"], orient="row")


def figures(families: dict[str, list[Claim]]) -> list[Figure]:
    """Of each family and of all: wrong shares of the sure, right ones of the likely, how often a claim is reached."""
    everything = [one for found in families.values() for one in found]
    out = []
    for title, found in [*families.items(), ("all families", everything)]:
        for name in ("gate", "path"):
            claimed, right = _claimed(found, name)
            sure, likely = claimed >= SURE, (claimed >= LIKELY) & (claimed < SURE)
            wrongs, count = int((~right[sure]).sum()), int(sure.sum())
            about = f"{title}, {name}: "
            share = wrongs / count if count else 0.0
            # Of one family so few claims that are wrong by chance do not count; of all together they do.
            low = share if title == "all families" else least_share(wrongs, count)
            out.append(Figure(f"{about}wrong of {count} sure runs ({wrongs}), least share", low, "", 0.01))
            if likely.any():
                title_of = f"{about}right of {likely.sum()} likely runs"
                out.append(Figure(title_of, float(right[likely].mean()), "", 0.9, "above"))
            out.append(Figure(f"{about}share of {len(found)} runs that are sure", float(sure.mean()), ""))
        for track in "ab":
            own = [one for one in found if one.track == track]
            wins = float(np.mean([one.path_right for one in own])) if own else 0.0
            out.append(Figure(f"{title}: right of {len(own)} runs on {track}", wins, ""))
    return out


def least_share(wrongs: int, count: int) -> float:
    """Lower end of the exact two-sided 95 % interval (Clopper and Pearson)."""
    from scipy.stats import beta  # takes long to load

    return float(beta.ppf(0.025, wrongs, count - wrongs + 1)) if wrongs else 0.0


def _claimed(found: list[Claim], name: str) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.array([getattr(one, name) for one in found]),
        np.array([getattr(one, f"{name}_right") for one in found]),
    )


def measure(out: Path) -> list[Figure]:
    """All figures over 300 sure runs of each family; nothing is written."""
    return figures({name: enough_claims(300, 1, family, 3000) for name, family in FAMILIES.items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--claims", type=int, default=300, help="sure runs of each family")
    parser.add_argument("--runs", type=int, default=3000, help="runs of each family at most")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", choices=FAMILIES, action="append", help="these families only")
    options = parser.parse_args()
    families = {
        name: enough_claims(options.claims, options.seed, FAMILIES[name], options.runs)
        for name in options.family or FAMILIES
    }
    everything = [one for found in families.values() for one in found]
    for name in ("gate", "path"):
        print(f"\n{name}_probability, {len(everything)} runs, seed {options.seed}")
        print("  claim          runs   mean claim   right")
        for low, high, count, mean, right in reliability(everything, name).iter_rows():
            print(f"  {low:4.2f} to {high:4.2f} {count:7d} {mean:12.3f} {right:7.3f}")
    for figure in figures(families):
        verdict = {True: " met", False: " MISSED", None: ""}[figure.met]
        target = "" if figure.target is None else f" (target {figure.better} {figure.target:.2f})"
        print(f"{figure.name:<80} {figure.value:7.4f}{target}{verdict}")


if __name__ == "__main__":
    main()
