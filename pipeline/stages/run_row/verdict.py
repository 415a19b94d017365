"""The verdict of a run (DOMAIN section 5.4), by service level too (TVB eq. 7)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipeline.stages.judge.failures import within_budget
from schemas.config import Configuration
from schemas.enums import Judgement, Reason, RunVerdict, ThrVerdict

Row = Mapping[str, Any]
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


def reasons_of(run: Row, allowed_s: float, undiagnosed_share: float) -> list[Reason]:
    """Why a run has its verdict, by the columns `DECISIVE` of its row (DOMAIN section 5.4).

    `allowed_s`: allowed T_D; `undiagnosed_share`: of the configuration.
    """
    failures = failures_in(run)
    within, beyond = level_counts(failures, allowed_s)
    hours_begun = max(1, math.ceil((run["duration_s"] or 0.0) / 3600.0))
    applies = {
        Reason.ACCEPTED_WRONG: run["unsafe_accepted"] > 0,
        Reason.FAILURE_BEYOND_BUDGET: beyond > 0,
        # Eq. 7 is of nature's failures: how many were injected is nobody's rate.
        Reason.HAZARDOUS_SUM: (run["hazardous_natural_s"] or 0.0) > allowed_s * hours_begun,
        Reason.ACCEPTED_UNKNOWN: run["unproven_accepted"] > 0,
        Reason.BUDGET_UNKNOWN: within + beyond < len(failures),
        Reason.UNKNOWN_IN_USE: (run["unknown_in_use_s"] or 0.0) > allowed_s,
        Reason.NOT_DIAGNOSED: (run["share_undiagnosed"] or 0.0) > undiagnosed_share,
        Reason.NOTHING_ACCEPTED: run["balises_accepted"] == 0,
        **{reason: reason in (run["reasons"] or ()) for reason in _LASTING},
    }
    # What is assumed of the track matters where something is unknown by it; an epoch or two at the end do not.
    unknown = (Reason.ACCEPTED_UNKNOWN, Reason.BUDGET_UNKNOWN, Reason.UNKNOWN_IN_USE, Reason.NOTHING_ACCEPTED)
    applies[Reason.TRACK_ASSUMED] &= any(applies[reason] for reason in unknown)
    return [reason for reason in Reason if applies[reason]]


def verdict_of(reasons: Iterable[Reason]) -> RunVerdict:
    """The worst that applies; an assumed clock alone changes nothing (DOMAIN section 5.4)."""
    against = set(reasons) - {Reason.CLOCK_ASSUMED}
    if against & _UNSAFE:
        return RunVerdict.UNSAFE
    return RunVerdict.UNPROVEN if against else RunVerdict.SAFE


def level_rows(run: Row, config: Configuration) -> list[dict[str, object]]:
    """One `runs` row against the allowed T_D of each service level, by the rules of the run's verdict."""
    failures = failures_in(run)
    in_time = ThrVerdict.KEPT if failures else ThrVerdict.NO_FAILURE
    rows: list[dict[str, object]] = []
    for level in config.safety.service_levels:
        allowed_s = config.safety.allowed_time_to_detect_s(level)
        within, exceeded = level_counts(failures, allowed_s)
        verdict = verdict_of(reasons_of(run, allowed_s, config.hazards.undiagnosed_share))
        values = (level, allowed_s, within, exceeded, _OF_LEVEL.get(verdict, in_time).value)
        rows.append(dict(zip(LEVEL_LISTS, values, strict=True)))
    return rows


def failures_in(run: Row) -> list[Failure]:
    """The failures of one `runs` row, in order of time."""
    lists = ("failure_hazardous_s", "failure_hazardous_may_s", "failure_accepted")
    return list(zip(*(run[name] or [] for name in lists), strict=True))


def level_counts(failures: Sequence[Failure], allowed_s: float) -> tuple[int, int]:
    """How many failures kept the allowed time whatever is unknown, and how many did not for certain."""
    kept = [within_budget(spent_s, may_s, Judgement(accepted), allowed_s) for spent_s, may_s, accepted in failures]
    return kept.count(True), kept.count(False)
