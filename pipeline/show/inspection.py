"""What `balise inspect` says of a log, a site or a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from pipeline.read.ingest.csv_draft import draft_mapping
from pipeline.read.ingest.describe import LogDescription, StreamSummary, TopicSummary, describe_log
from pipeline.read.ingest.parts import LogPart, parts_of_table_by
from pipeline.read.site.read import read_site
from pipeline.results import store
from pipeline.results.figures.head import HAZARD_COUNTS, head_of, known_counts, run_verdicts
from pipeline.show.kinds import Kind, kind_at
from pipeline.show.terminal import show_tables
from pipeline.storage import files
from pipeline.storage.address import Address, redacted
from pipeline.storage.described import PREFIX, describe
from pipeline.storage.parquet import ParquetError
from pipeline.studies.plausibility.fit import FitReport, fit_report
from schemas.config import Configuration, IngestConfig, Vehicle
from schemas.errors import UsageError
from schemas.run import Finding, Site

NOT_USED = "unused"
PARTS = "Parts"
STARTING_CONFIG = "Configuration to begin with"
_RUN_COLUMNS = (
    *("verdict", "run_id", "solution", "reasons", "part_verdict", "proof_margin_m", "remedies", "status"),
    *("duration_s", "distance_m", "gnss_rate_hz", "availability", "lost_to", "lost_to_share", "lost_to_monitor"),
    *("evidence", "vehicle", "share_unknown", "balises_passed", "balises_found", "unsafe_accepted"),
    *("unproven_accepted", "failures", "failures_within_budget", *HAZARD_COUNTS, "missed_detections"),
    *("alarms", "false_alarms", "error"),
)


def inspect_path(
    path: Address,
    config: Configuration | None = None,
    result: Address | None = None,
    site: Address | None = None,
    vehicle: Vehicle | None = None,
) -> dict[str, pl.DataFrame]:
    """Tables by title, for whatever stands at the path.

    `result`: runs over a site, for what they say of its survey. `site`, `vehicle`: what a log is held against.
    """
    config = config or Configuration()
    kind = kind_at(path)
    if kind is Kind.SITE:
        return inspect_site(path, result, config)
    if result is not None:
        raise UsageError("is not a site", place=redacted(str(path)), expected="a site, to compare the result with")
    if kind is Kind.RESULT:
        return inspect_result(path)
    if kind is Kind.CSV:
        return inspect_csv(Path(path), config.ingest)
    if kind is Kind.TABLE:
        return inspect_table(path)
    return inspect_log(path, config, None if site is None else read_site(site, config.site), vehicle)


def inspect_csv(path: Path, config: IngestConfig | None = None) -> dict[str, pl.DataFrame]:
    """A mapping to begin with, and the columns as it uses them, or as the configuration does where that maps them."""
    text = draft_mapping(path)
    parts = parts_of_table_by(path, config or IngestConfig(), text)
    return {PARTS: parts_table(parts), STARTING_CONFIG: pl.DataFrame({"toml": text.splitlines()})}


def parts_table(parts: Sequence[LogPart]) -> pl.DataFrame:
    """What a log consists of, and what of it is used as what."""
    rows = [(part.log, part.kind, part.name, part.count, part.used_as or NOT_USED) for part in parts]
    types = {"log": pl.String, "kind": pl.String, "name": pl.String, "count": pl.Int64, "used_as": pl.String}
    return pl.DataFrame(rows, schema=types, orient="row")


def inspect_table(path: Address) -> dict[str, pl.DataFrame]:
    """What a single Parquet file says of itself, and its columns with unit and meaning."""
    try:
        found = describe(files.read_bytes(path))
    except ParquetError as error:
        raise UsageError(f"cannot be read: {error}", place=redacted(str(path)), expected="a Parquet file") from None
    metadata = {key.removeprefix(PREFIX): value for key, value in found.metadata.items()}
    return {"File": _figures_table({"rows": found.rows, **metadata}), "Columns": found.columns}


def show_inspection(tables: Mapping[str, pl.DataFrame]) -> None:
    """Print the tables; what is to be saved as configuration last, without a frame.

    A mapping that comes alone can be saved as it is printed: its comments say what it uses.
    """
    alone = tables.keys() == {PARTS, STARTING_CONFIG}
    show_tables({name: table for name, table in tables.items() if name != STARTING_CONFIG and not alone})
    if STARTING_CONFIG in tables:
        print("\n".join(tables[STARTING_CONFIG]["toml"]))


def inspect_log(
    path: Address, config: Configuration, site: Site | None = None, vehicle: Vehicle | None = None
) -> dict[str, pl.DataFrame]:
    """Streams, topics, what is mapped to what, what does not fit, and what keeps the log from being replayed."""
    return tables_of_log(describe_log(path, config.ingest), config, site, vehicle)


def tables_of_log(
    log: LogDescription, config: Configuration, site: Site | None = None, vehicle: Vehicle | None = None
) -> dict[str, pl.DataFrame]:
    """The tables of a log that was described already, by their titles."""
    figures = {
        "kind": log.kind,
        "size_bytes": log.size_bytes,
        "left_over": log.left_over,
        "damage": log.notes.damage,
        "chunks_without_crc": log.notes.chunks_without_crc,
        "files_without_crc": list(log.notes.files_without_crc),
    }
    tables = {"Log": _figures_table(figures)}
    tables["Streams"] = pl.DataFrame([_stream_row(stream) for stream in log.streams])
    if log.topics:
        tables["Topics"] = pl.DataFrame([_topic_row(topic) for topic in log.topics])
    fitted = fit_report(log.run, config, site, vehicle) if log.run else FitReport({}, ())
    tables |= fitted.tables
    if problems := (*log.problems, *fitted.problems):
        tables["Problems"] = pl.DataFrame({"problem": problems})
    if log.starting_config:
        tables[STARTING_CONFIG] = pl.DataFrame({"toml": log.starting_config.splitlines()})
    return tables


def _stream_row(stream: StreamSummary) -> dict[str, object]:
    """A stream as a row for people."""
    row = {item.name: getattr(stream, item.name) for item in fields(stream)}
    for name in ("t_start", "t_end"):
        t_ns = row.pop(f"{name}_ns")
        row[name] = None if t_ns is None else datetime.fromtimestamp(t_ns / 1e9, UTC)
    return {**row, "fix_mix": _value_words(stream.fix_mix), "columns": " ".join(stream.columns)}


def _topic_row(topic: TopicSummary) -> dict[str, object]:
    """A topic as a row for people."""
    row = {item.name: getattr(topic, item.name) for item in fields(topic) if item.name != "fields"}
    mapping = ", ".join(f"{column} = {source}" for column, source in topic.mapping.items())
    return {**row, "stream": topic.stream or "left over", "mapping": mapping}


def inspect_site(
    path: Address, result: Address | None = None, config: Configuration | None = None
) -> dict[str, pl.DataFrame]:
    """Figures and findings of a site; among these balises that linking cannot tell apart, and tracks that positions
    cannot. Neighbouring tracks, and what tells them apart at the survey's sigma.

    With a result also how far its runs lay beside each net element and above it, against what both sigmas allow.
    """
    # What they need takes long to load, and a log needs none of it.
    from pipeline.read.site.alike import ambiguities
    from pipeline.read.site.describe import describe_site, elements_table, no_balises_finding
    from pipeline.read.site.neighbours import neighbour_table
    from pipeline.read.site.survey_findings import survey_findings

    config = config or Configuration()
    site = read_site(path, config.site)
    findings = (*ambiguities(site, config), *site.findings, *no_balises_finding(site.balises))
    tables = {
        "Site": _figures_table(describe_site(site)),
        "Elements": elements_table(site),
        "Neighbours": neighbour_table(site, config),
        "Findings": findings_table(findings),
    }
    if result is None:
        return tables
    epochs = (store.read_table(result, "epochs", run).collect() for run in store.complete_runs(result))
    return {**tables, "Survey": survey_findings(epochs, site.track, config)}


def inspect_result(path: Address) -> dict[str, pl.DataFrame]:
    """The verdict of a result, and its runs in their main figures; null what nobody could count."""
    runs = store.read_table(path, "runs").select(_RUN_COLUMNS).collect()
    head = head_of(run_verdicts(runs).values())
    return {"Verdict": _figures_table({"verdict": head.word, **head.counts()}), "Runs": known_counts(runs)}


def _figures_table(figures: Mapping[str, object]) -> pl.DataFrame:
    """Figures by name as a table."""
    return pl.DataFrame({"figure": list(figures), "value": [_value_words(value) for value in figures.values()]})


def findings_table(findings: tuple[Finding, ...]) -> pl.DataFrame:
    """Findings as they are shown."""
    columns = ("severity", "place", "message", "remedy")
    rows = [tuple(getattr(finding, name) for name in columns) for finding in findings]
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.String), orient="row")


def _value_words(value: object) -> str:
    """A value in words."""
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.6g}"
        case Mapping():
            return ", ".join(f"{count} {name}" for name, count in value.items()) or "none"
        case tuple():
            return ", ".join(map(_value_words, value)) or "none"
        case _:
            return str(value)
