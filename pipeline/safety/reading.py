"""Tables of an assessment as a person reads them: each figure with its bounds, its unit and where it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import polars as pl

from schemas.campaign import CampaignFigures

# By the beginning of the figure's name, the first that fits; docs/domain.md is DOMAIN.
_SOURCES = {
    "runs_unsafe": "DOMAIN 5.4",
    "runs_unproven": "DOMAIN 5.4",
    "runs_safe": "DOMAIN 5.4",
    "runs": "count",
    "hours_needed": "Poisson, 95 %, against THR_VB (TVB section 3)",
    "hours_still_needed": "Poisson, 95 %, against THR_VB (TVB section 3)",
    "hours": "DOMAIN 5.1",
    "hazard": "DIAG, section Hazards; DOMAIN 5.3",
    "missed": "DIAG, section Hazards; DOMAIN 5.3",
    "beyond_budget": "TVB eq. 7; DOMAIN 5.3",
    "failures": "TVB eq. 7; DOMAIN 5.3",
    "false_alarm": "DOMAIN 3 and 5.3",
    "accepted": "DOMAIN 4",
    "unsafe": "DOMAIN 5.2",
    "unproven": "DOMAIN 5.2",
    "outage": "count of gaps (dictionary, `runs`)",
    "trusted": "LOC eq. 8",
    "mtbf": "LOC eq. 8",
    "continuity": "LOC eq. 8",
    "share_p": "TVB, Markov model; DOMAIN 4",
    "share_unknown": "DOMAIN 5.2",
    "stanford": "Stanford diagram, along track",
    "thr_vb": "TVB section 3",
    "undetected": "docs/domain.md section 5.6",
    "physical_spacing": "docs/domain.md section 5.6",
}


def figures_for_reading(figures: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Per solution: `figure, value, low, high, unit, source`; low and high are exact two-sided 95 % bounds."""
    return {str(row["solution"]): _figures(row) for row in figures.iter_rows(named=True)}


def _figures(row: Mapping[str, Any]) -> pl.DataFrame:
    bounds = {_bounded(name) for name in row if _is_bound(name)}
    rows = [
        (
            name,
            row[name],
            *(_bound(row, name, side) if name in bounds else None for side in ("low", "high")),
            *_told(name),
        )
        for name in row
        if name != "solution" and not _is_bound(name)
    ]
    kinds = {"figure": pl.String, "value": pl.Float64, "low": pl.Float64, "high": pl.Float64}
    return pl.DataFrame(rows, schema={**kinds, "unit": pl.String, "source": pl.String}, orient="row", strict=False)


def _told(name: str) -> tuple[str, str]:
    """Unit, and paper or clause."""
    column = CampaignFigures.columns()[name]
    unit = str((column.metadata or {}).get("unit", "")) or "1"
    return unit, next((source for start, source in _SOURCES.items() if name.startswith(start)), "")


def _is_bound(name: str) -> bool:
    return any(f"_{side}" in name and _bounded(name) != name for side in ("low", "high")) and "upper" not in name


def _bounded(name: str) -> str:
    """The figure that a bound belongs to: `mtbf_h` of `mtbf_low_h`."""
    for side in ("low", "high"):
        head, found, tail = name.rpartition(f"_{side}")
        if found and (not tail or tail.startswith("_")):
            return head + tail
    return name


def _bound(row: Mapping[str, Any], name: str, side: str) -> Any:
    """The bound of a figure; its side stands before the unit."""
    names = [column for column in row if _is_bound(column) and _bounded(column) == name and f"_{side}" in column]
    return row[names[0]] if names else None
