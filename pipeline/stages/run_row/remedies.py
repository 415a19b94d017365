"""What would mend a verdict or a low availability: one decision table over the `runs` row (DOMAIN section 5.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import may_move, met, reaction_of
from pipeline.stages.run_row.lost_time import LostTime
from schemas.arrays import floats
from schemas.config import Configuration
from schemas.enums import TRUTH, Judgement, LostTo, Origin, Reason, Remedy, RunVerdict, VehicleFigures
from schemas.tables import BANK_MONITORS

FAST = tuple(name for name in BANK_MONITORS if name.endswith(("_raw", "_ewma_0p1")))
"""Monitors that the receiver's fast noise fails where the model states it too small."""

_LACKING = {Reason.ACCEPTED_UNKNOWN, Reason.BUDGET_UNKNOWN, Reason.UNKNOWN_IN_USE}
"""Reasons that more evidence would remove."""

# Stamps of epochs are round to milliseconds.
_STAMPS_S = 1e-3


@dataclass(frozen=True)
class Unknown:
    """Whether more moving time in use than the budget is unknown before the first and after the last epoch that is
    judged, and between them.
    """

    at_ends: bool
    between: bool


def unknown_parts(epochs: pl.DataFrame, config: Configuration) -> Unknown:
    known = met(epochs, pl.col("judgement") != Judgement.UNKNOWN.value)
    inside = np.logical_or.accumulate(known) & np.logical_or.accumulate(known[::-1])[::-1]
    unknown_s = floats(epochs, "used_s") * (met(epochs, pl.col("in_use") & may_move()) & ~known)
    at_ends_s, between_s = (float(unknown_s[part].sum()) for part in (~inside, inside))
    return Unknown(at_ends_s > config.budget_s, between_s > config.budget_s)


def remedies(
    run: Mapping[str, Any],
    lost: LostTime,
    unknown: Unknown,
    survey_stated: bool,
    config: Configuration,
    clock_open_m: float = 0.0,
) -> list[Remedy]:
    """What would mend this run, in the order of the enum, a missing declaration first.

    `survey_stated`: the survey states its sigma; `clock_open_m`: how wide the clocks of the recorders alone make the
    evidence at the highest speed.
    """
    unproven = run["verdict"] == RunVerdict.UNPROVEN
    reasons = frozenset(run.get("reasons") or ())
    missing = unproven and bool(reasons & _LACKING)
    truth = run["evidence"] in TRUTH
    scarce = run["availability"] is not None and run["availability"] < config.advice.low_availability

    def costs(*causes: LostTo) -> bool:
        """Enough of the moving time of a run of low availability was lost to these."""
        return scarce and sum(lost.causes.get(cause, 0.0) for cause in causes) >= config.advice.lost_share

    healthy = lost.unfounded and not run["faults_injected"]
    noisy = healthy and lost.monitor in FAST and costs(LostTo.ALARM, LostTo.RELINK)
    # Some time passes in every run until the noise is known; alone it has to make availability low.
    loud = lost.causes.get(LostTo.NOISE, 0.0) > 1.0 - config.advice.low_availability
    calibrate = (noisy or loud) and not config.calibration.runs
    # What calibrates the noise measures the odometer too.
    without_scale = run["vehicle"] == VehicleFigures.LEARNED and not calibrate
    # Nobody can declare it to be something else.
    of_gnss = run.get("odometer_origin") in (Origin.GNSS, Origin.FUSED) or Reason.ODOMETER_FOLLOWS_GNSS in reasons
    # Calibration refuses an odometer that may be made of the positions.
    independent = not reasons & {Reason.ODOMETER_ORIGIN_UNKNOWN, Reason.ODOMETER_FOLLOWS_GNSS}
    table = {
        Remedy.CALIBRATE: calibrate and independent,
        Remedy.VEHICLE_FILE: without_scale and independent and (costs(LostTo.RELINK) or unproven),
        Remedy.REFERENCE: missing and not truth,
        Remedy.READS_AT_ENDS: missing and truth and unknown.at_ends,
        Remedy.READS_CLOSER: missing and truth and unknown.between,
        Remedy.ROUTE: costs(LostTo.TRACK_AMBIGUOUS),
        Remedy.CLOCK: bool(reasons & {Reason.CLOCK_ASSUMED, Reason.EVIDENCE_DISPUTED}),
        # Of the room for an error, the limit to both sides, the clocks alone take half.
        Remedy.RECORDER_LATENCY: missing and truth and clock_open_m > config.hazards.failure_limit_m,
        Remedy.ODOMETER: run["vehicle"] == VehicleFigures.NONE or of_gnss or costs(LostTo.NO_ODOMETER),
        Remedy.ODOMETER_ORIGIN: Reason.ODOMETER_ORIGIN_UNKNOWN in reasons and not of_gnss,
        Remedy.FASTER_LOG: _too_slow(run, config),
        Remedy.SURVEY_SIGMA: costs(LostTo.TRACK_AMBIGUOUS) and not survey_stated,
        Remedy.REFERENCE_SIGMA: False,
        Remedy.SURVEY_COMPLETE: Reason.TRACK_ASSUMED in reasons,
    }
    # An odometer that counts comes first: nothing else helps as long as there is none.
    first = None if independent else Remedy.ODOMETER if of_gnss else Remedy.ODOMETER_ORIGIN
    return sorted((remedy for remedy in Remedy if table[remedy]), key=lambda one: one is not first)


def _too_slow(run: Mapping[str, Any], config: Configuration) -> bool:
    """A failure beyond the budget that was negated as soon as an epoch of this log allows, and hurt no balise."""
    if not run["gnss_rate_hz"]:
        return False
    period_s = 1.0 / run["gnss_rate_hz"]
    needs_s = period_s + reaction_of(period_s, config)
    failures = zip(run["failure_hazardous_may_s"] or (), run["failure_accepted"] or (), strict=True)
    return any(
        accepted == Judgement.RIGHT and config.budget_s < spent_s <= needs_s + _STAMPS_S
        for spent_s, accepted in failures
    )
