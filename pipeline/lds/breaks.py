"""After a break of the diagnosis: is GNSS minus odometer what it was before it?

While there is no position, or no odometer, no increment is monitored over that time as such: a long gap restarts the
bank, and over a short one the scale's uncertainty may hide more than the failure limit. What came to the position
meanwhile shows only in the place where it comes back. The expectation window (5 m + 5 % of the way) is too wide to see
it (DOMAIN section 4), so the first position after a break is held against the last validated one as a re-link is.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.journey import Journey
from pipeline.lds.recovery import Anchor, moved_m, noise_bound_m

LOST = "odometer distance lost since the last validated position"
TOO_FAR = "after a break, too far from the last validated position to tell"
NEVER = "no balise or validated position to measure from"


class Verdict(Enum):
    """What the odometer says of a position after a break."""

    HOLDS = "holds"
    MOVED = "moved"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Comparison:
    """GNSS minus odometer against what it was at the anchor; `reason`: why nothing can be told."""

    verdict: Verdict
    moved_m: float
    bound_m: float
    reason: str | None = None


def break_epochs(journey: Journey) -> frozenset[int]:
    """The first epochs that can be compared after none could for longer than a crossing is interpolated over.

    Where the odometer lost its distance, the first ones of its new stretch.
    """
    known = np.flatnonzero(journey.comparable)
    pause = np.diff(journey.t_ns[known]) > journey.gap_ns
    lost = np.diff(journey.stretch[known]) != 0
    return frozenset(known[1:][pause | lost].tolist())


def compare(anchor: Anchor | None, k: int, journey: Journey, limits: LdsLimits) -> Comparison:
    """Hold the position at epoch `k` against the anchor.

    More than k_T sigma is a move whatever sigma is. Less than that proves health only while it is inside the failure
    limit: beyond, a failure would pass too.
    """
    if anchor is None:
        return Comparison(Verdict.UNKNOWN, np.nan, np.nan, NEVER)
    if anchor.stretch != journey.stretch[k]:
        return Comparison(Verdict.UNKNOWN, np.nan, np.nan, LOST)
    way_m, bound_m = moved_m(anchor, k, journey), noise_bound_m(anchor, k, journey, limits)
    if abs(way_m) > bound_m + anchor.slack_m:
        return Comparison(Verdict.MOVED, way_m, bound_m + anchor.slack_m)
    if abs(way_m) <= bound_m <= limits.failure_limit_m:
        return Comparison(Verdict.HOLDS, way_m, bound_m)
    return Comparison(Verdict.UNKNOWN, way_m, bound_m, TOO_FAR)
