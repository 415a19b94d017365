"""Which bank to use: detection, false alarms and budget of candidate banks over a catalogue of faults.

Banks are compared on the same sky and with the replay's own rules: what counts is not the time to detect but
whether the fault is negated within the allowed time after the failure (TVB eq. 7), and how often a healthy train
is disturbed for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

from datasets.experiment.bank_faults import CATALOGUE, HEADING_DEG, Fault, WhiteNoise, failure_s, fault_response
from datasets.experiment.bank_text import recommendation_page
from datasets.experiment.diagnostics import SEED
from datasets.experiment.geometry import Geometry, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.plan import SENSORS
from datasets.experiment.rare import false_alarm_probability
from datasets.experiment.tables import write_page, write_tables
from datasets.experiment.workers import generator
from pipeline.campaign.workers import mapped
from pipeline.figures.bounds import clopper_pearson
from schemas.arrays import Floats
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


@dataclass(frozen=True)
class _Candidate:
    number: int
    spec: BankSpec
    geometry: Geometry
    faults: tuple[Fault, ...]
    repetitions: int
    seed: int
    budget_s: float


def _evaluate(candidate: _Candidate) -> list[dict[str, object]]:
    spec, faults = candidate.spec, candidate.faults
    bank = linear_bank(candidate.geometry, HEADING_DEG, spec)
    epochs = int(_horizon_s(candidate) * spec.rate_hz)
    axes = bank.along_error.size
    responses = np.stack(
        [fault_response(bank, fault.rates(candidate.geometry, axes), fault.shape, epochs) for fault in faults]
    )
    shaken = WhiteNoise(bank, faults, candidate.repetitions, generator(candidate.seed, 62, candidate.number))
    first = np.full((len(faults), candidate.repetitions), -1)
    by = np.full(first.shape, -1)
    rng = generator(candidate.seed, 61, candidate.number)
    for k, noise in enumerate(bank.paths(epochs, candidate.repetitions, rng)):
        open_faults = np.flatnonzero((first < 0).any(axis=1))
        if open_faults.size == 0:
            break
        values = noise[None] + responses[open_faults, k][:, :, None] + shaken.step(open_faults)
        ratio = np.abs(values) / bank.threshold[:, None]
        found = (ratio.max(axis=1) > 1.0) & (first[open_faults] < 0)
        loudest = ratio.argmax(axis=1)
        first[open_faults] = np.where(found, k, first[open_faults])
        by[open_faults] = np.where(found, loudest, by[open_faults])
    hours = _alarms_per_h(bank, candidate)
    return [_row(candidate, bank, fault, first[index], by[index], hours) for index, fault in enumerate(faults)]


def _horizon_s(candidate: _Candidate) -> float:
    """Until the slowest failure is over its budget, and not longer than the longest."""
    times = [failure_s(fault, candidate.geometry) or 0.0 for fault in candidate.faults]
    return min(max(times) + candidate.budget_s + 1.0, _LONGEST_S)


def _alarms_per_h(bank: LinearBank, candidate: _Candidate) -> float:
    result = false_alarm_probability(bank, int(600 * bank.spec.rate_hz), _ALARM_RUNS, candidate.seed)
    return float(-np.log1p(-min(result.value, 1.0 - 1e-12)) * 6.0)


def _row(
    candidate: _Candidate, bank: LinearBank, fault: Fault, first: Floats, by: Floats, alarms_per_h: float
) -> dict[str, object]:
    spec = candidate.spec
    # A fault is in the data one epoch after it began at the earliest; the negation takes one epoch more.
    detected_s = np.where(first >= 0, (first + 1) / spec.rate_hz, np.inf)
    failed_s = failure_s(fault, candidate.geometry)
    horizon_s = _horizon_s(candidate)
    judged = failed_s is not None and failed_s + candidate.budget_s <= horizon_s
    in_time = detected_s + 1.0 / spec.rate_hz <= (failed_s or 0.0) + candidate.budget_s
    share = clopper_pearson(int(in_time.sum()), in_time.size)
    missed = clopper_pearson(int((detected_s > (failed_s or 0.0)).sum()), in_time.size)
    seen = first >= 0
    return {
        "bank": candidate.number,
        "alphas": ", ".join(f"{alpha:g}" for alpha in spec.weights),
        "sensors": spec.sensors,
        "probability": spec.false_alarm_probability,
        "rate_hz": spec.rate_hz,
        "fault": fault.name,
        "runs": first.size,
        "detected": float(seen.mean()),
        "time_to_detect_median_s": float(np.median(detected_s)) if seen.mean() > 0.5 else None,
        "first_monitor": bank.names[np.bincount(by[seen]).argmax()] if seen.any() else None,
        "failure_s": failed_s,
        "pmd_at_failure": missed.value if judged else None,
        "pmd_at_failure_low": missed.low if judged else None,
        "pmd_at_failure_high": missed.high if judged else None,
        "within_budget": share.value if judged else None,
        "within_budget_low": share.low if judged else None,
        "within_budget_high": share.high if judged else None,
        "false_alarms_per_h": alarms_per_h,
    }


def compare_banks(
    specs: Sequence[BankSpec] | None = None,
    faults: tuple[Fault, ...] = CATALOGUE,
    repetitions: int = REPETITIONS,
    seed: int = SEED,
    jobs: int = 1,
) -> pl.DataFrame:
    """One row per bank and fault."""
    chosen = list(specs) if specs is not None else candidates()
    budget_s = Configuration().budget_s
    tasks = [
        _Candidate(number, spec, default_geometry("gps"), faults, repetitions, seed, budget_s)
        for number, spec in enumerate(chosen)
    ]
    rows = [row for part in mapped(_evaluate, tasks, jobs) for row in part]
    return pl.DataFrame(rows, infer_schema_length=None)


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
        faults_in_time=(pl.col("within_budget_low") > 0.95).sum(),
        faults_seen=(pl.col("detected") > 0.5).sum(),
        share_in_time=pl.col("within_budget").mean(),
        late=pl.col("fault").filter(pl.col("within_budget_low") <= 0.95).str.join(", "),
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


def write_bank(
    out: Path, repetitions: int | None = None, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> list[Path]:
    """`comparison.parquet` by bank and fault, `ranking.parquet` with the best first, `recommendation.md`.

    A configured bank enters the comparison beside the candidates.
    """
    count = repetitions or REPETITIONS
    specs = candidates()
    if config is not None:
        specs += [
            replace(BankSpec.of(config.monitors, sensors, rate_hz), map_m=_MAP_M)
            for sensors in SENSORS
            for rate_hz in (1.0, 10.0)
        ]
    comparison = compare_banks(list(dict.fromkeys(specs)), repetitions=count, seed=seed, jobs=jobs)
    ranking = rank_banks(comparison)
    settings = {"experiment": "bank", "repetitions": count, "seed": seed}
    written = write_tables(out, {"comparison": comparison, "ranking": ranking}, settings)
    return [*written, write_page(out / "recommendation.md", recommendation_page(ranking))]
