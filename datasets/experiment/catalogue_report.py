"""The catalogue's replays as tables by fault and monitor, shares with exact bounds, and as a page to read."""

from __future__ import annotations

import polars as pl

from datasets.experiment.catalogue_faults import HEALTHY
from datasets.experiment.tables import Row, share_columns, table_of_rows
from schemas.monitors import MONITORS, OTHER_MONITORS

_HEAD = (
    "| fault | position fails after | seen first by | after | way | seen in | missed at failure (95 %) | unsafe |",
    "|---|---|---|---|---|---|---|---|",
)


def faults_table(runs: pl.DataFrame) -> pl.DataFrame:
    """One row per fault, in the order of the runs."""
    return table_of_rows([_fault_row(part) for part in runs.partition_by("fault", maintain_order=True)])


def _fault_row(runs: pl.DataFrame) -> Row:
    """The row of one fault.

    Pmd is over the runs whose position failed, in time means negated within budget after that.
    """
    found = runs.filter(pl.col("detected_s").is_not_null())
    failed = runs.filter(pl.col("failure_s").is_not_null())
    missed = failed.filter(~(pl.col("detected_s") <= pl.col("failure_s")).fill_null(False)).height
    negated_s = pl.col("detected_s") + pl.col("reaction_s")
    in_time = failed.filter((negated_s <= pl.col("failure_s") + pl.col("budget_s")).fill_null(False)).height
    first = _rank_monitors(found)
    return {
        **{name: runs[name][0] for name in ("fault", "kind", "size", "unit", "journey")},
        "runs": runs.height,
        **share_columns("detected", found.height, runs.height),
        "first_monitor": first[0][0] if first else None,
        "first_monitors": ", ".join(f"{name} {part:.0%}" for name, part in first),
        "time_to_detect_median_s": found["detected_s"].median(),
        "time_to_detect_max_s": found["detected_s"].max(),
        "way_median_m": found["way_m"].median(),
        "way_max_m": found["way_m"].max(),
        "failed": failed.height,
        "failure_median_s": failed["failure_s"].median(),
        "missed_at_failure": missed,
        **share_columns("pmd_at_failure", missed, failed.height),
        **share_columns("within_budget", in_time, failed.height),
        "runs_with_unsafe": runs.filter(pl.col("unsafe") > 0).height,
        "unsafe_accepted": int(runs["unsafe"].clip(lower_bound=0).sum()),
        "seen_by_linking_alone": runs.filter(pl.col("detected_s").is_null() & (pl.col("linking_errors") > 0)).height,
    }


def _rank_monitors(found: pl.DataFrame) -> list[tuple[str, float]]:
    """Monitors by the share of detections in which they failed first, or with the largest value of those that did."""
    leading = found.select(monitor=pl.col("first").list.first())
    counted = leading.group_by("monitor").len().sort(["len", "monitor"], descending=[True, False])
    return [(str(name), count / found.height) for name, count in counted.iter_rows()]


def monitors_table(runs: pl.DataFrame) -> pl.DataFrame:
    """One row per fault and monitor that saw it in some run.

    `first`: share of runs in which no other failed earlier; `ahead`: in which all others failed later or not at all;
    `alone`: in which none did; `lead_s`: median of how much earlier than the next it failed, where it did.
    """
    rows = [
        {"fault": part["fault"][0], **row}
        for part in runs.partition_by("fault", maintain_order=True)
        for place, monitor in enumerate(MONITORS)
        if (row := _monitor_row(monitor, place, part["seen_s"].to_list())) is not None
    ]
    return pl.DataFrame(rows, schema=_MONITORS_SCHEMA)


def _monitor_row(monitor: str, place: int, runs: list[list[float | None]]) -> Row | None:
    """`runs`: by run the seconds to the first failure of each monitor."""
    own = []
    leads = []
    first = 0
    alone = 0
    for first_fails in runs:
        mine = first_fails[place]
        if mine is None:
            continue
        others = min((s for k, s in enumerate(first_fails) if k != place and s is not None), default=None)
        own.append(mine)
        alone += others is None
        first += others is None or others >= mine
        if others is not None and others > mine:
            leads.append(others - mine)
    if not own:
        return None
    return {
        "monitor": monitor,
        "runs": len(runs),
        **share_columns("seen", len(own), len(runs)),
        "first": first / len(runs),
        "ahead": (len(leads) + alone) / len(runs),
        "alone": alone / len(runs),
        "lead_s": pl.Series(leads, dtype=pl.Float64).median(),
        "time_to_detect_median_s": pl.Series(own).median(),
        "time_to_detect_max_s": max(own),
    }


_MONITORS_SCHEMA = {"fault": pl.String, "monitor": pl.String, "runs": pl.Int64} | dict.fromkeys(
    (
        *("seen", "seen_low", "seen_high", "first", "ahead", "alone", "lead_s"),
        *("time_to_detect_median_s", "time_to_detect_max_s"),
    ),
    pl.Float64,
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
        *(_table_line(row) for row in real.iter_rows(named=True)),
        "",
        "## What no monitor sees in most replays",
        "",
        *_undetected_lines(real),
        "",
        "## What each monitor beyond the bank of averages is for",
        "",
        *(_purpose_words(name, monitors) for name in OTHER_MONITORS),
        "",
        "## Healthy journeys",
        "",
        "What fails here fails without a fault, and counts as no detection above.",
        "",
        *(_healthy_line(row) for row in faults.filter(pl.col("kind").str.starts_with(HEALTHY)).iter_rows(named=True)),
    ]
    return "\n".join(lines) + "\n"


def _table_line(row: dict[str, object]) -> str:
    """A fault as a line of the table."""
    cells = (
        row["fault"],
        _seconds_words(row["failure_median_s"]),
        row["first_monitors"] or "-",
        _seconds_words(row["time_to_detect_median_s"]),
        _metres_words(row["way_median_m"]),
        _percent_words(row["detected"]),
        _pmd_words(row),
        f"{row['runs_with_unsafe']}",
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _pmd_words(row: dict[str, object]) -> str:
    """Missed at the failure, of how many, with bounds."""
    if not row["failed"]:
        return "-"
    bounds = f"{_percent_words(row['pmd_at_failure_low'])} to {_percent_words(row['pmd_at_failure_high'])}"
    return f"{row['missed_at_failure']} of {row['failed']} ({bounds})"


def _seconds_words(value: object) -> str:
    """A time in words."""
    return "-" if value is None else f"{value:.0f} s"


def _metres_words(value: object) -> str:
    """A distance in words."""
    return "-" if value is None else f"{value:.0f} m"


def _percent_words(value: object) -> str:
    """A share in words."""
    return "-" if value is None else f"{value:.1%}"


def _undetected_lines(faults: pl.DataFrame) -> list[str]:
    """Lines on faults that fewer than half of the replays detected."""
    lines = []
    for row in faults.filter(pl.col("detected") < 0.5).iter_rows(named=True):
        harm = f"unsafe in {row['runs_with_unsafe']} of {row['runs']}" if row["runs_with_unsafe"] else "nothing unsafe"
        linking = ", linking errors tell" if row["seen_by_linking_alone"] * 2 > row["runs"] else ""
        share = f", seen in {_percent_words(row['detected'])}" if row["detected"] else ""
        lines.append(f"- {row['fault']}: {harm}{linking}{share}")
    return lines or ["- nothing"]


def _purpose_words(monitor: str, monitors: pl.DataFrame) -> str:
    """Faults that it sees before all others, or alone, in most replays; else those that it is among the first for."""
    own = monitors.filter(pl.col("monitor") == monitor)
    ahead = own.filter(pl.col("ahead") >= 0.5)
    if ahead.height:
        return (
            f"- `{monitor}`: before all others for {'; '.join(_lead_words(row) for row in ahead.iter_rows(named=True))}"
        )
    among = own.filter(pl.col("first") >= 0.5)["fault"].to_list()
    return f"- `{monitor}`: among the first for {'; '.join(among) or 'nothing'}"


def _lead_words(row: dict[str, object]) -> str:
    """A fault that a monitor sees first, how often, and by how much."""
    lead = "alone" if row["lead_s"] is None else f"by {_seconds_words(row['lead_s'])}"
    return f"{row['fault']} ({_percent_words(row['ahead'])}, {lead})"


def _healthy_line(row: dict[str, object]) -> str:
    """A line on journeys without a fault."""
    first = f", first {row['first_monitors']}" if row["first_monitors"] else ""
    return f"- {row['kind']}: some monitor failed in {_percent_words(row['detected'])} of {row['runs']} replays{first}"
