"""How often a healthy bank alarms: per epoch, verified by counting, and per hour, at 1 and 10 Hz."""

from __future__ import annotations

from functools import partial

import numpy as np
import polars as pl

from datasets.experiment.geometry import Geometry, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.passage import BLOCK_EPOCHS, NoisePaths
from datasets.experiment.plan import ExperimentPlan, Sensors, bank_forms
from datasets.experiment.range_alarms import range_alarms
from datasets.experiment.rare import false_alarm_probability
from datasets.experiment.tables import Contents, Row, share, table
from datasets.experiment.thresholds import (
    EXTRAPOLATED,
    calibrated_ratios,
    regressed_ratios,
    regression_table,
    two_sided,
)
from datasets.experiment.workers import in_pieces
from pipeline.stages.run_row.bounds import poisson_rate
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, LdsConfig, threshold_factor

PROBABILITIES: tuple[float, ...] = (1e-3, 1e-4, 1e-5)
REPETITIONS = 1_000_000
_VERIFIED_AT_S = 1_000
_BLOCK_REPETITIONS = 2_000
_RARE_RUNS = 600
_COUNTED_RUNS = 200
_HORIZON_S = 3_600
_STEADY_TRACK_M = 1e-6
_TWO_SIDED_FACTOR = 1.959963984540054


def made(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`regression`, `verification`, `pseudorange` and `alarms_per_hour`."""
    rare = min(_RARE_RUNS, repetitions)
    counted = min(_COUNTED_RUNS, repetitions)
    return {
        "regression": regression_table(),
        "verification": verification_table(repetitions, seed, jobs),
        "pseudorange": range_alarms(PROBABILITIES, repetitions, seed, jobs),
        "alarms_per_hour": alarms_per_hour(rare, counted, seed, jobs),
    }


def verification_plan(geometry: Geometry) -> ExperimentPlan:
    """Fault-free runs of the default sky, heading 0, all monitors of both readings."""
    span = _VERIFIED_AT_S + 1
    return ExperimentPlan(geometry, headings_deg=(0.0,), rates_mps=(1.0,), span_s=span, onset_s=span)


def _exceedances(plan: ExperimentPlan, limits: Floats, repetitions: int, rng: np.random.Generator) -> Ints:
    """How many runs exceed each limit (ways, probabilities, monitors) at the last epoch: one look per run."""
    paths = NoisePaths(plan, repetitions, rng)
    left = _VERIFIED_AT_S
    while left > 0:
        basis = paths.advance(min(BLOCK_EPOCHS, left))
        left -= len(basis)
    values = np.abs((bank_forms(plan).rows * paths.weights) @ basis[-1])
    return np.asarray((values > limits[..., None]).sum(axis=-1), dtype=np.int64)


def verification_table(repetitions: int, seed: int = 1, jobs: int = 1) -> pl.DataFrame:
    """False-alarm probability of each way at 1e-3 to 1e-5, counted on independent runs, with exact bounds."""
    plan = verification_plan(default_geometry("gps"))
    forms = bank_forms(plan)
    exact = forms.threshold[_VERIFIED_AT_S - 1] / threshold_factor(plan.false_alarm_probability)
    ratios = {
        "exact": np.ones_like(exact),
        "regression": regressed_ratios(plan),
        "calibrated": calibrated_ratios(plan, seed),
    }
    factors = np.array([threshold_factor(p) for p in PROBABILITIES])
    limits = np.array([factors[:, None] * ratio * exact for ratio in ratios.values()])
    count = partial(_exceedances, plan, limits)
    counts = np.sum(in_pieces(count, repetitions, _BLOCK_REPETITIONS, (seed, 52), jobs), axis=0)
    rows: list[Row] = []
    for (way, level, form), alarms in np.ndenumerate(counts):
        name, ratio = list(ratios.items())[way]
        rows.append(
            {
                "way": name,
                "monitor": forms.names[form],
                "sigma_ratio": float(ratio[form]),
                "intended": PROBABILITIES[level],
                "expected": float(two_sided(factors[level] * ratio[form])),
                "runs": repetitions,
                "alarms": int(alarms),
                **share("measured", int(alarms), repetitions),
                "at_1e_7": float(two_sided(threshold_factor(EXTRAPOLATED) * ratio[form])),
            }
        )
    return table(rows)


def _episodes(bank: LinearBank, runs: int, rng: np.random.Generator) -> int:
    """Alarm episodes in an hour of each run; fails less than the recovery time apart are one (DOMAIN section 5)."""
    together = int(LdsConfig().recovery_s * bank.spec.rate_hz)
    # What began before the hour is no episode of it.
    since_fail = np.full(runs, together)
    episodes = 0
    settling = together
    epochs = int(_HORIZON_S * bank.spec.rate_hz)
    for k, noise in enumerate(bank.paths(settling + epochs, runs, rng)):
        failing = (np.abs(noise) > bank.threshold[:, None]).any(axis=0)
        if k >= settling:
            episodes += int((failing & (since_fail >= together)).sum())
        since_fail = np.where(failing, 0, since_fail + 1)
    return episodes


def alarms_per_hour(rare_runs: int, counted_runs: int, seed: int, jobs: int = 1) -> pl.DataFrame:
    """Alarm episodes of a healthy bank per hour: counted from 1e-3 to 1e-5 per epoch and monitor, below by sampling.

    `white_track` is the experiment's 1 m of white track noise; on recorded runs a survey error is constant and does
    not alarm.
    """
    settings: tuple[tuple[Sensors, float], ...] = (
        ("odometer", 1.0),
        ("odometer_and_track", 1.0),
        ("odometer_and_track", _STEADY_TRACK_M),
    )
    rows = []
    for sensors, map_m in settings:
        for rate_hz in (1.0, 10.0):
            for probability in (*PROBABILITIES, 1e-6, EXTRAPOLATED):
                spec = BankSpec(sensors=sensors, rate_hz=rate_hz, map_m=map_m, false_alarm_probability=probability)
                runs = counted_runs if probability >= min(PROBABILITIES) else rare_runs
                rows.append(alarm_rate(spec, runs, seed, jobs))
    return table(rows)


def alarm_rate(spec: BankSpec, runs: int, seed: int = 1, jobs: int = 1) -> Row:
    """One row: counted where alarms are frequent enough, else from the probability P of an alarm within the hour,
    by importance sampling, as -ln(1-P).
    """
    bank = linear_bank(default_geometry("gps"), 30.0, spec)
    counted = spec.false_alarm_probability >= min(PROBABILITIES)
    value, low, high = _count_alarms(bank, runs, seed, jobs) if counted else _sampled(bank, runs, seed, jobs)
    return {
        "sensors": spec.sensors,
        "white_track": spec.map_m > _STEADY_TRACK_M,
        "rate_hz": spec.rate_hz,
        "probability": spec.false_alarm_probability,
        "monitors": bank.slope.size,
        "method": "counting" if counted else "importance_sampling",
        "alarms_per_h": value,
        "alarms_per_h_low": low,
        "alarms_per_h_high": high,
        "hours_between": 1.0 / value if value else None,
    }


def _count_alarms(bank: LinearBank, runs: int, seed: int, jobs: int) -> tuple[float | None, ...]:
    """Alarms per hour and their bounds."""
    episodes = sum(in_pieces(partial(_episodes, bank), runs, 100, (seed, 54), jobs))
    rate = poisson_rate(episodes, runs * _HORIZON_S / 3600.0)
    return rate.value, rate.low, rate.high


def _sampled(bank: LinearBank, runs: int, seed: int, jobs: int) -> tuple[float | None, ...]:
    result = false_alarm_probability(bank, int(_HORIZON_S * bank.spec.rate_hz), runs, seed, jobs)
    half = _TWO_SIDED_FACTOR * result.relative_error * result.value
    probabilities = (result.value, result.value - half, result.value + half)
    return tuple(float(-np.log1p(-p) * 3600.0 / _HORIZON_S) for p in probabilities)
