"""What a log holds, what would be made of it, and what is left over: for `balise inspect`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.read.ingest.fields import fields_of
from pipeline.read.ingest.guesses import COLUMNS, ORIGIN, WORDS, columns_in, first_fitting, mapping_lines, word_of
from pipeline.read.ingest.mcap_block import Block, Messages
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.mcap_run import LARGEST_MESSAGE, walk_log
from pipeline.read.ingest.plan import Sample, sources_of
from pipeline.read.ingest.recipes import recipes_for
from pipeline.read.ingest.run import read_run
from pipeline.stages.clean.clean import StreamCounts, count_stamps
from pipeline.stages.epochs.clock import GAP_PERIODS
from pipeline.storage import files
from pipeline.storage.address import Address, join, name_of
from schemas.config import IngestConfig
from schemas.errors import BaliseError, InputError
from schemas.frozen import frozen
from schemas.run import STREAMS, IngestNotes, RunLog, Stream

_MOST_SAMPLES = 1000  # topics whose fields are looked for: each takes the time of parsing its schema


@frozen
class StreamSummary:
    """One stream, of GNSS one solution: `rate_hz` from the median step, gaps longer than 1.5 steps."""

    stream: Stream
    solution: str | None
    rows: int
    t_start_ns: int | None
    t_end_ns: int | None
    rate_hz: float | None
    gaps: int
    longest_gap_s: float | None
    duplicates: int
    out_of_order: int
    fix_mix: Mapping[str, int]
    columns: tuple[str, ...]


@frozen
class TopicSummary:
    """One topic of an MCAP file; `mapping` is stream column to recorded fields, empty where left over."""

    topic: str
    schema: str
    encoding: str
    messages: int
    rate_hz: float | None
    stream: Stream | None
    mapping: Mapping[str, str]
    fields: Mapping[str, str]
    remark: str = ""


@frozen
class LogDescription:
    """What `balise inspect` shows of a log; `problems` is what keeps it from being replayed."""

    path: str
    kind: str
    size_bytes: int
    streams: tuple[StreamSummary, ...]
    topics: tuple[TopicSummary, ...]
    left_over: tuple[str, ...]
    notes: IngestNotes
    problems: tuple[str, ...]
    starting_config: str
    run: RunLog | None = None


def describe_log(path: Address, config: IngestConfig) -> LogDescription:
    """Describe a run; a log that cannot be replayed is described as far as it can be read."""
    is_mcap = name_of(path).endswith(".mcap")
    topics = topics_of([path], config) if is_mcap else ()
    parts = [path] if is_mcap else [join(path, name) for name in files.list_dir(path) if name.endswith(".parquet")]
    run: RunLog | None = None
    problems: tuple[str, ...] = ()
    try:
        run = read_run(path, config, with_digest=False)
    except BaliseError as error:
        problems = (str(error),)
    size = sum(files.size_of(file) for file in parts)
    return description_of(str(path), "mcap" if is_mcap else "parquet", size, topics, run, problems)


def description_of(
    path: str,
    kind: str,
    size_bytes: int,
    topics: tuple[TopicSummary, ...],
    run: RunLog | None,
    problems: tuple[str, ...],
) -> LogDescription:
    """What there is to say of a log: of its topics, and of what was read of it, or why nothing was."""
    notes = run.notes if run else IngestNotes()
    left = tuple(topic.topic for topic in topics if topic.stream is None) or notes.skipped_topics
    return LogDescription(
        path=path,
        kind=kind,
        size_bytes=size_bytes,
        streams=tuple(_stream_summaries(run)) if run else (),
        topics=topics,
        left_over=left,
        notes=notes,
        problems=problems,
        starting_config=starting_config(topics),
        run=run,
    )


def _stream_summaries(run: RunLog) -> Iterator[StreamSummary]:
    """Summaries of all streams, of GNSS by solution."""
    for stream in STREAMS:
        if (frame := run.stream(stream)) is not None:
            parts = frame.partition_by("solution", maintain_order=True) if stream == "gnss" else [frame]
            yield from (_stream_summary(stream, part) for part in parts)


def _stream_summary(stream: Stream, frame: pl.DataFrame) -> StreamSummary:
    """Times, rates, gaps and kinds of fix of one stream."""
    # Satellites share the time of their epoch: an epoch is one step.
    t_ns = frame.to_series(0).to_physical().drop_nulls().to_numpy()
    ordered = np.diff(np.unique(t_ns))
    step = float(np.median(ordered)) if len(ordered) else None
    stamps = count_stamps(stream, frame) if stream != "faults" else StreamCounts()
    late = ordered[ordered > GAP_PERIODS * step] if step else ordered[:0]
    mix = frame["fix"].value_counts().sort("fix") if stream == "gnss" else None
    return StreamSummary(
        stream=stream,
        solution=frame["solution"][0] if stream == "gnss" else None,
        rows=frame.height,
        t_start_ns=int(t_ns.min()) if len(t_ns) else None,
        t_end_ns=int(t_ns.max()) if len(t_ns) else None,
        rate_hz=1e9 / step if step else None,
        gaps=len(late),
        longest_gap_s=float(late.max()) / 1e9 if len(late) else None,
        duplicates=stamps.duplicates,
        out_of_order=stamps.out_of_order,
        fix_mix=dict(mix.iter_rows()) if mix is not None else {},
        columns=tuple(name for name in frame.columns if frame[name].null_count() < frame.height),
    )


@dataclass
class _ChannelCounts:
    """What the walk has counted of one channel."""

    channel: Channel
    fields: Mapping[str, str]
    messages: int = 0
    span_ns: list[int] = field(default_factory=list)


class Census:
    """Counts messages of all channels and looks at the first of each."""

    def __init__(self) -> None:
        self.counts: dict[int, _ChannelCounts] = {}

    def add(self, block: Block, channels: Mapping[int, Channel]) -> None:
        """Count these messages, and look at the first of each channel."""
        for channel_id, messages in block.items():
            if channel_id not in self.counts:
                fields = _fields(channels[channel_id], messages) if len(self.counts) < _MOST_SAMPLES else {}
                self.counts[channel_id] = _ChannelCounts(channels[channel_id], fields)
            counts = self.counts[channel_id]
            times = messages.log_time
            counts.messages += len(messages)
            counts.span_ns += [int(times.min()), int(times.max())]


def _fields(channel: Channel, messages: Messages) -> Mapping[str, str]:
    """The fields of the first message; none of pictures and point clouds, which are too large to look into."""
    if messages.length[0] > LARGEST_MESSAGE:
        return {}
    try:
        return fields_of(channel, messages)
    except InputError:
        return {}


def topics_of(paths: Sequence[Address], config: IngestConfig) -> tuple[TopicSummary, ...]:
    """All topics of a log, in one or several files, as far as it can be read; of damage it says nothing."""
    return topics_in([_count_log(path, config) for path in paths], config)


def topics_in(logs: Sequence[Census], config: IngestConfig) -> tuple[TopicSummary, ...]:
    """All topics that were counted, in one or several files of a log."""
    if len(logs) == 1:
        return tuple(_topic_summary(logs[0].counts[channel_id], config) for channel_id in sorted(logs[0].counts))
    joined: dict[tuple[str, str, str], _ChannelCounts] = {}
    for counted in (counted for census in logs for counted in census.counts.values()):
        key = (counted.channel.topic, counted.channel.schema_name, counted.channel.encoding)
        before = joined.setdefault(key, _ChannelCounts(counted.channel, counted.fields))
        before.messages += counted.messages
        before.span_ns += counted.span_ns
    return tuple(_topic_summary(joined[key], config) for key in sorted(joined))


def _count_log(path: Address, config: IngestConfig) -> Census:
    """Counts of a log as far as it can be walked."""
    census = Census()
    with suppress(InputError):
        walk_log(path, config, census)
    return census


def _topic_summary(counted: _ChannelCounts, config: IngestConfig) -> TopicSummary:
    """What would be made of a topic."""
    sample = Sample(counted.channel, counted.fields)
    span_s = (max(counted.span_ns) - min(counted.span_ns)) / 1e9
    sources = sources_of(sample, config) if counted.fields else []
    source = next((source for source in sources if not source.is_dropped), None)
    mapping = {}
    if source is not None:
        mapping = {name: " + ".join(time.fields) for name, time in source.times.items()}
        mapping |= {
            name: ", ".join(dict.fromkeys(expression.meta.root_names())) or "constant"
            for name, expression in source.columns.items()
        }
    return TopicSummary(
        topic=counted.channel.topic,
        schema=counted.channel.schema_name,
        encoding=counted.channel.encoding,
        messages=counted.messages,
        rate_hz=(counted.messages - 1) / span_s if span_s > 0 else None,
        stream=source.recipe.stream if source else None,
        mapping=mapping,
        fields=counted.fields,
        remark=source.recipe.remark if source else "",
    )


def starting_config(topics: Sequence[TopicSummary]) -> str:
    """Configuration text that maps what is left over, as far as names allow a guess; to be checked."""
    parts = [part for topic in topics if topic.stream is None and topic.fields for part in (_suggested_mapping(topic),)]
    if not parts:
        return ""
    return "# Check every line: names tell neither units nor whether a height is ellipsoidal.\n\n" + "\n".join(parts)


def _suggested_mapping(topic: TopicSummary) -> str:
    """Lines that would map a topic that is left over."""
    if recipe := next((recipe for recipe in recipes_for(topic.schema, topic.topic) if recipe.only_mapped), None):
        written = [f"[[ingest.{recipe.stream}]]", f"topic = {json.dumps(topic.topic, ensure_ascii=False)}"]
        remark = (
            f"{topic.schema}: a sensor or a filter of the positions, only you know. If it is an odometer, remove the #:"
        )
        return "\n".join([f"# {remark}", *(f"# {line}" for line in written), ORIGIN]) + "\n"
    numbers = [path for path, kind in topic.fields.items() if kind in ("int", "float")]
    words = {path: word_of(path.split(".")[-1]) for path in sorted(numbers, key=lambda path: (path.count("."), path))}
    time = ['time = "auto"  # or "log", "publish", "field:PATH"']
    for stream in COLUMNS:
        if lines := mapping_lines(stream, topic.topic, words, time, None, {}):
            used = set(columns_in(stream, words).values())
            return "\n".join([*lines, f"# other fields: {_other_fields(topic.fields, used)}\n"])
    named = {path: word_of(path.split(".")[-1]) for path, kind in topic.fields.items() if kind in ("int", "text")}
    if balise := first_fitting(named, WORDS["balise"]):
        head = ["[[ingest.balise_reads]]", f"topic = {json.dumps(topic.topic, ensure_ascii=False)}", *time]
        fields = f"fields = {{ balise_id = {json.dumps(balise, ensure_ascii=False)} }}"
        return "\n".join([*head, fields, f"# other fields: {_other_fields(topic.fields, {balise})}\n"])
    return (
        f'# [[ingest.STREAM]]\n# topic = "{topic.topic}"  # {topic.schema or "no schema"}\n'
        f"# fields: {_other_fields(topic.fields, set())}\n"
    )


def _other_fields(fields: Mapping[str, str], used: set[str]) -> str:
    """Fields that a suggestion does not use."""
    return ", ".join(path for path in list(fields)[:30] if path not in used)
