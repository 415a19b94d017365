"""Rare events of the pseudorange monitor, alone on its ranges: misses of a slow ramp, alarms of healthy ones."""

from __future__ import annotations

import polars as pl

from datasets.experiment.geometry import CONSTELLATIONS, default_geometry
from datasets.experiment.ranges import RangePlan
from datasets.experiment.rare import Probability, false_alarm_probability, missed_detection_probability
from datasets.experiment.rare_ranges import RangeSystem, miss_at_one_epoch, range_system
from datasets.experiment.rare_rows import SMALLEST, figures, first_below
from schemas.config import Configuration

TARGETS: tuple[float, ...] = (1e-4, 1e-9)
# Ramps, and how often residuals are recorded for them.
_ASKED: tuple[tuple[float, float], ...] = ((0.01, 10.0), (0.01, 30.0), (0.1, 1.0), (0.1, 10.0))
_LONGEST_S = 10_000.0
_HOUR_S = 3_600.0
_SEARCH_RUNS = 500
_HEADING_DEG = 0.0
_ALARM_SHARE = 20


def range_table(runs: int, seed: int, jobs: int, config: Configuration | None = None) -> pl.DataFrame:
    """Times at which a miss is as rare as each target, the misses at the mean failure, and alarms within an hour."""
    rows: list[dict[str, object]] = []
    for constellation in CONSTELLATIONS:
        for rate, period_s in _ASKED:
            plan = _plan(constellation, period_s, config)
            system = range_system(plan, _HEADING_DEG)
            labels = {"constellation": constellation, "period_s": period_s}
            slope = abs(float(plan.geometry.axes(_HEADING_DEG)[0] @ plan.geometry.ramp_direction)) * rate
            failure = min(plan.failure_limit_m / slope, _LONGEST_S)
            for reason, epochs in _times(system, rate, failure, seed, jobs):
                result = missed_detection_probability(system, epochs, rate, runs, seed, jobs)
                rows.append(labels | _missed(system, rate, reason, epochs, failure, result))
            if rate == _ASKED[0][0] or period_s == _ASKED[2][1]:
                epochs = int(_HOUR_S / period_s)
                alarm = false_alarm_probability(system, epochs, max(runs // _ALARM_SHARE, 20), seed, jobs)
                rows.append(labels | {"event": "false_alarm", "time_s": _HOUR_S, **figures(alarm)})
    return pl.DataFrame(rows, infer_schema_length=None)


def _plan(constellation: str, period_s: float, config: Configuration | None) -> RangePlan:
    geometry = default_geometry("gps" if constellation == "gps" else "gps_galileo")
    if config is None:
        return RangePlan(geometry, period_s=period_s)
    return RangePlan(geometry, period_s=period_s, false_alarm_probability=config.monitors.false_alarm_probability)


def _times(system: RangeSystem, rate: float, failure_s: float, seed: int, jobs: int) -> list[tuple[str, int]]:
    times = [("failure", int(failure_s / system.period_s))]
    found = first_below(
        lambda n: missed_detection_probability(system, n, rate, _SEARCH_RUNS, seed, jobs).value,
        TARGETS,
        int(_LONGEST_S / system.period_s),
    )
    times += [(f"{target:g}", epochs) for target, epochs in zip(TARGETS, found, strict=True) if epochs is not None]
    return times


def _missed(
    system: RangeSystem, rate: float, reason: str, epochs: int, failure_s: float, result: Probability
) -> dict[str, object]:
    time_s = epochs * system.period_s
    return {
        "event": "missed_detection",
        "rate_mps": rate,
        "chosen_for": reason,
        "time_s": time_s,
        "mean_failure_s": failure_s,
        "at_most": max(miss_at_one_epoch(system, rate * time_s), SMALLEST),
        **figures(result),
    }
