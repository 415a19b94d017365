"""What moving time without a valid TVB was lost to, and to which monitor (CONTRACT section 3, `lost_to`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock, confident, may_move, met, unambiguous, usable
from schemas.arrays import NS_PER_S, Bools, Ints, floats, times_ns
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.enums import LdsMode, LostTo, MonitorState, Verdict
from schemas.tables import MONITORS, Epochs
from schemas.words import lost_words

_LOST_TO = dtypes(Epochs)["lost_to"]


@dataclass(frozen=True)
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


def lost_columns(epochs: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """`step_s`, `gap`, `moving_s`, `lost_s` and `lost_to` of `epochs`: from each to the next.

    Lost to the first cause that applies. A gap is time without a position, as for `availability`.
    """
    clock = Clock.of(epochs, config)
    steps_s = np.diff(clock.t_ns, append=clock.t_ns[-1:]) / NS_PER_S
    moving = met(epochs, may_move())
    gap = clock.held_s < steps_s
    lost = moving & (gap | ~met(epochs, pl.col("tvb") & pl.col("moving").is_not_null()))
    causes = _causes(epochs, gap, clock.t_ns, config)
    first = np.select([lost & applies for applies in causes.values()], list(range(len(causes))), default=len(causes))
    words = pl.Series([*(cause.value for cause in causes), None], dtype=_LOST_TO)
    time_s = {"moving_s": steps_s * moving, "lost_s": steps_s * lost}
    return pl.DataFrame({"step_s": steps_s, "gap": gap, **time_s, "lost_to": words.gather(first)})


def lost_time(epochs: pl.DataFrame, alarms: pl.DataFrame, config: Configuration) -> LostTime:
    """Shares of the moving time, from `epochs` with their `lost_columns`."""
    lost_s = floats(epochs, "lost_s")
    whole_s = float(floats(epochs, "moving_s").sum())
    if whole_s <= 0.0 or not met(epochs, pl.col("moving"))[:-1].any():
        return LostTime()
    to = epochs["lost_to"].cast(pl.String).to_numpy()
    parts = {cause: float(lost_s[to == cause.value].sum()) / whole_s for cause in LostTo}
    ranked = sorted((cause for cause, part in parts.items() if part > 0.0), key=lambda cause: -parts[cause])
    alarmed = to == LostTo.ALARM.value
    unexplained = alarmed & ~_explained(alarms, times_ns(epochs), config.lds.recovery_s)
    return LostTime(
        share=float(lost_s.sum()) / whole_s,
        causes={cause: parts[cause] for cause in ranked},
        monitor=_loudest(epochs.filter(alarmed)),
        unfounded=bool(2.0 * lost_s[unexplained].sum() > lost_s[alarmed].sum()),
    )


def _causes(epochs: pl.DataFrame, gap: Bools, t_ns: Ints, config: Configuration) -> dict[LostTo, Bools]:
    """Conditions in the order in which they apply."""
    negated = met(epochs, pl.col("lds_mode").cast(pl.String) == LdsMode.FAIL_SAFE.value)
    alarm_ns = np.where(met(epochs, pl.col("alarm")), t_ns, np.iinfo(np.int64).min)
    # A monitor fails, or has failed less than `recovery_s` ago (DOMAIN section 4).
    alarmed = np.maximum.accumulate(alarm_ns) >= t_ns - round(config.lds.recovery_s * NS_PER_S)
    noise, slip, relink = (
        met(epochs, pl.col("withheld_for").cast(pl.String) == cause.value)
        for cause in (LostTo.NOISE, LostTo.SLIP, LostTo.RELINK)
    )
    return {
        LostTo.NO_POSITION: gap | ~met(epochs, usable()),
        LostTo.CONFIDENCE: ~met(epochs, confident(config)),
        LostTo.TRACK_AMBIGUOUS: ~met(epochs, unambiguous()),
        LostTo.NOISE: noise,
        LostTo.SLIP: slip,
        LostTo.RELINK: relink | (negated & ~alarmed),
        LostTo.ALARM: negated,
        LostTo.NO_ODOMETER: met(epochs, pl.col("odometer_reason").is_not_null()),
    }


def _explained(alarms: pl.DataFrame, t_ns: Ints, recovery_s: float) -> Bools:
    """Epochs of alarm episodes that were due, or that belong to a hazard, and of the recovery after them."""
    due = alarms.filter((pl.col("verdict") == Verdict.TRUE.value) | pl.col("hazard_id").is_not_null())
    ends_ns = times_ns(due, "t_end") + round(recovery_s * NS_PER_S)
    inside = np.zeros(t_ns.size, dtype=np.bool_)
    for start_ns, end_ns in zip(times_ns(due, "t_start"), ends_ns, strict=True):
        inside |= (t_ns >= start_ns) & (t_ns <= end_ns)
    return inside


def _loudest(epochs: pl.DataFrame) -> str | None:
    """The monitor that failed in most of these epochs."""
    failing = {name: pl.col(f"{name}_state").cast(pl.String) == MonitorState.FAIL.value for name in MONITORS}
    counts = epochs.select(**{name: condition.sum() for name, condition in failing.items()}).row(0, named=True)
    loudest = max(counts, key=lambda name: int(counts[name]))
    return loudest if counts[loudest] else None
