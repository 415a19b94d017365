"""Regression of monitor sigmas, and the whole of `calibrate` on synthetic fault-free runs."""

import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.comma2k19 import comma2k19_run
from datasets.demo import demo_scenario
from datasets.scenario import OdometerSpec
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from pipeline.studies.calibration.calibrate import Calibration, ObservedRun, calibrate, combine_runs, sigma_settings
from pipeline.studies.calibration.sigmas import regress_sigmas, sigma_table, worst_fit
from pipeline.studies.calibration.vehicle import RunEstimate
from schemas.config import CalibrationConfig, Configuration, MonitorConfig, Vehicle
from schemas.enums import Origin
from schemas.errors import InputError
from schemas.run import RunLog, Site

FACTOR = 5.0
CONFIG = CalibrationConfig()


def monitored(seed: int, intercept: float, slope: float, spread: float = 0.8) -> pl.DataFrame:
    """A run of one monitor whose values have sigma (intercept + slope s) / s of the predicted one."""
    rng = np.random.default_rng(seed)
    sigma = 1.0 + spread * rng.random(20_000)
    predicted = 0.3 * sigma
    value = rng.standard_normal(sigma.size) * predicted * (intercept + slope * sigma) / sigma
    frame = pl.DataFrame(
        {
            "sigma_along_m": sigma,
            "sigma_cross_m": sigma,
            "sigma_up_m": sigma,
            "along_raw_value": value,
            "along_raw_threshold": FACTOR * predicted,
            "along_raw_state": "pass",
        }
    )
    others = [name for name in ALL if name != "along_raw"]
    return frame.with_columns(
        *(pl.lit(None, pl.Float64).alias(f"{name}_{part}") for name in others for part in ("value", "threshold")),
        *(pl.lit("not_evaluated").alias(f"{name}_state") for name in others),
    )


ALL = [
    f"{axis}_{scale}" for axis in ("along", "cross", "up") for scale in ("raw", "ewma_0p1", "ewma_0p01", "ewma_0p001")
]


def test_intercept_and_slope_are_found() -> None:
    fits = regress_sigmas([monitored(seed, 0.4, 1.5) for seed in range(3)], FACTOR, CONFIG)
    assert [fit.monitor for fit in fits] == ["along_raw"]
    assert fits[0].intercept_m == pytest.approx(0.4, abs=4 * fits[0].intercept_error_m)
    assert fits[0].slope == pytest.approx(1.5, abs=4 * fits[0].slope_error)
    assert 0 < fits[0].slope_error < 0.1


def test_a_constant_sigma_gives_a_slope_alone() -> None:
    (fit,) = regress_sigmas([monitored(1, 0.0, 2.0, spread=0.0)], FACTOR, CONFIG)
    assert fit.intercept_m == 0.0
    assert fit.slope == pytest.approx(2.0, rel=0.02)


def test_fewer_pieces_left_out_change_the_standard_errors_alone() -> None:
    """A run in two halves a and b: the jackknife's error of their ratio is half the difference of the halves."""
    run = monitored(1, 0.0, 2.0, spread=0.0)
    halves = CalibrationConfig(left_out_pieces=2)
    (eight,), (two,) = (regress_sigmas([run], FACTOR, config) for config in (CONFIG, halves))
    assert (two.ratio, two.slope) == (eight.ratio, eight.slope)
    parts = [regress_sigmas([part], FACTOR, CONFIG)[0].ratio for part in (run[:10_000], run[10_000:])]
    assert two.ratio_error == pytest.approx(0.5 * abs(parts[0] - parts[1]), rel=1e-9)
    assert two.ratio_error != eight.ratio_error


def test_the_loudest_proven_monitor_decides() -> None:
    (fit,) = regress_sigmas([monitored(1, 0.0, 1.2)], FACTOR, CONFIG)
    lucky = type(fit)("up_raw", 100, 1.4, 0.5, 0.0, 0.0, 1.4, 0.5)
    assert worst_fit([lucky, fit]) is fit
    assert worst_fit([]) is None
    assert sigma_table([fit, lucky]).height == 2


@pytest.fixture(scope="module")
def fault_free() -> tuple[list[RunLog], Site]:
    scenario = demo_scenario()
    runs = tuple(scenario.runs[0].model_copy(update={"id": f"clean{k}"}) for k in range(2))
    scenario = scenario.model_copy(update={"runs": runs})
    return [build_run(scenario, run) for run in runs], build_site(scenario)


@pytest.fixture(scope="module")
def result(fault_free: tuple[list[RunLog], Site]) -> Calibration:
    return calibrate(*fault_free)


def test_calibration_finds_the_simulated_vehicle(result: Calibration) -> None:
    """The demonstration's vehicle: scale 1.0015, latency 50 ms; receiver and bank agree, so the slope is 1."""
    vehicle = result.vehicle
    assert vehicle.odometer_scale == pytest.approx(1.0015, abs=4 * (vehicle.odometer_scale_sigma or 0))
    assert vehicle.gnss_latency_s == pytest.approx(0.05, abs=4 * (vehicle.gnss_latency_sigma_s or 0))
    assert 0 < (vehicle.odometer_scale_sigma or 0) < 2e-4
    assert 0 < (vehicle.gnss_latency_sigma_s or 0) < 0.03
    assert result.runs["run_id"].to_list() == ["clean0", "clean1"]
    assert result.alarms == {}
    assert result.sigmas.height == 12
    assert result.monitors["sigma_slope"] == pytest.approx(1.0, abs=0.1)
    settings = tomllib.loads(result.monitors_toml())
    assert settings["monitors"]["sigma_slope"] == result.monitors["sigma_slope"]


def test_sigmas_of_an_earlier_calibration_do_not_count(
    fault_free: tuple[list[RunLog], Site], result: Calibration
) -> None:
    config = Configuration(monitors=MonitorConfig(sigma_intercept_m=0.5, sigma_slope=2.0, doppler_sigma_mps=0.3))
    again = calibrate(*fault_free, config=config)
    assert again.sigmas.equals(result.sigmas)
    assert again.monitors == result.monitors


def observed(run_id: str, noise_m: dict[str, tuple[float, ...]], alarms: tuple[str, ...] = ()) -> ObservedRun:
    return ObservedRun(run_id, RunEstimate(1.0, 1e-4, 0.0, 0.01, 100), noise_m, None, alarms)


def test_runs_that_failed_beyond_their_noise_are_named() -> None:
    runs = [observed("good", {}), observed("bad", {}, ("along_ewma_0p01",))]
    assert combine_runs(runs, Vehicle(), Configuration()).alarms == {"bad": ("along_ewma_0p01",)}


def test_the_loudest_run_counts_monitor_by_monitor_and_an_axis_unknown_to_all_stays_unset() -> None:
    one = observed("one", {"noise_along_m": (0.1, 0.1, 0.4, 0.4), "noise_cross_m": (0.0, 0.0, 0.0, 0.0)})
    other = observed("other", {"noise_along_m": (0.2, 0.3, 0.3, 0.3)})
    found = combine_runs([one, other], Vehicle(), Configuration())
    assert found.monitors == {"noise_along_m": (0.2, 0.3, 0.4, 0.4), "noise_cross_m": (0.0, 0.0, 0.0, 0.0)}


def test_quieter_than_predicted_is_believed_only_where_no_noise_explains_it() -> None:
    (fit,) = regress_sigmas([monitored(1, 0.0, 0.7, spread=0.0)], FACTOR, CONFIG)
    assert sigma_settings([fit], noisy=True) == {"sigma_intercept_m": 0.0, "sigma_slope": 1.0}
    assert sigma_settings([fit], noisy=False)["sigma_slope"] == pytest.approx(0.7, rel=0.02)


def test_a_noisy_odometer_shows_in_the_sigma_of_the_velocity(fault_free: tuple[list[RunLog], Site]) -> None:
    """0.2 m per root second, of which the bank expects 0.05, beside ten velocities of 0.03 m/s a second."""
    scenario, (_, site) = demo_scenario(), fault_free
    clean = scenario.runs[0]
    assert isinstance(clean.odometer, OdometerSpec)
    noisy = clean.model_copy(update={"odometer": clean.odometer.model_copy(update={"noise_m_per_root_s": 0.2})})
    log = build_run(scenario, noisy)
    result = calibrate([log], site)
    assert result.monitors["doppler_sigma_mps"] == pytest.approx(np.sqrt(0.2**2 - 0.05**2 + 0.03**2 / 10), rel=0.1)
    followed = MonitorConfig.model_validate(tomllib.loads(result.monitors_toml())["monitors"])
    alarms = [
        replay(log, site, result.vehicle, Configuration(monitors=monitors)).epochs["along_doppler_state"] == "fail"
        for monitors in (MonitorConfig(), followed)
    ]
    assert alarms[0].sum() > 0
    assert alarms[1].sum() == 0


def test_where_no_velocity_was_recorded_nothing_is_said_of_it(fault_free: tuple[list[RunLog], Site]) -> None:
    logs, site = fault_free
    nothing = pl.lit(None, pl.Float64)
    still = logs[0].gnss.with_columns(pl.col("^velocity_.*_mps$").cast(pl.Float64) * nothing)
    result = calibrate([logs[0].with_streams(gnss=still)], site)
    assert "doppler_sigma_mps" not in result.monitors
    assert "doppler_sigma_mps" not in result.monitors_toml()


def test_runs_without_odometer_are_refused(fault_free: tuple[list[RunLog], Site]) -> None:
    logs, site = fault_free
    with pytest.raises(InputError, match="no odometer that is declared to be free of the GNSS; found no odometer"):
        calibrate([logs[0].with_streams(odometer=None)], site)


@pytest.mark.parametrize(("origin", "said"), [(None, "declare where"), ("gnss", "record an odo")])
def test_runs_whose_odometer_may_be_made_of_the_positions_are_refused(
    fault_free: tuple[list[RunLog], Site], origin: str | None, said: str
) -> None:
    logs, site = fault_free
    assert logs[0].odometer is not None
    odometer = logs[0].odometer.with_columns(origin=pl.lit(origin, dtype=pl.Enum(Origin)))
    with pytest.raises(InputError, match=rf"free of the GNSS; found {origin or 'unknown'}.*{said}"):
        calibrate([logs[0].with_streams(odometer=odometer)], site)


def test_the_solution_is_the_one_named(fault_free: tuple[list[RunLog], Site], result: Calibration) -> None:
    logs, site = fault_free
    renamed = [log.with_streams(gnss=log.gnss.with_columns(solution=pl.lit("galileo"))) for log in logs]
    with pytest.raises(InputError, match="primary: no run has this solution; found galileo"):
        calibrate(renamed, site)
    assert calibrate(renamed, site, solution="galileo").vehicle == result.vehicle


def test_a_recorded_minute_gives_its_known_scale_and_no_latency() -> None:
    """comma2k19: wheels read 0.85 % short, by least squares against the pose. One minute alone tells no latency."""
    segment = Path(__file__).parents[4] / "shared" / "data" / "comma2k19" / "segment"
    if not segment.is_dir():
        pytest.skip("the shared recordings are not beside the repository")
    run, site = comma2k19_run(segment)
    vehicle = calibrate([run], site).vehicle
    assert vehicle.odometer_scale == pytest.approx(1.0085, abs=3 * (vehicle.odometer_scale_sigma or 0))
    assert 0 < (vehicle.odometer_scale_sigma or 0) < 0.005
    assert vehicle.gnss_latency_s is None
