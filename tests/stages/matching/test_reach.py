"""Which positions the train can have reached, without an odometer by where it was heading: they choose the track."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl
import pytest

from pipeline.stages.matching.fixes import fixes_of
from pipeline.stages.matching.steps import believable, travelled
from pipeline.stages.odometry import odometry_of
from schemas.config import Configuration, FixSigma, MatchingConfig, Vehicle
from tests.stages.matching.builders import line, matched, odometer, run, site

DEFAULTS = MatchingConfig()


def disbelieved(
    x_m: npt.NDArray[np.float64],
    rate_hz: float,
    distance: pl.DataFrame | None = None,
    config: MatchingConfig = DEFAULTS,
) -> list[int]:
    fixes = fixes_of(run(x_m, np.zeros(len(x_m)), rate_hz, sigma_m=0.1), FixSigma())
    way = None if distance is None else odometry_of(distance, Vehicle(), Configuration())
    believed = believable(fixes, fixes.valid, travelled(fixes, way), config)
    return np.setdiff1d(np.arange(len(x_m)), believed).tolist()


@pytest.mark.parametrize("jump_m", [-100.0, -60.0, -30.0, 30.0, 60.0, 100.0])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_falling_back_is_no_less_a_jump_than_running_ahead(jump_m: float, rate_hz: float) -> None:
    """At 50 m/s. Positions that fall back lie no further apart than those of the train itself."""
    t = np.arange(0.0, 110.0, 1.0 / rate_hz)
    away = (t >= 30.0) & (t < 31.0)
    x = 200.0 + 50.0 * t + np.where(away, jump_m, 0.0)
    assert disbelieved(x, rate_hz) == np.flatnonzero(away).tolist()


@pytest.mark.parametrize("jump_m", [-40.0, 40.0, 300.0])
def test_one_position_astray_costs_that_one_only(jump_m: float) -> None:
    """The speed after it is that of the epochs before it, not that of the way back."""
    x = 100.0 + 30.0 * np.arange(60.0)
    x[20] += jump_m
    assert disbelieved(x, 1.0) == [20]


def test_a_jump_that_stays_is_believed_in_the_end() -> None:
    """400 m ahead from 30 s on: not before the train could have got there, but within the configured time."""
    t = np.arange(0.0, 110.0)
    out = disbelieved(200.0 + 50.0 * t + np.where(t >= 30.0, 400.0, 0.0), 1.0)
    assert out == list(range(30, 30 + len(out)))
    assert 5 <= len(out) <= MatchingConfig().jump_hold_s


def test_a_train_that_speeds_up_or_lost_its_position_is_believed() -> None:
    """From standstill at 1.5 m/s²."""
    assert disbelieved(0.75 * np.arange(0.0, 50.0, 0.4) ** 2, 2.5) == []


def test_how_far_apart_positions_tell_a_velocity_is_configuration() -> None:
    """Without a velocity a position that falls back is no farther away than the train can have gone."""
    x = 200.0 + 50.0 * np.arange(60.0)
    x[30] -= 60.0
    assert disbelieved(x, 1.0) == [30]
    assert disbelieved(x, 1.0, config=MatchingConfig(jump_speed_most_s=0.5)) == []
    assert disbelieved(x, 1.0, config=MatchingConfig(jump_speed_least_s=10.0)) == []


@pytest.mark.parametrize("counts", ["distance_m", "speed_mps"])
@pytest.mark.parametrize("slips", [False, True])
def test_while_the_odometer_knows_no_way_the_velocity_tells(counts: str, slips: bool) -> None:
    """From 40 s to 60 s the odometer pauses, or reports slip; from 45 s to 48 s the position lies 60 m behind."""
    t = np.arange(0.0, 150.0)
    x = 100.0 + 20.0 * t
    off = (t >= 40.0) & (t < 60.0)
    stream = odometer(x).with_columns(distance_m=pl.lit(None, dtype=pl.Float64), speed_mps=pl.lit(20.0))
    stream = odometer(x) if counts == "distance_m" else stream
    stream = stream.with_columns(slip=pl.Series(off)) if slips else stream.filter(pl.Series(~off))
    assert disbelieved(x - 60.0 * ((t >= 45.0) & (t < 48.0)), 1.0, stream) == [45, 46, 47]


def test_a_train_that_turns_back_in_a_pause_of_the_odometer_keeps_its_sense() -> None:
    """The odometer falls from 2 s on: the run began by reversing, whatever of its first metres is not known."""
    t = np.arange(0.0, 200.0)
    x = 1000.0 - 10.0 * np.minimum(t, 20.0) + 10.0 * np.clip(t - 40.0, 0.0, None)
    stream = odometer(x).with_columns(slip=pl.Series((t < 2.0) | ((t > 8.0) & (t < 15.0))))
    epochs = matched(run(x, 0.0 * x, sigma_m=0.1), site({"a": line((0, 0), (6000, 0))}), stream).epochs
    assert epochs["path_m"][19] > epochs["path_m"][2]
    assert epochs["gate_probability"].min() == 1.0
