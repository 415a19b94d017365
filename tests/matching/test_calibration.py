"""Are the claimed probabilities right? Parallel tracks 4 m apart, errors that last for minutes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.matching import match
from pipeline.odometry import odometry_of
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from tests.matching.ladder import journey, ladder, matched_lateral_m

SITE = ladder()


def claims(seeds: range, sigma_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per seed and epoch: posterior, causal probability, and whether the matched track is the true one."""
    posterior, gate, right = [], [], []
    for seed in seeds:
        trip = journey(seed, sigma_m)
        epochs = match(
            trip.fixes,
            odometry_of(trip.odometer, Vehicle(), Configuration()),
            SITE,
            Vehicle(),
            MatchingConfig(),
            FixSigma(),
        ).epochs
        posterior.append(epochs["path_probability"].to_numpy())
        gate.append(epochs["gate_probability"].to_numpy())
        right.append(np.abs(matched_lateral_m(epochs) - trip.lateral_m) < 1.0)
    return np.array(posterior), np.array(gate), np.array(right)


def test_no_run_claims_a_wrong_track() -> None:
    """At 1 m position noise no seed is wrong above 0.99 for more than 1 % of its epochs."""
    posterior, gate, right = claims(range(60), 1.0)
    assert ((posterior > 0.99) & ~right).mean(axis=1).max() <= 0.01
    assert ((gate > 0.99) & ~right).mean(axis=1).max() <= 0.01
    assert right.mean() > 0.98


@pytest.mark.slow
def test_claims_come_true_as_often_as_they_say() -> None:
    """At 2 m the tracks are hard to tell apart; within a run the claim hardly changes, so runs are counted."""
    posterior, _, right = claims(range(400), 2.0)
    claim, share = posterior.mean(axis=1), right.mean(axis=1)
    assert claim.mean() == pytest.approx(share.mean(), abs=0.02)
    for low, high in ((0.5, 0.7), (0.7, 0.85), (0.85, 0.95), (0.95, 0.99), (0.99, 1.01)):
        inside = (claim >= low) & (claim < high)
        count, expected = int(inside.sum()), float(claim[inside].mean())
        spread = np.sqrt(expected * (1.0 - expected) / count)
        assert count >= 15, (low, high)
        assert share[inside].mean() == pytest.approx(expected, abs=2.5 * spread + 0.005), (low, high)
