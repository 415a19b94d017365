"""What a result measured, for an assessor: figures with their bounds, and what they do and do not show."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.results import store
from pipeline.results.figures.campaign_figures import derived_tables
from pipeline.results.figures.map_errors import map_suspects
from pipeline.results.manifest import NAME, read_manifest
from pipeline.results.workers import with_progress
from pipeline.storage.address import Address, join
from pipeline.studies.safety.sensitivity import Replay, vary_keys
from pipeline.studies.safety.sentences import (
    level_statements,
    plain_statements,
    reservations,
    slow_receivers,
    verdict_statement,
)
from pipeline.studies.safety.side_by_side import EPOCH_COLUMNS, side_by_side
from pipeline.studies.safety.tally import add_counts, architecture_figures
from schemas.config import Configuration
from schemas.enums import TRUTH, RunStatus, ThrVerdict
from schemas.frozen import frozen


@frozen
class Assessment:
    """`statements` in words, the verdict first; `tables` by name."""

    statements: list[str]
    tables: dict[str, pl.DataFrame]


def assess(out: Address, config: Configuration | None = None, replay: Replay | None = None) -> Assessment:
    """Everything that `balise safety OUT` says, from the tables of all complete runs.

    Args:
        out: the result of a campaign.
        config: its safety budget counts instead of the result's own, to judge it by other service levels. All else
            stays as the tables were made with it: limits and the time of a negation are in them.
        replay: replays the logs into a folder, as `sensitivity` takes it; None: rows that need it have no figures.

    Returns:
        Sentences, the verdict first, and tables by name.

    Source:
        DOMAIN section 6.
    """
    store.complete_runs(out)
    settings = store.read_config(out) or Configuration()
    if config is not None:
        settings = settings.model_copy(update={"safety": config.safety})
    names = ("runs", "hazards", "passages", "alarms")
    runs, hazards, passages, alarms = (store.read_table(out, name).collect() for name in names)
    derived = derived_tables(runs, hazards, passages, alarms, settings)
    of_runs = compare_architectures(out, runs, hazards, alarms, settings)
    tables = {
        "sources": source_files(out),
        "sensitivity": vary_keys(runs, settings, replay),
        "figures": derived["figures"],
        "time_to_detect": derived["detection"],
        "levels": levels_summary(derived["levels"]),
        "levels_of_runs": derived["levels"],
        "accuracy": derived["accuracy"],
        "side_by_side": architecture_figures(add_counts(of_runs.values())),
        "side_by_side_of_runs": architectures_by_run(of_runs),
        "alarms": alarm_causes(alarms, settings.hazards.map_reach_m),
        "map": derived["map"],
    }
    statements = [
        verdict_statement(runs),
        *reservations(runs, alarms),
        *slow_receivers(derived["levels"]),
        *plain_statements(derived["figures"]),
        *level_statements(derived["detection"]),
    ]
    return Assessment(statements, tables)


def compare_architectures(
    out: Address, runs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> dict[str, pl.DataFrame]:
    """`side_by_side` of every run that holds several solutions; one run's epochs in memory at a time."""
    done = runs.filter(pl.col("status") != RunStatus.FAILED)
    several = done.group_by("run_id").len().filter(pl.col("len") > 1)["run_id"].sort()
    compared = {}
    for run_id in with_progress(several.to_list()):
        epochs = store.read_table(out, "epochs", run_id).select(EPOCH_COLUMNS).collect()
        of_hazards, of_alarms, of_runs = (frame.filter(pl.col("run_id") == run_id) for frame in (hazards, alarms, done))
        compared[run_id] = side_by_side(epochs, of_hazards, of_alarms, of_runs, config)
    return compared


def architectures_by_run(counts_of_runs: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    """The architectures of each run, one run below the other."""
    parts = [
        architecture_figures(counts).insert_column(0, pl.lit(run).alias("run_id"))
        for run, counts in counts_of_runs.items()
    ]
    return pl.concat(parts) if parts else pl.DataFrame()


def levels_summary(levels: pl.DataFrame) -> pl.DataFrame:
    """Runs by verdict, per solution and service level; `no_truth`: of how many neither a reference nor balise
    reads judged, so that no failure means little.
    """
    no_truth = (~pl.col("evidence").is_in(TRUTH).fill_null(value=False)).sum().cast(pl.Int64)
    too_slow = (~pl.col("receiver_quick_enough")).sum().cast(pl.Int64)
    counts: dict[str, pl.Expr] = {
        verdict.value: (pl.col("verdict") == verdict.value).sum().cast(pl.Int64) for verdict in ThrVerdict
    }
    return (
        levels.filter(pl.col("solution") != "")
        .group_by("solution", "service_level", "allowed_s", maintain_order=True)
        .agg(**counts, no_truth=no_truth, receiver_too_slow=too_slow)
        .sort("solution", maintain_order=True)
    )


def alarm_causes(alarms: pl.DataFrame, reach_m: float) -> pl.DataFrame:
    """Alarms by verdict and suspect, the map held to be at fault where several runs agree on a place."""
    named = map_suspects(alarms, reach_m).with_columns(pl.col("verdict", "suspect").cast(pl.String))
    keys = ("solution", "verdict", "suspect")
    counts = {"alarms": pl.len().cast(pl.Int64), "runs": pl.col("run_id").n_unique().cast(pl.Int64)}
    return named.group_by(keys).agg(**counts).sort(keys)


SOURCES = {"kind": pl.String, "of": pl.String, "name": pl.String, "bytes": pl.Int64, "sha256": pl.String}


def source_files(out: Address) -> pl.DataFrame:
    """`kind, of, name, bytes, sha256`: manifest, program, settings, site and logs; none without a manifest."""
    manifest = read_manifest(out)
    if manifest is None:
        return pl.DataFrame(schema=SOURCES)
    content = storage.content_of(join(out, NAME)) or b""
    rows: list[tuple[str, str, str, int | None, str]] = [
        ("manifest", "", NAME, len(content), hashlib.sha256(content).hexdigest())
    ]
    made = {(run["software"], run["software_digest"]) for run in manifest["runs"].values()}
    rows += [("program", "", software or "", None, digest or "") for software, digest in sorted(made, key=str)]
    for entries in manifest["settings"].values():
        rows += [_file_row(kind, "", file) for entry in entries for kind, file in entry.items() if file]
    for listed in manifest["sites"].values():
        rows += [_file_row("site", "", file) for file in listed]
    for run_id, run in manifest["runs"].items():
        rows += [_file_row("log", run_id, file) for file in run["log"]]
    return pl.DataFrame(rows, schema=SOURCES, orient="row").unique(maintain_order=True)


def _file_row(kind: str, of: str, file: dict[str, Any]) -> tuple[str, str, str, int, str]:
    """A file that the assessment rests on, as a row."""
    return kind, of, file["name"], file["bytes"], file["sha256"]
