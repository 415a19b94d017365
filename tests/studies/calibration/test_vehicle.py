"""Scale and latency against known truth, with honest uncertainty; pooling worked by hand."""

from functools import lru_cache

import numpy as np
import pytest

from pipeline.stages.monitors.axis import error_model
from pipeline.stages.odometry.odometry import Odometry
from pipeline.studies.calibration.vehicle import RunEstimate, estimate_run, pooled
from schemas.arrays import Floats
from schemas.config import MonitorConfig
from tests.stages.alignment.straight import odometer_of, odometry_from

SHARES, TAUS_S = error_model(MonitorConfig())
SCALE, LATENCY_S, SIGMA_M = 1.004, 0.12, 1.2


@lru_cache(maxsize=32)
def simulated_run(seed: int, duration_s: int = 1000, moving: bool = True) -> tuple[Floats, Floats, Odometry]:
    """A train that speeds up and brakes between 5 and 45 m/s; odometer at 10 Hz, positions at 2 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s, 0.1)
    speed = 25.0 + 20.0 * np.sin(2 * np.pi * t / 240.0) if moving else np.full(t.size, 25.0)
    true = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * 0.1)])
    walk = np.cumsum(rng.normal(0.0, 0.05 * np.sqrt(0.1), t.size))
    at = np.arange(20.0, duration_s - 20.0, 0.5)
    error = np.zeros(at.size)
    for share, tau in zip(SHARES, TAUS_S, strict=True):
        phi = np.exp(-0.5 / tau)
        noise = rng.standard_normal(at.size)
        unit = np.empty(at.size)
        unit[0] = noise[0]
        for k in range(1, at.size):
            unit[k] = phi * unit[k - 1] + np.sqrt(1 - phi**2) * noise[k]
        error += np.sqrt(share) * SIGMA_M * unit
    position = np.interp(at - LATENCY_S, t, true) + error + 500.0
    return at, position, odometry_from(odometer_of(t, distance_m=true / SCALE + walk))


def test_truth_lies_within_the_stated_uncertainty() -> None:
    """12 runs: standardised errors have mean 0 and no more than their spread."""
    results = [estimate_run(*simulated_run(seed)) for seed in range(12)]
    found = [one for one in results if one is not None]
    assert len(found) == 12
    for standardised in standardised_errors(found):
        assert abs(standardised.mean()) < 3.0 / np.sqrt(12)
        assert 0.4 < standardised.std() < 1.5
    assert all((one.latency_sigma_s or 1.0) < 0.03 and one.scale_sigma < 3e-4 for one in found)


def standardised_errors(found: list[RunEstimate]) -> tuple[Floats, Floats]:
    """Of scale and latency, in their own sigmas."""
    scale = np.array([(one.scale - SCALE) / one.scale_sigma for one in found])
    latency = [(one.latency_s or 0.0, one.latency_sigma_s or 1e-9) for one in found]
    return scale, np.array([(at_s - LATENCY_S) / sigma_s for at_s, sigma_s in latency])


def test_constant_speed_tells_no_latency() -> None:
    for seed in range(3):
        one = estimate_run(*simulated_run(seed, 420, moving=False))
        assert one is not None
        assert one.latency_s is None
        assert abs(one.scale - SCALE) < 4.0 * one.scale_sigma


def test_lost_distance_joins_no_way() -> None:
    t_s, path_m, track = simulated_run(5)
    broken = odometry_from(odometer_of(track.t_s, distance_m=track.distance_m + 300.0 * (track.t_s >= 700.0)))
    whole, parts = (estimate_run(t_s, path_m, one) for one in (track, broken))
    assert whole is not None
    assert parts is not None
    assert parts.scale == pytest.approx(whole.scale, abs=4 * whole.scale_sigma)
    assert parts.points == whole.points


def test_too_little_data_gives_nothing() -> None:
    t_s, path_m, track = simulated_run(6, duration_s=60)
    assert estimate_run(t_s[:10], path_m[:10], track) is None
    assert estimate_run(t_s[:0], path_m[:0], track) is None


def test_pooling_by_hand() -> None:
    """Equal sigmas, runs that agree: the mean with sigma / sqrt(n). Runs that differ: their scatter stays."""
    agree = pooled(np.array([1.0, 1.0, 1.0, 1.0]), np.full(4, 0.2))
    assert [agree.value, agree.sigma] == pytest.approx([1.0, 0.1])
    # Two runs at -1 and 1 with sigma 0.1: between = (Q - 1) / (sum w - sum w^2 / sum w) = (200 - 1) / 100.
    differ = pooled(np.array([-1.0, 1.0]), np.full(2, 0.1))
    assert differ.value == pytest.approx(0.0)
    assert differ.sigma == pytest.approx(np.sqrt((0.01 + 1.99) / 2.0 + 1.99))
    alone = pooled(np.array([3.0]), np.array([0.4]))
    assert [alone.value, alone.sigma] == pytest.approx([3.0, 0.4])


def with_rows(track: Odometry, kind: str, size_m: float, seed: int) -> Odometry:
    """The track by counts of this size, or with noise of it in every row."""
    noise = np.random.default_rng(seed).normal(0.0, size_m, track.t_s.size)
    rows = np.floor(track.distance_m / size_m) * size_m if kind == "counts" else track.distance_m + noise
    return odometry_from(odometer_of(track.t_s, distance_m=rows))


ROWS = [("counts", 2.0), ("noise", 0.5)]


@pytest.mark.parametrize(("kind", "size_m"), ROWS)
def test_rows_that_scatter_make_nothing_surer_than_it_is(kind: str, size_m: float) -> None:
    runs = [simulated_run(seed, 600) for seed in range(8)]
    results = [estimate_run(t_s, path_m, with_rows(track, kind, size_m, 50)) for t_s, path_m, track in runs]
    found = [one for one in results if one is not None]
    assert len(found) == 8
    for standardised in standardised_errors(found):
        assert np.sqrt(np.mean(standardised**2)) < 1.5
    assert all((one.latency_sigma_s or 1.0) < 0.1 and one.scale_sigma < 1e-3 for one in found)


@pytest.mark.parametrize(("kind", "size_m"), ROWS)
def test_rows_that_scatter_tell_no_latency_at_constant_speed(kind: str, size_m: float) -> None:
    for seed in range(2):
        t_s, path_m, track = simulated_run(seed, 420, moving=False)
        one = estimate_run(t_s, path_m, with_rows(track, kind, size_m, seed))
        assert one is not None
        assert one.latency_s is None
        assert abs(one.scale - SCALE) < 4.0 * one.scale_sigma


def test_counts_as_coarse_as_its_changes_of_speed_tell_no_latency() -> None:
    """5 m at 10 Hz: a change of 5 m/s in 10 s cannot be distinguished from the rhythm of the counts; the scale is."""
    t_s, path_m, track = simulated_run(0, 600)
    one = estimate_run(t_s, path_m, with_rows(track, "counts", 5.0, 50))
    assert one is not None
    assert one.latency_s is None
    assert abs(one.scale - SCALE) < 4.0 * one.scale_sigma
