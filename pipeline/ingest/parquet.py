"""A run as a folder of Parquet files, one per stream."""

from __future__ import annotations

import hashlib
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.ingest.breaches import Breach, refuse
from pipeline.ingest.conform import conform, extra_columns
from pipeline.storage import files
from pipeline.storage.address import Address, join, stem_of
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, IngestNotes, RunLog, Stream


def read_folder(path: Address, with_digest: bool = True) -> RunLog:
    """A folder `RUN/` of `gnss.parquet`, `odometer.parquet`, ...; every breach of every file in one error."""
    present = set(files.list_dir(path))
    breaches: list[Breach] = []
    if "gnss.parquet" not in present:
        breaches.append(_no_gnss(path, present))
    digest = hashlib.sha256()
    frames: dict[str, pl.DataFrame] = {}
    skipped: list[str] = []
    for stream in STREAMS:
        if f"{stream}.parquet" not in present:
            continue
        file = join(path, f"{stream}.parquet")
        content = files.read_bytes(file)
        if with_digest:
            digest.update(f"{stream}:{len(content)}:".encode())
            digest.update(content)
        recorded = _read(content, stream, str(file), breaches)
        if recorded is not None:
            frames[stream] = conform(recorded, stream, str(file), breaches)
            skipped += [f"{stream}.parquet: column {name}" for name in extra_columns(recorded, stream)]
    refuse(breaches)
    skipped += sorted(present - {f"{stream}.parquet" for stream in STREAMS})
    return RunLog(
        run_id=stem_of(path),
        notes=IngestNotes(skipped_topics=tuple(skipped)),
        input_digest=digest.hexdigest() if with_digest else "",
        **frames,
    )


def _no_gnss(path: Address, present: set[str]) -> Breach:
    return Breach(
        str(path),
        "holds no GNSS stream",
        found=", ".join(sorted(present)[:10]) or "an empty folder",
        expected="gnss.parquet",
        remedy="Give a run folder or an MCAP file; `balise convert` makes runs of receiver logs.",
    )


def _read(content: bytes, stream: Stream, place: str, breaches: list[Breach]) -> pl.DataFrame | None:
    if not content:
        breaches.append(Breach(place, "is empty", found="0 bytes", expected="a Parquet file"))
        return None
    try:
        return _frame(pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True), stream)
    except (pa.ArrowException, pl.exceptions.PolarsError, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        breaches.append(Breach(place, f"cannot be read as Parquet ({reason})", remedy="Record or copy the file again."))
        return None


def _frame(file: Any, stream: Stream) -> pl.DataFrame:
    """Row group by row group; of columns outside the contract only the names are kept."""
    names = list(file.schema_arrow.names)
    if len(set(names)) != len(names):
        raise ValueError("a column name stands twice")
    known = [name for name in names if name in STREAM_SCHEMAS[stream].columns()]
    groups = [
        pl.DataFrame(pl.from_arrow(file.read_row_group(index, columns=known))) for index in range(file.num_row_groups)
    ]
    # Not `empty_table()`: through it pyarrow imports pandas, where that is installed, in every process.
    empty = pl.DataFrame(pl.from_arrow(pa.Table.from_batches([], file.schema_arrow)))
    frame = pl.concat([empty.select(known), *groups], rechunk=True)
    others = [pl.lit(None).alias(name) for name in names if name not in known]
    return frame.with_columns(others)
