"""Hazards of two results matched by time and class."""

from __future__ import annotations

from typing import Literal

import polars as pl

from pipeline.results.diff.rules import Rules
from pipeline.results.diff.tables import NO_RULES, Difference, compare_tables
from schemas.frozen import frozen
from schemas.tables import Hazards

# Of the comparison of two results, which have a configuration each: an onset moves by an epoch at 1 Hz either way.
HAZARD_WINDOW_S = 2.0
# Columns of a hazard that say what it was, whether it was seen in time and what it hit.
_DECIDING = {
    *("failure_mode", "timing", "evidence", "caused_by", "monitor", "detected", "within_budget"),
    *("balise_ids", "accepted_ids"),
}

Change = Literal["appeared", "vanished", "changed"]


@frozen
class HazardChange:
    """A hazard that stands in one result only, or in both with other values."""

    change: Change
    solution: str
    hazard: str
    t_hazard: str
    differences: tuple[Difference, ...] = ()

    @property
    def _deciding_differences(self) -> list[str]:
        """Differences in columns that decide about a hazard."""
        return [item.column for item in self.differences if item.column in _DECIDING]

    @property
    def changes_decision(self) -> bool:
        """Whether more differs than figures of the same hazard."""
        return self.change != "changed" or bool(self._deciding_differences)

    @property
    def _title(self) -> str:
        """Which hazard it is, and how it changed, for people."""
        return f"{self.hazard} at {self.t_hazard} ({self.solution}) {self.change}"

    @property
    def one_line(self) -> str:
        """The change in one line; of changed values the columns alone."""
        return ": ".join(filter(None, [self._title, ", ".join(self._deciding_differences)]))

    def __str__(self) -> str:
        return self._title + "".join(f"\n    {item.column}: {item.message}" for item in self.differences)


def compare_hazards(
    a: pl.DataFrame, b: pl.DataFrame, rules: Rules = NO_RULES
) -> tuple[list[Difference], list[HazardChange]]:
    """Differences of the tables' schemas, and the hazards that appeared, vanished or changed.

    The numbers of hazards (`hazard_id`, `caused_by`) count as changed only where none came or went.

    Args:
        a: hazards of the first result.
        b: hazards of the second one.
        rules: what may differ.

    Returns:
        Differences of the schemas, and the changes in order of time.
    """
    schema = [item for item in compare_tables(a.clear(), b.clear(), Hazards, rules=rules) if item.kind == "schema"]
    if any(item.column in {"solution", "hazard", "t_hazard"} for item in schema):
        return schema, []
    pairs = _match_rows(a, b)
    changes = [_timed_change("vanished", a, row) for row in range(a.height) if row not in pairs]
    changes += [_timed_change("appeared", b, row) for row in range(b.height) if row not in pairs.values()]
    ids = ["hazard_id", "caused_by"] if changes else []
    for row_a, row_b in pairs.items():
        rows = (
            a.drop(ids, strict=False)[row_a : row_a + 1],
            b.drop(ids, strict=False)[row_b : row_b + 1],
        )
        differing = tuple(item for item in compare_tables(*rows, Hazards, rules=rules) if item.kind == "values")
        if differing:
            changes.append(_timed_change("changed", a, row_a, differing))
    return schema, [change for _, change in sorted(changes, key=lambda item: item[0])]


def _match_rows(a: pl.DataFrame, b: pl.DataFrame) -> dict[int, int]:
    """Rows of `a` to rows of `b`: each at most once, the nearest in time first."""
    rows_a, rows_b = (
        frame.select("solution", pl.col("hazard").cast(pl.String), t=pl.col("t_hazard").to_physical()).rows()
        for frame in (a, b)
    )
    window_ns = round(HAZARD_WINDOW_S * 1e9)
    near = sorted(
        (apart_ns, row_a, row_b)
        for row_a, (solution_a, class_a, t_a) in enumerate(rows_a)
        for row_b, (solution_b, class_b, t_b) in enumerate(rows_b)
        if (solution_a, class_a) == (solution_b, class_b)
        and (apart_ns := 0 if t_a == t_b else window_ns + 1 if None in (t_a, t_b) else abs(t_a - t_b)) <= window_ns
    )
    pairs: dict[int, int] = {}
    for _, row_a, row_b in near:
        if row_a not in pairs and row_b not in pairs.values():
            pairs[row_a] = row_b
    return dict(sorted(pairs.items()))


def _timed_change(
    change: Change, frame: pl.DataFrame, row: int, differences: tuple[Difference, ...] = ()
) -> tuple[int, HazardChange]:
    """The time of a change [ns] and the change; hazards without a time come first."""
    t_text = frame["t_hazard"].dt.to_string("%Y-%m-%dT%H:%M:%S%.3fZ")[row] or "an unknown time"
    found = HazardChange(change, frame["solution"][row], str(frame["hazard"][row]), t_text, differences)
    return int(frame["t_hazard"].to_physical()[row] or 0), found
