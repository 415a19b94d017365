"""When a position was in use: valid, unambiguous, confident and not negated (DOMAIN section 5.2 and 5.3)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.epochs.clock import met, trusted
from pipeline.epochs.timeline import crossing_gap_ns, nominal_period_s
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, runs_of, times_ns
from schemas.config import Configuration


def reaction_s(t_ns: Ints, config: Configuration) -> float:
    """From detection to negation [s]: as configured, else one epoch."""
    if config.hazards.reaction_s is not None:
        return config.hazards.reaction_s
    return nominal_period_s(t_ns) or 0.0


def in_use_s(epochs: pl.DataFrame, config: Configuration) -> Floats:
    """For how long each epoch stands for a position in use [s]: from the epoch before, for a fault may be that old.

    At most max(1.5 periods, `crossing_gap_s`), the first epoch for one period; of a negated time only what comes
    before the reaction.
    """
    t_ns = times_ns(epochs)
    usable = met(epochs, trusted(config))
    period_s = nominal_period_s(t_ns) or 0.0
    end_s = (t_ns - t_ns[:1]) / NS_PER_S
    begin_s = end_s - np.minimum(np.diff(end_s, prepend=-period_s), crossing_gap_ns(t_ns, config.lds) / NS_PER_S)
    blocked = np.zeros(t_ns.size)
    for from_s, until_s in _negated_spans(end_s, flags(epochs, "negated"), reaction_s(t_ns, config)):
        blocked += np.clip(np.minimum(end_s, until_s) - np.maximum(begin_s, from_s), 0.0, None)
    held: Floats = np.clip(end_s - begin_s - blocked, 0.0, None)
    return np.where(usable, held, 0.0)


def _negated_spans(t_s: Floats, negated: Bools, delay_s: float) -> list[tuple[float, float]]:
    """From each detection plus the reaction to the return [s]."""
    firsts, lasts = runs_of(negated)
    until = np.append(t_s, np.inf)[lasts + 1]
    return list(zip((t_s[firsts] + delay_s).tolist(), until.tolist(), strict=True))
