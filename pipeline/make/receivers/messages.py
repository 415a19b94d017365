"""Logs of messages of receivers (UBX, SBF, NovAtel, NMEA), from frames to epochs."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

from pipeline.make.receivers import nmea, novatel, sbf, ubx
from pipeline.make.receivers.adding import Streams
from pipeline.make.receivers.epochs import Epochs, Gathered
from pipeline.make.receivers.frames import Frame, Protocol, name_of, whole_messages
from pipeline.make.receivers.rivals import twin_distance_m, two_receivers_error
from pipeline.read.ingest.parts import LogPart, parts_of_messages
from schemas.errors import InputError


class NoEpochError(InputError):
    """A log of a receiver whose messages tell no position with a time."""


class UnknownError(InputError):
    """A file without a message of a known receiver."""


def reasons_text(dropped: Mapping[str, int]) -> str:
    """What was not used, and why, for people."""
    return "".join(f" Not used: {reason} ({count})." for reason, count in sorted(dropped.items()))


def read_messages(
    content: bytes, log: Path, date: date | None, solution: str | None, left_out: frozenset[str] = frozenset()
) -> tuple[Streams, Counter[str], tuple[LogPart, ...]]:
    """Read the epochs of the protocol that says most; what is damaged or said twice is counted.

    Args:
        content: the log.
        log: its path, for errors.
        date: day of NMEA sentences without a date, None where unknown.
        solution: talker to take where several have positions of their own, None for the only one.
        left_out: talkers that are not read.

    Returns:
        Streams, number of records left out by reason, and what the log consists of.

    Raises:
        UnknownError: the file has no message of a known receiver.
        NoEpochError: no message has a position with a time.
        InputError: the log holds two receivers, or a package is missing.
    """
    dropped: Counter[str] = Counter()
    gathered = {protocol: Gathered() for protocol in _PROTOCOLS}
    gathered[Protocol.NMEA] = nmea.Sentences(left_out=left_out)
    named: Counter[tuple[Protocol, str, bool]] = Counter()
    for frame in whole_messages(
        content, lambda: dropped.update(["damaged message"]), lambda: dropped.update([_UNCHECKED])
    ):
        is_used = frame.protocol in gathered and _decode_message(frame, gathered[frame.protocol])
        named[frame.protocol, name_of(frame), is_used] += 1
    twins = {protocol: twin_distance_m(of) for protocol, of in gathered.items()}
    ubx.settle_times(gathered[Protocol.UBX])
    nmea.settle_days(gathered[Protocol.NMEA], date)
    novatel.settle_source(gathered[Protocol.NOVATEL])
    settled = {protocol: epochs.settle_epochs() for protocol, epochs in gathered.items()}
    best = max(settled, key=lambda protocol: _information_of(protocol, settled[protocol]))
    for protocol, epochs in settled.items():
        if protocol is best or not settled[best].positions:
            dropped.update(gathered[protocol].dropped)
        elif epochs.positions:
            dropped[f"{protocol} position beside those of {best}"] += epochs.positions
    if not settled[best].epochs:
        raise _no_epoch_error(content, log, dropped)
    rivals = gathered[best].rivals
    if solution in rivals:
        return read_messages(content, log, date, None, rivals - {solution})
    if rivals or twins[best] is not None:
        raise two_receivers_error(str(log), rivals, max(gathered[best].rival_distance_m, twins[best] or 0.0))
    counts = Counter({(name, used and protocol is best): 0 for protocol, name, used in named})
    for (protocol, name, used), count in named.items():
        counts[name, used and protocol is best] += count
    return settled[best].streams(), dropped, tuple(parts_of_messages(log.name, counts))


def _no_epoch_error(content: bytes, log: Path, dropped: Mapping[str, int]) -> InputError:
    """The error for a log without positions; what there is instead tells what to change at the receiver."""
    counts = Counter(name_of(frame) for frame in whole_messages(content, lambda: None))
    if not counts:
        head = content[:_HEAD]
        hint = next((hint for pattern, hint in _ALMOST.items() if re.search(pattern, head)), _OTHER)
        return UnknownError(
            "holds no message of a known receiver" if content else "is empty",
            place=str(log),
            expected="UBX, SBF, NMEA, NovAtel, JSON of gpsd, RTKLIB .pos, a bag, or CSV",
            remedy=hint + reasons_text(dropped),
        )
    return NoEpochError(
        "no epoch with a time and a position",
        place=str(log),
        found=", ".join(f"{name} ({count})" for name, count in counts.most_common(_MOST_NAMES)),
        expected="UBX NAV-PVT, SBF PVTGeodetic or PVTCartesian, NMEA GGA, GNS or RMC with a date, "
        "NovAtel BESTPOS or INSPVA",
        remedy="Let the receiver record one of these messages, or give the day of NMEA without one by --date."
        + reasons_text(dropped),
    )


def _information_of(protocol: Protocol, epochs: Epochs) -> int:
    """A receiver that sends NMEA beside its own protocol rounds there, and leaves out how accurate it is."""
    return epochs.positions * (1 if protocol is Protocol.NMEA else 2)


def _decode_message(frame: Frame, gathered: Gathered) -> bool:
    """Add what a message says to its epoch; whether it is of a kind that is used."""
    parse, decode = _PROTOCOLS[frame.protocol]
    try:
        message = parse(frame.content)
    except ImportError as error:
        raise InputError(
            f"cannot be read without the package {error.name}",
            place=f"{frame.protocol} messages",
            remedy=f"Install the extra `{'novatel' if frame.protocol is Protocol.NOVATEL else 'receivers'}`.",
        ) from None
    except Exception:
        # The parsers' own errors share no base class.
        gathered.count_dropped(_UNFIT)
        return True
    try:
        if message is not None:
            decode(gathered, message, frame.content)
    except (AttributeError, OverflowError):  # a message that ends before its fields do, a time beyond all calendars
        gathered.count_dropped(_UNFIT)
    return message is not None


# What is left out though it is almost a log, and what to do.
_OTHER = "Convert it to CSV and give a mapping, if the receiver is another one."
_ALMOST = {
    rb"\A.{20,60}C?RINEX VER": "RINEX holds ranges, no positions: compute them first, "
    "for example with rnx2rtkp of RTKLIB, and convert the .pos file that it writes.",
    rb"\$[A-Z]{2}(GGA|GNS|RMC),[^*\r\n]*\r?\n": "NMEA without checksums cannot be checked: let the logger keep them.",
}
_MOST_NAMES = 20
# Where a hint is looked for: what begins with gigabytes of something else is no such file.
_HEAD = 1024 * 1024
_UNCHECKED = "sentence without a checksum (nothing shows whether it is whole)"
_UNFIT = "message that does not fit its definition"


# By protocol: what makes a message of a frame, and what adds it to its epoch. The first wins a tie.
_PROTOCOLS: dict[Protocol, tuple[Callable[[bytes], Any], Callable[[Gathered, Any, bytes], None]]] = {
    Protocol.UBX: (ubx.parse, ubx.decode),
    Protocol.SBF: (sbf.parse, sbf.decode),
    Protocol.NOVATEL: (novatel.parse, novatel.decode),
    Protocol.NMEA: (nmea.parse, nmea.decode),
}
