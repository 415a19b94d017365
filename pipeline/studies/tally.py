"""One tally for safety, claim and line: trials and hours counted, their exact bounds, what they show of a limit.

A journey is counted once. What was not judged counts as good in a lower bound and as bad in an upper one, so that
weaker evidence never shows what stronger evidence refutes.
"""

from __future__ import annotations

from enum import StrEnum

import polars as pl

from pipeline.stages.run_row.bounds import (
    CONFIDENCE,
    UNKNOWN,
    Estimate,
    clopper_pearson,
    hours_still_needed,
    poisson_rate,
    poisson_rate_upper,
)
from pipeline.studies.reservations import reservation_sentences
from schemas.enums import RunVerdict
from schemas.frozen import frozen

S_PER_H = 3600.0
# Share of the distance by which two records of one journey differ at most.
_OTHER_JOURNEY = 0.01


class Compliance(StrEnum):
    """What counts show of a limit."""

    MET = "met"
    NOT_MET = "not met"
    NOT_SHOWN = "not shown"


@frozen
class Shown:
    """A finding with the bounds that it rests on; `needed`: good trials or hours still needed to show the limit.

    `needed` is None where no number of them does, or too many to be stated.
    """

    finding: Compliance
    bounds: Estimate = UNKNOWN
    needed: float | None = None


def share_shown(bad: int, judged: int, unjudged: int, limit: float, confidence: float = CONFIDENCE) -> Shown:
    """Whether at most this share of independent trials is bad, by Clopper and Pearson's bounds."""
    number = judged + unjudged
    low = clopper_pearson(bad, number, confidence).low
    high = clopper_pearson(bad + unjudged, number, confidence).high
    needed = trials_needed(bad + unjudged, number, limit, confidence)
    return Shown(_compliance(low, high, limit), Estimate(bad / judged if judged else None, low, high), needed)


def rate_shown(events: int, possible: int, hours: float, hours_known: float, limit_per_h: float) -> Shown:
    """Whether the rate is below the limit, by Garwood's bounds; `met` by the one-sided bound, as a THR claim needs.

    `possible`: how many events there may be at most with all that is not known; the rate itself is of the known hours.
    """
    low = poisson_rate(events, hours).low
    finding = _compliance(low, poisson_rate_upper(possible, hours), limit_per_h)
    return Shown(finding, poisson_rate(events, hours_known), hours_still_needed(limit_per_h, possible, hours))


def _compliance(low: float | None, high: float | None, limit: float) -> Compliance:
    """Whether a limit is met, by the lower and upper bound of what was counted; neither: not shown."""
    if high is not None and high <= limit:
        return Compliance.MET
    return Compliance.NOT_MET if low is not None and low > limit else Compliance.NOT_SHOWN


def trials_needed(bad: int, number: int, limit: float, confidence: float = CONFIDENCE) -> int | None:
    """Good trials after `bad` of `number` until the upper bound of the share keeps the limit; None beyond 2^40."""

    def enough(more: int) -> bool:
        """Whether so many more good trials keep the limit."""
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


def without_repeated_journeys(runs: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """Rows of `runs` by run and solution without further recordings or replays of one journey, and a remark on them.

    Runs of one solution that begin and end at the same nanoseconds and went as far are one journey: one log under two
    names, or in two formats. The one with the worst verdict stays. Of runs that overlap in time otherwise nobody knows
    whether one train made them: they stay, with a remark.
    """
    worst_first = {RunVerdict.UNSAFE.value: 0, RunVerdict.UNPROVEN.value: 1}
    order = pl.col("verdict").cast(pl.String).replace_strict(worst_first, default=2)
    ends = ["solution", "t_start", "t_end"]
    # Logs of two trains may be cut on the same hour; a vehicle file's scale changes the distance by less.
    first_m = pl.col("distance_m").first().over(ends)
    another = ((pl.col("distance_m") - first_m).abs() > _OTHER_JOURNEY * first_m).fill_null(value=False)
    kept = runs.sort("solution", order, "run_id").filter(
        pl.struct(ends).is_first_distinct() | pl.col("t_start").is_null() | another
    )
    ended = pl.col("t_end").shift().cum_max().over("solution")
    overlapping = kept.sort("solution", "t_start").filter(pl.col("t_start") < ended).height
    said = {"one_journey": runs.height - kept.height, "overlapping": overlapping}
    return kept.sort("run_id", "solution"), reservation_sentences("studies", said)
