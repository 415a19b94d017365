"""What a result measured, for an assessor: figures with their bounds, and what they do and do not show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import polars as pl

from pipeline.derived_tables import derived_tables
from pipeline.hazards.map_errors import map_suspects
from pipeline.present import tall
from pipeline.results import catalogue, store
from pipeline.safety.measured import plain_statements
from pipeline.safety.side_by_side import EPOCH_COLUMNS, Key, side_by_side, side_by_side_table
from pipeline.safety.tally import Tally
from pipeline.storage.files import Address
from schemas.config import Configuration
from schemas.enums import TRUTH, RunStatus, ThrVerdict, Verdict

_WORTH_SAYING_S = 1.0


@dataclass(frozen=True)
class Assessment:
    """`statements` in words; `tables` by name."""

    statements: list[str]
    tables: dict[str, pl.DataFrame]


def assess(out: Address, config: Configuration | None = None) -> Assessment:
    """Everything that `balise safety OUT` says, from the tables of all complete runs.

    `config`: its safety budget instead of the result's own, to judge it by other service levels. All else stays as the
    tables were made with it: limits and the time of a negation are in them.
    """
    store.complete_runs(out)
    settings = store.read_config(out) or Configuration()
    if config is not None:
        settings = settings.model_copy(update={"safety": config.safety})
    names = ("runs", "hazards", "passages", "alarms")
    runs, hazards, passages, alarms = (_table(out, name) for name in names)
    derived = derived_tables(runs, hazards, passages, alarms, settings)
    of_runs = compare_architectures(out, runs, hazards, alarms, settings)
    tables = {
        "figures": derived["figures"],
        "time_to_detect": derived["detection"],
        "levels": levels_summary(derived["levels"]),
        "levels_of_runs": derived["levels"],
        "accuracy": derived["accuracy"],
        "side_by_side": over_all_runs(of_runs),
        "side_by_side_of_runs": by_run(of_runs),
        "alarms": alarm_causes(alarms),
        "map": derived["map"],
    }
    said = [
        *_reservations(runs, alarms),
        *_slow_receivers(derived["levels"]),
        *plain_statements(derived["figures"]),
        *_level_statements(derived["detection"]),
    ]
    return Assessment(said, tables)


def _table(out: Address, name: str) -> pl.DataFrame:
    """From the catalogue where it is fresh; nothing is written."""
    kept = catalogue.fresh(out, name)
    return (store.read_table(out, name) if kept is None else kept).collect()


def compare_architectures(
    out: Address, runs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> dict[str, dict[Key, Tally]]:
    """`side_by_side` of every run that holds several solutions; one run's epochs in memory at a time."""
    done = runs.filter(pl.col("status") != RunStatus.FAILED)
    several = done.group_by("run_id").len().filter(pl.col("len") > 1)["run_id"].sort()
    found = {}
    for run_id in several.to_list():
        epochs = store.read_table(out, "epochs", run_id).select(EPOCH_COLUMNS).collect()
        of_hazards, of_alarms, of_runs = (frame.filter(pl.col("run_id") == run_id) for frame in (hazards, alarms, done))
        found[run_id] = side_by_side(epochs, of_hazards, of_alarms, of_runs, config)
    return found


def by_run(found: dict[str, dict[Key, Tally]]) -> pl.DataFrame:
    """The architectures of each run, one run below the other."""
    parts = [
        side_by_side_table(of_run).insert_column(0, pl.lit(run_id).alias("run_id")) for run_id, of_run in found.items()
    ]
    return pl.concat(parts, how="vertical_relaxed") if parts else pl.DataFrame()


def over_all_runs(found: dict[str, dict[Key, Tally]]) -> pl.DataFrame:
    """The architectures over all runs that hold the solutions concerned; `runs` says how many."""
    total: dict[Key, Tally] = {}
    runs: dict[Key, int] = {}
    for of_run in found.values():
        for key, tally in of_run.items():
            total[key] = total[key] + tally if key in total else tally
            runs[key] = runs.get(key, 0) + 1
    table = side_by_side_table(total)
    if table.is_empty():
        return table
    keys = zip(table["solution"], table["architecture"], table["other"], strict=True)
    return table.insert_column(3, pl.Series("runs", [runs[key] for key in keys], dtype=pl.Int64))


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


def alarm_causes(alarms: pl.DataFrame) -> pl.DataFrame:
    """Alarms by verdict and suspect, the map held to be at fault where several runs agree on a place."""
    named = map_suspects(alarms).with_columns(pl.col("verdict", "suspect").cast(pl.String))
    keys = ("solution", "verdict", "suspect")
    counts = {"alarms": pl.len().cast(pl.Int64), "runs": pl.col("run_id").n_unique().cast(pl.Int64)}
    return named.group_by(keys).agg(**counts).sort(keys)


def _reservations(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """What keeps the figures from being those of traffic, and what they leave out."""
    injected = runs.filter(pl.col("notes").str.contains("faults were injected").fill_null(value=False))
    failed = runs.filter((pl.col("status") == RunStatus.FAILED).all().over("run_id"))["run_id"].n_unique()
    said = []
    if injected.height:
        said.append(
            f"Faults were injected into {injected['run_id'].n_unique()} of {runs['run_id'].n_unique()} runs: rates of "
            "hazards, misses and outages per hour are those of the trial, not of traffic."
        )
    if failed:
        said.append(f"{failed} of {runs['run_id'].n_unique()} runs failed and count nowhere.")
    said += [
        f"{solution}: {count} of {runs['run_id'].n_unique()} runs failed with this solution alone and count nowhere in"
        " its figures."
        for solution, count in _failed_alone(runs)
    ]
    partial = runs.filter(pl.col("status") == RunStatus.PARTIAL)["run_id"].n_unique()
    if partial:
        said.append(f"{partial} of {runs['run_id'].n_unique()} runs are partial: what was read of them counts.")
    return [*said, *_unjudged(runs, alarms)]


def _failed_alone(runs: pl.DataFrame) -> list[tuple[str, int]]:
    """Solutions that failed in runs of which another one was replayed, and in how many."""
    failed = pl.col("status") == RunStatus.FAILED
    alone = runs.filter(failed & ~failed.all().over("run_id"))
    return alone.group_by("solution").agg(pl.col("run_id").n_unique()).sort("solution").rows()


def _unjudged(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """Per solution: the time and the alarms that nothing could judge."""
    said = []
    done = runs.filter(pl.col("status") != RunStatus.FAILED).sort("solution")
    for (solution,), rows in done.group_by("solution", maintain_order=True):
        held_s, seen_s = (float(rows[name].sum()) for name in ("held_s", "evidence_s"))
        if held_s - seen_s >= _WORTH_SAYING_S:
            without = rows["evidence"].null_count()
            said.append(
                f"{solution}: for {(held_s - seen_s) / 3600.0:.3g} of {held_s / 3600.0:.3g} h the error is not known"
                f" ({without} of {rows.height} runs have no evidence at all): no rate of hazards counts this time."
            )
        open_cases = alarms.filter((pl.col("solution") == solution) & (pl.col("verdict") == Verdict.UNKNOWN))
        if open_cases.height:
            said.append(
                f"{solution}: {open_cases.height} alarms in {open_cases['run_id'].n_unique()} runs are neither true nor"
                " false for want of evidence: the rate of false alarms leaves these runs out."
            )
    return said


def _slow_receivers(levels: pl.DataFrame) -> list[str]:
    """Service levels whose allowed time is over before the next epoch can negate anything (TVB section 5)."""
    slow = levels.filter(~pl.col("receiver_quick_enough"))
    return [
        f"{solution}: epochs come too slowly for {level} in {runs} runs: period and negation take up to "
        f"{needed_s:.4g} s of the {allowed_s:.4g} s allowed."
        for solution, level, allowed_s, runs, needed_s in slow.group_by(
            "solution", "service_level", "allowed_s", maintain_order=True
        )
        .agg(pl.col("run_id").n_unique(), pl.col("receiver_needs_s").max())
        .iter_rows()
    ]


def _level_statements(detection: pl.DataFrame) -> list[str]:
    """Per solution: how many failures were negated in the time that each service level allows."""
    said = []
    for (solution,), rows in detection.filter(pl.col("failures") > 0).group_by("solution", maintain_order=True):
        levels = [
            f"{row['within']} within {row['allowed_s']:.4g} s ({row['service_level']}{_within_bounds(row)})"
            for row in rows.iter_rows(named=True)
        ]
        failures, never = rows["failures"][0], rows["never_negated"][0]
        said.append(
            f"{solution}: of {failures} position failures {never} were never negated; " + ", ".join(levels) + "."
        )
    return said


def _within_bounds(row: dict[str, Any]) -> str:
    """The bounds of the share of failures that a truth judged; nothing without any."""
    if row["within_share"] is None:
        return ""
    of = "" if row["failures_judged"] == row["failures"] else f" of the {row['failures_judged']} judged by a truth"
    return f"; 95 %{of}: {row['within_share_low']:.1%} to {row['within_share_high']:.1%}"


_SHORT = {
    "time_to_detect": (
        *("solution", "service_level", "allowed_s", "failures", "within", "failures_judged", "within_judged"),
        *("within_share_low", "within_share_high"),
        *("never_negated", "hazardous_median_s", "hazardous_p95_s", "hazardous_max_s"),
        *("time_to_detect_median_s", "time_to_detect_p95_s", "time_to_detect_max_s"),
    ),
    "accuracy": (
        *("solution", "grouped_by", "group", "accepted_judged", "location_error_mean_m", "location_error_sigma_m"),
        *("location_error_p95_m", "location_error_max_m", "location_accuracy_m", "within_location_accuracy_share_low"),
        *("within_location_accuracy", "within_ci_limit"),
    ),
}


def for_reading(tables: dict[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """The tables as they fit a screen: without those of single runs, wide ones in fewer columns or turned."""
    shown = {
        "figures": tall(tables["figures"], ("solution",)) if tables["figures"].height else tables["figures"],
        "time to detect and hazardous time": tables["time_to_detect"].select(_SHORT["time_to_detect"]),
        "runs by verdict per service level": tables["levels"],
        "location error of accepted virtual balises": tables["accuracy"].select(_SHORT["accuracy"]),
        "composite and reactive fail-safety side by side": tables["side_by_side"],
        "alarms by verdict and suspect": tables["alarms"],
        "places where the map is in doubt": tables["map"],
    }
    side = "composite and reactive fail-safety side by side"
    if shown[side].height:
        shown[side] = tall(shown[side], ("architecture", "solution", "other"))
    return {name: table for name, table in shown.items() if table.height}
