"""Two results against each other: runs, hazards matched by time and class, and every other value."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass

import polars as pl

from pipeline import storage
from pipeline.diff.hazards import HAZARD_WINDOW_S, HazardChange, compare_hazards
from pipeline.diff.tables import Difference, compare_tables
from pipeline.results import store
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
# How a result was made is told, but it is no change of the result.
_PROVENANCE = ("config_digest", "input_digest", "software", "contract")


@dataclass(frozen=True)
class RunDiff:
    """What changed in one run. `made_otherwise`: digests and versions that differ, which is no change."""

    run_id: str
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

    def text(self) -> str:
        """For people: one line per finding, the verdict last."""
        lines = [f"{run}: only in A" for run in self.only_in_a] + [f"{run}: only in B" for run in self.only_in_b]
        for run in self.runs:
            lines += [f"{run.run_id}:", *(f"  {finding}" for finding in run.findings)]
        lines += [f"note: {note}" for note in self.notes]
        verdict = "all the same" if not self.runs else f"{len(self.runs)} changed"
        alone = [f"{len(runs)} only in {name}" for runs, name in ((self.only_in_a, "A"), (self.only_in_b, "B")) if runs]
        lines.append(", ".join([f"{self.compared} runs in both: {verdict}", *alone]))
        return "\n".join(lines)

    def as_dict(self) -> dict[str, object]:
        """For programs: plain values, as JSON holds them."""
        return {"same": self.same, **asdict(self)}


def diff_results(out_a: Address, out_b: Address, hazard_window_s: float = HAZARD_WINDOW_S) -> ResultDiff:
    """Compare two results run by run; files of the same bytes are not opened.

    Hazards of the same solution and class at most `hazard_window_s` [s] apart are the same hazard.
    """
    runs_a, runs_b = (store.complete_runs(out) for out in (out_a, out_b))
    common = [run for run in runs_a if run in set(runs_b)]
    found = [_diff_run(out_a, out_b, run, hazard_window_s) for run in common]
    return ResultDiff(
        compared=len(common),
        only_in_a=tuple(run for run in runs_a if run not in set(runs_b)),
        only_in_b=tuple(run for run in runs_b if run not in set(runs_a)),
        runs=tuple(run for run in found if not run.same),
        notes=_notes(found),
    )


def _notes(runs: list[RunDiff]) -> tuple[str, ...]:
    counts = Counter(column for run in runs for column in run.made_otherwise)
    return tuple(f"{column} differs in {counts[column]} runs" for column in _PROVENANCE if counts[column])


def _diff_run(out_a: Address, out_b: Address, run_id: str, window_s: float) -> RunDiff:
    hazards: list[HazardChange] = []
    differences: list[Difference] = []
    for table, contract in TABLES.items():
        a, b = (_content(out, table, run_id) for out in (out_a, out_b))
        if a == b:
            continue
        frame_a, frame_b = (_frame(out, table, run_id, content) for out, content in ((out_a, a), (out_b, b)))
        if table == "hazards":
            found, hazards = compare_hazards(frame_a, frame_b, window_s)
        else:
            found = compare_tables(frame_a, frame_b, contract, _KEYS[table])
        differences += found
    made = [item for item in differences if item.kind == "values" and item.column in _PROVENANCE]
    changed = [item for item in differences if item not in made]
    return RunDiff(run_id, tuple(hazards), tuple(changed), tuple(item.column for item in made))


def _frame(out: Address, table: str, run_id: str, content: bytes) -> pl.DataFrame:
    try:
        return read_parquet(content)
    except ParquetError as error:
        place = redacted(str(store.table_address(out, table, run_id)))
        raise UsageError(f"cannot be read: {error}", place=place, remedy="Replay the run again with --force.") from None


def _content(out: Address, table: str, run_id: str) -> bytes:
    address = store.table_address(out, table, run_id)
    content = storage.content_of(address)
    if content is None:
        place = redacted(str(address))
        raise UsageError("is missing from a complete run", place=place, remedy="Replay the run again with --force.")
    return content
