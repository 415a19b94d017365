"""Every limit that follows from `[hazards]`: one name for each use of it, with its equation (DOMAIN section 5)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from schemas.arrays import Floats


class _Hazards(Protocol):
    """The limits of `[hazards]` [m]."""

    @property
    def failure_limit_m(self) -> float: ...
    @property
    def shift_limit_m(self) -> float: ...
    @property
    def jump_limit_m(self) -> float: ...


class Limits(NamedTuple):
    """Limits of one replay [m]; with F = `failure_limit_m`.

    Whoever compares a distance with the failure limit takes the name of the question that is asked, never F itself.
    """

    failure_m: float
    """F. An error beyond it is wrong, within it right; the proof margin is what is left up to it."""
    shift_m: float
    """A virtual balise offered so far from its place is a VB Shift."""
    jump_m: float
    """A change of the error by so much within `jump_window_s` is a VB Jump."""
    settled_m: float
    """F / 2. An episode ends where the error stays within it; noise never explains more."""
    healthy_m: float
    """F. The margin of a healthy position, 3 sigma, is never wider."""
    relink_m: float
    """F / 2. No bound within which a position returns is wider, and no more may be in doubt then."""
    stand_m: float
    """F. An odometer that stands while the positions move further is contradicted by them."""
    agreement_m: float
    """F. An accepted balise further from what the odometer carried from the one before confirms nothing."""
    doubt_m: float
    """F. A distance by the odometer of which more is in doubt is not known."""
    confirming_m: float
    """F / 2. A read with less certainty of its place and time confirms nothing."""
    moved_m: float
    """F. So far a position may have moved over an outage or a break: the odometer's scale is learned anew behind it."""
    abreast_m: float
    """F. Errors across the track and in height are stated where the reference is no further along it."""
    span_m: float
    """2 F. A part of the line whose place is known less closely is unknown: the whole room of a right position."""
    clock_open_m: float
    """F. Of the room of a right position, 2 F, the clocks alone take half: `clock` is a remedy."""

    def settled_at_m(self, failure_m: Floats) -> Floats:
        """`settled_m` at instants whose failure limit is `failure_m`, in proportion to it [m]."""
        return failure_m * (self.settled_m / self.failure_m)

    def healthy_at_m(self, failure_m: Floats) -> Floats:
        """`healthy_m` at instants whose failure limit is `failure_m`, in proportion to it [m]."""
        return failure_m * (self.healthy_m / self.failure_m)


def limits_of(hazards: _Hazards) -> Limits:
    """The limits of a configuration.

    Args:
        hazards: the section `hazards` of a configuration.

    Returns:
        Each use of `failure_limit_m` under its own name [m].

    Source:
        DOMAIN section 5.
    """
    failure_m = hazards.failure_limit_m
    half_m = 0.5 * failure_m
    return Limits(
        failure_m=failure_m,
        shift_m=hazards.shift_limit_m,
        jump_m=hazards.jump_limit_m,
        settled_m=half_m,
        healthy_m=failure_m,
        relink_m=half_m,
        stand_m=failure_m,
        agreement_m=failure_m,
        doubt_m=failure_m,
        confirming_m=half_m,
        moved_m=failure_m,
        abreast_m=failure_m,
        span_m=2.0 * failure_m,
        clock_open_m=failure_m,
    )


def noise_limit_m(failure_m: float, factor: float) -> float:
    """The largest fast noise with which a position failure still shows: F / (2 k_T).

    Args:
        failure_m: failure limit F [m].
        factor: threshold factor k_T [1].

    Returns:
        Largest noise [m].

    Source:
        DOMAIN section 3.
    """
    return failure_m / (2.0 * factor)


def scatter_limit_m(failure_m: float, factor: float) -> float:
    """The largest deviation of an odometer's row, or of digits, that thresholds allow for: F / (k_T sqrt 2).

    With more, k_T sqrt(2) sigma of two rows would exceed the failure limit: false alarms rather than a failure hidden.

    Args:
        failure_m: failure limit F [m].
        factor: threshold factor k_T [1].

    Returns:
        Largest deviation [m].
    """
    return failure_m / (factor * math.sqrt(2.0))
