"""Positions as steps of a second, and what of them is known at each."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.paths.path_steps import PathSteps, path_steps
from pipeline.stages.paths.path_tests import NO_STEPS, PathTests, Stretch, Trail
from pipeline.stages.track.geodesy import points_of
from schemas.arrays import Floats, Ints
from schemas.config import MatchingConfig


def steps_at(
    t_s: Floats, distance_m: Floats | None = None, known_from_s: float = 0.0, independent: bool = True
) -> PathSteps:
    """20 m/s eastwards; an odometer from some time on."""
    points = points_of(np.full(t_s.size, 50.0), 14.0 + 20.0 * t_s / 71_700.0)

    def way(begin_ns: Ints, end_ns: Ints) -> Floats:
        return np.where(begin_ns >= known_from_s * 1e9, 20e-9 * (end_ns - begin_ns), np.nan)

    t_ns = np.round(t_s * 1e9).astype(np.int64)
    odometer = None if distance_m is None else way
    return path_steps(t_ns, points, np.ones(t_s.size), odometer, independent and odometer is not None)


def test_the_usual_time_between_steps_is_that_of_the_steps_before() -> None:
    """A position a second for a minute, then one in five seconds: known after half a minute of steps, not before."""
    t_s = np.concatenate([np.arange(60.0), 60.0 + 5.0 * np.arange(60.0)])
    period_s = steps_at(t_s).period_s
    assert (period_s[:75] == 1.0).all()
    assert (period_s[76:] == 5.0).all()
    for cut in (3, 50, 70, 90):
        assert (steps_at(t_s[:cut]).period_s == period_s[:cut]).all()


def test_ten_positions_a_second_are_one_step() -> None:
    steps = steps_at(np.arange(0.0, 30.0, 0.1))
    assert len(steps) == 30
    assert np.allclose(np.diff(steps.t_ns), 1e9)
    assert (steps.period_s == 1.0).all()
    assert steps.begin_ns.tolist() == [number * 1_000_000_000 for number in range(30)]


def test_an_odometer_that_begins_later_tells_nothing_before() -> None:
    t_s = np.arange(60.0)
    for independent in (True, False):
        steps = steps_at(t_s, t_s, 20.0, independent)
        assert steps.with_odometer.tolist() == [number > 20 for number in range(60)]
        assert np.isfinite(steps.along_m).any() == independent
    assert not steps_at(t_s).with_odometer.any()


@pytest.mark.parametrize(("jump_m", "refuted"), [(2.5, False), (3.3, True)])
@pytest.mark.parametrize("independent", [True, False])
def test_noise_lasts_longer_where_an_odometer_was_there(independent: bool, jump_m: float, refuted: bool) -> None:
    """Before it has measured the noise, declared independent or not: a movement over 3 s of 1 m positions.

    The bound is 4.19 sqrt(0.419) m + 0.2 m = 2.9 m with 20 s, of which the difference of two means of 3 s, 3 s apart,
    has 2 (0.952 - 0.742) of the variance.
    """
    assert _refuted(steps_at(np.arange(20.0), np.arange(20.0), 0.0, independent), jump_m) == refuted


@pytest.mark.parametrize(("jump_m", "refuted"), [(3.3, False), (4.0, True)])
def test_noise_may_last_shorter_where_no_odometer_was_there(jump_m: float, refuted: bool) -> None:
    """4.19 sqrt(0.708) m + 0.2 m = 3.7 m with 10 s."""
    assert _refuted(steps_at(np.arange(20.0)), jump_m) == refuted


def _refuted(steps: PathSteps, jump_m: float) -> bool:
    """A path beside which the positions lie, and from the 13th second on so far aside; exact survey, no bias."""
    count = len(steps)
    aside_m = np.where(np.arange(count) < 12, 0.0, jump_m)
    zeros = np.zeros(count)
    config = MatchingConfig(cross_bias_sigma_m=1e-6)
    tests = PathTests.of_run(steps, 0, config)
    verdict = tests.test_trail(steps, Trail(0, 0, 0, Stretch(aside_m, *[zeros] * 4), NO_STEPS))
    return verdict.rejected < count
