"""How the position moves across two tracks whose surveyed distance changes, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.matching.innovations import innovations_of, movements_m
from schemas.arrays import Floats, Ints


def followed(
    a_m: list[float], b_m: list[float], tolerance_m: float, turned: bool = False
) -> tuple[Floats, Floats, Floats]:
    """Movements on both tracks, and what is taken for an error of the survey; `turned`: b is surveyed backwards."""
    offset = np.array([a_m, [-b for b in b_m] if turned else b_m]).T.ravel()
    state = np.arange(len(offset))
    before: Ints = np.where(state < 2, -1, state - 2)
    heading = np.tile([0.0, np.pi if turned else 0.0], len(a_m))
    limit = np.full(len(offset), tolerance_m)
    found = innovations_of(np.arange(0, len(offset) + 1, 2), offset, heading, limit, before, np.ones(len(a_m)))
    moved = movements_m(found, offset, limit, state[:-2], state[2:]).reshape(-1, 2)
    sign = -1.0 if turned else 1.0
    return moved[:, 0], sign * moved[:, 1], found.survey_m.reshape(-1, 2)


@pytest.mark.parametrize("turned", [False, True])
def test_a_distance_that_winds_tells_nothing(turned: bool) -> None:
    """4 m apart; b's survey goes aside by 0.5 m and back, while the position moves by 0.1 m each step."""
    a_m = [0.0, 0.1, 0.2, 0.3]
    b_m = [-4.0, -3.4, -3.3, -3.7]
    on_a, on_b, _ = followed(a_m, b_m, 1.0, turned)
    assert on_a.tolist() == pytest.approx([0.1, 0.1, 0.1])
    assert on_b.tolist() == pytest.approx([0.1, 0.1, 0.1])


def test_what_no_error_of_the_survey_explains_counts() -> None:
    """b bends away by 2 m in each of three steps; one metre of it may be the survey's."""
    on_a, on_b, error_m = followed([0.0] * 4, [-4.0, -6.0, -8.0, -10.0], 1.0)
    assert on_a.tolist() == [0.0, 0.0, 0.0]
    assert on_b.tolist() == pytest.approx([-1.0, -2.0, -2.0])
    assert error_m[-1].tolist() == pytest.approx([0.0, -1.0])


def test_the_shared_movement_is_that_of_the_track_which_the_position_moves_least_against() -> None:
    """A step of 0.8 m at a joint of a, then one of b: neither is a movement of the train."""
    on_a, on_b, _ = followed([0.0, 0.8, 0.8], [-4.0, -4.0, -4.8], 1.0)
    assert on_a.tolist() == on_b.tolist() == [0.0, 0.0]


def test_a_crossover_does_not_lift_the_tracks_that_it_joins() -> None:
    """The position drifts by 0.3 m a step towards b while the crossover leads there, then stays.

    For three steps it moves least against the crossover x. By the smallest error x became the measure of both tracks:
    a and b were lifted by 0.9 m, and by 0.3 m more each step as x went on.
    """
    a_m = [0.0, 0.3, 0.6, 0.9, 0.9, 0.9, 0.9]
    x_m = [0.0, 0.0, 0.0, 0.0, -0.3, -0.6, -0.9]
    offset = np.array([a_m, [value - 4.0 for value in a_m], x_m]).T.ravel()
    state = np.arange(len(offset))
    before: Ints = np.where(state < 3, -1, state - 3)
    first = np.arange(0, len(offset) + 1, 3)
    found = innovations_of(first, offset, np.zeros(len(offset)), np.full(len(offset), 4.0), before, np.ones(len(a_m)))
    error_m = found.survey_m.reshape(-1, 3)
    assert error_m[:, :2] == pytest.approx(np.zeros((7, 2)))
    assert error_m[:, 2] == pytest.approx([0.0, -0.3, -0.6, -0.9, -1.2, -1.5, -1.8])
