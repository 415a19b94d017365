"""Which channel of a log feeds which stream, and how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import dataframely as dy
import polars as pl

from pipeline.ingest.breaches import Breach, refuse
from pipeline.ingest.inventory import stamp_parts
from pipeline.ingest.mcap_model import Channel
from pipeline.ingest.recipes import FIX_TYPE, Recipe, recipe_for, recorded_type
from pipeline.ingest.stamps import LOG_TIME, PUBLISH_TIME, TimeSource, time_source
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import ConfigError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

_STAMPS_BY_CUSTOM = ("header.stamp", "timestamp", "stamp")


@dataclass(frozen=True)
class Sample:
    """A channel with the fields of its first message."""

    channel: Channel
    fields: Mapping[str, str]


@dataclass(frozen=True)
class Source:
    """One channel that feeds a stream: fields to decode, columns and times over them."""

    channel: Channel
    recipe: Recipe
    columns: Mapping[str, pl.Expr]
    times: Mapping[str, TimeSource]
    types: Mapping[str, pl.DataType]
    solution: str | None = None

    @property
    def stream(self) -> Stream:
        return self.recipe.stream


@dataclass(frozen=True)
class Plan:
    """Sources in order of channel, and the topics that nothing is made of with the reason."""

    sources: tuple[Source, ...]
    left_over: Mapping[str, str]


def plan_streams(samples: Sequence[Sample], config: IngestConfig) -> Plan:
    """The configured topics of each stream, else those whose schema is known."""
    refuse(_absent_topics(samples, config))
    breaches: list[Breach] = []
    sources: list[Source] = []
    for stream in STREAMS:
        mappings: tuple[StreamMapping, ...] = getattr(config, stream, ())
        chosen = _configured(samples, stream, mappings) if mappings else _recognised(samples, stream)
        sources += [source for pair in chosen if (source := _source(*pair, breaches)) is not None]
        breaches += _competing(stream, chosen)
    refuse(breaches)
    return Plan(tuple(_with_solutions(sources)), _left_over(samples, sources))


Chosen = tuple[Sample, Recipe, StreamMapping | None]


def _absent_topics(samples: Sequence[Sample], config: IngestConfig) -> list[Breach]:
    topics = sorted({sample.channel.topic for sample in samples})
    file = samples[0].channel.file if samples else "log"
    return [
        Breach(
            f"{file}: topic {mapping.topic}",
            f"is configured for {stream} but has no messages",
            found=", ".join(topics) or "no topics",
            remedy="Correct [ingest] in the configuration; `balise inspect` lists the topics.",
        )
        for stream in STREAMS
        for mapping in getattr(config, stream, ())
        if mapping.topic not in topics
    ]


def _configured(
    samples: Sequence[Sample], stream: Stream, mappings: Sequence[StreamMapping]
) -> list[Chosen]:
    if stream == "gnss":
        _refuse_shared_solutions(mappings)
    return [
        (sample, _mapped_recipe(sample, stream, mapping), mapping)
        for mapping in mappings
        for sample in samples
        if sample.channel.topic == mapping.topic
    ]


def _refuse_shared_solutions(mappings: Sequence[StreamMapping]) -> None:
    """Two receivers under one name would be read as one that jumps between their positions."""
    names = [mapping.solution for mapping in mappings if not _is_supplement_only(mapping)]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                "several topics feed the same solution",
                place=f"[ingest.gnss] solution {name}",
                expected="one name per topic",
                remedy="Set solution in each [[ingest.gnss]].",
            )


def _is_supplement_only(mapping: StreamMapping) -> bool:
    return False


def _mapped_recipe(sample: Sample, stream: Stream, mapping: StreamMapping) -> Recipe:
    """The mapping over the recipe of the schema, if that is one of the same stream."""
    base = recipe_for(sample.channel.schema_name, sample.channel.topic)
    if base is None or base.stream != stream:
        base = Recipe(stream=stream, columns={}, stamps={})
    contract = STREAM_SCHEMAS[stream].columns()
    unknown = sorted((set(mapping.fields) | set(mapping.constants) | set(mapping.factors) - {"t"}) - set(contract))
    if unknown:
        raise ConfigError(
            "is no column of this stream",
            place=f"[ingest.{stream}] topic {mapping.topic}",
            found=", ".join(unknown),
            expected=", ".join(contract),
        )
    columns = dict(base.columns) | {name: pl.col(path) for name, path in mapping.fields.items() if name != "t"}
    columns |= {name: _constant(contract[name], value) for name, value in mapping.constants.items()}
    for name, factor in mapping.factors.items():
        if name in columns:
            columns[name] = columns[name] * factor
    types = {path: recorded_type(contract[name]) for name, path in mapping.fields.items() if name != "t"}
    return replace(base, columns=columns, types=dict(base.types) | types)


def _constant(column: dy.Column, value: str | float | bool) -> pl.Expr:
    return pl.lit(value, dtype=FIX_TYPE if isinstance(column, dy.Enum) else column.dtype)


def _recognised(samples: Sequence[Sample], stream: Stream) -> list[Chosen]:
    """Channels by schema; where this project's own schema is present, it alone."""
    known = [
        (sample, recipe, None)
        for sample in samples
        if (recipe := recipe_for(sample.channel.schema_name, sample.channel.topic)) is not None
        and recipe.stream == stream
    ]
    own = [chosen for chosen in known if chosen[1].own]
    return own or known  # type: ignore[return-value]


def _competing(stream: Stream, chosen: Sequence[Chosen]) -> list[Breach]:
    """Only GNSS may come from several topics: the other streams have no solution to tell them apart."""
    topics = list(dict.fromkeys(sample.channel.topic for sample, _, _ in chosen))
    if stream == "gnss" or len(topics) < 2 or stream == "satellites":
        return []
    return [
        Breach(
            chosen[0][0].channel.file,
            f"several topics could be the {stream}",
            found=", ".join(topics),
            expected="one",
            remedy=f"Choose one by [ingest.{stream}] topic in the configuration.",
        )
    ]


def _source(
    sample: Sample, recipe: Recipe, mapping: StreamMapping | None, breaches: list[Breach]
) -> Source | None:
    """The source, or breaches: a column that the contract demands whose field the messages do not have."""
    contract = STREAM_SCHEMAS[recipe.stream].columns()
    closed = sample.channel.encoding != "json"  # JSON messages may leave keys out one by one
    columns = {}
    for name, expression in recipe.columns.items():
        absent = [path for path in recipe.fields_of(name) if path not in sample.fields]
        if not absent or (not closed and contract[name].nullable):
            columns[name] = expression
        elif (not contract[name].nullable and name != "solution") or (mapping and name in mapping.fields):
            breaches.append(_missing_field(sample, name, absent))
    times = _times(sample, recipe, mapping)
    types = {path: recipe.type_of(path) for name in columns for path in recipe.fields_of(name)}
    for time in times.values():
        types |= time.types
    solution = mapping.solution if mapping else None
    return Source(sample.channel, recipe, columns, times, types, solution)


def _times(sample: Sample, recipe: Recipe, mapping: StreamMapping | None) -> dict[str, TimeSource]:
    """The time of validity, and further times (end of a fault), which look like it and may be absent."""
    (column, path), *others = (recipe.stamps or {"t": ""}).items()
    first = _time(sample, path, mapping)
    return {column: first} | {name: first.of_field(path, other) for name, other in others}


def _missing_field(sample: Sample, column: str, absent: Sequence[str]) -> Breach:
    return Breach(
        sample.channel.place,
        f"has no field {', '.join(absent)} for column {column}",
        found=", ".join(list(sample.fields)[:40]),
        remedy="Map the column by `fields` in [ingest] of the configuration.",
    )


def _time(sample: Sample, path: str, mapping: StreamMapping | None) -> TimeSource:
    """The time of validity: as configured, else the payload's stamp, else the log time."""
    wanted = mapping.time if mapping else "auto"
    if wanted in ("log", "publish"):
        name = LOG_TIME if wanted == "log" else PUBLISH_TIME
        return time_source((name,), {name: "int"}, mapping)
    if wanted.startswith("field:"):
        path = wanted.removeprefix("field:")
        parts = stamp_parts(dict(sample.fields), path)
        if not parts:
            refuse([_missing_field(sample, "t", [path])])
        return time_source(parts, sample.fields, mapping)
    for candidate in (path, *_STAMPS_BY_CUSTOM):
        parts = stamp_parts(dict(sample.fields), candidate)
        if parts:
            return time_source(parts, sample.fields, mapping)
    return time_source((LOG_TIME,), {LOG_TIME: "int"}, mapping)


def _with_solutions(sources: Sequence[Source]) -> list[Source]:
    """Names of solutions: as configured, `primary` for the only topic, else after the topic."""
    topics = {source.channel.topic for source in sources if source.stream == "gnss"}
    return [
        source
        if source.solution is not None or source.stream not in ("gnss", "satellites")
        else replace(source, solution=_named_after(source.channel.topic) if len(topics) > 1 else "primary")
        for source in sources
    ]


def _named_after(topic: str) -> str:
    return topic.strip("/").replace("/", "_") or "primary"


def _left_over(samples: Sequence[Sample], sources: Sequence[Source]) -> dict[str, str]:
    used = {source.channel.topic for source in sources}
    return {
        sample.channel.topic: sample.channel.schema_name or sample.channel.encoding
        for sample in samples
        if sample.channel.topic not in used
    }
