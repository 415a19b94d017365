"""Without an odometer that knows: which positions the train cannot have reached, by where it was heading."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.matching.builders import line, matched, odometer, run, site

LONG = site({"a": line((0, 0), (6000, 0))})


@pytest.mark.parametrize("jump_m", [-100.0, -60.0, -30.0, 30.0, 60.0, 100.0])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_without_an_odometer_falling_back_is_no_less_a_jump_than_running_ahead(jump_m: float, rate_hz: float) -> None:
    """At 50 m/s for 10 s. Positions that fall back lie no further apart than those of the train itself."""
    t = np.arange(0.0, 110.0, 1.0 / rate_hz)
    x = 200.0 + 50.0 * t
    x[(t >= 30.0) & (t < 40.0)] += jump_m
    gate = matched(run(x, np.zeros(len(x)), rate_hz, sigma_m=0.1), LONG).epochs["gate_probability"].to_numpy()
    assert (gate[(t >= 30.0) & (t < 40.0)] == 0.0).all()
    assert (gate[t < 30.0] == 1.0).all()
    assert (gate[t >= 80.0] == 1.0).all()


def test_one_position_astray_costs_that_one_only() -> None:
    """The speed after it is that of the epochs before it, not that of the way back."""
    for jump_m in (-40.0, 40.0, 300.0):
        x = 100.0 + 30.0 * np.arange(60.0)
        x[20] += jump_m
        gate = matched(run(x, np.zeros(60), 1.0, sigma_m=0.1), LONG).epochs["gate_probability"].to_numpy()
        assert np.flatnonzero(gate < 1.0).tolist() == [20]


@pytest.mark.parametrize("counts", ["distance_m", "speed_mps"])
@pytest.mark.parametrize("slips", [False, True])
def test_while_the_odometer_knows_no_way_a_jump_is_out_of_reach(counts: str, slips: bool) -> None:
    """From 40 s to 60 s the odometer pauses, or reports slip; from 45 s to 52 s the position lies 60 m behind."""
    t = np.arange(0.0, 150.0)
    x = 100.0 + 20.0 * t
    off = (t >= 40.0) & (t < 60.0)
    stream = odometer(x).with_columns(distance_m=pl.lit(None, dtype=pl.Float64), speed_mps=pl.lit(20.0))
    stream = odometer(x) if counts == "distance_m" else stream
    stream = stream.with_columns(slip=pl.Series(off)) if slips else stream.filter(pl.Series(~off))
    away = (t >= 45.0) & (t < 52.0)
    gate = matched(run(x - 60.0 * away, 0.0 * x, sigma_m=0.1), LONG, stream).epochs["gate_probability"].to_numpy()
    assert (gate[away] == 0.0).all()
    assert (gate[t < 45.0] == 1.0).all()
    assert (gate[t >= 85.0] == 1.0).all()


def test_a_jump_in_a_pause_that_lost_the_way_is_held_beyond_it() -> None:
    """An odometer of speeds does not tell after its pause where the train is: the hold goes on."""
    t = np.arange(0.0, 150.0)
    x = 100.0 + 20.0 * t
    off = (t >= 40.0) & (t < 50.0)
    fixes = run(np.where(t >= 45.0, x + 60.0, x), 0.0 * x, sigma_m=0.1)
    speeds = odometer(x).with_columns(distance_m=pl.lit(None, dtype=pl.Float64), speed_mps=pl.lit(20.0))
    gate = matched(fixes, LONG, speeds.filter(pl.Series(~off))).epochs["gate_probability"].to_numpy()
    assert (gate[45:75] == 0.0).all()
    assert (gate[:45] == 1.0).all()
    assert (gate[85:] == 1.0).all()


def test_a_train_that_turns_back_in_a_pause_of_the_odometer_keeps_its_sense() -> None:
    """The odometer falls from 2 s on: the run began by reversing, whatever of its first metres is not known."""
    t = np.arange(0.0, 200.0)
    x = 1000.0 - 10.0 * np.minimum(t, 20.0) + 10.0 * np.clip(t - 40.0, 0.0, None)
    stream = odometer(x).with_columns(slip=pl.Series((t < 2.0) | ((t > 8.0) & (t < 15.0))))
    epochs = matched(run(x, 0.0 * x, sigma_m=0.1), LONG, stream).epochs
    assert epochs["path_m"][19] > epochs["path_m"][2]
    assert epochs["gate_probability"].min() == 1.0
