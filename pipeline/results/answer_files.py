"""The answer to a query as a file that other programs read: CSV, Parquet, Excel."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import polars as pl

from pipeline.storage import write_bytes
from pipeline.storage.described import noted_bytes
from schemas.errors import UsageError
from schemas.version import SOFTWARE

# Excel has no nanoseconds and no time zones, and a sheet ends here.
_MOST_ROWS = 1_048_575
_TIMES = "yyyy-mm-dd hh:mm:ss.000"

Writer = Callable[[pl.DataFrame, Path], None]


def write_answer(
    answer: pl.DataFrame,
    csv: Path | None,
    parquet: Path | None,
    xlsx: Path | None,
    by_suffix: Path | None = None,
    guard: bool = True,
) -> list[Path]:
    """Write the formats that are asked for; returns the files, without standard output. `guard`: see `write_csv`."""
    as_csv = partial(write_csv, guard=guard)
    formats: dict[Path | None, Writer] = {csv: as_csv, parquet: write_parquet, xlsx: write_xlsx}
    if by_suffix is not None:
        formats[by_suffix] = as_csv if by_suffix.suffix.lower() == ".csv" else _writer_for(by_suffix)
    for file, write in formats.items():
        if file is not None:
            write(answer, file)
    return [file for file in formats if file is not None and str(file) != "-"]


def _writer_for(file: Path) -> Writer:
    """What writes a file of this suffix."""
    writers: dict[str, Writer] = {".csv": write_csv, ".parquet": write_parquet, ".xlsx": write_xlsx}
    if file.suffix.lower() not in writers:
        raise UsageError("has an unknown suffix", place=str(file), expected=" or ".join(writers))
    return writers[file.suffix.lower()]


def write_csv(answer: pl.DataFrame, file: Path, guard: bool = True) -> None:
    """Comma-separated text with a heading; lists as words with blanks between them. `-` is standard output.

    `guard`: texts that a spreadsheet would run get an apostrophe in front
    (https://owasp.org/www-community/attacks/CSV_Injection).
    """
    flat = _without_lists(answer)
    if guard:
        text_columns = pl.col(pl.String)
        runs = text_columns.str.contains(r"^[=+\-@\t\r]")
        flat = flat.with_columns(pl.when(runs).then("'" + text_columns).otherwise(text_columns).name.keep())
        flat.columns = [f"'{name}" if name[:1] in set("=+-@\t\r") else name for name in flat.columns]
    text = flat.write_csv(datetime_format="%Y-%m-%dT%H:%M:%S%.9fZ")
    if str(file) == "-":
        sys.stdout.write(text)
    else:
        write_bytes(file, text.encode())


def write_parquet(answer: pl.DataFrame, file: Path) -> None:
    """Write an answer of `balise sql` with its provenance."""
    write_bytes(file, noted_bytes(answer, {"table": "answer of `balise sql`", "software": SOFTWARE}))


def write_xlsx(answer: pl.DataFrame, file: Path) -> None:
    """One sheet of an Excel workbook; times are UTC. Raises `UsageError` where the library is not installed."""
    if answer.height > _MOST_ROWS:
        raise UsageError(
            "is too long for Excel", place=str(file), found=f"{answer.height} rows", expected=f"at most {_MOST_ROWS}"
        )
    times = [name for name, dtype in answer.schema.items() if isinstance(dtype, pl.Datetime)]
    plain = _without_lists(answer).with_columns(pl.col(times).dt.replace_time_zone(None).dt.cast_time_unit("ms"))
    buffer = io.BytesIO()
    try:
        plain.write_excel(buffer, dtype_formats={pl.Datetime: _TIMES}, freeze_panes=(1, 0), autofit=True)
    except ImportError:
        remedy = "Install the extra `excel` (`pip install balise[excel]`), or take --csv."
        raise UsageError("cannot be written without XlsxWriter", place=str(file), remedy=remedy) from None
    write_bytes(file, buffer.getvalue())


def _without_lists(answer: pl.DataFrame) -> pl.DataFrame:
    """The answer without lists, which neither format can hold."""
    lists = [name for name, dtype in answer.schema.items() if isinstance(dtype, pl.List)]
    return answer.with_columns(pl.col(name).cast(pl.List(pl.String)).list.join(" ") for name in lists)
