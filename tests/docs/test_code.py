"""Python and SQL blocks of the documentation do what they are there for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.docs.blocks import PAGES, Block, blocks


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


def test_there_are_such_blocks() -> None:
    assert {block.page for block in chosen("python")} >= {"README.md", "developer.md"}
    assert [block.page for block in chosen("sql")] == ["README.md"]
