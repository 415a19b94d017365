"""The design aid: responses, failures and ranking worked by hand, and a comparison small enough to run."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS
from datasets.experiment.bank import Fault, compare_banks, failure_s, fault_response, rank_banks
from datasets.experiment.geometry import default_geometry
from datasets.experiment.linear_bank import BankSpec, linear_bank
from datasets.experiment.rare_tables import banks, epochs_until, failure_epoch
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
    specs = [BankSpec(sensors=sensors, map_m=0.1) for sensors in ("odometer", "odometer_and_track")]  # type: ignore[arg-type]
    comparison = compare_banks(specs, (Fault("step", "cross", 25.0),), repetitions=20, seed=2)
    assert comparison["detected"].to_list() == [0.0, 1.0]
    assert comparison["first_monitor"].to_list() == [None, "cross_raw"]


def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    specs = [BankSpec(), BankSpec(alphas=(1.0, 0.1))]
    faults = (Fault("ramp", "range", 5.0),)
    one, two = (compare_banks(specs, faults, 20, seed=3, jobs=jobs) for jobs in (1, 2))
    assert one.equals(two)


def test_time_until_a_miss_is_rare_enough() -> None:
    bank = linear_bank(GPS, 0.0, BankSpec())
    earlier, later = epochs_until(bank, 1.0, (1e-3, 1e-9), seed=1, jobs=1)
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
    assert all(chosen.weights == spec.weights for _, chosen, _ in banks(config))
    for name in ("diagnostics", "findings", "pseudorange", "thresholds"):
        with pytest.raises(UsageError, match="takes no configuration"):
            EXPERIMENTS[name](tmp_path, 1, 1, 1, config)
