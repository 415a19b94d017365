"""The epochs of one solution along time: how long each holds, and conditions on them."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.epochs.timeline import gap_limit_s, held_s, nominal_period_s
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration


@dataclass(frozen=True)
class Clock:
    """The epochs' times and how long the state of each holds."""

    t_ns: Ints
    period_s: float | None
    limit_s: float
    held_s: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, config: Configuration) -> Clock:
        t_ns = epochs["t"].to_physical().to_numpy()
        period_s = nominal_period_s(t_ns)
        limit_s = gap_limit_s(period_s, config.align.gap_reset_s)
        return cls(t_ns, period_s, limit_s, held_s(t_ns, limit_s))

    @property
    def duration_s(self) -> float | None:
        return float(self.t_ns[-1] - self.t_ns[0]) / 1e9 if len(self.t_ns) else None


def met(frame: pl.DataFrame, condition: pl.Expr) -> Bools:
    """Where a condition holds; null is false."""
    return frame.select(condition.fill_null(value=False)).to_series().to_numpy()


def may_move() -> pl.Expr:
    """The train moves from this epoch to the next, or nobody knows (DOMAIN section 5.5)."""
    return pl.col("moving").fill_null(value=True)


def usable() -> pl.Expr:
    """An epoch with a position on the track."""
    return pl.col("path_m").is_not_null() & pl.col("on_track")


def unambiguous(config: Configuration) -> pl.Expr:
    """The track of the position is not in doubt by what the train knew then."""
    return pl.col("gate_probability") >= config.matching.ambiguity_probability


def confident(config: Configuration) -> pl.Expr:
    """The confidence interval along the track is within its limit."""
    return pl.col("confidence_m") <= config.lds.ci_limit_m


def trusted(config: Configuration) -> pl.Expr:
    """An epoch whose position is valid, confident and unambiguous (CONTRACT section 3, `mtbf_h`)."""
    return usable() & confident(config) & unambiguous(config)
