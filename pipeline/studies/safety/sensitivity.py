"""How much the verdict depends on what was chosen: failure limit, service level, width of the evidence.

Service levels need no new replay: how long each failure was in use stands in the `runs` table. The failure limit and
the width of the evidence decide what a failure is, and the limit also when a blocked position may return, so that these
need the logs again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from typing import Any

import polars as pl

from pipeline.results import store
from pipeline.results.figures.head import head_of, run_verdicts
from pipeline.stages.run_row.run_figures import count_kept_and_exceeded, failures_of_run, reasons_of, verdict_of
from schemas.config import Configuration
from schemas.enums import RunStatus

# Shares of the configured value: a half and half as much again; two to five sigma round the usual three.
_VARIED = {"failure_limit_m": (0.5, 1.5), "evidence_factor": (2.0 / 3.0, 4.0 / 3.0, 5.0 / 3.0)}
_TABLES = "from tables"
_REPLAYED = "replayed"
_NEEDED = "needs --logs"

Row = dict[str, Any]
Replay = Callable[[Configuration, str], object]


def vary_keys(runs: pl.DataFrame, config: Configuration, replay: Replay | None = None) -> pl.DataFrame:
    """One row per key of `[hazards]` and value: runs by verdict, wrong acceptances, failures beyond the time allowed.

    `how` says where a row comes from. `replay` replays the logs with a configuration into a folder; without it the rows
    that need it have no figures.
    """
    used = config.hazards.service_level
    rows: list[Row] = []
    for level in config.safety.service_levels:
        allowed_s = config.safety.allowed_time_to_detect_s(level)
        name = f"{level} ({allowed_s:.4g} s)" + (", configured" if level == used else "")
        rows.append(_sensitivity_row("service_level", name, runs_at_level(runs, allowed_s, config), _TABLES))
    for key, shares in _VARIED.items():
        for value in sorted(round(share * getattr(config.hazards, key), 6) for share in (*shares, 1.0)):
            rows.append(_vary_key(runs, config, key, value, replay))
    return pl.DataFrame(rows, schema=_SCHEMA)


def runs_at_level(runs: pl.DataFrame, allowed_s: float, config: Configuration) -> pl.DataFrame:
    """The `runs` rows as they would be with another allowed time: failures within and beyond it, and the verdict."""
    return pl.DataFrame(
        [_with_allowed(row, allowed_s, config) for row in runs.iter_rows(named=True)],
        schema=runs.schema,
    )


def _with_allowed(row: Row, allowed_s: float, config: Configuration) -> Row:
    """A `runs` row with the failures, reasons and verdict of another allowed time."""
    if row["status"] == RunStatus.FAILED:
        return row
    within, beyond = count_kept_and_exceeded(failures_of_run(row), allowed_s)
    counted = {**row, "failures_within_budget": within, "failures_beyond_budget": beyond}
    reasons = reasons_of(counted, allowed_s, config.hazards)
    return {**counted, "reasons": reasons, "verdict": verdict_of(reasons).value}


def _vary_key(runs: pl.DataFrame, config: Configuration, key: str, value: float, replay: Replay | None) -> Row:
    """One key of `[hazards]` at one value."""
    if value == getattr(config.hazards, key):
        return _sensitivity_row(key, f"{value:g}, configured", runs, _TABLES)
    if replay is None:
        return {"key": key, "value": f"{value:g}", "how": _NEEDED}
    changed = config.model_copy(update={"hazards": config.hazards.model_copy(update={key: value})})
    with tempfile.TemporaryDirectory(prefix="balise-safety-") as folder:
        replay(changed, folder)
        again = store.read_table(folder, "runs").collect()
    return _sensitivity_row(key, f"{value:g}", again, _REPLAYED)


def _sensitivity_row(key: str, value: str, runs: pl.DataFrame, how: str) -> Row:
    """Verdict and counts over all runs, for one value of a key."""
    head = head_of(run_verdicts(runs).values())
    counts = {name: int(runs[name].sum()) for name in _COUNTS}
    return {"key": key, "value": value, "how": how, "verdict": head.word, **head.counts(), **counts}


_COUNTS = ("unsafe_accepted", "unproven_accepted", "failures", "failures_beyond_budget")
_SCHEMA = {
    **dict.fromkeys(("key", "value", "how", "verdict"), pl.String),
    **dict.fromkeys(("unsafe", "unproven", "safe", "failed", *_COUNTS), pl.Int64),
}
