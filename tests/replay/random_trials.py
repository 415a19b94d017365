"""What the tables of a random trial say otherwise than they must."""

from __future__ import annotations

import argparse
import sys
from typing import Any

import polars as pl

from datasets.expected_hazards import ExpectedRow
from datasets.random_trials import ON_ODOMETER, RandomTrial, random_trial
from pipeline.one_run import replay
from pipeline.stages.epochs.clock import nominal_period_s
from schemas.enums import Verdict
from schemas.run import RunTables


def deviations(trial: RandomTrial, tables: RunTables) -> list[str]:
    """In words, what the tables of a trial say otherwise than expected; empty where all is right."""
    first = trial.run.gnss["t"].min()
    hazards = tables.hazards.with_columns(t_s=(pl.col("t_hazard") - first).dt.total_nanoseconds() * 1e-9)
    found = hazards.to_dicts()
    wrong: list[str] = []
    if len(found) != len(trial.rows):
        wrong.append(f"{len(found)} rows, expected {len(trial.rows)}: {[row['hazard'] for row in found]}")
    for row, expected in zip(found, trial.rows, strict=False):
        wrong += _differences(row, expected, trial)
    return wrong + _wrong_alarms(trial, tables)


def _differences(row: dict[str, Any], expected: ExpectedRow, trial: RandomTrial) -> list[str]:
    wrong = []
    if row["hazard"] != expected.hazard:
        wrong.append(f"{row['hazard']}, expected {expected.hazard}")
    if frozenset(row["balise_ids"]) != expected.balise_ids:
        wrong.append(f"balises {row['balise_ids']}, expected {sorted(expected.balise_ids)}")
    if row["caused_by"] != expected.caused_by:
        wrong.append(f"caused by {row['caused_by']}, expected {expected.caused_by}")
    if expected.early is not None and row["timing"] != ("early" if expected.early else "late"):
        wrong.append(f"timing {row['timing']}")
    period_s = nominal_period_s(trial.run.gnss["t"].dt.timestamp("ns").to_numpy()) or 1.0
    if expected.early is None and abs(row["t_s"] - expected.t_s) > period_s + 1e-6:
        wrong.append(f"step at {row['t_s']:.2f} s, expected {expected.t_s:.2f} s")
    if row["suspect"] not in ("gnss", "unknown"):
        wrong.append(f"suspect {row['suspect']}")
    return wrong + _late_detections(row, trial, period_s)


def _late_detections(row: dict[str, Any], trial: RandomTrial, period_s: float) -> list[str]:
    """Steps within one epoch; fast ramps before the failure."""
    detected, period = row["detected"], period_s + 1e-6
    is_step = trial.kind in ("step", "offset") and row["caused_by"] is None
    if is_step and not (detected and row["time_to_detect_s"] <= period):
        return [f"step detected after {row['time_to_detect_s']} s"]
    is_ramp = trial.kind == "ramp" and row["t_failure"] is not None
    if is_ramp and not (detected and row["t_detected"] <= row["t_failure"]):
        return [f"ramp detected at {row['t_detected']}, the failure was at {row['t_failure']}"]
    return []


def _wrong_alarms(trial: RandomTrial, tables: RunTables) -> list[str]:
    wrong = []
    suspects = set(tables.alarms["suspect"].to_list())
    if trial.kind in ("none", "outage") and tables.alarms.height:
        wrong.append(f"alarm by {tables.alarms['monitors'].to_list()}")
    # A position may leave the margin of a healthy one by its own noise; the alarm is then right about it too.
    beside = set(tables.alarms.filter(pl.col("verdict") != Verdict.TRUE)["suspect"].to_list())
    if trial.kind in ON_ODOMETER and not beside <= {"odometer", "unknown"}:
        wrong.append(f"suspects {sorted(beside)} of a fault of the odometer")
    if trial.kind in ("step", "offset", "ramp", "slow ramp") and not suspects <= {"gnss", "unknown"}:
        wrong.append(f"suspects {sorted(suspects)} of a fault of the position")
    return wrong


def main() -> int:
    """Print each trial that is not as expected; exit status 1 if there is one."""
    parser = argparse.ArgumentParser(prog="tests.replay.random_trials", description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    given = parser.parse_args()
    failures = 0
    for seed in range(given.first, given.first + given.trials):
        trial = random_trial(seed)
        wrong = deviations(trial, replay(trial.run, trial.site, trial.vehicle))
        if wrong:
            failures += 1
            print(f"seed {seed} ({trial.kind}): {'; '.join(wrong)}", flush=True)
    print(f"{given.trials} trials, {failures} not as expected")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
