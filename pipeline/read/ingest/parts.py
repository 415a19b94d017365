"""What a log consists of, and what of it is used: its columns, topics or kinds of messages, all of them, one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from pipeline.read.ingest.csv_text import read_log_table
from pipeline.read.ingest.describe import TopicSummary, starting_config
from pipeline.read.ingest.mapping import mappings_of
from schemas.config import IngestConfig, StreamMapping, settings_from, toml_of
from schemas.frozen import frozen
from schemas.run import STREAMS, Stream

PartKind = Literal["column", "topic", "message", "file"]


@frozen
class LogPart:
    """One column, topic or kind of message of a log, or a file or column of a run.

    `count`: its rows or messages; `used_as`: empty where it is not; `draft`: lines of configuration that would read it,
    to be checked.
    """

    log: str
    kind: PartKind
    name: str
    count: int
    used_as: str = ""
    draft: str = ""


def parts_of_table(
    log: str, rows: int, columns: Sequence[str], mappings: Sequence[tuple[Stream, StreamMapping]]
) -> list[LogPart]:
    """The columns of a table, and what the mappings make of them."""
    uses: dict[str, list[str]] = {}
    for stream, mapping in mappings:
        for recorded, column in _columns_in(mapping, columns):
            uses.setdefault(recorded, []).append(f"{stream} {column}")
    return [LogPart(log, "column", name, rows, ", ".join(uses.get(name, ()))) for name in columns]


def parts_of_table_by(path: Path, config: IngestConfig, draft: str) -> list[LogPart]:
    """The columns of a table by the mappings that the configuration has for it, else by a draft."""
    drafted = toml_of(draft.encode(), f"mapping of {path}").get("ingest", {})
    log = read_log_table(path, infer=True)
    given = mappings_for(path, config)
    own = drafted if isinstance(drafted, dict) else {}
    found = given or mappings_for(path, settings_from(own, IngestConfig, str(path)))
    return parts_of_table(path.name, log.table.height, log.table.columns, found)


def mappings_for(path: Path, config: IngestConfig) -> list[tuple[Stream, StreamMapping]]:
    """The mappings that are meant for a table."""
    topics = (path.name, path.stem, "*")
    return [(name, mapping) for name in STREAMS for mapping in mappings_of(config, name) if mapping.topic in topics]


def _columns_in(mapping: StreamMapping, columns: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Recorded columns that a mapping names, and the columns of the stream that they become."""
    time = mapping.time.removeprefix("field:")
    times = [time] if time in columns else [part.strip() for part in time.split("+")]
    yield from ((name, "t") for name in times if name in columns)
    yield from ((path, column) for column, path in mapping.fields.items() if path in columns)


def parts_of_topics(log: str, topics: Sequence[TopicSummary], left_over: Sequence[str]) -> list[LogPart]:
    """The topics of a log; of those that feed nothing the draft of a mapping. `left_over`: by the run that was read."""
    parts: list[LogPart] = []
    for topic in topics:
        name = f"{topic.topic} ({topic.schema})" if topic.schema else topic.topic
        mapping = ", ".join(f"{column} = {source}" for column, source in topic.mapping.items())
        used_as = "" if topic.stream is None or name in left_over else f"{topic.stream}: {mapping}"
        draft = starting_config([topic]) if topic.stream is None else ""
        parts.append(LogPart(log, "topic", name, topic.messages, used_as, draft))
    return parts


def parts_of_messages(log: str, counts: Mapping[tuple[str, bool], int]) -> list[LogPart]:
    """The kinds of messages of a receiver; counted by name and whether they are used."""
    used = "epochs of the receiver"
    return [LogPart(log, "message", name, count, used * is_used) for (name, is_used), count in sorted(counts.items())]


_PLURALS: Mapping[PartKind, str] = {
    "column": "columns",
    "topic": "topics",
    "message": "messages",
    "file": "files",
}


def lines_of_parts(parts: Sequence[LogPart]) -> list[str]:
    """For people: by log what is used as what, and what is not."""
    lines = []
    for log in dict.fromkeys(part.log for part in parts):
        own = [part for part in parts if part.log == log]
        plural = _PLURALS[own[0].kind]
        used = [_use_words(part) for part in own if part.used_as]
        unused = [
            f"{part.name} ({part.count})" if part.kind in ("topic", "message") else part.name
            for part in own
            if not part.used_as
        ]
        lines.append(f"{log}: {plural} used: {'; '.join(used) or 'none'}")
        lines.append(f"{log}: {plural} not used: {', '.join(unused) or 'none'}")
    return lines


def _use_words(part: LogPart) -> str:
    """What a part is used as, in words."""
    # Of a topic the stream; its columns are many.
    return part.name if part.kind == "message" else f"{part.name} as {part.used_as.partition(':')[0]}"


def drafts_of(parts: Sequence[LogPart]) -> list[str]:
    """Lines that would read what is not used, commented out, each topic once."""
    texts = dict.fromkeys(part.draft for part in parts if part.draft)
    lines = [line for text in texts for line in text.splitlines() if line and not line.startswith("# Check every")]
    return [line if line.startswith("#") else f"# {line}" for line in lines]
