"""How often a healthy bank alarms: per epoch, verified by counting, and per hour, at 1 and 10 Hz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from datasets.experiment.diagnostics import SEED
from datasets.experiment.geometry import Geometry, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.passage import BLOCK_EPOCHS, NoisePaths
from datasets.experiment.plan import Plan, Sensors, bank_forms
from datasets.experiment.range_alarms import range_alarms
from datasets.experiment.rare import false_alarm_probability
from datasets.experiment.tables import refuse_configuration, write_tables
from datasets.experiment.thresholds import (
    EXTRAPOLATED,
    calibrated_ratios,
    regressed_ratios,
    regression_table,
    two_sided,
)
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from pipeline.figures.bounds import clopper_pearson, poisson_rate
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


def verification_plan(geometry: Geometry) -> Plan:
    """Fault-free runs of the default sky, heading 0, all monitors of both readings."""
    span = _VERIFIED_AT_S + 1
    return Plan(geometry, headings_deg=(0.0,), rates_mps=(1.0,), span_s=span, onset_s=span)


@dataclass(frozen=True)
class _Count:
    plan: Plan
    limits: Floats
    key: tuple[int, ...]
    repetitions: int


def _exceedances(work: _Count) -> Ints:
    """How many runs exceed each limit (ways, probabilities, monitors) at the last epoch: one look per run."""
    plan = work.plan
    paths = NoisePaths(plan, work.repetitions, generator(*work.key))
    left = _VERIFIED_AT_S
    while left > 0:
        basis = paths.advance(min(BLOCK_EPOCHS, left))
        left -= len(basis)
    values = np.abs((bank_forms(plan).rows * paths.weights) @ basis[-1])
    beyond = values > work.limits[..., None]
    return np.asarray(beyond.sum(axis=-1), dtype=np.int64)


def verification_table(repetitions: int = REPETITIONS, seed: int = SEED, jobs: int = 1) -> pl.DataFrame:
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
    works = [
        _Count(plan, limits, (seed, 52, block), size)
        for block, size in enumerate(in_blocks(repetitions, _BLOCK_REPETITIONS))
    ]
    counts = np.sum(mapped(_exceedances, works, jobs), axis=0)
    rows = []
    for way, (name, ratio) in enumerate(ratios.items()):
        for level, probability in enumerate(PROBABILITIES):
            for form, monitor in enumerate(forms.names):
                share = clopper_pearson(int(counts[way, level, form]), repetitions)
                rows.append(
                    {
                        "way": name,
                        "monitor": monitor,
                        "sigma_ratio": float(ratio[form]),
                        "intended": probability,
                        "expected": float(two_sided(factors[level] * ratio[form])),
                        "runs": repetitions,
                        "alarms": int(counts[way, level, form]),
                        "measured": share.value,
                        "measured_low": share.low,
                        "measured_high": share.high,
                        "at_1e_7": float(two_sided(threshold_factor(EXTRAPOLATED) * ratio[form])),
                    }
                )
    return pl.DataFrame(rows)


@dataclass(frozen=True)
class _Counted:
    bank: LinearBank
    key: tuple[int, ...]
    runs: int


def _episodes(work: _Counted) -> int:
    """Alarm episodes in an hour of each run; fails less than the recovery time apart are one (DOMAIN section 5)."""
    rate_hz = work.bank.spec.rate_hz
    together = int(LdsConfig().recovery_s * rate_hz)
    # What began before the hour is no episode of it.
    since_fail = np.full(work.runs, together)
    episodes = 0
    settling = together
    epochs = int(_HORIZON_S * rate_hz)
    for k, noise in enumerate(work.bank.paths(settling + epochs, work.runs, generator(*work.key))):
        failing = (np.abs(noise) > work.bank.threshold[:, None]).any(axis=0)
        if k >= settling:
            episodes += int((failing & (since_fail >= together)).sum())
        since_fail = np.where(failing, 0, since_fail + 1)
    return episodes


def alarms_per_hour(
    rare_runs: int = _RARE_RUNS, counted_runs: int = _COUNTED_RUNS, seed: int = SEED, jobs: int = 1
) -> pl.DataFrame:
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
    return pl.DataFrame(rows)


def alarm_rate(spec: BankSpec, runs: int, seed: int = SEED, jobs: int = 1) -> dict[str, object]:
    """One row: counted where alarms are frequent enough, else from the probability P of an alarm within the hour,
    by importance sampling, as -ln(1-P).
    """
    bank = linear_bank(default_geometry("gps"), 30.0, spec)
    counted = spec.false_alarm_probability >= min(PROBABILITIES)
    figures = _counted(bank, runs, seed, jobs) if counted else _sampled(bank, runs, seed, jobs)
    return {
        "sensors": spec.sensors,
        "white_track": spec.map_m > _STEADY_TRACK_M,
        "rate_hz": spec.rate_hz,
        "probability": spec.false_alarm_probability,
        "monitors": bank.slope.size,
        "method": "counting" if counted else "importance_sampling",
        **figures,
    }


def _counted(bank: LinearBank, runs: int, seed: int, jobs: int) -> dict[str, float | None]:
    works = [_Counted(bank, (seed, 54, block), size) for block, size in enumerate(in_blocks(runs, 100))]
    episodes = sum(mapped(_episodes, works, jobs))
    rate = poisson_rate(episodes, runs * _HORIZON_S / 3600.0)
    return _per_hour(rate.value, rate.low, rate.high)


def _sampled(bank: LinearBank, runs: int, seed: int, jobs: int) -> dict[str, float | None]:
    result = false_alarm_probability(bank, int(_HORIZON_S * bank.spec.rate_hz), runs, seed, jobs)
    half = _TWO_SIDED_FACTOR * result.relative_error * result.value
    bounds = [-np.log1p(-p) * 3600.0 / _HORIZON_S for p in (result.value, result.value - half, result.value + half)]
    return _per_hour(*(float(bound) for bound in bounds))


def _per_hour(value: float | None, low: float | None, high: float | None) -> dict[str, float | None]:
    return {
        "alarms_per_h": value,
        "alarms_per_h_low": low,
        "alarms_per_h_high": high,
        "hours_between": 1.0 / value if value else None,
    }


def write_thresholds(
    out: Path, repetitions: int | None = None, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> list[Path]:
    """`regression`, `verification`, `pseudorange` and `alarms_per_hour`, one Parquet file each."""
    refuse_configuration("thresholds", config)
    count = repetitions or REPETITIONS
    tables = {
        "regression": regression_table(),
        "verification": verification_table(count, seed, jobs),
        "pseudorange": range_alarms(PROBABILITIES, count, seed, jobs),
        "alarms_per_hour": alarms_per_hour(min(_RARE_RUNS, count), min(_COUNTED_RUNS, count), seed, jobs),
    }
    return write_tables(out, tables, {"experiment": "thresholds", "repetitions": count, "seed": seed})
