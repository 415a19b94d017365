"""Importance sampling against counting, against theory, and against the recursion of the bank."""

import numpy as np
import pytest
from scipy.stats import norm

from datasets.experiment.geometry import TAUS_S, default_geometry
from datasets.experiment.linear_bank import BankSpec, LinearBank, linear_bank
from datasets.experiment.plan import BANKS
from datasets.experiment.rare import (
    false_alarm_probability,
    missed_detection_probability,
    most_probable_miss,
    plain_false_alarm,
    plain_missed_detection,
)
from datasets.experiment.sigmas import limit_sigmas
from datasets.experiment.workers import generator

GPS = default_geometry("gps")


def bank(**changes: object) -> LinearBank:
    return linear_bank(GPS, 0.0, BankSpec(**changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_sigmas_are_those_of_the_closed_form(rate_hz: float) -> None:
    spec = BankSpec(sensors="odometer_and_track", rate_hz=rate_hz)
    system = linear_bank(GPS, 30.0, spec)
    for index, (white, position) in enumerate(((0.05, 0.0), (0.0, 1.0), (0.0, 1.0))):
        axis = GPS.axes(30.0)[index]
        variances = np.einsum("a,jab,b->j", axis, GPS.source_covariances_m2, axis)
        wanted = limit_sigmas(np.array(BANKS["increments"]), variances, TAUS_S, white, position, rate_hz)
        assert system.sigma[4 * index : 4 * index + 4] == pytest.approx(wanted, rel=1e-7)


def test_covariances_over_time_are_those_of_simulated_paths() -> None:
    system = bank(reading="position")
    paths = np.stack([noise.copy() for noise in system.paths(40, 40_000, generator(1))])
    wanted = system.covariance_with(2, 25, 40)
    measured = (paths * paths[24, 2]).mean(axis=2)
    scale = system.sigma * system.sigma[2]
    assert (np.abs(measured - wanted) / scale).max() < 5.0 / np.sqrt(40_000)


def test_one_epoch_of_one_monitor_is_the_gaussian_tail() -> None:
    """No overlap of exceedances: the estimate has no variance at all."""
    system = bank(alphas=(1.0,), false_alarm_probability=1e-9)
    result = false_alarm_probability(system, 1, runs=100)
    assert result.value == pytest.approx(1e-9, rel=1e-6)
    assert result.relative_error < 1e-6


def test_false_alarms_agree_with_counting() -> None:
    system = bank(false_alarm_probability=1e-4, sensors="odometer_and_track")
    clever = false_alarm_probability(system, 100, runs=1000, seed=2)
    plain = plain_false_alarm(system, 100, runs=20_000, seed=3)
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)
    assert clever.relative_error < 0.1


def test_missed_detections_agree_with_counting() -> None:
    for changes, rate, epochs in (({}, 0.3, 62), ({"sensors": "odometer_and_track"}, 0.3, 45)):
        system = bank(**changes)
        clever = missed_detection_probability(system, epochs, rate, runs=4000, seed=4)
        plain = plain_missed_detection(system, epochs, rate, runs=40_000, seed=5)
        assert 1e-4 < plain.value < 0.3
        spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
        assert clever.value == pytest.approx(plain.value, abs=4 * spread)


def test_a_single_gaussian_miss_has_its_exact_probability() -> None:
    """Raw monitor alone, one epoch: P(|m + r| < T) by the normal distribution, at 1e-9 and beyond."""
    system = bank(alphas=(1.0,))
    for rate in (2.0, 3.5):
        shift = rate * system.response(1)[0, 0] / system.sigma[0]
        factor = system.threshold[0] / system.sigma[0]
        exact = norm.cdf(factor - shift) - norm.cdf(-factor - shift)
        result = missed_detection_probability(system, 1, rate, runs=4000, seed=6)
        assert result.value == pytest.approx(exact, rel=5 * max(result.relative_error, 1e-3))
        assert result.relative_error < 0.1
    assert result.value < 1e-6


def test_the_most_probable_miss_stays_inside_the_thresholds() -> None:
    system = bank(sensors="odometer_and_track", reading="position")
    shift = most_probable_miss(system, 150, 0.2)
    path = shift.mean + 0.2 * system.response(150)
    assert (np.abs(path) <= system.threshold * 1.001).all()
    assert shift.half_square > 0


@pytest.mark.parametrize("sensors", ["odometer", "odometer_and_track"])
def test_probabilities_of_1e_9_are_within_reach(sensors: str) -> None:
    epochs = {"odometer": 420, "odometer_and_track": 330}[sensors]
    result = missed_detection_probability(bank(sensors=sensors), epochs, 0.1, runs=6000, seed=7)
    assert 1e-10 < result.value < 1e-8
    assert result.relative_error < 0.5
    assert result.variance_reduction > 1e5


def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    system = bank()
    one, two = (missed_detection_probability(system, 60, 0.3, runs=1000, seed=8, jobs=jobs) for jobs in (1, 2))
    assert one == two
