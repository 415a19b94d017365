"""Bags of ROS 1 (`.bag`) and ROS 2 (`.db3`, folders): their messages as an MCAP log, which ingest then reads."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from pipeline.make.receivers.bag_budget import Unpack, budget_of_bag, unpacker_of
from pipeline.read.ingest.describe import (
    Census,
    LogDescription,
    TopicSummary,
    description_of,
    topics_in,
    topics_of,
)
from pipeline.read.ingest.run import read_part
from pipeline.storage.budget import Budget
from pipeline.storage.noted import scratch_folder
from schemas.config import IngestConfig
from schemas.errors import BaliseError, InputError
from schemas.run import RunLog

_HEADER = "std_msgs/msg/Header"
_ENDINGS = (".bag", ".db3")


def is_bag(path: Path) -> bool:
    """Whether a path is a bag, or an MCAP log."""
    return path.suffix.lower() in (*_ENDINGS, ".mcap") or (path / "metadata.yaml").is_file()


class Bag(NamedTuple):
    """All streams of a bag, what was left over, reason to number, and its topics."""

    run: RunLog
    left: dict[str, int]
    topics: tuple[TopicSummary, ...]


def read_bag(path: Path, config: IngestConfig, partly: bool = False) -> Bag:
    """The streams of a bag, by schema name or as `[ingest]` maps its topics; `partly`: of one of several of a run."""
    if path.suffix.lower() == ".mcap":
        census = Census()
        run = read_part([path], config, partly, [census])
        return Bag(*_with_unused_noted(run, {}), topics_in([census], config))
    if path.is_dir() and (declared := read_declaration(path)) is not None and declared.mcap:
        return _read_parts(path, declared, config, partly)
    with scratch_folder() as folder:
        log = folder / "bag.mcap"
        left, counts = _transcribe(path, log, config)
        census = Census()
        try:
            run = read_part([log], config, partly, [census])
            return Bag(
                *_with_unused_noted(_compared_with_declaration(run, path, counts), left), topics_in([census], config)
            )
        except BaliseError as error:
            error.place = None if error.place is None else error.place.replace(str(log), str(path))
            error.message = error.message.replace(str(log), str(path))
            raise


def describe_bag(path: Path, config: IngestConfig) -> LogDescription:
    """Describe a bag; one of which no run can be made is described as far as it can be read."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files)
    try:
        bag = read_bag(path, config)
        return description_of(str(path), "bag", size, bag.topics, bag.run, ())
    except BaliseError as error:
        topics = _topics_without_messages(path, config)
        return description_of(str(path), "bag", size, topics, None, (str(error),))


def _topics_without_messages(path: Path, config: IngestConfig) -> tuple[TopicSummary, ...]:
    """Topics of a bag from its description, without reading its messages if that can be."""
    try:
        if path.is_dir() and (declared := read_declaration(path)) is not None and declared.mcap:
            return topics_of(bag_files(path, declared), config)
        with scratch_folder() as folder:
            log = folder / "bag.mcap"
            _transcribe(path, log, config)
            return topics_of([log], config)
    except BaliseError:
        return ()


class Declared(NamedTuple):
    """What the `metadata.yaml` of a bag folder says that it holds: files in order, all messages and those by topic.

    `mcap`: its files are MCAP logs as they stand, not packed once more.
    """

    mcap: bool
    files: tuple[str, ...]
    messages: int
    topics: dict[str, int]


def read_declaration(folder: Path) -> Declared | None:
    """The declaration of a bag folder; None where there is none, or none that can be read."""
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError:
        return None
    try:
        metadata = YAML(typ="safe", pure=True).load((folder / "metadata.yaml").read_text(encoding="utf-8"))
        bag = metadata["rosbag2_bagfile_information"]
        # Older writers name the folder too.
        names = tuple(PurePosixPath(str(name)).name for name in bag["relative_file_paths"])
        packed = str(bag.get("compression_mode") or "").upper() in ("FILE", "MESSAGE")
        by_topic = bag.get("topics_with_message_count") or ()
        topics = {str(one["topic_metadata"]["name"]): int(one["message_count"]) for one in by_topic}
        mcap = str(bag["storage_identifier"]) == "mcap" and not packed
        return Declared(mcap, names, int(bag.get("message_count") or 0), topics)
    except (OSError, UnicodeDecodeError, YAMLError, LookupError, TypeError, ValueError, AttributeError):
        return None


def bag_files(folder: Path, declared: Declared) -> list[Path]:
    """The files of a bag folder that are there, in order.

    Raises `InputError` where none of them is there.
    """
    files = [folder / name for name in declared.files]
    found = [file for file in files if file.is_file() and file.stat().st_size]
    if not found:
        raise InputError(
            "holds none of the files that its metadata.yaml declares",
            place=str(folder),
            expected=", ".join(declared.files),
            remedy="Copy the whole folder.",
        )
    return found


def _read_parts(folder: Path, declared: Declared, config: IngestConfig, partly: bool) -> Bag:
    """The MCAP files of a bag folder as one run; what is missing makes it partial."""
    found = bag_files(folder, declared)
    counted = [Census() for _ in found]
    run = read_part(found, config, partly, counted)
    damages = [*filter(None, [run.notes.damage]), *_missing_files(folder, declared, found)]
    damages += _topics_with_fewer_messages(declared, run.notes.messages)
    whole = replace(run, notes=replace(run.notes, damage="; ".join(damages) or None))
    return Bag(*_with_unused_noted(whole, {}), topics_in(counted, config))


def _missing_files(folder: Path, declared: Declared, found: Sequence[Path]) -> Iterator[str]:
    """Files that are declared and not there, or hold nothing, and those that are there and not declared."""
    names = [path.name for path in found]
    for name in declared.files:
        if name not in names:
            yield f"{name} is declared and {'empty' if (folder / name).is_file() else 'not there'}"
    yield from _undeclared_files(folder, declared)


def _undeclared_files(folder: Path, declared: Declared) -> Iterator[str]:
    """Files next to a bag that its description does not name."""
    others = sorted(path.name for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    known = {name.removesuffix(".zstd") for name in declared.files}
    yield from (f"{name} is not declared, and not read" for name in others if name not in known)


def _topics_with_fewer_messages(declared: Declared, counts: Mapping[str, int]) -> Iterator[str]:
    """Topics of which fewer messages were found than are declared."""
    lost = {topic: wanted for topic, wanted in sorted(declared.topics.items()) if counts.get(topic, 0) < wanted}
    for topic, wanted in lost.items():
        yield f"holds {counts.get(topic, 0)} of {wanted} messages of {topic} that are declared"
    if not lost and sum(counts.values()) < declared.messages:
        yield f"holds {sum(counts.values())} of {declared.messages} messages that are declared"


def _with_unused_noted(run: RunLog, left: dict[str, int]) -> tuple[RunLog, dict[str, int]]:
    """A run with what was not used of its log."""
    if run.notes.damage is not None:
        left = left | {f"end of the log, {run.notes.damage}": 1}
    return run, left | {f"topic {topic}": 1 for topic in run.notes.skipped_topics}


def _compared_with_declaration(run: RunLog, path: Path, counts: Mapping[str, int]) -> RunLog:
    """The run, partial where its files lack what the folder of the bag declares."""
    declared = read_declaration(path) if path.is_dir() else None
    damages = (
        [] if declared is None else [*_undeclared_files(path, declared), *_topics_with_fewer_messages(declared, counts)]
    )
    if not damages:
        return run
    return replace(run, notes=replace(run.notes, damage="; ".join(damages)))


def _transcribe(path: Path, to: Path, config: IngestConfig) -> tuple[dict[str, int], dict[str, int]]:
    """Write the messages with their definitions; those of a topic whose definition is not known are counted. Also how
    many there are of each topic.
    """
    budget = budget_of_bag(path, config)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"cannot be read without the package {error.name}", place=str(path), remedy="Install the extra `bags`."
        ) from None
    try:
        # Bags of ROS 1 always hold their definitions, older ones of ROS 2 never do.
        known = None if path.suffix.lower() == ".bag" else get_typestore(Stores.LATEST)
        with AnyReader([path], default_typestore=known) as bag:
            return _write_as_mcap(bag, to, unpacker_of(bag, str(path), config), budget)
    except BaliseError:
        raise
    except Exception as error:  # the reader's own errors share no base class
        raise InputError(
            f"is not a whole bag: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
            place=str(path),
            expected="a ROS 1 .bag, a ROS 2 .db3, or the folder of one with its metadata.yaml",
            remedy="`rosbag reindex` or `ros2 bag reindex` repairs bags that were not closed.",
        ) from None


def _write_as_mcap(bag: Any, to: Path, unpack: Unpack, budget: Budget) -> tuple[dict[str, int], dict[str, int]]:
    """Write all messages of a bag as MCAP."""
    from mcap.writer import CompressionType, Writer

    left: dict[str, int] = {}
    counts: Counter[str] = Counter()
    types = bag.typestore if bag.is2 else _without_sequence(bag.typestore)
    with to.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels = {}
        for connection in bag.connections:
            definition = _definition(types, connection.msgtype)
            if definition is None:
                left[f"message on {connection.topic} ({connection.msgtype}), whose definition is not in the bag"] = (
                    connection.msgcount
                )
                counts[connection.topic] += connection.msgcount
                continue
            schema = writer.register_schema(connection.msgtype, "ros2msg", definition.encode())
            channels[connection.id, connection.owner] = writer.register_channel(connection.topic, "cdr", schema)
        for connection, t_ns, raw in bag.messages([c for c in bag.connections if (c.id, c.owner) in channels]):
            counts[connection.topic] += 1
            message = unpack(raw)
            budget.take(len(message))
            data = message if bag.is2 else bytes(types.ros1_to_cdr(message, connection.msgtype))
            writer.add_message(channels[connection.id, connection.owner], t_ns, data, t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return left, dict(counts)


def _without_sequence(known: Any) -> Any:
    """The types of a ROS 1 bag with the header of ROS 2, which has no sequence number: so they are transcribed."""
    from rosbags.typesys import Stores, get_typestore

    types = dict(known.fielddefs)
    constants, fields = types.get(_HEADER, ([], []))
    types |= {_HEADER: (constants, [field for field in fields if field[0] != "seq"])} if _HEADER in types else {}
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _definition(types: Any, name: str) -> str | None:
    """Definition of a message type, if it is known."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return str(types.generate_msgdef(name, ros_version=2)[0])
        except Exception:  # not known to the reader's types
            return None
