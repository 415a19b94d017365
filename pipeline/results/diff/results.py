"""Two results against each other: runs, hazards matched by time and class, and every other value."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict

import polars as pl

from pipeline import storage
from pipeline.results import store
from pipeline.results.diff.hazards import HazardChange, compare_hazards
from pipeline.results.diff.rules import Rules
from pipeline.results.diff.tables import NO_RULES, Difference, compare_tables
from pipeline.results.workers import with_progress
from pipeline.storage.address import Address, redacted
from pipeline.storage.parquet import ParquetError, read_parquet
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.tables import TABLES

_KEYS: dict[str, tuple[str, ...]] = {
    "passages": ("solution", "kind", "balise_id"),
    "alarms": ("solution", "alarm_id"),
    "epochs": ("solution", "t"),
    "runs": ("solution",),
}
# How a result was made is shown, but is no change of the result.
_PROVENANCE = ("config_digest", "input_digest", "software", "contract")
BALISE_COUNTS = {
    "balises_passed": "passed",
    "balises_found": "found",
    "balises_on_path": "passages",
    "balises_accepted": "accepted",
    "balises_rejected": "rejected",
    "balises_missed": "not found",
    "balises_not_available": "without a position",
    "unsafe_accepted": "accepted despite a wrong position",
    "unproven_accepted": "accepted that nothing can check",
}
_LINES_SHOWN = 20
_COLUMNS_SHOWN = 8


@frozen
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
    def is_same(self) -> bool:
        """Whether nothing differs."""
        return not (self.hazards or self.differences)

    @property
    def findings(self) -> list[HazardChange | Difference]:
        """All that changed, the verdict first."""
        verdicts = [item for item in self.differences if item.column == "verdict"]
        return [*verdicts, *self.hazards, *(item for item in self.differences if item not in verdicts)]

    @property
    def other_columns(self) -> set[str]:
        """Columns that changed, other than verdicts, hazards and balises."""
        shown = {"runs.verdict", "passages.status", *(f"runs.{name}" for name in BALISE_COUNTS)}
        return {item.place for item in self.differences} - shown


@frozen
class ResultDiff:
    """What changed from result A to result B: `runs` holds the changed ones only."""

    compared: int
    only_in_a: tuple[str, ...] = ()
    only_in_b: tuple[str, ...] = ()
    runs: tuple[RunDiff, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def is_same(self) -> bool:
        """Whether both results have the same runs, and nothing differs in any."""
        return not (self.only_in_a or self.only_in_b or self.runs)

    def text(self, detail: bool = False) -> str:
        """How much changed, for people; then verdicts, hazards and balises, in `detail` also every other value."""
        lines = [self._sentence(), *(f"note: {note}" for note in self.notes)]
        lines += [f"{run}: only in A" for run in self.only_in_a] + [f"{run}: only in B" for run in self.only_in_b]
        lines += _section_lines("Verdicts", [(run.run_id, text) for run in self.runs for text in run.verdicts], detail)
        lines += _section_lines("Hazards", self._hazard_lines(), detail)
        lines += _section_lines("Balises", [(run.run_id, text) for run in self.runs for text in run.balises], detail)
        if not detail:
            return "\n".join([*lines, *self._other_lines()])
        for run in self.runs:
            lines += ["", f"{run.run_id}:", *(f"  {finding}" for finding in run.findings)]
        return "\n".join(lines)

    def _sentence(self) -> str:
        """How many runs were compared, and how many changed, for people."""
        verdict = "all the same" if not self.runs else f"{len(self.runs)} changed"
        alone = [f"{len(runs)} only in {name}" for runs, name in ((self.only_in_a, "A"), (self.only_in_b, "B")) if runs]
        return ", ".join([f"{self.compared} runs in both: {verdict}", *alone])

    def _hazard_lines(self) -> list[tuple[str, str]]:
        """Hazards that came, went or were judged otherwise, and how many have other figures only."""
        rows = [(run.run_id, item.one_line) for run in self.runs for item in run.hazards if item.changes_decision]
        figures = Counter(run.run_id for run in self.runs for item in run.hazards if not item.changes_decision)
        return rows + [(run_id, f"{count} with other figures only") for run_id, count in figures.items()]

    def _other_lines(self) -> list[str]:
        """What else changed, by column; the values are in the detail."""
        counts = Counter(column for run in self.runs for column in sorted(run.other_columns))
        if not counts:
            return []
        listed = ", ".join(column for column, _ in counts.most_common(_COLUMNS_SHOWN))
        more = f" and {len(counts) - _COLUMNS_SHOWN} more" if len(counts) > _COLUMNS_SHOWN else ""
        return ["", f"Other columns that changed: {listed}{more}. --detail shows the values."]

    def as_dict(self) -> dict[str, object]:
        """The difference for programs: plain values, as JSON holds them."""
        return {"same": self.is_same, **asdict(self)}


def diff_results(out_a: Address, out_b: Address, rules: Rules = NO_RULES) -> ResultDiff:
    """Compare two results run by run; files of the same bytes are not opened.

    Hazards of the same solution and class at most `HAZARD_WINDOW_S` apart are the same hazard.

    Args:
        out_a: the first result.
        out_b: the second one.
        rules: what may differ.

    Returns:
        Runs that only one of them has, and the differences of the others.
    """
    runs_a, runs_b = (store.complete_runs(out) for out in (out_a, out_b))
    common = [run for run in runs_a if run in set(runs_b)]
    diffs = [_diff_run(out_a, out_b, run, rules) for run in with_progress(common)]
    others = Counter(column for run in diffs for column in run.made_otherwise)
    return ResultDiff(
        compared=len(common),
        only_in_a=tuple(run for run in runs_a if run not in set(runs_b)),
        only_in_b=tuple(run for run in runs_b if run not in set(runs_a)),
        runs=tuple(run for run in diffs if not run.is_same),
        notes=tuple(f"{column} differs in {others[column]} runs" for column in _PROVENANCE if others[column]),
    )


def _section_lines(title: str, rows: list[tuple[str, str]], detail: bool) -> list[str]:
    """A heading and one line per change, the run in front; not more than a screen without `detail`."""
    if not rows:
        return []
    shown = rows if detail else rows[:_LINES_SHOWN]
    width = max(len(run_id) for run_id, _ in shown)
    more = [f"  and {len(rows) - len(shown)} more"] if len(rows) > len(shown) else []
    return ["", title, *(f"  {run_id:<{width}}  {text}" for run_id, text in shown), *more]


def _diff_run(out_a: Address, out_b: Address, run_id: str, rules: Rules) -> RunDiff:
    """What differs between two results of one run."""
    hazards: list[HazardChange] = []
    differences: list[Difference] = []
    verdicts: tuple[str, ...] = ()
    balises: tuple[str, ...] = ()
    for table, contract in TABLES.items():
        if (pair := _unlike_tables(out_a, out_b, table, run_id)) is None:
            continue
        if table == "hazards":
            differing, hazards = compare_hazards(*pair, rules)
        else:
            differing = compare_tables(*pair, contract, _KEYS[table], rules)
        changed_columns = {item.column for item in differing}
        if table == "runs":
            verdicts = _changed_words(*pair, {"verdict": ""}, unknown="failed") if "verdict" in changed_columns else ()
            counts = {name: words for name, words in BALISE_COUNTS.items() if name in changed_columns}
            balises = _changed_words(*pair, counts, unknown="unknown") + balises
        elif table == "passages" and {"status", ""} & changed_columns:
            balises = _passage_changes(*pair)
        differences += differing
    made = [item for item in differences if item.kind == "values" and item.column in _PROVENANCE]
    changed = tuple(item for item in differences if item not in made)
    return RunDiff(run_id, verdicts, balises, tuple(hazards), changed, tuple(item.column for item in made))


def _unlike_tables(out_a: Address, out_b: Address, table: str, run_id: str) -> tuple[pl.DataFrame, pl.DataFrame] | None:
    """One table of a run in both results; none where it is the same. Files of the same bytes are not opened."""
    content_a, content_b = (_recorded(out, table, run_id) for out in (out_a, out_b))
    if isinstance(content_a, bytes) and isinstance(content_b, bytes) and content_a == content_b:
        return None
    a = _table_of(out_a, table, run_id, content_a)
    b = _table_of(out_b, table, run_id, content_b)
    return None if a.equals(b) else (a, b)


def _changed_words(a: pl.DataFrame, b: pl.DataFrame, columns: Mapping[str, str], unknown: str) -> tuple[str, ...]:
    """`accepted 15 became 3`: values that changed, of the solutions that stand in both `runs` tables of one run."""
    changed = []
    for column, words in columns.items():
        if column not in a.columns or column not in b.columns:
            continue
        before, after = (dict(frame.select("solution", column).iter_rows()) for frame in (a, b))
        for solution in [name for name in before if name in after]:
            was, became = (unknown if of[solution] is None else of[solution] for of in (before, after))
            if before[solution] != after[solution]:
                changed.append(_solution_prefix(solution, a, b) + f"{words} {was} became {became}".strip())
    return tuple(changed)


def _passage_changes(a: pl.DataFrame, b: pl.DataFrame) -> tuple[str, ...]:
    """`VB04 VB05: accepted became rejected_monitor`, from two `passages` tables of one run."""
    moved: dict[tuple[str, str, str], list[str]] = {}
    before = _statuses(a)
    after = _statuses(b)
    for solution, balise in dict.fromkeys([*before, *after]):
        was = before.get((solution, balise), "no passage")
        became = after.get((solution, balise), "no passage")
        if was != became:
            moved.setdefault((solution, was, became), []).append(balise)
    return tuple(
        f"{_solution_prefix(solution, a, b)}{' '.join(balises)}: {was} became {became}"
        for (solution, was, became), balises in moved.items()
    )


def _statuses(passages: pl.DataFrame) -> dict[tuple[str, str], str]:
    """What became of each balise of each solution, turn by turn."""
    if not {"solution", "balise_id", "status"} <= set(passages.columns):
        return {}
    listed = passages.group_by("solution", "balise_id", maintain_order=True).agg(pl.col("status").cast(pl.String))
    return {(solution, balise): ", ".join(statuses) for solution, balise, statuses in listed.iter_rows()}


def _solution_prefix(solution: str, a: pl.DataFrame, b: pl.DataFrame) -> str:
    """The solution in front, where there is more than one."""
    several = pl.concat([a["solution"], b["solution"]]).n_unique() > 1
    return f"{solution}: " if several else ""


def _recorded(out: Address, table: str, run_id: str) -> bytes | pl.DataFrame:
    """The run's own file, or its rows in a pack."""
    if (packed := store.packed_frame(out, table, run_id)) is not None:
        return packed
    content = storage.content_of(store.table_address(out, table, run_id))
    if content is None:
        raise _unreadable_error(out, table, run_id, "is missing from a complete run")
    return content


def _table_of(out: Address, table: str, run_id: str, recorded: bytes | pl.DataFrame) -> pl.DataFrame:
    """A table of a run, in whatever form it was recorded."""
    try:
        return read_parquet(recorded) if isinstance(recorded, bytes) else recorded
    except ParquetError as error:
        raise _unreadable_error(out, table, run_id, f"cannot be read: {error}") from None


def _unreadable_error(out: Address, table: str, run_id: str, reason: str) -> UsageError:
    """The error for a table that cannot be read."""
    place = redacted(str(store.table_address(out, table, run_id)))
    return UsageError(reason, place=place, remedy="Replay the run again with --force.")
