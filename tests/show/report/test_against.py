"""Two results side by side: what the page says, against tables of which the difference is known."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

from pipeline.results.store import write_run
from pipeline.show.report import write_against, write_report
from schemas.errors import UsageError
from schemas.run import RunTables
from schemas.tables import Runs
from tests.tables import alarms, epochs, hazards, passages, table


def tables(run_id: str, *, lost_s: float, status: str, verdict: str, **columns: object) -> RunTables:
    """Ten seconds of which `lost_s` had no TVB, all at one place, and one passage of one balise."""
    of_run = {"solution": "primary", "status": "ok", "verdict": verdict, "moving_s": 10.0, "software": "balise 1"}
    epoch_rows = epochs(
        [float(k) for k in range(10)],
        solution="primary",
        step_s=1.0,
        moving_s=1.0,
        lost_s=[1.0 if k < lost_s else 0.0 for k in range(10)],
        netelement_id="E1",
        measure_m=700.0,
    )
    run = table(Runs, 1, **of_run, availability=1.0 - lost_s / 10.0, **columns)
    passage_rows = passages(1, solution="primary", balise_id="VB1", kind="virtual", status=status)
    return RunTables(run_id, hazards(), passage_rows, alarms(), epoch_rows, run)


class Rows(HTMLParser):
    """The cells of each table, by its id."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self._rows: list[list[str]] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self._rows = self.tables.setdefault(dict(attrs).get("id") or "", [])
        if tag == "tr":
            self._rows.append([])
        if tag == "td":
            self._rows[-1].append("")
            self._inside = True

    def handle_endtag(self, tag: str) -> None:
        self._inside = self._inside and tag != "td"

    def handle_data(self, data: str) -> None:
        if self._inside:
            self._rows[-1][-1] += data


def rows(page: Path) -> dict[str, list[list[str]]]:
    parser = Rows()
    parser.feed(page.read_text(encoding="utf-8"))
    return {name: [row for row in found if row] for name, found in parser.tables.items()}


@pytest.fixture
def results(tmp_path: Path) -> tuple[Path, Path]:
    """Run `a` became unsafe and lost 4 s less, `b` stayed, `c` and `d` stand in one result only."""
    new, old = tmp_path / "new", tmp_path / "old"
    same = {"lost_s": 0.0, "status": "accepted", "verdict": "safe", "time_to_detect_max_s": 1.0}
    for out, which in ((new, "c"), (old, "d")):
        write_run(tables("b", **same), out, {})
        write_run(tables(which, **same), out, {})
    write_run(tables("a", lost_s=5.0, status="missed", verdict="safe", faults=1, evidence="reference"), old, {})
    write_run(tables("a", lost_s=1.0, status="accepted", verdict="unsafe", faults=1, evidence="reference"), new, {})
    return new, old


def test_what_changed_stands_on_the_page(results: tuple[Path, Path]) -> None:
    new, old = results
    page = write_against(new, str(old))
    found = rows(page)
    assert sorted((was, now, runs) for was, now, runs, _ in found["table-verdicts"]) == [
        ("safe", "safe", "1"),
        ("safe", "unsafe", "1"),
    ]
    figures = {row[0]: row[1:] for row in found["table-figures"]}
    # 15 of 20 s, and 19 of 20 s.
    assert figures["availability"] == ["75.0%", "95.0%", "20.0%"]
    (changed,) = found["table-changed"]
    assert changed[:4] == ["a", "primary", "safe → unsafe", "50.0% → 90.0%"]
    (place,) = found["table-places"]
    assert place == ["E1", "500", "20", "0.75", "0.95", "0.2"]
    assert found["table-balises"] == [["VB1", "accepted", "1", "2"], ["VB1", "not found", "1", "0"]]
    text = page.read_text(encoding="utf-8")
    assert text.index("unsafe") < text.index("Two results side by side"), "the verdict is the first word"
    assert "1 run, 1 run: left out" in text


def test_a_result_beside_itself_shows_no_change(results: tuple[Path, Path]) -> None:
    new, _ = results
    found = rows(write_against(new, str(new)))
    assert "table-changed" not in found
    assert "table-balises" not in found
    assert {row[3] for row in found["table-figures"]} <= {"0", "0.0%", "not known"}


def test_the_next_report_leaves_no_stale_comparison(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    write_run(replayed["jump_two"], tmp_path, {})
    page = write_against(tmp_path, str(tmp_path))
    write_report(tmp_path)
    assert not page.exists()


def test_results_without_a_common_run_are_refused(results: tuple[Path, Path], tmp_path: Path) -> None:
    alone = tables("z", lost_s=0.0, status="accepted", verdict="safe")
    write_run(alone, tmp_path / "other", {})
    with pytest.raises(UsageError, match="shares no run"):
        write_against(results[0], str(tmp_path / "other"))
