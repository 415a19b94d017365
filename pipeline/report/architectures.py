"""Composite and reactive fail-safety side by side, on the pages of runs and of the campaign."""

from __future__ import annotations

import polars as pl

from pipeline.report.columns import frame_table
from pipeline.report.markup import section
from pipeline.safety.tally import architecture_figures

_NOTE = (
    "<p>Reactive: a solution diagnosed by itself (LOC Fig. 4). Composite: two solutions compared, both needed (LOC "
    "Fig. 3); blind to what they share. Reactive 1oo2: one of two such channels is enough (LOC eq. 11). Judged after "
    "the fact on the same faults.</p>"
)
_COLUMNS = (
    *("architecture", "solution", "other", "hazards", "detected", "failures", "missed", "missed_share"),
    *("common_missed", "time_to_detect_median_s", "time_to_detect_max_s", "alarms", "false_alarms"),
    *("false_alarm_rate_per_h", "wrong_in_use_s", "availability", "mtbf_h", "continuity_15s"),
)


def architectures_section(identity: str, counts: pl.DataFrame) -> str:
    """`counts` as of `pipeline.safety.tally`; nothing where there is but one solution."""
    if counts["other"].null_count() == counts.height:
        return ""
    found = architecture_figures(counts)
    shown = frame_table(f"table-{identity}", "Composite and reactive fail-safety side by side", found, _COLUMNS)
    return section(identity, "Architectures", _NOTE, shown)
