"""`balise replay --calibrate`: vehicle and noise of each run from other runs, never from itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from typer.testing import CliRunner

from cli import app
from datasets.trial import write_run_log, write_site
from pipeline.campaign import Plan, make_plan, run_campaign
from pipeline.campaign import calibrated as calibrated_module
from pipeline.campaign.calibrated import calibrate_plan
from pipeline.campaign.plan import RunJob
from pipeline.results.workers import map_in_processes
from schemas.config import Vehicle
from schemas.errors import UsageError
from tests.campaign.compare import campaign_bytes, result_bytes
from tests.conftest import Shared
from tests.replay.slip.world import BALISES, Fault, ride, site

NOISY = [f"ride{seed}" for seed in (1, 2, 3)]


@pytest.fixture(scope="session")
def trial(shared: Shared) -> Path:
    """Three rides whose positions have 30 cm of white noise that the receiver does not state, and a faulty one."""

    def fill(folder: Path) -> None:
        write_site(site(), folder / "site")
        for seed in (1, 2, 3):
            write_run_log(ride(white_m=0.3, seed=seed, scale=1.002), folder / "runs")
        write_run_log(ride(None, Fault(200.0, 40.0), white_m=0.3, seed=4, scale=1.002), folder / "faulty")
        write_run_log(ride(white_m=0.3, seed=5, scale=1.03), folder / "other")

    return shared("calibrated-trial", fill)


def plan_of(trial: Path, out: Path, *folders: str, names: Sequence[str] = ()) -> Plan:
    runs = [str(trial / folder) for folder in folders] + [str(trial / "runs" / name) for name in names]
    return make_plan(runs, trial / "site", out)


def auto(plan: Plan) -> Plan:
    return calibrate_plan(plan, ["auto"])


_RESULTS: dict[str, Any] = {}


@pytest.fixture
def remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run tells the same whoever asks, and telling takes seconds."""

    def each_once(function: Callable[[RunJob], Any], tasks: Sequence[RunJob], jobs: int) -> list[Any]:
        return [_RESULTS.setdefault(task.address, _RESULTS.get(task.address) or function(task)) for task in tasks]

    monkeypatch.setattr(calibrated_module, "map_in_processes", each_once)


@pytest.mark.usefixtures("in_process", "remembered")
class TestAuto:
    def test_a_run_never_calibrates_itself_and_the_tables_say_who_did(self, trial: Path, tmp_path: Path) -> None:
        plan = auto(plan_of(trial, tmp_path, "runs"))
        by_run = {job.run_id: list(job.config.calibration.runs) for job in plan.jobs}
        assert by_run == {name: [other for other in NOISY if other != name] for name in NOISY}
        assert len({job.config_digest for job in plan.jobs}) == 3
        run_campaign(plan)
        table = pl.read_parquet(tmp_path / "campaign" / "runs.parquet")
        assert dict(table.select("run_id", "calibrated_by").rows()) == by_run
        assert table["vehicle"].to_list() == ["file"] * 3
        assert table["balises_accepted"].to_list() == [len(BALISES)] * 3
        assert table["config_digest"].to_list() == [job.config_digest for job in plan.jobs]

    def test_scale_and_noise_are_what_the_runs_were_made_with(self, trial: Path, tmp_path: Path) -> None:
        for job in auto(plan_of(trial, tmp_path, "runs")).jobs:
            assert job.vehicle.odometer_scale == pytest.approx(1.002, abs=5e-4)
            monitors = job.config.monitors
            assert (monitors.sigma_intercept_m, monitors.sigma_slope) == (0.0, 1.0)
            # White noise is taken for 1.5 times its variance; the loudest of two short runs.
            for noise_m in (monitors.noise_along_m, monitors.noise_cross_m, monitors.noise_up_m):
                assert noise_m is not None
                assert 0.3 * 1.5**0.5 < noise_m[0] < 0.5
                assert noise_m == tuple(sorted(noise_m))

    def test_same_bytes_in_any_order_and_a_second_call_has_nothing_to_do(
        self, trial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        run_campaign(auto(plan_of(trial, tmp_path / "one", "runs")))
        with monkeypatch.context() as measured_again:
            measured_again.setattr(calibrated_module, "map_in_processes", map_in_processes)
            run_campaign(auto(plan_of(trial, tmp_path / "other", names=NOISY[::-1])))
        assert result_bytes(tmp_path / "one") == result_bytes(tmp_path / "other")
        assert campaign_bytes(tmp_path / "one") == campaign_bytes(tmp_path / "other")
        again = run_campaign(auto(plan_of(trial, tmp_path / "one", "runs")))
        assert all(outcome.skipped for outcome in again.outcomes)

    def test_a_run_with_an_alarm_beyond_noise_is_replayed_and_calibrates_nobody(
        self, trial: Path, tmp_path: Path
    ) -> None:
        plan = auto(plan_of(trial, tmp_path, "runs", "faulty"))
        by_run = {job.run_id: set(job.config.calibration.runs) for job in plan.jobs}
        assert by_run["ride4"] == set(NOISY)
        assert not any("ride4" in runs for runs in by_run.values())

    def test_too_few_runs(self, trial: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="too few other fault-free runs to calibrate ride1") as error:
            auto(plan_of(trial, tmp_path, "faulty", names=NOISY[:2]))
        assert "ride4: alarms beyond its noise (along_" in str(error.value)
        assert "calibration.least_runs" in str(error.value)

    def test_runs_of_different_vehicles(self, trial: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="different vehicles") as error:
            auto(plan_of(trial, tmp_path, "runs", "other"))
        assert "1.03" in str(error.value)
        assert "ride5" in str(error.value)


@pytest.mark.usefixtures("in_process", "remembered")
class TestGivenRuns:
    def test_they_calibrate_all_runs_but_themselves(self, trial: Path, tmp_path: Path) -> None:
        plan = calibrate_plan(plan_of(trial, tmp_path, "faulty"), [str(trial / "runs")])
        (job,) = plan.jobs
        assert list(job.config.calibration.runs) == NOISY
        assert (plan.config, plan.vehicle) == (job.config, job.vehicle)
        both = calibrate_plan(plan_of(trial, tmp_path, "faulty", names=["ride1"]), [str(trial / "runs")])
        assert [list(job.config.calibration.runs) for job in both.jobs] == [NOISY[1:], NOISY]

    def test_what_the_vehicle_file_says_beside_scale_and_latency_stays(self, trial: Path, tmp_path: Path) -> None:
        vehicle = Vehicle(antenna_height_m=3.9, odometer_scale=0.9)
        plan = make_plan([str(trial / "faulty")], trial / "site", tmp_path, vehicle=vehicle)
        (job,) = calibrate_plan(plan, [str(trial / "runs")]).jobs
        assert job.vehicle.antenna_height_m == 3.9
        assert job.vehicle.odometer_scale == pytest.approx(1.002, abs=5e-4)

    def test_a_faulty_run_is_refused(self, trial: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="cannot calibrate") as error:
            calibrate_plan(plan_of(trial, tmp_path, "runs"), [str(trial / "runs"), str(trial / "faulty")])
        assert "ride4: alarms beyond its noise" in str(error.value)

    def test_no_such_run(self, trial: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="no such run"):
            calibrate_plan(plan_of(trial, tmp_path, "runs"), [str(trial / "nowhere")])


@pytest.mark.usefixtures("in_process", "remembered")
def test_the_command(trial: Path, tmp_path: Path) -> None:
    given = ["replay", str(trial / "runs"), "--site", str(trial / "site"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*given, "--calibrate", "auto", "--quiet"])
    assert done.exit_code == 0, done.output
    few = CliRunner().invoke(app, [*given[:1], str(trial / "faulty"), *given[2:], "--calibrate", "auto", "--quiet"])
    assert isinstance(few.exception, UsageError) or few.exit_code == 2
