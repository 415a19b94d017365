"""The verdict heads every page, coloured by it; from tables made by hand."""

import re
from pathlib import Path
from typing import Any

import pytest

from pipeline.figures.summary import failed_row
from pipeline.report import write_report
from pipeline.results.provenance import Provenance
from pipeline.results.store import write_run
from schemas.run import RunTables
from schemas.tables import TABLES, Runs
from tests.summary.tables import NS, alarms, epochs, hazards, passages, table

SAFE = {"verdict": "safe", "balises_accepted": 1, "accepted_judged": 1, "share_unknown": 0.004}
UNSAFE = {
    "verdict": "unsafe",
    "balises_accepted": 2,
    "unsafe_accepted": 1,
    "accepted_judged": 1,
    "unproven_accepted": 1,
    "failures": 3,
    "failures_within_budget": 1,
    "failures_beyond_budget": 1,
    "share_unknown": 0.05,
}


def run_of(run_id: str, counts: dict[str, Any], failed_s: list[float]) -> RunTables:
    levels = {"service_levels": [["lpv200"]], "level_allowed_s": [[0.5025]], "level_within": [[1]]}
    levels |= {"level_exceeded": [[1 if failed_s else 0]], "level_verdict": [["exceeded" if failed_s else "kept"]]}
    spent = {"failure_hazardous_s": [failed_s], "failure_hazardous_may_s": [failed_s]}
    plain = {"solution": "primary", "evidence": "balise", "vehicle": "file", "duration_s": 60.0, "evidence_s": 60.0}
    judgement = ["right", "unknown", "wrong"]
    hit = (
        hazards(1, solution="primary", accepted_ids=[["VB2"]], t_failure=NS, budget_s=0.5025) if failed_s else hazards()
    )
    return RunTables(
        run_id,
        epochs=epochs([0.0, 1.0, 2.0], solution="primary", judgement=judgement, netelement_id="A", measure_m=1.0),
        passages=passages(3, solution="primary", status="accepted", judgement=judgement, measure_m=1.0, path_m=1.0),
        hazards=hit,
        alarms=alarms(),
        runs=table(Runs, 1, **(plain | levels | spent | counts)),
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("verdicts")
    write_run(run_of("good", SAFE, []), out, {})
    write_run(run_of("bad", UNSAFE, [0.2, 7.0, 0.1]), out, {})
    empty = {name: schema.create_empty() for name, schema in TABLES.items()}
    lost = failed_row("gnss.parquet: column t: not in order", Provenance("c", "i", "test"))
    write_run(RunTables("lost", **(empty | {"runs": lost})), out, {})
    write_report(out)
    return out / "report"


@pytest.mark.parametrize(
    ("page", "word", "reason"),
    [
        ("index.html", "unsafe", "1 unsafe, 0 unproven, 1 safe, 1 failed."),
        ("runs/good.html", "safe", "primary: safe, every acceptance right, every position failure within"),
        ("runs/bad.html", "unsafe", "primary: unsafe, VBs accepted despite a wrong position: 1; position"),
        ("runs/lost.html", "failed", "run: failed."),
    ],
)
def test_the_verdict_is_the_first_word(report: Path, page: str, word: str, reason: str) -> None:
    body = (report / page).read_text().partition("<header>")[2]
    assert body.startswith(f'<p class="verdict {word}"><strong>{word}</strong> {reason}')


def test_all_reasons_stand_behind_it(report: Path) -> None:
    page = (report / "runs" / "bad.html").read_text()
    assert "position failures of unknown length: 1" in page
    assert "5.0% of the moving time in use could not be checked" in page
    assert "accepted despite the fault" in page


def test_runs_stand_worst_first(report: Path) -> None:
    table_of_runs = (report / "index.html").read_text().partition('id="table-runs"')[2]
    assert table_of_runs.index(">bad<") < table_of_runs.index(">lost<") < table_of_runs.index(">good<")


def test_failures_against_the_levels(report: Path) -> None:
    """0.2, 7.0 and 0.1 s against 0.5025 s: two within, one beyond, though a single hazard row was hit."""
    levels = (report / "index.html").read_text().partition('id="table-levels-s0"')[2]
    row = levels.partition(">lpv200<")[2].partition("</tr>")[0]
    assert re.findall(r'data-order="([\d.]+)"', row)[1:4] == ["3.0", "2.0", "1.0"]
