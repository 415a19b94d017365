"""The epochs of one solution along time: how long each holds, outages, and conditions on them.

A state at an epoch holds until the next one; across a gap nothing is known to hold. Times of epochs are int64
nanoseconds in order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Floats, Ints, median, times_ns
from schemas.config import Configuration, LdsConfig
from schemas.frozen import frozen
from schemas.stages import ONE_TRACK_LEFT

Time = TypeVar("Time", float, pl.Expr)

# CONTRACT section 3, `outages`: what is longer lacks an epoch.
GAP_PERIODS = 1.5
# DOMAIN section 4: of so many steps before an epoch the median is the period of the log as known then.
_PERIOD_STEPS = 100


@frozen
class Clock:
    """The epochs' times and how long the state of each holds; `period_s`: from one position to the next."""

    t_ns: Ints
    period_s: float | None
    limit_s: float
    held_s: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, config: Configuration) -> Clock:
        """The clock of an epochs table."""
        return cls.at(times_ns(epochs), position_ns(epochs), config)

    @classmethod
    def at(cls, t_ns: Ints, position_ns: Ints, config: Configuration) -> Clock:
        """The clock of epochs at `t_ns`, of which those at `position_ns` have a position."""
        period_s = nominal_period_s(position_ns)
        limit_s = gap_limit_s(period_s, config.align.gap_reset_s)
        return cls(t_ns, period_s, limit_s, held_s(t_ns, limit_s))

    @property
    def duration_s(self) -> float | None:
        """Time from the first epoch to the last [s]."""
        return float(self.t_ns[-1] - self.t_ns[0]) / 1e9 if len(self.t_ns) else None


def holds_at_rows(frame: pl.DataFrame, condition: pl.Expr) -> Bools:
    """Whether a condition holds at each row, shape (rows,); null is false."""
    return frame.select(condition.fill_null(value=False)).to_series().to_numpy()


def may_move() -> pl.Expr:
    """Whether the train moves from this epoch to the next; true where nobody knows (DOMAIN section 5.5)."""
    return pl.col("moving").fill_null(value=True)


def usable() -> pl.Expr:
    """Whether an epoch has a position on the track."""
    return pl.col("path_m").is_not_null() & pl.col("on_track")


def unambiguous() -> pl.Expr:
    """Whether one track is left for the position by what the train knew then."""
    return pl.col("gate_probability") >= ONE_TRACK_LEFT


def least_belief() -> pl.Expr:
    """Confidence in the track, at the time or in hindsight, whichever is less.

    The track is doubtful where this is below `ONE_TRACK_LEFT`.
    """
    return pl.min_horizontal("gate_probability", "path_probability")


def confident(config: Configuration) -> pl.Expr:
    """Whether the confidence interval along the track is within its limit."""
    return pl.col("confidence_m") <= config.lds.ci_limit_m


def trusted(config: Configuration) -> pl.Expr:
    """Whether the position of an epoch is valid, confident and unambiguous (CONTRACT section 3, `mtbf_h`)."""
    return usable() & confident(config) & unambiguous()


def nominal_period_s(t_ns: Ints) -> float | None:
    """Median distance of consecutive epochs [s]; None for fewer than two."""
    return median(np.diff(t_ns)) / NS_PER_S if len(t_ns) > 1 else None


def position_ns(epochs: pl.DataFrame) -> Ints:
    """Times of the epochs with a position: a logger may write others between them, which say nothing."""
    return times_ns(epochs.filter(pl.col("path_m").is_not_null()))


def periods_before_s(t_ns: Ints) -> Floats:
    """Median of the last 100 steps before each epoch [s]; 0 where there is none."""
    return _periods_before_s(t_ns.astype(np.int64, copy=False).tobytes()).copy()


@lru_cache(maxsize=4)
def _periods_before_s(stamps: bytes) -> Floats:
    """The same by the bytes of the stamps: half a dozen parts of a replay ask it of the same epochs."""
    t_ns = np.frombuffer(stamps, dtype=np.int64)
    medians = pl.Series(np.diff(t_ns), dtype=pl.Float64).rolling_median(_PERIOD_STEPS, min_samples=1).to_numpy()
    return np.concatenate([[0.0, 0.0], medians[:-1]])[: t_ns.size] / NS_PER_S


def crossing_gaps_ns(t_ns: Ints, lds: LdsConfig) -> Ints:
    """Longest step to each epoch over which a movement is interpolated [ns], as known before it (DOMAIN section 4)."""
    longest_s = np.maximum(GAP_PERIODS * periods_before_s(t_ns), lds.crossing_gap_s)
    return np.round(longest_s * NS_PER_S).astype(np.int64)


def reaction_or_period_s(period_s: Time, config: Configuration) -> Time | float:
    """Time from detection to negation [s]: as configured, else one period of the positions."""
    return period_s if config.hazards.reaction_s is None else config.hazards.reaction_s


def reactions_ns(detected_ns: Ints, position_ns: Ints, config: Configuration) -> Ints:
    """Time from each detection to negation [ns]: as configured, else to the next position, over a gap its limit."""
    if config.hazards.reaction_s is not None or position_ns.size == 0:
        return np.full(detected_ns.size, round((config.hazards.reaction_s or 0.0) * NS_PER_S))
    after = np.searchsorted(position_ns, detected_ns, side="right").clip(max=position_ns.size - 1)
    waits_ns = np.where(position_ns[after] > detected_ns, position_ns[after] - detected_ns, NS_PER_S)
    reactions: Ints = np.minimum(waits_ns, crossing_gaps_ns(position_ns, config.lds)[after])
    return reactions


def gap_limit_s(period_s: float | None, gap_reset_s: float) -> float:
    """Longest distance of epochs [s] that is not yet a gap (CONTRACT section 3, `outages`)."""
    return float(gap_limits_s(np.array(period_s or 0.0), gap_reset_s))


def gap_limits_s(period_s: Floats, gap_reset_s: float) -> Floats:
    """Longest step [s] that is not yet a gap, for the period `period_s` at each epoch."""
    return np.minimum(gap_reset_s, np.maximum(GAP_PERIODS * period_s, 1.0))


def outages_s(t_ns: Ints, usable: Bools, limit_s: float) -> Floats:
    """Lengths [s] of the stretches over `limit_s` from one usable epoch to the next, in order of time.

    At the ends from the first and to the last epoch.
    """
    stretches = np.diff(np.concatenate([t_ns[:1], t_ns[usable], t_ns[-1:]])) / NS_PER_S
    return stretches[stretches > limit_s]


class Uptime(NamedTuple):
    """How long a condition held [s], and how often it was lost after it had held."""

    up_s: float
    losses: int


def uptime(t_ns: Ints, good: Bools, limit_s: float) -> Uptime:
    """How long `good` held, and how often it was lost: a loss is an outage over `limit_s` after a good epoch."""
    stretches = np.diff(np.concatenate([t_ns[good], t_ns[-1:]])) / NS_PER_S
    lost = stretches > limit_s
    return Uptime(float(stretches[~lost].sum()), int(lost.sum()))


def held_s(t_ns: Ints, limit_s: float) -> Floats:
    """Time for which the state of each epoch is known to hold [s]: to the next epoch, 0 before a gap."""
    steps = np.diff(t_ns, append=t_ns[-1:]) / NS_PER_S
    return np.where(steps <= limit_s, steps, 0.0)


def share_of_time(held: Floats, where: Bools) -> float | None:
    """Share of the time held that `where` covers; None without any."""
    total = held.sum()
    return min(1.0, float(held[where].sum() / total)) if total > 0 else None


def availability(t_ns: Ints, valid: Bools, moving: Bools, limit_s: float) -> float | None:
    """Share of moving time, gaps included, during which `valid` held; None if it never moved.

    `moving[k]`: from epoch k to the next. A gap is time without validity.
    """
    if len(t_ns) < 2:
        return None
    total = (np.diff(t_ns) / NS_PER_S)[moving[:-1]].sum()
    held = held_s(t_ns, limit_s)[:-1]
    return min(1.0, float(held[moving[:-1] & valid[:-1]].sum() / total)) if total > 0 else None


class Passing(NamedTuple):
    """A step to row `after` passes `place`; `share` of it lies before the place, `sense` is +1 where it grows."""

    after: int
    place: int
    sense: int
    share: float

    def instant_ns(self, before_ns: int, after_ns: int) -> int:
        """The instant of the passing between its two rows' instants, in whole nanoseconds."""
        return before_ns + round(self.share * (after_ns - before_ns))


def passings(at_m: Floats, places_m: Floats | Sequence[float]) -> list[Passing]:
    """Steps of a series of known coordinates that pass places in order of growing coordinate.

    Growing from before a place to it or beyond, falling from there to before it: touching it and turning back are two.
    Those of one step are in the order of being passed.
    """
    places = np.asarray(places_m, dtype=np.float64)
    behind = np.searchsorted(places, at_m, side="right")
    found: list[Passing] = []
    for row in (np.flatnonzero(np.diff(behind)) + 1).tolist():
        before, after = int(behind[row - 1]), int(behind[row])
        begin_m, end_m = at_m[row - 1 : row + 1].tolist()
        passed = range(before, after) if after > before else range(before - 1, after - 1, -1)
        sense = 1 if after > before else -1
        found += [Passing(row, place, sense, float((places[place] - begin_m) / (end_m - begin_m))) for place in passed]
    return found
