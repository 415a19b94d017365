"""The design aid: responses, failures and ranking worked by hand, and a comparison small enough to run."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS
from datasets.experiment.bank import FEWEST_RUNS, compare_banks, rank_banks
from datasets.experiment.bank_faults import CATALOGUE, Fault, WhiteNoise, failure_s, fault_response
from datasets.experiment.geometry import default_geometry
from datasets.experiment.linear_bank import BankSpec, linear_bank
from datasets.experiment.rare_tables import banks, epochs_until, failure_epoch
from datasets.experiment.workers import generator
from schemas.config import Configuration, MonitorConfig
from schemas.errors import UsageError

GPS = default_geometry("gps")


def test_responses_to_a_ramp_and_a_step_by_hand() -> None:
    """Weights 1 and 0.5 at 1 Hz: a ramp of 2 m/s gives 2, 2, 2 and 1, 1.5, 1.75; a step of 8 m 8, 0, 0 and 4, 2, 1."""
    bank = linear_bank(GPS, 0.0, BankSpec(alphas=(1.0, 0.5)))
    ramp = fault_response(bank, np.array([2.0]), "ramp", 3)
    assert ramp[:, 0].tolist() == [2.0, 2.0, 2.0]
    assert ramp[:, 1].tolist() == [1.0, 1.5, 1.75]
    step = fault_response(bank, np.array([8.0]), "step", 3)
    assert step[:, 0].tolist() == [8.0, 0.0, 0.0]
    assert step[:, 1].tolist() == [4.0, 2.0, 1.0]


def test_failures_by_hand() -> None:
    assert failure_s(Fault("ramp", "along", 0.5), GPS) == pytest.approx(40.0)
    assert failure_s(Fault("step", "along", 25.0), GPS) == 0.0
    assert failure_s(Fault("step", "along", 10.0), GPS) is None
    assert failure_s(Fault("ramp", "cross", 1.0), GPS) is None
    # At 30 m/s: 30 m behind at once; 30 m/s behind; an odometer that is wrong leaves the position right.
    assert failure_s(Fault("latency", "along", 1.0), GPS) == 0.0
    assert failure_s(Fault("latency", "along", 0.2), GPS) is None
    assert failure_s(Fault("frozen", "along", 1.0), GPS) == pytest.approx(2.0 / 3.0)
    assert failure_s(Fault("slip", "odometer", 3.0), GPS) is None


def test_what_faults_make_of_position_minus_odometer_by_hand() -> None:
    sizes = {
        Fault("latency", "along", 0.2): -6.0,
        Fault("frozen", "along", 1.0): -30.0,
        Fault("slip", "odometer", 0.8): -0.8,
        Fault("slide", "odometer", 0.8): 0.8,
        Fault("scale", "odometer", 1.02): -0.6,
        Fault("odometer late", "odometer", 0.2): 6.0,
    }
    for fault, size in sizes.items():
        assert fault.rates(GPS, 3).tolist() == pytest.approx([size, 0.0, 0.0])
    assert Fault("scale", "odometer", 1.02).name == "scale 1.02 odometer"
    assert len({fault.name for fault in CATALOGUE}) == len(CATALOGUE)


def test_noise_on_the_position_shakes_the_monitors_as_white_noise_does() -> None:
    """Increments of white noise of 2 m: sigma 2 sqrt(2) raw; EWMA of weight a: 2 a sqrt(2 / (2 - a))."""
    bank = linear_bank(GPS, 0.0, BankSpec(alphas=(1.0, 0.2)))
    shaken = WhiteNoise(bank, (Fault("noise", "along", 2.0),), 40_000, generator(1))
    for _ in range(60):
        values = shaken.step(np.array([0]))
    expected = 2.0 * np.array([np.sqrt(2.0), 0.2 * np.sqrt(2.0 / 1.8)])
    assert values[0].std(axis=1) == pytest.approx(expected, rel=0.02)


def test_too_few_runs_say_so() -> None:
    """72 runs that all go well show more than 95 %, 71 do not."""
    for runs, shown in ((FEWEST_RUNS, True), (FEWEST_RUNS - 1, False)):
        comparison = compare_banks([BankSpec(rate_hz=10.0)], (Fault("step", "along", 25.0),), runs, seed=1)
        ranking = rank_banks(comparison)
        assert ranking["faults_in_time"][0] == int(shown)
        assert ("cannot show 95 %" in ranking["reason"][0]) is not shown


def test_ten_hertz_keeps_a_25_m_step_in_the_budget_and_1_hz_does_not() -> None:
    """One epoch to see it and one to negate it: 0.2 s and 2 s against the allowed 1.675 s."""
    specs = [BankSpec(rate_hz=rate_hz) for rate_hz in (1.0, 10.0)]
    faults = (Fault("step", "along", 25.0), Fault("ramp", "along", 5.0))
    comparison = compare_banks(specs, faults, repetitions=30, seed=1)
    step = comparison.filter(pl.col("fault") == faults[0].name)
    assert step["within_budget"].to_list() == [0.0, 1.0]
    assert step["first_monitor"].to_list() == ["along_raw", "along_raw"]
    ranking = rank_banks(comparison)
    assert ranking["rate_hz"][0] == 10.0
    assert "late: step 25 m along" in ranking.filter(pl.col("rate_hz") == 1.0)["reason"][0]


def test_cross_track_faults_need_the_track() -> None:
    specs = [BankSpec(sensors=sensors, map_m=0.1) for sensors in ("odometer", "odometer_and_track")]
    comparison = compare_banks(specs, (Fault("step", "cross", 25.0),), repetitions=20, seed=2)
    assert comparison["detected"].to_list() == [0.0, 1.0]
    assert comparison["first_monitor"].to_list() == [None, "cross_raw"]


@pytest.mark.usefixtures("in_process")
def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    specs = [BankSpec(), BankSpec(alphas=(1.0, 0.1))]
    faults = (Fault("ramp", "range", 5.0),)
    one, two = (compare_banks(specs, faults, 20, seed=3, jobs=jobs) for jobs in (1, 2))
    assert one.equals(two)


def test_time_until_a_miss_is_rare_enough() -> None:
    bank = linear_bank(GPS, 0.0, BankSpec())
    earlier, later = epochs_until(bank, 1.0, (1e-3, 1e-9), seed=1, jobs=1, period_s=1.0)
    assert earlier is not None
    assert later is not None
    assert earlier < later < failure_epoch(bank, 1.0)
    assert failure_epoch(bank, 1.0) == pytest.approx(20.0 / abs(float(bank.along_error[0])), abs=1.0)


def test_a_configured_bank_is_judged(tmp_path: Path) -> None:
    """The replay's configuration as a bank; published experiments refuse one instead of ignoring it."""
    config = Configuration(
        monitors=MonitorConfig(ewma_alphas=(0.2, 0.05, 0.005), odometer_sigma_mps=0.1, false_alarm_probability=1e-6)
    )
    spec = BankSpec.of(config.monitors, "odometer_and_track", 10.0)
    assert spec.weights == (1.0, 0.2, 0.05, 0.005)
    assert (spec.odometer_m, spec.false_alarm_probability, spec.rate_hz) == (0.1, 1e-6, 10.0)
    assert all(chosen.spec.weights == spec.weights for _, chosen in banks(config))
    for name in ("diagnostics", "findings", "pseudorange", "thresholds"):
        with pytest.raises(UsageError, match="takes no configuration"):
            EXPERIMENTS[name](tmp_path, 1, 1, 1, config)


def test_the_recommendation_says_why_and_where_the_default_stands() -> None:
    """Default weights at 1e-8 come first: at 1e-7 and 10 Hz twelve monitors alarm more than once in 100 h."""
    specs = [
        BankSpec(
            alphas=(1.0, 0.1, 0.01, 0.001),
            sensors="odometer_and_track",
            false_alarm_probability=probability,
            rate_hz=10.0,
            map_m=0.1,
        )
        for probability in (1e-7, 1e-8)
    ]
    ranking = rank_banks(compare_banks(specs, (Fault("step", "along", 25.0),), FEWEST_RUNS, seed=1))
    assert ranking["probability"].to_list() == [1e-8, 1e-7]
    assert ranking["replay_default"].to_list() == [False, True]
    best, default = ranking["reason"]
    assert best.startswith("1 of 1 faults negated in time, one false alarm in ")
    assert "more often than one in 100 h" not in best
    assert "more often than one in 100 h" in default
