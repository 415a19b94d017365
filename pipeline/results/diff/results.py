"""Two results against each other: runs, hazards matched by time and class, and every other value."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass

import polars as pl

from pipeline import storage
from pipeline.results import store
from pipeline.results.diff.hazards import HazardChange, compare_hazards
from pipeline.results.diff.leading import BALISE_COUNTS, balise_counts, passage_changes, verdict_changes
from pipeline.results.diff.tables import Difference, compare_tables
from pipeline.results.workers import told
from pipeline.storage.address import Address, redacted
from pipeline.storage.parquet import ParquetError, read_parquet
from schemas.errors import UsageError
from schemas.tables import TABLES

_KEYS: dict[str, tuple[str, ...]] = {
    "passages": ("solution", "kind", "balise_id"),
    "alarms": ("solution", "alarm_id"),
    "epochs": ("solution", "t"),
    "runs": ("solution",),
}
# How a result was made is shown, but is no change of the result.
_PROVENANCE = ("config_digest", "input_digest", "software", "contract")
_LINES_SHOWN = 20
_COLUMNS_SHOWN = 8


@dataclass(frozen=True)
class RunDiff:
    """What changed in one run. `made_otherwise`: digests and versions that differ, which is no change.

    `verdicts` and `balises` say in words what matters most of `differences`.
    """

    run_id: str
    verdicts: tuple[str, ...] = ()
    balises: tuple[str, ...] = ()
    hazards: tuple[HazardChange, ...] = ()
    differences: tuple[Difference, ...] = ()
    made_otherwise: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        return not (self.hazards or self.differences)

    @property
    def findings(self) -> list[HazardChange | Difference]:
        """All that changed, the verdict first."""
        verdicts = [item for item in self.differences if item.column == "verdict"]
        return [*verdicts, *self.hazards, *(item for item in self.differences if item not in verdicts)]

    @property
    def other_columns(self) -> set[str]:
        """Columns that changed beside verdicts, hazards and balises."""
        shown = {"runs.verdict", "passages.status", *(f"runs.{name}" for name in BALISE_COUNTS)}
        return {item.place for item in self.differences} - shown


@dataclass(frozen=True)
class ResultDiff:
    """What changed from result A to result B: `runs` holds the changed ones only."""

    compared: int
    only_in_a: tuple[str, ...] = ()
    only_in_b: tuple[str, ...] = ()
    runs: tuple[RunDiff, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        return not (self.only_in_a or self.only_in_b or self.runs)

    def text(self, detail: bool = False) -> str:
        """For people: how much changed, then verdicts, hazards and balises; in `detail` also every other value."""
        lines = [self._sentence(), *(f"note: {note}" for note in self.notes)]
        lines += [f"{run}: only in A" for run in self.only_in_a] + [f"{run}: only in B" for run in self.only_in_b]
        lines += _section("Verdicts", [(run.run_id, text) for run in self.runs for text in run.verdicts], detail)
        lines += _section("Hazards", self._hazards(), detail)
        lines += _section("Balises", [(run.run_id, text) for run in self.runs for text in run.balises], detail)
        if not detail:
            return "\n".join([*lines, *self._others()])
        for run in self.runs:
            lines += ["", f"{run.run_id}:", *(f"  {finding}" for finding in run.findings)]
        return "\n".join(lines)

    def _sentence(self) -> str:
        verdict = "all the same" if not self.runs else f"{len(self.runs)} changed"
        alone = [f"{len(runs)} only in {name}" for runs, name in ((self.only_in_a, "A"), (self.only_in_b, "B")) if runs]
        return ", ".join([f"{self.compared} runs in both: {verdict}", *alone])

    def _hazards(self) -> list[tuple[str, str]]:
        """Those that came, went or were judged otherwise, and how many have other figures only."""
        rows = [(run.run_id, item.short) for run in self.runs for item in run.hazards if item.matters]
        figures = Counter(run.run_id for run in self.runs for item in run.hazards if not item.matters)
        return rows + [(run_id, f"{count} with other figures only") for run_id, count in figures.items()]

    def _others(self) -> list[str]:
        """What else changed, by column; the values are in the detail."""
        counts = Counter(column for run in self.runs for column in sorted(run.other_columns))
        if not counts:
            return []
        listed = ", ".join(column for column, _ in counts.most_common(_COLUMNS_SHOWN))
        more = f" and {len(counts) - _COLUMNS_SHOWN} more" if len(counts) > _COLUMNS_SHOWN else ""
        return ["", f"Other columns that changed: {listed}{more}. --detail shows the values."]

    def as_dict(self) -> dict[str, object]:
        """For programs: plain values, as JSON holds them."""
        return {"same": self.same, **asdict(self)}


def diff_results(out_a: Address, out_b: Address) -> ResultDiff:
    """Compare two results run by run; files of the same bytes are not opened.

    Hazards of the same solution and class at most `HAZARD_WINDOW_S` apart are the same hazard.
    """
    runs_a, runs_b = (store.complete_runs(out) for out in (out_a, out_b))
    common = [run for run in runs_a if run in set(runs_b)]
    diffs = [_diff_run(out_a, out_b, run) for run in told(common)]
    others = Counter(column for run in diffs for column in run.made_otherwise)
    return ResultDiff(
        compared=len(common),
        only_in_a=tuple(run for run in runs_a if run not in set(runs_b)),
        only_in_b=tuple(run for run in runs_b if run not in set(runs_a)),
        runs=tuple(run for run in diffs if not run.same),
        notes=tuple(f"{column} differs in {others[column]} runs" for column in _PROVENANCE if others[column]),
    )


def _section(title: str, rows: list[tuple[str, str]], detail: bool) -> list[str]:
    """A heading and one line per change, the run in front; not more than a screen without `detail`."""
    if not rows:
        return []
    shown = rows if detail else rows[:_LINES_SHOWN]
    width = max(len(run_id) for run_id, _ in shown)
    more = [f"  and {len(rows) - len(shown)} more"] if len(rows) > len(shown) else []
    return ["", title, *(f"  {run_id:<{width}}  {text}" for run_id, text in shown), *more]


def _diff_run(out_a: Address, out_b: Address, run_id: str) -> RunDiff:
    hazards: list[HazardChange] = []
    differences: list[Difference] = []
    verdicts: tuple[str, ...] = ()
    balises: tuple[str, ...] = ()
    for table, contract in TABLES.items():
        a, b = (_recorded(out, table, run_id) for out in (out_a, out_b))
        if isinstance(a, bytes) and isinstance(b, bytes) and a == b:
            continue
        frame_a, frame_b = (_frame(out, table, run_id, content) for out, content in ((out_a, a), (out_b, b)))
        if frame_a.equals(frame_b):
            continue
        if table == "hazards":
            differing, hazards = compare_hazards(frame_a, frame_b)
        else:
            differing = compare_tables(frame_a, frame_b, contract, _KEYS[table])
        if table == "runs":
            verdicts = verdict_changes(frame_a, frame_b)
            balises = balise_counts(frame_a, frame_b) + balises
        elif table == "passages":
            balises = passage_changes(frame_a, frame_b)
        differences += differing
    made = [item for item in differences if item.kind == "values" and item.column in _PROVENANCE]
    changed = [item for item in differences if item not in made]
    return RunDiff(run_id, verdicts, balises, tuple(hazards), tuple(changed), tuple(item.column for item in made))


def _frame(out: Address, table: str, run_id: str, recorded: bytes | pl.DataFrame) -> pl.DataFrame:
    try:
        return read_parquet(recorded) if isinstance(recorded, bytes) else recorded
    except ParquetError as error:
        place = redacted(str(store.table_address(out, table, run_id)))
        raise UsageError(f"cannot be read: {error}", place=place, remedy="Replay the run again with --force.") from None


def _recorded(out: Address, table: str, run_id: str) -> bytes | pl.DataFrame:
    """The run's own file, or its rows in a pack."""
    if (packed := store.packed_frame(out, table, run_id)) is not None:
        return packed
    address = store.table_address(out, table, run_id)
    if (content := storage.content_of(address)) is None:
        place = redacted(str(address))
        raise UsageError("is missing from a complete run", place=place, remedy="Replay the run again with --force.")
    return content
