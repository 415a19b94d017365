"""What `balise safety OUT` prints: the verdict, tables that fit a screen, and what they mean."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import polars as pl

from pipeline.results.manifest import NAME
from pipeline.show.terminal import show_tables, to_json, turn_table
from pipeline.stages.run_row.bounds import bound_columns
from pipeline.studies.safety.assessment import SOURCES, Assessment
from pipeline.studies.safety.budget import published_table
from schemas.campaign import CampaignFigures
from schemas.errors import visible


def show_assessment(assessment: Assessment, as_json: bool) -> None:
    """Print it: the verdict, each table, what it means; or all of it as JSON."""
    if as_json:
        print(to_json({"statements": assessment.statements, **assessment.tables}))
        return
    print(visible(assessment.statements[0]) + "\n")
    show_tables(tables_for_reading(assessment.tables))
    print(visible("\n".join(assessment.statements[1:])))


_SHORT = {
    "time_to_detect": (
        *("solution", "service_level", "allowed_s", "failures", "within", "exceeded", "failures_judged"),
        *("within_judged", "within_share_low", "within_share_high"),
        *("hazardous_median_s", "hazardous_p95_s", "hazardous_max_s", "hazardous_may_max_s"),
        *("time_to_detect_median_s", "time_to_detect_p95_s", "time_to_detect_max_s"),
    ),
    "accuracy": (
        *("solution", "grouped_by", "group", "location_error_count", "location_error_mean_m"),
        "location_error_sigma_m",
        *("location_error_p95_m", "location_error_max_m", "location_accuracy_m", "within_location_accuracy_share_low"),
        *("within_location_accuracy", "within_ci_limit"),
    ),
}


def tables_for_reading(tables: dict[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """The tables as they fit a screen: without those of single runs, wide ones in fewer columns or turned."""
    figures = figures_for_reading(tables["figures"])
    shown = {
        "what this result was made from": sources_in_short(tables["sources"]),
        "how much the verdict depends on what was chosen": tables["sensitivity"],
        **{f"figures of {name}, with exact 95 % bounds": table for name, table in figures.items()},
        "time to detect and hazardous time": tables["time_to_detect"].select(_SHORT["time_to_detect"]),
        "runs by verdict per service level": tables["levels"],
        "location error of accepted virtual balises": tables["accuracy"].select(_SHORT["accuracy"]),
        "composite and reactive fail-safety side by side": tables["side_by_side"],
        "alarms by verdict and suspect": tables["alarms"],
        "places where the map is in doubt": tables["map"],
    }
    side = "composite and reactive fail-safety side by side"
    if shown[side].height:
        shown[side] = turn_table(shown[side], ("architecture", "solution", "other"))
    return {name: table for name, table in shown.items() if table.height}


def figures_for_reading(figures: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Figures per solution: `figure, value, low, high, unit, source`; bounds are exact, two-sided, 95 %."""
    return {str(row["solution"]): _figure_rows(row) for row in figures.iter_rows(named=True)}


def _figure_rows(row: Mapping[str, Any]) -> pl.DataFrame:
    """The figures of one solution, a row each, with bounds, unit and source."""
    bounds = bound_columns(row)
    not_shown = {"solution", *(name for name in row if re.search("_(low|high)(_|$)", name))}
    rows = [
        (name, value, *(row.get(bound) for bound in bounds.get(name, ("", ""))), *_unit_and_source(name))
        for name, value in row.items()
        if name not in not_shown
    ]
    kinds = {"figure": pl.String, "value": pl.Float64, "low": pl.Float64, "high": pl.Float64}
    return pl.DataFrame(rows, schema={**kinds, "unit": pl.String, "source": pl.String}, orient="row", strict=False)


def _unit_and_source(name: str) -> tuple[str, str]:
    """Unit, and paper or clause."""
    column = CampaignFigures.columns()[name]
    unit = str((column.metadata or {}).get("unit", "")) or "1"
    # By the beginning of the figure's name, the first that fits; docs/domain.md is DOMAIN.
    sources = published_table("figure_sources").iter_rows()
    return unit, next((source for start, source in sources if name.startswith(start)), "")


def sources_in_short(sources: pl.DataFrame, most: int = 8) -> pl.DataFrame:
    """The sources as they fit a screen: digests shortened, and not all logs of many."""
    logs = sources.filter(pl.col("kind") == "log")
    shown = pl.concat([sources.filter(pl.col("kind") != "log"), logs.head(most)])
    if (more := logs.height - most) > 0:
        rest = pl.DataFrame([("log", f"and {more} more", NAME, None, "")], schema=SOURCES, orient="row")
        shown = pl.concat([shown, rest])
    return shown.with_columns(pl.col("sha256").str.head(16))
