"""What the re-link of a negated position is measured from (DOMAIN section 4)."""

from __future__ import annotations

from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.drift import Drift
from pipeline.lds.journey import Journey
from pipeline.lds.reads import Read
from pipeline.lds.recovery import Anchor, Recovery, read_anchor, relink_bound_m
from schemas.arrays import Ints


class Footing:
    """Positions that the diagnosis stood behind, and what the last return was measured from.

    TVBs between two alarms prove nothing against a drift that the restarted bank takes a minute to see again: each
    return would find the position where the last TVB had it, a few metres farther off, and step by step nothing
    would bound the error. So an alarm that follows upon a return may be about the same fault, and its re-link has to
    hold against the footing of that return as well, for as long as the odometer can tell.
    """

    def __init__(self, journey: Journey, limits: LdsLimits) -> None:
        self._journey, self._limits = journey, limits
        self._last_tvb: int | None = None
        self._accepted: Anchor | None = None  # where the last VB was accepted
        self._disputed: Anchor | None = None
        self._read: Anchor | None = None  # the last physical balise
        self._drift: Drift | None = None  # by the alarm that stands

    def validate(self, k: int) -> None:
        """The epoch is a TVB."""
        self._last_tvb = k

    def accept(self, anchor: Anchor) -> None:
        """A VB was accepted here."""
        self._accepted = anchor

    def read(self, read: Read) -> None:
        """A physical balise read while the position is in use: better to measure from than an earlier position."""
        self._read = read_anchor(read, self._journey) or self._read
        if self._disputed is not None:
            self._disputed = self._read or self._disputed

    def negate(self, k: int, slow_after: Ints | None) -> None:
        """An alarm; `slow_after`: where only a slow average fails, the TVBs before it, which may carry its fault.

        What the odometer can no longer tell since the last return does not count.
        """
        self._drift = None if slow_after is None else Drift.before(slow_after, self._journey, self._limits)
        if self._disputed is not None and relink_bound_m(self._disputed, k, self._journey, self._limits) is None:
            self._disputed = None

    def forget(self) -> None:
        """A new initialisation."""
        self._disputed = None

    def last_validated(self) -> Anchor | None:
        """Where the last TVB was, or the last accepted VB if that came later."""
        accepted = self._accepted
        if self._last_tvb is None:
            return accepted
        if accepted is not None and accepted.t_ns > int(self._journey.t_ns[self._last_tvb]):
            return accepted
        return Anchor.at_epoch(self._journey, self._last_tvb)

    def before_break(self) -> Anchor | None:
        """What was validated last, or a physical balise that was read since."""
        validated = self.last_validated()
        if self._read is None or (validated is not None and validated.t_ns > self._read.t_ns):
            return validated
        return self._read

    def relinks(self, recovery: Recovery, k: int, anchor: Anchor) -> bool:
        """GNSS minus odometer is what it was at the anchor; where no balise was read, also at the last return's."""
        settled = recovery.read is not None or (self._is_undisputed(k, recovery) and self._leaves_room(k))
        if not (settled and recovery.relinks(k, anchor)):
            return False
        self._disputed = recovery.read or self._disputed or anchor
        return True

    def _is_undisputed(self, k: int, recovery: Recovery) -> bool:
        return self._disputed is None or recovery.relinks(k, self._disputed)

    def _leaves_room(self, k: int) -> bool:
        offset_m = float(self._journey.path_m[k] - self._journey.odometer_m[k])
        return self._drift is None or self._drift.leaves_room(offset_m, self._limits)
