"""The lag of a recorder by what it saw between its stamps: a train whose ways are known, its recorder seconds late."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.stages.evidence.clock import lag_of
from schemas.arrays import NS_PER_S, Floats, Ints


def distance_m(t_s: Floats) -> Floats:
    """Every minute: 30 s speeding up by 1 m/s2, 30 s slowing down; 900 m."""
    minute, second = np.divmod(t_s, 60.0)
    return 900.0 * minute + np.where(second < 30.0, 0.5 * second**2, 900.0 - 0.5 * (60.0 - second) ** 2)


def speed_mps(t_s: Floats) -> Floats:
    return 30.0 - np.abs(t_s % 60.0 - 30.0)


def odometer() -> Any:
    """Exact, and without an end."""
    return SimpleNamespace(
        odometer=SimpleNamespace(deadband_mps=0.1),
        distance_m=lambda begin_ns, end_ns: distance_m(end_ns / NS_PER_S) - distance_m(begin_ns / NS_PER_S),
        speed_mps=lambda t_ns: speed_mps(t_ns / NS_PER_S),
    )


def recorded(ways: int, late_s: float) -> tuple[Ints, Ints, Floats]:
    """Stamps 20 s apart, each `late_s` after the moment; what was driven in between."""
    t_s = 600.0 + 20.0 * np.arange(ways + 1)
    stamps = np.round((t_s + late_s) * NS_PER_S).astype(np.int64)
    return stamps[:-1], stamps[1:], np.diff(distance_m(t_s))


@pytest.mark.parametrize(
    ("ways", "late_s", "known"),
    [
        (6, 0.2, True),
        (5, 0.2, False),  # too few
        (12, 0.2, True),
        (12, 8.0, True),
        (12, -8.0, True),
        (11, 8.0, False),  # too few for a lag of seconds
        (60, 29.5, True),
    ],
)
def test_a_lag_is_known_from_six_ways_and_one_of_seconds_from_twelve(ways: int, late_s: float, known: bool) -> None:
    found = lag_of(*recorded(ways, late_s), cast(Any, odometer()))
    assert np.isfinite(found.sigma_s) == known
    assert found.lag_s == pytest.approx(late_s if known else 0.0, abs=0.01)
