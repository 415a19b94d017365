"""Which positions of a recorded line the train can have come to, by where it was heading."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.make.survey.reachable import reachable_rows
from pipeline.stages.matching.epochs import fixes_of
from schemas.arrays import Floats
from schemas.config import FixSigma
from tests.stages.matching.builders import run


def left_out(x_m: Floats, rate_hz: float) -> list[int]:
    fixes = fixes_of(run(x_m, np.zeros(len(x_m)), rate_hz, sigma_m=0.1), FixSigma())
    return np.setdiff1d(np.arange(len(x_m)), reachable_rows(fixes)).tolist()


@pytest.mark.parametrize("jump_m", [-100.0, -60.0, -30.0, 30.0, 60.0, 100.0])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_falling_back_is_no_less_a_jump_than_running_ahead(jump_m: float, rate_hz: float) -> None:
    """At 50 m/s. Positions that fall back lie no further apart than those of the train itself."""
    t = np.arange(0.0, 110.0, 1.0 / rate_hz)
    away = (t >= 30.0) & (t < 31.0)
    x = 200.0 + 50.0 * t + np.where(away, jump_m, 0.0)
    assert left_out(x, rate_hz) == np.flatnonzero(away).tolist()


@pytest.mark.parametrize("jump_m", [-40.0, 40.0, 300.0])
def test_one_position_astray_costs_that_one_only(jump_m: float) -> None:
    """The speed after it is that of the epochs before it, not that of the way back."""
    x = 100.0 + 30.0 * np.arange(60.0)
    x[20] += jump_m
    assert left_out(x, 1.0) == [20]


def test_a_jump_that_stays_is_believed_in_the_end() -> None:
    """400 m ahead from 30 s on: not before the train could have got there, but within half a minute."""
    t = np.arange(0.0, 110.0)
    out = left_out(200.0 + 50.0 * t + np.where(t >= 30.0, 400.0, 0.0), 1.0)
    assert out == list(range(30, 30 + len(out)))
    assert 5 <= len(out) <= 30


def test_a_train_that_speeds_up_or_lost_its_position_is_believed() -> None:
    """From standstill at 1.5 m/s²."""
    assert left_out(0.75 * np.arange(0.0, 50.0, 0.4) ** 2, 2.5) == []
