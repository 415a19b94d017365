"""SQL over the tables of a campaign.

Polars answers, not DuckDB: it is there already, and over the small files of ten thousand runs it is
the quicker of the two (1.0 s against 1.8 s for a count of hazards by class, two cores). The files
are plain Hive-partitioned Parquet, so DuckDB reads them from outside all the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.results import catalogue, store
from pipeline.storage.address import Address, is_url, join
from schemas.campaign import CAMPAIGN_TABLES
from schemas.errors import UsageError
from schemas.tables import TABLES

# What may stand before the words that a query begins with, one piece at a time: in one expression it takes for ever.
_BEFORE = re.compile(r"\s+|\(|--[^\n]*|/\*.*?\*/", re.DOTALL)
_QUERY = re.compile(r"(select|with|explain|from|values)\b", re.IGNORECASE)
# Functions of polars' SQL that open files; looked for in texts and comments, too, so that no quoting hides them.
_FILES = re.compile(r"\bread_(csv|parquet|ipc|json|ndjson)\b", re.IGNORECASE)

_EXPECTED = "a SELECT over " + ", ".join([*TABLES, *CAMPAIGN_TABLES])
_REMEDY = "`balise dictionary` lists the columns of each table."


def run_sql(out: Address, sql: str, allow_files: bool = False) -> pl.DataFrame:
    """The answer to one SELECT over the complete runs of a result.

    Tables: `hazards`, `passages`, `alarms`, `epochs`, `runs`, each with `run_id`, and those of the
    campaign where they are written. A condition on `run_id` reads the files of these runs only.
    `allow_files`: the query may also read other files of this machine (`read_csv` and its like).
    """
    _check_query(sql, allow_files)
    tables = _tables(out, sql)
    try:
        with catalogue.patient():
            return pl.SQLContext(tables).execute(sql).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, RecursionError) as error:
        if not is_url(out):
            store.check_tables(out, [name for name in TABLES if name in tables])
        raise UsageError(
            f"cannot be answered: {_first_line(error)}",
            place="SQL",
            expected=_EXPECTED,
            remedy=_REMEDY,
        ) from None


def _check_query(sql: str, allow_files: bool) -> None:
    begin = 0
    while before := _BEFORE.match(sql, begin):
        begin = before.end()
    if not _QUERY.match(sql, begin):
        raise UsageError(
            "is no query",
            place="SQL",
            found=sql.strip()[:80] or "nothing",
            expected=f"{_EXPECTED} (WITH ... SELECT, EXPLAIN SELECT); results are only read",
            remedy=_REMEDY,
        )
    if not allow_files and (found := _FILES.search(sql)):
        raise UsageError(
            "reads files beside the result",
            place="SQL",
            found=found[0],
            expected=_EXPECTED,
            remedy="`--allow-files` lets a query that you trust read files of this machine.",
        )


def _tables(out: Address, sql: str) -> dict[str, pl.LazyFrame]:
    """What the query may name: ten thousand addresses take their time, remote tables their transfer."""
    runs = store.complete_runs(out)

    def named(names: Iterable[str]) -> list[str]:
        return [name for name in names if re.search(rf"\b{name}\b", sql, re.IGNORECASE)]

    return {name: _scan(out, name, runs) for name in named(TABLES)} | _campaign_tables(out, named(CAMPAIGN_TABLES))


def _scan(out: Address, table: str, runs: list[str]) -> pl.LazyFrame:
    kept = catalogue.fresh(out, table)
    if kept is not None:
        return kept
    return store.read_table(out, table) if is_url(out) else catalogue.scan(out, table, runs)


def _campaign_tables(out: Address, names: Iterable[str]) -> dict[str, pl.LazyFrame]:
    """`campaign/runs.parquet` as `campaign_runs`, and so on; those that are not there are left out."""
    addresses = {name: join(join(out, "campaign"), f"{name.removeprefix('campaign_')}.parquet") for name in names}
    if not is_url(out):
        found = {name: Path(address) for name, address in addresses.items() if Path(address).exists()}
        return {name: pl.scan_parquet(file, glob=False) for name, file in found.items()}
    contents = storage.read_many([str(address) for address in addresses.values()])
    there = {name: contents.get(str(address)) for name, address in addresses.items()}
    return {name: pl.read_parquet(content).lazy() for name, content in there.items() if content is not None}


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
