"""The figures of one solution of one run, as its page shows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.report.markup import UNKNOWN, cell, number, pairs, table
from pipeline.report.run_columns import FIGURES
from schemas.campaign import STANFORD

Row = Mapping[str, Any]


def figures(row: Row) -> str:
    """Names and values of one `runs` row."""
    values = []
    for key, title, unit in FIGURES:
        value = row[key]
        text = number(value, 4) if isinstance(value, int | float) else str(value or UNKNOWN)
        values.append((title, f"{text} {unit}".strip() if value is not None else "not known"))
    low, high = row["false_alarm_rate_low_per_h"], row["false_alarm_rate_high_per_h"]
    known = row["false_alarm_rate_per_h"] is not None
    rate = f"{number(row['false_alarm_rate_per_h'])} /h (95 %: {number(low)} to {number(high)})"
    shares = ", ".join(
        f"{state.upper()} " + ("not known" if row[f"share_{state}"] is None else format(row[f"share_{state}"], ".2%"))
        for state in ("p0", "p1", "p2", "p3")
    )
    stanford = [
        (f"epochs by error and {bound}", _stanford(row, prefix))
        for bound, prefix in (("confidence", "stanford"), ("HPL", "stanford_hpl"))
    ]
    rest = [("false alarm rate", rate if known else "not known"), ("share of time", shares), *stanford]
    return pairs([*values, *rest])


def verdict_reasons(row: Row, unknown_share_limit: float) -> str:
    """Why the verdict is what it is: the counts that it follows from (DOMAIN section 5.4)."""
    undecided = row["failures"] - row["failures_within_budget"] - row["failures_beyond_budget"]
    share = row["share_unknown"]
    reasons = [
        (row["unsafe_accepted"], "{} VBs accepted despite a wrong position"),
        (row["failures_beyond_budget"], "{} position failures in use beyond the budget"),
        (row["unproven_accepted"], "{} VBs accepted of which nothing says whether the position was right"),
        (undecided, "{} position failures of which nothing says whether they were within the budget"),
    ]
    said = [text.format(count) for count, text in reasons if count]
    if share is None:
        said.append("no position was in use while the train moved")
    elif share > unknown_share_limit:
        said.append(f"{share:.1%} of the moving time in use cannot be judged")
    if not row["balises_accepted"]:
        said.append("no VB was accepted")
    return "; ".join(said) or "every acceptance was right, and every position failure within the budget"


def _stanford(row: Row, prefix: str) -> str:
    """Counts of the along-track Stanford diagram in words."""
    counts = [(kind, row[f"{prefix}_{kind}"]) for kind in STANFORD]
    if any(count is None for _, count in counts):
        return "not known"
    return ", ".join(f"{number(count)} {kind}" for kind, count in counts)


def levels(key: str, run: Row) -> str:
    """What the run would be worth at each service level (TVB eq. 7)."""
    columns = ("service_levels", "level_allowed_s", "level_within", "level_exceeded", "level_verdict")
    rows = [
        [
            cell(level),
            cell(allowed_s, 4),
            *(cell(count) for count in (within, exceeded, run["failures"] - within - exceeded)),
            cell(verdict.replace("_", " ")),
        ]
        for level, allowed_s, within, exceeded, verdict in zip(*(run[name] or [] for name in columns), strict=True)
    ]
    titles = ["service level", "allowed T_D [s]", "failures within it", "beyond it", "not known", "verdict"]
    return table(f"table-levels-{key}", "Position failures against the allowed T_D (TVB eq. 7)", titles, rows)
