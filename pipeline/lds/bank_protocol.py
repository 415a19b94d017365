"""What the location determination system asks of a monitor bank."""

from __future__ import annotations

from typing import Protocol

from schemas.arrays import Bools


class Bank(Protocol):
    """Monitors of one solution, from the last restart on.

    Epochs are row indices of the solution's epochs. The answers for an epoch may change with
    `restart` at that epoch or before it, never through later ones.
    """

    def failed(self, epoch: int) -> bool:
        """Any monitor of the bank fails at this epoch."""
        ...

    def fast_failed(self, epoch: int) -> bool:
        """A monitor fails that does not ring: raw, fastest EWMA, or without memory. Only these hold back recovery.

        A monitor without memory (Doppler, ranges, channels) belongs here: it does not outlive its fault, and a
        return while it fails would restart the bank every `recovery_s` and so blind its slow averages.
        """
        ...

    def along_evaluated(self, epoch: int) -> bool:
        """The along-track monitors have a verdict (pass or fail) at this epoch."""
        ...

    def quiet_until(self, epoch: int, end: int) -> int:
        """The first epoch from `epoch` on at which a monitor fails, or that is not looked at yet; at most `end`."""
        ...

    def along_evaluated_between(self, epoch: int, end: int) -> Bools:
        """`along_evaluated` of the epochs [epoch, end), none of them beyond what `quiet_until` answered."""
        ...

    def restart(self, epoch: int) -> None:
        """The recursion starts anew; its first increment is that from this epoch to the next."""
        ...
