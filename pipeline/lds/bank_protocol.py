"""What the location determination system asks of a monitor bank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from schemas.config import Configuration, Vehicle


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

    def along_evaluated_between(self, epoch: int, end: int) -> NDArray[np.bool_]:
        """`along_evaluated` of the epochs [epoch, end), none of them beyond what `quiet_until` answered."""
        ...

    def restart(self, epoch: int) -> None:
        """The recursion starts anew; its first increment is that from this epoch to the next."""
        ...


@dataclass(frozen=True)
class LdsLimits:
    """Limits that the LDS shares with other stages.

    `threshold_factor` is k_T, two-sided Gaussian for the false alarm probability per sample; `odometer_sigma_mps` the
    odometer's noise over one second [m]; `odometer_scale_sigma` that of the vehicle file, None unless it gives scale
    and sigma; `gap_reset_s`: over a longer gap the bank begins anew; `disabled` names monitors.
    """

    ambiguity_probability: float
    failure_limit_m: float
    threshold_factor: float
    odometer_sigma_mps: float
    odometer_scale_sigma: float | None
    balise_read_sigma_m: float
    gap_reset_s: float
    disabled: tuple[str, ...]

    @classmethod
    def of(cls, configuration: Configuration, vehicle: Vehicle) -> Self:
        monitors, hazards = configuration.monitors, configuration.hazards
        return cls(
            ambiguity_probability=configuration.matching.ambiguity_probability,
            failure_limit_m=hazards.failure_limit_m,
            threshold_factor=float(-ndtri(monitors.false_alarm_probability / 2)),
            odometer_sigma_mps=monitors.odometer_sigma_mps,
            odometer_scale_sigma=None if vehicle.odometer_scale is None else vehicle.odometer_scale_sigma,
            balise_read_sigma_m=hazards.balise_read_sigma_m,
            gap_reset_s=configuration.align.gap_reset_s,
            disabled=monitors.disabled,
        )
