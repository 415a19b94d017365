"""Receiver logs as a run: UBX, SBF, NMEA, NovAtel, RTKLIB, bags, or CSV with a column mapping."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.make.receivers import nmea, novatel, sbf, ubx
from pipeline.make.receivers.adding import BY_SOLUTION, Purpose, Streams, added, assigned
from pipeline.make.receivers.bags import is_bag, read_bag
from pipeline.make.receivers.csv import TABLES, names_file, read_csv
from pipeline.make.receivers.epochs import Epochs, Gathered
from pipeline.make.receivers.frames import Frame, Protocol, frames, name_of
from pipeline.make.receivers.gpsd import is_gpsd, objects_in, read_gpsd
from pipeline.make.receivers.rivals import sees_twins, two_receivers
from pipeline.make.receivers.rtklib import is_solution, parts_of_solution, read_solution
from pipeline.make.receivers.unpack import BAG_FOLDER, unpacked
from pipeline.read.ingest.conform import conform, refuse
from pipeline.read.ingest.correct import corrected, corrections_of
from pipeline.read.ingest.mapping import mappings_of
from pipeline.read.ingest.parts import LogPart, parts_of_messages, parts_of_topics
from pipeline.read.ingest.plan import absent_topics
from pipeline.storage import FileDigest, files
from schemas.config import FixSigma, IngestConfig, StreamCorrection
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import STREAMS, IngestNotes, RunLog, Stream


@frozen
class Converted:
    """The run, what could not be used, reason to number, and what the logs consist of."""

    run: RunLog
    dropped: Mapping[str, int]
    parts: tuple[LogPart, ...] = ()

    def made_of(self, logs: Sequence[FileDigest]) -> Converted:
        """The run with the logs that were read for it, and those that it was made of before."""
        listed = dict.fromkeys([*self.run.notes.raw_logs, *((log.name, log.size_bytes, log.sha256) for log in logs)])
        return replace(self, run=replace(self.run, notes=replace(self.run.notes, raw_logs=tuple(listed))))

    def gathered(self) -> Gatherings:
        """The streams, and the corrections that they hold."""
        return replace(gathered_of(self.run, self.dropped), parts=self.parts)


def convert(logs: list[Path], run_id: str, config: IngestConfig | None = None) -> Converted:
    """Receiver logs of one journey as one new run: `gather` and `as_run`.

    Args:
        logs: files of one journey.
        run_id: id of the run.
        config: the section `ingest` of the configuration; None: the defaults.

    Returns:
        The run, and what was left out.

    Raises:
        InputError: no log holds an epoch.
    """
    return as_run(gather(logs, config), run_id)


def as_run(
    logs: Gatherings,
    run_id: str,
    purpose: Purpose | None = None,
    sigmas: FixSigma | None = None,
    correct: Sequence[StreamCorrection] = (),
) -> Converted:
    """Make a new run of what logs hold.

    Args:
        logs: what the logs hold, as `gather` yields it.
        run_id: id of the run.
        purpose: which stream the positions become; None: `gnss`.
        sigmas: standard deviations by kind of fix, where a log states none [m].
        correct: corrections of streams.

    Returns:
        The run, and what was left out.

    Raises:
        InputError: the logs hold no position.
    """
    streams = assigned(logs.streams, purpose or Purpose(), sigmas or FixSigma())
    if "gnss" not in streams:
        raise InputError(
            "no epoch with a time and a position",
            place=run_id,
            found=", ".join(streams) or None,
            expected="GNSS positions, which a new run needs",
            remedy="Convert the log of the receiver first or in the same call." + _reasons(logs.dropped),
        )
    held = logs.corrections_as(purpose or Purpose())
    notes = IngestNotes(damage=logs.damage, corrections=held)
    run = RunLog(run_id, streams["gnss"], notes=notes).with_streams(**streams)
    return Converted(corrected(run, correct, later=True), logs.dropped, logs.parts)


def extended(
    run: RunLog,
    place: Path,
    logs: Gatherings,
    purpose: Purpose,
    sigmas: FixSigma,
    force: bool,
    correct: Sequence[StreamCorrection] = (),
) -> Converted:
    """Add what logs hold to a run; both are corrected first.

    Args:
        run: the run as it stands.
        place: its path, for errors.
        logs: what the logs hold, as `gather` yields it.
        purpose: which stream the positions become.
        sigmas: standard deviations by kind of fix, where a log states none [m].
        force: replace streams that the run has already.
        correct: corrections of streams.

    Returns:
        The run with the streams added, and what was left out.

    Raises:
        InputError: the run has a stream already, or its corrections differ.
    """
    streams = assigned(logs.streams, purpose, sigmas)
    notes = IngestNotes(corrections=logs.corrections_as(purpose))
    bare = RunLog(run.run_id, run.gnss.clear(), notes=notes).with_streams(**streams)
    new = corrected(bare, [made for made in correct if made.stream in streams], later=True)
    old = corrected(run, correct, later=True)
    for name in streams.keys() & set(BY_SOLUTION):
        if old.stream(name) is not None:
            _refuse_unlike(corrections_of(old, name), corrections_of(new, name), name, place)
    whole = added(old, {name: frame for name in streams if (frame := new.stream(name)) is not None}, force, place)
    held = [made for name in STREAMS for made in corrections_of(new if name in streams else old, name)]
    damages = dict.fromkeys(filter(None, [old.notes.damage, logs.damage]))
    notes = replace(old.notes, corrections=tuple(held), damage="; ".join(damages) or None)
    return Converted(replace(whole, notes=notes), logs.dropped, logs.parts)


def _refuse_unlike(
    one: Sequence[StreamCorrection], other: Sequence[StreamCorrection], stream: Stream, place: Path
) -> None:
    """Refuse rows of one stream that were corrected in different ways: nothing would distinguish them."""
    if one != other:
        changes = [", ".join(made.changes for made in held) or "none" for held in (one, other)]
        raise InputError(
            f"receivers of one {stream} with different corrections",
            place=str(place),
            found=" and ".join(changes),
            remedy="Convert them with one configuration; `solution` in [[ingest.correct]] names which it is for.",
        )


@frozen
class Gatherings:
    """The streams of all logs, as the contract has them, and what could not be used: reason to number.

    `corrections`: those that the streams hold already, of logs that are runs of this program; `damage`: what the logs
    lack; `parts`: what they consist of, and what of it is used; `topics`: of
    a bag, those that it holds.
    """

    streams: Streams
    dropped: Mapping[str, int]
    corrections: tuple[StreamCorrection, ...] = ()
    damage: str | None = None
    parts: tuple[LogPart, ...] = ()
    topics: tuple[str, ...] = ()

    def corrections_as(self, purpose: Purpose) -> tuple[StreamCorrection, ...]:
        """Corrections of the streams as they are meant: positions that become the reference are no `gnss` any more."""
        lost = BY_SOLUTION if purpose.stream == "reference" else ()
        return tuple(made for made in self.corrections if made.stream not in lost)


def gathered_of(run: RunLog, dropped: Mapping[str, int]) -> Gatherings:
    """The streams of a run, and the corrections that they hold."""
    streams: Streams = {name: frame for name in STREAMS if (frame := run.stream(name)) is not None}
    return Gatherings(streams, dropped, run.notes.corrections, run.notes.damage)


def gather(
    logs: list[Path], config: IngestConfig | None = None, date: date | None = None, solution: str | None = None
) -> Gatherings:
    """Read what the logs hold.

    Args:
        logs: files, packed or not.
        config: the section `ingest` of the configuration; None: the defaults.
        date: the day of the first sentence, for NMEA logs that hold none.
        solution: the talker or device that is meant, where a log holds the positions of two receivers.

    Returns:
        Streams of positions, or whatever else a mapping or a topic makes a stream of, and what was left out.

    Raises:
        InputError: no log of a receiver holds an epoch, or two logs hold the same time under one solution.
    """
    dropped: Counter[str] = Counter()
    parts: list[tuple[Path, Gatherings]] = []
    unread: list[NoEpochError | UnknownError] = []
    for log in logs:
        files.require_regular(log)
        with unpacked(log, config or IngestConfig()) as inner:
            for plain in inner:
                place = log if plain == log else log / plain.name
                try:
                    parts.append((place, _convert_one(plain, config or IngestConfig(), date, solution)))
                    dropped.update(parts[-1][1].dropped)
                except (NoEpochError, UnknownError) as error:
                    if plain == log and isinstance(error, UnknownError):
                        raise
                    error.place = str(error.place).replace(str(plain), str(place))
                    unread.append(error)
    _refuse_unread(unread, parts)
    _refuse_absent(parts, config or IngestConfig())
    names = {NoEpochError: "log without an epoch", UnknownError: "file of an archive that is no log"}
    dropped.update(names[type(error)] for error in unread)
    _refuse_overlaps(parts)
    damages = [f"{log.name}: {gathered.damage}" for log, gathered in parts if gathered.damage is not None]
    listed = tuple(part for _, gathered in parts for part in gathered.parts)
    return Gatherings(_concat_streams(parts), dict(dropped), _common(parts), "; ".join(damages) or None, listed)


def _refuse_unread(unread: list[NoEpochError | UnknownError], parts: list[tuple[Path, Gatherings]]) -> None:
    """Without any position a log of a receiver that holds none is the error; without any log, a file that is none."""
    found = any("gnss" in gathered.streams for _, gathered in parts)
    for error in unread:
        if not parts or (isinstance(error, NoEpochError) and not found):
            raise error


def _refuse_absent(parts: list[tuple[Path, Gatherings]], config: IngestConfig) -> None:
    """A topic that is mapped is in one of the bags, or its mapping is of a table."""
    bags = [(log, gathered.topics) for log, gathered in parts if gathered.topics]
    if not bags:
        return
    tables = {name for log, gathered in parts if not gathered.topics for name in (log.name, log.stem, "*")}
    held = {name for log, topics in bags for topic in topics for name in (topic, f"{log.name}:{topic}")}
    refuse(absent_topics(held | tables, of_topics(config), ", ".join(str(log) for log, _ in bags)))


def _common(parts: list[tuple[Path, Gatherings]]) -> tuple[StreamCorrection, ...]:
    """What the logs hold of corrections; logs of one stream hold the same."""
    common: dict[Stream, list[StreamCorrection]] = {}
    for log, gathered in parts:
        for name in gathered.streams:
            made = [correction for correction in gathered.corrections if correction.stream == name]
            _refuse_unlike(common.setdefault(name, made), made, name, log)
    return tuple(correction for made in common.values() for correction in made)


class NoEpochError(InputError):
    """A log of a receiver whose messages tell no position with a time."""


class UnknownError(InputError):
    """A file without a message of a known receiver."""


def said_of(reason: str) -> str:
    """What became of the records set apart for a reason: some are noted and used all the same.

    Args:
        reason: why records were set apart.

    Returns:
        `noted` or `not used`.
    """
    return "noted" if re.search(r"\((kept|put right)", reason) else "not used"


def _reasons(dropped: Mapping[str, int]) -> str:
    """What was not used, and why, for people."""
    return "".join(f" Not used: {reason} ({count})." for reason, count in sorted(dropped.items()))


def _concat_streams(parts: list[tuple[Path, Gatherings]]) -> Streams:
    """The streams of all logs, one after the other, as the contract has them."""
    breaches: list[InputError] = []
    collected: dict[Stream, list[pl.DataFrame]] = {}
    for log, gathered in parts:
        for name, frame in gathered.streams.items():
            if frame.height:
                collected.setdefault(name, []).append(conform(frame, name, str(log), breaches))
    refuse(breaches)
    return {name: pl.concat(frames) for name, frames in collected.items()}


# By stream: the column that tells recorders apart, those of which one log may hold one and another the other, what two
# logs would be mixed of, and what to do.
_RECORDERS: dict[Stream, tuple[str, tuple[str, ...], str, str]] = {
    "gnss": (
        "solution",
        (),
        "positions",
        "Convert the second log into the same run with --solution NAME, or --stream reference.",
    ),
    "odometer": (
        "sensor",
        ("distance_m", "speed_mps"),
        "odometer values",
        'Leave one of them out, or name its `sensor` in the mapping; `topic = "LOG.mcap:TOPIC"` is that of one log.',
    ),
}


def _refuse_overlaps(parts: list[tuple[Path, Gatherings]]) -> None:
    """Two recorders under one name would be read as one that jumps between their values."""
    for stream, (key, columns, values, remedy) in _RECORDERS.items():
        logs = [(log, gathered.streams[stream]) for log, gathered in parts if stream in gathered.streams]
        spans = [span for log, frame in logs for span in _spans(log, frame, key, columns)]
        if len(spans) < 2:
            continue
        for (name, _), rows in pl.concat(spans).group_by(key, "column", maintain_order=True):
            for one, two in pairwise(rows.sort("start", "end").iter_rows(named=True)):
                if one["log"] != two["log"] and two["start"] < one["end"]:
                    raise InputError(
                        f"two logs hold {values} of the same time under one {key}",
                        place=f"{one['log']}, {two['log']}",
                        found=f"{key} {name} in both, from {two['start']} on",
                        expected="one recorder",
                        remedy=remedy,
                    )


def _spans(log: Path, frame: pl.DataFrame, key: str, columns: tuple[str, ...]) -> Iterator[pl.DataFrame]:
    """Times from when to when a log holds values, by recorder; a frame for each of the columns."""
    named = frame if key in frame.columns else frame.with_columns(pl.lit("primary").alias(key))
    for column in columns or ("t",):
        if column in named.columns:
            of_column = named.drop_nulls(["t", column]).group_by(pl.col(key).cast(pl.String), maintain_order=True)
            spans = of_column.agg(start=pl.col("t").min(), end=pl.col("t").max())
            yield spans.with_columns(log=pl.lit(str(log)), column=pl.lit(column))


def _convert_one(log: Path, config: IngestConfig, date: date | None, solution: str | None) -> Gatherings:
    """What one file of a receiver gives."""
    if is_bag(log):
        # Corrections are made of the whole, once.
        own = of_topics(config, log)
        bag = read_bag(log, own.model_copy(update={"correct": ()}), partly=True)
        gathered = gathered_of(bag.run, bag.left)
        return replace(
            gathered,
            streams={name: frame for name, frame in gathered.streams.items() if frame.height},
            parts=tuple(parts_of_topics(log.name, bag.topics, bag.run.notes.skipped_topics)),
            topics=tuple(topic.topic for topic in bag.topics),
        )
    if log.suffix.lower() == ".csv" or names_file(config, log):
        table = read_csv(log, config)
        return Gatherings(table.streams, table.left, parts=tuple(table.parts))
    if log.is_dir():
        expected = f"a file, or the folder of a bag with its {BAG_FOLDER}"
        raise InputError("cannot be read: it is a folder", place=str(log), expected=expected)
    content = files.read_bytes(log)
    if is_solution(content):
        return Gatherings(*read_solution(content, log), parts=tuple(parts_of_solution(content, log)))
    if is_gpsd(content):
        streams, dropped = read_gpsd(content, log, solution)
        if streams["gnss"].height:
            return Gatherings(streams, dropped, parts=tuple(parts_of_messages(log.name, objects_in(content))))
    return _read(content, log, date, solution)


def of_topics(config: IngestConfig, log: Path | None = None) -> IngestConfig:
    """Without the mappings of tables, whose names are no topics of a bag; `LOG:TOPIC` of this log is its topic."""
    prefix = "" if log is None else f"{log.name}:"
    kept: dict[str, object] = {
        stream: tuple(
            m.model_copy(update={"topic": m.topic.removeprefix(prefix)})
            for m in mappings_of(config, stream)
            if not m.topic.lower().endswith(TABLES)
        )
        for stream in STREAMS
        if stream != "faults"
    }
    return config.model_copy(update=kept)


def _read(
    content: bytes, log: Path, date: date | None, solution: str | None, left_out: frozenset[str] = frozenset()
) -> Gatherings:
    """The epochs of the protocol that says most; what is damaged or said twice is counted. `left_out`: talkers."""
    dropped: Counter[str] = Counter()
    gathered = {protocol: Gathered() for protocol in _PROTOCOLS}
    gathered[Protocol.NMEA] = nmea.Sentences(left_out=left_out)
    named: Counter[tuple[Protocol, str, bool]] = Counter()
    for frame in frames(content, lambda: dropped.update(["damaged message"]), lambda: dropped.update([_UNCHECKED])):
        is_used = frame.protocol in gathered and _decode(frame, gathered[frame.protocol])
        named[frame.protocol, name_of(frame), is_used] += 1
    twins = {protocol: sees_twins(of) for protocol, of in gathered.items()}
    ubx.settle_times(gathered[Protocol.UBX])
    nmea.settle_days(gathered[Protocol.NMEA], date)
    novatel.settle_source(gathered[Protocol.NOVATEL])
    settled = {protocol: epochs.settled() for protocol, epochs in gathered.items()}
    best = max(settled, key=lambda protocol: _worth(protocol, settled[protocol]))
    for protocol, epochs in settled.items():
        if protocol is best or not settled[best].positions:
            dropped.update(gathered[protocol].dropped)
        elif epochs.positions:
            dropped[f"{protocol} position beside those of {best}"] += epochs.positions
    if not settled[best].epochs:
        raise _no_epoch(content, log, dropped)
    rivals = gathered[best].rivals
    if solution in rivals:
        return _read(content, log, date, None, rivals - {solution})
    if rivals or twins[best] is not None:
        raise two_receivers(str(log), rivals, max(gathered[best].widest_m, twins[best] or 0.0))
    counts = Counter({(name, used and protocol is best): 0 for protocol, name, used in named})
    for (protocol, name, used), count in named.items():
        counts[name, used and protocol is best] += count
    return Gatherings(settled[best].streams(), dropped, parts=tuple(parts_of_messages(log.name, counts)))


def _no_epoch(content: bytes, log: Path, dropped: Mapping[str, int]) -> InputError:
    """What there is in place of positions tells what to change at the receiver."""
    counts = Counter(name_of(frame) for frame in frames(content, lambda: None))
    if not counts:
        head = content[:_HEAD]
        hint = next((hint for pattern, hint in _ALMOST.items() if re.search(pattern, head)), _OTHER)
        return UnknownError(
            "holds no message of a known receiver" if content else "is empty",
            place=str(log),
            expected="UBX, SBF, NMEA, NovAtel, JSON of gpsd, RTKLIB .pos, a bag, or CSV",
            remedy=hint + _reasons(dropped),
        )
    return NoEpochError(
        "no epoch with a time and a position",
        place=str(log),
        found=", ".join(f"{name} ({count})" for name, count in counts.most_common(_MOST_NAMES)),
        expected="UBX NAV-PVT, SBF PVTGeodetic or PVTCartesian, NMEA GGA, GNS or RMC with a date, "
        "NovAtel BESTPOS or INSPVA",
        remedy="Let the receiver record one of these messages, or give the day of NMEA without one by --date."
        + _reasons(dropped),
    )


def _worth(protocol: Protocol, epochs: Epochs) -> int:
    """A receiver that sends NMEA beside its own protocol rounds there, and leaves out how accurate it is."""
    return epochs.positions * (1 if protocol is Protocol.NMEA else 2)


def _decode(frame: Frame, gathered: Gathered) -> bool:
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
        gathered.drop(_UNFIT)
        return True
    try:
        if message is not None:
            decode(gathered, message, frame.content)
    except (AttributeError, OverflowError):  # a message that ends before its fields do, a time beyond all calendars
        gathered.drop(_UNFIT)
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
