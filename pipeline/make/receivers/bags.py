"""Bags of ROS 1 (`.bag`) and ROS 2 (`.db3`, folders): their messages as an MCAP log, which ingest then reads."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import polars as pl

from pipeline.make.receivers.bag_budget import Unpack, budget_of_bag, unpacker_of
from pipeline.read.ingest.run import read_run
from pipeline.storage.budget import Budget
from schemas.config import IngestConfig
from schemas.errors import BaliseError, InputError
from schemas.run import STREAMS, RunLog

_HEADER = "std_msgs/msg/Header"
_ENDINGS = (".bag", ".db3")


def is_bag(path: Path) -> bool:
    """Whether a path is a bag, or an MCAP log."""
    return path.suffix.lower() in (*_ENDINGS, ".mcap") or (path / "metadata.yaml").is_file()


def read_bag(path: Path, config: IngestConfig) -> tuple[RunLog, dict[str, int]]:
    """All streams of a bag, by schema name or as `[ingest]` maps its topics; what was left over."""
    if path.suffix.lower() == ".mcap":
        return _with_rest(read_run(path, config, with_digest=False), {})
    if path.is_dir() and (declared := declared_of(path)) is not None and declared.mcap:
        return _read_parts(path, declared, config)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "bag.mcap"
        left = _transcribe(path, log, config)
        try:
            return _with_rest(read_run(log, config, with_digest=False), left)
        except BaliseError as error:
            error.place = None if error.place is None else error.place.replace(str(log), str(path))
            error.message = error.message.replace(str(log), str(path))
            raise


class Declared(NamedTuple):
    """What the `metadata.yaml` of a bag folder says that it holds: files in order, and messages of each."""

    mcap: bool
    files: tuple[str, ...]
    messages: dict[str, int]


def declared_of(folder: Path) -> Declared | None:
    """The declaration of a bag folder; None where there is none, or none that can be read."""
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError:
        return None
    try:
        told = YAML(typ="safe", pure=True).load((folder / "metadata.yaml").read_text(encoding="utf-8"))
        bag = told["rosbag2_bagfile_information"]
        names = tuple(str(name) for name in bag["relative_file_paths"])
        counts = {str(part["path"]): int(part["message_count"]) for part in bag.get("files") or ()}
        return Declared(str(bag["storage_identifier"]) == "mcap", names, counts)
    except (OSError, UnicodeDecodeError, YAMLError, LookupError, TypeError, ValueError):
        return None


def _read_parts(folder: Path, declared: Declared, config: IngestConfig) -> tuple[RunLog, dict[str, int]]:
    """The MCAP files of a bag folder, one after the other, as one run; what is missing makes it partial.

    Raises `InputError` where none of them is there.
    """
    damages: list[str] = []
    until: list[int] = []
    runs: list[RunLog] = []
    for name in declared.files:
        part = folder / name
        # A name of a folder's own file: what a declaration names elsewhere is not read.
        if Path(name).name != name or not part.is_file():
            damages.append(f"{name} is declared and not there")
            continue
        run = read_run(part, config, with_digest=False)
        if run.notes.damage is not None:
            damages.append(f"{name}: {run.notes.damage}")
        if run.notes.partial_until_ns is not None:
            until.append(run.notes.partial_until_ns)
        count = message_count(part)
        if (wanted := declared.messages.get(name)) is not None and count is not None and count < wanted:
            damages.append(f"{name} holds {count} of {wanted} messages that are declared")
        runs.append(run)
    if not runs:
        raise InputError(
            "holds none of the files that its metadata.yaml declares",
            place=str(folder),
            expected=", ".join(declared.files),
            remedy="Copy the whole folder.",
        )
    streams = {name: _one_after_the_other([run.stream(name) for run in runs]) for name in STREAMS}
    notes = runs[0].notes
    skipped = tuple(dict.fromkeys(topic for run in runs for topic in run.notes.skipped_topics))
    whole = replace(
        runs[0].with_streams(**streams),
        notes=replace(
            notes,
            damage="; ".join(damages) or None,
            partial_until_ns=min(until, default=None),
            skipped_topics=skipped,
        ),
    )
    return _with_rest(whole, {})


def _one_after_the_other(frames: list[pl.DataFrame | None]) -> pl.DataFrame | None:
    there = [frame for frame in frames if frame is not None]
    return pl.concat(there) if there else None


def message_count(log: Path) -> int | None:
    """How many messages the summary of an MCAP file declares; None without a summary."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with log.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, OSError, ValueError):
        return None
    return None if summary is None or summary.statistics is None else int(summary.statistics.message_count)


def _with_rest(run: RunLog, left: dict[str, int]) -> tuple[RunLog, dict[str, int]]:
    if run.notes.damage is not None:
        left = left | {f"end of the log, {run.notes.damage}": 1}
    return run, left | {f"topic {topic}": 1 for topic in run.notes.skipped_topics}


def _transcribe(path: Path, to: Path, config: IngestConfig) -> dict[str, int]:
    """Write the messages with their definitions; those of a topic whose definition is not known are counted."""
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
            return _write(bag, to, unpacker_of(bag, str(path), config), budget)
    except BaliseError:
        raise
    except Exception as error:  # the reader's own errors share no base class
        raise InputError(
            f"is not a whole bag: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
            place=str(path),
            expected="a ROS 1 .bag, a ROS 2 .db3, or the folder of one with its metadata.yaml",
            remedy="`rosbag reindex` or `ros2 bag reindex` repairs bags that were not closed.",
        ) from None


def _write(bag: Any, to: Path, unpack: Unpack, budget: Budget) -> dict[str, int]:
    from mcap.writer import CompressionType, Writer

    left: dict[str, int] = {}
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
                continue
            schema = writer.register_schema(connection.msgtype, "ros2msg", definition.encode())
            channels[connection.id, connection.owner] = writer.register_channel(connection.topic, "cdr", schema)
        for connection, t_ns, raw in bag.messages([c for c in bag.connections if (c.id, c.owner) in channels]):
            message = unpack(raw)
            budget.take(len(message))
            data = message if bag.is2 else bytes(types.ros1_to_cdr(message, connection.msgtype))
            writer.add_message(channels[connection.id, connection.owner], t_ns, data, t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return left


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return str(types.generate_msgdef(name, ros_version=2)[0])
        except Exception:  # not known to the reader's types
            return None
