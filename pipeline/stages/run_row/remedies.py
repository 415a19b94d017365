"""What would mend a verdict or a low availability: one decision table over the `runs` row (DOMAIN section 5.4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.stages.epochs.clock import reaction_of
from pipeline.stages.run_row.lost_time import LostTime
from schemas.config import Configuration
from schemas.enums import TRUTH, Judgement, LostTo, Origin, Reason, Remedy, RunVerdict, VehicleFigures
from schemas.frozen import frozen
from schemas.stages import EpochFigures
from schemas.tables import ALL_MONITORS

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
        """Of the moving time."""
        return min(1.0, part_s / self.moving_s) if self.moving_s else 0.0


def time_in_use(epochs: EpochFigures, moving_s: float) -> InUse:
    """Of the judged epochs; `moving_s`: moving time."""
    known = (epochs.judgement >= 0) & ~epochs.is_judged(Judgement.UNKNOWN)
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
        return sum(lost.causes.get(cause, 0.0) for cause in causes)

    def costs(*causes: LostTo) -> bool:
        """Enough of the moving time of a run of low availability was lost to these."""
        return scarce and lost_to(*causes) >= config.advice.lost_share

    healthy = lost.unfounded and not run["faults_injected"]
    noisy = healthy and lost.monitor in FAST_OF_BANK and costs(LostTo.ALARM, LostTo.RELINK)
    # Some time passes in every run until the noise is known; alone it has to make availability low.
    loud = lost_to(LostTo.NOISE) > 1.0 - config.advice.low_availability
    calibrate = (noisy or loud) and not config.calibration.runs
    # What calibrates the noise measures the odometer too.
    without_scale = run["vehicle"] == VehicleFigures.LEARNED and not calibrate
    # Nobody can declare it to be something else.
    of_gnss = run.get("odometer_origin") in (Origin.GNSS, Origin.FUSED) or Reason.ODOMETER_FOLLOWS_GNSS in reasons
    # Calibration refuses an odometer that may be made of the positions.
    independent = not reasons & {Reason.ODOMETER_ORIGIN_UNKNOWN, Reason.ODOMETER_FOLLOWS_GNSS}
    late_s = _too_slow_s(run, config)

    in_use = used.share(used.in_use_s)
    unknown = used.share(used.unknown_at_ends_s + used.unknown_between_s)
    ambiguous = lost_to(LostTo.TRACK_AMBIGUOUS)
    noise = noisy * lost_to(LostTo.ALARM, LostTo.RELINK) + lost_to(LostTo.NOISE)
    # Each with its gain.
    table = {
        Remedy.CALIBRATE: (calibrate and independent, noise),
        Remedy.VEHICLE_FILE: (
            without_scale and independent and (costs(LostTo.RELINK) or unproven),
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
        Remedy.ROUTE: (costs(LostTo.TRACK_AMBIGUOUS), ambiguous),
        Remedy.CLOCK: (
            # Of the room for an error, the limit to both sides, the clocks alone take half.
            bool(reasons & {Reason.CLOCK_ASSUMED, Reason.EVIDENCE_DISPUTED})
            or (missing and truth and clock_open_m > config.hazards.limits.clock_open_m),
            unknown,
        ),
        Remedy.ODOMETER: (
            run["vehicle"] == VehicleFigures.NONE or of_gnss or costs(LostTo.NO_ODOMETER),
            lost_to(LostTo.NO_ODOMETER) + of_gnss * in_use,
        ),
        # What such an odometer validates is validated by nothing.
        Remedy.ODOMETER_ORIGIN: (Reason.ODOMETER_ORIGIN_UNKNOWN in reasons and not of_gnss, in_use),
        Remedy.FASTER_LOG: (late_s > 0.0, used.share(late_s)),
        Remedy.SURVEY_SIGMA: (costs(LostTo.TRACK_AMBIGUOUS) and not survey_stated, ambiguous),
        Remedy.REFERENCE_SIGMA: (False, 0.0),
        Remedy.SURVEY_COMPLETE: (Reason.TRACK_ASSUMED in reasons, unknown),
    }
    gains = {remedy: gain for remedy, (applies, gain) in table.items() if applies}
    return dict(sorted(gains.items(), key=lambda item: -item[1]))


def _too_slow_s(run: Mapping[str, Any], config: Configuration) -> float:
    """Time of failures beyond the budget that were negated as soon as an epoch allows, and hurt no balise."""
    if not run["gnss_rate_hz"]:
        return 0.0
    period_s = 1.0 / run["gnss_rate_hz"]
    needs_s = period_s + reaction_of(period_s, config)
    failures = zip(run["failure_hazardous_may_s"] or (), run["failure_accepted"] or (), strict=True)
    return sum(
        float(spent_s)
        for spent_s, accepted in failures
        if accepted == Judgement.RIGHT and config.budget_s < spent_s <= needs_s + _STAMPS_S
    )
