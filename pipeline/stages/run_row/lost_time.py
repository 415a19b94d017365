"""What moving time without a valid TVB was lost to, to which monitor (CONTRACT section 3, `lost_to`), and remedies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock, reaction_or_period_s
from pipeline.stages.epochs.verdicts import Verdicts
from pipeline.stages.judge.judged import JudgedEpochs
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, times_ns
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.enums import (
    TRUTH,
    Judgement,
    LdsMode,
    LostTo,
    Origin,
    Reason,
    Remedy,
    RunVerdict,
    VehicleFigures,
    Verdict,
)
from schemas.frozen import frozen
from schemas.monitors import ALL_MONITORS, MONITORS
from schemas.stages import NO_REASON
from schemas.tables import Epochs
from schemas.words import lost_words

_LOST_TO = dtypes(Epochs)["lost_to"]
_NUMBER = {cause: number for number, cause in enumerate(LostTo)}
_FAIL_SAFE = tuple(LdsMode).index(LdsMode.FAIL_SAFE)


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
        """The losses in a sentence for people."""
        return lost_words(list(self.causes), list(self.causes.values()), self.monitor, self.share)

    def columns(self) -> dict[str, object]:
        """The lost time as columns of `runs`."""
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
        """What was lost at each epoch, as columns of `epochs`."""
        words = pl.Series("lost_to", [*(cause.value for cause in LostTo), None], dtype=_LOST_TO)
        return [
            pl.Series("step_s", self.step_s),
            pl.Series("gap", self.gap),
            pl.Series("moving_s", self.moving_s),
            pl.Series("lost_s", self.lost_s),
            words[np.where(self.lost_to < 0, len(LostTo), self.lost_to).astype(np.uint32)],
        ]


def lost_columns(epochs: JudgedEpochs, config: Configuration) -> LostColumns:
    """Moving time by the first cause that applies. A gap is time without a position, as for `availability`.

    Args:
        epochs: of one solution, judged.
        config: the configuration; used are `lds` and `align.gap_reset_s`.

    Returns:
        For each epoch the time to the next, and what it was lost to.

    Source:
        CONTRACT section 3, `lost_to`; LOC eq. 8.
    """
    clock = Clock.at(epochs.t_ns, epochs.t_ns[np.isfinite(epochs.path_m)], config)
    steps_s = np.diff(clock.t_ns, append=clock.t_ns[-1:]) / NS_PER_S
    gap = clock.held_s < steps_s
    lost = epochs.may_move & (gap | ~epochs.valid)
    causes = _loss_conditions(epochs, gap, config)
    numbers = [_NUMBER[cause] for cause in causes]
    first = np.select([lost & applies for applies in causes.values()], numbers, default=-1)
    return LostColumns(steps_s, gap, steps_s * epochs.may_move, steps_s * lost, first)


def lost_time(epochs: JudgedEpochs, lost: LostColumns, alarms: pl.DataFrame, config: Configuration) -> LostTime:
    """Shares of the moving time.

    Args:
        epochs: of one solution, judged.
        lost: what their time was lost to.
        alarms: its rows of `Alarms`.
        config: the configuration; used is `lds.recovery_s`.

    Returns:
        The share lost, its causes, and the monitor that failed most.
    """
    whole_s = float(lost.moving_s.sum())
    if whole_s <= 0.0 or not epochs.moves[:-1].any():
        return LostTime()
    parts = {cause: float(lost.lost_s[lost.lost_to == _NUMBER[cause]].sum()) / whole_s for cause in LostTo}
    ranked = sorted((cause for cause, part in parts.items() if part > 0.0), key=lambda cause: -parts[cause])
    alarmed = lost.lost_to == _NUMBER[LostTo.ALARM]
    unexplained = alarmed & ~_are_explained(alarms, epochs.t_ns, config.lds.recovery_s)
    return LostTime(
        share=float(lost.lost_s.sum()) / whole_s,
        causes={cause: parts[cause] for cause in ranked},
        monitor=_most_failed_monitor(epochs.verdicts, alarmed),
        unfounded=bool(2.0 * lost.lost_s[unexplained].sum() > lost.lost_s[alarmed].sum()),
    )


def _loss_conditions(epochs: JudgedEpochs, gap: Bools, config: Configuration) -> dict[LostTo, Bools]:
    """The epochs to which each cause applies, in the order in which causes count."""
    negated = epochs.lds_mode == _FAIL_SAFE
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
        LostTo.NO_ODOMETER: epochs.odometer_reason != NO_REASON,
    }


def _are_explained(alarms: pl.DataFrame, t_ns: Ints, recovery_s: float) -> Bools:
    """Epochs of alarm episodes that were due, or that belong to a hazard, and of the recovery after them."""
    inside = np.zeros(t_ns.size, dtype=np.bool_)
    if alarms.is_empty():
        return inside
    due = alarms.filter((pl.col("verdict") == Verdict.TRUE.value) | pl.col("hazard_id").is_not_null())
    ends_ns = times_ns(due, "t_end") + round(recovery_s * NS_PER_S)
    for start_ns, end_ns in zip(times_ns(due, "t_start"), ends_ns, strict=True):
        inside |= (t_ns >= start_ns) & (t_ns <= end_ns)
    return inside


def _most_failed_monitor(verdicts: Mapping[str, Verdicts], alarmed: Bools) -> str | None:
    """The monitor that failed in most of these epochs."""
    if not alarmed.any():
        return None
    counts = {name: int((verdicts[name].fails & alarmed).sum()) for name in MONITORS}
    loudest = max(counts, key=lambda name: counts[name])
    return loudest if counts[loudest] else None


FAST_OF_BANK = tuple(monitor.name for monitor in ALL_MONITORS if monitor.scale is not None and monitor.is_fast)
"""Monitors that the receiver's fast noise fails where the model states it too small."""

_LACKING = {Reason.ACCEPTED_UNKNOWN, Reason.BUDGET_UNKNOWN, Reason.UNKNOWN_IN_USE}
"""Reasons that more evidence would remove."""

# Stamps of epochs are round to milliseconds.
_STAMPS_S = 1e-3


@frozen
class InUse:
    """Moving time [s]: all of it, with a position in use, and of this what is unknown before the first and after the
    last epoch that is judged, and between them.
    """

    moving_s: float = 0.0
    in_use_s: float = 0.0
    unknown_at_ends_s: float = 0.0
    unknown_between_s: float = 0.0

    def share(self, part_s: float) -> float:
        """Share of the moving time."""
        return min(1.0, part_s / self.moving_s) if self.moving_s else 0.0


def moving_in_use(epochs: JudgedEpochs, moving_s: float) -> InUse:
    """Moving time in use of judged epochs, and what of it is unknown; `moving_s`: all moving time [s]."""
    known = epochs.judgements.is_judged
    inside = np.logical_or.accumulate(known) & np.logical_or.accumulate(known[::-1])[::-1]
    used_s = epochs.used_s * (epochs.in_use & epochs.may_move)
    parts = (np.ones_like(known), ~known & ~inside, ~known & inside)
    return InUse(moving_s, *(float(used_s[part].sum()) for part in parts))


def remedies(
    run: Mapping[str, Any],
    lost: LostTime,
    used: InUse,
    survey_stated: bool,
    config: Configuration,
    clock_open_m: float = 0.0,
) -> dict[Remedy, float]:
    """What would mend this run, the largest gain first, then in the order of the enum.

    The gain is the share of the moving time that it would win back, or whose positions it would let be judged, at
    most. `survey_stated`: the survey states its sigma; `clock_open_m`: how wide the clocks of the recorders alone make
    the evidence at the highest speed.
    """
    unproven = run["verdict"] == RunVerdict.UNPROVEN
    reasons = frozenset(run.get("reasons") or ())
    missing = unproven and bool(reasons & _LACKING)
    truth = run["evidence"] in TRUTH
    scarce = run["availability"] is not None and run["availability"] < config.advice.low_availability

    def lost_to(*causes: LostTo) -> float:
        """Share of the moving time that was lost to these causes."""
        return sum(lost.causes.get(cause, 0.0) for cause in causes)

    def cost_much(*causes: LostTo) -> bool:
        """Whether the run has low availability and lost enough of its moving time to these causes."""
        return scarce and lost_to(*causes) >= config.advice.lost_share

    healthy = lost.unfounded and not run["faults_injected"]
    noisy = healthy and lost.monitor in FAST_OF_BANK and cost_much(LostTo.ALARM, LostTo.RELINK)
    # Some time passes in every run until the noise is known; alone it has to make availability low.
    loud = lost_to(LostTo.NOISE) > 1.0 - config.advice.low_availability
    calibrate = (noisy or loud) and not config.calibration.runs
    # What calibrates the noise measures the odometer too.
    without_scale = run["vehicle"] == VehicleFigures.LEARNED and not calibrate
    # Nobody can declare it to be something else.
    of_gnss = run.get("odometer_origin") in (Origin.GNSS, Origin.FUSED) or Reason.ODOMETER_FOLLOWS_GNSS in reasons
    # Calibration refuses an odometer that may be made of the positions.
    independent = not reasons & {Reason.ODOMETER_ORIGIN_UNKNOWN, Reason.ODOMETER_FOLLOWS_GNSS}
    late_s = _time_lost_to_rate_s(run, config)

    in_use = used.share(used.in_use_s)
    unknown = used.share(used.unknown_at_ends_s + used.unknown_between_s)
    ambiguous = lost_to(LostTo.TRACK_AMBIGUOUS)
    noise = noisy * lost_to(LostTo.ALARM, LostTo.RELINK) + lost_to(LostTo.NOISE)
    # Each with its gain.
    table = {
        Remedy.CALIBRATE: (calibrate and independent, noise),
        Remedy.VEHICLE_FILE: (
            without_scale and independent and (cost_much(LostTo.RELINK) or unproven),
            lost_to(LostTo.RELINK) + unknown,
        ),
        Remedy.REFERENCE: (missing and not truth, unknown),
        Remedy.READS_AT_ENDS: (
            missing and truth and used.unknown_at_ends_s > config.budget_s,
            used.share(used.unknown_at_ends_s),
        ),
        Remedy.READS_CLOSER: (
            missing and truth and used.unknown_between_s > config.budget_s,
            used.share(used.unknown_between_s),
        ),
        Remedy.ROUTE: (cost_much(LostTo.TRACK_AMBIGUOUS), ambiguous),
        Remedy.CLOCK: (
            # Of the room for an error, the limit to both sides, the clocks alone take half.
            bool(reasons & {Reason.CLOCK_ASSUMED, Reason.EVIDENCE_DISPUTED})
            or (missing and truth and clock_open_m > config.hazards.limits.clock_open_m),
            unknown,
        ),
        Remedy.ODOMETER: (
            run["vehicle"] == VehicleFigures.NONE or of_gnss or cost_much(LostTo.NO_ODOMETER),
            lost_to(LostTo.NO_ODOMETER) + of_gnss * in_use,
        ),
        # What such an odometer validates is validated by nothing.
        Remedy.ODOMETER_ORIGIN: (Reason.ODOMETER_ORIGIN_UNKNOWN in reasons and not of_gnss, in_use),
        Remedy.FASTER_LOG: (late_s > 0.0, used.share(late_s)),
        Remedy.SURVEY_SIGMA: (cost_much(LostTo.TRACK_AMBIGUOUS) and not survey_stated, ambiguous),
        Remedy.REFERENCE_SIGMA: (False, 0.0),
        Remedy.SURVEY_COMPLETE: (Reason.TRACK_ASSUMED in reasons, unknown),
    }
    gains = {remedy: gain for remedy, (applies, gain) in table.items() if applies}
    return dict(sorted(gains.items(), key=lambda item: -item[1]))


def _time_lost_to_rate_s(run: Mapping[str, Any], config: Configuration) -> float:
    """Time of failures beyond the budget [s] that were negated as soon as an epoch allows, and hurt no balise."""
    if not run["gnss_rate_hz"]:
        return 0.0
    period_s = 1.0 / run["gnss_rate_hz"]
    needs_s = period_s + reaction_or_period_s(period_s, config)
    failures = zip(run["failure_hazardous_may_s"] or (), run["failure_accepted"] or (), strict=True)
    return sum(
        float(spent_s)
        for spent_s, accepted in failures
        if accepted == Judgement.RIGHT and config.budget_s < spent_s <= needs_s + _STAMPS_S
    )
