"""What the paper's bank lets pass: the largest unnoticed error against the time since the last independent fix.

The skies are those of the published experiment (`datasets.experiment`), the noise its Gauss-Markov errors along the
track and an odometer of 0.05 m over one second; the bank has run for 2,000 s when the fix comes. Figures are medians
over noise and headings, of the larger direction; `docs/undetected.md` has them.

python -m benchmarks.truth.unnoticed_bank
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import polars as pl
from scipy.special import chdtri

from datasets.experiment.bank import BankSpec, linear_bank
from datasets.experiment.geometry import TAUS_S, Constellation, Geometry, default_geometry
from datasets.experiment.sampling import missed_detection_probability
from pipeline.show.terminal import show_table
from pipeline.stages.monitors.axis import AxisSeries, ewma_weight, run_axis
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows
from pipeline.studies.undetected.error import largest_errors
from pipeline.studies.undetected.steps_and_ramps import Shape, largest_of_shape
from pipeline.studies.undetected.watched import NO_ROW, Watched
from schemas.arrays import Floats
from schemas.config import Configuration, MonitorConfig, threshold_factor

BANKS: dict[str, tuple[float, ...]] = {
    "0.1 0.01 0.001": (0.1, 0.01, 0.001),
    "0.1 0.01 0.002": (0.1, 0.01, 0.002),
    "0.1 0.01 0.0005": (0.1, 0.01, 0.0005),
    "0.1 0.01 0.0002": (0.1, 0.01, 0.0002),
    "0.1 0.01 0.0001": (0.1, 0.01, 0.0001),
    "0.001 alone": (0.001,),
    "0.1 0.03 0.01": (0.1, 0.03, 0.01),
}
SHAPES: tuple[Shape, ...] = ("step", "ramp")
MINUTES = (1, 10, 30, 60, 120)
HEADINGS_DEG = (0.0, 45.0, 90.0)
_WARM_S = 2000
_ODOMETER_M = 0.05
_PROBABILITY = 1e-7


def along_sigmas_m(sky: Geometry, heading_deg: float) -> Floats:
    """Deviation along the track of each source of the position error [m]."""
    heading = np.radians(heading_deg)
    ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
    sigmas: Floats = np.sqrt(np.einsum("a,jab,b->j", ahead, sky.source_covariances_m2, ahead))
    return sigmas


def noise_of(sigmas_m: Floats, seconds: int, rng: np.random.Generator) -> Floats:
    """GNSS minus odometer at 1 Hz: Gauss-Markov errors and a random walk [m]."""
    keep = np.exp(-1.0 / TAUS_S)
    error = sigmas_m * rng.standard_normal(sigmas_m.size)
    drawn = rng.standard_normal((seconds, sigmas_m.size)) * sigmas_m * np.sqrt(1.0 - keep**2)
    offset = np.cumsum(_ODOMETER_M * rng.standard_normal(seconds))
    for second in range(seconds):
        error = keep * error + drawn[second]
        offset[second] += error.sum()
    return offset


def watched_of(offset_m: Floats, sigmas_m: Floats, alphas: Floats) -> Watched:
    """What the bank watches of a run at 1 Hz."""
    size = offset_m.size
    second, zero = np.ones(size), np.zeros(size)
    fresh = np.arange(size) == 0
    spread = np.tile(sigmas_m, (size, 1))
    series = AxisSeries(
        epoch=np.arange(size),
        fresh=fresh,
        border=np.zeros(size, dtype=np.bool_),
        dt_s=second,
        rate_mps=np.diff(offset_m, prepend=offset_m[0]),
        sigma_m=spread,
        sigma_before_m=spread,
        decorrelation=np.tile(-np.expm1(-1.0 / TAUS_S), (size, 1)),
        white_m2=_ODOMETER_M**2 * second,
        border_m2=zero,
        lasting_mps=np.zeros((zero.size, 0)),
    )
    value, sigma, _ = run_axis(series, alphas)
    limit = np.where(fresh[:, None], np.inf, threshold_factor(_PROBABILITY) * sigma)
    infinite = np.full(size, np.inf)
    return Watched(
        epoch=series.epoch,
        t_s=np.arange(size, dtype=np.float64),
        fresh=fresh,
        free=series.border,
        fastest_m=5.0 * second,
        gain_s=second,
        rate_mps=series.rate_mps,
        least_mps=np.maximum(-limit[:, 0], series.rate_mps - 5.0),
        most_mps=np.minimum(limit[:, 0], series.rate_mps + 5.0),
        weight=ewma_weight(alphas, second),
        average_mps=np.where(fresh[:, None], 0.0, value[:, 1:]),
        threshold_mps=limit[:, 1:],
        low_m=-infinite,
        high_m=infinite,
        anchor=np.full(size, NO_ROW),
        held_low_m=-infinite,
        held_high_m=infinite,
        learned_m=zero,
        learned_late_m=zero,
    )


def bank_figures(
    constellation: Constellation, name: str, repetitions: int, minutes: tuple[int, ...], *, velocity: bool = False
) -> dict[str, object]:
    """One row of the table: medians of the larger direction at these times, and where the mean bound passes 20 m.

    `velocity`: it carries the fault, so that the Doppler monitor holds the fault's rate.
    """
    sky, alphas = default_geometry(constellation), np.array(BANKS[name])
    larger = []
    for repetition in range(repetitions):
        for heading in HEADINGS_DEG:
            sigmas, rng = along_sigmas_m(sky, heading), np.random.default_rng([9, repetition, int(heading)])
            size = _WARM_S + 60 * minutes[-1] + 1
            rows = watched_of(noise_of(sigmas, size, rng), sigmas, alphas)
            monitored = (
                _with_doppler(rows.after_fix(_WARM_S, size - 1)) if velocity else rows.after_fix(_WARM_S, size - 1)
            )
            both = [
                largest_errors(one, Configuration().undetected).most_m
                for one in (monitored, monitored.in_other_direction())
            ]
            larger.append(np.maximum(*both))
    median = np.median(larger, axis=0)
    beyond = np.flatnonzero(median > 20.0)
    by_minutes = {f"{minute} min": round(float(median[60 * minute - 1]), 1) for minute in minutes}
    return {
        "sky": constellation,
        "bank": name + " Doppler" * velocity,
        **by_minutes,
        "20 m after min": beyond[0] / 60 if beyond.size else None,
    }


def _with_doppler(rows: Watched) -> Watched:
    """The rows with the monitor of the velocity, its noise at zero: a mean over the second before."""
    limit_mps = threshold_factor(_PROBABILITY) * np.hypot(MonitorConfig().doppler_sigma_mps, _ODOMETER_M)
    return replace(
        rows,
        least_mps=np.maximum(rows.least_mps, rows.rate_mps - limit_mps),
        most_mps=np.minimum(rows.most_mps, rows.rate_mps + limit_mps),
    )


def shape_figures(constellation: Constellation, repetitions: int, minutes: tuple[int, ...]) -> list[dict[str, object]]:
    """Medians of what steps and ramps may become, by the default bank."""
    sky, alphas = default_geometry(constellation), np.array(BANKS["0.1 0.01 0.001"])
    figures: list[dict[str, object]] = []
    for shape in SHAPES:
        larger = []
        for repetition in range(repetitions):
            for heading in HEADINGS_DEG:
                sigmas, rng = along_sigmas_m(sky, heading), np.random.default_rng([9, repetition, int(heading)])
                rows = watched_of(noise_of(sigmas, _WARM_S + 60 * minutes[-1] + 1, rng), sigmas, alphas)
                ends = [_WARM_S + 60 * minute for minute in minutes]
                both = (rows, rows.in_other_direction())
                larger.append(
                    [max(largest_of_shape(one.after_fix(_WARM_S, end), shape) for one in both) for end in ends]
                )
        median = np.median(larger, axis=0)
        figures.append(
            {"sky": constellation, "shape": shape} | {f"{m} min": v for m, v in zip(minutes, median, strict=True)}
        )
    return figures


def ramp_figures(draws: int) -> list[dict[str, object]]:
    """Share of draws of noise in which a ramp of ten minutes is not detected, against the experiment's probability.

    One side counts the draws whose largest unnoticed ramp is as steep, by the linear bounds of this room. The other
    samples misses (`datasets.experiment.rare`) with the bank's state equations, and shares nothing with it.
    """
    seconds, heading = 600, 0.0
    sky, alphas = default_geometry("gps"), np.array(BANKS["0.1 0.01 0.001"])
    # The experiment counts headings from the faulty satellite on.
    sigmas, steepest = along_sigmas_m(sky, float(sky.azimuth_deg[sky.faulty]) + heading), []
    for draw in range(draws):
        noise = noise_of(sigmas, _WARM_S + seconds + 1, np.random.default_rng([11, draw]))
        window = watched_of(noise, sigmas, alphas).after_fix(_WARM_S, _WARM_S + seconds)
        steepest.append(largest_of_shape(window, "ramp", np.array([1])) / seconds)
    # The bank of the draws has run for as long since its restart.
    bank = linear_bank(sky, heading, BankSpec(alphas=(1.0, *alphas.tolist()), age_s=float(_WARM_S)))
    figures: list[dict[str, object]] = []
    for rate_mps in (0.012, 0.015, 0.018, 0.021, 0.024):
        share = float(np.mean(np.array(steepest) >= rate_mps))
        sampled = missed_detection_probability(bank, seconds, rate_mps / abs(float(bank.slope[0])), runs=20_000)
        deviation = np.hypot(
            np.sqrt(sampled.value * (1.0 - sampled.value) / draws), sampled.relative_error * sampled.value
        )
        figures.append(
            {
                "ramp m/s": rate_mps,
                "share undetected": share,
                "experiment": sampled.value,
                "sigmas apart": (share - sampled.value) / max(float(deviation), 1e-12),
            }
        )
    return figures


def range_figure(constellation: Constellation, heading_deg: float) -> float:
    """The largest fault along the track by one range that the pseudorange monitor passes, noise at its mean [m]."""
    sky = default_geometry(constellation)
    rows, heading = line_of_sight_rows(sky.azimuth_deg, sky.elevation_deg), np.radians(heading_deg)
    ahead, left = np.array([np.sin(heading), np.cos(heading), 0.0]), np.array([-np.cos(heading), np.sin(heading), 0.0])
    clocks = clock_columns(sky.svs)
    design = np.column_stack([rows @ ahead, rows @ left, rows[:, 2], clocks])
    weight = 1.0 / sky.range_variance_m2.sum(axis=1)
    normal = design.T @ (weight[:, None] * design) + np.diag([0.0, 1.0, 1.0, *np.zeros(clocks.shape[1])])
    freedom = len(sky.svs) - 1 - clocks.shape[1]
    shown = weight - weight**2 * np.einsum("ni,ij,nj->n", design, np.linalg.inv(normal), design)
    size = np.sqrt((chdtri(freedom, _PROBABILITY) - freedom) / shown)
    return float(np.abs(ahead @ sky.gain * size).max())


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="benchmarks.truth.unnoticed_bank", description=__doc__)
    parser.add_argument("--repetitions", type=int, default=4)
    given = parser.parse_args()
    skies: tuple[Constellation, ...] = ("gps", "gps_galileo")
    show_table(pl.DataFrame([bank_figures(sky, name, given.repetitions, MINUTES) for sky in skies for name in BANKS]))
    # Over the same times, so that it is the same noise.
    doppler = [bank_figures(sky, "0.1 0.01 0.001", given.repetitions, MINUTES, velocity=True) for sky in skies]
    show_table(pl.DataFrame(doppler), "Where the velocity carries the fault")
    show_table(pl.DataFrame([row for sky in skies for row in shape_figures(sky, given.repetitions, MINUTES[:4])]))
    ranges = [{"sky": sky, **{f"{h:.0f} deg": range_figure(sky, h) for h in HEADINGS_DEG}} for sky in skies]
    show_table(pl.DataFrame(ramp_figures(100 * given.repetitions)), "Ramps of ten minutes")
    show_table(pl.DataFrame(ranges), "One range at fault, by the pseudorange monitor alone [m]")
    spread = [
        {"sky": sky, **{f"{h:.0f} deg": np.linalg.norm(along_sigmas_m(default_geometry(sky), h)) for h in HEADINGS_DEG}}
        for sky in skies
    ]
    show_table(pl.DataFrame(spread), "Deviation of the position along the track [m]")


if __name__ == "__main__":
    main()
