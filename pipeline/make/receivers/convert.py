"""Receiver logs as a run: UBX, SBF, NMEA, NovAtel, RTKLIB, bags, or CSV with a column mapping."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date
from itertools import pairwise
from pathlib import Path

import polars as pl

from pipeline.make.receivers.adding import BY_SOLUTION, Purpose, Streams, add_streams, assign_purpose
from pipeline.make.receivers.bags import is_bag, read_bag
from pipeline.make.receivers.csv import TABLES, maps_file, read_csv
from pipeline.make.receivers.gpsd import count_objects, is_gpsd, read_gpsd
from pipeline.make.receivers.messages import NoEpochError, UnknownError, read_messages, reasons_text
from pipeline.make.receivers.rtklib import is_solution, parts_of_solution, read_solution
from pipeline.make.receivers.unpack import BAG_FOLDER, unpacked_logs
from pipeline.read.ingest.conform import conform, refuse
from pipeline.read.ingest.correct import correct_run, corrections_of
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

    def as_gatherings(self) -> Gatherings:
        """The streams, and the corrections that they hold."""
        return replace(gatherings_of_run(self.run, self.dropped), parts=self.parts)


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
    streams = assign_purpose(logs.streams, purpose or Purpose(), sigmas or FixSigma())
    if "gnss" not in streams:
        raise InputError(
            "no epoch with a time and a position",
            place=run_id,
            found=", ".join(streams) or None,
            expected="GNSS positions, which a new run needs",
            remedy="Convert the log of the receiver first or in the same call." + reasons_text(logs.dropped),
        )
    held = logs.corrections_as(purpose or Purpose())
    notes = IngestNotes(damage=logs.damage, corrections=held)
    run = RunLog(run_id, streams["gnss"], notes=notes).with_streams(**streams)
    return Converted(correct_run(run, correct, later=True), logs.dropped, logs.parts)


def extend_run(
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
    streams = assign_purpose(logs.streams, purpose, sigmas)
    notes = IngestNotes(corrections=logs.corrections_as(purpose))
    bare = RunLog(run.run_id, run.gnss.clear(), notes=notes).with_streams(**streams)
    new = correct_run(bare, [made for made in correct if made.stream in streams], later=True)
    old = correct_run(run, correct, later=True)
    for name in streams.keys() & set(BY_SOLUTION):
        if old.stream(name) is not None:
            _refuse_unlike(corrections_of(old, name), corrections_of(new, name), name, place)
    whole = add_streams(old, {name: frame for name in streams if (frame := new.stream(name)) is not None}, force, place)
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
    lack; `parts`: what they consist of, and what of it is used; `topics`: of a bag, those that it holds.
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


def gatherings_of_run(run: RunLog, dropped: Mapping[str, int]) -> Gatherings:
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
        with unpacked_logs(log, config or IngestConfig()) as inner:
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
    _refuse_unreadable(unread, parts)
    _refuse_absent_topics(parts, config or IngestConfig())
    names = {NoEpochError: "log without an epoch", UnknownError: "file of an archive that is no log"}
    dropped.update(names[type(error)] for error in unread)
    _refuse_overlaps(parts)
    damages = [f"{log.name}: {gathered.damage}" for log, gathered in parts if gathered.damage is not None]
    listed = tuple(part for _, gathered in parts for part in gathered.parts)
    return Gatherings(
        _concat_streams(parts), dict(dropped), _common_corrections(parts), "; ".join(damages) or None, listed
    )


def _refuse_unreadable(unread: list[NoEpochError | UnknownError], parts: list[tuple[Path, Gatherings]]) -> None:
    """Refuse logs that hold no position, with the error of a receiver's log.

    Without any log, that of a file that is none.
    """
    found = any("gnss" in gathered.streams for _, gathered in parts)
    for error in unread:
        if not parts or (isinstance(error, NoEpochError) and not found):
            raise error


def _refuse_absent_topics(parts: list[tuple[Path, Gatherings]], config: IngestConfig) -> None:
    """Refuse mappings of topics that are in none of the bags, unless they are of a table."""
    bags = [(log, gathered.topics) for log, gathered in parts if gathered.topics]
    if not bags:
        return
    tables = {name for log, gathered in parts if not gathered.topics for name in (log.name, log.stem, "*")}
    held = {name for log, topics in bags for topic in topics for name in (topic, f"{log.name}:{topic}")}
    refuse(absent_topics(held | tables, mappings_of_topics(config), ", ".join(str(log) for log, _ in bags)))


def _common_corrections(parts: list[tuple[Path, Gatherings]]) -> tuple[StreamCorrection, ...]:
    """Corrections that the logs hold; logs of one stream hold the same."""
    common: dict[Stream, list[StreamCorrection]] = {}
    for log, gathered in parts:
        for name in gathered.streams:
            made = [correction for correction in gathered.corrections if correction.stream == name]
            _refuse_unlike(common.setdefault(name, made), made, name, log)
    return tuple(correction for made in common.values() for correction in made)


def words_for_dropped(reason: str) -> str:
    """What became of the records set apart for a reason: some are noted and used all the same.

    Args:
        reason: why records were set apart.

    Returns:
        `noted` or `not used`.
    """
    return "noted" if re.search(r"\((kept|put right)", reason) else "not used"


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
    """Refuse logs of one name whose times overlap: they would be read as one recorder that jumps between two."""
    for stream, (key, columns, values, remedy) in _RECORDERS.items():
        logs = [(log, gathered.streams[stream]) for log, gathered in parts if stream in gathered.streams]
        spans = [span for log, frame in logs for span in _recorded_spans(log, frame, key, columns)]
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


def _recorded_spans(log: Path, frame: pl.DataFrame, key: str, columns: tuple[str, ...]) -> Iterator[pl.DataFrame]:
    """Per recorder and column a frame of the begin and end of the times at which a log holds values."""
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
        own = mappings_of_topics(config, log)
        bag = read_bag(log, own.model_copy(update={"correct": ()}), partly=True)
        gathered = gatherings_of_run(bag.run, bag.left)
        return replace(
            gathered,
            streams={name: frame for name, frame in gathered.streams.items() if frame.height},
            parts=tuple(parts_of_topics(log.name, bag.topics, bag.run.notes.skipped_topics)),
            topics=tuple(topic.topic for topic in bag.topics),
        )
    if log.suffix.lower() == ".csv" or maps_file(config, log):
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
            return Gatherings(streams, dropped, parts=tuple(parts_of_messages(log.name, count_objects(content))))
    found, left, parts = read_messages(content, log, date, solution)
    return Gatherings(found, left, parts=parts)


def mappings_of_topics(config: IngestConfig, log: Path | None = None) -> IngestConfig:
    """The configuration without the mappings of tables, whose names are no topics of a bag.

    Of this log `LOG:TOPIC` becomes its topic.
    """
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
