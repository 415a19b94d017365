"""Expectation windows against hand-worked and published numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.stages.lds.crossings import expectation_window, minimal_spacing_m, window_after_turn
from schemas.config import LdsConfig

CONFIG = LdsConfig()


@pytest.mark.parametrize(
    ("distance_m", "accuracy_m", "open_m", "close_m"),
    [
        (400.0, 12.0, 371.0 / 1.05, 429.0 / 0.95),
        (400.0, 5.0, 385.0 / 1.05, 415.0 / 0.95),
        (2500.0, 12.0, 2471.0 / 1.05, 2529.0 / 0.95),
        (20.0, 12.0, -9.0 / 1.05, 49.0 / 0.95),
    ],
)
def test_window_is_not_symmetric_about_the_announced_distance(
    distance_m: float, accuracy_m: float, open_m: float, close_m: float
) -> None:
    window = expectation_window(distance_m, accuracy_m, accuracy_m, CONFIG)
    assert window.open_m == pytest.approx(open_m, abs=1e-9)
    assert window.close_m == pytest.approx(close_m, abs=1e-9)


@pytest.mark.parametrize(
    ("distance_m", "with_5_m", "with_12_m"),
    [(400.0, 73.7, 103.2), (1000.0, 136.8, 166.3), (2500.0, 294.7, 324.2)],
)
def test_minimal_spacing_for_disjoint_windows(distance_m: float, with_5_m: float, with_12_m: float) -> None:
    assert minimal_spacing_m(distance_m, 5.0, 5.0, 5.0, CONFIG) == pytest.approx(with_5_m, abs=0.05)
    assert minimal_spacing_m(distance_m, 12.0, 12.0, 12.0, CONFIG) == pytest.approx(with_12_m, abs=0.05)


@given(
    distance_m=st.floats(0, 3000),
    accuracy_m=st.floats(0, 63),
    reference_m=st.floats(0, 63),
    reading=st.floats(-1, 1),
)
def test_window_holds_every_reading_within_the_odometer_s_accuracy(
    distance_m: float, accuracy_m: float, reference_m: float, reading: float
) -> None:
    # The true way lies within the two location accuracies; the reading d is true to 5 m + 5 % of d.
    chainage_m = distance_m + reading * (accuracy_m + reference_m)
    for odometer_m in ((chainage_m + 5.0) / 0.95, (chainage_m - 5.0) / 1.05):
        window = expectation_window(distance_m, accuracy_m, reference_m, CONFIG)
        assert window.open_m - 1e-9 <= odometer_m <= window.close_m + 1e-9


@given(distance_m=st.floats(50, 3000), own_m=st.floats(0, 63), next_m=st.floats(0, 63), reference_m=st.floats(0, 63))
def test_minimal_spacing_makes_the_next_window_open_where_this_one_closes(
    distance_m: float, own_m: float, next_m: float, reference_m: float
) -> None:
    spacing_m = minimal_spacing_m(distance_m, own_m, next_m, reference_m, CONFIG)
    close_m = expectation_window(distance_m, own_m, reference_m, CONFIG).close_m
    next_open_m = expectation_window(distance_m + spacing_m, next_m, reference_m, CONFIG).open_m
    assert next_open_m == pytest.approx(close_m, abs=1e-6)


def test_after_a_turn_the_whole_way_run_counts() -> None:
    # 100 m out and back: 5 % of 200 m, 29 m margin: (29 + 10) / 0.95 either side.
    window = window_after_turn(0.0, 200.0, 29.0, CONFIG)
    assert window == pytest.approx((-39.0 / 0.95, 39.0 / 0.95), abs=1e-9)
