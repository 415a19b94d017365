"""How a measured lag is taken: worked by hand with k = 3 and an assumed clock of 0.1 s (DOMAIN section 5.1)."""

from __future__ import annotations

import pytest

from pipeline.stages.evidence.clock import RecorderClock, clock_of
from pipeline.stages.odometry.scale_lag import LagState, ScaleLag
from schemas.config import HazardConfig


@pytest.mark.parametrize(
    ("lag_s", "sigma_s", "clock"),
    [
        (0.4, 0.01, RecorderClock(0.2, 0.23)),  # the hull of 0 +- 0.03 and 0.4 +- 0.03
        (-0.4, 0.01, RecorderClock(-0.2, 0.23)),
        (0.0, 0.02, RecorderClock(0.0, 0.06)),
        (0.1, 0.06, RecorderClock(0.0, 0.1, assumed=True)),  # below two sigmas, of which three are 0.18 s
        (0.13, 0.06, RecorderClock(0.065, 0.245)),
        (0.05, 0.03, RecorderClock(0.025, 0.115)),  # three sigmas are no more than is assumed anyway
        (17.0, 0.02, RecorderClock(8.5, 8.56)),
    ],
)
def test_the_hull_of_no_lag_and_the_measured_one(lag_s: float, sigma_s: float, clock: RecorderClock) -> None:
    found = clock_of([ScaleLag(1.0, 0.01, lag_s, sigma_s, LagState.MEASURED)], True, HazardConfig())
    assert (found.shift_s, found.delta_s) == pytest.approx((clock.shift_s, clock.delta_s))
    assert found.assumed == clock.assumed


def test_what_is_not_measured_is_assumed() -> None:
    assert clock_of([ScaleLag()], True, HazardConfig()) == RecorderClock(0.0, 0.1, assumed=True)


@pytest.mark.parametrize(("lag_s", "lags_s"), [(0.0, (-0.1, 0.1)), (0.4, (-0.1, 0.43)), (-0.05, (-0.1, 0.1))])
def test_by_an_odometer_that_is_not_independent_it_only_widens(lag_s: float, lags_s: tuple[float, float]) -> None:
    found = clock_of([ScaleLag(1.0, 0.01, lag_s, 0.01, LagState.MEASURED)], False, HazardConfig())
    assert found.lags_s == pytest.approx(lags_s)
    assert found.assumed
