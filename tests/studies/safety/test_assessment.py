"""What `balise safety OUT` says of a small result worked by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline.results.store import write_config, write_run
from pipeline.show.assessment import for_reading
from pipeline.studies.safety.assessment import Assessment, alarm_causes, assess
from schemas.config import Configuration
from schemas.run import RunTables
from schemas.tables import Runs
from tests.tables import NS, alarms, epochs, hazards, passages, table

ACROSS = {"monitors": [["cross_raw"]], "verdict": "false", "suspect": "unknown", "netelement_id": "A"}


def run_of(run_id: str, solutions: tuple[str, ...] = ("primary",), counted: Any = None, **found: Any) -> RunTables:
    rows: dict[str, Any] = {
        "solution": list(solutions),
        "status": "ok",
        "evidence": "reference",
        "duration_s": 3600.0,
        "held_s": 3600.0,
        "evidence_s": 3600.0,
        "judged_s": 3600.0,
        "gnss_rate_hz": 10.0,
        "false_alarms": 0,
        "false_alarm_rate_per_h": 0.0,
        "in_use_s": 3600.0,
        "in_use_judged_s": 3600.0,
        "balises_accepted": 1,
        "reasons": [[]] * len(solutions),
        "verdict": "safe",
        "input_digest": run_id,
        "failure_hazardous_s": [[]] * len(solutions),
        "failure_hazardous_may_s": [[]] * len(solutions),
        "failure_accepted": [[]] * len(solutions),
    } | (counted or {})
    points = [20.0 * k for k in range(3)]
    stand = {"netelement_id": "A", "measure_m": points, "path_m": points, "sigma_along_m": 1.0}
    tables = {"hazards": hazards(), "alarms": alarms(), "passages": passages()} | found
    frames = pl.concat(epochs([0, 1, 2], solution=name, **stand) for name in solutions)
    return RunTables(run_id, epochs=frames, runs=table(Runs, len(solutions), **rows), **tables)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Assessment:
    out = tmp_path_factory.mktemp("assessed")
    fault = hazards(
        1,
        solution="primary",
        t_onset=0,
        t_failure=5 * NS,
        t_detected=6 * NS,
        time_since_failure_s=1.0,
        time_to_detect_s=5.9,
        budget_s=1.675,
    )
    failed = {
        "verdict": "unsafe",
        "failures": 1,
        "failures_beyond_budget": 1,
        "failure_hazardous_s": [[1.0]],
        "failure_hazardous_may_s": [[1.0]],
        "failure_accepted": [["right"]],
    }
    across = alarms(1, solution="primary", measure_m=500.0, **ACROSS)
    write_run(run_of("a", counted=failed | {"faults_injected": True}, hazards=fault, alarms=across), out, {})
    write_run(run_of("b", alarms=across.with_columns(measure_m=540.0)), out, {})
    write_run(run_of("c", ("gps", "primary")), out, {})
    return assess(out)


def test_tables(found: Assessment) -> None:
    figures = {row["solution"]: row for row in found.tables["figures"].iter_rows(named=True)}
    assert (figures["primary"]["runs"], figures["gps"]["runs"]) == (3, 1)
    assert (figures["primary"]["hours_with_truth"], figures["primary"]["failures"]) == (3.0, 1)
    assert (figures["primary"]["missed_known"], figures["primary"]["missed"]) == (1, 0)
    levels = found.tables["levels"].filter(solution="primary").select("service_level", "kept", "exceeded", "no_failure")
    assert levels.rows() == [
        ("npa", 1, 0, 2),
        ("lpv200", 0, 1, 2),
        ("egnos_observed", 1, 0, 2),
        ("horizontal_sis", 1, 0, 2),
    ]
    assert found.tables["levels_of_runs"].height == 16


def test_only_runs_with_several_solutions_are_compared(found: Assessment) -> None:
    assert set(found.tables["side_by_side_of_runs"]["run_id"]) == {"c"}
    assert found.tables["side_by_side"].select("architecture", "solution", "other", "runs").rows() == [
        ("reactive 1oo1", "gps", None, 1),
        ("reactive 1oo1", "primary", None, 1),
        ("composite 2oo2", "gps", "primary", 1),
        ("reactive 1oo2", "gps", "primary", 1),
    ]


def test_the_map_is_the_suspect_where_runs_agree(found: Assessment) -> None:
    assert found.tables["alarms"].rows() == [("primary", "false", "map", 2, 2)]
    assert found.tables["map"].select("from_m", "to_m", "runs").rows() == [(500.0, 540.0, 2)]
    one = alarms(1, solution="primary", measure_m=500.0, **ACROSS).with_columns(run_id=pl.lit("a"))
    assert alarm_causes(one, 100.0)["suspect"].to_list() == ["unknown"]


def test_statements_say_what_the_figures_are_not(found: Assessment) -> None:
    said = found.statements
    assert said[0].startswith("unsafe: 1 unsafe, 0 unproven, 2 safe, 0 failed; ")
    assert said[1].startswith("Faults were injected into 1 of 3 runs")
    assert any(text.startswith("primary: 1 position failures in use, at a virtual balise or not: 0") for text in said)
    assert "0 in time for 0.5025 s (lpv200; 1 judged by a truth, 95 %: 0.0% to 97.5%)" in said[-1]


def test_what_nobody_can_judge_is_said(tmp_path: Path) -> None:
    write_run(run_of("whole"), tmp_path, {})
    assert not any("could not be checked" in text or "partial" in text for text in assess(tmp_path).statements)
    blind = run_of("blind", alarms=alarms(1, solution="primary", verdict="unknown"))
    evidence = pl.lit(None, blind.runs.schema["evidence"])
    rows = blind.runs.with_columns(
        evidence=evidence, evidence_s=0.0, balises_accepted=0, false_alarm_rate_per_h=pl.lit(None, pl.Float64)
    )
    write_run(RunTables(**{**vars(blind), "runs": rows}), tmp_path, {})
    cut = run_of("cut")
    rows = cut.runs.with_columns(status=pl.lit("partial", cut.runs.schema["status"]))
    write_run(RunTables(**{**vars(cut), "runs": rows}), tmp_path, {})
    found = assess(tmp_path)
    said = found.statements
    assert set(found.tables["levels"].select("no_failure", "unknown", "no_truth").rows()) == {(2, 1, 1)}
    assert said[1] == "1 of 3 runs are partial: only what was read of them counts."
    assert said[2].startswith(
        "primary: in 1 of 3 h the position could not be checked (1 of 3 runs have no evidence at all)"
    )
    assert said[3].startswith("primary: 1 alarms in 1 runs could not be checked.")


def test_a_solution_that_failed_alone_is_named_as_such(tmp_path: Path) -> None:
    half, lost = run_of("half", ("gps", "primary")), run_of("lost", ("",))
    status = pl.Series("status", ["failed", "ok"]).cast(half.runs.schema["status"])
    verdict = pl.Series("verdict", [None, "safe"]).cast(half.runs.schema["verdict"])
    write_run(RunTables(**{**vars(half), "runs": half.runs.with_columns(status, verdict)}), tmp_path, {})
    nothing = pl.lit(None, lost.runs.schema["verdict"])
    failed = lost.runs.with_columns(status=pl.lit("failed", lost.runs.schema["status"]), verdict=nothing)
    write_run(RunTables(**{**vars(lost), "runs": failed}), tmp_path, {})
    said = assess(tmp_path).statements
    assert said[0].startswith("unproven: 0 unsafe, 1 unproven, 0 safe, 1 failed; ")
    assert said[1] == "1 of 2 runs failed and are left out of all figures."
    assert said[2].startswith("gps: 1 of 2 runs failed with this solution alone and are left out")


def test_receivers_too_slow_are_named(tmp_path: Path) -> None:
    slow = run_of("a")
    write_run(RunTables(**{**vars(slow), "runs": slow.runs.with_columns(gnss_rate_hz=1.0)}), tmp_path, {})
    said = assess(tmp_path).statements
    assert "primary: the receiver is too slow for lpv200 in 1 runs" in said[1]
    assert not any("npa" in text for text in said)
    write_config(tmp_path, Configuration.model_validate({"hazards": {"reaction_s": 0.1}}))
    assert sum("too slow" in text for text in assess(tmp_path).statements) == 1


def test_other_service_levels_leave_the_limits_of_the_result_alone(tmp_path: Path) -> None:
    limits = {"lds": {"ci_limit_m": 25.0}, "hazards": {"failure_limit_m": 10.0, "reaction_s": 0.1}}
    one = passages(1, solution="primary", kind="virtual", status="accepted", location_error_m=20.0)
    write_run(run_of("a", ("gps", "primary"), passages=one), tmp_path, {})
    write_config(tmp_path, Configuration.model_validate(limits))
    other = Configuration.model_validate({"safety": {"demands_per_hour": 4.0}})
    own, judged = assess(tmp_path), assess(tmp_path, other)
    for name in ("accuracy", "side_by_side", "figures", "alarms"):
        assert judged.tables[name].equals(own.tables[name]), name
    assert set(judged.tables["accuracy"]["ci_limit_m"]) == {25.0}
    needed, allowed = ("receiver_needs_s", "allowed_s")
    assert judged.tables["levels_of_runs"][needed].equals(own.tables["levels_of_runs"][needed])
    quarter = own.tables["levels_of_runs"][allowed] / 4.0
    assert judged.tables["levels_of_runs"][allowed].to_list() == pytest.approx(quarter.to_list())


def test_for_reading_leaves_out_what_is_empty_or_of_single_runs(found: Assessment) -> None:
    shown = for_reading(found.tables)
    assert "places where the map is in doubt" in shown
    assert all(frame.height for frame in shown.values())
    figures = shown["figures of primary, with exact 95 % bounds"]
    assert figures.columns == ["figure", "value", "low", "high", "unit", "source"]
    by_name = {row["figure"]: row for row in figures.iter_rows(named=True)}
    measured = found.tables["figures"].filter(pl.col("solution") == "primary").row(0, named=True)
    for figure, low, high in (
        ("false_alarm_rate_per_h", "false_alarm_rate_low_per_h", "false_alarm_rate_high_per_h"),
        ("mtbf_h", "mtbf_low_h", "mtbf_high_h"),
        ("unsafe_share", "unsafe_share_low", "unsafe_share_high"),
    ):
        row = by_name[figure]
        assert (row["value"], row["low"], row["high"]) == (measured[figure], measured[low], measured[high])
        assert row["source"]
    assert {row["unit"] for row in by_name.values()} == {"1", "h", "1/h", "m"}
    assert all(row["source"] for row in by_name.values())
    bounds = [name for name in measured if "_low" in name or "_high" in name]
    assert len(by_name) == len(measured) - len(bounds) - 1


def test_a_recording_under_two_names_counts_once(tmp_path: Path) -> None:
    """Replayed with two vehicle files: the worse one counts."""
    for run_id, digest, verdict in (("a", "x", "safe"), ("b", "x", "unsafe"), ("c", "y", "safe")):
        write_run(run_of(run_id, counted={"input_digest": digest, "verdict": verdict}), tmp_path, {})
    figures = assess(tmp_path).tables["figures"]
    assert figures.select("runs", "hours_with_truth", "runs_unsafe").rows() == [(2, 2.0, 1)]


@pytest.mark.parametrize(("digests", "stated"), [(("x", "x"), False), (("x", "y"), True)])
def test_runs_of_other_settings_are_stated(digests: tuple[str, str], stated: bool, tmp_path: Path) -> None:
    for run_id, digest in zip("ab", digests, strict=True):
        write_run(run_of(run_id, counted={"config_digest": digest, "input_digest": run_id}), tmp_path, {})
    assert any("with 2 settings or vehicle files" in text for text in assess(tmp_path).statements) == stated
