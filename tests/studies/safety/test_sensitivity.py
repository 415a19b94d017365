"""How much the verdict depends on the service level: from the hazardous times that stand in the table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from pipeline.results.store import write_run
from pipeline.studies.safety.sensitivity import runs_at_level, vary_keys
from schemas.config import Configuration
from schemas.run import RunTables
from schemas.tables import TABLES, Runs
from tests.tables import table


def runs(**changed: Any) -> pl.DataFrame:
    """A run whose two failures were in use for 1.0 s, and for 0.2 s or, where unknown time counts, 2.0 s."""
    plain: dict[str, Any] = {
        "solution": "primary",
        "status": "ok",
        "verdict": "unsafe",
        "share_unknown": 0.0,
        "balises_accepted": 3,
        "failures": 2,
        "failures_beyond_budget": 1,
        "failure_hazardous_s": [[1.0, 0.2]],
        "failure_hazardous_may_s": [[1.0, 2.0]],
        "failure_accepted": [["right", "right"]],
    }
    return table(Runs, 1, **(plain | changed)).insert_column(0, pl.Series("run_id", ["r"]))


def verdict_at(allowed_s: float, **changed: Any) -> tuple[str, int, int]:
    row = runs_at_level(runs(**changed), allowed_s, Configuration()).row(0, named=True)
    return row["verdict"], row["failures_within_budget"], row["failures_beyond_budget"]


def test_a_longer_allowed_time_makes_failures_unproven_and_then_safe() -> None:
    assert verdict_at(0.5) == ("unsafe", 0, 1)
    assert verdict_at(1.5) == ("unproven", 1, 0)
    assert verdict_at(2.0) == ("safe", 2, 0)


def test_a_wrong_acceptance_stays_unsafe_at_any_level() -> None:
    assert verdict_at(100.0, unsafe_accepted=1) == ("unsafe", 2, 0)


def test_a_failed_run_has_no_verdict() -> None:
    row = runs_at_level(runs(status="failed", verdict=None), 100.0, Configuration()).row(0, named=True)
    assert row["verdict"] is None


def test_one_table_says_where_each_row_comes_from(tmp_path: Path) -> None:
    asked: list[tuple[float, float]] = []

    def replay(config: Configuration, out: str) -> None:
        asked.append((config.hazards.failure_limit_m, config.hazards.evidence_factor))
        empty = {name: schema.create_empty() for name, schema in TABLES.items() if name != "runs"}
        write_run(RunTables("r", runs=runs(verdict="safe").drop("run_id"), **empty), out, {})

    without, found = (vary_keys(runs(), Configuration(), again) for again in (None, replay))
    needed = without.filter(pl.col("how") == "needs --logs")
    assert needed.select("key", "value").rows() == [
        *(("failure_limit_m", "10"), ("failure_limit_m", "30")),
        *(("evidence_factor", "2"), ("evidence_factor", "4"), ("evidence_factor", "5")),
    ]
    assert needed["verdict"].null_count() == 5
    assert asked == [(10.0, 3.0), (30.0, 3.0), (20.0, 2.0), (20.0, 4.0), (20.0, 5.0)]
    assert found.filter(pl.col("how") == "replayed")["verdict"].to_list() == ["safe"] * 5
    levels = {row["value"].split(" ")[0]: row["verdict"] for row in found.iter_rows(named=True)}
    # 24.12 s and 100.5 s are longer than 2.0 s; 0.5025 s is shorter than 1.0 s and 1.675 s than 2.0 s.
    assert (levels["npa"], levels["lpv200"], levels["egnos_observed"]) == ("safe", "unsafe", "unproven")
