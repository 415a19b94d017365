"""Figures of a `runs` row: availability, accuracy, balises, hazards, alarms, states.

Reasons and verdict (DOMAIN 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Clock, availability, outages_s, share_of_time, uptime
from pipeline.stages.judge.failures import Failure as PositionFailure
from pipeline.stages.judge.failures import keeps_budget
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.run_row.bounds import (
    CONTINUITY_S,
    UNKNOWN,
    columns_of,
    continuity_over,
    independent_episodes,
    poisson_rate,
)
from schemas import enums
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, median
from schemas.config import Configuration, HazardConfig
from schemas.enums import TRUTH, Judgement, PassageStatus, Reason, RunVerdict, ThrVerdict
from schemas.monitors import SCALES

RunRow = Mapping[str, Any]
Failure = tuple[float, float, str]
"""Hazardous time [s], the same with what is unknown, and the worst judgement of the VBs accepted meanwhile."""

_UNSAFE = {Reason.ACCEPTED_WRONG, Reason.FAILURE_BEYOND_BUDGET, Reason.HAZARDOUS_SUM}
_LASTING = (
    Reason.EVIDENCE_DISPUTED,
    Reason.EVIDENCE_CONTRADICTED,
    Reason.ODOMETER_ORIGIN_UNKNOWN,
    Reason.ODOMETER_FOLLOWS_GNSS,
    Reason.TRACK_ASSUMED,
    Reason.SIGMA_DOUBTFUL,
    Reason.INPUT_DOUBTFUL,
    Reason.CLOCK_ASSUMED,
)
"""Reasons that no count of a `runs` row holds: they stand among its `reasons` from the beginning."""

DECISIVE = (
    *("unsafe_accepted", "unproven_accepted", "balises_accepted", "unknown_in_use_s", "share_undiagnosed"),
    *("failure_hazardous_s", "failure_hazardous_may_s", "failure_accepted"),
    *("hazardous_natural_s", "duration_s", "reasons"),
)
"""Columns of `runs` that the reasons are read from."""

LEVEL_LISTS = {
    "service_level": "service_levels",
    "allowed_s": "level_allowed_s",
    "within": "level_within",
    "exceeded": "level_exceeded",
    "verdict": "level_verdict",
}
"""What `level_rows` gives for each service level, and the list of the `runs` table that holds it."""

_OF_LEVEL = {RunVerdict.UNSAFE: ThrVerdict.EXCEEDED, RunVerdict.UNPROVEN: ThrVerdict.UNKNOWN}


def reasons_of(run: RunRow, allowed_s: float, hazards: HazardConfig) -> list[Reason]:
    """Why a run has its verdict.

    Args:
        run: its row, or the columns `DECISIVE` of it.
        allowed_s: allowed T_D [s].
        hazards: limits of the configuration.

    Returns:
        All reasons that apply, in the order of the enumeration.

    Source:
        DOMAIN section 5.4.
    """
    failures = failures_of_run(run)
    within, beyond = count_kept_and_exceeded(failures, allowed_s)
    hours_begun = max(1, math.ceil((run["duration_s"] or 0.0) / 3600.0))
    applies = {
        Reason.ACCEPTED_WRONG: run["unsafe_accepted"] > 0,
        Reason.FAILURE_BEYOND_BUDGET: beyond > 0,
        # Eq. 7 is of nature's failures: how many were injected is nobody's rate.
        Reason.HAZARDOUS_SUM: (run["hazardous_natural_s"] or 0.0) > allowed_s * hours_begun,
        Reason.ACCEPTED_UNKNOWN: run["unproven_accepted"] > 0,
        Reason.BUDGET_UNKNOWN: within + beyond < len(failures),
        Reason.UNKNOWN_IN_USE: (run["unknown_in_use_s"] or 0.0) > allowed_s,
        Reason.NOT_DIAGNOSED: (run["share_undiagnosed"] or 0.0) > hazards.undiagnosed_share,
        Reason.NOTHING_ACCEPTED: run["balises_accepted"] == 0,
        **{reason: reason in (run["reasons"] or ()) for reason in _LASTING},
    }
    # What is assumed of the track matters where something is unknown by it; an epoch or two at the end do not.
    unknown = (Reason.ACCEPTED_UNKNOWN, Reason.BUDGET_UNKNOWN, Reason.UNKNOWN_IN_USE, Reason.NOTHING_ACCEPTED)
    applies[Reason.TRACK_ASSUMED] &= any(applies[reason] for reason in unknown)
    return [reason for reason in Reason if applies[reason]]


def verdict_of(reasons: Iterable[Reason]) -> RunVerdict:
    """The worst that applies; an assumed clock alone changes nothing.

    Args:
        reasons: why a run is not safe.

    Returns:
        The verdict of the run.

    Source:
        DOMAIN section 5.4.
    """
    against = set(reasons) - {Reason.CLOCK_ASSUMED}
    if against & _UNSAFE:
        return RunVerdict.UNSAFE
    return RunVerdict.UNPROVEN if against else RunVerdict.SAFE


def level_rows(run: RunRow, config: Configuration) -> list[dict[str, object]]:
    """One `runs` row against the allowed T_D of each service level, by the rules of the run's verdict.

    Args:
        run: the row by its columns.
        config: the configuration; used are `safety` and `hazards`.

    Returns:
        By service level its allowed time [s], failures within and beyond it, and the verdict.

    Source:
        TVB eq. 7.
    """
    failures = failures_of_run(run)
    in_time = ThrVerdict.KEPT if failures else ThrVerdict.NO_FAILURE
    rows: list[dict[str, object]] = []
    for level in config.safety.service_levels:
        allowed_s = config.safety.allowed_time_to_detect_s(level)
        within, exceeded = count_kept_and_exceeded(failures, allowed_s)
        verdict = verdict_of(reasons_of(run, allowed_s, config.hazards))
        values = (level, allowed_s, within, exceeded, _OF_LEVEL.get(verdict, in_time).value)
        rows.append(dict(zip(LEVEL_LISTS, values, strict=True)))
    return rows


def failures_of_run(run: RunRow) -> list[Failure]:
    """The failures of one `runs` row, in order of time."""
    lists = ("failure_hazardous_s", "failure_hazardous_may_s", "failure_accepted")
    return list(zip(*(run[name] or [] for name in lists), strict=True))


def count_kept_and_exceeded(failures: Sequence[Failure], allowed_s: float) -> tuple[int, int]:
    """How many failures kept the allowed time [s] whatever is unknown, and how many certainly exceeded it."""
    kept = [keeps_budget(spent_s, may_s, Judgement(accepted), allowed_s) for spent_s, may_s, accepted in failures]
    return kept.count(True), kept.count(False)


Row = dict[str, Any]


def availability_figures(epochs: JudgedEpochs, clock: Clock, config: Configuration) -> Row:
    """Columns of availability, outages and continuity (CONTRACT section 3; LOC eq. 8).

    Time of which nobody knows whether the train moved counts as moving, and a TVB in it does not (DOMAIN section 5.5).
    """
    lost_s = outages_s(clock.t_ns, epochs.usable, clock.limit_s)
    share = availability(clock.t_ns, epochs.valid, epochs.may_move, clock.limit_s)
    trust = uptime(clock.t_ns, epochs.trusted(config.lds), clock.limit_s)
    mtbf_h = trust.up_s / trust.losses / 3600.0 if trust.losses and trust.up_s > 0 else None
    return {
        "availability": share if epochs.moves[:-1].any() else None,
        "outages": lost_s.size,
        "longest_outage_s": float(lost_s.max(initial=0.0)) if epochs.height else None,
        "cross_bias_m": _median_m(epochs.cross_track_m[epochs.on_track]),
        "mtbf_h": mtbf_h,
        "continuity_15s": continuity_over(CONTINUITY_S, mtbf_h) if mtbf_h else None,
        "trusted_s": trust.up_s if epochs.height else None,
        "trusted_losses": trust.losses,
    }


def _median_m(values_m: Floats) -> float | None:
    """Median of the values that are known [m]; None without any."""
    known_m = values_m[np.isfinite(values_m)]
    return median(known_m) if known_m.size else None


def is_judged() -> pl.Expr:
    """Expression on epochs or passages: the evidence calls the position right or wrong (DOMAIN section 5.2)."""
    return pl.col("judgement").is_in([Judgement.RIGHT, Judgement.WRONG])


def time_in_use(epochs: JudgedEpochs, recovery_s: float) -> Row:
    """Columns of time in use, and what of it nobody can judge or nothing diagnoses (DOMAIN section 5.4).

    Shares are of the moving time in use, null without any. All null without epochs.
    """
    used_s = epochs.used_s
    moves = epochs.may_move
    judged_rows = epochs.judgements.is_judged
    negated_s = epochs.counted_s[epochs.negated]
    figures = {
        "in_use_s": float(used_s.sum()),
        "in_use_judged_s": float(used_s[judged_rows].sum()),
        "negated_s": float(negated_s.sum()),
        "share_unknown": share_of_time(used_s[moves], ~judged_rows[moves]),
        "share_undiagnosed": share_of_time(used_s[moves], epochs.undiagnosed[moves]),
        "unknown_in_use_s": _longest_stretch_s(epochs.t_ns, used_s, ~judged_rows & moves & (used_s > 0.0), recovery_s),
    }
    return figures if epochs.height else dict.fromkeys(figures)


def _longest_stretch_s(t_ns: Ints, used_s: Floats, where: Bools, apart_s: float) -> float:
    """Longest time [s] that epochs `where` a condition holds stand for, less than `apart_s` from each other."""
    rows = np.flatnonzero(where)
    breaks = np.flatnonzero(np.diff(t_ns[rows]) >= apart_s * NS_PER_S) + 1
    return max(float(used_s[part].sum()) for part in np.split(rows, breaks))


def proof_margin_m(epochs: JudgedEpochs, passages: pl.DataFrame) -> float | None:
    """Least proof margin of the epochs in use and the acceptances that are right [m] (DOMAIN section 5.2)."""
    right = epochs.judgements.at(epochs.judgements.is_right & epochs.in_use)
    margins_m = right.limit_m - np.fmax(-right.low_m, right.high_m)
    of_epochs = margins_m[np.isfinite(margins_m)].min(initial=np.inf)
    of_passages = passages.filter(is_accepted())["proof_margin_m"].min()
    margins = [float(of_epochs)] if np.isfinite(of_epochs) else []
    margins += [of_passages] if isinstance(of_passages, float) else []
    return min(margins, default=None)


def error_spread(error: pl.Expr, name: str, counted: str) -> dict[str, pl.Expr]:
    """Expressions for mean, 95 % and largest of the known errors [m], and how many these are.

    The latter two of their magnitude; the names begin with `name`, the count ends with `counted`.
    """
    size = error.abs()
    return {
        f"{name}_mean_m": error.mean(),
        f"{name}_p95_m": size.quantile(0.95, interpolation="linear"),
        f"{name}_max_m": size.max(),
        f"{name}_{counted}": size.count().cast(pl.Int64),
    }


def accuracy_figures(epochs: JudgedEpochs) -> Row:
    """Columns of the known errors along, across and above the track."""
    errors: dict[str, pl.Expr] = {}
    for axis in ("along", "cross", "up"):
        errors |= error_spread(pl.col(axis), f"{axis}_error", "epochs")
    known_m = {"along": epochs.error_along_m, "cross": epochs.error_cross_m, "up": epochs.error_up_m}
    return pl.DataFrame(known_m, nan_to_null=True).select(**errors).row(0, named=True)


def is_accepted() -> pl.Expr:
    """Expression on passages: the LDS accepted the balise."""
    return pl.col("status") == PassageStatus.ACCEPTED


def outcome_conditions() -> dict[str, pl.Expr]:
    """Expressions on passages, by outcome of the offer."""
    status = pl.col("status")
    return {
        "accepted": is_accepted(),
        "rejected": status.cast(pl.String).str.starts_with("rejected_"),
        "missed": status == PassageStatus.MISSED,
        "not_available": status == PassageStatus.NOT_AVAILABLE,
    }


def acceptance_conditions() -> dict[str, pl.Expr]:
    """Expressions on passages: acceptances, by what the judge says of them; none re-judges."""
    known = is_judged().fill_null(value=False)
    return {
        "accepted_judged": is_accepted() & known,
        "unsafe_accepted": is_accepted() & _is_wrong(),
        "unproven_accepted": is_accepted() & ~known,
        "initialising_accepted": pl.col("initialising"),
    }


def _is_wrong() -> pl.Expr:
    """Expression on passages: judged wrong."""
    return (pl.col("judgement") == Judgement.WRONG).fill_null(value=False)


def balise_counts(passages: pl.DataFrame) -> Row:
    """What became of the virtual balises, and of those accepted what the judge says of their positions."""
    virtual = passages.filter(pl.col("kind") == enums.BaliseKind.VIRTUAL)
    return virtual.select(**_balise_aggregates()).row(0, named=True)


@cache
def _balise_aggregates() -> dict[str, pl.Expr]:
    """Columns of `runs` over the passages of virtual balises."""
    counts = {"balises_on_path": is_passage()}
    counts |= {f"balises_{name}": becomes for name, becomes in outcome_conditions().items()} | acceptance_conditions()
    each_once = {"balises_passed": is_passage(), "balises_found": is_passage() & is_accepted()}
    return {
        **{name: condition.sum() for name, condition in counts.items()},
        **error_spread(pl.col("location_error_m").filter(is_accepted()), "location_error", "count"),
        **{name: pl.col("balise_id").filter(condition).n_unique() for name, condition in each_once.items()},
    }


def _count_rows(frame: pl.DataFrame, conditions: Mapping[str, pl.Expr]) -> Row:
    """In how many rows each condition holds."""
    return frame.select(condition.sum().alias(name) for name, condition in conditions.items()).row(0, named=True)


def is_passage() -> pl.Expr:
    """Expression on passages: a row that is no offer beyond the passages of the train.

    An offer beyond is one that is judged wrong and for which the evidence knows no true crossing.
    """
    return ~(pl.col("t_true").is_null() & _is_wrong())


def hazard_counts(hazards: pl.DataFrame) -> Row:
    """Columns that count the hazards by class, the faults behind them, and the largest detection times."""
    counts = {kind.counted_as: pl.col("hazard") == kind for kind in enums.Hazard} | {
        "hazards_detected": pl.col("detected"),
        "hazards_within_budget": pl.col("within_budget"),
    }
    times = ("time_to_detect", "time_since_failure", "time_since_failure_may")
    # A fault counts once, whatever its rows.
    faults = independent_episodes(hazards)["missed"] if hazards.height else pl.Series(dtype=pl.Boolean)
    of_faults = {"faults": faults.len(), "missed_detections": faults.sum()}
    return _count_rows(hazards, counts) | of_faults | {f"{name}_max_s": hazards[f"{name}_s"].max() for name in times}


def failure_figures(failures: Sequence[PositionFailure]) -> Row:
    """Columns of the position failures; every failure counts, whether it hit a VB or not (DOMAIN section 5.3)."""
    within = [failure.within_budget for failure in failures]
    hazardous_s = [failure.hazardous_s for failure in failures]
    return {
        "failures": len(failures),
        "failures_within_budget": within.count(True),
        "failures_beyond_budget": within.count(False),
        "hazardous_max_s": max(hazardous_s, default=None),
        "hazardous_s": _sum_s(hazardous_s),
        "hazardous_natural_s": _sum_s([failure.natural_s for failure in failures]),
        "failure_hazardous_s": hazardous_s,
        "failure_hazardous_may_s": [failure.hazardous_may_s for failure in failures],
        "failure_accepted": [failure.accepted.value for failure in failures],
    }


def _sum_s(times_s: Sequence[float]) -> float:
    """Sum of times [s]."""
    return float(pl.Series(times_s, dtype=pl.Float64).sum())


def service_level_columns(row: Row, config: Configuration) -> Row:
    """Columns of the row against the allowed T_D of each service level (TVB eq. 7)."""
    rows = level_rows(row, config)
    return {name: [level[part] for level in rows] for part, name in LEVEL_LISTS.items()}


def alarm_figures(alarms: pl.DataFrame, epochs: JudgedEpochs, evidence: enums.Evidence | None) -> Row:
    """Columns of alarms and of the rate of false ones, which needs truth and a verdict on every alarm.

    The rate counts the time in use in which the along-track bank judged and the position was judged (DOMAIN 6).
    """
    false = int((alarms["verdict"] == enums.Verdict.FALSE).sum())
    monitored: Bools = np.logical_or.reduce([epochs.verdicts[f"along_{scale}"].evaluated for scale in SCALES])
    judged_rows = epochs.judgements.is_judged
    counted_s = epochs.counted_s
    judged_s = counted_s[monitored & judged_rows & epochs.in_use]
    times = {
        "held_s": counted_s,
        "monitored_s": counted_s[monitored],
        "evidence_s": counted_s[judged_rows],
        "judged_s": judged_s,
    }
    truth = evidence in TRUTH and bool(judged_rows.any())
    complete = truth and not (alarms["verdict"] == enums.Verdict.UNKNOWN).any()
    rate = poisson_rate(false, float(judged_s.sum()) / 3600.0) if complete else UNKNOWN
    return {
        **{name: float(held.sum()) if epochs.height else None for name, held in times.items()},
        "alarms": alarms.height,
        "false_alarms": false if truth else None,
        **columns_of("false_alarm_rate", rate, "_per_h"),
    }


def exposure_figures(epochs: JudgedEpochs) -> Row:
    """Columns of the exposure time [s]: largest, and 99 %."""
    exposure_s = pl.Series(epochs.exposure_s, nan_to_null=True)
    return {
        "exposure_max_s": exposure_s.max(),
        "exposure_p99_s": exposure_s.quantile(0.99, interpolation="linear"),
    }


def state_shares(epochs: JudgedEpochs) -> Row:
    """Share of the time, without gaps, in which each state of the LDS is known to hold (TVB section 4).

    The time in P1 is the hazardous time of all failures. While the state is unknown no share grows, so the four may add
    up to less than one. If some state is unknown and no epoch is known to be P0, the share of P0 is null, not 0; so is
    that of P1 unless some epoch is in it.
    """
    inside = {state: epochs.lds_state == number for number, state in enumerate(enums.LdsState)}
    row: Row = {f"share_{state.value.lower()}": share_of_time(epochs.counted_s, held) for state, held in inside.items()}
    if (epochs.lds_state < 0).any() and not inside[enums.LdsState.P0].any():
        row["share_p0"] = None
        if not inside[enums.LdsState.P1].any():
            row["share_p1"] = None
    return row


def stanford_counts(epochs: JudgedEpochs, bound_m: Floats, limit_m: float) -> Row:
    """Columns that count epochs by error and bound along the track (CONTRACT section 3, `stanford_*`).

    Of those whose error is known to 5 m; `limit_m`: the largest bound that is offered.
    """
    known = np.isfinite(epochs.error_along_m) & np.isfinite(bound_m)
    error_m = np.abs(epochs.error_along_m[known])
    bound_m = bound_m[known]
    offered = bound_m <= limit_m
    counts = {
        "nominal": offered & (error_m <= bound_m),
        "misleading": offered & (error_m > bound_m) & (error_m <= limit_m),
        "hazardous": offered & (error_m > limit_m),
        "unavailable": ~offered,
    }
    return {f"stanford_{name}": int(condition.sum()) for name, condition in counts.items()}


def stanford_counts_of_receiver(epochs: JudgedEpochs, limit_m: float) -> Row:
    """The same counts with the receiver's protection level as bound; not known where it gives none."""
    counts = stanford_counts(epochs, epochs.hpl_m, limit_m) if np.isfinite(epochs.hpl_m).any() else {}
    return {f"stanford_hpl_{name.removeprefix('stanford_')}": value for name, value in counts.items()}
