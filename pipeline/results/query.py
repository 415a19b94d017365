"""SQL over the tables of a campaign.

Polars answers, not DuckDB: it is there already, and over the small files of ten thousand runs it is
the quicker of the two (1.0 s against 1.8 s for a count of hazards by class, two cores). The files
are plain Hive-partitioned Parquet, so DuckDB reads them from outside all the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import partial

import dataframely as dy
import polars as pl

from pipeline import storage
from pipeline.results import packs, store, views
from pipeline.results.source import source_of
from pipeline.storage import parquet
from pipeline.storage.address import Address, join
from schemas.campaign import CAMPAIGN_TABLES
from schemas.dictionary import dictionary_frame
from schemas.errors import UsageError
from schemas.near import nearest
from schemas.tables import TABLES

# What may stand before the words that a query begins with, one piece at a time: in one expression it takes for ever.
_BEFORE = re.compile(r"\s+|\(|--[^\n]*|/\*.*?\*/", re.DOTALL)
_QUERY = re.compile(r"(select|with|explain|from|values)\b", re.IGNORECASE)
# Functions of polars' SQL that open files; looked for in texts and comments, too, so that no quoting hides them.
_FILES = re.compile(r"\bread_(csv|parquet|ipc|json|ndjson)\b", re.IGNORECASE)

_SHOW = re.compile(r"\s*show\s+tables\s*;?\s*", re.IGNORECASE)
_DESCRIBE = re.compile(r"\s*(?:describe|desc)\s+(?:table\s+)?[\"`]?(\w+)[\"`]?\s*;?\s*", re.IGNORECASE)
_NAMED = re.compile(r"[A-Za-z]\w*=.+")

_NO_COLUMN = re.compile(r"(?:unable to find column|no column named) [\"'](\w+)[\"']")
_NO_TABLE = re.compile(r"relation '(\w+)' was not found")

_KNOWN = (*TABLES, *CAMPAIGN_TABLES)
_EXPECTED = "a SELECT over " + ", ".join(_KNOWN)
_REMEDY = "SHOW TABLES and DESCRIBE table list what there is."


def run_sql(
    out: Address, sql: str, allow_files: bool = False, others: Mapping[str, Address] | None = None
) -> pl.DataFrame:
    """The answer to one SELECT, SHOW TABLES or DESCRIBE over the complete runs of a result.

    Tables: `hazards`, `passages`, `alarms`, `epochs`, `runs`, each with `run_id`, those of the campaign where they are
    written, and the views of `views.toml`. A condition on `run_id` reads the files of these runs only.
    `others`: more results by name; `{"old": OUT}` adds the tables `old_runs`, `old_hazards` and so on.
    `allow_files`: the query may also read other files of this machine (`read_csv` and its like).
    """
    return packs.read_twice_if_moved(partial(_answer, out, sql, allow_files, others or {}))


def _answer(out: Address, sql: str, allow_files: bool, others: Mapping[str, Address]) -> pl.DataFrame:
    """The answer to a query."""
    if _SHOW.fullmatch(sql):
        return _list_tables(others)
    if described := _DESCRIBE.fullmatch(sql):
        return _columns_of(described[1], others)
    _check_query(sql, allow_files)
    asked = [view for view in views.views_in_query(sql) if not view.needs or view.needs in others]
    # What a view asks is asked too.
    whole = "\n".join([sql, *(view.sql for view in asked)])
    tables = _tables(out, whole)
    try:
        for name, address in others.items():
            tables |= _tables_of_other(address, whole, f"{name}_")
        frames = tables | views.answer_views(asked, tables)
        return pl.SQLContext(frames).execute(sql).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, RecursionError) as error:
        message = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise _query_error(message, tables, others) from None


def _tables_of_other(out: Address, sql: str, prefix: str) -> dict[str, pl.LazyFrame]:
    """The tables and views of a second result that a query names, under its name."""
    asked = views.views_in_query(sql, prefix)
    own = "\n".join(
        [*(name for name in _KNOWN if views.may_name(sql, f"{prefix}{name}")), *(view.sql for view in asked)]
    )
    tables = _tables(out, own)
    return {f"{prefix}{name}": frame for name, frame in (tables | views.answer_views(asked, tables)).items()}


def _query_error(message: str, tables: Mapping[str, pl.LazyFrame], others: Iterable[str]) -> UsageError:
    """Why a query has no answer; of a name that does not exist the three nearest."""
    if unknown := _NO_COLUMN.search(message):
        known = {name for frame in tables.values() for name in frame.collect_schema().names()}
        kind = "column"
    elif unknown := _NO_TABLE.search(message):
        view = views.views().get(unknown[1].lower())
        if view is not None and view.needs:
            remedy = f"`--with {view.needs}=OUT_OLD` names the other one."
            return UsageError("compares two results", place=f"view `{view.name}`", remedy=remedy)
        known = {*_contracts_by_table(others), *views.views()}
        kind = "table"
    else:
        return UsageError(f"cannot be answered: {message}", place="SQL", expected=_EXPECTED, remedy=_REMEDY)
    near = " or ".join(f"`{name}`" for name in nearest(unknown[1], known))
    text = f"there is no {kind} {unknown[1]} (did you mean {near}?)"
    return UsageError(text, place="SQL", expected=_EXPECTED, remedy=_REMEDY)


def named_results(given: Iterable[str]) -> dict[str, str]:
    """`NAME=OUT` by name, for `others`. Raises `UsageError`."""
    named = list(given)
    for text in named:
        if not _NAMED.fullmatch(text):
            raise UsageError("names no result", place=f"--with {text}", expected="NAME=OUT, for example old=OUT_OLD")
    return dict(text.split("=", 1) for text in named)


def _check_query(sql: str, allow_files: bool) -> None:
    """Refuse a query that does more than read tables."""
    begin = 0
    while before := _BEFORE.match(sql, begin):
        begin = before.end()
    if not _QUERY.match(sql, begin):
        raise UsageError(
            "is not a query",
            place="SQL",
            found=sql.strip()[:80] or "nothing",
            expected=f"{_EXPECTED} (WITH ... SELECT, EXPLAIN SELECT); results are only read",
            remedy=_REMEDY,
        )
    if not allow_files and (call := _FILES.search(sql)):
        raise UsageError(
            "reads files outside the result",
            place="SQL",
            found=call[0],
            expected=_EXPECTED,
            remedy="If you trust the query, `--allow-files` lets it read files of this machine.",
        )


def _tables(out: Address, sql: str) -> dict[str, pl.LazyFrame]:
    """What the query may name: ten thousand addresses take their time, remote tables their transfer."""
    store.complete_runs(out)

    def named(known: Iterable[str]) -> list[str]:
        """Tables among these that the query names."""
        return [name for name in known if views.may_name(sql, name)]

    own = {name: store.read_table(out, name) for name in named(TABLES)}
    return own | _campaign_tables(out, named(CAMPAIGN_TABLES))


def _contracts_by_table(others: Iterable[str]) -> dict[str, tuple[str, type[dy.Schema]]]:
    """Every table that a query may name: the name in the dictionary, and its contract."""
    tables = {**TABLES, **CAMPAIGN_TABLES}
    return {
        f"{prefix}{name}": (name, kind) for prefix in ("", *(f"{o}_" for o in others)) for name, kind in tables.items()
    }


def _list_tables(others: Iterable[str]) -> pl.DataFrame:
    """All tables, with their meaning."""
    rows = [
        (name, len(kind.columns()), " ".join((kind.__doc__ or "").split()))
        for name, (_, kind) in _contracts_by_table(others).items()
    ]
    rows += [(view.name, len(view.columns), view.meaning) for view in views.views().values()]
    return pl.DataFrame(rows, schema={"table": pl.String, "columns": pl.Int64, "meaning": pl.String}, orient="row")


def _columns_of(table: str, others: Iterable[str]) -> pl.DataFrame:
    """Columns of a table, with units and meanings."""
    if (view := views.views().get(table.lower())) is not None:
        return pl.DataFrame(view.columns, schema=["column", "unit", "meaning"], orient="row")
    known = _contracts_by_table(others)
    contract = known.get(table.lower())
    if contract is None:
        near = " or ".join(f"`{name}`" for name in nearest(table, [*known, *views.views()]))
        raise UsageError(f"is not a table (did you mean {near}?)", place=table, expected=_EXPECTED, remedy=_REMEDY)
    columns = dictionary_frame(contract[0]).drop("group", "table")
    if contract[0] not in TABLES:
        return columns
    run_id = {"column": "run_id", "dtype": "String", "unit": "", "nullable": False, "meaning": "id of the run"}
    return pl.concat([pl.DataFrame([run_id], schema=columns.schema), columns])


def _campaign_tables(out: Address, names: Iterable[str]) -> dict[str, pl.LazyFrame]:
    """`campaign/runs.parquet` as `campaign_runs`, and so on; those that are not there are left out."""
    folder = join(out, "campaign")
    places = {name: str(join(folder, f"{name.removeprefix('campaign_')}.parquet")) for name in names}
    contents = storage.read_many(list(places.values()))
    return {name: _campaign_table(name, contents[place]) for name, place in places.items() if place in contents}


def _campaign_table(name: str, source: bytes) -> pl.LazyFrame:
    """A table of a campaign."""
    try:
        frame = parquet.read_parquet(source)
    except parquet.ParquetError as error:
        remedy = "`balise replay` with the same --out writes it again."
        raise UsageError(f"cannot be read: {error}", place=f"table `{name}`", remedy=remedy) from None
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))
