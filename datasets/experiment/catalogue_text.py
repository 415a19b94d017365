"""The catalogue as a page to read."""

from __future__ import annotations

import polars as pl

from datasets.experiment.catalogue_faults import HEALTHY
from schemas.tables import OTHER_MONITORS

_HEAD = (
    "| fault | position fails after | seen first by | after | way | seen in | missed at failure (95 %) | unsafe |",
    "|---|---|---|---|---|---|---|---|",
)


def catalogue_page(faults: pl.DataFrame, monitors: pl.DataFrame) -> str:
    """Markdown: the table by fault, what no monitor sees, and what each monitor beyond the paper's bank adds."""
    real = faults.filter(~pl.col("kind").str.starts_with(HEALTHY))
    runs = int(faults["runs"].max())  # type: ignore[arg-type]
    lines = [
        "# Fault catalogue",
        "",
        f"{runs} replays of each fault. Times are medians from the onset, ways those of the train meanwhile; "
        "`seen first by`: the monitor that failed first, the loudest where several did. `unsafe`: replays in which a "
        "virtual balise was accepted with an error beyond the limit.",
        "",
        *_HEAD,
        *(_row(row) for row in real.iter_rows(named=True)),
        "",
        "## What no monitor sees in most replays",
        "",
        *_undetected_lines(real),
        "",
        "## What each monitor beyond the bank of averages is for",
        "",
        *(_purpose(name, monitors) for name in OTHER_MONITORS),
        "",
        "## Healthy journeys",
        "",
        "What fails here fails without a fault, and counts as no detection above.",
        "",
        *(_healthy(row) for row in faults.filter(pl.col("kind").str.starts_with(HEALTHY)).iter_rows(named=True)),
    ]
    return "\n".join(lines) + "\n"


def _row(row: dict[str, object]) -> str:
    cells = (
        row["fault"],
        _seconds(row["failure_median_s"]),
        row["first_monitors"] or "-",
        _seconds(row["time_to_detect_median_s"]),
        _metres(row["way_median_m"]),
        _percent(row["detected"]),
        _pmd(row),
        f"{row['runs_with_unsafe']}",
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _pmd(row: dict[str, object]) -> str:
    if not row["failed"]:
        return "-"
    bounds = f"{_percent(row['pmd_at_failure_low'])} to {_percent(row['pmd_at_failure_high'])}"
    return f"{row['missed_at_failure']} of {row['failed']} ({bounds})"


def _seconds(value: object) -> str:
    return "-" if value is None else f"{value:.0f} s"


def _metres(value: object) -> str:
    return "-" if value is None else f"{value:.0f} m"


def _percent(value: object) -> str:
    return "-" if value is None else f"{value:.1%}"


def _undetected_lines(faults: pl.DataFrame) -> list[str]:
    lines = []
    for row in faults.filter(pl.col("detected") < 0.5).iter_rows(named=True):
        harm = f"unsafe in {row['runs_with_unsafe']} of {row['runs']}" if row["runs_with_unsafe"] else "nothing unsafe"
        linking = ", linking errors tell" if row["seen_by_linking_alone"] * 2 > row["runs"] else ""
        seen = f", seen in {_percent(row['detected'])}" if row["detected"] else ""
        lines.append(f"- {row['fault']}: {harm}{linking}{seen}")
    return lines or ["- nothing"]


def _purpose(monitor: str, monitors: pl.DataFrame) -> str:
    """Faults that it sees before all others, or alone, in most replays; else those that it is among the first for."""
    own = monitors.filter(pl.col("monitor") == monitor)
    ahead = own.filter(pl.col("ahead") >= 0.5)
    if ahead.height:
        return f"- `{monitor}`: before all others for {'; '.join(_leads(row) for row in ahead.iter_rows(named=True))}"
    among = own.filter(pl.col("first") >= 0.5)["fault"].to_list()
    return f"- `{monitor}`: among the first for {'; '.join(among) or 'nothing'}"


def _leads(row: dict[str, object]) -> str:
    lead = "alone" if row["lead_s"] is None else f"by {_seconds(row['lead_s'])}"
    return f"{row['fault']} ({_percent(row['ahead'])}, {lead})"


def _healthy(row: dict[str, object]) -> str:
    first = f", first {row['first_monitors']}" if row["first_monitors"] else ""
    return f"- {row['kind']}: some monitor failed in {_percent(row['detected'])} of {row['runs']} replays{first}"
