"""Which way round the odometer counts, by the votes of two parallel tracks: worked by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.stages.matching.least_squares import PathStates, polarity_of_parts


def signs_of(place_m: list[list[float]], odometer_m: list[float], orientable: bool = True) -> list[int]:
    """Two elements of a part each, 0 and 1, 2 and 3 along and against; at each step a state along either."""
    network = SimpleNamespace(successors=[None] * 4, parts=np.array([0, 0, 1, 1]), orientable=orientable)
    steps = len(place_m)
    states = PathStates(
        step=np.arange(steps),
        first=2 * np.arange(steps + 1),
        oriented=np.array([0, 2] * steps),
        place_m=np.ravel(place_m),
        cost=np.zeros(2 * steps),
        refuted=np.zeros(2 * steps, dtype=np.bool_),
    )
    return polarity_of_parts(cast(Any, network), states, np.array(odometer_m)).tolist()


@pytest.mark.parametrize(
    ("place_m", "odometer_m", "signs"),
    [
        ([[0.0, 90.0], [10.0, 80.0], [20.0, 70.0]], [np.nan, 10.0, 10.0], [1, 1, -1, -1]),
        ([[0.0, 90.0], [10.0, 80.0], [20.0, 70.0]], [np.nan, -10.0, -10.0], [-1, -1, 1, 1]),
        # One short step back outvotes nothing, a longer one does.
        ([[0.0, 90.0], [10.0, 80.0], [9.0, 81.0]], [np.nan, 10.0, 1.0], [1, 1, -1, -1]),
        ([[0.0, 90.0], [10.0, 80.0], [9.0, 81.0]], [np.nan, 1.0, 10.0], [-1, -1, 1, 1]),
        # Nothing counted: not known.
        ([[0.0, 90.0], [10.0, 80.0], [20.0, 70.0]], [np.nan, 0.0, np.nan], [0, 0, 0, 0]),
    ],
)
def test_each_part_of_the_network_has_the_sign_that_its_states_moved_by(
    place_m: list[list[float]], odometer_m: list[float], signs: list[int]
) -> None:
    assert signs_of(place_m, odometer_m) == signs
    assert signs_of(place_m, odometer_m, orientable=False) == [0] * 4
