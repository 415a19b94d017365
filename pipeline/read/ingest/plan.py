"""Which streams a channel of a log may feed, how its messages make rows, and which of the channels do feed them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain

import polars as pl

from pipeline.read.ingest.conform import DEFAULTS, refuse
from pipeline.read.ingest.fields import definition_of, may_follow
from pipeline.read.ingest.mapping import mapped_recipe, mappings_of
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.recipe import Recipe
from pipeline.read.ingest.recipes import recipes_for
from pipeline.read.ingest.stamps import (
    LOG_TIME,
    PUBLISH_TIME,
    TIME_KINDS,
    CivilTime,
    TimeSource,
    stamp_parts,
    time_source,
)
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import ConfigError, InputError
from schemas.frozen import frozen
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

_POSITION = ("latitude_deg", "longitude_deg")
_FRAMES = ("child_frame_id", "header.frame_id", "frame_id")
_WORLD = r"(map|odom|world|earth|ecef|enu|ned|utm|wgs84|global|local|navigation|nav|inertial|gps|gnss|navsat)(_.*)?"
_USUAL_STAMPS = ("header.stamp", "timestamp", "stamp")


@frozen
class Sample:
    """A channel with the fields of its first message and their kinds."""

    channel: Channel
    fields: Mapping[str, str]


@frozen
class Source:
    """One channel that feeds a stream: fields to decode, columns and times over them.

    `doubtful` are fields that the first message lacks and some message must have, by column. `implicit` are
    nullable columns of this project's protobuf messages whose field cannot be left out: 0 may say that it was. `frame`:
    the field that names the frame of a speed, empty where none has to be looked at.
    """

    channel: Channel
    recipe: Recipe
    mapping: StreamMapping | None
    columns: Mapping[str, pl.Expr]
    times: Mapping[str, TimeSource | CivilTime]
    types: Mapping[str, pl.DataType]
    breaches: Sequence[InputError]
    doubtful: Mapping[str, str]
    implicit: Sequence[str]
    frame: str = ""

    @property
    def needs_frame(self) -> bool:
        """Whether the field that names the frame of a speed makes a column, too."""
        paths = chain.from_iterable(column.meta.root_names() for column in self.columns.values())
        return self.frame in (*paths, *self.recipe.key)

    @property
    def is_dropped(self) -> bool:
        """Whether it is a driver's optional message that is not as its recipe knows it: left over, not an error."""
        optional = self.recipe.stream == "satellites" or self.recipe.supplement
        return bool(self.breaches) and optional and self.mapping is None and not self.recipe.own


def sources_of(sample: Sample, config: IngestConfig) -> list[Source]:
    """What the channel may feed: by configuration, else by its schema."""
    known = _source_by_schema(sample)
    sources: list[Source] = []
    for stream in STREAMS:
        mappings = mappings_of(config, stream)
        sources += [mapped_source(sample, stream, m) for m in mappings if m.topic == sample.channel.topic]
        if known is not None and known.recipe.stream == stream and _needs_no_mapping(known.recipe, bool(mappings)):
            sources.append(known)
    return sources


def _needs_no_mapping(recipe: Recipe, is_mapped: bool) -> bool:
    """Whether the schema alone makes the stream, in a log of whose stream some topic `is_mapped` or not."""
    return not recipe.only_mapped and (not is_mapped or recipe.supplement)


def is_candidate(channel: Channel, config: IngestConfig) -> bool:
    """Whether anything may be made of the channel at all."""
    mapped = any(mapping.topic == channel.topic for stream in STREAMS for mapping in mappings_of(config, stream))
    return mapped or any(not recipe.only_mapped for recipe in recipes_for(channel.schema_name, channel.topic))


def _source_by_schema(sample: Sample) -> Source | None:
    """The source by the first recipe of the schema whose fields are all there, else by the first at all."""
    known = [_make_source(sample, recipe) for recipe in recipes_for(sample.channel.schema_name, sample.channel.topic)]
    return next((source for source in known if not source.breaches), known[0] if known else None)


def mapped_source(sample: Sample, stream: Stream, mapping: StreamMapping) -> Source:
    """The source that the configuration makes of a channel."""
    if mapping.time_zone is not None and sample.channel.encoding != "csv":
        raise InputError("time_zone is for CSV: other logs count their times", place=sample.channel.place)
    known = _source_by_schema(sample)
    recipe = mapped_recipe(known.recipe if known else None, sample.fields, stream, mapping)
    return _make_source(sample, recipe, mapping)


def _make_source(sample: Sample, recipe: Recipe, mapping: StreamMapping | None = None) -> Source:
    """How the channel's messages make rows; `breaches` tells what they lack."""
    contract = STREAM_SCHEMAS[recipe.stream].columns()
    closed = sample.channel.encoding != "json"  # JSON messages may leave keys out one by one
    columns: dict[str, pl.Expr] = {}
    breaches: list[InputError] = []
    doubtful: dict[str, str] = {}
    for name, expression in recipe.columns.items():
        absent = [path for path in recipe.fields_of(name) if not _has_field(sample, recipe, path)]
        wanted = mapping is not None and name in mapping.fields
        optional = not closed and (contract[name].nullable or name in DEFAULTS)
        if optional or all(_may_have_field(sample, recipe, path) for path in absent):
            columns[name] = expression
            if absent and (wanted or (name in _POSITION and not recipe.own)):
                doubtful[name] = absent[0]
        elif wanted or not (contract[name].nullable or name in DEFAULTS):
            breaches.append(missing_field_error(sample.channel, sample.fields, name, absent))
    if recipe.rows and sample.channel.encoding != "cdr":
        breaches.append(InputError("holds arrays, which are read of cdr only", place=sample.channel.place))
    times = _time_sources(sample, recipe, mapping, breaches)
    paths = dict.fromkeys([*recipe.key, *(path for name in columns for path in recipe.fields_of(name))])
    types = {path: recipe.type_of(path) for path in paths}
    for time in times.values():
        types |= time.types
    implicit = _without_presence(sample.channel, columns) if recipe.own else ()
    frame = _speed_frame_field(sample, columns.get("speed_mps"), mapping, breaches)
    types |= {frame: pl.String()} if frame else {}
    return Source(sample.channel, recipe, mapping, columns, times, types, breaches, doubtful, implicit, frame)


def _speed_frame_field(
    sample: Sample, speed: pl.Expr | None, mapping: StreamMapping | None, breaches: list[InputError]
) -> str:
    """The field with the frame of a speed that is one component of a vector; empty where the mapping gives it."""
    roots = [] if speed is None else speed.meta.root_names()
    if len(roots) != 1 or not re.search(r"\.[xyz]$", roots[0]):
        return ""
    if mapping is not None and mapping.frame is not None:
        if is_world_frame(mapping.frame):
            breaches.append(world_frame_error(sample.channel, roots[0], mapping.frame))
        return ""
    # A twist is in the frame of the child where a message has one (REP 105, nav_msgs/Odometry).
    return next((name for name in _FRAMES if sample.fields.get(name) == "text"), "")


def is_world_frame(frame: str) -> bool:
    """Whether a frame does not turn with the train, by the names that REP 105 and drivers use."""
    return re.fullmatch(_WORLD, frame.strip("/ ").rpartition("/")[2].lower()) is not None


def world_frame_error(channel: Channel, path: str, frame: str) -> InputError:
    """A component of a velocity in the world, which is no speed of the train."""
    vector = path.rpartition(".")[0]
    return InputError(
        f"{path} is one component of a velocity in a frame that does not turn with the train",
        place=channel.place,
        found=f"frame {frame!r}",
        expected="a frame of the vehicle, such as base_link",
        remedy=f'Write fields = {{ speed_mps = "norm({vector})" }} for its length, which is never negative, or, if the '
        'component is along the train all the same, frame = "base_link" in this mapping.',
    )


def _without_presence(channel: Channel, columns: Iterable[str]) -> tuple[str, ...]:
    """Columns whose protobuf field has its default where it was not set (proto3 without `optional`)."""
    if channel.encoding != "protobuf":
        return ()
    known = definition_of(channel).DESCRIPTOR.fields_by_name
    return tuple(name for name in columns if name in known and not known[name].has_presence)


def _has_field(sample: Sample, recipe: Recipe, path: str) -> bool:
    """Whether the first message has the field of a path."""
    return path in sample.fields or f"{recipe.rows}[0].{path}" in sample.fields


def _may_have_field(sample: Sample, recipe: Recipe, path: str) -> bool:
    """Whether later messages may have the field: the first says nothing of elements of an array that is empty in it."""
    in_element = f"{recipe.rows}[0].{path}"
    return may_follow(sample.channel, path) or (bool(recipe.rows) and may_follow(sample.channel, in_element))


def missing_field_error(channel: Channel, fields: Iterable[str], column: str, absent: Sequence[str]) -> InputError:
    """The error for a column whose fields the messages lack."""
    return InputError(
        f"has no field {', '.join(absent)} for column {column}",
        place=channel.place,
        found=", ".join(list(fields)[:40]) or None,
        remedy="Name the field of this column in `fields` of [ingest] in the configuration.",
    )


def _time_sources(
    sample: Sample, recipe: Recipe, mapping: StreamMapping | None, breaches: list[InputError]
) -> dict[str, TimeSource | CivilTime]:
    """The time of validity, and further times (end of a fault), which look like it and may be absent."""
    if recipe.time is not None and (mapping is None or mapping.time == "auto"):
        return {"t": recipe.time}
    (column, path), *others = (recipe.stamps or {"t": ""}).items()
    first = _time_source(sample, path, mapping, breaches)
    extra = {name: first.of_field(path, other) for name, other in others}
    return {column: first, **extra}


def _time_source(sample: Sample, path: str, mapping: StreamMapping | None, breaches: list[InputError]) -> TimeSource:
    """The time of validity: as configured, else the payload's stamp, else the log time."""
    wanted = mapping.time if mapping else "auto"
    log_time = time_source((LOG_TIME,), {LOG_TIME: "int"}, mapping)
    if wanted == "log":
        return log_time
    if wanted == "publish":
        return time_source((PUBLISH_TIME,), {PUBLISH_TIME: "int"}, mapping)
    named = wanted.removeprefix("field:") if wanted != "auto" else mapping.fields.get("t") if mapping else None
    for candidate in (named,) if named else (path, *_USUAL_STAMPS):
        parts = stamp_parts(sample.fields, candidate)
        unfit = [sample.fields[part] for part in parts if sample.fields[part] not in TIME_KINDS]
        if parts and not unfit:
            return time_source(parts, sample.fields, mapping)
        if unfit and named:
            place = f"{sample.channel.place}: field {candidate}"
            breaches.append(InputError("is not a time", place=place, found=unfit[0], expected="numbers or text"))
            return log_time
    if named:
        breaches.append(missing_field_error(sample.channel, sample.fields, "t", [named]))
    return log_time


def settle_sources(
    sources: Sequence[Source], topics: Sequence[str], config: IngestConfig, file: str, partly: bool = False
) -> list[Source]:
    """The sources that stand, once all channels are known; raises for what is missing or in doubt.

    `partly`: of one of several logs, in which not every topic need be.
    """
    breaches = [] if partly else absent_topics(topics, config, file)
    kept: list[Source] = []
    for stream in STREAMS:
        chosen = _preferred_sources([s for s in sources if s.recipe.stream == stream and not s.is_dropped])
        if stream == "gnss":
            _refuse_shared_solutions(chosen)
        elif stream != "satellites":
            breaches += _competing_sources(stream, chosen, file)
        breaches += [breach for source in chosen for breach in source.breaches]
        kept += chosen
    refuse(breaches)
    return kept


def absent_topics(topics: Collection[str], config: IngestConfig, file: str) -> list[InputError]:
    """Mappings whose topic is not among those of the log."""
    return [
        InputError(
            f"is configured for {stream} but has no messages",
            place=f"{file}: topic {mapping.topic}",
            found=", ".join(sorted(set(topics))) or "no topics",
            remedy="Correct [ingest] in the configuration; `balise inspect` lists the topics.",
        )
        for stream in STREAMS
        for mapping in mappings_of(config, stream)
        if mapping.topic not in topics
    ]


def _preferred_sources(sources: Sequence[Source]) -> list[Source]:
    """The sources to read: this project's own schema alone where it is present.

    A supplement only with what it adds to.
    """
    of_project = [source for source in sources if source.recipe.own]
    if of_project:
        return of_project
    return list(sources) if any(not source.recipe.supplement for source in sources) else []


def _refuse_shared_solutions(sources: Sequence[Source]) -> None:
    """Two receivers under one name would be read as one that jumps between their positions."""
    topics: dict[str, str] = {}
    for source in sources:
        name = source.mapping.solution if source.mapping and not source.recipe.supplement else None
        if name is not None and topics.setdefault(name, source.channel.topic) != source.channel.topic:
            raise ConfigError(
                "several topics feed the same solution",
                place=f"[ingest.gnss] solution {name}",
                found=f"{topics[name]}, {source.channel.topic}",
                expected="one name per topic",
                remedy="Give each [[ingest.gnss]] a `solution` of its own.",
            )


def _competing_sources(stream: Stream, sources: Sequence[Source], file: str) -> list[InputError]:
    """GNSS may come from several topics, and odometers of which each names its sensor; nothing tells others apart."""
    topics = list(dict.fromkeys(source.channel.topic for source in sources))
    sensors = {source.mapping.constants.get("sensor") for source in sources if source.mapping}
    if len(topics) < 2 or (stream == "odometer" and None not in sensors and len(sensors) == len(topics)):
        return []
    return [
        InputError(
            f"several topics could be the {stream}",
            place=file,
            found=", ".join(topics),
            expected="one",
            remedy=f"Choose one with `topic` in [ingest.{stream}] of the configuration"
            + (", or give each topic `constants = {sensor = ...}` of its own." if stream == "odometer" else "."),
        )
    ]


def solution_of(source: Source, settled: Sequence[Source]) -> str | None:
    """The name of a solution: as configured, `primary` for the only topic, else after the topic."""
    if source.recipe.stream not in ("gnss", "satellites"):
        return None
    if source.mapping and source.mapping.solution is not None:
        return source.mapping.solution
    whole = [other for other in settled if other.recipe.stream == "gnss" and not other.recipe.supplement]
    if len({other.channel.topic for other in whole}) < 2:
        return "primary"
    return source.channel.topic.strip("/").replace("/", "_") or "primary"
