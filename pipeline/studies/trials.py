"""Trials as all studies count them: no journey twice, exact bounds, and how many more would show something."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.stages.run_row.bounds import CONFIDENCE, Estimate, clopper_pearson
from pipeline.studies.reservations import sentences
from schemas.enums import RunVerdict

# Share of the distance by which two records of one journey differ at most.
_OTHER_JOURNEY = 0.01


def distinct(runs: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """Rows of `runs` by run and solution without further recordings or replays of one journey, and a remark on them.

    Runs of one solution that begin and end at the same nanoseconds and went as far are one journey: one log under two
    names, or in two formats. The one with the worst verdict stays. Of runs that overlap in time otherwise nobody knows
    whether one train made them: they stay, with a remark.
    """
    order = (
        pl.col("verdict")
        .cast(pl.String)
        .replace_strict({RunVerdict.UNSAFE.value: 0, RunVerdict.UNPROVEN.value: 1}, default=2)
    )
    ends = ["solution", "t_start", "t_end"]
    # Logs of two trains may be cut on the same hour; a vehicle file's scale changes the distance by less.
    apart_m = (pl.col("distance_m") - pl.col("distance_m").first().over(ends)).abs()
    another = (apart_m > _OTHER_JOURNEY * pl.col("distance_m").first().over(ends)).fill_null(value=False)
    kept = runs.sort("solution", order, "run_id").filter(
        pl.struct(ends).is_first_distinct() | pl.col("t_start").is_null() | another
    )
    left = runs.height - kept.height
    ends_before = pl.col("t_end").shift().cum_max().over("solution")
    overlapping = kept.sort("solution", "t_start").filter(pl.col("t_start") < ends_before).height
    return kept.sort("run_id", "solution"), sentences("studies", {"one_journey": left, "overlapping": overlapping})


@dataclass(frozen=True)
class Trials:
    """Independent trials: those that the evidence judged, the bad ones among them, and those that it did not judge."""

    judged: int
    bad: int
    unjudged: int = 0

    def share(self, confidence: float = CONFIDENCE) -> Estimate:
        """Share of bad trials; what was not judged counts as good in the lower bound and as bad in the upper one."""
        number = self.judged + self.unjudged
        low = clopper_pearson(self.bad, number, confidence).low
        high = clopper_pearson(self.bad + self.unjudged, number, confidence).high
        return Estimate(self.bad / self.judged if self.judged else None, low, high)

    def needed(self, limit: float, confidence: float = CONFIDENCE) -> int | None:
        """Further good trials until the upper bound of the share keeps the limit; None beyond 2^40."""
        return trials_needed(self.bad + self.unjudged, self.judged + self.unjudged, limit, confidence)


def trials_needed(bad: int, number: int, limit: float, confidence: float = CONFIDENCE) -> int | None:
    """Further good trials until the upper bound of the share of bad ones keeps the limit; None beyond 2^40.

    `bad` of `number` trials so far; the bound is Clopper and Pearson's.
    """

    def enough(more: int) -> bool:
        high = clopper_pearson(bad, number + more, confidence).high
        return high is not None and high <= limit

    most = next((1 << power for power in range(41) if enough(1 << power)), None)
    if most is None:
        return None
    low = -1
    while most - low > 1:
        middle = (low + most) // 2
        low, most = (low, middle) if enough(middle) else (middle, most)
    return most
