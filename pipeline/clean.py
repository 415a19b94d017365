"""Streams in order of time, without duplicated stamps; what had to be mended is counted."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import polars as pl

from schemas.errors import InputError
from schemas.run import STREAMS, RunLog, Stream

_KEYS: dict[Stream, list[str]] = {
    "gnss": ["solution", "t"],
    "satellites": ["solution", "t", "sv"],
    "balise_reads": ["t", "balise_id"],
}


@dataclass(frozen=True)
class StreamCounts:
    """Rows dropped because their key stands twice, and rows that came before an earlier one."""

    duplicates: int = 0
    out_of_order: int = 0


@dataclass(frozen=True)
class CleanCounts:
    """What cleaning found, per GNSS solution and per other stream."""

    solutions: dict[str, StreamCounts] = field(default_factory=dict)
    streams: dict[str, StreamCounts] = field(default_factory=dict)


def clean(run: RunLog) -> tuple[RunLog, CleanCounts]:
    """The run with every stream in order and each stamp once (the first recorded one stays), times in nanoseconds.

    Raises `InputError` where no solution or not the odometer has two different times, or both have no time in common:
    nothing can be replayed.
    """
    streams: dict[str, pl.DataFrame | None] = {}
    counts: dict[str, StreamCounts] = {}
    for name in STREAMS:
        frame = run.stream(name)
        if frame is None or name == "faults":
            continue
        streams[name], counts[name] = _in_order(frame, _KEYS.get(name, ["t"]))
    recorded = run.gnss.select("solution", "t").partition_by("solution", maintain_order=True)
    solutions = {part["solution"][0]: _in_order(part, ["t"])[1] for part in recorded}
    gnss = streams["gnss"]
    parts = [] if gnss is None else gnss.select("solution").partition_by("solution", maintain_order=True)
    if parts and all(part.height < 2 for part in parts):
        require_two_times(parts[0], f"{run.run_id}: gnss", f" of solution {parts[0]['solution'][0]!r}")
    odometer = streams.get("odometer")
    if odometer is not None:
        require_two_times(odometer, f"{run.run_id}: odometer")
        _require_common_time(run.run_id, gnss, odometer)
    return run.with_streams(**streams), CleanCounts(solutions, counts)


def stamp_counts(stream: Stream, frame: pl.DataFrame) -> StreamCounts:
    """What `clean` would count in one stream, of GNSS in one solution."""
    return _in_order(frame.drop_nulls("t"), _KEYS.get(stream, ["t"]))[1]


def _in_order(frame: pl.DataFrame, keys: list[str]) -> tuple[pl.DataFrame, StreamCounts]:
    frame = frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    if (np.diff(frame["t"].to_physical().to_numpy()) > 0).all():
        return frame, StreamCounts(0, 0)
    late = _out_of_order(frame, [key for key in keys if key == "solution"])
    ordered = frame if late == 0 and frame["t"].is_sorted() else frame.sort("t", maintain_order=True)
    unique = ordered.unique(subset=keys, keep="first", maintain_order=True)
    return unique, StreamCounts(frame.height - unique.height, late)


def _out_of_order(frame: pl.DataFrame, by: list[str]) -> int:
    """Rows whose time lies before the latest time recorded so far."""
    latest = pl.col("t").cum_max()
    late = pl.col("t") < (latest.over(by) if by else latest)
    return int(frame.select(late.sum()).item())


def require_two_times(stream: pl.DataFrame, place: str, of: str = "") -> None:
    """Refuse a cleaned stream with fewer than two times."""
    if stream.height < 2:
        raise InputError(
            f"only one time in the stream{of}",
            place=f"{place}, column t",
            found=f"{stream.height} distinct time",
            expected="at least two epochs at different times",
            remedy="Check the recorder's time stamps, or the mapping's time source.",
        )


def _require_common_time(run_id: str, gnss: pl.DataFrame | None, odometer: pl.DataFrame) -> None:
    """Refuse an odometer of another time than the GNSS: not one position could be held against it."""
    if gnss is None or gnss.is_empty():
        return
    (begin, end), (odometer_begin, odometer_end) = (stream["t"].to_physical()[[0, -1]] for stream in (gnss, odometer))
    if odometer_begin > end or odometer_end < begin:
        raise InputError(
            "has no time in common with the GNSS",
            place=f"{run_id}: odometer, column t",
            found=f"{odometer['t'][0]} to {odometer['t'][-1]}",
            expected=f"times within {gnss['t'][0]} to {gnss['t'][-1]}",
            remedy="Check date and time scale of the two recorders; leave the odometer out to replay without it.",
        )
