"""SQL over the tables of a campaign.

Polars answers, not DuckDB: it is there already, and over the small files of ten thousand runs it is
the quicker of the two (1.0 s against 1.8 s for a count of hazards by class, two cores). The files
are plain Hive-partitioned Parquet, so DuckDB reads them from outside all the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.results import catalogue, store
from pipeline.results.source import source_of
from pipeline.storage import parquet
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
        return pl.SQLContext(tables).execute(sql).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, RecursionError) as error:
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
    return store.scan_runs(out, table, runs)


def _campaign_tables(out: Address, names: Iterable[str]) -> dict[str, pl.LazyFrame]:
    """`campaign/runs.parquet` as `campaign_runs`, and so on; those that are not there are left out."""
    addresses = {name: join(join(out, "campaign"), f"{name.removeprefix('campaign_')}.parquet") for name in names}
    contents: Mapping[str, bytes | Path]
    if is_url(out):
        contents = storage.read_many([str(address) for address in addresses.values()])
    else:
        contents = {str(address): Path(address) for address in addresses.values() if Path(address).exists()}
    there = {name: str(address) for name, address in addresses.items() if str(address) in contents}
    return {name: _campaign_table(name, contents[place]) for name, place in there.items()}


def _campaign_table(name: str, source: bytes | Path) -> pl.LazyFrame:
    try:
        frame = parquet.read_parquet(source)
    except parquet.ParquetError as error:
        remedy = "`balise replay` with the same --out writes it again."
        raise UsageError(f"cannot be read: {error}", place=f"table `{name}`", remedy=remedy) from None
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
