"""Which bank to use: detection, false alarms and budget of candidate banks over a catalogue of faults.

Banks are compared on the same sky and with the replay's own rules: what counts is not the time to detect but
whether the fault is negated within the allowed time after the failure (TVB eq. 7), and how often a healthy train
is disturbed for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl

from datasets.experiment.bank_faults import CATALOGUE, HEADING_DEG, Fault, WhiteNoise, failure_s, fault_response
from datasets.experiment.geometry import default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.plan import SENSORS
from datasets.experiment.rare import false_alarm_probability
from datasets.experiment.tables import Contents, Row, share, table
from datasets.experiment.workers import generator
from pipeline.results.workers import mapped
from schemas.arrays import Ints
from schemas.config import Configuration, MonitorConfig

REPETITIONS = 200
# So few runs in which all goes well show a share over 95 % (Clopper-Pearson, two-sided 95 %).
FEWEST_RUNS = 72
_LONGEST_S = 6_000.0
_ALARM_RUNS = 200
# Noise of a matched position against the surveyed track beyond the survey's constant error [m].
_MAP_M = 0.1
# A train that is stopped by its own diagnosis more often than this is not operated.
_MOST_ALARMS_PER_H = 0.01
_SURE = 0.95


def made(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`comparison` by bank and fault, and `ranking`: the first is the one to use, `reason` says why.

    A configured bank enters the comparison beside the candidates.
    """
    specs = candidates()
    if config is not None:
        specs += [
            replace(BankSpec.of(config.monitors, sensors, rate_hz), map_m=_MAP_M)
            for sensors in SENSORS
            for rate_hz in (1.0, 10.0)
        ]
    comparison = compare_banks(list(dict.fromkeys(specs)), repetitions=repetitions, seed=seed, jobs=jobs)
    return {"comparison": comparison, "ranking": rank_banks(comparison)}


def candidates() -> list[BankSpec]:
    """Weights, probability, rate and sensors that a user may choose."""
    weights = (
        (1.0, 0.1, 0.01, 0.001),
        (1.0, 0.1, 0.01, 0.002),
        (1.0, 0.1, 0.01),
        (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001),
    )
    return [
        BankSpec(alphas=alphas, sensors=sensors, false_alarm_probability=probability, rate_hz=rate_hz, map_m=_MAP_M)
        for alphas in weights
        for sensors in ("odometer", "odometer_and_track")
        for probability, rate_hz in ((1e-7, 1.0), (1e-8, 1.0), (1e-7, 10.0), (1e-8, 10.0))
    ]


def compare_banks(
    specs: Sequence[BankSpec],
    faults: tuple[Fault, ...] = CATALOGUE,
    repetitions: int = REPETITIONS,
    seed: int = 1,
    jobs: int = 1,
) -> pl.DataFrame:
    """One row per bank and fault; GPS alone."""
    evaluate = partial(_evaluated, faults, repetitions, seed)
    return table([row for part in mapped(evaluate, list(enumerate(specs)), jobs) for row in part])


def _evaluated(faults: tuple[Fault, ...], repetitions: int, seed: int, candidate: tuple[int, BankSpec]) -> list[Row]:
    number, spec = candidate
    bank = linear_bank(default_geometry("gps"), HEADING_DEG, spec)
    budget_s = Configuration().budget_s
    horizon_s = _horizon_s(faults, budget_s)
    first, by = _first_fails(bank, faults, int(horizon_s * spec.rate_hz), repetitions, (seed, number))
    alarms = false_alarm_probability(bank, int(600 * spec.rate_hz), _ALARM_RUNS, seed)
    alarms_per_h = float(-np.log1p(-min(alarms.value, 1.0 - 1e-12)) * 6.0)
    labels: Row = {
        "bank": number,
        "alphas": spec.weights_text,
        "sensors": spec.sensors,
        "probability": spec.false_alarm_probability,
        "rate_hz": spec.rate_hz,
    }
    return [
        labels | _row(bank, fault, first[index], by[index], budget_s, horizon_s) | {"false_alarms_per_h": alarms_per_h}
        for index, fault in enumerate(faults)
    ]


def _horizon_s(faults: tuple[Fault, ...], budget_s: float) -> float:
    """Until the slowest failure is over its budget, and not longer than the longest."""
    times = [failure_s(fault, default_geometry("gps")) or 0.0 for fault in faults]
    return min(max(times) + budget_s + 1.0, _LONGEST_S)


def _first_fails(
    bank: LinearBank, faults: tuple[Fault, ...], epochs: int, repetitions: int, key: tuple[int, int]
) -> tuple[Ints, Ints]:
    """When a monitor first fails, and the loudest one then, (faults, repetitions); -1 where none does."""
    seed, number = key
    rates = [fault.rates(default_geometry("gps"), bank.along_error.size) for fault in faults]
    responses = np.stack(
        [fault_response(bank, rate, fault.shape, epochs) for rate, fault in zip(rates, faults, strict=True)]
    )
    shaken = WhiteNoise(bank, faults, repetitions, generator(seed, 62, number))
    first = np.full((len(faults), repetitions), -1)
    by = np.full(first.shape, -1)
    for k, noise in enumerate(bank.paths(epochs, repetitions, generator(seed, 61, number))):
        open_faults = np.flatnonzero((first < 0).any(axis=1))
        if open_faults.size == 0:
            break
        values = noise[None] + responses[open_faults, k][:, :, None] + shaken.step(open_faults)
        ratio = np.abs(values) / bank.threshold[:, None]
        found = (ratio.max(axis=1) > 1.0) & (first[open_faults] < 0)
        first[open_faults] = np.where(found, k, first[open_faults])
        by[open_faults] = np.where(found, ratio.argmax(axis=1), by[open_faults])
    return first, by


def _row(bank: LinearBank, fault: Fault, first: Ints, by: Ints, budget_s: float, horizon_s: float) -> Row:
    # A fault is in the data one epoch after it began at the earliest; the negation takes one epoch more.
    epoch_s = 1.0 / bank.spec.rate_hz
    runs = first.size
    seen = first >= 0
    detected_s = np.where(seen, (first + 1) / bank.spec.rate_hz, np.inf)
    failed_s = failure_s(fault, default_geometry("gps"))
    # Nothing is judged of a fault that makes no failure within the horizon.
    trials = runs if failed_s is not None and failed_s + budget_s <= horizon_s else 0
    missed = int((detected_s > (failed_s or 0.0)).sum())
    in_time = int((detected_s + epoch_s <= (failed_s or 0.0) + budget_s).sum())
    return {
        "fault": fault.name,
        "runs": runs,
        "detected": float(seen.mean()),
        "time_to_detect_median_s": float(np.median(detected_s)) if seen.mean() > 0.5 else None,
        "first_monitor": bank.names[np.bincount(by[seen]).argmax()] if seen.any() else None,
        "failure_s": failed_s,
        **share("pmd_at_failure", missed if trials else 0, trials),
        **share("within_budget", in_time if trials else 0, trials),
    }


def rank_banks(comparison: pl.DataFrame) -> pl.DataFrame:
    """One row per bank, best first, with what speaks for and against it.

    Banks that disturb a healthy train more than once in 100 h come last; then the number of faults that are surely
    negated in time decides (lower bound of the share over 95 %), then the number that is seen at all, then the mean
    share, then fewer false alarms.
    """
    keys = ["bank", "alphas", "sensors", "probability", "rate_hz"]
    judged = comparison.group_by(keys, maintain_order=True).agg(
        false_alarms_per_h=pl.col("false_alarms_per_h").first(),
        faults_judged=pl.col("within_budget").count(),
        faults_in_time=(pl.col("within_budget_low") > _SURE).sum(),
        faults_seen=(pl.col("detected") > 0.5).sum(),
        share_in_time=pl.col("within_budget").mean(),
        late=pl.col("fault").filter(pl.col("within_budget_low") <= _SURE).str.join(", "),
        unseen=pl.col("fault").filter(pl.col("detected") < 0.5).str.join(", "),
        runs=pl.col("runs").min(),
    )
    tolerable = pl.col("false_alarms_per_h") <= _MOST_ALARMS_PER_H
    ranked = judged.with_columns(tolerable=tolerable).sort(
        ["tolerable", "faults_in_time", "faults_seen", "share_in_time", "false_alarms_per_h", "bank"],
        descending=[True, True, True, True, False, False],
    )
    reasons = [_reason(row) for row in ranked.iter_rows(named=True)]
    default = MonitorConfig()
    weights = ", ".join(f"{alpha:g}" for alpha in (1.0, *default.ewma_alphas))
    is_default = (pl.col("alphas") == weights) & (pl.col("probability") == default.false_alarm_probability)
    return ranked.with_columns(pl.Series("reason", reasons), replay_default=is_default).with_row_index("rank", offset=1)


def _reason(row: dict[str, object]) -> str:
    """The verdict in words."""
    alarms = float(row["false_alarms_per_h"])  # type: ignore[arg-type]
    text = f"{row['faults_in_time']} of {row['faults_judged']} faults negated in time"
    text += f", one false alarm in {1.0 / alarms:.0f} h" if alarms > 0 else ""
    if int(row["runs"]) < FEWEST_RUNS:  # type: ignore[call-overload]
        text += f" ({row['runs']} runs cannot show 95 %, {FEWEST_RUNS} can)"
    if not row["tolerable"]:
        text += ", which is more often than one in 100 h"
    if row["late"]:
        text += f"; late: {row['late']}"
    if row["unseen"]:
        text += f"; mostly not seen at all: {row['unseen']}"
    return text
