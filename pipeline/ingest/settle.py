"""Which of the channels that could feed a stream do, and under which names, once all of them are known."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.ingest.breaches import refuse
from pipeline.ingest.mapping import mappings_of
from pipeline.ingest.plan import Source
from schemas.config import IngestConfig
from schemas.errors import ConfigError, InputError
from schemas.run import STREAMS, Stream


def settle(sources: Sequence[Source], topics: Sequence[str], config: IngestConfig, file: str) -> list[Source]:
    """The sources that stand, once all channels are known; raises for what is missing or in doubt."""
    breaches = _absent_topics(topics, config, file)
    kept: list[Source] = []
    for stream in STREAMS:
        chosen = _preferred([s for s in sources if s.recipe.stream == stream and not s.dropped])
        if stream == "gnss":
            _refuse_shared_solutions(chosen)
        elif stream != "satellites":
            breaches += _competing(stream, chosen, file)
        breaches += [breach for source in chosen for breach in source.breaches]
        kept += chosen
    refuse(breaches)
    return kept


def _absent_topics(topics: Sequence[str], config: IngestConfig, file: str) -> list[InputError]:
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


def _preferred(sources: Sequence[Source]) -> list[Source]:
    """This project's own schema alone where it is present; a supplement only with what it adds to."""
    own = [source for source in sources if source.recipe.own]
    if own:
        return own
    whole = [source for source in sources if not source.recipe.supplement]
    return list(sources) if whole else []


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


def _competing(stream: Stream, sources: Sequence[Source], file: str) -> list[InputError]:
    """Only GNSS may come from several topics: the other streams have no solution to tell them apart."""
    topics = list(dict.fromkeys(source.channel.topic for source in sources))
    if len(topics) < 2:
        return []
    return [
        InputError(
            f"several topics could be the {stream}",
            place=file,
            found=", ".join(topics),
            expected="one",
            remedy=f"Choose one with `topic` in [ingest.{stream}] of the configuration.",
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
