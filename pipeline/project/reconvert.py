"""Whether the raw logs of a project give its converted runs again."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from pipeline.campaign.verify import Problem, Verification
from pipeline.project.convert import Recordings, convert_entry
from pipeline.project.opened import OpenedProject
from pipeline.read.ingest import read_run
from pipeline.storage.noted import scratch_folder
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.project import ConvertEntry
from schemas.run import STREAMS, RunLog


def verify_conversion(opened: OpenedProject, recordings: Recordings, runs: Collection[str]) -> Verification:
    """Convert the raw logs of these runs again, in a folder of their own, and hold each stream against the run that
    stands in the project.

    `runs`: absolute places. Rows are compared, not bytes: another build may write them in another way.
    """
    entries = [entry for entry in opened.project.convert if str(Path(opened.place(entry.to)).absolute()) in runs]
    problems = [problem for entry in entries for problem in _problems_of_entry(opened, entry, recordings)]
    count = f"{len(entries)} {'run' if len(entries) == 1 else 'runs'}"
    return Verification(f"{count} converted again from raw logs", tuple(problems))


def _problems_of_entry(opened: OpenedProject, entry: ConvertEntry, recordings: Recordings) -> Iterator[Problem]:
    """What one run, converted again, has unlike the one that stands there."""
    config = opened.given_config()
    place = Path(opened.place(entry.to))
    with scratch_folder() as folder:
        again = folder / place.name
        try:
            recordings.write(convert_entry(opened, entry, config.ingest, config.fix_sigma, recordings).run, again)
            # Both are read without the corrections of the configuration: they hold those that they were written with.
            made, there = (read_run(str(path), IngestConfig(), with_digest=False) for path in (again, place))
        except InputError as error:
            yield f"run {entry.run_id}", f"cannot be converted again: {error}", "the run"
            return
    yield from _compare_runs(entry.run_id, there, made)


def _compare_runs(run_id: str, there: RunLog, made: RunLog) -> Iterator[Problem]:
    """Streams, corrections and raw logs of two runs that are unlike."""
    for stream in STREAMS:
        present, expected = there.stream(stream), made.stream(stream)
        if (present is None) != (expected is None):
            what = ["nothing" if one is None else "rows" for one in (present, expected)]
            yield f"run {run_id}, {stream}", what[0], what[1]
        elif present is not None and expected is not None and not present.equals(expected):
            yield f"run {run_id}, {stream}", "other rows", "those of the raw logs"
    if there.notes.corrections != made.notes.corrections:
        yield f"run {run_id}, corrections", "others", "those of the project"
    if there.notes.raw_logs != made.notes.raw_logs:
        yield f"run {run_id}, raw logs", "others", "those that the project names"
