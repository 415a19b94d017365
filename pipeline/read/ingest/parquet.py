"""A run as a folder of Parquet files, one per stream."""

from __future__ import annotations

import hashlib

import polars as pl

from pipeline.read.ingest.conform import conform, refuse, refuse_too_many
from pipeline.read.ingest.correct import read_corrections, read_damage, read_raw_logs
from pipeline.read.ingest.wraps import whole_stream
from pipeline.storage import files
from pipeline.storage.address import Address, join, stem_of
from pipeline.storage.described import noted
from pipeline.storage.parquet import ColumnTypes, ParquetError, TableFile
from schemas.config import IngestConfig, StreamCorrection
from schemas.conform import dtypes
from schemas.errors import InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, IngestNotes, RunLog, Stream


def read_folder(path: Address, config: IngestConfig, with_digest: bool = True) -> RunLog:
    """A folder `RUN/` of `gnss.parquet`, `odometer.parquet`, ...; every breach of every file in one error."""
    present = set(files.list_dir(path))
    breaches: list[InputError] = []
    if "gnss.parquet" not in present:
        breaches.append(_no_gnss_error(path, present))
    digest = hashlib.sha256()
    frames: dict[str, pl.DataFrame] = {}
    skipped: list[str] = []
    unproved: list[str] = []
    held: list[StreamCorrection] = []
    damages: list[str] = []
    raw_logs: tuple[tuple[str, int, str], ...] = ()
    for stream in STREAMS:
        if f"{stream}.parquet" not in present:
            continue
        file = join(path, f"{stream}.parquet")
        content = files.read_bytes(file)
        if with_digest:
            digest.update(f"{stream}:{len(content)}:".encode())
            digest.update(content)
        stored = _stored(content, str(file), breaches)
        recorded = None if stored is None else _read_stream(stored, stream, str(file), config, breaches)
        if stored is not None and recorded is not None:
            frames[stream] = conform(recorded, stream, str(file), breaches)
            if stream == "odometer" and not breaches:
                frames[stream], wraps = whole_stream(frames[stream], config)
                skipped += [f"odometer.parquet: {said}" for said in wraps]
            said = noted(stored.notes)
            held += read_corrections(said, stream, str(file))
            raw_logs += read_raw_logs(said)
            damages += [*filter(None, [read_damage(said)]), *_missing_rows(stream, stored.rows, recorded)]
            unproved += [f"{stream}.parquet"] if stored.without_checksums else []
            skipped += [f"{stream}.parquet: column {name}" for name in recorded.columns if not _is_known(name, stream)]
    refuse(breaches)
    skipped += sorted(present - {f"{stream}.parquet" for stream in STREAMS})
    return RunLog(
        run_id=stem_of(path),
        notes=IngestNotes(
            damage="; ".join(damages) or None,
            skipped_topics=tuple(skipped),
            files_without_crc=tuple(unproved),
            corrections=tuple(held),
            raw_logs=raw_logs,
        ),
        input_digest=digest.hexdigest() if with_digest else "",
        gnss=frames["gnss"],
    ).with_streams(**frames)


def _missing_rows(stream: Stream, declared: int, recorded: pl.DataFrame) -> list[str]:
    """Rows that a file declares and does not hold."""
    return [f"{stream}.parquet holds {recorded.height} of {declared} rows that are declared"] * (
        recorded.height < declared
    )


def _no_gnss_error(path: Address, present: set[str]) -> InputError:
    """The error for a folder without positions."""
    return InputError(
        "holds no GNSS stream",
        place=str(path),
        found=", ".join(sorted(present)[:10]) or "an empty folder",
        expected="gnss.parquet",
        remedy="Give a run folder or an MCAP file; `balise convert` makes runs of receiver logs.",
    )


def _stored(content: bytes, place: str, breaches: list[InputError]) -> TableFile | None:
    """The file with its metadata; None after a breach."""
    if not content:
        breaches.append(InputError("is empty", place=place, found="0 bytes", expected="a Parquet file"))
        return None
    try:
        return TableFile(content)
    except ParquetError as error:
        breaches.append(_unreadable(error, place))
        return None


def _read_stream(
    stored: TableFile, stream: Stream, place: str, config: IngestConfig, breaches: list[InputError]
) -> pl.DataFrame | None:
    """The columns of the contract, and those beside it without their values; None after a breach."""
    others: list[str] = []

    def known_columns(types: ColumnTypes) -> list[str]:
        """Columns of the contract; names of the others are kept."""
        others.extend(name for name in types if not _is_known(name, stream))
        return [name for name in types if _is_known(name, stream)]

    try:
        refuse_too_many(stored.rows, place, config)
        frame = stored.frame(known_columns)
    except ParquetError as error:
        breaches.append(_unreadable(error, place))
        return None
    return frame.with_columns(pl.lit(None).alias(name) for name in others) if others else frame


def _unreadable(error: ParquetError, place: str) -> InputError:
    """The breach for a file that is no whole Parquet file."""
    return InputError(f"cannot be read as Parquet ({error})", place=place, remedy="Record or copy the file again.")


def _is_known(column: str, stream: Stream) -> bool:
    """Whether the contract knows the column; of others only the names are kept."""
    return column in dtypes(STREAM_SCHEMAS[stream])
