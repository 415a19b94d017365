"""Logs of receivers and public recordings to runs: what `balise convert` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path

from datasets import infrabel
from datasets.comma2k19 import comma2k19_run
from datasets.trial import write_run_as
from pipeline.make.receivers import Converted, Purpose, as_run, extend_run, gather, words_for_dropped
from pipeline.project.convert import Recordings
from pipeline.read.ingest import read_run
from pipeline.read.ingest.parts import LogPart, drafts_of, lines_of_parts
from pipeline.storage.noted import note_all_below, noting
from pipeline.studies.plausibility.fit import FitReport, fit_report
from schemas.config import Configuration, IngestConfig
from schemas.errors import visible
from schemas.frozen import frozen


@frozen
class Conversion:
    """What was written, how often which kind of record was not used, what the logs consist of, what was corrected, and
    what does not fit.
    """

    run: Path
    epochs: int
    not_used: Mapping[str, int]
    corrected: Sequence[str]
    fit: FitReport
    parts: Sequence[LogPart] = ()

    def lines(self) -> list[str]:
        """The result for people."""
        unused = [
            f"{words_for_dropped(reason)}: {count} x {visible(reason)}" for reason, count in self.not_used.items()
        ]
        made = [f"corrected: {visible(text)}" for text in self.corrected]
        listed = map(visible, [*lines_of_parts(self.parts), *drafts_of(self.parts)])
        return [f"{self.epochs} epochs in {self.run}", *unused, *made, *listed, *self.fit.lines()]

    def as_dict(self) -> dict[str, object]:
        """The result for programs."""
        head = {"run": self.run, "epochs": self.epochs, "not_used": self.not_used, "corrected": self.corrected}
        return {**head, "parts": [vars(part) for part in self.parts], **self.fit.as_dict()}


def convert_logs(
    logs: list[Path], to: Path, given: Configuration | None, purpose: Purpose, day: date | None, force: bool
) -> Conversion:
    """Write logs as a run, or add their streams to one.

    With a configuration no log is taken for a public recording.
    """
    settings = given or Configuration()
    with noting() as noted:
        recording = known_recording(logs[0]) if len(logs) == 1 and given is None else None
        found = gather(logs, settings.ingest, day, purpose.solution) if recording is None else recording.as_gatherings()
        if recording is not None:
            note_all_below(logs[0])
    if to.is_file() or (to / "gnss.parquet").is_file():
        run = read_run(to, IngestConfig(), with_digest=False)
        converted = extend_run(run, to, found, purpose, settings.fix_sigma, force, settings.ingest.correct)
    else:
        name = to.name.removesuffix(".mcap")
        converted = as_run(found, name, purpose, settings.fix_sigma, settings.ingest.correct)
    converted = converted.made_of(noted.listing())
    write_run_as(converted.run, to)
    made = tuple(f"{correction.stream}: {correction.changes}" for correction in converted.run.notes.corrections)
    return Conversion(
        to, converted.run.gnss.height, converted.dropped, made, fit_report(converted.run, settings), converted.parts
    )


def known_recording(path: Path) -> Converted | None:
    """A segment of comma2k19 (a folder) or a log of the Infrabel train (a CSV with its columns); none if neither."""
    if (path / "processed_log").is_dir():
        return Converted(comma2k19_run(path)[0], {})
    if path.suffix.lower() != ".csv" or not path.is_file():
        return None
    with path.open("rb") as stream:
        head = stream.readline()
    return infrabel.infrabel_recording(path) if all(name.encode() in head for name in infrabel.COLUMNS) else None


def public_recordings() -> Recordings:
    """What a project needs to know of recordings."""
    return Recordings(known_recording, write_run_as)
