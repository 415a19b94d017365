"""Of the places that a position has on two elements behind each other, which one is kept: worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.stages.paths.candidates import Candidates, belong_beyond
from tests.stages.evidence.test_chains import line

# On element a (100 m) and on b, which begins where a ends: metres from the start, and metres past which end.
Place = tuple[float, float, int]
INSIDE, PAST_START, PAST_END = 0, -1, 1


def candidates(*places: tuple[int, Place]) -> Candidates:
    """Of one position, by element."""
    element = np.array([number for number, _ in places], dtype=np.int64)
    along_m, beyond_m, past = (np.array(values) for values in zip(*(place for _, place in places), strict=True))
    absent: Any = None
    return Candidates(
        first=np.array([0, element.size]), step=np.zeros(element.size, dtype=np.int64), element=element,
        along_m=along_m, left_m=100.0 - along_m, beyond_m=beyond_m, past=past, offset_m=absent, distance_m=absent,
        height_m=absent, heading_rad=absent, vertex=absent, linked_start=absent, linked_end=absent,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("on_a", "on_b", "kept"),
    [
        ((99.0, 0.0, INSIDE), (0.0, 1.0, PAST_START), "a"),
        ((100.0, 1.0, PAST_END), (1.0, 0.0, INSIDE), "b"),
        ((100.0, 5.0, PAST_END), (5.0, 0.0, INSIDE), "b"),  # 5 m inside are no longer about the end
        ((95.0, 0.0, INSIDE), (0.0, 5.0, PAST_START), "a"),
        ((100.0, 1.0, PAST_END), (0.0, 0.5, PAST_START), "b"),  # outside a bend: past both
        ((100.0, 0.5, PAST_END), (0.0, 1.0, PAST_START), "a"),
        ((99.5, 0.0, INSIDE), (1.0, 0.0, INSIDE), "b"),  # inside a bend: farther inside of b
        ((99.0, 0.0, INSIDE), (0.5, 0.0, INSIDE), "a"),
        ((100.0, 0.0, INSIDE), (0.0, 0.0, INSIDE), "a"),  # at the joint itself the first of the survey
        ((100.0, 1.0, PAST_END), (0.0, 1.0, PAST_START), "a"),
        ((95.0, 0.0, INSIDE), (5.0, 0.0, INSIDE), "ab"),  # a curve back: neither is about the joint
    ],
)
def test_at_a_joint_a_position_has_one_place(on_a: Place, on_b: Place, kept: str) -> None:
    out = belong_beyond(candidates((0, on_a), (1, on_b)), line("both"))
    assert "".join(np.array(["a", "b"])[~out]) == kept


def test_only_what_the_track_goes_on_to_overtakes() -> None:
    """c lies behind b; a position past the end of a, and inside c, may have left the track between."""
    out = belong_beyond(candidates((0, (100.0, 3.0, PAST_END)), (2, (1.0, 0.0, INSIDE))), line("both"))
    assert out.tolist() == [False, False]
    alone = belong_beyond(candidates((0, (100.0, 3.0, PAST_END))), line("both"))
    assert alone.tolist() == [False]
