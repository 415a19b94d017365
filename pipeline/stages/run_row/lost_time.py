"""What moving time without a valid TVB was lost to, and to which monitor (CONTRACT section 3, `lost_to`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, times_ns, truths
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.enums import LostTo, MonitorState, Verdict
from schemas.frozen import frozen
from schemas.stages import EpochFigures
from schemas.tables import MONITORS, Epochs
from schemas.words import lost_words

_LOST_TO = dtypes(Epochs)["lost_to"]
_NUMBER = {cause: number for number, cause in enumerate(LostTo)}


@frozen
class LostTime:
    """`share` of moving time without a valid TVB, None where the train never moved; `causes`: shares, largest first.

    What no cause explains is initialisation and short losses. `monitor`: failed in most of the time lost to alarms.
    `unfounded`: most of that time follows alarms that neither the evidence nor a hazard explains.
    """

    share: float | None = None
    causes: Mapping[LostTo, float] = field(default_factory=dict)
    monitor: str | None = None
    unfounded: bool = False

    @property
    def words(self) -> str:
        return lost_words(list(self.causes), list(self.causes.values()), self.monitor, self.share)

    def columns(self) -> dict[str, object]:
        """As they stand in `runs`."""
        causes = {"lost_to": list(self.causes), "lost_to_share": list(self.causes.values())}
        return {**causes, "lost_to_monitor": self.monitor}


@frozen
class LostColumns:
    """What each epoch's time was lost to, from it to the next; arrays of shape (epochs,)."""

    step_s: Floats
    """Time to the next epoch [s]."""
    gap: Bools
    """A gap in the positions follows."""
    moving_s: Floats
    """Of the step, time that the train moves or may move [s]."""
    lost_s: Floats
    """Of this, time without a valid TVB [s]."""
    lost_to: Ints
    """The first cause that applies, by number in `LostTo`; -1 for none."""

    def columns(self) -> list[pl.Series]:
        """As they stand in `epochs`."""
        words = pl.Series("lost_to", [*(cause.value for cause in LostTo), None], dtype=_LOST_TO)
        return [
            pl.Series("step_s", self.step_s),
            pl.Series("gap", self.gap),
            pl.Series("moving_s", self.moving_s),
            pl.Series("lost_s", self.lost_s),
            words[np.where(self.lost_to < 0, len(LostTo), self.lost_to).astype(np.uint32)],
        ]


def lost_columns(epochs: EpochFigures, config: Configuration) -> LostColumns:
    """Lost to the first cause that applies. A gap is time without a position, as for `availability`."""
    clock = Clock.at(epochs.t_ns, epochs.t_ns[np.isfinite(epochs.path_m)], config)
    steps_s = np.diff(clock.t_ns, append=clock.t_ns[-1:]) / NS_PER_S
    gap = clock.held_s < steps_s
    lost = epochs.may_move & (gap | ~epochs.valid)
    causes = _causes(epochs, gap, config)
    numbers = [_NUMBER[cause] for cause in causes]
    first = np.select([lost & applies for applies in causes.values()], numbers, default=-1)
    return LostColumns(steps_s, gap, steps_s * epochs.may_move, steps_s * lost, first)


def lost_time(epochs: EpochFigures, lost: LostColumns, alarms: pl.DataFrame, config: Configuration) -> LostTime:
    """Shares of the moving time."""
    whole_s = float(lost.moving_s.sum())
    if whole_s <= 0.0 or not epochs.moves[:-1].any():
        return LostTime()
    parts = {cause: float(lost.lost_s[lost.lost_to == _NUMBER[cause]].sum()) / whole_s for cause in LostTo}
    ranked = sorted((cause for cause, part in parts.items() if part > 0.0), key=lambda cause: -parts[cause])
    alarmed = lost.lost_to == _NUMBER[LostTo.ALARM]
    unexplained = alarmed & ~_explained(alarms, epochs.t_ns, config.lds.recovery_s)
    return LostTime(
        share=float(lost.lost_s.sum()) / whole_s,
        causes={cause: parts[cause] for cause in ranked},
        monitor=_loudest(epochs.table, alarmed),
        unfounded=bool(2.0 * lost.lost_s[unexplained].sum() > lost.lost_s[alarmed].sum()),
    )


def _causes(epochs: EpochFigures, gap: Bools, config: Configuration) -> dict[LostTo, Bools]:
    """Conditions in the order in which they apply."""
    negated = epochs.fail_safe
    alarm_ns = np.where(epochs.alarm, epochs.t_ns, np.iinfo(np.int64).min)
    # A monitor fails, or has failed less than `recovery_s` ago (DOMAIN section 4).
    alarmed = np.maximum.accumulate(alarm_ns) >= epochs.t_ns - round(config.lds.recovery_s * NS_PER_S)
    noise, slip, relink = (
        epochs.withheld_for == _NUMBER[cause] for cause in (LostTo.NOISE, LostTo.SLIP, LostTo.RELINK)
    )
    return {
        LostTo.NO_POSITION: gap | ~epochs.usable,
        LostTo.CONFIDENCE: ~epochs.confident(config.lds.ci_limit_m),
        LostTo.TRACK_AMBIGUOUS: ~epochs.unambiguous,
        LostTo.NOISE: noise,
        LostTo.SLIP: slip,
        LostTo.RELINK: relink | (negated & ~alarmed),
        LostTo.ALARM: negated,
        LostTo.NO_ODOMETER: epochs.without_odometer,
    }


def _explained(alarms: pl.DataFrame, t_ns: Ints, recovery_s: float) -> Bools:
    """Epochs of alarm episodes that were due, or that belong to a hazard, and of the recovery after them."""
    due = alarms.filter((pl.col("verdict") == Verdict.TRUE.value) | pl.col("hazard_id").is_not_null())
    ends_ns = times_ns(due, "t_end") + round(recovery_s * NS_PER_S)
    inside = np.zeros(t_ns.size, dtype=np.bool_)
    for start_ns, end_ns in zip(times_ns(due, "t_start"), ends_ns, strict=True):
        inside |= (t_ns >= start_ns) & (t_ns <= end_ns)
    return inside


def _loudest(epochs: pl.DataFrame, alarmed: Bools) -> str | None:
    """The monitor that failed in most of these epochs."""
    if not alarmed.any():
        return None
    counts = {
        name: int((truths(epochs[f"{name}_state"] == MonitorState.FAIL.value) & alarmed).sum()) for name in MONITORS
    }
    loudest = max(counts, key=lambda name: counts[name])
    return loudest if counts[loudest] else None
