"""Rare events on recorded noise: the bank against its own simulation, and what is taken from a result."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS, rare
from datasets.experiment.bank import BankSpec, bank_of_axis
from datasets.experiment.sampling import missed_detection_probability
from schemas.config import Configuration, MonitorConfig
from schemas.errors import UsageError
from schemas.monitors import SCALES

SPEC = BankSpec(alphas=(1.0, 0.1, 0.01), false_alarm_probability=1e-4)
R_M2, TAU_S, WHITE_M = np.array([0.2, 0.1, 0.0, 0.7]), np.array([360.0, 1800.0, 3600.0, 100.0]), 0.3


def test_monitors_and_misses_are_those_of_simulated_positions() -> None:
    """2,000 journeys of 1,200 s without a fault, then a ramp of 0.03 m/s for 120 s; thresholds are the bank's own."""
    made = bank_of_axis(SPEC, R_M2, TAU_S, WHITE_M)
    rng = np.random.default_rng(4)
    journeys, before, after, rate_mps = 2_000, 1_200, 120, 0.03
    phi = np.exp(-1.0 / TAU_S)[:, None]
    errors = np.sqrt(R_M2)[:, None] * rng.standard_normal((4, journeys))
    last_m = errors.sum(axis=0) + WHITE_M * rng.standard_normal(journeys)
    averages = np.zeros((3, journeys))
    alarm = np.zeros(journeys, dtype=bool)
    weights = np.array(SPEC.alphas)[:, None]
    scatter = []
    for second in range(before + after):
        fresh = np.sqrt(R_M2 * (1 - phi[:, 0] ** 2))[:, None] * rng.standard_normal((4, journeys))
        errors = phi * errors + fresh
        position_m = errors.sum(axis=0) + WHITE_M * rng.standard_normal(journeys)
        fault_mps = rate_mps if second >= before else 0.0
        rate = position_m - last_m + 0.05 * rng.standard_normal(journeys) + fault_mps
        last_m = position_m
        averages = weights * rate + (1 - weights) * averages
        if second == before - 1:
            scatter = averages.std(axis=1)
        if second >= before:
            alarm |= (np.abs(averages) > made.threshold[:, None]).any(axis=0)
    assert scatter == pytest.approx(made.sigma, rel=0.06)
    counted = 1.0 - alarm.mean()
    sampled = missed_detection_probability(made, after, rate_mps, runs=2_000).value
    assert 0.1 < counted < 0.9
    assert sampled == pytest.approx(counted, abs=4 * np.sqrt(counted * (1 - counted) / journeys))


def tables_of_a_result(faults: bool = False, white_m: float | None = 0.05) -> dict[str, pl.DataFrame]:
    """Two runs of three epochs; in the second epoch of each `along_raw` fails."""
    start = datetime(2026, 1, 1, tzinfo=UTC)
    runs = pl.DataFrame({
        "run_id": ["a", "b"], "solution": ["primary"] * 2, "status": ["ok", "ok"], "faults_injected": [faults] * 2,
        "gnss_rate_hz": [1.0, 1.0], "duration_s": [1800.0, 5400.0],
        "white_noise_along_m": pl.Series([white_m, white_m], dtype=pl.Float64),
    })  # fmt: skip
    epochs = pl.DataFrame({
        "run_id": ["a"] * 3 + ["b"] * 3, "solution": ["primary"] * 6,
        "t": [start + timedelta(seconds=k) for k in range(6)],
        "sigma_along_m": [1.0, 9.0, 2.0, 1.0, 9.0, 2.0], "alarm": [False, True, False] * 2,
        **{f"along_{scale}_value": [0.3, 5.0, -0.3] * 2 for scale in SCALES},
        **{f"along_{scale}_threshold": [1.0] * 6 for scale in SCALES},
        **{f"along_{scale}_state": ["pass", "fail", "pass"] * 2 for scale in SCALES},
    })  # fmt: skip
    return {"runs": runs, "epochs": epochs}


def given(monkeypatch: pytest.MonkeyPatch, tables: dict[str, pl.DataFrame]) -> None:
    monkeypatch.setattr(rare, "read_table", lambda _, name: tables[name].lazy())
    monkeypatch.setattr(rare, "read_config", lambda _: None)


def test_noise_is_that_of_epochs_without_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    """sigma 1 and 2 m; values of 0.3 thresholds are 0.3 x 5.3267 sigmas."""
    given(monkeypatch, tables_of_a_result())
    (noise,) = rare.recorded_noises(Path("out"))
    assert (noise.solution, noise.runs, noise.hours, noise.rate_hz) == ("primary", 2, 2.0, 1.0)
    assert (noise.sigma_m, noise.white_m) == (1.5, 0.05)
    assert noise.ratios == pytest.approx([0.3 * 5.3267] * 4, rel=1e-4)


@pytest.mark.parametrize("tables", [tables_of_a_result(faults=True), tables_of_a_result(white_m=None)])
def test_a_result_without_fault_free_noise_is_refused(monkeypatch: pytest.MonkeyPatch, tables: dict) -> None:  # type: ignore[type-arg]
    given(monkeypatch, tables)
    with pytest.raises(UsageError, match="has no run whose noise along the track is known"):
        rare.recorded_noises(Path("out"))


def test_only_the_rare_side_takes_recorded_noise(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="takes no recorded noise"):
        EXPERIMENTS["catalogue"](tmp_path, recorded=tmp_path)


def test_the_model_is_that_of_the_thresholds() -> None:
    """sigma 2 m, no white noise: variances are the shares of 4 m2, and the shares of the default add up to one."""
    noise = rare.RecordedNoise("primary", 1, 1.0, 1.0, 2.0, 0.0, (None,) * 4)

    bank = noise.bank(Configuration(), 1.0)
    config = MonitorConfig()
    shares = [config.ionosphere_share, config.troposphere_share, config.orbit_clock_share, config.user_share]
    assert np.diag(bank.covariance)[:4] == pytest.approx(4.0 * np.array(shares))
    assert bank.size == 4
