"""How a measured lag is taken: worked by hand with k = 3 and an assumed clock of 0.1 s (DOMAIN section 5.1)."""

from __future__ import annotations

import pytest

from pipeline.stages.evidence.carrying import Lags, RecorderClock, possible_leads_s, recorder_clock, recorder_clocks
from pipeline.stages.odometry.regression import LagState, ScaleLag
from schemas.config import HazardConfig


@pytest.mark.parametrize(
    ("lag_s", "sigma_s", "clock"),
    [
        (0.4, 0.01, RecorderClock(0.4, 0.03)),
        (-0.4, 0.01, RecorderClock(-0.4, 0.03)),
        (0.0, 0.02, RecorderClock(0.0, 0.06)),
        (0.1, 0.06, RecorderClock(0.0, 0.1, assumed=True)),  # below two sigmas, of which three are 0.18 s
        (0.13, 0.06, RecorderClock(0.0, 0.31)),  # it may be none: 0.13 - 0.18 < 0
        (0.05, 0.03, RecorderClock(0.0, 0.14)),  # three sigmas are no more than is assumed anyway
        (17.0, 0.02, RecorderClock(17.0, 0.06)),
    ],
)
def test_a_recorder_is_put_on_the_clock_of_the_odometer(lag_s: float, sigma_s: float, clock: RecorderClock) -> None:
    found = recorder_clock([Lags((ScaleLag(1.0, 0.01, lag_s, sigma_s, LagState.MEASURED),))], True, HazardConfig())
    assert (found.shift_s, found.delta_s) == pytest.approx((clock.shift_s, clock.delta_s))
    assert found.assumed == clock.assumed


def test_a_clock_of_which_the_ways_say_nothing_is_assumed() -> None:
    assert recorder_clock([Lags((ScaleLag(),))], True, HazardConfig()) == RecorderClock(0.0, 0.1, assumed=True)


@pytest.mark.parametrize(
    ("possible_s", "clock"),
    [
        ((0.6, 1.8), (0.0, 1.8)),  # found, and not proved: it moves nothing
        ((-2.5, 0.1), (0.0, 2.5)),
    ],
)
def test_lags_that_few_ways_do_not_refute_are_all_possible(
    possible_s: tuple[float, float], clock: tuple[float, float]
) -> None:
    found = recorder_clock([Lags((ScaleLag(),), possible_s)], True, HazardConfig())
    assert (found.shift_s, found.delta_s) == pytest.approx(clock)
    assert not found.assumed


@pytest.mark.parametrize(("lag_s", "clock"), [(0.0, (0.0, 0.1)), (0.4, (0.4, 0.1)), (-0.05, (-0.05, 0.1))])
def test_by_an_odometer_that_is_not_independent_it_only_widens(lag_s: float, clock: tuple[float, float]) -> None:
    found = recorder_clock([Lags((ScaleLag(1.0, 0.01, lag_s, 0.01, LagState.MEASURED),))], False, HazardConfig())
    assert (found.shift_s, found.delta_s) == pytest.approx(clock)
    assert found.assumed


def test_any_clock_may_be_the_true_one() -> None:
    clocks = [RecorderClock(0.4, 0.1), RecorderClock(-0.2, 0.02)]
    assert possible_leads_s(clocks) == pytest.approx((-0.2, 0.4))
    assert possible_leads_s([RecorderClock(0.0, 0.1)]) == (0.0,)
    # Seconds of lag are gone through in steps of a second or less: the train may have sped up and braked within.
    assert possible_leads_s([RecorderClock(3.5, 0.1)]) == pytest.approx((0.0, 0.875, 1.75, 2.625, 3.5))


def test_a_clock_that_cannot_be_measured_may_be_that_of_any_other_recorder() -> None:
    """Lags of 4 s and -1 s are measured: a third recorder may have either, or none, each to 0.1 s."""
    measured = [Lags((ScaleLag(1.0, 0.01, lag_s, 0.01, LagState.MEASURED),)) for lag_s in (4.0, -1.0)]
    first, second, third = recorder_clocks([[measured[0]], [measured[1]], []], True, HazardConfig())
    assert (first.shift_s, second.shift_s) == pytest.approx((4.0, -1.0))
    assert third.assumed
    assert third.shift_s - third.delta_s <= -1.1
    assert third.shift_s + third.delta_s >= 4.1
