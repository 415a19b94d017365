"""Composite and reactive fail-safety side by side, on the pages of runs and of the campaign."""

from __future__ import annotations

from collections.abc import Iterable

import polars as pl

from pipeline.report.markup import Cell, cell, number, section, table

_NOTE = (
    "<p>Reactive: a solution diagnosed by itself (LOC Fig. 4). Composite: two solutions compared, both needed (LOC "
    "Fig. 3); blind to what they share. Reactive 1oo2: one of two such channels is enough (LOC eq. 11). Judged after "
    "the fact on the same faults.</p>"
)
_COLUMNS = (
    ("hazards", "faults"), ("detected", "detected"), ("failures", "failures"), ("missed", "missed"),
    ("missed_share", "missed share (95 %)"), ("common_missed", "missed, common to both"),
    ("time_to_detect_median_s", "T_D median [s]"), ("time_to_detect_max_s", "T_D max [s]"), ("alarms", "alarms"),
    ("false_alarms", "false alarms"), ("false_alarm_rate", "false alarms per h (95 %)"),
    ("wrong_in_use_s", "wrong and in use [s]"), ("availability", "availability"),
    ("mtbf", "MTBF [h] (95 %)"), ("mtbf_expected_h", "MTBF if independent [h]"),
    ("continuity_15s", "continuity over 15 s"),
)  # fmt: skip
_BOUNDED = {"missed_share": "", "false_alarm_rate": "_per_h", "mtbf": "_h"}


def architectures_section(identity: str, found: pl.DataFrame) -> str:
    """`found` as from `side_by_side_table`; nothing where there is but one solution."""
    if found.is_empty() or found["other"].null_count() == found.height:
        return ""
    rows = [
        [cell(row["architecture"]), cell(row["solution"]), cell(row["other"]), *_figures(row)]
        for row in found.iter_rows(named=True)
    ]
    titles = ["architecture", "solution", "with", *(title for _, title in _COLUMNS)]
    shown = table(f"table-{identity}", "Composite and reactive fail-safety side by side", titles, rows)
    return section(identity, "Architectures", _NOTE, shown)


def _figures(row: dict[str, object]) -> Iterable[Cell]:
    for name, _ in _COLUMNS:
        if name in _BOUNDED:
            unit = _BOUNDED[name]
            yield _bounded(*(row[f"{name}{part}{unit}"] for part in ("", "_low", "_high")))
        else:
            yield cell(row[name], 4)


def _bounded(value: object, low: object, high: object) -> Cell:
    """A value with its bounds; `at least` where only the lower one is known."""
    known = [float(part) if isinstance(part, int | float) else None for part in (value, low, high)]
    if known[0] is None:
        return Cell("not known") if known[1] is None else Cell(f"at least {number(known[1])}", known[1])
    return Cell(f"{number(known[0])} ({number(known[1])} to {number(known[2])})", known[0])


def map_section(places: pl.DataFrame) -> str:
    """Places where several runs raised the same alarm across the track; nothing where there are none."""
    if places.is_empty():
        return ""
    columns = ("netelement_id", "from_m", "to_m", "axis", "runs", "alarms", "solutions", "run_ids")
    rows = [[cell(row[name]) for name in columns] for row in places.iter_rows(named=True)]
    titles = ["net element", "from [m]", "to [m]", "across", "runs", "alarms", "solutions", "run ids"]
    note = "<p>Monitors across the track alone failed there in several runs: look at the survey first.</p>"
    return section("map", "Places where the map is in doubt", note, table("table-map", "Map in doubt", titles, rows))
