"""SQL over a result on disk."""

import shutil
from pathlib import Path

import polars as pl
import pytest

from pipeline.results.answer_files import write_answer
from pipeline.results.query import run_sql
from pipeline.results.store import table_address, write_run
from schemas.errors import UsageError
from schemas.run import RunTables
from schemas.tables import Runs
from tests.tables import NS, alarms, epochs, hazards, passages, table

KINDS = ["VB_JUMP_1A", "VB_SHIFT", "VB_SHIFT"]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    for k, run_id in enumerate(["a", "b c", "d=e"]):
        found = hazards(3 - k, hazard=KINDS[: 3 - k], size_m=[10.0 * j for j in range(3 - k)], solution="primary")
        offered = passages(1, solution="primary", balise_id="VB1", t_offered=[k * NS])
        catalogue = table(Runs, 1, solution="primary", status="ok", duration_s=100.0 * k)
        write_run(
            RunTables(run_id, found, offered, alarms(), epochs([0, 1], solution="primary"), catalogue), folder, {}
        )
    return folder


def test_hazards_by_class(out: Path) -> None:
    found = run_sql(out, "SELECT hazard, COUNT(*) AS n FROM hazards GROUP BY hazard ORDER BY hazard")
    assert found.rows() == [("VB_JUMP_1A", 3), ("VB_SHIFT", 3)]


def test_join_of_tables(out: Path) -> None:
    found = run_sql(
        out,
        "SELECT r.run_id, r.duration_s, COUNT(*) AS n FROM runs r JOIN hazards h ON r.run_id = h.run_id"
        " AND r.solution = h.solution GROUP BY r.run_id, r.duration_s ORDER BY r.run_id",
    )
    assert found.rows() == [("a", 0.0, 3), ("b c", 100.0, 2), ("d=e", 200.0, 1)]


def test_run_ids_come_back_as_they_were(out: Path) -> None:
    assert run_sql(out, "SELECT run_id FROM runs ORDER BY run_id")["run_id"].to_list() == ["a", "b c", "d=e"]
    assert run_sql(out, "SELECT run_id FROM runs WHERE run_id = 'd=e'").height == 1


def test_a_condition_on_the_run_reads_no_other(out: Path, tmp_path: Path) -> None:
    """The other runs' files are broken: only pruning answers."""
    for name in ("hazards", "runs"):
        for run in ("a", "d=e"):
            target = Path(table_address(tmp_path, name, run))
            target.parent.mkdir(parents=True)
            target.write_bytes(Path(table_address(out, name, run)).read_bytes() if run == "a" else b"broken")
    assert run_sql(tmp_path, "SELECT * FROM hazards WHERE run_id = 'a'").height == 3
    with pytest.raises(UsageError, match="run d=e, table `hazards`: cannot be read"):
        run_sql(tmp_path, "SELECT * FROM hazards")


def test_a_run_without_its_marker_does_not_count(out: Path, tmp_path: Path) -> None:
    for name, run in (("hazards", "a"), ("runs", "a"), ("hazards", "d=e")):
        target = Path(table_address(tmp_path, name, run))
        target.parent.mkdir(parents=True)
        target.write_bytes(Path(table_address(out, name, run)).read_bytes())
    assert run_sql(tmp_path, "SELECT DISTINCT run_id FROM hazards").rows() == [("a",)]


def test_campaign_tables(out: Path) -> None:
    folder = out / "campaign"
    folder.mkdir(exist_ok=True)
    pl.DataFrame({"balise_id": ["VB1"], "passages": [7]}).write_parquet(folder / "balises.parquet")
    assert run_sql(out, "SELECT passages FROM campaign_balises").item() == 7


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("SELECT speed FROM hazards", "speed"),
        ("SELECT * FROM nothing", "nothing"),
        ("SELEKT * FROM hazards", "SELEKT"),
        ("SELECT * FROM hazards WHERE hazard = 'VB_SLIP'", "VB_SLIP"),
    ],
)
def test_what_cannot_be_answered_says_what_can(out: Path, sql: str, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        run_sql(out, sql)
    assert said in str(caught.value)
    assert "expected a SELECT over hazards, passages, alarms, epochs, runs" in str(caught.value)


def test_tables_and_columns_are_listed(out: Path) -> None:
    tables = run_sql(out, "show tables;")
    assert {"hazards", "epochs", "campaign_figures"} <= set(tables["table"])
    columns = run_sql(out, "DESCRIBE alarms")
    assert columns.filter(pl.col("column") == "peak_ratio").select("unit", "nullable").rows() == [("1", True)]
    assert columns["column"][0] == "run_id"
    assert run_sql(out, "describe old_runs", others={"old": out}).height == len(Runs.columns()) + 1
    with pytest.raises(UsageError, match=r"is not a table \(did you mean `alarms`"):
        run_sql(out, "DESCRIBE alarm")


def test_not_a_result(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("no folder\n")
    for named in (tmp_path, file, tmp_path / "nowhere"):
        with pytest.raises(UsageError, match="holds no complete run"):
            run_sql(named, "SELECT 1")


def test_a_result_of_another_build_is_named(out: Path, tmp_path: Path) -> None:
    shutil.copytree(out, tmp_path / "old")
    file = next((tmp_path / "old/passages").rglob("*.parquet"))
    pl.read_parquet(file).drop("speed_mps").write_parquet(file)
    with pytest.raises(UsageError, match=r"table `passages`: .* another build .* found speed_mps missing or"):
        run_sql(tmp_path / "old", "SELECT max(speed_mps) FROM passages")


def test_texts_that_a_spreadsheet_would_run_are_guarded(tmp_path: Path) -> None:
    answer = pl.DataFrame({"=A": ["=1+2", "@x", "-3", "+4", "\tx", "x=1", None], "number": [-1.5] * 7})
    write_answer(answer, tmp_path / "a.csv", None, None)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines == ["'=A,number", "'=1+2,-1.5", "'@x,-1.5", "'-3,-1.5", "'+4,-1.5", "'\tx,-1.5", "x=1,-1.5", ",-1.5"]
    write_answer(answer, tmp_path / "a.csv", None, None, guard=False)
    assert (tmp_path / "a.csv").read_text().splitlines()[:2] == ["=A,number", "=1+2,-1.5"]
