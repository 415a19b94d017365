"""A count that nobody could make is not zero."""

from __future__ import annotations

from pathlib import Path

from pipeline.campaign.outcome import outcome_of
from pipeline.results.figures.head import is_judged, known_counts
from pipeline.results.store import write_run
from pipeline.show.inspection import inspect_result
from schemas.run import RunTables
from schemas.tables import TABLES, Hazards, Passages, Runs
from tests.tables import table

ROWS = table(
    Runs,
    3,
    status=["ok", "ok", "failed"],
    evidence=["odometer", None, None],
    balises_accepted=[8, 7, 0],
    balises_found=[8, 7, 0],
    hazards_1b=[1, 0, 0],
    lost_to=[None, ["no_position", "no_odometer"], None],
    lost_to_share=[None, [0.6, 0.4], None],
)


def test_without_evidence_the_judged_counts_are_not_known_and_of_a_failed_run_none_is() -> None:
    found = known_counts(ROWS)
    assert found["hazards_1b"].to_list() == [1, None, None]
    assert found["unsafe_accepted"].to_list() == [0, None, None]
    assert found["missed_detections"].to_list() == [0, None, None]
    assert found["balises_accepted"].to_list() == [8, 7, None]
    assert found["alarms"].to_list() == [0, 0, None]
    assert found.columns == ROWS.columns
    assert [is_judged(row) for row in ROWS.iter_rows(named=True)] == [True, False, False]


def test_outcome_of_a_run() -> None:
    counted = [
        (found.hazards, found.missed_detections)
        for found in (
            outcome_of("r", "r", 0.0, rows, Hazards.create_empty(), Passages.create_empty())
            for rows in (ROWS, ROWS[1:2], ROWS[2:])
        )
    ]
    assert counted == [(1, 0), (None, None), (None, None)]


def test_inspected_result(tmp_path: Path) -> None:
    empty = {name: schema.create_empty() for name, schema in TABLES.items()}
    for run_id, row in (("blind", ROWS[1:2]), ("seen", ROWS[:1])):
        write_run(RunTables(run_id, **(empty | {"runs": row})), tmp_path, {})
    inspected = inspect_result(tmp_path)
    assert inspected["Verdict"].rows() == [
        ("verdict", "failed"), ("unsafe", "0"), ("unproven", "0"), ("safe", "0"), ("failed", "2")
    ]  # fmt: skip
    runs = inspected["Runs"].select("run_id", "unsafe_accepted", "hazards_1b", "balises_found", "lost_to_share")
    assert runs.rows() == [("blind", None, None, 7, [0.6, 0.4]), ("seen", 0, 1, 8, None)]
