"""The least squares position against direct solutions, and protection levels against an independent engine."""

from __future__ import annotations

import numpy as np
import pytest
import sidereon

from datasets.solution import K_H_NPA, K_H_PA, design_rows, least_squares, protection_levels, solve_positions

PLACE = (np.radians(50.0), np.radians(14.0))


def sky(seed: int, satellites: int = 9) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    names = [f"{'G' if i < 6 else 'E'}{i + 1:02d}" for i in range(satellites)]
    return names, rng.uniform(0, 360, satellites), rng.uniform(5, 90, satellites), rng.uniform(0.5, 4, satellites)


def sidereon_levels(
    names: list[str], azimuth: np.ndarray, elevation: np.ndarray, sigma: np.ndarray, k: sidereon.SbasKMultipliers
) -> tuple[float, float]:
    latitude, longitude = PLACE
    enu = np.array(
        [
            [-np.sin(longitude), np.cos(longitude), 0.0],
            [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)],
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)],
        ]
    )
    e, a = np.radians(elevation), np.radians(azimuth)
    sight = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=-1) @ enu
    rows = [sidereon.ProtectionRow(sv, sight[i], float(e[i])) for i, sv in enumerate(names)]
    systems = [sidereon.GnssSystem.GPS, sidereon.GnssSystem.GALILEO]
    present = [s for s, letter in zip(systems, "GE", strict=True) if any(sv[0] == letter for sv in names)]
    geometry = sidereon.ProtectionGeometry(rows, sidereon.Wgs84Geodetic(latitude, longitude, 0.0), present)
    errors = [sidereon.SbasSisError(sv, float(sigma[i]), 0.0, 0.0, 0.0) for i, sv in enumerate(names)]
    found = sidereon.sbas_protection_levels(geometry, sidereon.SbasErrorModel(errors), k)
    return found.hpl_m, found.vpl_m


@pytest.mark.parametrize("satellites", [5, 6, 8, 12])
def test_protection_levels_agree_with_an_independent_engine(satellites: int) -> None:
    for seed in range(25):
        names, azimuth, elevation, sigma = sky(seed, satellites)
        covariance, _ = least_squares(design_rows(names, azimuth, elevation), sigma)
        ours = protection_levels(covariance)
        for hpl, k in (
            (ours.hpl_pa_m, sidereon.SbasKMultipliers.precision_approach()),
            (ours.hpl_npa_m, sidereon.SbasKMultipliers.en_route_npa()),
        ):
            theirs = sidereon_levels(names, azimuth, elevation, sigma, k)
            assert (float(hpl), float(ours.vpl_m)) == pytest.approx(theirs, rel=1e-9)


def test_protection_levels_by_hand() -> None:
    # Axes 3 and 4 m turned by 45 degrees: major axis 4 m whatever the frame.
    turn = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([9.0, 16.0]) @ turn.T
    covariance[2, 2] = 4.0
    levels = protection_levels(covariance)
    assert (levels.hpl_pa_m, levels.hpl_npa_m) == pytest.approx((4 * K_H_PA, 4 * K_H_NPA))
    assert levels.vpl_m == pytest.approx(2 * 5.33)


def test_solution_is_the_weighted_least_squares() -> None:
    names, azimuth, elevation, sigma = sky(3)
    error = np.random.default_rng(9).normal(size=9) * sigma
    every = np.ones((1, 9), dtype=bool)
    found = solve_positions(names, azimuth[None], elevation[None], sigma[None], error[None], every, every)
    design = design_rows(names, azimuth, elevation)
    state, *_ = np.linalg.lstsq(design / sigma[:, None], error / sigma, rcond=None)
    assert found.error_m[0] == pytest.approx(state[:3], abs=1e-10)
    assert found.residual_m[0] == pytest.approx(error - design @ state, abs=1e-10)
    # The residuals are orthogonal to the design in the metric of the weights.
    assert design.T @ (found.residual_m[0] / sigma**2) == pytest.approx(np.zeros(5), abs=1e-10)


def test_a_moved_receiver_leaves_no_residual() -> None:
    names, azimuth, elevation, sigma = sky(4)
    moved = design_rows(names, azimuth, elevation) @ np.array([3.0, -2.0, 1.0, 7.0, -4.0])
    every = np.ones((1, 9), dtype=bool)
    found = solve_positions(names, azimuth[None], elevation[None], sigma[None], moved[None], every, every)
    assert found.error_m[0] == pytest.approx([3.0, -2.0, 1.0], abs=1e-9)
    assert np.abs(found.residual_m).max() < 1e-9


def test_empirical_covariance_is_the_stated_one() -> None:
    names, azimuth, elevation, sigma = sky(5)
    epochs = 20000
    error = np.random.default_rng(6).normal(size=(epochs, 9)) * sigma
    every = np.ones((epochs, 9), dtype=bool)
    wide = [np.broadcast_to(values, (epochs, 9)) for values in (azimuth, elevation, sigma)]
    found = solve_positions(names, *wide, error, every, every)
    assert np.cov(found.error_m.T) == pytest.approx(found.covariance_m2[0], rel=0.1, abs=0.05)


def test_too_few_satellites_give_no_position_and_unused_ones_a_residual() -> None:
    names, azimuth, elevation, sigma = sky(6)
    usable = np.ones((2, 9), dtype=bool)
    usable[0, 3:] = False
    usable[1, 0] = False
    wide = [np.broadcast_to(values, (2, 9)) for values in (azimuth, elevation, sigma)]
    found = solve_positions(names, *wide, np.ones((2, 9)), usable, np.ones((2, 9), dtype=bool))
    assert found.solved.tolist() == [False, True]
    assert not found.used[0].any()
    assert np.isfinite(found.residual_m[1]).all()
