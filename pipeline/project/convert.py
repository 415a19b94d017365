"""One run of a project from its logs, as `balise convert` makes it in one or several calls."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import date
from itertools import groupby
from pathlib import Path

from pipeline.make.receivers import Converted, Gatherings, Purpose, as_run, extend_run, gather
from pipeline.project.opened import OpenedProject
from pipeline.read.ingest import read_run
from pipeline.read.ingest.correct import correct_further, correct_run
from pipeline.storage.noted import note_all_below, noting
from schemas.config import FixSigma, IngestConfig
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.project import ConvertEntry, LogEntry
from schemas.run import RunLog


@frozen
class Recordings:
    """What public recordings need no mapping for, and how a run is written; both are known to `datasets` alone."""

    known: Callable[[Path], Converted | None]
    write: Callable[[RunLog, Path], None]


@frozen
class _Part:
    """Logs that are read in one call, what their positions are for, and what they hold."""

    purpose: Purpose
    found: Gatherings


def logs_of(opened: OpenedProject, entry: ConvertEntry) -> list[Path]:
    """Every log of a run. Raises `UsageError` for one that is not there."""
    return [path for log in entry.logs for path in _files_of_log(opened, log, entry)]


def convert_entry(
    opened: OpenedProject, entry: ConvertEntry, ingest: IngestConfig, sigmas: FixSigma, recordings: Recordings
) -> Converted:
    """The run, corrected as the project says; raises `InputError` for logs that cannot be read."""
    with noting() as noted:
        parts = _logs_by_purpose(opened, entry, ingest, recordings)
    parts.sort(key=lambda part: part.purpose.stream != "gnss" or "gnss" not in part.found.streams)
    first = parts[0]
    common = ingest.correct
    made = as_run(first.found, entry.run_id, first.purpose, sigmas, common)
    dropped = Counter(made.dropped)
    listed = list(made.parts)
    for part in parts[1:]:
        made = extend_run(made.run, Path(entry.to), part.found, part.purpose, sigmas, False, common)
        dropped.update(made.dropped)
        listed += made.parts
    run = correct_run(made.run, common)
    # A log that is a run of this program may have been corrected so when it was written.
    own = [correction for correction in entry.correct if correction not in run.notes.corrections]
    return Converted(correct_further(run, own), dict(dropped), tuple(listed)).made_of(noted.listing())


def _logs_by_purpose(
    opened: OpenedProject, entry: ConvertEntry, base: IngestConfig, recordings: Recordings
) -> list[_Part]:
    """Logs of the same purpose are read together, so that two of the same time are refused."""
    ingest = _with_mappings(base, entry.logs)
    parts = []
    for (purpose, day), logs in groupby(sorted(entry.logs, key=_reading_key), key=_purpose_and_date):
        paths = []
        for log in logs:
            for path in _files_of_log(opened, log, entry):
                known = None if log.mappings() or day else _read_known_form(path, ingest, recordings)
                if known is None:
                    paths.append(path)
                else:
                    parts.append(_Part(purpose, known.as_gatherings()))
        if paths:
            parts.append(_Part(purpose, gather(paths, ingest, day, purpose.solution)))
    return parts


def _read_known_form(path: Path, config: IngestConfig, recordings: Recordings) -> Converted | None:
    """A public recording, or a folder that is a run already; None for any other."""
    note_all_below(path)
    if (path / "gnss.parquet").is_file():
        return Converted(read_run(path, config, with_digest=False), {})
    return recordings.known(path)


def _purpose_and_date(log: LogEntry) -> tuple[Purpose, date | None]:
    """What the positions of a log are for, and the date of its first epoch."""
    return Purpose(log.solution, log.stream), log.date


def _reading_key(log: LogEntry) -> tuple[str, str, str]:
    """Sorts logs by what is read in one call."""
    return log.stream, log.solution or "", str(log.date or "")


def _with_mappings(base: IngestConfig, logs: tuple[LogEntry, ...]) -> IngestConfig:
    """The mappings of all logs before those of the configuration; corrections are made of the whole run."""
    own: list[Mapping[str, object]] = [log.mappings() for log in logs]
    names = dict.fromkeys(name for mappings in own for name in mappings)
    joined = {name: sum((tuple(of[name]) for of in own if name in of), ()) + getattr(base, name) for name in names}  # type: ignore[arg-type]
    return base.model_copy(update={"correct": (), **joined})


def _files_of_log(opened: OpenedProject, log: LogEntry, entry: ConvertEntry) -> list[Path]:
    """The files of a log, patterns resolved."""
    found: list[Path] = []
    for named in log.files:
        place = opened.place(named)
        matches = [place] if Path(place).exists() else sorted(glob.glob(place, recursive=True))
        if not matches:
            raise UsageError(
                "does not exist",
                place=place,
                expected=f"a log of run {entry.run_id}, as {opened.file} names it",
                remedy="Put it back, or correct `files` under [[convert]]; paths are relative to balise.toml.",
            )
        found += map(Path, matches)
    return found
