"""How far the position had drifted from the odometer by the time a slow alarm was raised.

The re-link counts from the last TVB before the alarm's onset (DOMAIN section 4). Where only a slow average fails, the
train does not know that onset: the fault began minutes before, and the TVBs of these minutes carry it. So each TVB that
the odometer still reaches may be the one. And the fault may still go on: the bank, restarted by a return, will not see
it before the position has drifted as far again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.journey import Journey
from schemas.arrays import Ints


@dataclass(frozen=True, slots=True)
class Drift:
    """Least and largest GNSS minus odometer [m] of the TVBs that the odometer reached from the last of them."""

    least_m: float
    largest_m: float

    @classmethod
    def before(cls, validated: Ints, journey: Journey, limits: LdsLimits) -> Self | None:
        """`validated`: epochs of the TVBs before the alarm, in order; `None` where there are none.

        Reached are those from which the bound of a re-link is within the failure limit (DOMAIN section 4).
        """
        if not validated.size:
            return None
        reached = validated[_bounds_m(validated, journey, limits) <= limits.failure_limit_m]
        offset_m = (journey.path_m - journey.odometer_m)[reached]
        return cls(float(offset_m.min()), float(offset_m.max())) if reached.size else None

    def leaves_room(self, offset_m: float, limits: LdsLimits) -> bool:
        """After a return here the position may drift as far again and still be inside the failure limit."""
        drifted_m = max(offset_m - self.least_m, self.largest_m - offset_m)
        return 2.0 * drifted_m <= limits.failure_limit_m


def _bounds_m(epochs: Ints, journey: Journey, limits: LdsLimits) -> np.ndarray:
    """`noise_bound_m` from each epoch to the last one; infinite where the odometer lost its distance between."""
    last = epochs[-1]
    way_m = journey.travelled_m[last] - journey.travelled_m[epochs]
    scale = np.maximum(journey.scale_sigma[epochs], journey.scale_sigma[last])
    latency_m = journey.latency_sigma_s[last] * (journey.speed_mps[last] - journey.speed_mps[epochs])
    waited_s = (journey.t_ns[last] - journey.t_ns[epochs]) * 1e-9
    variance_m2 = journey.sigma_m[epochs] ** 2 + journey.sigma_m[last] ** 2 + (scale * way_m) ** 2 + latency_m**2
    variance_m2 += limits.odometer_sigma_mps**2 * waited_s
    bound_m = limits.threshold_factor * np.sqrt(variance_m2)
    return np.where(journey.stretch[epochs] == journey.stretch[last], bound_m, np.inf)
