"""Behind a switch its branches are one track until they are a gauge apart."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.matching.claims import SwitchZones
from pipeline.stages.paths.growth import path_set
from pipeline.stages.paths.path_steps import path_steps
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import network_in_pieces
from schemas.arrays import Floats, floats
from schemas.config import MatchingConfig
from schemas.run import Site
from tests.stages.matching.builders import Link, line, matched, odometer, run, site
from tests.stages.matching.ladder import degrees

# A straight line, and from its middle at x = 0 a straight branch at 1:10: at a way of 15.06 m behind the switch points
# of the two are 1.5 m apart, 2 x sin(0.5 atan 0.1).
ANGLE = np.arctan(0.1)
APART_M = 0.75 / np.sin(0.5 * ANGLE)


def turnout(cut_m: float = 400.0) -> Site:
    """The branch in pieces of such a length."""
    ends = np.arange(0.0, 400.0 + cut_m / 2.0, cut_m)
    points = np.column_stack([ends * np.cos(ANGLE), ends * np.sin(ANGLE)])
    pieces = len(ends) - 1
    elements = {"s": line((-400.0, 0.0), (0.0, 0.0)), "m": line((0.0, 0.0), (400.0, 0.0))}
    elements |= {f"d{k}": line(tuple(points[k]), tuple(points[k + 1]), 2.5) for k in range(pieces)}
    links: list[Link] = [("s", 1, "m", 0, "both"), ("s", 1, "d0", 0, "both")]
    links += [(f"d{k}", 1, f"d{k + 1}", 0, "both") for k in range(pieces - 1)]
    return site(elements, links, sigma_m=0.02)


def claimed_at_m(chainage_m: Floats, place: Site) -> Floats:
    """Of exact positions along stem and branch, the ways behind the switch [m] at which the branch is claimed."""
    x_m = np.where(chainage_m < 0.0, chainage_m, chainage_m * np.cos(ANGLE))
    y_m = np.where(chainage_m < 0.0, 0.0, chainage_m * np.sin(ANGLE))
    epochs = matched(run(x_m, y_m, sigma_m=0.02), place, odometer(np.abs(chainage_m - chainage_m[0]))).epochs.table
    on_branch = np.array([name is not None and name[0] == "d" for name in epochs["netelement_id"].to_list()])
    return chainage_m[on_branch & (np.nan_to_num(floats(epochs, "gate_probability")) >= 0.99)]


@pytest.mark.parametrize("cut_m", [400.0, 10.0, 4.0])
def test_branches_are_one_track_until_they_are_a_gauge_apart(cut_m: float) -> None:
    network = network_in_pieces(turnout(cut_m))
    chainage_m = np.arange(-50.0, -10.0)
    latitude, longitude = degrees(chainage_m, np.zeros(chainage_m.size))
    steps = path_steps(
        (chainage_m * 1e9).astype(np.int64), points_of(latitude, longitude), np.full(chainage_m.size, 0.02)
    )
    one_track = SwitchZones(path_set(steps, network, MatchingConfig()), 1.5)
    branch = network.track.ids.index("d0")
    assert one_track.zone_beyond(2 * branch + 1).length_m == pytest.approx(APART_M, abs=0.1)
    assert one_track.zone_beyond(2 * branch).length_m == 0.0
    # The stem has no branch beside it.
    assert one_track.zone_beyond(2 * network.track.ids.index("s")).length_m == 0.0


@pytest.mark.parametrize("cut_m", [400.0, 10.0])
def test_no_branch_is_claimed_where_it_is_no_other_track_yet(cut_m: float) -> None:
    """Exact positions at walking pace tell the branches apart long before they are two tracks."""
    claimed_m = claimed_at_m(np.arange(-390.0, 390.0, 1.0), turnout(cut_m))
    assert claimed_m.size
    assert APART_M < claimed_m.min() < APART_M + 5.0


@pytest.mark.parametrize("cut_m", [400.0, 10.0])
def test_on_the_way_back_the_branch_is_known_up_to_the_switch(cut_m: float) -> None:
    claimed_m = claimed_at_m(np.arange(390.0, -390.0, -1.0), turnout(cut_m))
    assert 0.0 < claimed_m.min() < 0.7 * APART_M
