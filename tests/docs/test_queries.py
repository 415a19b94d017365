"""The queries of the analyst's page: SQL and polars give the same rows, and so does DuckDB."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline.results import views
from pipeline.results.query import run_sql
from tests.docs.blocks import ROOT, Block, blocks

PAGE = blocks(ROOT / "docs" / "analyst.md")
PREAMBLE = next(block.text for block in PAGE if block.language == "python")
VIEW_OF_FILES = next(block.text for block in PAGE if block.text.startswith("CREATE VIEW"))
PAIRS = [
    (sql, python) for sql, python in itertools.pairwise(PAGE) if (sql.language, python.language) == ("sql", "python")
]


Answers = Callable[[str], pl.DataFrame]


@pytest.fixture(scope="module")
def told(asked: Path) -> Answers:
    """What the program answers to SQL; asked once."""
    return cache(lambda sql: run_sql(asked / "OUT", sql))


@pytest.fixture(scope="module")
def duck(asked: Path) -> Iterator[Any]:
    """A connection of DuckDB that has the files as views, as the page makes them."""
    duckdb = pytest.importorskip("duckdb", reason="DuckDB is not installed")
    with duckdb.connect() as connection, contextlib.chdir(asked):
        for name in ("hazards", "passages", "alarms", "epochs", "runs"):
            connection.execute(VIEW_OF_FILES.replace("hazards", name))
        connection.execute("CREATE VIEW campaign_runs AS SELECT * FROM 'OUT/campaign/runs.parquet'")
        yield connection


def test_there_are_twenty_and_the_verdict() -> None:
    assert len(PAIRS) == 21
    assert len([block for block in PAGE if block.language == "sql"]) == 21
    assert len({sql.heading for sql, _ in PAIRS}) == 21


@pytest.mark.parametrize(("sql", "python"), PAIRS, ids=lambda block: block.heading[:40])
def test_sql_and_polars_agree(
    sql: Block, python: Block, asked: Path, told: Answers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(asked)
    names: dict[str, Any] = {}
    exec(PREAMBLE + python.text, names)
    answer = names["answer"].collect()
    assert answer.columns == told(sql.text).columns
    assert_same_rows(answer, told(sql.text))


@pytest.mark.parametrize("sql", [sql for sql, _ in PAIRS], ids=lambda block: block.heading[:40])
def test_duckdb_gives_the_same(
    sql: Block, asked: Path, told: Answers, duck: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(asked)
    found = pl.DataFrame(duck.sql(sql.text).to_arrow_table())
    assert told(sql.text).columns == found.columns
    assert_same_rows(found, told(sql.text))


VIEWS = [view for view in views.views().values() if not view.needs]


def test_duckdb_answers_the_views_alike(asked: Path, told: Answers, duck: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(asked)
    for view in VIEWS:
        duck.execute(f"CREATE VIEW {view.name} AS {view.sql}")
        found = pl.DataFrame(duck.sql(f"SELECT * FROM {view.name}").to_arrow_table())
        answer = told(f"SELECT * FROM {view.name}")
        assert answer.height > 0, view.name
        assert answer.columns == found.columns
        of_runs = [name for name in answer.columns if name == "run_ids"]
        assert_same_rows(*(frame.with_columns(pl.col(of_runs).list.sort()) for frame in (found, answer)))


def test_by_epochs_and_by_runs_availability_is_the_same(asked: Path) -> None:
    by_epochs = (
        "SELECT run_id, solution, 1 - SUM(lost_s) / SUM(moving_s) AS share FROM stretches GROUP BY run_id, solution"
    )
    of_runs = "SELECT run_id, solution, availability FROM runs WHERE availability IS NOT NULL"
    shares, told = (
        {(run, solution): share for run, solution, share in run_sql(asked / "OUT", sql).rows()}
        for sql in (by_epochs, of_runs)
    )
    assert len(told) > 5
    assert {run: shares[run] for run in told} == pytest.approx(told)


def test_there_are_ten_questions_on_views() -> None:
    asked_of_views = [
        block.text for block in PAGE if block.heading.startswith("Ten questions") and "balise sql" in block.text
    ]
    lines = [line for text in asked_of_views for line in text.splitlines() if "balise sql" in line]
    assert len(lines) == 10
    assert all(any(views.may_name(line, name) for name in views.views()) for line in lines)


def test_hardly_a_query_is_empty(told: Answers) -> None:
    empty = {sql.heading.split(".")[0] for sql, _ in PAIRS if told(sql.text).is_empty()}
    assert empty == set()


def assert_same_rows(one: pl.DataFrame, other: pl.DataFrame) -> None:
    assert_same_values(one.rows(), other.rows())


def assert_same_values(one: list[tuple[Any, ...]], other: list[tuple[Any, ...]]) -> None:
    assert len(one) == len(other)
    for left, right in zip(sorted(one, key=in_order), sorted(other, key=in_order), strict=True):
        for a, b in zip(left, right, strict=True):
            assert same(a, b), (left, right)


def in_order(row: tuple[Any, ...]) -> str:
    return repr([round(value, 6) if isinstance(value, float) else plain(value) for value in row])


def plain(value: Any) -> Any:
    # DuckDB gives times in the zone of the machine.
    return value.timestamp() if hasattr(value, "timestamp") else value


def same(a: Any, b: Any) -> bool:
    if isinstance(a, float) or isinstance(b, float):
        return a is not None and b is not None and math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9)
    return bool(plain(a) == plain(b))
