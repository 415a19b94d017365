"""Records that pass between ingest and the stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import TYPE_CHECKING, Literal, get_args

from schemas.frozen import frozen

if TYPE_CHECKING:
    import polars as pl

    from schemas.config import StreamCorrection

RecordedStream = Literal["gnss", "odometer", "satellites", "reference", "balise_reads"]
Stream = Literal[RecordedStream, "faults"]
"""The recorded streams, and what was injected into them."""
RECORDED_STREAMS: tuple[RecordedStream, ...] = get_args(RecordedStream)
STREAMS: tuple[Stream, ...] = get_args(Stream)


@frozen
class IngestNotes:
    """What reading found out about the log beside its data.

    `partial_until_ns` is set when the log is damaged at its end and read up to there; `corrections`: those that
    its streams hold already, made when it was read or when it was written. `messages`: how many a log holds, by topic.
    `raw_logs`: of a converted run the files that it was made of: name, size [bytes], SHA-256.
    """

    partial_until_ns: int | None = None
    damage: str | None = None
    slow_path_messages: int = 0
    chunks_without_crc: int = 0
    files_without_crc: tuple[str, ...] = ()
    skipped_topics: tuple[str, ...] = ()
    corrections: tuple[StreamCorrection, ...] = ()
    messages: Mapping[str, int] = field(default_factory=dict)
    raw_logs: tuple[tuple[str, int, str], ...] = ()


@frozen
class RunLog:
    """One recorded journey, one frame per stream as in `schemas.inputs`.

    Once cleaned, `odometer` is the sensor that the LDS uses, and `other_odometers` are the others, one each.
    """

    run_id: str
    gnss: pl.DataFrame
    odometer: pl.DataFrame | None = None
    satellites: pl.DataFrame | None = None
    reference: pl.DataFrame | None = None
    balise_reads: pl.DataFrame | None = None
    faults: pl.DataFrame | None = None
    notes: IngestNotes = field(default_factory=IngestNotes)
    input_digest: str = ""
    other_odometers: tuple[pl.DataFrame, ...] = ()

    def stream(self, name: Stream) -> pl.DataFrame | None:
        """One of its streams by name, or None."""
        frame: pl.DataFrame | None = getattr(self, name)
        return frame

    def with_streams(self, **streams: pl.DataFrame | None) -> RunLog:
        """The run with some streams replaced."""
        return replace(self, **streams)  # type: ignore[arg-type]

    def solutions(self) -> list[str]:
        """Names of the run's solutions, sorted."""
        return sorted(self.gnss["solution"].unique().to_list())

    def main_solution(self) -> str:
        """The one that speaks for the run where only one can: `primary`, else the first by name."""
        solutions = self.solutions()
        return solutions[0] if solutions and "primary" not in solutions else "primary"


@frozen
class Finding:
    """One remark on a site: `severity` is `error`, `warning` or `note`."""

    severity: Literal["error", "warning", "note"]
    place: str
    message: str
    remedy: str = ""


BALISE_PLACE = "balises: "
"""What the place of a finding on a balise begins with."""


@frozen(eq=False)
class Site:
    """What does not change from run to run, in WGS 84, tables as in `schemas.inputs`.

    A site is equal to itself alone: what is made of it is kept beside it.

    `files`: name, size [bytes] and SHA-256 of each file that it was read from; `digest` is over names and contents.
    """

    track: pl.DataFrame
    links: pl.DataFrame
    balises: pl.DataFrame | None = None
    route: pl.DataFrame | None = None
    findings: tuple[Finding, ...] = ()
    digest: str = ""
    files: tuple[tuple[str, int, str], ...] = ()

    def balises_off(self) -> list[str]:
        """Balises that lie off their net element."""
        return [item.place.removeprefix(BALISE_PLACE) for item in self.findings if item.severity == "error"]


@frozen
class RunTables:
    """The five output tables of one run, all solutions in each, brought to their contract (`schemas.tables`).

    Raises `ValueError` where a table breaks it, which is a defect of the program.
    """

    run_id: str
    hazards: pl.DataFrame
    passages: pl.DataFrame
    alarms: pl.DataFrame
    epochs: pl.DataFrame
    runs: pl.DataFrame

    def __post_init__(self) -> None:
        # Imported here because it takes a while, and the parent of a campaign holds no tables.
        from schemas.conform import conform
        from schemas.tables import TABLES

        for name, schema in TABLES.items():
            object.__setattr__(self, name, conform(getattr(self, name), schema))
