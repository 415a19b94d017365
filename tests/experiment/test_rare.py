"""Importance sampling against counting, against theory, and against the recursion of the bank."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from datasets.experiment import EXPERIMENTS
from datasets.experiment.bank import PUBLISHED_WEIGHTS, BankSpec, LinearBank, linear_bank
from datasets.experiment.geometry import TAUS_S, Constellation, default_geometry
from datasets.experiment.rare import banks, epochs_until, failure_epoch
from datasets.experiment.sampling import (
    Probability,
    false_alarm_probability,
    first_below,
    missed_detection_probability,
    most_probable_miss,
    population_size,
    probability_figures,
)
from datasets.experiment.workers import in_blocks, random_generator
from schemas.config import Configuration, MonitorConfig
from schemas.errors import UsageError
from tests.experiment.counting import agree, counted_alarms, counted_misses
from tests.experiment.sigmas import bank_sigmas, limit_sigmas

GPS = default_geometry("gps")


def monitored_noise(system: LinearBank, epochs: int, runs: int) -> np.ndarray:
    """Noise of all monitors, (epochs, monitors, runs)."""
    rng = random_generator(1)
    state = system.draw_start(runs, rng)
    values = []
    for _ in range(epochs):
        state = system.draw_next(state, rng)
        values.append(system.values(state).copy())
    return np.stack(values)


def bank(**changes: object) -> LinearBank:
    return linear_bank(GPS, 0.0, BankSpec(**changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_sigmas_are_those_of_the_closed_form(rate_hz: float) -> None:
    spec = BankSpec(sensors="odometer_and_track", rate_hz=rate_hz)
    system = linear_bank(GPS, 30.0, spec)
    for index, (white, position) in enumerate(((0.05, 0.0), (0.0, 1.0), (0.0, 1.0))):
        axis = GPS.axes(30.0)[index]
        variances = np.einsum("a,jab,b->j", axis, GPS.source_covariances_m2, axis)
        wanted = limit_sigmas(np.array(PUBLISHED_WEIGHTS["increments"]), variances, TAUS_S, white, position, rate_hz)
        assert system.sigma[4 * index : 4 * index + 4] == pytest.approx(wanted, rel=1e-7)


def test_covariances_over_time_are_those_of_simulated_paths() -> None:
    system = bank(reading="position")
    paths = monitored_noise(system, 40, 40_000)
    wanted = system.covariance_with(2, 25, system.covariances(40))
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
    plain = counted_alarms(system, 100, runs=20_000, seed=3)
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)
    assert clever.relative_error < 0.1


def test_missed_detections_agree_with_counting() -> None:
    for changes, rate, epochs in (({}, 0.3, 62), ({"sensors": "odometer_and_track"}, 0.3, 45)):
        system = bank(**changes)
        clever = missed_detection_probability(system, epochs, rate, runs=4000, seed=4)
        plain = counted_misses(system, epochs, rate, runs=20_000, seed=5)
        assert 1e-4 < plain.value < 0.3
        spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
        assert clever.value == pytest.approx(plain.value, abs=4 * spread)


def test_a_single_gaussian_miss_has_its_exact_probability() -> None:
    """Raw monitor alone, one epoch: P(|m + r| < T) by the normal distribution, at 1e-9 and beyond."""
    system = bank(alphas=(1.0,))
    for rate in (2.0, 3.5):
        shift = system.ramp(1, rate)[0, 0] / system.sigma[0]
        factor = system.threshold[0] / system.sigma[0]
        exact = ndtr(factor - shift) - ndtr(-factor - shift)
        result = missed_detection_probability(system, 1, rate, runs=4000, seed=6)
        assert result.value == pytest.approx(exact, rel=5 * max(result.relative_error, 1e-3))
        assert result.relative_error < 0.1
    assert result.value < 1e-6


def test_the_most_probable_miss_stays_inside_the_thresholds() -> None:
    system = bank(sensors="odometer_and_track", reading="position")
    shift = most_probable_miss(system, 150, 0.2)
    path = shift.mean + system.ramp(150, 0.2)
    assert (np.abs(path) <= system.threshold * 1.001).all()
    assert shift.half_square > 0


@pytest.mark.parametrize("sensors", ["odometer", "odometer_and_track"])
def test_probabilities_of_1e_9_are_within_reach(sensors: str) -> None:
    epochs = {"odometer": 420, "odometer_and_track": 330}[sensors]
    result = missed_detection_probability(bank(sensors=sensors), epochs, 0.1, runs=6000, seed=7)
    assert 1e-10 < result.value < 1e-8
    assert result.relative_error < 0.5
    assert result.variance_reduction > 1e5


@pytest.mark.usefixtures("in_process")
def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    system = bank()
    one, two = (missed_detection_probability(system, 60, 0.3, runs=500, seed=8, jobs=jobs) for jobs in (1, 2))
    assert one == two


@pytest.mark.parametrize(
    ("constellation", "changes", "rate", "epochs", "runs", "decade"),
    [
        # A sample of shifted noise alone said 7.6e-10 here, once in 500 runs, or lost every run.
        ("gps_galileo", {"sensors": "odometer_and_track"}, 0.1, 576, 4_000, -7),
        ("gps", {"sensors": "odometer_and_track"}, 0.03, 1040, 2_000, -4),
        ("gps", {"reading": "position"}, 0.03, 960, 2_000, -5),
    ],
)
def test_many_near_thresholds_leave_runs_alive(
    constellation: Constellation, changes: dict[str, object], rate: float, epochs: int, runs: int, decade: int
) -> None:
    system = linear_bank(default_geometry(constellation), 0.0, BankSpec(**changes))  # type: ignore[arg-type]
    one, two = (missed_detection_probability(system, epochs, rate, runs=runs, seed=seed) for seed in (1, 2))
    assert np.floor(np.log10(one.value)) == decade
    assert one.relative_error < 0.3
    assert one.value == pytest.approx(two.value, abs=4 * np.hypot(one.relative_error, two.relative_error) * two.value)


def test_a_miss_that_counting_sees_once_in_a_thousand_over_a_long_time() -> None:
    """Dual constellation, 0.03 m/s, twelve monitors: some 1400 epochs near thresholds, where a shift alone fails."""
    system = linear_bank(default_geometry("gps_galileo"), 0.0, BankSpec(sensors="odometer_and_track"))
    clever = missed_detection_probability(system, 1_700, 0.03, runs=1_500, seed=3)
    plain = counted_misses(system, 1_700, 0.03, runs=1_000, seed=4)
    assert 0.002 < plain.value < 0.3
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)


@pytest.mark.parametrize("age_s", [0.0, 40.0])
def test_a_young_bank_has_its_own_sigmas_and_misses(age_s: float) -> None:
    young, old = bank(age_s=age_s), bank()
    axis = GPS.axes(0.0)[0]
    variances = np.einsum("a,jab,b->j", axis, GPS.source_covariances_m2, axis)
    exact = bank_sigmas(np.array(PUBLISHED_WEIGHTS["increments"]), int(age_s) + 60, variances, TAUS_S, 0.05, 0.0)
    assert young.sigmas(60) == pytest.approx(exact[int(age_s) :], rel=1e-7)
    clever = missed_detection_probability(young, 60, 0.3, runs=4000, seed=9)
    plain = counted_misses(young, 60, 0.3, runs=60_000, seed=10)
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)
    assert clever.value != pytest.approx(missed_detection_probability(old, 60, 0.3, runs=4000, seed=9).value, rel=0.3)


def test_a_bank_older_than_its_memory_is_the_stationary_one() -> None:
    assert bank(age_s=10_000.0).sigmas(3) == pytest.approx(bank().sigmas(3), rel=1e-6)


def test_false_alarms_are_not_sampled_of_a_young_bank() -> None:
    with pytest.raises(ValueError, match="stationary"):
        false_alarm_probability(bank(age_s=0.0), 10)


def test_the_first_time_below_a_target_by_hand() -> None:
    """Halved every epoch: below 1e-3 from epoch 10 on; an estimate of zero is no proof of rarity."""
    assert first_below(lambda epochs: 0.5**epochs, (1e-3, 1e-6, 1e-40), 100) == [10, 20, None]
    assert first_below(lambda epochs: 0.0, (1e-3,), 100) == [None]


def test_no_probability_below_1e_12_is_stated() -> None:
    """And none that came out as zero: that no run came through proves nothing."""
    wanted = {1e-12: (1e-12, None, 0.1), 9e-13: (None, 1e-12, None), 0.0: (None, None, None)}
    for value, expected in wanted.items():
        row = probability_figures(Probability(value, 0.1, 10.0, 100))
        assert (row["probability"], row["below"], row["relative_error"]) == expected


def test_intervals_that_meet_by_hand() -> None:
    """10 of 1,000: Clopper-Pearson from 0.0048 to 0.0183."""
    counted = Probability(0.010, 0.3, 1.0, 1000)
    assert agree(Probability(0.0185, 0.02, 1.0, 100), counted)
    assert not agree(Probability(0.0195, 0.02, 1.0, 100), counted)
    assert not agree(Probability(0.0045, 0.02, 1.0, 100), counted)
    assert not agree(Probability(0.0, float("inf"), 1.0, 100), counted)


def test_runs_are_shared_by_populations_of_some_size() -> None:
    assert in_blocks(20_000, population_size(20_000)) == [1_000] * 20
    assert in_blocks(1_100, population_size(1_100)) == [250] * 4 + [100]
    assert in_blocks(7, population_size(7)) == [7]


def test_a_ramp_below_all_thresholds_is_sampled_well_too() -> None:
    """0.03 m/s, noise on position, two constellations: the mean never comes near a threshold, and still 4e-9 miss."""
    system = linear_bank(default_geometry("gps_galileo"), 0.0, BankSpec(reading="position"))
    assert most_probable_miss(system, 2_720, 0.03).half_square > 2.0
    result = missed_detection_probability(system, 2_720, 0.03, runs=2_500, seed=11)
    assert 1e-9 < result.value < 1e-8
    assert result.relative_error < 0.2


def test_the_error_of_a_probability_below_the_smallest_square() -> None:
    system = linear_bank(default_geometry("gps_galileo"), 0.0, BankSpec(reading="position"))
    result = missed_detection_probability(system, 120, 1.0, runs=2_000, seed=12)
    assert 0.0 < result.value < 1e-155
    assert 0.0 < result.relative_error < 0.6


def test_time_until_a_miss_is_rare_enough() -> None:
    system = bank()
    earlier, later = epochs_until(system, 1.0, (1e-3, 1e-9), seed=1, jobs=1, period_s=1.0)
    assert earlier is not None
    assert later is not None
    assert earlier < later < failure_epoch(system, 1.0)
    assert failure_epoch(system, 1.0) == pytest.approx(20.0 / abs(float(system.along_error[0])), abs=1.0)


def test_a_configured_bank_is_judged(tmp_path: Path) -> None:
    """The replay's configuration as a bank; the published experiment refuses one instead of ignoring it."""
    config = Configuration(
        monitors=MonitorConfig(ewma_alphas=(0.2, 0.05, 0.005), odometer_sigma_mps=0.1, false_alarm_probability=1e-6)
    )
    spec = BankSpec.from_configuration(config.monitors, "odometer_and_track", 10.0)
    assert spec.weights == (1.0, 0.2, 0.05, 0.005)
    assert (spec.odometer_m, spec.false_alarm_probability, spec.rate_hz) == (0.1, 1e-6, 10.0)
    assert all(chosen.spec.weights == spec.weights for _, chosen in banks(config))
    with pytest.raises(UsageError, match="takes no configuration"):
        EXPERIMENTS["diagnostics"](tmp_path, 1, 1, 1, config)


@pytest.mark.parametrize(("rate_hz", "hours"), [(1.0, 413.0), (10.0, 75.0)])
def test_a_healthy_bank_alarms_once_in_so_many_hours(rate_hz: float, hours: float) -> None:
    """Twelve monitors, a track whose error is constant: what docs/experiments.md gives from more runs."""
    system = linear_bank(GPS, 30.0, BankSpec(sensors="odometer_and_track", rate_hz=rate_hz, map_m=1e-6))
    span_h = 0.3 if rate_hz > 1.0 else 1.0
    alarmed = false_alarm_probability(system, int(3_600 * rate_hz * span_h), runs=100 if rate_hz > 1.0 else 150)
    assert hours / 1.3 < -span_h / np.log1p(-alarmed.value) < hours * 1.3
