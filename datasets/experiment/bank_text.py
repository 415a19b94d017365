"""The design aid's recommendation as a page to read."""

from __future__ import annotations

import polars as pl

_SHOWN = 5
_CHOICES = ("alphas", "sensors", "probability", "rate_hz")


def recommendation_page(ranking: pl.DataFrame) -> str:
    """Markdown: the recommended bank and why, the runners-up, and where the replay's default stands and differs."""
    best = ranking.row(0, named=True)
    lines = [
        "# Which bank",
        "",
        f"Recommended: {_bank(best)}. {best['reason']}.",
        "",
        "Ranked by: at most one false alarm in 100 h; then faults that are surely negated in time (95 %), faults seen "
        "at all, mean share in time, fewer false alarms.",
        "",
        "| rank | bank | faults in time | seen | one false alarm in |",
        "|---|---|---|---|---|",
        *(_row(row) for row in ranking.head(_SHOWN).iter_rows(named=True)),
        "",
        "## The replay's default",
        "",
        *(_default(row, best) for row in ranking.filter(pl.col("replay_default")).iter_rows(named=True)),
        "",
        "The default keeps the published probability of 1e-7 per sample and monitor (DIAG, eq. 17), so that results "
        "can be compared with the paper's; `monitors.false_alarm_probability` sets another.",
    ]
    return "\n".join(lines) + "\n"


def _bank(row: dict[str, object]) -> str:
    sensors = str(row["sensors"]).replace("_", " ")
    return f"weights {row['alphas']}, {sensors}, {row['probability']:.0e} per sample, {row['rate_hz']:g} Hz"


def _hours(row: dict[str, object]) -> str:
    alarms = float(str(row["false_alarms_per_h"]))
    return f"{1.0 / alarms:.0f} h" if alarms > 0.0 else "-"


def _row(row: dict[str, object]) -> str:
    in_time = f"{row['faults_in_time']} of {row['faults_judged']}"
    return f"| {row['rank']} | {_bank(row)} | {in_time} | {row['faults_seen']} | {_hours(row)} |"


def _default(row: dict[str, object], best: dict[str, object]) -> str:
    differs = [f"{name.replace('_', ' ')} {row[name]} for {best[name]}" for name in _CHOICES if row[name] != best[name]]
    how = "the recommended one" if not differs else "differs from the recommended one in " + "; ".join(differs)
    return f"- rank {row['rank']}, {_bank(row)}: {how}. {row['reason']}."
