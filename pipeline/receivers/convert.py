"""Receiver logs as a run: UBX, SBF, NMEA, or CSV with a column mapping."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.receivers import sbf, ubx
from pipeline.receivers.csv import read_csv
from pipeline.receivers.epochs import Gathered
from pipeline.receivers.nmea import NmeaDecoder, settle_first_day
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import RunLog

_UBX_SYNC, _SBF_SYNC = b"\xb5\x62", b"$@"
_NMEA_SENTENCE = re.compile(rb"\$G[A-Z]{4},")
_UBX_AND_NMEA = 3
_SBF = 2


@dataclass(frozen=True)
class Converted:
    """The run, and what could not be used: reason to number."""

    run: RunLog
    dropped: dict[str, int]


def convert(logs: list[Path], run_id: str, config: IngestConfig | None = None) -> Converted:
    """Receiver logs of one journey as one run.

    Binary logs are recognised by their content; `.csv` files by their ending, and need the mapping of `config`.
    Raises `InputError` where a log holds no position at all.
    """
    parts = [_convert_one(log, config or IngestConfig()) for log in logs]
    dropped: dict[str, int] = {}
    for _, counts in parts:
        for reason, count in counts.items():
            dropped[reason] = dropped.get(reason, 0) + count
    streams: dict[str, pl.DataFrame] = {}
    for frames, _ in parts:
        for name, frame in frames.items():
            streams[name] = pl.concat([streams[name], frame]) if name in streams else frame
    if streams.get("gnss") is None or streams["gnss"].is_empty():
        raise InputError(
            "no epoch with a time and a position",
            place=", ".join(str(log) for log in logs),
            expected="UBX NAV-PVT, SBF PVTGeodetic or PVTCartesian, NMEA GGA with RMC or ZDA, or a mapped CSV",
            remedy="Let the receiver record one of these messages." + _reasons(dropped),
        )
    return Converted(RunLog(run_id, streams.pop("gnss")).with_streams(**streams), dropped)


def _reasons(dropped: dict[str, int]) -> str:
    return "".join(f" Not used: {reason} ({count})." for reason, count in sorted(dropped.items()))


def _convert_one(log: Path, config: IngestConfig) -> tuple[dict[str, pl.DataFrame], dict[str, int]]:
    if log.suffix.lower() == ".csv":
        return read_csv(log, config), {}
    try:
        content = log.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(log)) from None
    gathered = _gather(content, log)
    fixes, ranges = gathered.frames()
    frames = {"gnss": fixes} if ranges is None else {"gnss": fixes, "satellites": ranges}
    return frames, gathered.dropped


def _gather(content: bytes, log: Path) -> Gathered:
    """All messages of a log that can be decoded; damaged ones are counted."""
    gathered = Gathered()
    if content.count(_SBF_SYNC) > content.count(_UBX_SYNC):
        _read(_sbf_messages, content, gathered, lambda m: lambda g, raw: sbf.decode(g, m, raw))
        return gathered
    if _UBX_SYNC not in content and not _NMEA_SENTENCE.search(content):
        raise InputError(
            "holds no message of a known receiver",
            place=str(log),
            expected="UBX, SBF or NMEA",
            remedy="Convert it to CSV and give a mapping, if the receiver is another one.",
        )
    nmea = NmeaDecoder()
    _read(_ubx_messages, content, gathered, lambda m: lambda g, raw: _ubx_or_nmea(g, m, raw, nmea))
    settle_first_day(gathered)
    return gathered


def _ubx_or_nmea(gathered: Gathered, message: Any, raw: bytes, nmea: NmeaDecoder) -> None:
    if raw[:2] == _UBX_SYNC:
        ubx.decode(gathered, message, raw)
    else:
        nmea.decode(gathered, message, raw)


def _read(
    messages: Callable[[bytes, Callable[[Exception], None]], Any],
    content: bytes,
    gathered: Gathered,
    decoder: Callable[[Any], Callable[[Gathered, bytes], None]],
) -> None:
    for raw, message in messages(content, lambda error: gathered.drop("damaged message")):
        if message is not None:
            decoder(message)(gathered, raw)


def _ubx_messages(content: bytes, on_error: Callable[[Exception], None]) -> Any:
    from pyubx2 import UBXReader

    return UBXReader(io.BytesIO(content), quitonerror=1, errorhandler=on_error, protfilter=_UBX_AND_NMEA)


def _sbf_messages(content: bytes, on_error: Callable[[Exception], None]) -> Any:
    from pysbf2 import SBFReader

    return SBFReader(io.BytesIO(content), quitonerror=1, errorhandler=on_error, protfilter=_SBF)
