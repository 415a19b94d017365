"""When a position was in use, for how long, and the state of the reactive LDS (DOMAIN sections 4, 5.2 and 5.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gap_ns, met, nominal_period_s, reaction_of, trusted
from pipeline.stages.judge.judgement import RIGHT, WRONG
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, runs_of, times_ns
from schemas.config import Configuration
from schemas.enums import LdsState

# Numerics: times shorter than half a nanosecond are rounding.
_LEAST_S = 0.5 / NS_PER_S


def time_in_use(epochs: pl.DataFrame, code: Ints, config: Configuration) -> pl.DataFrame:
    """Per epoch `in_use`, and the time before it that it accounts for [s] (DOMAIN section 5.3).

    `wrong_s`: of a position wrong in use, all time since the position before where that was wrong in use too, else one
    nominal period at most. `used_s`: the same for wrong or unknown; for right positions, the time since the position
    before, of a gap one period. `counted_s`: for shares of time, `wrong_s` where there is any. An epoch without a
    position accounts for time only in a gap.
    """
    known = met(epochs, pl.col("path_m").is_not_null())
    steps = _StepTimes.of(epochs, known, config)
    usable = met(epochs.filter(known), trusted(config) & ~pl.col("withheld"))
    in_use = usable & (steps.left_s(steps.alone_s) > _LEAST_S)
    right = code[known] == RIGHT
    wrong_s, used_s = np.zeros((2, known.size))
    wrong_s[known] = steps.lasting_s(in_use & (code[known] == WRONG))
    used_s[known] = np.where(in_use & right, steps.left_s(steps.near_s), steps.lasting_s(in_use & ~right))
    in_use_of_all = known.copy()
    in_use_of_all[known] = in_use
    counted_s = np.where(wrong_s > 0.0, wrong_s, _counted_s(times_ns(epochs), known, steps))
    return pl.DataFrame({"in_use": in_use_of_all, "used_s": used_s, "wrong_s": wrong_s, "counted_s": counted_s})


@dataclass(frozen=True)
class _StepTimes:
    """The time from the position before to each, ending at `end_s`.

    `step_s`: whole; `near_s`: one period where it is a gap; `alone_s`: one period at most. `blocked_s`: total time
    negated up to each of `edge_s`, the begins and ends of the negations; linear between them.
    """

    end_s: Floats
    step_s: Floats
    near_s: Floats
    alone_s: Floats
    period_s: float
    gap_s: float
    edge_s: Floats
    blocked_s: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, known: Bools, config: Configuration) -> _StepTimes:
        all_ns = times_ns(epochs)
        t_ns = all_ns[known]
        all_s = (all_ns - all_ns[:1]) / NS_PER_S
        period_s = nominal_period_s(t_ns) or 0.0
        gap_s = crossing_gap_ns(t_ns, config.lds) / NS_PER_S
        step_s = np.diff(all_s[known], prepend=all_s[known][:1] - period_s)
        alone_s = np.minimum(step_s, period_s)
        near_s = np.where(step_s <= gap_s, step_s, alone_s)
        delay_s = reaction_of(period_s, config)
        negated = _negated_spans(all_s, flags(epochs, "negated"), flags(epochs, "withheld"), delay_s)
        blocked_s = np.cumsum(np.diff(negated, axis=1, prepend=negated[:, :1]).ravel())
        return cls(all_s[known], step_s, near_s, alone_s, period_s, gap_s, negated.ravel(), blocked_s)

    def left_s(self, length_s: Floats) -> Floats:
        """This much time before each position, less the negated part of it."""
        if self.edge_s.size == 0:
            return length_s
        until_s, since_s = (np.interp(t_s, self.edge_s, self.blocked_s) for t_s in (self.end_s, self.end_s - length_s))
        left_s = length_s - (until_s - since_s)
        return np.where(left_s > _LEAST_S, left_s, 0.0)

    def lasting_s(self, member: Bools) -> Floats:
        """Time of the members: whole since the position before where that is a member too."""
        member_before = np.concatenate([[False], member[:-1]])[: member.size]
        return np.where(member, self.left_s(np.where(member_before, self.step_s, self.alone_s)), 0.0)


def _negated_spans(t_s: Floats, negated: Bools, withheld: Bools, delay_s: float) -> Floats:
    """Begin and end of each negation [s]: from `delay_s` after it, or at once where already withheld, to the return."""
    firsts, lasts = runs_of(negated)
    until_s = np.append(t_s, t_s[-1:])[lasts + 1]
    from_s = t_s[firsts] + np.where(withheld[firsts], 0.0, delay_s)
    return np.column_stack([np.minimum(from_s, until_s), until_s])


def _counted_s(t_ns: Ints, known: Bools, steps: _StepTimes) -> Floats:
    """Time since the epoch before [s], of a gap one period.

    Of epochs between two near positions the later position accounts for all, the others for none.
    """
    since_s = np.diff(t_ns, prepend=t_ns[:1] - round(steps.period_s * NS_PER_S)) / NS_PER_S
    since_s = np.where(since_s <= max(steps.gap_s, steps.period_s), since_s, steps.period_s)
    rows = np.flatnonzero(known)
    after = np.searchsorted(rows, np.arange(t_ns.size))
    near = np.append(steps.step_s <= steps.gap_s, False)
    since_s[(after > 0) & near[after]] = 0.0
    since_s[rows] = steps.near_s
    return since_s


def lds_states(epochs: pl.DataFrame, code: Ints, in_use: Bools, undiagnosed: Bools) -> pl.Series:
    """P1 wrong in use, P2 negated, P3 not diagnosed, P0 right, the first that applies (DOMAIN section 4).

    Null where the evidence cannot say, and where a wrong position was not in use.
    """
    applies = {
        LdsState.P1: (code == WRONG) & in_use,
        LdsState.P2: flags(epochs, "negated"),
        LdsState.P3: undiagnosed,
        LdsState.P0: code == RIGHT,
    }
    states = [pl.when(pl.Series(held)).then(pl.lit(state.value)) for state, held in applies.items()]
    return pl.select(lds_state=pl.coalesce(states).cast(pl.Enum(LdsState))).to_series()
