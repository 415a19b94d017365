"""Where a series passes places, against the definition place by place and step by step."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.epochs.clock import Passing, passings


def test_touching_a_place_and_turning_back_are_two() -> None:
    assert passings(np.array([0.0, 10.0, 5.0]), [10.0]) == [Passing(1, 0, 1, 1.0), Passing(2, 0, -1, 0.0)]
    assert passings(np.array([10.0, 10.0, 20.0]), [10.0]) == []
    assert passings(np.array([]), [10.0]) == []


def test_a_step_passes_its_places_in_order_and_shares_its_time() -> None:
    there, back = passings(np.array([0.0, 40.0]), [10.0, 30.0]), passings(np.array([40.0, 0.0]), [10.0, 30.0])
    assert [(one.place, one.sense, one.share) for one in there] == [(0, 1, 0.25), (1, 1, 0.75)]
    assert [(one.place, one.sense, one.share) for one in back] == [(1, -1, 0.25), (0, -1, 0.75)]
    assert there[0].instant_ns(1_000, 2_000) == 1_250


@pytest.mark.parametrize("seed", range(3))
def test_every_change_of_side_is_found_once(seed: int) -> None:
    dice = np.random.default_rng(seed)
    at_m = np.round(np.cumsum(dice.normal(0.0, 20.0, 300)))
    places_m = np.sort(dice.choice(np.arange(-300.0, 300.0), 12, replace=False))
    expected = {
        (row, place, 1 if at_m[row] >= place_m else -1)
        for row in range(1, at_m.size)
        for place, place_m in enumerate(places_m)
        if (at_m[row] >= place_m) != (at_m[row - 1] >= place_m)
    }
    found = passings(at_m, places_m)
    assert {(one.after, one.place, one.sense) for one in found} == expected
    assert len(found) == len(expected) > 20
    for one in found:
        assert at_m[one.after - 1] + one.share * (at_m[one.after] - at_m[one.after - 1]) == pytest.approx(
            places_m[one.place]
        )
