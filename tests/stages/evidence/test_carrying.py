"""Between two anchors, worked out by hand: 100 m apart, where the odometer counts 10.2 m each second for 10 s."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.stages.evidence.carrying import TrueAnchor, carry_between_anchors, odometer_closes
from pipeline.stages.evidence.gaps import Gap
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Ints
from schemas.config import Configuration
from schemas.enums import Evidence
from tests.stages.alignment.straight import odometer_of, odometry_from

CONFIG = Configuration()
ANCHORS = tuple(
    TrueAnchor(t_s * NS_PER_S, (Place(0, 10.0 * t_s),), sigma_m, Evidence.BALISE)
    for t_s, sigma_m in ((0, 1.0), (10, 2.0))
)
AT_4_S = np.array([4 * NS_PER_S])


def odometer(scale: float | None) -> Any:
    """10.2 m and 0.01 m2 of variance in a second."""

    def between(begin_ns: Ints, end_ns: Ints) -> SimpleNamespace:
        way_s = (end_ns - begin_ns) / NS_PER_S
        return SimpleNamespace(distance_m=10.2 * way_s, variance_m2=0.01 * np.abs(way_s), bound_m=np.zeros(way_s.shape))

    def driven_m(begin_ns: Ints, end_ns: Ints) -> Any:
        return 10.2 * np.abs(end_ns - begin_ns) / NS_PER_S

    return SimpleNamespace(has_known_scale=scale is not None, distance_and_variance=between, driven_between_m=driven_m)


def test_a_gap_has_the_anchors_that_there_are() -> None:
    begin, end = ANCHORS
    for given in ((begin, end), (None, end), (begin, None)):
        gap = Gap(0, 10 * NS_PER_S, *given, routes=[])
        assert gap.anchors == [anchor for anchor in given if anchor]


def test_without_a_vehicle_file_both_anchors_may_be_right() -> None:
    """From the first 40.8 m with variance 1.04, from the second 38.8 m with variance 4.06; three sigmas."""
    low, high = carry_between_anchors(odometer(None), cast(Any, ANCHORS), (0.0, 100.0), AT_4_S, CONFIG)
    assert (low[0], high[0]) == (pytest.approx(38.8 - 6.0448, abs=1e-4), pytest.approx(38.8 + 6.0448, abs=1e-4))


def test_the_hull_is_that_of_both_anchors() -> None:
    """After 1 s the first anchor reaches less far back, after 9 s the second less far ahead."""
    at_ns = np.array([NS_PER_S, 9 * NS_PER_S])
    low, high = carry_between_anchors(odometer(None), cast(Any, ANCHORS), (0.0, 130.0), at_ns, CONFIG)
    assert low == pytest.approx([10.2 - 3.0150, 91.8 - 3.1321], abs=1e-4)
    assert high == pytest.approx([38.2 + 6.0671, 119.8 + 6.0075], abs=1e-4)


def test_where_a_known_odometer_closes_the_better_anchor_weighs_more() -> None:
    """40.3922 m with variance 1 / (1 / 1.04 + 1 / 4.06); the closing error of 2 m may have been lost at one place."""
    low, high = carry_between_anchors(odometer(1.0), cast(Any, ANCHORS), (0.0, 100.0), AT_4_S, CONFIG)
    assert (low[0], high[0]) == (pytest.approx(40.3922 - 4.7297, abs=1e-4), pytest.approx(40.3922 + 4.7297, abs=1e-4))


def test_a_clock_widens_by_the_weights_of_the_anchors() -> None:
    """The first weighs 4.06 / 5.1: 0.7961 of its 2 m; as a hull each has its own."""
    late = (replace(ANCHORS[0], clock_m=2.0), ANCHORS[1])
    low, high = carry_between_anchors(odometer(1.0), cast(Any, late), (0.0, 100.0), AT_4_S, CONFIG)
    assert high[0] - low[0] == pytest.approx(2.0 * (4.7297 + 1.5922), abs=1e-3)
    low, high = carry_between_anchors(odometer(None), cast(Any, late), (0.0, 100.0), AT_4_S, CONFIG)
    assert (low[0], high[0]) == (pytest.approx(38.8 - 6.0448, abs=1e-4), pytest.approx(40.8 + 5.0594, abs=1e-4))


@pytest.mark.parametrize(("apart_m", "closed"), [(91.91, True), (91.89, False)])
def test_without_a_vehicle_file_a_way_closes_within_five_metres_and_five_percent(apart_m: float, closed: bool) -> None:
    """102 m are counted: 10.1 m."""
    assert odometer_closes(odometer(None), cast(Any, ANCHORS), apart_m, CONFIG) is closed


@pytest.mark.parametrize(("apart_m", "closed"), [(95.23, True), (95.22, False), (108.77, True), (108.78, False)])
def test_an_odometer_closes_within_three_roots_of_both_anchors_and_its_way(apart_m: float, closed: bool) -> None:
    """102 m are counted; 3 sqrt(1 + 4 + 0.1) = 6.775 m."""
    assert odometer_closes(odometer(1.0), cast(Any, ANCHORS), apart_m, CONFIG) is closed


@pytest.mark.parametrize(("t_s", "speed_mps"), [(-3.0, 0.0), (0.0, 10.0), (1.0, 12.0), (2.0, 14.0), (9.0, 0.0)])
def test_the_best_speed_is_that_of_the_second_as_far_as_it_was_recorded(t_s: float, speed_mps: float) -> None:
    """10 m in the first of two seconds and 14 m in the other one; farther away than the second nothing was."""
    counted = odometry_from(odometer_of([0.0, 1.0, 2.0], distance_m=[0.0, 10.0, 24.0]))
    found = counted.speed_about(np.array([counted.epoch_ns + round(t_s * NS_PER_S)]))
    assert found[0] == pytest.approx(speed_mps)
