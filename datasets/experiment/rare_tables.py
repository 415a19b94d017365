"""Rare events of the published banks: when a missed detection has become as rare as railways ask, and the proof."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import polars as pl

from datasets.experiment.diagnostics import SEED
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.plan import READINGS, SENSORS
from datasets.experiment.rare import (
    Probability,
    false_alarm_probability,
    missed_detection_probability,
    plain_false_alarm,
    plain_missed_detection,
)
from datasets.experiment.tables import write_tables
from pipeline.statistics import clopper_pearson
from schemas.config import Configuration

RUNS = 20_000
PLAIN_RUNS = 400_000
TARGETS: tuple[float, ...] = (1e-4, 1e-9)
_RATES_MPS = (0.03, 0.1, 1.0)
_SEARCH_RUNS = 1_000
_FAILURE_LIMIT_M = 20.0
_LONGEST_S = 10_000
_CLOSE_ENOUGH = 0.02


def banks(config: Configuration | None) -> Iterator[tuple[Constellation, BankSpec, LinearBank]]:
    """Both constellations and sensor sets, heading 0, 1 Hz: the configured bank, or those of both readings."""
    specs = [
        spec
        for sensors in SENSORS
        for spec in (
            [BankSpec.of(config.monitors, sensors)]
            if config is not None
            else [BankSpec(reading=reading, sensors=sensors) for reading in READINGS]
        )
    ]
    for constellation in CONSTELLATIONS:
        for spec in specs:
            yield constellation, spec, linear_bank(default_geometry(constellation), 0.0, spec)


def failure_epoch(bank: LinearBank, rate_mps: float) -> int:
    """Epochs until the mean along-track error of a range ramp passes the limit, at most the published span."""
    slope = abs(float(bank.along_error[0])) * rate_mps
    seconds = _FAILURE_LIMIT_M / slope if slope > 0 else float(_LONGEST_S)
    return int(min(seconds, _LONGEST_S) * bank.spec.rate_hz)


def epochs_until(bank: LinearBank, rate_mps: float, target: float, seed: int, jobs: int) -> int | None:
    """Epochs after which the missed-detection probability is below `target`; None if not within the span.

    Bisection, with few runs per step: time is found far better than probability, which falls steeply.
    """

    def below(epochs: int) -> bool:
        return missed_detection_probability(bank, epochs, rate_mps, _SEARCH_RUNS, seed, jobs).value < target

    low, high = 1, 8
    while not below(high):
        low, high = high, 2 * high
        if low >= _LONGEST_S * bank.spec.rate_hz:
            return None
    while high - low > max(1, _CLOSE_ENOUGH * high):
        middle = (low + high) // 2
        low, high = (low, middle) if below(middle) else (middle, high)
    return high


def missed_table(
    runs: int = RUNS, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> pl.DataFrame:
    """Pmd at the mean failure, and the time that makes it as rare as each target, with the error of the estimate."""
    rows = []
    for constellation, spec, bank in banks(config):
        for rate in _RATES_MPS:
            at_failure = failure_epoch(bank, rate)
            rows.append(_missed_row(constellation, spec, bank, rate, at_failure, "failure", runs, seed, jobs))
            for target in TARGETS:
                epochs = epochs_until(bank, rate, target, seed, jobs)
                if epochs is not None:
                    rows.append(_missed_row(constellation, spec, bank, rate, epochs, f"{target:g}", runs, seed, jobs))
    return pl.DataFrame(rows)


def _missed_row(
    constellation: Constellation,
    spec: BankSpec,
    bank: LinearBank,
    rate: float,
    epochs: int,
    reason: str,
    runs: int,
    seed: int,
    jobs: int,
) -> dict[str, object]:
    result = missed_detection_probability(bank, epochs, rate, runs, seed, jobs)
    return {
        "constellation": constellation,
        "reading": spec.reading,
        "alphas": ", ".join(f"{alpha:g}" for alpha in spec.weights),
        "sensors": spec.sensors,
        "rate_mps": rate,
        "chosen_for": reason,
        "time_s": epochs / spec.rate_hz,
        "mean_failure_s": failure_epoch(bank, rate) / spec.rate_hz,
        **_figures(result),
    }


def _figures(result: Probability) -> dict[str, float | int | None]:
    seen = result.value > 0.0
    return {
        "probability": result.value if seen else None,
        "relative_error": result.relative_error if seen else None,
        "variance_reduction": result.variance_reduction if seen else None,
        "runs": result.runs,
    }


def agreement_table(runs: int = RUNS, plain_runs: int = PLAIN_RUNS, seed: int = SEED, jobs: int = 1) -> pl.DataFrame:
    """Sampling against counting where counting reaches: 1e-3 to 1e-5, with exact bounds of the count."""
    rows = []
    for sensors in SENSORS:
        bank = linear_bank(default_geometry("gps"), 0.0, BankSpec(sensors=sensors))
        for target in (1e-3, 1e-4, 1e-5):
            epochs = epochs_until(bank, 0.3, target, seed, jobs)
            if epochs is None:
                continue
            clever = missed_detection_probability(bank, epochs, 0.3, runs, seed, jobs)
            plain = plain_missed_detection(bank, epochs, 0.3, plain_runs, seed, jobs)
            rows.append(_agreement("missed_detection", sensors, epochs, clever, plain))
            tight = linear_bank(
                default_geometry("gps"), 0.0, BankSpec(sensors=sensors, false_alarm_probability=target / 500)
            )
            clever = false_alarm_probability(tight, 100, min(runs, 2_000), seed, jobs)
            plain = plain_false_alarm(tight, 100, plain_runs, seed, jobs)
            rows.append(_agreement("false_alarm", sensors, 100, clever, plain))
    return pl.DataFrame(rows)


def _agreement(event: str, sensors: str, epochs: int, clever: Probability, plain: Probability) -> dict[str, object]:
    counted = clopper_pearson(round(plain.value * plain.runs), plain.runs)
    return {
        "event": event,
        "sensors": sensors,
        "epochs": epochs,
        **_figures(clever),
        "counted": counted.value,
        "counted_low": counted.low,
        "counted_high": counted.high,
        "counted_runs": plain.runs,
    }


def write_rare(
    out: Path, repetitions: int | None = None, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> list[Path]:
    """`missed.parquet`, `agreement.parquet`; `repetitions` are the runs of importance sampling."""
    runs = repetitions or RUNS
    tables = {
        "missed": missed_table(runs, seed, jobs, config),
        "agreement": agreement_table(runs, 20 * runs, seed, jobs),
    }
    return write_tables(out, tables, {"experiment": "rare", "repetitions": runs, "seed": seed})
