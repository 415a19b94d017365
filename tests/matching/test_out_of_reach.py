"""Without an odometer: which positions the train cannot have reached, by where it was heading."""

from __future__ import annotations

import numpy as np
import pytest

from tests.matching.builders import line, matched, run, site

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
