"""Off the network, and back beyond a switch: by a movement of the positions, not of a branch."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.arrays import Floats, floats
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site

X_M = np.arange(-1900.0, 1900.0, 20.0)


def turnout(aside_m: float) -> Site:
    """A straight line, and from its middle at x = 0 a branch that lies so far aside from 100 m on."""
    branch = np.vstack([line((0.0, 0.0), (100.0, aside_m)), line((100.0, aside_m), (2000.0, aside_m))[1:]])
    elements = {"s": line((-2000.0, 0.0), (0.0, 0.0)), "m": line((0.0, 0.0), (2000.0, 0.0)), "d": branch}
    links: list[Link] = [("s", 1, "m", 0, "both"), ("s", 1, "d", 0, "both")]
    return site(elements, links, sigma_m=0.05)


def claims(y_m: Floats, place: Site) -> tuple[list[str | None], list[bool]]:
    """Per second the track that is claimed, and whether the set is empty, of positions exact but for `y_m`."""
    epochs = matched(run(X_M, y_m, sigma_m=0.1), place, odometer(X_M - X_M[0])).epochs.table
    gate, names = floats(epochs, "gate_probability"), epochs["netelement_id"].to_list()
    claimed = [name if one >= 0.99 else None for one, name in zip(np.nan_to_num(gate), names, strict=True)]
    return claimed, np.isnan(gate).tolist()


@pytest.mark.parametrize("aside_m", [16.0, -10.0, 30.0])
def test_positions_that_come_back_beyond_a_switch_are_on_their_track_again(aside_m: float) -> None:
    """A fault moves them 10 m to the left from x = -600 m on; it ends at x = 700 m, behind the switch."""
    fault_m = np.interp(X_M, [-600.0, -580.0, 700.0, 720.0], [0.0, 10.0, 10.0, 0.0])
    claimed, off = claims(fault_m, turnout(aside_m))
    while_off = (X_M > -400.0) & (X_M < 720.0)
    assert np.array(off)[while_off].all()
    assert set(claimed[-30:]) == {"m"}


@pytest.mark.parametrize("aside_m", [10.0, 20.0, -10.0])
def test_a_branch_that_comes_over_to_an_unsurveyed_siding_is_no_way_back(aside_m: float) -> None:
    """The train is on a siding 10 m to the left from x = -580 m on, which the survey lacks."""
    siding_m = np.interp(X_M, [-600.0, -580.0], [0.0, 10.0])
    claimed, off = claims(siding_m, turnout(aside_m))
    assert np.array(off)[X_M > -400.0].all()
    assert set(np.array(claimed, dtype=object)[X_M > -400.0]) == {None}


def test_a_movement_as_large_the_other_way_is_none() -> None:
    """From the siding 10 m to the left of the line to 20 m; the branch lies 30 m aside."""
    siding_m = np.interp(X_M, [-600.0, -580.0, 700.0, 720.0], [0.0, 10.0, 10.0, 20.0])
    claimed, _ = claims(siding_m, turnout(30.0))
    assert set(np.array(claimed, dtype=object)[X_M > -400.0]) == {None}
