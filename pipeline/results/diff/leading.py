"""What a reader wants to know first of two results of one run: verdicts, and what became of the balises."""

from __future__ import annotations

import polars as pl

BALISE_COUNTS = {
    "balises_on_path": "on the path",
    "balises_accepted": "accepted",
    "balises_rejected": "rejected",
    "balises_missed": "not found",
    "balises_not_available": "without a position",
    "unsafe_accepted": "accepted despite a wrong position",
    "unproven_accepted": "accepted that nothing can check",
}


def verdict_changes(a: pl.DataFrame, b: pl.DataFrame) -> tuple[str, ...]:
    """Solutions whose verdict is another one, from two `runs` tables of one run."""
    return tuple(
        f"{_of(solution, a, b)}{before or 'failed'} became {after or 'failed'}"
        for solution, before, after in _both(a, b, "verdict")
        if before != after
    )


def balise_counts(a: pl.DataFrame, b: pl.DataFrame) -> tuple[str, ...]:
    """`accepted 15 became 3`: counts of virtual balises that changed, from two `runs` tables of one run."""
    return tuple(
        f"{_of(solution, a, b)}{words} {_or_unknown(before)} became {_or_unknown(after)}"
        for column, words in BALISE_COUNTS.items()
        for solution, before, after in _both(a, b, column)
        if before != after
    )


def passage_changes(a: pl.DataFrame, b: pl.DataFrame) -> tuple[str, ...]:
    """`VB04 VB05: accepted became rejected_monitor`, from two `passages` tables of one run."""
    moved: dict[tuple[str, str, str], list[str]] = {}
    before = _statuses(a)
    after = _statuses(b)
    for key in dict.fromkeys([*before, *after]):
        was = before.get(key, "no passage")
        became = after.get(key, "no passage")
        if was != became:
            moved.setdefault((key[0], was, became), []).append(key[1])
    return tuple(
        f"{_of(solution, a, b)}{' '.join(balises)}: {was} became {became}"
        for (solution, was, became), balises in moved.items()
    )


def _or_unknown(count: object) -> object:
    return "unknown" if count is None else count


def _both(a: pl.DataFrame, b: pl.DataFrame, column: str) -> list[tuple[str, object, object]]:
    """Solution and both values, of the solutions that stand in both; nothing where a result has no such column."""
    if column not in a.columns or column not in b.columns:
        return []
    values = [dict(frame.select("solution", column).iter_rows()) for frame in (a, b)]
    return [(solution, value, values[1][solution]) for solution, value in values[0].items() if solution in values[1]]


def _statuses(passages: pl.DataFrame) -> dict[tuple[str, str], str]:
    """What became of each balise of each solution, turn by turn."""
    if not {"solution", "balise_id", "status"} <= set(passages.columns):
        return {}
    listed = passages.group_by("solution", "balise_id", maintain_order=True).agg(pl.col("status").cast(pl.String))
    return {(solution, balise): ", ".join(statuses) for solution, balise, statuses in listed.iter_rows()}


def _of(solution: str, a: pl.DataFrame, b: pl.DataFrame) -> str:
    """The solution in front, where there is more than one."""
    several = pl.concat([a["solution"], b["solution"]]).n_unique() > 1
    return f"{solution}: " if several else ""
