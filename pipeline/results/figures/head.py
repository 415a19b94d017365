"""What heads several runs: the worst verdict, how many have which, the figures beside it, and counts not known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import polars as pl

from schemas.campaign import STANFORD
from schemas.enums import Hazard, RunStatus, RunVerdict
from schemas.frozen import frozen


def worst_verdict(verdicts: Iterable[RunVerdict | str | None]) -> RunVerdict | None:
    """The verdict that heads several; None stands for one that failed, and proves nothing among others."""
    known = {None if verdict is None else RunVerdict(verdict) for verdict in verdicts}
    if RunVerdict.UNSAFE in known:
        return RunVerdict.UNSAFE
    if not known - {None}:
        return None
    return RunVerdict.SAFE if known == {RunVerdict.SAFE} else RunVerdict.UNPROVEN


@frozen
class CampaignHead:
    """The verdict of a campaign, and how many runs have which; `failed`: no solution could be replayed."""

    verdict: RunVerdict | None
    unsafe: int
    unproven: int
    safe: int
    failed: int

    @property
    def word(self) -> str:
        """The verdict in one word."""
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
    listed = list(verdicts)
    counts = {verdict.value: listed.count(verdict) for verdict in RunVerdict}
    return CampaignHead(worst_verdict(listed), **counts, failed=listed.count(None))


def run_verdicts(runs: pl.DataFrame) -> dict[str, RunVerdict | None]:
    """Verdict of each run, the worst of its solutions, from `runs` with `run_id`."""
    listed = runs.group_by("run_id").agg(pl.col("verdict").cast(pl.String)).sort("run_id")
    return {run_id: worst_verdict(verdicts) for run_id, verdicts in listed.iter_rows()}


def verdict_figures(runs: pl.DataFrame) -> Mapping[str, Any]:
    """The figures beside a campaign's verdict: sums, availability by moving time, the least margin, and where the
    odometers of its safe runs come from by their declarations.
    """
    weight_s = pl.col("moving_s").filter(pl.col("availability").is_not_null()).sum()
    available = (pl.col("availability") * pl.col("moving_s")).sum() / weight_s
    figures = runs.select(
        pl.col("balises_found", "balises_passed", "balises_accepted", "balises_on_path").sum(),
        pl.col("proof_margin_m").min(),
        availability=pl.when(weight_s > 0.0).then(available),
    )
    declared = runs.filter(pl.col("verdict") == RunVerdict.SAFE.value)["odometer_origin"].cast(pl.String).drop_nulls()
    return {**figures.row(0, named=True), "odometer_origins": declared.unique().sort().to_list()}


HAZARD_COUNTS = tuple(kind.counted_as for kind in Hazard)
"""Rows of the hazard table by class."""

JUDGED_COUNTS = (
    *("unsafe_accepted", *HAZARD_COUNTS, "hazards_detected", "hazards_within_budget", "faults", "missed_detections"),
    *("failures", "failures_within_budget", "failures_beyond_budget"),
    *(f"stanford_{kind}" for kind in STANFORD),
)
"""Counts that need evidence: a run without any has none, which is not the same as having found nothing."""


def is_judged(row: Mapping[str, Any]) -> bool:
    """Whether the judged counts of a row of `runs` mean something, as in `known_counts`."""
    return row["status"] != RunStatus.FAILED and row["evidence"] is not None


def known_counts(runs: pl.DataFrame) -> pl.DataFrame:
    """Rows of `runs` with null for counts that mean nothing: all of a failed run, the judged ones without evidence.

    Columns as in `runs`, or some of them with `status` and `evidence`.
    """
    failed = pl.col("status") == RunStatus.FAILED
    blind = pl.col("evidence").is_null()
    counts = [name for name, dtype in runs.schema.items() if dtype == pl.Int64]
    return runs.with_columns(
        pl.when(failed | blind if name in JUDGED_COUNTS else failed).then(None).otherwise(pl.col(name)).alias(name)
        for name in counts
    )
