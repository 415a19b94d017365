"""One log looked at: which streams it feeds, from when to when, and the mapping that its header suggests."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.campaign.plan import is_run
from pipeline.make.receivers import gather
from pipeline.make.receivers.convert import mappings_of_topics
from pipeline.make.receivers.csv import TABLES, maps_file
from pipeline.make.receivers.messages import UnknownError
from pipeline.project.convert import Recordings
from pipeline.read.ingest import read_run
from pipeline.read.ingest.csv_draft import draft_mapping
from pipeline.read.ingest.describe import Census, topics_in
from pipeline.read.ingest.parts import LogPart, parts_of_topics
from pipeline.read.ingest.run import read_part
from schemas.config import IngestConfig, settings_from, toml_of
from schemas.enums import Fix
from schemas.errors import BaliseError, InputError
from schemas.frozen import frozen
from schemas.run import STREAMS, RunLog, Stream

_A_DAY = timedelta(days=1)  # clocks of one ride may be local and UTC


@frozen
class StreamSpan:
    """Rows of a stream, and the times of the first and the last."""

    rows: int
    start: datetime
    end: datetime


@frozen
class InspectedLog:
    """A log and what it feeds; `mapping`: of a table, by stream; `is_run`: needs no conversion; `parts`: what it
    consists of; `assumed`: what was taken for granted where its header leaves it open.
    """

    path: Path
    spans: Mapping[Stream, StreamSpan]
    mapping: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)
    is_run: bool = False
    mostly_fixed: bool = False
    parts: tuple[LogPart, ...] = ()
    assumed: tuple[str, ...] = ()

    @property
    def has_positions(self) -> bool:
        """Whether it holds positions of a receiver."""
        return "gnss" in self.spans

    @property
    def start(self) -> datetime:
        """Begin of the positions, else of all streams."""
        return min(span.start for span in self._deciding_spans())

    @property
    def end(self) -> datetime:
        """The last instant of any stream."""
        return max(span.end for span in self._deciding_spans())

    def overlaps(self, other: InspectedLog) -> bool:
        """Whether the times of two logs overlap."""
        return self.start < other.end and other.start < self.end

    def _deciding_spans(self) -> list[StreamSpan]:
        """Spans that its time is taken from: of the positions, else of all streams."""
        return [self.spans["gnss"]] if self.has_positions else list(self.spans.values())


def look_at_dates(path: Path, config: IngestConfig, others: Sequence[InspectedLog]) -> InspectedLog | None:
    """A table whose dates may be day first or month first: in the one order that puts it within a day of other logs."""
    if path.suffix.lower() not in TABLES or maps_file(config, path):
        return None
    fitting: list[InspectedLog] = []
    for order in ("day_first", "month_first"):
        try:
            log = _look_at_table(path, config, order)
        except BaliseError:
            continue
        if any(log.start < other.end + _A_DAY and other.start < log.end + _A_DAY for other in others):
            fitting.append(log)
    # 03.03.2025 is the same day either way.
    return fitting[0] if fitting and all(log.spans == fitting[0].spans for log in fitting) else None


def look_at(path: Path, config: IngestConfig, day: date | None, recordings: Recordings) -> InspectedLog:
    """Read a log to see what it feeds. Raises `InputError` where nothing can be made of it."""
    if is_run(path):
        return _look_at_run(path, config)
    known = None if maps_file(config, path) else recordings.known(path)
    if known is not None:
        return _inspected_log(path, known.as_gatherings().streams, parts=known.parts)
    if path.suffix.lower() == ".csv" and not maps_file(config, path):
        return _look_at_table(path, config)
    try:
        found = gather([path], config, day)
        return _inspected_log(path, found.streams, parts=found.parts)
    except UnknownError:
        if path.suffix.lower() not in TABLES:
            raise
        return _look_at_table(path, config)


def _look_at_run(path: Path, config: IngestConfig) -> InspectedLog:
    """A run; an MCAP log without positions is a log that another one needs."""
    if path.suffix.lower() == ".mcap":
        own = mappings_of_topics(config, path)
        census = Census()
        run = read_part([path], own, partly=True, observers=[census])
        parts = tuple(parts_of_topics(path.name, topics_in([census], own), run.notes.skipped_topics))
    else:
        run = read_run(path, config, with_digest=False)
        parts = _parts_of_folder(path, run)
    streams = {name: frame for name in STREAMS if (frame := run.stream(name)) is not None and frame.height}
    return _inspected_log(path, streams, is_run="gnss" in streams, parts=parts)


def _parts_of_folder(path: Path, run: RunLog) -> tuple[LogPart, ...]:
    """The columns and files of a run's folder that are none of the contract's, and those that are."""
    used = [(name, frame.height) for name in STREAMS if (frame := run.stream(name)) is not None]
    whole = [LogPart(path.name, "file", f"{name}.parquet", rows, name) for name, rows in used]
    return (*whole, *(LogPart(path.name, "file", name, 0) for name in run.notes.skipped_topics))


def _inspected_log(
    path: Path,
    streams: Mapping[Stream, pl.DataFrame],
    mapping: Mapping[str, list[dict[str, Any]]] | None = None,
    is_run: bool = False,
    parts: tuple[LogPart, ...] = (),
) -> InspectedLog:
    """What was seen of a log; raises `InputError` where no stream has a time."""
    spans: dict[Stream, StreamSpan] = {}
    for name, frame in streams.items():
        times = frame.to_series(0).drop_nulls()
        if len(times):
            spans[name] = StreamSpan(frame.height, times.min(), times.max())  # type: ignore[arg-type]
    if not spans:
        raise InputError("holds no row with a time", place=str(path), expected="positions, distances, speeds or reads")
    gnss = streams.get("gnss")
    fixed = 0 if gnss is None else (gnss["fix"].cast(pl.String) == Fix.RTK_FIXED.value).sum()
    return InspectedLog(path, spans, mapping or {}, is_run, gnss is not None and 2 * fixed > gnss.height, parts)


def _look_at_table(path: Path, config: IngestConfig, date_order: str | None = None) -> InspectedLog:
    """A table by the mapping that its header suggests."""
    text = draft_mapping(path)
    drafted = toml_of(text.encode(), f"mapping of {path}").get("ingest")
    mapping: dict[str, Any] = drafted if isinstance(drafted, dict) else {}
    mapping = {stream: entries if isinstance(entries, list) else [entries] for stream, entries in mapping.items()}
    if not mapping or any("time" not in entry for entries in mapping.values() for entry in entries):
        left_open = re.search(r"(?m)^# (time = .*?)  # (in .*)$", text)
        reason = "the names of its columns do not tell " + ("its time" if mapping else "what they are")
        raise _undecided_error(path, f"{left_open[1]} is {left_open[2]}" if left_open else reason)
    for entries in mapping.values():
        for entry in entries:
            entry["topic"] = path.name
            if date_order is not None:
                entry["date_order"] = date_order
    ingest = settings_from({**config.model_dump(exclude_defaults=True), **mapping}, IngestConfig, str(path))
    try:
        found = gather([path], ingest)
    except InputError as error:
        raise _undecided_error(path, error.message, error) from None
    own = {name: [{k: v for k, v in entry.items() if k != "topic"} for entry in of] for name, of in mapping.items()}
    assumed = ('its GPS times are taken for UTC; `time_scale = "gps"` in its mapping if they are 18 s ahead',)
    log = _inspected_log(path, found.streams, own, parts=found.parts)
    return replace(log, assumed=assumed) if "\n# time_scale = " in text else log


def _undecided_error(path: Path, why: str, error: InputError | None = None) -> InputError:
    """The error for a table whose columns need a mapping."""
    hint = f"`balise inspect {path}` prints a draft: complete it as config.toml, and add --config config.toml."
    return InputError(
        f"needs a mapping of its columns: {why}",
        place=str(path) if error is None else error.place,
        found=None if error is None else error.found,
        expected=None if error is None else error.expected,
        remedy=" ".join(filter(None, [error.remedy if error else None, hint])),
    )
