"""How far aside a path is refuted: farther beside a track so near that right claims are as rare as wrong ones."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from pipeline.stages.paths.path_tests import _limits_by_spacing
from schemas.arrays import Floats, floats
from tests.stages.matching.builders import line, matched, odometer, run, site

X_M = np.arange(20.0, 2900.0, 20.0)


def gate(apart_m: float, aside_m: float, turned: bool = False) -> Floats:
    """Beside track A, B so far to the left of it, both surveyed to 2 m; positions of 0.3 m, so far left of A."""
    begin, end = (3000.0, 0.0) if turned else (0.0, 3000.0)
    other = line((begin, apart_m), (end, apart_m))
    place = site({"A": line((0.0, 0.0), (3000.0, 0.0)), "B": other}, sigma_m=2.0)
    return floats(
        matched(run(X_M, np.full(X_M.size, aside_m), sigma_m=0.3), place, odometer(X_M)).epochs.table,
        "gate_probability",
    )


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("apart_m", "aside_m", "claimed"),
    [
        # Bias (1.5 m), survey and position together are 2.52 m: aside by 3.2, 3.6 and 4.2 of them, B is 1.8 away.
        (4.5, 8.1, False),
        (4.5, 9.1, False),
        (4.5, 10.5, True),
        # Four roots away: while the train is on one of them, the other is refuted in 70 % of runs.
        (10.0, 8.9, True),
        (10.0, 8.1, False),
    ],
)
def test_near_another_track_an_offset_has_to_be_larger(
    apart_m: float, aside_m: float, claimed: bool, turned: bool
) -> None:
    live = gate(apart_m, aside_m, turned)[-1]
    assert live >= 0.99 if claimed else live < 0.99


def test_a_single_line_is_left_at_the_limit_of_its_offset() -> None:
    """4.17 roots of 2.52 m are 10.5 m."""
    place = site({"A": line((0.0, 0.0), (3000.0, 0.0))}, sigma_m=2.0)
    for aside_m, off in ((10.3, False), (10.7, True)):
        y_m = np.interp(X_M, [1900.0, 1960.0], [0.0, aside_m])
        assert matched(run(X_M, y_m, sigma_m=0.3), place, odometer(X_M)).off.is_empty() != off


@pytest.mark.parametrize("apart", [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])
def test_of_claims_by_offset_no_more_are_wrong_than_they_say(apart: float) -> None:
    """Two tracks so many roots apart, drawn offsets; of a million runs less than twenty need not be looked at."""
    (limit,) = _limits_by_spacing(np.array([apart]), 0.05, 3.0)
    tail = NormalDist().cdf
    right, wrong = tail(apart - limit), tail(-limit)
    assert wrong <= 0.01 * right or wrong < 2e-5
