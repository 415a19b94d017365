"""Receiver logs as a run: UBX, SBF, NMEA, or CSV with a column mapping."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.ingest.breaches import Breach, refuse
from pipeline.ingest.conform import conform
from pipeline.receivers import nmea, sbf, ubx
from pipeline.receivers.csv import read_csv
from pipeline.receivers.epochs import Epochs, Gathered
from pipeline.receivers.frames import Frame, Protocol, frames
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import RunLog, Stream

Streams = dict[Stream, pl.DataFrame]
Decode = Callable[[Gathered, Any, bytes], None]


@dataclass(frozen=True)
class Converted:
    """The run, and what could not be used: reason to number."""

    run: RunLog
    dropped: dict[str, int]


def convert(logs: list[Path], run_id: str, config: IngestConfig | None = None) -> Converted:
    """Receiver logs of one journey as one run.

    Binary logs are recognised by their content; `.csv` files by their ending, and need the mapping of `config`.
    Raises `InputError` where no log holds a position, or where two logs tell of the same time under one solution.
    """
    dropped: Counter[str] = Counter()
    parts: list[tuple[Path, Streams]] = []
    for log in logs:
        streams, counts = _convert_one(log, config or IngestConfig())
        parts.append((log, streams))
        dropped.update(counts)
    _refuse_overlaps(parts)
    joined = _joined(parts)
    if joined.get("gnss") is None or joined["gnss"].is_empty():
        raise InputError(
            "no epoch with a time and a position",
            place=", ".join(str(log) for log in logs),
            expected="UBX NAV-PVT or NAV-SOL, SBF PVTGeodetic or PVTCartesian, NMEA GGA, GNS or RMC with a date, "
            "or a mapped CSV",
            remedy="Let the receiver record one of these messages." + _reasons(dropped),
        )
    return Converted(RunLog(run_id, joined.pop("gnss")).with_streams(**joined), dict(dropped))


def _reasons(dropped: Mapping[str, int]) -> str:
    return "".join(f" Not used: {reason} ({count})." for reason, count in sorted(dropped.items()))


def _joined(parts: list[tuple[Path, Streams]]) -> Streams:
    """The streams of all logs, one after the other, as the contract has them."""
    breaches: list[Breach] = []
    collected: dict[Stream, list[pl.DataFrame]] = {}
    for log, streams in parts:
        for name, frame in streams.items():
            if frame.height:
                collected.setdefault(name, []).append(conform(frame, name, str(log), breaches))
    refuse(breaches)
    return {name: pl.concat(frames) for name, frames in collected.items()}


def _refuse_overlaps(parts: list[tuple[Path, Streams]]) -> None:
    """Two receivers under one name would be read as one that jumps between their positions."""
    spans: dict[str, list[tuple[Any, Any, Path]]] = {}
    for log, streams in parts:
        frame = streams.get("gnss", pl.DataFrame({"solution": [], "t": []})).drop_nulls("t")
        for name, start, end in (
            frame.group_by("solution", maintain_order=True)
            .agg(pl.col("t").min().alias("start"), pl.col("t").max().alias("end"))
            .rows()
        ):
            for other_start, other_end, other in spans.setdefault(name, []):
                if other != log and start < other_end and other_start < end:
                    raise InputError(
                        "two logs hold positions of the same time under one solution",
                        place=f"{other}, {log}",
                        found=f"solution {name} in both, from {max(start, other_start)} on",
                        expected="one receiver per run, or a solution of its own for each",
                        remedy="Convert the logs into runs of their own.",
                    )
            spans[name].append((start, end, log))


def _convert_one(log: Path, config: IngestConfig) -> tuple[Streams, Mapping[str, int]]:
    if log.suffix.lower() == ".csv":
        return read_csv(log, config)
    try:
        content = log.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(log)) from None
    return _read(content, log)


def _read(content: bytes, log: Path) -> tuple[Streams, Mapping[str, int]]:
    """The epochs of the protocol that tells most; what is damaged or told twice is counted."""
    dropped: Counter[str] = Counter()
    decoders = {protocol: make() for protocol, (_, make) in _PROTOCOLS.items()}
    gathered = {protocol: Gathered() for protocol in _PROTOCOLS}
    met = 0
    for frame in frames(content, lambda: dropped.update(["damaged message"])):
        met += 1
        if frame.protocol in decoders:
            _decode(frame, decoders[frame.protocol], gathered[frame.protocol])
    if not met:
        raise InputError(
            "holds no message of a known receiver",
            place=str(log),
            expected="UBX, SBF or NMEA",
            remedy="Convert it to CSV and give a mapping, if the receiver is another one." + _reasons(dropped),
        )
    nmea.settle_first_day(gathered[Protocol.NMEA])
    told = {protocol: epochs.settled() for protocol, epochs in gathered.items()}
    best = max(told, key=lambda protocol: _worth(protocol, told[protocol]))
    for protocol, epochs in told.items():
        if protocol is best or not told[best].positions:
            dropped.update(gathered[protocol].dropped)
        elif epochs.positions:
            dropped[f"{protocol} position beside those of {best}"] += epochs.positions
    return told[best].streams(), dropped


def _worth(protocol: Protocol, epochs: Epochs) -> int:
    """A receiver that sends NMEA beside its own protocol rounds there, and leaves out how accurate it is."""
    return epochs.positions * (1 if protocol is Protocol.NMEA else 2)


def _decode(frame: Frame, decode: Decode, gathered: Gathered) -> None:
    parse, _ = _PROTOCOLS[frame.protocol]
    try:
        message = parse(frame.content)
    except ImportError as error:
        raise InputError(
            f"cannot be read without the package {error.name}",
            place=f"{frame.protocol} messages",
            remedy="Install the extra `receivers`.",
        ) from None
    except Exception:
        # The parsers' own errors share no base class.
        gathered.drop(_UNFIT)
        return
    try:
        if message is not None:
            decode(gathered, message, frame.content)
    except (AttributeError, OverflowError):  # a message that ends before its fields do, a time beyond all calendars
        gathered.drop(_UNFIT)


_UNFIT = "message that does not fit its definition"


# By protocol: what makes a message of a frame, and what makes a decoder of its messages. The first wins a tie.
_PROTOCOLS: dict[Protocol, tuple[Callable[[bytes], Any], Callable[[], Decode]]] = {
    Protocol.UBX: (ubx.parse, lambda: ubx.UbxDecoder().decode),
    Protocol.SBF: (sbf.parse, lambda: sbf.decode),
    Protocol.NMEA: (nmea.parse, lambda: nmea.NmeaDecoder().decode),
}
