"""Which logs are of one ride: those of the same time, and those of one recorder that follow each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.make.receivers.unpack import is_packed
from pipeline.project.looking import InspectedLog

# Recorders begin a new file every hour or every so many megabytes, and lose a few seconds between two at most.
_NEXT_FILE_S = 60.0


@dataclass
class RecordedRun:
    """One run to be: `receivers` first the one under the name `primary`; of each the files that follow each other."""

    run_id: str
    receivers: list[list[InspectedLog]] = field(default_factory=list)
    references: list[InspectedLog] = field(default_factory=list)
    others: list[InspectedLog] = field(default_factory=list)

    @property
    def logs(self) -> list[InspectedLog]:
        """All logs of the run."""
        return [*(log for files in self.receivers for log in files), *self.references, *self.others]

    @property
    def is_ready(self) -> bool:
        """Whether it is a single run that needs no conversion."""
        return [log.is_run for log in self.logs] == [True]


def group_into_runs(
    logs: Sequence[InspectedLog], references: Sequence[Path]
) -> tuple[list[RecordedRun], list[InspectedLog]]:
    """The rides in order of time, and the logs that are of none of them.

    Logs without positions belong to every ride whose time they share; to the only ride whatever their clock says, so
    that a wrong clock is found by comparing streams.
    """
    recorded_runs: list[RecordedRun] = []
    positions = [log for log in logs if log.has_positions and log.path not in references]
    for log in sorted(positions, key=lambda log: (log.start, logs.index(log))):
        _assign_log(log, recorded_runs)
    alone: list[InspectedLog] = []
    for log in logs:
        if log in positions:
            continue
        homes = (
            recorded_runs
            if len(recorded_runs) == 1
            else [
                recorded_run
                for recorded_run in recorded_runs
                if any(map(log.overlaps, _logs_of_receivers(recorded_run)))
            ]
        )
        for recorded_run in homes:
            (recorded_run.references if log.path in references else recorded_run.others).append(log)
        if not homes:
            alone.append(log)
    # The receiver named first is the one under test.
    for recorded_run in recorded_runs:
        recorded_run.receivers.sort(key=lambda files: min(map(logs.index, files)))
    return _with_unique_names(recorded_runs), alone


def _assign_log(log: InspectedLog, recorded_runs: list[RecordedRun]) -> None:
    """A log continues a file of its kind, is another receiver of a ride, or begins a ride."""
    for recorded_run in recorded_runs:
        for files in recorded_run.receivers:
            gap_s = (log.start - files[-1].end).total_seconds()
            if log.path.suffix == files[-1].path.suffix and 0 <= gap_s <= _NEXT_FILE_S and not log.is_run:
                files.append(log)
                return
    for recorded_run in recorded_runs:
        if any(map(log.overlaps, _logs_of_receivers(recorded_run))):
            recorded_run.receivers.append([log])
            return
    recorded_runs.append(RecordedRun(stem_of(log.path), [[log]]))


def _logs_of_receivers(recorded_run: RecordedRun) -> list[InspectedLog]:
    """Logs of all receivers of a run."""
    return [log for files in recorded_run.receivers for log in files]


def stem_of(path: Path) -> str:
    """The name of a log without its suffixes of packing and of kind: packed logs are named as what is in them."""
    while is_packed(path) and path.stem:
        path = path.with_suffix("")
    return path.name if path.is_dir() else path.stem


def _with_unique_names(recorded_runs: list[RecordedRun]) -> list[RecordedRun]:
    """Run ids by the first log of each ride; logs of one name in several folders take the folder's name too."""
    firsts = [recorded_run.receivers[0][0].path for recorded_run in recorded_runs]
    stems = [stem_of(path) for path in firsts]
    named: list[RecordedRun] = []
    for recorded_run, path, stem in zip(recorded_runs, firsts, stems, strict=True):
        unique = stem if stems.count(stem) == 1 else f"{path.resolve().parent.name}_{stem}"
        taken = sum(known.run_id == unique or known.run_id.startswith(f"{unique}_") for known in named)
        named.append(replace(recorded_run, run_id=f"{unique}_{taken + 1}" if taken else unique))
    return named
