"""Failures against the allowed T_D of a service level (TVB eq. 7; DOMAIN sections 5.3 and 6)."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.enums import TRUTH, Evidence, ThrVerdict


def level_counts(hazardous_s: Sequence[float], hazardous_may_s: Sequence[float], allowed_s: float) -> tuple[int, int]:
    """How many failures are within the allowed time whatever is unknown, and how many beyond it for certain."""
    within = sum(may_s <= allowed_s for may_s in hazardous_may_s)
    return within, sum(spent_s > allowed_s for spent_s in hazardous_s)


def level_verdict(failures: int, within: int, exceeded: int, *, proven: bool) -> ThrVerdict:
    """`proven`: next to nothing of the run is unknown (`is_proven`), so that no failure can be hidden."""
    if exceeded:
        return ThrVerdict.EXCEEDED
    if within < failures or not proven:
        return ThrVerdict.UNKNOWN
    return ThrVerdict.KEPT if failures else ThrVerdict.NO_FAILURE


def is_proven(evidence: Evidence | str | None, share_unknown: float | None, unknown_share_limit: float) -> bool:
    """A reference or balise reads judge the position in use but for the share that a verdict may leave unknown."""
    return evidence in TRUTH and share_unknown is not None and share_unknown <= unknown_share_limit
