"""The verdict heads every page, coloured by it; from tables made by hand."""

import re
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline.results.store import write_run
from pipeline.show.report import markup, write_report
from pipeline.show.report.balises import balise_table
from pipeline.show.report.markup import cell
from pipeline.stages.prepare import Provenance
from pipeline.stages.run_row.summary import failed_row
from schemas.campaign import CampaignBalises
from schemas.run import RunTables
from schemas.tables import TABLES, Runs
from tests.tables import NS, alarms, epochs, hazards, passages, table

SAFE = {
    "verdict": "safe",
    "reasons": [[]],
    "balises_found": 1,
    "balises_passed": 1,
    "balises_accepted": 1,
    "balises_on_path": 1,
    "accepted_judged": 1,
    "share_unknown": 0.004,
}
UNSAFE = {
    "verdict": "unsafe",
    "reasons": [["accepted_wrong", "failure_beyond_budget", "budget_unknown", "unknown_in_use"]],
    "balises_found": 2,
    "balises_passed": 3,
    "balises_accepted": 2,
    "balises_on_path": 3,
    "availability": 0.25,
    "held_s": 60.0,
    "moving_s": 60.0,
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
    spent: dict[str, Any] = {"failure_hazardous_s": [failed_s], "failure_hazardous_may_s": [failed_s]}
    spent["failure_accepted"] = [["right"] * len(failed_s)]
    plain = {"solution": "primary", "evidence": "balise", "vehicle": "file", "duration_s": 60.0, "evidence_s": 60.0}
    judgement = ["right", "unknown", "wrong"]
    errors_m, hit_by = ([0.5, None, 500.0], [None, None, 0]) if failed_s else ([0.5], [None])
    offers: dict[str, Any] = {"solution": "primary", "status": "accepted", "measure_m": 1.0, "path_m": 1.0}
    offers |= {"judgement": judgement[: len(errors_m)], "balise_id": ["VB0", "VB1", "VB2"][: len(errors_m)]}
    fault: dict[str, Any] = {"hazard": "VB_JUMP_1B", "size_m": 620.0, "timing": "early", "budget_s": 0.5025}
    fault |= {"balise_ids": [["VB2"]], "accepted_ids": [["VB2"]], "t_failure": NS, "solution": "primary"}
    hit = hazards(1, **fault) if failed_s else hazards()
    return RunTables(
        run_id,
        epochs=epochs([0.0, 1.0, 2.0], solution="primary", judgement=judgement, netelement_id="A", measure_m=1.0),
        passages=passages(len(errors_m), location_error_m=errors_m, hazard_id=hit_by, **offers),
        hazards=hit,
        alarms=alarms(),
        runs=table(Runs, 1, **(plain | levels | spent | counts)),
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("verdicts")
    files = '[["good/gnss.parquet", 1200, "ab12"], ["good/<b>", 7, "cd34"]]'
    write_run(run_of("good", SAFE, []), out, {"log_files": files, "log_digest": "ef56"})
    write_run(run_of("bad", UNSAFE, [0.2, 7.0, 0.1]), out, {})
    empty = {name: schema.create_empty() for name, schema in TABLES.items()}
    lost = failed_row("gnss.parquet: column t: not in order", Provenance("c", "i", "test"))
    write_run(RunTables("lost", **(empty | {"runs": lost})), out, {})
    write_report(out)
    return out / "report"


@pytest.mark.parametrize(
    ("page", "word", "reason"),
    [
        ("index.html", "unsafe", "VB_JUMP_1B: VB2 accepted 500.0 m early; no monitor saw it (run bad)."),
        (
            "runs/good.html",
            "safe",
            "every acceptance right, every position failure within the time allowed; no fault occurred.",
        ),
        ("runs/bad.html", "unsafe", "VB_JUMP_1B: VB2 accepted 500.0 m early; no monitor saw it."),
        ("runs/lost.html", "failed", "gnss.parquet: column t: not in order."),
    ],
)
def test_the_verdict_is_the_first_word(report: Path, page: str, word: str, reason: str) -> None:
    body = (report / page).read_text().partition("<header>")[2]
    assert body.startswith(f'<p class="verdict {word}"><strong>{word}</strong>: {reason}')


def test_a_safe_run_says_what_it_rests_on(tmp_path: Path) -> None:
    """40 of 50 s in use judged; the largest unnoticed error is said where it was computed, else that it was not."""
    used = SAFE | {"in_use_s": 50.0, "in_use_judged_s": 40.0}
    for run_id, largest in (
        ("known", {"undetected_max_m": 14.26, "undetected_share_beyond": 0.0}),
        ("beyond", {"undetected_max_m": 29.0, "undetected_share_beyond": 0.125}),
        ("silent", {}),
    ):
        write_run(run_of(run_id, used | largest, []), tmp_path, {})
    write_report(tmp_path)
    banner = {
        name: (tmp_path / "report" / page).read_text().partition("<header>")[2].partition("</p>")[0]
        for name, page in (
            ("known", "runs/known.html"),
            ("beyond", "runs/beyond.html"),
            ("silent", "runs/silent.html"),
            ("all", "index.html"),
        )
    }
    assert "Judged by balise reads for 80% of the time in use." in banner["known"]
    assert "The largest error that no monitor would have noticed was 14.3 m (not proved on curves)." in banner["known"]
    assert "29.0 m (not proved on curves), beyond the failure limit for 12.5% of the epochs in use." in banner["beyond"]
    for name in ("silent", "all"):
        assert (
            "no monitor would have noticed was not computed (`balise replay --undetected`; `undetected` in balise.toml)"
            in banner[name]
        )


def test_physical_balises_are_not_the_worst_for_want_of_a_judge() -> None:
    """P1 was read twice, which nobody checks; VB1 was accepted once without a check."""
    counts = {"runs": 2, "passages": 2, "unsafe_accepted": 0, "lost": 0, "lost_share": 0.0}
    rows = table(
        CampaignBalises, 2, balise_id=["P1", "VB1"], kind=["physical", "virtual"], unproven_accepted=[2, 1]
    ).with_columns(**{name: pl.lit(value) for name, value in counts.items()})  # fmt: skip
    text = balise_table("t", "Balises", rows)
    assert text.index(">VB1<") < text.index(">P1<")


def test_ten_columns_are_shown_and_the_rest_behind_a_switch() -> None:
    heads = [(f"c{number}", "") for number in range(12)]
    text = markup.table("t", "Many", heads, [[cell(number) for number in range(12)]])
    assert re.findall(r'<th[^>]*class="number more"[^>]*>(\w+)<', text) == ["c10", "c11"]
    assert "all 12 columns" in text
    assert "columns</label>" not in markup.table("t", "Few", heads[:10], [[cell(number) for number in range(10)]])


def test_all_reasons_stand_behind_it(report: Path) -> None:
    page = (report / "runs" / "bad.html").read_text()
    assert "VBs accepted despite a wrong position: 1; position failures in use for longer than allowed: 1" in page
    assert "position failures of unknown length: 1; positions in use without a check for" in page
    assert "accepted despite the fault" in page
    assert "1 unsafe, 1 safe, 1 failed." in (report / "index.html").read_text()


def test_bad_tiles_look_bad(report: Path) -> None:
    tiles = [
        dict(re.findall(r'<div class="tile ?(\w*)"><dt>accepted at a wrong place</dt><dd>(\d)</dd>', page.read_text()))
        for page in (report / "runs" / "bad.html", report / "runs" / "good.html")
    ]
    assert tiles == [{"bad": "1"}, {"good": "0"}]


def test_runs_stand_worst_first(report: Path) -> None:
    table_of_runs = (report / "index.html").read_text().partition('id="table-runs"')[2]
    assert table_of_runs.index(">bad<") < table_of_runs.index(">lost<") < table_of_runs.index(">good<")


def test_failures_against_the_levels(report: Path) -> None:
    """0.2, 7.0 and 0.1 s against 0.5025 s: two within, one beyond, though a single hazard row was hit."""
    levels = (report / "index.html").read_text().partition('id="table-levels-s0"')[2]
    row = levels.partition(">lpv200<")[2].partition("</tr>")[0]
    assert re.findall(r'data-order="([\d.]+)"', row)[1:4] == ["3.0", "2.0", "1.0"]


def test_the_files_of_a_run_are_named(report: Path) -> None:
    page = (report / "runs" / "good.html").read_text().partition('id="table-files"')[2].partition("</table>")[0]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in page.split("<tr>")[2:]]
    assert rows == [["log", "good/gnss.parquet", "1\u202f200", "ab12"], ["log", "good/&lt;b&gt;", "7", "cd34"]]


def test_the_figures_stand_beside_every_verdict(report: Path) -> None:
    for page, figures in (("runs/bad.html", "2 of 3 balises accepted, available for 25% of the moving time"),
                       ("runs/good.html", "1 of 1 balises accepted, availability not known (no odometer "),
                       ("index.html", "3 of 4 balises accepted, available for 25% of the moving time")):  # fmt: skip
        assert figures in (report / page).read_text().partition("<header>")[2].partition("<h1>")[0]


def test_numbers_of_a_list_are_rounded_as_others_are() -> None:
    assert cell([0.448815736651947, 0.12], 4).text == "0.4488, 0.12"
