"""Counts of a requirement that add up over runs, and what is demanded of them.

A run is one trial of a share: of its time one instant is drawn, without a look at its error, because epochs of a run
err together. A gap of the log is time of which nobody knows.
"""

from __future__ import annotations

import hashlib
from enum import StrEnum

import numpy as np

from pipeline.stages.run_row.bounds import UNKNOWN, Estimate, clopper_pearson, poisson_rate
from pipeline.studies.tally import S_PER_H, Compliance, Shown, rate_shown, share_shown
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.frozen import frozen

KEPT = 1
NOT_KNOWN = 0
BROKEN = -1

_COUNTS = ("trials", "kept", "broken", "events", "possible", "held_s", "known_s")


@frozen
class Tally:
    """Of one run, or of many added up.

    `trials`: independent ones, of which `kept` and `broken` are known. `events`: known exceedances, `possible`: how
    many there may be at most with all that is not known. `held_s`: time that the requirement applied, `known_s`: of it
    judged. `worst`: largest size known; `longest_s`: the longest run.
    """

    trials: int = 0
    kept: int = 0
    broken: int = 0
    events: int = 0
    possible: int = 0
    held_s: float = 0.0
    known_s: float = 0.0
    worst: float | None = None
    longest_s: float = 0.0

    def __add__(self, other: Tally) -> Tally:
        sizes = [size for size in (self.worst, other.worst) if size is not None]
        counts = {name: getattr(self, name) + getattr(other, name) for name in _COUNTS}
        return Tally(**counts, worst=max(sizes, default=None), longest_s=max(self.longest_s, other.longest_s))


def keeps_and_breaks(low: Floats, high: Floats, over: Floats | float, under: Floats | float) -> tuple[Bools, Bools]:
    """Whether an error between `low` and `high` is at most `over` and not below `-under`; whether it is beyond."""
    with np.errstate(invalid="ignore"):
        return (high <= over) & (low >= -np.asarray(under)), (low > over) | (high < -np.asarray(under))


def codes(kept: Bools, broken: Bools) -> Ints:
    """One of `KEPT`, `NOT_KNOWN`, `BROKEN` per epoch; what is broken is not kept."""
    return np.where(broken, BROKEN, np.where(kept, KEPT, NOT_KNOWN)).astype(np.int64)


def count_claims(
    run: str,
    t_ns: Ints,
    held_s: Floats,
    code: Ints,
    gap_s: float,
    size: Floats | None = None,
    without_data_s: Floats | float = 0.0,
) -> Tally:
    """Count the epochs of one run to which a requirement applies, in order of time; `run` draws its trial.

    `without_data_s`: how long the log holds nothing after each epoch's own time `held_s`; nobody knows what was then.
    """
    if code.size == 0:
        return Tally()
    without_data = np.broadcast_to(without_data_s, code.shape)
    trial = _drawn_code(run, held_s, without_data, code)
    known = code != NOT_KNOWN
    sizes = size[known & np.isfinite(size)] if size is not None else np.empty(0)
    doubtful = (code != KEPT) | (without_data > 0)
    until_ns = t_ns + np.where(without_data > 0, (held_s + without_data) * NS_PER_S, 0).astype(np.int64)
    return Tally(
        trials=1,
        kept=int(trial == KEPT),
        broken=int(trial == BROKEN),
        events=len(group_lengths_s(t_ns[code == BROKEN], t_ns[code == BROKEN], gap_s)),
        possible=sum(int(span_s // gap_s) + 1 for span_s in group_lengths_s(t_ns[doubtful], until_ns[doubtful], gap_s)),
        held_s=float(held_s.sum()),
        known_s=float(held_s[known].sum()),
        worst=float(sizes.max()) if sizes.size else None,
    )


def group_lengths_s(from_ns: Ints, to_ns: Ints, gap_s: float) -> list[float]:
    """Lengths [s] of the groups of stretches that lie no more than `gap_s` apart; in order of time."""
    if from_ns.size == 0:
        return []
    apart = np.flatnonzero(from_ns[1:] - to_ns[:-1] > gap_s * NS_PER_S)
    first = from_ns[np.concatenate(([0], apart + 1))]
    last = to_ns[np.concatenate((apart, [to_ns.size - 1]))]
    lengths: list[float] = ((last - first) / NS_PER_S).tolist()
    return lengths


def _drawn_code(run: str, held_s: Floats, without_data_s: Floats, code: Ints) -> int:
    """The code of one instant by chance; of one epoch where none of them holds for any time."""
    # What an epoch holds, then what has no data after it, one after the other.
    lengths = np.column_stack([held_s, without_data_s]).ravel()
    codes_of = np.column_stack([code, np.full(code.size, NOT_KNOWN)]).ravel()
    if not lengths.any():
        lengths = np.ones(code.size)
        codes_of = code
    until = np.cumsum(lengths)
    return int(codes_of[np.searchsorted(until, random_share(run) * until[-1], side="right")])


def random_share(run: str) -> float:
    """A number from 0 to below 1 by chance, always the same for the same run."""
    return int.from_bytes(hashlib.sha256(run.encode()).digest()[:6], "big") / (1 << 48)


class Kind(StrEnum):
    """What is demanded: a maximum at all times, a share of trials, a rate, a share of time."""

    ALWAYS = "always"
    SHARE = "share"
    RATE = "rate"
    AVAILABILITY = "availability"


@frozen
class Demand:
    """What is demanded of a requirement, and what counts show of it.

    `limit`: share or rate [1/h]. `by_means`: what is kept as a mean may be exceeded at an instant, so is never met.
    `outside_s`: a run is unavailable where it is for so long.
    """

    kind: Kind
    limit: float = 0.0
    by_means: bool = False
    outside_s: float = 0.0

    @property
    def words(self) -> str:
        """The demand as a formula."""
        if self.kind is Kind.ALWAYS:
            return "always"
        return f"< {self.limit:g} /h" if self.kind is Kind.RATE else f"p >= {self.limit:g}"

    def assess(self, tally: Tally) -> Shown:
        """What counts show of the demand; `needed` in hours."""
        hours_known = tally.known_s / S_PER_H
        if self.kind is Kind.RATE:
            return rate_shown(tally.events, tally.possible, tally.held_s / S_PER_H, hours_known, self.limit)
        if self.kind is Kind.AVAILABILITY:
            return self._assess_availability(tally)
        if self.kind is Kind.SHARE:
            return self._assess_share(tally)
        # One event breaks a maximum that is demanded without a probability, and no number of hours shows it.
        finding = Compliance.NOT_MET if tally.events else Compliance.NOT_SHOWN
        return Shown(finding, poisson_rate(tally.events, hours_known))

    def _assess_share(self, tally: Tally) -> Shown:
        """A share of runs; the figure with its bounds is of the runs judged."""
        if tally.trials == 0:
            return Shown(Compliance.NOT_SHOWN)
        judged = tally.kept + tally.broken
        broken = share_shown(tally.broken, judged, tally.trials - judged, 1.0 - self.limit)
        kept = clopper_pearson(tally.kept, judged)
        if broken.finding is Compliance.MET:
            return Shown(Compliance.NOT_SHOWN, kept) if self.by_means else Shown(Compliance.MET, kept, 0.0)
        hours = tally.held_s / tally.trials / S_PER_H
        unknown = self.by_means or broken.needed is None or hours <= 0.0
        return Shown(broken.finding, kept, None if unknown else hours * (broken.needed or 0))

    def _assess_availability(self, tally: Tally) -> Shown:
        """Broken runs were unavailable for `outside_s` at least, so for that part of the longest run at least.

        Never `met`: the result does not hold the confidence of speed, nor what stood in gaps of the log.
        """
        broken = clopper_pearson(tally.broken, tally.trials) if tally.trials else UNKNOWN
        lost = (broken.low or 0.0) * self.outside_s / tally.longest_s if tally.longest_s > 0 else 0.0
        measured = Estimate(tally.known_s / tally.held_s, None, 1.0 - lost) if tally.held_s > 0 else UNKNOWN
        return Shown(Compliance.NOT_MET if lost > 1.0 - self.limit else Compliance.NOT_SHOWN, measured)


ALWAYS = Demand(Kind.ALWAYS)
