"""Figures of one solution of one run: availability, accuracy, balises, hazards, alarms, states (CONTRACT section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import (
    Clock,
    availability,
    may_move,
    met,
    outages_s,
    share_of_time,
    trusted,
    uptime,
    usable,
)
from pipeline.stages.run_row.bounds import CONTINUITY_S, UNKNOWN, Estimate, columns_of, continuity, poisson_rate
from pipeline.stages.run_row.independent import missed_detection
from pipeline.stages.run_row.verdict import LEVEL_LISTS, level_rows
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration
from schemas.enums import (
    TRUTH,
    BaliseKind,
    Evidence,
    Hazard,
    Judgement,
    LdsState,
    MonitorState,
    PassageStatus,
    Verdict,
)
from schemas.tables import SCALES

Row = dict[str, Any]


def positions(epochs: pl.DataFrame, clock: Clock, config: Configuration) -> Row:
    """Availability, outages and continuity (CONTRACT section 3; LOC eq. 8).

    Time of which nobody knows whether the train moved counts as moving, and a TVB in it does not (DOMAIN section 5.5).
    """
    lost = outages_s(clock.t_ns, met(epochs, usable()), clock.limit_s)
    valid = met(epochs, pl.col("tvb") & pl.col("moving").is_not_null())
    share = availability(clock.t_ns, valid, met(epochs, may_move()), clock.limit_s)
    trust = uptime(clock.t_ns, met(epochs, trusted(config)), clock.limit_s)
    mtbf_h = trust.mean_time_between_losses_h
    return {
        "availability": share if met(epochs, pl.col("moving"))[:-1].any() else None,
        "outages": len(lost),
        "longest_outage_s": float(lost.max()) if len(lost) else 0.0 if epochs.height else None,
        "cross_bias_m": epochs["cross_track_m"].filter(epochs["on_track"]).median(),
        "mtbf_h": mtbf_h,
        "continuity_15s": continuity(CONTINUITY_S, mtbf_h) if mtbf_h else None,
        "trusted_s": trust.up_s if epochs.height else None,
        "trusted_losses": trust.losses,
    }


def judged() -> pl.Expr:
    """The evidence calls the position right or wrong (DOMAIN section 5.2)."""
    return pl.col("judgement").is_in([Judgement.RIGHT, Judgement.WRONG])


def time_in_use(epochs: pl.DataFrame, recovery_s: float) -> Row:
    """Time in use, and what of it nobody can judge or nothing diagnoses (DOMAIN section 5.4).

    `epochs`: with the columns of `JudgedEpochs`. Shares are of the moving time in use, null without any.
    """
    used_s = floats(epochs, "used_s")
    moves = met(epochs, may_move())
    seen = met(epochs, judged())
    moving_s = used_s[moves]
    unknown = ~seen & moves & (used_s > 0.0)
    return {
        "in_use_s": float(used_s.sum()) if epochs.height else None,
        "in_use_judged_s": float(used_s[seen].sum()) if epochs.height else None,
        "negated_s": float(floats(epochs, "counted_s")[met(epochs, pl.col("negated"))].sum())
        if epochs.height
        else None,
        "share_unknown": share_of_time(moving_s, ~seen[moves]),
        "share_undiagnosed": share_of_time(moving_s, met(epochs, pl.col("undiagnosed"))[moves]),
        "unknown_in_use_s": _longest_s(times_ns(epochs), used_s, unknown, recovery_s) if epochs.height else None,
    }


def _longest_s(t_ns: Ints, used_s: Floats, where: Bools, apart_s: float) -> float:
    """Longest time that epochs less than `apart_s` from each other stand for [s]."""
    rows = np.flatnonzero(where)
    breaks = np.flatnonzero(np.diff(t_ns[rows]) >= apart_s * NS_PER_S) + 1
    return max((float(used_s[part].sum()) for part in np.split(rows, breaks)), default=0.0)


def proof_margin_m(epochs: pl.DataFrame, passages: pl.DataFrame, limit_m: float) -> float | None:
    """Least proof margin of the epochs in use and the acceptances that are right [m] (DOMAIN section 5.2)."""
    right = (pl.col("judgement") == Judgement.RIGHT) & pl.col("in_use")
    largest_m = pl.max_horizontal(-pl.col("error_low_m"), pl.col("error_high_m"))
    of_epochs = epochs.select((limit_m - largest_m.filter(right)).min()).item()
    of_passages = passages.filter(accepted())["proof_margin_m"].min()
    margins = [margin for margin in (of_epochs, of_passages) if isinstance(margin, float)]
    return min(margins, default=None)


def spread(error: pl.Expr, name: str, counted: str) -> dict[str, pl.Expr]:
    """Mean, 95 % and largest of the known errors [m], the latter two of their magnitude, and how many these are."""
    size = error.abs()
    return {
        f"{name}_mean_m": error.mean(),
        f"{name}_p95_m": size.quantile(0.95, interpolation="linear"),
        f"{name}_max_m": size.max(),
        f"{name}_{counted}": size.count().cast(pl.Int64),
    }


def accuracy(epochs: pl.DataFrame) -> Row:
    errors: dict[str, pl.Expr] = {}
    for axis in ("along", "cross", "up"):
        errors |= spread(pl.col(f"error_{axis}_m"), f"{axis}_error", "epochs")
    return epochs.select(**errors).row(0, named=True)


def accepted() -> pl.Expr:
    return pl.col("status") == PassageStatus.ACCEPTED


def outcomes() -> dict[str, pl.Expr]:
    """Conditions on passages: what became of the offer."""
    status = pl.col("status")
    return {
        "accepted": accepted(),
        "rejected": status.cast(pl.String).str.starts_with("rejected_"),
        "missed": status == PassageStatus.MISSED,
        "not_available": status == PassageStatus.NOT_AVAILABLE,
    }


def acceptances() -> dict[str, pl.Expr]:
    """Conditions on passages: acceptances by what the judge says of them; none re-judges."""
    known = judged().fill_null(value=False)
    return {
        "accepted_judged": accepted() & known,
        "unsafe_accepted": accepted() & (pl.col("judgement") == Judgement.WRONG).fill_null(value=False),
        "unproven_accepted": accepted() & ~known,
        "initialising_accepted": pl.col("initialising"),
    }


def balise_counts(passages: pl.DataFrame) -> Row:
    """What became of the virtual balises, and of those accepted what the judge says of their positions."""
    virtual = passages.filter(pl.col("kind") == BaliseKind.VIRTUAL)
    counts = {"balises_on_path": is_passage(), **{f"balises_{name}": met for name, met in outcomes().items()}}
    errors = spread(pl.col("location_error_m").filter(accepted()), "location_error", "count")
    return _counted(virtual, counts | acceptances()) | virtual.select(**errors).row(0, named=True)


def _counted(frame: pl.DataFrame, conditions: Mapping[str, pl.Expr]) -> Row:
    """In how many rows each condition holds."""
    return frame.select(condition.sum().alias(name) for name, condition in conditions.items()).row(0, named=True)


def is_passage() -> pl.Expr:
    """A row of `passages` that is no offer beyond the passages of the train.

    An offer beyond is one that is judged wrong and for which the evidence knows no true crossing.
    """
    wrong = (pl.col("judgement") == Judgement.WRONG.value).fill_null(value=False)
    return ~(pl.col("t_true").is_null() & wrong)


def hazard_counts(hazards: pl.DataFrame) -> Row:
    counts = {kind.counted_as: pl.col("hazard") == kind for kind in Hazard} | {
        "hazards_detected": pl.col("detected"),
        "hazards_within_budget": pl.col("within_budget"),
        "missed_detections": missed_detection(),
    }
    return {
        **_counted(hazards, counts),
        "time_to_detect_max_s": hazards["time_to_detect_s"].max(),
        "time_since_failure_max_s": hazards["time_since_failure_s"].max(),
        "time_since_failure_may_max_s": hazards["time_since_failure_may_s"].max(),
    }


def failure_counts(failures: pl.DataFrame) -> Row:
    """Every failure counts, whether it hit a VB or not (DOMAIN section 5.3); frame as in `schemas.stages.Failures`."""
    counts = {"failures_within_budget": pl.col("within_budget"), "failures_beyond_budget": ~pl.col("within_budget")}
    return {
        "failures": failures.height,
        **_counted(failures, counts),
        "hazardous_max_s": failures["hazardous_s"].max(),
        "hazardous_s": failures["hazardous_s"].sum(),
        "failure_hazardous_s": failures["hazardous_s"].to_list(),
        "failure_hazardous_may_s": failures["hazardous_may_s"].to_list(),
        "failure_accepted": failures["accepted"].to_list(),
    }


def service_levels(row: Row, config: Configuration) -> Row:
    """The row against the allowed T_D of each service level (TVB eq. 7)."""
    rows = level_rows(row, config)
    return {name: [level[part] for level in rows] for part, name in LEVEL_LISTS.items()}


def alarm_counts(alarms: pl.DataFrame, epochs: pl.DataFrame, evidence: Evidence | None) -> Row:
    """Alarms and the rate of false ones, which needs a reference or balise reads and a verdict on every alarm.

    The rate counts the time in use in which the along-track bank judged and the position was judged (DOMAIN 6).
    """
    false = alarms.filter(pl.col("verdict") == Verdict.FALSE).height
    monitored = met(epochs, _along_evaluated())
    seen = met(epochs, judged())
    truth = evidence in TRUTH and bool(seen.any())
    complete = truth and not (alarms["verdict"] == Verdict.UNKNOWN).any()
    counted_s = floats(epochs, "counted_s")
    in_use = met(epochs, pl.col("in_use"))
    judged_s = float(counted_s[monitored & seen & in_use].sum())
    rate: Estimate = poisson_rate(false, judged_s / 3600.0) if complete else UNKNOWN
    times = {
        "held_s": counted_s,
        "monitored_s": counted_s[monitored],
        "evidence_s": counted_s[seen],
        "judged_s": counted_s[monitored & seen & in_use],
    }
    return {
        **{name: float(held.sum()) if epochs.height else None for name, held in times.items()},
        "alarms": alarms.height,
        "false_alarms": false if truth else None,
        **columns_of("false_alarm_rate", rate, "_per_h"),
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


def state_shares(epochs: pl.DataFrame) -> Row:
    """Share of the time, without gaps, in which each state of the LDS is known to hold (TVB section 4).

    The time in P1 is the hazardous time of all failures. While the state is unknown no share grows, so the four may add
    up to less than one. If some state is unknown and no epoch is known to be P0, the share of P0 is null, not 0; so is
    that of P1 unless some epoch is in it.
    """
    states = {f"share_{state.value.lower()}": pl.col("lds_state") == state for state in LdsState}
    inside = epochs.select(condition.fill_null(value=False).alias(name) for name, condition in states.items())
    counted_s = floats(epochs, "counted_s")
    row: Row = {flag.name: share_of_time(counted_s, flag.to_numpy()) for flag in inside}
    if epochs["lds_state"].null_count() and not inside["share_p0"].any():
        unknown = ["share_p0"] if inside["share_p1"].any() else ["share_p0", "share_p1"]
        row |= dict.fromkeys(unknown)
    return row


def stanford_counts(epochs: pl.DataFrame, limit_m: float, bound: str = "confidence_m") -> Row:
    """Epochs whose error is known to 5 m, by error and bound along the track (CONTRACT section 3, `stanford_*`)."""
    known = epochs.select(error=pl.col("error_along_m").abs(), bound=pl.col(bound)).drop_nulls()
    error = known["error"].to_numpy()
    claimed = known["bound"].to_numpy()
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
