"""When a position was in use, for how long, and the state of the reactive LDS (DOMAIN sections 4, 5.2 and 5.3)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import (
    crossing_gaps_ns,
    met,
    nominal_period_s,
    periods_before_s,
    reactions_ns,
    trusted,
)
from pipeline.stages.judge.judgement import RIGHT, WRONG
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, runs_of, times_ns
from schemas.config import Configuration
from schemas.enums import LdsState
from schemas.frozen import frozen

# Numerics: times shorter than half a nanosecond are rounding.
_LEAST_S = 0.5 / NS_PER_S


def time_in_use(epochs: pl.DataFrame, code: Ints, config: Configuration) -> pl.DataFrame:
    """Per epoch `in_use`, and the time before it that it accounts for [s] (DOMAIN section 5.3).

    `used_s`: of a position in use all time since the position before, up to the longest step that is no gap; `wrong_s`:
    of it where the position was wrong. `counted_s`: for shares of time, `wrong_s` where there is any. An epoch without
    a position accounts for time only in a gap.
    """
    known = np.isfinite(floats(epochs, "path_m"))
    steps = _StepTimes.of(epochs, known, config)
    usable = met(epochs, trusted(config) & ~pl.col("withheld"))
    in_use = np.zeros(known.size, dtype=np.bool_)
    in_use[known] = usable[known] & (steps.left_s(steps.alone_s) > _LEAST_S)
    used_s = np.zeros(known.size)
    used_s[known] = np.where(in_use[known], steps.left_s(steps.near_s), 0.0)
    wrong_s = np.where(code == WRONG, used_s, 0.0)
    counted_s = np.where(wrong_s > 0.0, wrong_s, _counted_s(times_ns(epochs), known, steps, config))
    return pl.DataFrame({"in_use": in_use, "used_s": used_s, "wrong_s": wrong_s, "counted_s": counted_s})


@frozen
class _StepTimes:
    """The time from the position before to each, ending at `end_s`; `is_gap`: longer than a movement is interpolated.

    `near_s`: up to the longest step that is no gap (the fault may be that old); `alone_s`: up to one period.
    `blocked_s`: total time negated up to each of `edge_s`, the begins and ends of the negations; linear between them.
    """

    end_s: Floats
    near_s: Floats
    alone_s: Floats
    is_gap: Bools
    edge_s: Floats
    blocked_s: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, known: Bools, config: Configuration) -> _StepTimes:
        all_ns = times_ns(epochs)
        t_ns = all_ns[known]
        all_s = (all_ns - all_ns[:1]) / NS_PER_S
        # Before the first position there is none: it accounts for one period of the run, as far as that is known.
        step_s = np.diff(all_s[known], prepend=all_s[known][:1] - (nominal_period_s(t_ns) or 0.0))
        gap_s = crossing_gaps_ns(t_ns, config.lds) / NS_PER_S
        period_s = periods_before_s(t_ns)
        near_s = np.minimum(step_s, gap_s)
        alone_s = np.where(period_s > 0.0, np.minimum(near_s, period_s), near_s)
        reaction_s = reactions_ns(all_ns, t_ns, config) / NS_PER_S
        negated = _negated_spans(all_s, flags(epochs, "negated"), flags(epochs, "withheld"), reaction_s)
        blocked_s = np.cumsum(np.diff(negated, axis=1, prepend=negated[:, :1]).ravel())
        return cls(all_s[known], near_s, alone_s, step_s > gap_s, negated.ravel(), blocked_s)

    def left_s(self, length_s: Floats) -> Floats:
        """This much time before each position, less the negated part of it."""
        if self.edge_s.size == 0:
            return length_s
        until_s, since_s = (np.interp(t_s, self.edge_s, self.blocked_s) for t_s in (self.end_s, self.end_s - length_s))
        left_s = length_s - (until_s - since_s)
        return np.where(left_s > _LEAST_S, left_s, 0.0)


def _negated_spans(t_s: Floats, negated: Bools, withheld: Bools, reaction_s: Floats) -> Floats:
    """Begin and end of each negation [s]: a reaction after it, or at once where already withheld, to the return."""
    firsts, lasts = runs_of(negated)
    until_s = np.append(t_s, t_s[-1:])[lasts + 1]
    from_s = t_s[firsts] + np.where(withheld[firsts], 0.0, reaction_s[firsts])
    return np.column_stack([np.minimum(from_s, until_s), until_s])


def _counted_s(t_ns: Ints, known: Bools, steps: _StepTimes, config: Configuration) -> Floats:
    """Time since the epoch before [s], of a gap no more than a movement is interpolated over.

    Of epochs between two near positions the later position accounts for all, the others for none.
    """
    longest_s = crossing_gaps_ns(t_ns, config.lds) / NS_PER_S
    since_s = np.minimum(np.diff(t_ns, prepend=t_ns[:1]) / NS_PER_S, longest_s)
    rows = np.flatnonzero(known)
    after = np.searchsorted(rows, np.arange(t_ns.size))
    since_s[(after > 0) & np.append(~steps.is_gap, False)[after]] = 0.0
    since_s[rows] = np.where(steps.is_gap, since_s[rows], steps.near_s)
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
    words = pl.Series("lds_state", [*(state.value for state in applies), None], dtype=pl.Enum(LdsState))
    first = np.select(list(applies.values()), list(range(len(applies))), default=len(applies))
    return words[first.astype(np.uint32)]
