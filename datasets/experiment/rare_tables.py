"""Rare events of a bank: when a missed detection has become as rare as railways ask, and false alarms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from datasets.experiment.diagnostics import SEED
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.plan import READINGS, SENSORS
from datasets.experiment.rare import (
    false_alarm_probability,
    missed_detection_probability,
)
from datasets.experiment.rare_range_tables import range_table
from datasets.experiment.rare_rows import figures, first_below
from datasets.experiment.tables import write_tables
from schemas.config import Configuration

RUNS = 20_000
TARGETS: tuple[float, ...] = (1e-4, 1e-9)
_RATES_MPS = (0.01, 0.03, 0.1, 1.0)
_TRANSIENT_RATES_MPS = (0.1, 1.0)
_SEARCH_RUNS = 500
_FAILURE_LIMIT_M = 20.0
_LONGEST_S = 10_000
_HOUR_S = 3_600
_FAST_HZ, _SLOWEST_AT_FAST_MPS = 10.0, 0.1
_ALARM_SHARE = 20
# Seconds since the restart at the onset of a fault; none: long ago.
AGES_S: tuple[float | None, ...] = (0.0, 10.0, 60.0, 300.0, None)


def banks(config: Configuration | None, rate_hz: float = 1.0) -> Iterator[tuple[Constellation, BankSpec, LinearBank]]:
    """Both constellations and sensor sets, heading 0: the configured bank, or those of both readings."""
    specs = [
        spec
        for sensors in SENSORS
        for spec in (
            [BankSpec.of(config.monitors, sensors, rate_hz)]
            if config is not None
            else [BankSpec(reading=reading, sensors=sensors, rate_hz=rate_hz) for reading in READINGS]
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


def epochs_until(bank: LinearBank, rate_mps: float, targets: Sequence[float], seed: int, jobs: int) -> list[int | None]:
    """Epochs after which the missed-detection probability is below each target; None if not within the span."""
    return first_below(
        lambda epochs: missed_detection_probability(bank, epochs, rate_mps, _SEARCH_RUNS, seed, jobs).value,
        targets,
        int(_LONGEST_S * bank.spec.rate_hz),
    )


def missed_table(
    runs: int = RUNS, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> pl.DataFrame:
    """Pmd at the mean failure, and the time that makes it as rare as each target, with the error of the estimate."""
    rows = []
    for (constellation, _, bank), rate in _asked(config):
        at_failure = failure_epoch(bank, rate)
        asked = [("failure", at_failure)]
        for target, epochs in zip(TARGETS, epochs_until(bank, rate, TARGETS, seed, jobs), strict=True):
            if epochs is not None:
                asked.append((f"{target:g}", epochs))
        for reason, epochs in asked:
            missed = missed_detection_probability(bank, epochs, rate, runs, seed, jobs)
            rows.append(_missed_row(constellation, bank, rate, epochs, reason) | figures(missed))
    return pl.DataFrame(rows)


def _missed_row(
    constellation: Constellation, bank: LinearBank, rate: float, epochs: int, reason: str
) -> dict[str, object]:
    """What was asked: a ramp of this rate [m/s] on a bank, so many epochs after its onset."""
    spec = bank.spec
    return {
        "constellation": constellation,
        "reading": spec.reading,
        "alphas": _weights(spec),
        "sensors": spec.sensors,
        "rate_hz": spec.rate_hz,
        "rate_mps": rate,
        "chosen_for": reason,
        "time_s": epochs / spec.rate_hz,
        "mean_failure_s": failure_epoch(bank, rate) / spec.rate_hz,
    }


def _weights(spec: BankSpec) -> str:
    return ", ".join(f"{alpha:g}" for alpha in spec.weights)


def transient_table(
    runs: int = RUNS, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> pl.DataFrame:
    """Pmd of a fault that begins soon after a restart beside one long after, at the time that makes the latter 1e-4.

    Thresholds are exact at every age (DOMAIN section 3), so false alarms do not depend on it; misses do.
    """
    rows = []
    for constellation, spec, bank in banks(config):
        for rate in _TRANSIENT_RATES_MPS if constellation == "gps" else ():
            epochs = epochs_until(bank, rate, (max(TARGETS),), seed, jobs)[0]
            for age_s in AGES_S if epochs is not None else ():
                young = linear_bank(default_geometry(constellation), 0.0, replace(spec, age_s=age_s))
                missed = missed_detection_probability(young, epochs or 0, rate, runs, seed, jobs)
                row = _missed_row(constellation, young, rate, epochs or 0, "transient")
                rows.append({"age_s": age_s, **row, **figures(missed)})
    return pl.DataFrame(rows, infer_schema_length=None)


def _asked(config: Configuration | None) -> Iterator[tuple[tuple[Constellation, BankSpec, LinearBank], float]]:
    """Banks and ramps; at 10 Hz the faster ramps of GPS, since slow ones differ little from 1 Hz."""
    for one in banks(config):
        yield from ((one, rate) for rate in _RATES_MPS)
    for one in banks(config, _FAST_HZ):
        yield from ((one, rate) for rate in _RATES_MPS if rate >= _SLOWEST_AT_FAST_MPS and one[0] == "gps")


def alarm_table(runs: int = RUNS, seed: int = SEED, jobs: int = 1, config: Configuration | None = None) -> pl.DataFrame:
    """Probability that a healthy bank alarms at least once within an hour."""
    rows = []
    chosen = [*banks(config), *(one for one in banks(config, _FAST_HZ) if one[0] == "gps")]
    for constellation, spec, bank in chosen:
        result = false_alarm_probability(bank, int(_HOUR_S * spec.rate_hz), max(runs // _ALARM_SHARE, 20), seed, jobs)
        rows.append(
            {
                "constellation": constellation,
                "reading": spec.reading,
                "alphas": _weights(spec),
                "sensors": spec.sensors,
                "rate_hz": spec.rate_hz,
                "false_alarm_probability": spec.false_alarm_probability,
                "horizon_s": float(_HOUR_S),
                **figures(result),
            }
        )
    return pl.DataFrame(rows)


def write_rare(
    out: Path, repetitions: int | None = None, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> list[Path]:
    """`missed`, `transients`, `false_alarms`, `pseudorange`; `repetitions` are the sampled runs."""
    runs = repetitions or RUNS
    tables = {
        "missed": missed_table(runs, seed, jobs, config),
        "transients": transient_table(runs, seed, jobs, config),
        "false_alarms": alarm_table(runs, seed, jobs, config),
        "pseudorange": range_table(runs, seed, jobs, config),
    }
    return write_tables(out, tables, {"experiment": "rare", "repetitions": runs, "seed": seed})
