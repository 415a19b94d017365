"""Journeys: hand-worked stops, and distance, speed and time that agree with one another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.motion import MotionSpec, build_motion
from schemas.errors import ConfigError


def motion(*phases: dict[str, float], **settings: object):  # type: ignore[no-untyped-def]
    return build_motion(MotionSpec.model_validate({"start_m": 100.0, "stand_s": 2.0, "phases": phases, **settings}))


def test_hand_worked_journey() -> None:
    # 2 s stand; 0 to 20 m/s at 0.5 in 40 s over 400 m; 600 m in 30 s; 20 to 0 at 1.0 in 20 s over 200 m.
    journey = motion({"speed_mps": 20.0}, {"stop_at_m": 1300.0, "acceleration_mps2": 1.0, "hold_s": 8.0})
    assert journey.duration_s == pytest.approx(2 + 40 + 30 + 20 + 8)
    times = np.array([0.0, 2.0, 22.0, 42.0, 72.0, 82.0, 92.0, 100.0, 500.0])
    assert journey.chainage_m(times) == pytest.approx([100, 100, 200, 500, 1100, 1250, 1300, 1300, 1300])
    assert journey.speed_mps(times) == pytest.approx([0, 0, 10, 20, 20, 10, 0, 0, 0], abs=1e-12)


def test_holds_by_way_and_by_time() -> None:
    by_way = motion({"speed_mps": 10.0, "hold_m": 250.0})
    by_time = motion({"speed_mps": 10.0, "hold_s": 25.0})
    assert by_way.duration_s == by_time.duration_s == pytest.approx(2 + 20 + 25)


def test_the_other_direction_and_reversal() -> None:
    journey = motion(
        {"speed_mps": 10.0, "hold_m": 400.0},
        {"speed_mps": 0.0, "hold_s": 3.0},
        {"speed_mps": -5.0, "hold_m": 50.0},
        {"speed_mps": 0.0},
        start_m=1000.0,
        direction="falling",
    )
    # 100 m to speed, 400 m hold, 100 m to stand; 25 m, 50 m and 25 m back.
    assert journey.chainage_m(np.array([journey.duration_s]))[0] == pytest.approx(1000.0 - 600.0 + 100.0)
    assert journey.time_at(950.0) == pytest.approx(2.0 + np.sqrt(2 * 50 / 0.5), abs=1e-3)


def test_a_stop_that_cannot_be_made_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot stop"):
        motion({"speed_mps": 30.0}, {"stop_at_m": 1010.0})
    with pytest.raises(ConfigError, match="does not run"):
        motion({"speed_mps": 10.0}).time_at(5000.0)


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "speed_mps": st.floats(-40, 40),
                "acceleration_mps2": st.floats(0.1, 1.5),
                "hold_s": st.floats(0, 100),
            }
        ),
        min_size=1,
        max_size=6,
    )
)
def test_speed_is_the_slope_of_distance(phases: list[dict[str, float]]) -> None:
    journey = motion(*phases)
    t = np.linspace(0.0, journey.duration_s, 2000)
    distance, speed = journey.distance_m(t), journey.speed_mps(t)
    middle = 0.5 * (speed[1:] + speed[:-1])
    step = t[1] - t[0]
    # The trapezoid errs only in the cell where the acceleration changes, by less than a * step^2.
    assert np.abs(np.diff(distance) - middle * step).max() <= 3.0 * step**2 + 1e-9
