"""Reactive and composite fail-safety on the same run (LOC section III, Fig. 3 and 4), and redundant channels.

Reactive: one solution diagnosed by all monitors but the comparison of channels. Composite: the
comparison of two solutions alone (monitor `channel`). Both are judged on the same hazards and alarms.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.hazards.fails import Fails, fails_of
from pipeline.safety.measured import columns_of
from pipeline.statistics import UNKNOWN, clopper_pearson, poisson_rate
from pipeline.summary import trusted
from pipeline.timeline import Instants, Uptime, gap_limit_s, held_s, nominal_period_s, share_of_time, uptime
from schemas.config import Configuration
from schemas.enums import MonitorState, Verdict
from schemas.tables import MONITORS

COMPARISON = "channel"
ARCHITECTURES: dict[str, tuple[str, ...]] = {
    "reactive": tuple(name for name in MONITORS if name != COMPARISON),
    "composite": (COMPARISON,),
}
# What has to be evaluated for the architecture to diagnose anything along the track.
_NEEDED = {"reactive": "along_raw", "composite": COMPARISON}

Row = dict[str, object]


@dataclass(frozen=True)
class _Detection:
    """Of one fault: T_D [s], none where it was not found, and whether it was negated within the budget."""

    time_to_detect_s: float | None
    failed: bool
    missed: bool


def side_by_side(
    epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> pl.DataFrame:
    """One row per architecture for one solution of one run, from its output tables.

    `availability` is the share of time, gaps apart, in which the architecture diagnoses and does not fail;
    `mtbf_h` the time between the losses of that. False alarms carry the verdict of the alarm they belong to.
    """
    rows = [_architecture_row(name, epochs, hazards, alarms, config) for name in ARCHITECTURES]
    return pl.DataFrame(rows, infer_schema_length=None)


def _architecture_row(
    name: str, epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> Row:
    t_ns = epochs["t"].to_physical().to_numpy()
    limit_s = gap_limit_s(nominal_period_s(t_ns), config.align.gap_reset_s)
    fails = _fails(epochs, ARCHITECTURES[name], config.lds.recovery_s)
    working = epochs[f"{_NEEDED[name]}_state"].cast(pl.String).to_numpy() != MonitorState.NOT_EVALUATED.value
    working[fails.epochs] = False
    faults = [_detection(fault, fails, config) for fault in _faults(hazards)]
    failures = sum(item.failed for item in faults)
    detected = [item.time_to_detect_s for item in faults if item.time_to_detect_s is not None]
    missed = sum(item.missed for item in faults)
    return {
        "architecture": name,
        "hazards": len(faults),
        "detected": len(detected),
        "failures": failures,
        "missed": missed,
        **columns_of("missed_share", clopper_pearson(missed, failures)),
        "time_to_detect_median_s": float(np.median(detected)) if detected else None,
        "time_to_detect_max_s": max(detected, default=None),
        "alarms": len(fails.alarms),
        **_false_alarms(fails, alarms, t_ns),
        "availability": share_of_time(held_s(t_ns, limit_s), working),
        "mtbf_h": uptime(t_ns, working, limit_s).mean_time_between_losses_h,
    }


def _fails(epochs: pl.DataFrame, monitors: Iterable[str], recovery_s: float) -> Fails:
    columns = [f"{name}_{part}" for name in monitors for part in ("state", "value", "threshold")]
    return fails_of(epochs.select("t", *columns, negated=pl.lit(value=False)), recovery_s)


def _faults(hazards: pl.DataFrame) -> list[Row]:
    """One row per fault; those that the end of another made are part of it."""
    instants = [pl.col(name).to_physical() for name in ("t_onset", "t_hazard", "t_failure", "t_end")]
    return hazards.filter(pl.col("caused_by").is_null()).select(*instants, "budget_s").to_dicts()


def _detection(fault: Row, fails: Fails, config: Configuration) -> _Detection:
    onset, failure, end = (_whole(fault[name]) for name in ("t_onset", "t_failure", "t_end"))
    begin = onset if onset is not None else _whole(fault["t_hazard"]) or 0
    last = end if end is not None else int(fails.t_ns[-1])
    standing = fails.standing_at(begin) is not None
    first = fails.first_in(begin, last + 1)
    detected = begin if standing else first[0] if first is not None else None
    reaction_s = config.hazards.reaction_s
    reaction_ns = round((nominal_period_s(fails.t_ns) or 0.0 if reaction_s is None else reaction_s) * 1e9)
    allowed_ns = round(float(str(fault["budget_s"] or 0.0)) * 1e9)
    late = detected is None or (failure is not None and detected + reaction_ns > failure + allowed_ns)
    return _Detection(
        time_to_detect_s=None if detected is None else (detected - begin) / 1e9,
        failed=failure is not None,
        missed=failure is not None and late,
    )


def _whole(value: object) -> int | None:
    return value if isinstance(value, int) else None


def _false_alarms(fails: Fails, alarms: pl.DataFrame, t_ns: Instants) -> Row:
    spans = alarms.select(pl.col("t_start", "t_end").to_physical(), pl.col("verdict").cast(pl.String)).rows()
    verdicts = [
        next((verdict for start, end, verdict in spans if start <= span.start_ns <= end), Verdict.UNKNOWN.value)
        for span in fails.alarms
    ]
    false = verdicts.count(Verdict.FALSE.value)
    hours = (int(t_ns[-1]) - int(t_ns[0])) / 3.6e12 if len(t_ns) else 0.0
    rate = UNKNOWN if Verdict.UNKNOWN.value in verdicts else poisson_rate(false, hours)
    return {"false_alarms": false, **columns_of("false_alarm_rate", rate, "_per_h")}


def redundant_uptime(epochs: pl.DataFrame, config: Configuration) -> Uptime:
    """Time in which at least one of a run's solutions gave a trusted position (1oo2, LOC eq. 11).

    `epochs` of all solutions; a solution's epoch counts at its own time.
    """
    merged = epochs.select("t", good=trusted(config).fill_null(value=False)).group_by("t").agg(pl.col("good").any())
    merged = merged.sort("t")
    t_ns = merged["t"].to_physical().to_numpy()
    parts = epochs.partition_by("solution", maintain_order=True)
    periods = [nominal_period_s(part["t"].to_physical().to_numpy()) or 0.0 for part in parts]
    return uptime(t_ns, merged["good"].to_numpy(), gap_limit_s(max(periods, default=0.0), config.align.gap_reset_s))
