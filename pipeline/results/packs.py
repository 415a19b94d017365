"""Packs: the tables of many runs in one file each, as `balise compact` makes them of the files of single runs.

    OUT/compact/packs.json              the packs that count, in order
    OUT/compact/NAME.parquet            the index of a pack: a row per run, with its marker and its rows in each table
    OUT/hazards/compact/NAME.parquet    the rows of these runs, with `run_id` in front; so for each table

A pack never changes; its name follows from its runs. It counts when `packs.json` lists it, which is replaced in one
step. Of several packs with the same run the last one counts, and before any pack the run's own files (`store`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Literal, NamedTuple, Self, TypeVar

import numpy as np
import numpy.typing as npt
import polars as pl
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline import storage
from pipeline.results.marker import Marker, sha256
from pipeline.storage import files, parquet
from pipeline.storage.address import Address, join, redacted
from pipeline.storage.parquet import Span
from schemas.errors import UsageError
from schemas.tables import TABLES

T = TypeVar("T")

FOLDER = "compact"
LIST = f"{FOLDER}/packs.json"
INDEX = "index"
_OF_MARKER = ("sha256", "metadata")
INDEX_COLUMNS: dict[str, pl.DataType] = {
    "run_id": pl.String(),
    **dict.fromkeys(_OF_MARKER, pl.String()),
    **{f"{name}_rows": pl.Int64() for name in TABLES},
}


class Pack(BaseModel):
    """One pack as it is listed. `software_digest`: who made all its runs.

    `sha256`: of its index and of each table; `ends`: of the end of each table's file, so that whoever opens one sees at
    once that it is the one that was packed.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    name: str = Field(pattern=r"^[0-9a-f]+$")
    runs: int = Field(gt=0)
    bytes: int = Field(gt=0)
    software_digest: str
    sha256: dict[str, str]
    ends: dict[str, str]

    @model_validator(mode="after")
    def _of_all(self) -> Self:
        """A pack has a digest and an end for every table."""
        if self.sha256.keys() != {INDEX, *TABLES} or self.ends.keys() != set(TABLES):
            raise ValueError("not the digests of all files of a pack")
        return self


class _List(BaseModel):
    """The list of packs as it is written."""

    model_config = ConfigDict(extra="forbid", strict=True)

    compact: Literal[1]
    packs: list[Pack]


class PackedRun(NamedTuple):
    """Where a run is: its pack, and its row in the index."""

    pack: Pack
    row: int


class Index(NamedTuple):
    """The index of a pack without the metadata. `starts`: where each run begins in each table, and where all end."""

    run_ids: list[str]
    starts: Mapping[str, npt.NDArray[np.int64]]

    def spans(self, table: str, rows: Iterable[int]) -> list[Span]:
        """The rows of a table that these runs have."""
        starts = self.starts[table]
        return [(int(starts[row]), int(starts[row + 1])) for row in rows]


def read_list(out: Address) -> list[Pack]:
    """The packs of a result, in order; none where it has none. Raises `UsageError` for a list that cannot be read."""
    content = storage.content_of(join(out, LIST))
    return [] if content is None else _parse_list(str(out), content)


@lru_cache(maxsize=4)
def _parse_list(out: str, content: bytes) -> list[Pack]:
    """The packs of a list."""
    try:
        return _List.model_validate_json(content).packs
    except ValidationError as error:
        raise unusable_error(out, LIST, str(error.errors()[0]["msg"])) from None


def write_list(out: Address, packs: Sequence[Pack]) -> None:
    """Write the list of packs: from now on these count."""
    if not packs:
        storage.remove(join(out, LIST))
        return
    text = json.dumps({"compact": 1, "packs": [pack.model_dump() for pack in packs]}, indent=1)
    storage.write_bytes(join(out, LIST), f"{text}\n".encode())


def file_name(part: str, name: str) -> str:
    """The file of a pack's index or of a table of it, from the result's folder on."""
    return f"{FOLDER}/{name}.parquet" if part == INDEX else f"{part}/{FOLDER}/{name}.parquet"


def file_digests(pack: Pack) -> dict[str, str]:
    """SHA-256 of each file of a pack, by file name."""
    return {file_name(part, pack.name): digest for part, digest in pack.sha256.items()}


def _verified_content(out: Address, file: str, digest: str) -> bytes:
    """Content of a file of a pack, which must be there and whole."""
    content = storage.content_of(join(out, file))
    if content is None or sha256(content) != digest:
        raise unusable_error(out, file, "is missing" if content is None else "is damaged")
    return content


def find_packed(out: Address, among: Iterable[str] | None = None) -> dict[str, PackedRun]:
    """The packed ones of these runs; of all runs in the order of their ids."""
    packs = read_list(out)
    if not packs:
        return {}
    places = _places_in_packs(str(out), tuple((pack.name, pack.sha256[INDEX]) for pack in packs))
    runs = sorted(places) if among is None else [run_id for run_id in among if run_id in places]
    return {run_id: PackedRun(packs[places[run_id][0]], places[run_id][1]) for run_id in runs}


@lru_cache(maxsize=4)
def _places_in_packs(out: str, packs: tuple[tuple[str, str], ...]) -> dict[str, tuple[int, int]]:
    """Number of the last pack that has each run, and the row there."""
    return {
        run_id: (number, row)
        for number, (name, digest) in enumerate(packs)
        for row, run_id in enumerate(_index_of_file(out, name, digest).run_ids)
    }


def by_pack(runs: Mapping[str, PackedRun]) -> Iterator[tuple[Pack, dict[str, int]]]:
    """The packs of these runs, each with the rows of its own."""
    in_order = sorted(runs.items(), key=lambda item: (item[1].pack.name, item[1].row))
    for _, group in groupby(in_order, key=lambda item: item[1].pack.name):
        of_pack = list(group)
        yield of_pack[0][1].pack, {run_id: place.row for run_id, place in of_pack}


def index_of(out: Address, pack: Pack) -> Index:
    """Which runs a pack holds, and where. Raises `UsageError` where its index is not what was written."""
    return _index_of_file(str(out), pack.name, pack.sha256[INDEX])


@lru_cache(maxsize=256)
def _index_of_file(out: str, name: str, digest: str) -> Index:
    """Rows of each run within the tables of a pack."""
    rows = _read_index(out, name, digest, tuple(column for column in INDEX_COLUMNS if column not in _OF_MARKER))
    starts = {table: np.concatenate([[0], rows[f"{table}_rows"].cum_sum().to_numpy()]) for table in TABLES}
    return Index(rows["run_id"].to_list(), starts)


@lru_cache(maxsize=2)
def _read_index(out: str, name: str, digest: str, columns: tuple[str, ...]) -> pl.DataFrame:
    """The columns of an index, which must be what was written."""
    return parquet.read_parquet(_verified_content(out, file_name(INDEX, name), digest), lambda _: columns)


def markers(out: Address, runs: Mapping[str, PackedRun]) -> Iterator[Marker]:
    """The markers of packed runs."""
    for pack, rows in by_pack(runs):
        index = _read_index(str(out), pack.name, pack.sha256[INDEX], ("run_id", *_OF_MARKER))
        yield from (Marker(*row) for row in index[list(rows.values())].iter_rows())


def sweep(out: Address) -> None:
    """Remove files of packs that do not count."""
    names = {f"{pack.name}.parquet" for pack in read_list(out)} | {LIST.rpartition("/")[2]}
    for part in (INDEX, *TABLES):
        folder = join(out, FOLDER if part == INDEX else f"{part}/{FOLDER}")
        there = storage.files_below(folder)
        for name in there:
            if name not in names:
                storage.remove(join(folder, name))
        if not names.intersection(there):
            storage.remove_folder(folder)


class GoneError(UsageError):
    """A file of the result was listed and is not there: it is lost, or `compact` took its rows elsewhere meanwhile."""


def read_twice_if_moved(read: Callable[[], T]) -> T:
    """What is read of a result, once more where `compact` has moved rows between two looks.

    Raises `GoneError` where a file is gone the second time as well.
    """
    try:
        return read()
    except GoneError:
        return read()


def unusable_error(out: Address, file: str, reason: str) -> UsageError:
    """The error for a pack that cannot be read, or is gone."""
    kind = UsageError if files.exists(join(out, file)) else GoneError
    return kind(
        f"cannot be read, and many runs are in it: {reason}",
        place=redacted(str(join(out, file))),
        remedy="Take the file from a copy of the result, or replay into another --out.",
    )
