"""Python and SQL blocks of the documentation do what they are there for."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pytest

from schemas.tables import TABLES
from tests.docs.blocks import PAGES, ROOT, Block, blocks


def language(block: Block) -> str:
    """What an indented block holds, by how it begins."""
    begins = {"import ": "python", "from ": "python", "SELECT": "sql"}
    found = (name for start, name in begins.items() if block.text.startswith(start))
    return block.language or next(found, "")


def chosen(wanted: str) -> list[Block]:
    # The analyst's queries have tests of their own.
    found = [block for page in PAGES for block in blocks(page) if page.name != "analyst.md"]
    return [block for block in found if language(block) == wanted]


def name(block: Block) -> str:
    return f"{block.page}:{block.line}"


@pytest.mark.parametrize("block", chosen("python"), ids=name)
def test_python_runs(block: Block, workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workspace)
    names: dict[str, Any] = {}
    exec(compile(block.text, name(block), "exec"), names)
    assert names


@pytest.mark.parametrize("block", chosen("sql"), ids=name)
def test_sql_outside_runs_in_duckdb(block: Block, workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    duckdb = pytest.importorskip("duckdb", reason="DuckDB is not installed")
    monkeypatch.chdir(workspace)
    with duckdb.connect() as connection:
        assert connection.execute(block.text).fetchall()


def test_run_ids_are_text(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers of hive partitions make a number of `007` and a date of `2025-06-13` unless they are told."""
    ids = {"007", "2025-06-13"}
    for table in TABLES:
        for run_id in ids:
            shutil.copytree(
                workspace / "OUT" / table / "run_id=jump_two", tmp_path / "OUT" / table / f"run_id={run_id}"
            )
    monkeypatch.chdir(tmp_path)
    python = [block for block in blocks(ROOT / "README.md") if "run_id" in block.text and language(block) == "python"]
    analyst = next(block for block in blocks(ROOT / "docs" / "analyst.md") if block.language == "python")
    for block in (*python, analyst):
        names: dict[str, Any] = {}
        exec(block.text, names)
        names.pop("campaign_runs", None)
        read = [run_ids(value) for value in names.values() if isinstance(value, pl.LazyFrame | pa.Table)]
        assert set().union(*read) == ids
    (sql,) = chosen("sql")
    with pytest.importorskip("duckdb").connect() as connection:
        assert {row[0] for row in connection.execute(sql.text).fetchall()} == ids


def run_ids(table: pl.LazyFrame | pa.Table) -> set[Any]:
    if isinstance(table, pa.Table):
        return set(table["run_id"].to_pylist())
    return set(table.select("run_id").collect()["run_id"]) if "run_id" in table.collect_schema() else set()


def test_there_are_such_blocks() -> None:
    assert {block.page for block in chosen("python")} >= {"README.md", "developer.md"}
    assert [block.page for block in chosen("sql")] == ["README.md"]
