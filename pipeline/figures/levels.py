"""Failures against the allowed T_D of a service level (TVB eq. 7; DOMAIN sections 5.3 and 6)."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.config import Configuration
from schemas.enums import TRUTH, Evidence, ThrVerdict

LEVEL_LISTS = {
    "service_level": "service_levels",
    "allowed_s": "level_allowed_s",
    "within": "level_within",
    "exceeded": "level_exceeded",
    "verdict": "level_verdict",
}
"""What `level_rows` tells of each service level, and the list of the `runs` table that holds it."""


def level_rows(
    hazardous_s: Sequence[float],
    hazardous_may_s: Sequence[float],
    evidence: Evidence | str | None,
    share_unknown: float | None,
    config: Configuration,
) -> list[dict[str, object]]:
    """The failures of one run against the allowed T_D of each service level, with the verdict on it."""
    proven = _is_proven(evidence, share_unknown, config.hazards.unknown_share_limit)
    rows: list[dict[str, object]] = []
    for level in config.safety.service_levels:
        allowed_s = config.safety.allowed_time_to_detect_s(level)
        within, exceeded = level_counts(hazardous_s, hazardous_may_s, allowed_s)
        verdict = _verdict(len(hazardous_s), within, exceeded, proven=proven).value
        rows.append(dict(zip(LEVEL_LISTS, (level, allowed_s, within, exceeded, verdict), strict=True)))
    return rows


def level_counts(hazardous_s: Sequence[float], hazardous_may_s: Sequence[float], allowed_s: float) -> tuple[int, int]:
    """How many failures are within the allowed time whatever is unknown, and how many beyond it for certain."""
    within = sum(may_s <= allowed_s for may_s in hazardous_may_s)
    return within, sum(spent_s > allowed_s for spent_s in hazardous_s)


def _verdict(failures: int, within: int, exceeded: int, *, proven: bool) -> ThrVerdict:
    """`proven`: next to nothing of the run is unknown (`_is_proven`), so that no failure can be hidden."""
    if exceeded:
        return ThrVerdict.EXCEEDED
    if within < failures or not proven:
        return ThrVerdict.UNKNOWN
    return ThrVerdict.KEPT if failures else ThrVerdict.NO_FAILURE


def _is_proven(evidence: Evidence | str | None, share_unknown: float | None, unknown_share_limit: float) -> bool:
    """A reference or balise reads judge the position in use but for the share that a verdict may leave unknown."""
    return evidence in TRUTH and share_unknown is not None and share_unknown <= unknown_share_limit
