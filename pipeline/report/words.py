"""The words of the pages: titles of columns, and what the values of the tables are called for people."""

from __future__ import annotations

from collections.abc import Sequence

TITLES = {
    "run_id": "run",
    "status": "reading",
    "netelement_id": "net element",
    "balise_id": "balise",
    "balise_ids": "balises hit",
    "hazard_id": "hazard",
    "t_start": "from",
    "t_end": "to",
    "t_onset": "fault begins",
    "t_failure": "position wrong from",
    "t_detected": "found at",
    "t_offered": "offered at",
    "t_true": "passed at",
    "monitor": "found by",
    "time_to_detect_s": "time to detect T_D [s]",
    "time_to_detect_max_s": "longest T_D [s]",
    "time_since_failure_s": "found after the failure [s]",
    "hazardous_s": "wrong in use [s]",
    "hazardous_may_s": "wrong or unknown in use [s]",
    "hazardous_max_s": "longest wrong in use [s]",
    "budget_s": "allowed [s]",
    "within_budget": "in time",
    "accepted_ids": "accepted despite the fault",
    "caused_by": "follows hazard",
    "size_m": "largest error [m]",
    "rate_mps": "drift [m/s]",
    "suspect": "suspected (an opinion)",
    "suspect_after_the_fact": "while a fault was not yet found",
    "evidence": "judged by",
    "unsafe_accepted": "accepted at a wrong place",
    "unsafe_rate": "share of wrong acceptances",
    "unproven_accepted": "accepted, could not be checked",
    "accepted_judged": "accepted and checked",
    "failures_beyond_budget": "wrong in use too long",
    "missed_detections": "faults not found in time",
    "share_unknown": "share of time not checked",
    "balises_accepted": "balises accepted",
    "balises_on_path": "balises passed",
    "within": "in time",
    "exceeded": "too late",
    "within_share": "share in time",
    "failures": "wrong positions in use",
    "failures_judged": "of these checked",
    "missed": "not found",
    "not_available": "no position",
    "location_error_m": "location error [m], early is positive",
    "location_error_mean_m": "mean location error [m]",
    "location_error_max_m": "largest location error [m]",
    "location_accuracy_m": "location accuracy Q [m]",
    "confidence_m": "confidence [m]",
    "exposure_max_s": "longest exposure [s]",
    "missed_share": "share not found",
    "common_missed": "not found by both",
    "time_to_detect_median_s": "median T_D [s]",
    "wrong_in_use_s": "wrong in use [s]",
    "run_ids": "these runs",
    "input_digest": "digest of log and site",
    "peak_ratio": "largest value / threshold",
}

WORDS = {
    "accepted": "accepted",
    "rejected_window": "outside the window",
    "rejected_unlinked": "not announced",
    "rejected_monitor": "position blocked",
    "rejected_confidence": "confidence too wide",
    "rejected_ambiguous": "track not certain",
    "missed": "not found",
    "not_available": "no position",
    "no_position": "no position",
    "kept": "in time",
    "exceeded": "too late",
    "no_failure": "no wrong position",
    "unknown": "could not be checked",
    "service_brake": "service brake",
    "ok": "whole log read",
    "partial": "damaged, read in part",
    "failed": "failed",
}
"""Values of enums that say something else to a stranger than they mean."""

OPINIONS = {"unknown": "nobody can say"}
"""Of `suspect`: not known is no matter of evidence there."""


def plural(count: int, one: str) -> str:
    """`1 balise`, `3 balises`."""
    return f"{count} {one if count == 1 else one + 's'}"


def some_of(names: Sequence[str], most: int = 8) -> str:
    """The first of many names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
