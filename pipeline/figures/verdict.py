"""The verdict of a run (DOMAIN section 5.4), by service level too (TVB eq. 7), and what heads several runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from schemas.config import Configuration
from schemas.enums import TRUTH, Evidence, Judgement, RunStatus, RunVerdict, ThrVerdict

Row = Mapping[str, Any]
Failure = tuple[float, float, str]
"""Hazardous time [s], the same with what is unknown, and the worst judgement of the VBs accepted meanwhile."""


def verdict_of(run: Row, unknown_share_limit: float) -> RunVerdict:
    """The worst that applies, from the counts and the share of one `runs` row (DOMAIN section 5.4)."""
    unsafe, unproven = _reasons(run, unknown_share_limit)
    return RunVerdict.UNSAFE if unsafe else RunVerdict.UNPROVEN if unproven else RunVerdict.SAFE


def verdict_reasons(run: Row, unknown_share_limit: float) -> str:
    """Why the verdict is what it is."""
    unsafe, unproven = _reasons(run, unknown_share_limit)
    if not unsafe + unproven and run["verdict"] == RunVerdict.UNPROVEN:
        return "its streams do not fit each other, as the notes say"
    return "; ".join(unsafe + unproven) or "every acceptance right, every position failure within the time allowed"


def _reasons(run: Row, unknown_share_limit: float) -> tuple[list[str], list[str]]:
    """What makes a run unsafe, and what leaves it unproven.

    A failure of which the evidence cannot say whether it was within the budget leaves the run unproven. So does a
    `share_unknown` of None: the position was never in use while the train moved.
    """
    share = run["share_unknown"]
    undecided = run["failures"] - run["failures_within_budget"] - run["failures_beyond_budget"]
    unsafe = {
        "VBs accepted despite a wrong position: {}": run["unsafe_accepted"],
        "position failures in use for longer than allowed: {}": run["failures_beyond_budget"],
    }
    unproven = {
        "VBs accepted that nothing can check: {}": run["unproven_accepted"],
        "position failures of unknown length: {}": undecided,
        "no position was in use while the train moved": share is None,
        f"{share or 0.0:.1%} of the moving time in use could not be checked": share is not None
        and share > unknown_share_limit,
        "no VB was accepted": not run["balises_accepted"],
    }
    said, left = ([text.format(count) for text, count in found.items() if count] for found in (unsafe, unproven))
    return said, left


def worst_verdict(verdicts: Iterable[RunVerdict | str | None]) -> RunVerdict | None:
    """The verdict that heads several; None stands for one that failed, and proves nothing beside others."""
    found = {None if verdict is None else RunVerdict(verdict) for verdict in verdicts}
    if RunVerdict.UNSAFE in found:
        return RunVerdict.UNSAFE
    if not found - {None}:
        return None
    return RunVerdict.SAFE if found == {RunVerdict.SAFE} else RunVerdict.UNPROVEN


@dataclass(frozen=True)
class CampaignHead:
    """The verdict of a campaign, and how many runs have which; `failed`: no solution could be replayed."""

    verdict: RunVerdict | None
    unsafe: int
    unproven: int
    safe: int
    failed: int

    @property
    def word(self) -> str:
        return word_of(self.verdict)

    def counts(self) -> dict[str, int]:
        """Runs by verdict, worst first; failed ones last."""
        return {"unsafe": self.unsafe, "unproven": self.unproven, "safe": self.safe, "failed": self.failed}

    def __str__(self) -> str:
        return f"{self.word}: " + ", ".join(f"{count} {name}" for name, count in self.counts().items())


def word_of(verdict: RunVerdict | str | None) -> str:
    """The first word of every report, table and summary."""
    return RunStatus.FAILED.value if verdict is None else str(verdict)


def head_of(verdicts: Iterable[RunVerdict | None]) -> CampaignHead:
    """The head of a campaign from the verdicts of its runs."""
    found = list(verdicts)
    counts = {verdict.value: found.count(verdict) for verdict in RunVerdict}
    return CampaignHead(worst_verdict(found), **counts, failed=found.count(None))


def run_verdicts(runs: pl.DataFrame) -> dict[str, RunVerdict | None]:
    """Each run's verdict, the worst of its solutions, from `runs` with `run_id`."""
    listed = runs.group_by("run_id").agg(pl.col("verdict").cast(pl.String)).sort("run_id")
    return {run_id: worst_verdict(verdicts) for run_id, verdicts in listed.iter_rows()}


LEVEL_LISTS = {
    "service_level": "service_levels",
    "allowed_s": "level_allowed_s",
    "within": "level_within",
    "exceeded": "level_exceeded",
    "verdict": "level_verdict",
}
"""What `level_rows` tells of each service level, and the list of the `runs` table that holds it."""


def level_rows(
    failures: Sequence[Failure],
    evidence: Evidence | str | None,
    share_unknown: float | None,
    config: Configuration,
) -> list[dict[str, object]]:
    """The failures of one run against the allowed T_D of each service level, with the verdict on it."""
    proven = _is_proven(evidence, share_unknown, config.hazards.unknown_share_limit)
    rows: list[dict[str, object]] = []
    for level in config.safety.service_levels:
        allowed_s = config.safety.allowed_time_to_detect_s(level)
        within, exceeded = level_counts(failures, allowed_s)
        verdict = _verdict(len(failures), within, exceeded, proven=proven).value
        rows.append(dict(zip(LEVEL_LISTS, (level, allowed_s, within, exceeded, verdict), strict=True)))
    return rows


def failures_in(run: Row) -> list[Failure]:
    """The failures of one `runs` row, in order of time."""
    lists = ("failure_hazardous_s", "failure_hazardous_may_s", "failure_accepted")
    return list(zip(*(run[name] or [] for name in lists), strict=True))


def level_counts(failures: Sequence[Failure], allowed_s: float) -> tuple[int, int]:
    """How many failures kept the allowed time whatever is unknown, and how many did not for certain.

    One in which a VB was accepted wrong did not, one with an unknown acceptance may not have (DOMAIN section 5.3).
    """
    within = sum(may_s <= allowed_s and accepted == Judgement.RIGHT for _, may_s, accepted in failures)
    return within, sum(spent_s > allowed_s or accepted == Judgement.WRONG for spent_s, _, accepted in failures)


def _verdict(failures: int, within: int, exceeded: int, *, proven: bool) -> ThrVerdict:
    """`proven`: next to nothing of the run is unknown (`_is_proven`), so that no failure can be hidden."""
    if exceeded:
        return ThrVerdict.EXCEEDED
    if within < failures or not proven:
        return ThrVerdict.UNKNOWN
    return ThrVerdict.KEPT if failures else ThrVerdict.NO_FAILURE


def _is_proven(evidence: Evidence | str | None, share_unknown: float | None, unknown_share_limit: float) -> bool:
    """A reference or balise reads judge the position in use but for the share that a verdict may leave unknown."""
    return evidence in TRUTH and share_unknown is not None and share_unknown <= unknown_share_limit
