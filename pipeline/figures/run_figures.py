"""Figures of one solution of one run: availability, accuracy, balises, hazards, alarms, states (CONTRACT section 3)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import polars as pl

from pipeline.epochs.clock import Clock, flags, trusted, usable
from pipeline.epochs.timeline import availability, outages_s, share_of_time, uptime
from pipeline.figures.bounds import UNKNOWN, Estimate, poisson_rate
from pipeline.hazards.independent import independent_episodes, missed_detection
from pipeline.motion import Motion
from schemas.config import Configuration, SafetyConfig
from schemas.enums import (
    TRUTH,
    BaliseKind,
    Evidence,
    Hazard,
    LdsState,
    MonitorState,
    PassageStatus,
    ThrVerdict,
    Verdict,
)
from schemas.tables import SCALES

Row = dict[str, object]

CONTINUITY_S = 15.0
"""Most critical phase of an APV-I/LPV-200 operation (LOC section VI)."""

_REJECTED = [status.value for status in PassageStatus if status.value.startswith("rejected_")]


def positions(epochs: pl.DataFrame, motion: Motion, clock: Clock, config: Configuration) -> Row:
    """Availability, outages and continuity (CONTRACT section 3; LOC eq. 8).

    Time of which nobody knows whether the train moved counts as moving, and a TVB in it does not.
    """
    lost = outages_s(clock.t_ns, flags(epochs, usable()), clock.limit_s)
    valid = flags(epochs, pl.col("tvb")) & motion.known
    share = availability(clock.t_ns, valid, motion.moving | ~motion.known, clock.limit_s)
    trust = uptime(clock.t_ns, flags(epochs, trusted(config)), clock.limit_s)
    mtbf_h = trust.mean_time_between_losses_h
    return {
        "availability": share if (motion.moving & motion.known)[:-1].any() else None,
        "outages": len(lost),
        "longest_outage_s": float(lost.max()) if len(lost) else 0.0 if epochs.height else None,
        "cross_bias_m": epochs["cross_track_m"].filter(epochs["on_track"]).median(),
        "mtbf_h": mtbf_h,
        "continuity_15s": math.exp(-CONTINUITY_S / 3600.0 / mtbf_h) if mtbf_h else None,
        "trusted_s": trust.up_s if epochs.height else None,
        "trusted_losses": trust.losses,
    }


def _spread(errors: pl.Series, name: str) -> Row:
    """Mean, 95 % and largest of the known errors; the latter two of their magnitude."""
    size = errors.abs()
    return {
        f"{name}_mean_m": errors.mean(),
        f"{name}_p95_m": size.quantile(0.95, interpolation="linear"),
        f"{name}_max_m": size.max(),
    }


def accuracy(epochs: pl.DataFrame) -> Row:
    row: Row = {}
    for axis in ("along", "cross", "up"):
        row |= _spread(epochs[f"error_{axis}_m"], f"{axis}_error")
    return row


def balise_counts(passages: pl.DataFrame, evidence: Evidence | None, failure_limit_m: float) -> Row:
    """What became of the virtual balises; `accepted_judged` without a truth is zero, whatever the odometer says."""
    virtual, status, error = pl.col("kind") == BaliseKind.VIRTUAL, pl.col("status"), pl.col("location_error_m")
    accepted = virtual & (status == PassageStatus.ACCEPTED)
    counts = {
        "balises_on_path": virtual & is_passage(),
        "balises_accepted": accepted,
        "balises_rejected": virtual & status.is_in(_REJECTED),
        "balises_missed": virtual & (status == PassageStatus.MISSED),
        "balises_not_available": virtual & (status == PassageStatus.NOT_AVAILABLE),
        "accepted_judged": accepted & error.is_not_null() & pl.lit(evidence in TRUTH),
        "unsafe_accepted": accepted & (error.abs() > failure_limit_m),
    }
    known = passages.select(error.filter(accepted)).to_series()
    return {**_counted(passages, counts), **_spread(known, "location_error")}


def _counted(frame: pl.DataFrame, conditions: Mapping[str, pl.Expr]) -> Row:
    """In how many rows each condition holds."""
    return frame.select(condition.sum().alias(name) for name, condition in conditions.items()).row(0, named=True)


def is_passage() -> pl.Expr:
    """A row of `passages` that is no offer beyond the passages of the train.

    An offer beyond is one for which the evidence knows no true crossing; an offer without evidence
    (no location error) counts as a passage.
    """
    beyond = pl.col("t_true").is_null() & pl.col("t_offered").is_not_null() & pl.col("location_error_m").is_not_null()
    return ~beyond


def hazard_counts(hazards: pl.DataFrame) -> Row:
    classes = {
        Hazard.VB_JUMP_1A: "hazards_1a",
        Hazard.VB_JUMP_1B: "hazards_1b",
        Hazard.VB_SHIFT: "hazards_shift",
    }
    counts = {column: pl.col("hazard") == kind for kind, column in classes.items()}
    counts |= {
        "hazards_detected": pl.col("detected"),
        "hazards_within_budget": pl.col("within_budget"),
        "missed_detections": missed_detection(),
    }
    return {
        **_counted(hazards, counts),
        "time_to_detect_max_s": hazards["time_to_detect_s"].max(),
        "time_since_failure_max_s": hazards["time_since_failure_s"].max(),
        "hazardous_max_s": hazards["hazardous_s"].max(),
    }


def service_levels(hazards: pl.DataFrame, evidence: Evidence | None, safety: SafetyConfig) -> Row:
    """Whether the failures were negated within the allowed T_D of each service level (TVB eq. 7)."""
    hazardous_s: list[float | None] = []
    if hazards.height:
        faults = independent_episodes(hazards.with_columns(run_id=pl.lit("")))
        hazardous_s = faults.filter("failed")["hazardous_s"].to_list()
    failures = len(hazardous_s)
    allowed_s = [safety.allowed_time_to_detect_s(level) for level in safety.service_levels]
    within = [sum(spent_s is not None and spent_s <= limit_s for spent_s in hazardous_s) for limit_s in allowed_s]
    return {
        "failures": failures,
        "service_levels": list(safety.service_levels),
        "level_allowed_s": allowed_s,
        "level_within": within,
        "level_verdict": [_verdict(failures, count, evidence) for count in within],
    }


def _verdict(failures: int, within: int, evidence: Evidence | None) -> ThrVerdict:
    if failures:
        return ThrVerdict.KEPT if within == failures else ThrVerdict.EXCEEDED
    return ThrVerdict.UNKNOWN if evidence is None else ThrVerdict.NO_FAILURE


def alarm_counts(alarms: pl.DataFrame, epochs: pl.DataFrame, evidence: Evidence | None, clock: Clock) -> Row:
    """Alarms and the rate of false ones, which needs a truth and a verdict on every alarm.

    The rate counts the time in which the along-track bank judged and the error was known; without any there is none.
    """
    false = alarms.filter(pl.col("verdict") == Verdict.FALSE).height
    truth = evidence is not None and epochs["error_along_m"].is_not_null().any()
    judged = truth and not (alarms["verdict"] == Verdict.UNKNOWN).any()
    monitored, seen = flags(epochs, _along_evaluated()), flags(epochs, pl.col("error_along_m").is_not_null())
    judged_s = float(clock.held_s[monitored & seen].sum())
    rate: Estimate = poisson_rate(false, judged_s / 3600.0) if judged else UNKNOWN
    times = {
        "held_s": clock.held_s,
        "monitored_s": clock.held_s[monitored],
        "evidence_s": clock.held_s[seen],
        "judged_s": clock.held_s[monitored & seen],
    }
    return {
        **{name: float(held.sum()) if epochs.height else None for name, held in times.items()},
        "alarms": alarms.height,
        "false_alarms": false if truth else None,
        "false_alarm_rate_per_h": rate.value,
        "false_alarm_rate_low_per_h": rate.low,
        "false_alarm_rate_high_per_h": rate.high,
    }


def _along_evaluated() -> pl.Expr:
    """A monitor of the along-track bank has a verdict."""
    return pl.any_horizontal(pl.col(f"along_{scale}_state") != MonitorState.NOT_EVALUATED for scale in SCALES)


def exposure(epochs: pl.DataFrame) -> Row:
    exposure = epochs["exposure_s"]
    return {
        "exposure_max_s": exposure.max(),
        "exposure_p99_s": exposure.quantile(0.99, interpolation="linear"),
    }


def state_shares(epochs: pl.DataFrame, clock: Clock) -> Row:
    """Shares of the time, gaps apart, known to be spent in each state of the LDS (TVB section 4).

    Where the truth is missing for a while the four do not add up to one; where it is missing
    throughout, P0 and P1 are not known.
    """
    states = {f"share_{state.value.lower()}": pl.col("lds_state") == state for state in LdsState}
    inside = epochs.select(condition.fill_null(value=False).alias(name) for name, condition in states.items())
    row: Row = {flag.name: share_of_time(clock.held_s, flag.to_numpy()) for flag in inside}
    if epochs["lds_state"].null_count() and not (inside["share_p0"].any() or inside["share_p1"].any()):
        row |= {"share_p0": None, "share_p1": None}
    return row


def stanford_counts(epochs: pl.DataFrame, limit_m: float, bound: str = "confidence_m") -> Row:
    """Epochs of known error by error and bound along the track (CONTRACT section 3, `stanford_*`)."""
    known = epochs.select(error=pl.col("error_along_m").abs(), bound=pl.col(bound)).drop_nulls()
    error, claimed = known["error"].to_numpy(), known["bound"].to_numpy()
    offered = claimed <= limit_m
    return {
        "stanford_nominal": int(np.sum(offered & (error <= claimed))),
        "stanford_misleading": int(np.sum(offered & (error > claimed) & (error <= limit_m))),
        "stanford_hazardous": int(np.sum(offered & (error > limit_m))),
        "stanford_unavailable": int(np.sum(~offered)),
    }


def stanford_of_receiver(epochs: pl.DataFrame, limit_m: float) -> Row:
    """The same counts with the receiver's protection level as bound; not known where it gives none."""
    counts = stanford_counts(epochs, limit_m, "hpl_m") if epochs["hpl_m"].count() else {}
    return {f"stanford_hpl_{name.removeprefix('stanford_')}": value for name, value in counts.items()}
