"""Scale and lag of a recorder against a counter: by hand, and on drawn journeys whose truth nobody tells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.truth.clock import draw, estimate
from pipeline.stages.odometry.regression import LagState, ScaleLag
from pipeline.stages.odometry.scale_lag import CounterRows, possible_lags, scale_and_lag
from schemas.arrays import Floats


def distance_m(t_s: Floats) -> Floats:
    """Every minute: 30 s speeding up by 1 m/s2, 30 s slowing down; 900 m."""
    minute, second = np.divmod(t_s, 60.0)
    return 900.0 * minute + np.where(second < 30.0, 0.5 * second**2, 900.0 - 0.5 * (60.0 - second) ** 2)


def counter(scale: float = 1.0, step_s: float = 0.1) -> CounterRows:
    """Exact at its rows; without an end, as far as the tests go."""
    t_s = np.arange(0.0, 4000.0, step_s)
    return CounterRows(t_s, distance_m(t_s) / scale, np.zeros(t_s.size))


def recorded(ways: int, late_s: float, begin_s: float = 600.0) -> tuple[Floats, Floats, Floats]:
    """Stamps 20 s apart, each `late_s` after the moment; what was driven in between."""
    t_s = begin_s + 20.0 * np.arange(ways + 1)
    return t_s[:-1] + late_s, t_s[1:] + late_s, np.diff(distance_m(t_s))


@pytest.mark.parametrize(
    ("ways", "late_s", "state"),
    [
        (6, 0.2, LagState.MEASURED),
        (5, 0.2, LagState.TOO_FEW),
        (12, 0.2, LagState.MEASURED),
        (12, 8.0, LagState.MEASURED),
        (12, -8.0, LagState.MEASURED),
        (11, 8.0, LagState.TOO_FEW),  # for a lag of seconds
        (60, 29.0, LagState.MEASURED),
    ],
)
def test_a_lag_is_known_from_six_ways_and_one_of_seconds_from_twelve(ways: int, late_s: float, state: LagState) -> None:
    found = scale_and_lag(*recorded(ways, late_s), counter())
    assert found.state is state
    assert found.lag_s == pytest.approx(late_s if found.measured else 0.0, abs=0.01)
    assert np.isfinite(found.lag_sigma_s) == found.measured


@pytest.mark.parametrize("scale", [1.02, 0.97, -1.0, 0.2778])
def test_the_scale_is_found_with_the_lag_whatever_the_unit_and_the_sign(scale: float) -> None:
    found = scale_and_lag(*recorded(40, 1.3), counter(scale))
    assert (found.scale, found.lag_s) == (pytest.approx(scale), pytest.approx(1.3, abs=0.01))
    assert np.array(found.halves) == pytest.approx(np.array([[scale, 1.3]] * 2), abs=0.01)


def test_at_constant_speed_the_scale_alone_is_known() -> None:
    """Noise of 2 m, the other 7 s late and 1 % longer: nothing shows the lag."""
    t_s = np.arange(0.0, 1200.0, 0.1)
    rng = np.random.default_rng(1)
    counted = CounterRows(t_s, 30.0 * t_s + rng.normal(0.0, 0.1, t_s.size), np.zeros(t_s.size))
    at_s = np.arange(20.0, 1100.0, 2.0)
    place_m = 30.3 * (at_s - 7.0) + rng.normal(0.0, 2.0, at_s.size)
    found = scale_and_lag(at_s[:-5], at_s[5:], place_m[5:] - place_m[:-5], counted)
    assert not found.measured
    assert (found.lag_s, found.lag_sigma_s) == (0.0, float("inf"))
    assert found.scale == pytest.approx(1.01, abs=4.0 * found.scale_sigma)
    assert found.scale_sigma < 1e-3


def test_a_train_that_stands_shows_nothing() -> None:
    t_s = np.arange(0.0, 600.0, 0.1)
    rng = np.random.default_rng(2)
    counted = CounterRows(t_s, rng.normal(0.0, 0.01, t_s.size), np.zeros(t_s.size))
    begin_s = np.arange(20.0, 550.0, 2.0)
    found = scale_and_lag(begin_s, begin_s + 10.0, rng.normal(0.0, 0.1, begin_s.size), counted)
    assert (found.scale, found.scale_sigma, found.measured) == (1.0, float("inf"), False)


def test_one_change_of_speed_that_comes_with_a_step_is_no_lag() -> None:
    """From 34 to 28 m/s just as the other recorder steps back by 31 m: that looks like a lag of 5 s."""
    t_s = np.arange(0.0, 900.0, 0.1)
    travelled_m = np.cumsum(np.interp(t_s, [440.0, 452.0], [34.0, 28.0])) * 0.1
    begin_s = np.arange(20.0, 850.0, 2.0)
    place_m = np.interp(t_s, t_s, travelled_m) - 31.0 * (t_s > 446.0)
    place_m = place_m + np.random.default_rng(3).normal(0.0, 0.5, t_s.size)
    ways_m = np.interp(begin_s + 10.0, t_s, place_m) - np.interp(begin_s, t_s, place_m)
    found = scale_and_lag(begin_s, begin_s + 10.0, ways_m, CounterRows(t_s, travelled_m, np.zeros(t_s.size)))
    assert not found.measured or abs(found.lag_s) < 4.0 * found.lag_sigma_s


def drifting(begin_s: float, end_s: float, rate_mps: float, speeds: tuple[list[float], list[float]]) -> ScaleLag:
    """The other recorder, exact to 0.1 m and in time, walks away at this rate between these instants."""
    t_s = np.arange(0.0, speeds[0][-1], 0.05)
    travelled_m = np.cumsum(np.interp(t_s, *speeds)) * 0.05
    place_m = travelled_m + rate_mps * np.clip(t_s - begin_s, 0.0, end_s - begin_s)
    at_s = np.arange(2.0, t_s[-1] - 2.0, 2.0)
    measured_m = np.interp(at_s, t_s, place_m) + np.random.default_rng(4).normal(0.0, 0.1, at_s.size)
    return scale_and_lag(
        at_s[:-5], at_s[5:], measured_m[5:] - measured_m[:-5], CounterRows(t_s, travelled_m, np.zeros(t_s.size))
    )


def test_a_drift_as_long_as_the_only_change_of_speed_is_no_lag() -> None:
    """0.5 m/s beside a start at 0.2 m/s2 looks like a lag of -2.5 s, to the last minute of it."""
    found = drifting(115.0, 215.0, 0.5, ([0.0, 140.0, 240.0, 320.0], [0.0, 0.0, 20.0, 20.0]))
    assert not found.measured or abs(found.lag_s) < 4.0 * found.lag_sigma_s


def test_a_step_in_doubt_is_not_compared() -> None:
    """The counter begins anew at zero; without the doubt that is a way of 9 km."""
    whole = counter()
    reset = whole.t_s >= 1000.0
    distance = whole.distance_m - np.where(reset, whole.distance_m[reset][0], 0.0)
    found = scale_and_lag(*recorded(40, 0.4), CounterRows(whole.t_s, distance, reset.astype(np.float64)))
    assert found.lag_s == pytest.approx(0.4, abs=0.01)
    assert found.scale == pytest.approx(1.0, abs=1e-6)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_no_figure_is_wrong_by_more_than_four_of_its_sigmas(seed: int) -> None:
    """Constant speed, shuttles, freight, trams; `benchmarks.truth.clock` draws ten thousand."""
    drawn = draw(seed)
    found = estimate(drawn)
    assert abs(found.scale - drawn.scale) <= 4.0 * found.scale_sigma
    if found.measured:
        assert abs(found.lag_s - drawn.lag_s) <= 4.0 * found.lag_sigma_s


@pytest.mark.parametrize(("family", "least"), [("shuttle", 30), ("tram", 39)])
def test_where_the_speed_changes_the_lag_is_measured(family: str, least: int) -> None:
    """A shuttle that stops once in its five minutes may have been cut there by a step of the other recorder."""
    found = [estimate(draw(seed, family)) for seed in range(40)]
    assert sum(one.measured for one in found) >= least


@pytest.mark.parametrize("late_s", [0.0, 1.2, -7.0])
def test_three_ways_refute_all_lags_but_few(late_s: float) -> None:
    """Speeds at the ends of ways differ by 10 to 20 m/s, so that a lag of 1 s makes them so many metres longer."""
    ways = recorded(3, late_s)
    low_s, high_s = possible_lags(ways, counter(), np.full(3, 1.0), 0.05, 3.0) or (0.0, 0.0)
    assert low_s < late_s < high_s
    assert high_s - low_s < 2.0
    # Ways ten times as noisy refute no more.
    wider = possible_lags(ways, counter(), np.full(3, 10.0), 0.05, 3.0)
    assert wider is None or (wider[0] <= low_s and wider[1] >= high_s)


def test_ways_at_one_speed_say_nothing_of_a_lag() -> None:
    t_s = np.arange(0.0, 1200.0, 0.1)
    counted = CounterRows(t_s, 30.0 * t_s, np.zeros(t_s.size))
    begin_s = np.arange(100.0, 1000.0, 60.0)
    ways = begin_s, begin_s + 60.0, np.full(begin_s.size, 1800.0)
    assert possible_lags(ways, counted, np.ones(begin_s.size), 0.05, 3.0) is None
    # Of so few nobody can say that their speed was one: any lag is possible.
    two = ways[0][:2], ways[1][:2], ways[2][:2]
    assert possible_lags(two, counted, np.ones(2), 0.05, 3.0) == (-30.0, 30.0)


def test_a_slip_widens_what_is_possible() -> None:
    """Of eight ways one is 12 m too long: it hides the lag, and is no reason to believe in none."""
    begin_s, end_s, travelled_m = recorded(8, 1.2)
    slipped = travelled_m + 12.0 * (np.arange(8) == 3)
    clean, wide = (
        possible_lags((begin_s, end_s, way), counter(), np.ones(8), 0.05, 3.0) for way in (travelled_m, slipped)
    )
    assert clean is not None
    assert wide is not None
    assert wide[1] - wide[0] > clean[1] - clean[0]
    assert wide[0] < 1.2 < wide[1]


def test_the_true_lag_is_hardly_ever_refuted() -> None:
    """White places of 1 m, 400 draws of 3 to 11 ways: at 3 sigmas 1 in 370 of a normal figure."""
    dice = np.random.default_rng(7)
    missed = 0
    for _ in range(400):
        count, late_s, scale = (
            int(dice.integers(3, 12)),
            float(dice.uniform(-3.0, 3.0)),
            float(dice.uniform(0.96, 1.04)),
        )
        begin_s, end_s, travelled_m = recorded(count, late_s, float(dice.uniform(200.0, 3000.0)))
        noisy = scale * travelled_m + np.diff(dice.normal(0.0, 1.0, count + 1))
        found = possible_lags((begin_s, end_s, noisy), counter(), np.full(count, 2.0), 0.05, 3.0)
        missed += found is not None and not found[0] <= late_s <= found[1]
    assert missed <= 1
