"""How far chords lie beside the curve that they stand for: worked by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.stages.track.network import Network, site_network
from schemas.arrays import Floats
from tests.stages.matching.builders import Link, line, site

RADIUS_M = 500.0


def arc(angles_rad: Sequence[float] | Floats) -> Floats:
    """Points of a circle, from the origin to the left."""
    angle = np.asarray(angles_rad)
    return RADIUS_M * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def sigmas_m(points: Floats) -> list[float]:
    """Of each chord of one element."""
    return _sigmas_m(site_network(site({"a": points}, sigma_m=0.3)))[: len(points) - 1].tolist()


def _sigmas_m(network: Network) -> Floats:
    vertices = np.arange(len(network.track.measure_m) - 1)
    return np.sqrt(np.maximum(network.survey_sigmas_m(1.0, vertices) ** 2 - 0.3**2, 0.0))


@pytest.mark.parametrize(("step_rad", "expected_m"), [(0.2, 1.25), (0.1, 0.3125), (0.04, 0.05)])
def test_a_chord_lies_aside_by_half_of_its_length_times_its_turn_over_eight(step_rad: float, expected_m: float) -> None:
    """Points every 100, 50 and 20 m at a radius of 500 m; the first and the last chord are of the same arc."""
    points = arc(np.arange(0.0, 1.01, step_rad))
    assert sigmas_m(points) == pytest.approx([expected_m] * (len(points) - 1), rel=0.01)


def test_a_straight_before_a_curve_has_no_chord_error() -> None:
    """300 m of straight in three chords, then an arc; the first chord of the arc turns half as much at its start."""
    points = np.vstack([[[-300.0, 0.0], [-200.0, 0.0], [-100.0, 0.0]], arc([0.0, 0.2, 0.4, 0.6, 0.8])])
    root = float(np.sqrt(0.5))
    assert sigmas_m(points) == pytest.approx([0.0, 0.0, 0.0, 1.25 * root, 1.25, 1.25, 1.25], abs=0.05)


def test_a_short_straight_before_a_curve_has_none_either() -> None:
    """The line begins 100 m before the arc: the turn where the arc begins is all of the arc."""
    points = np.vstack([[[-100.0, 0.0]], arc([0.0, 0.2, 0.4, 0.6, 0.8])])
    assert sigmas_m(points)[0] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("turned", [False, True])
def test_the_first_chord_behind_a_switch_is_as_long_as_the_others(turned: bool) -> None:
    """A straight line, and from its middle an arc of 500 m with points every 50 m: half of 0.1 rad * 50 m / 8 each."""
    branch = arc([0.0, 0.1, 0.2, 0.3])
    parts = {"s": line((-300.0, 0.0), (0.0, 0.0), 50.0), "m": line((0.0, 0.0), (300.0, 0.0), 50.0)}
    links: list[Link] = [("s", 1, "m", 0, "both"), ("s", 1, "b", int(turned), "both")]
    place = site(parts | {"b": branch[::-1] if turned else branch}, links, sigma_m=0.3)
    found = _sigmas_m(site_network(place))[-3:]
    assert found.tolist() == pytest.approx([0.3125] * 3, rel=0.01)


def test_a_straight_behind_a_switch_has_no_chord_error() -> None:
    """Of 40 m, in which the branch leads away, and then on without a turn; and of 400 m up to a turn."""
    parts = {"s": line((-300.0, 0.0), (0.0, 0.0)), "m": line((0.0, 0.0), (900.0, 0.0))}
    parts["b"] = np.array([[0.0, 0.0], [40.0, 4.0], [80.0, 8.0], [120.0, 12.0]])
    parts["c"] = np.array([[0.0, 0.0], [400.0, -40.0], [500.0, -60.0], [600.0, -90.0]])
    links: list[Link] = [("s", 1, name, 0, "both") for name in "mbc"]
    network = site_network(site(parts, links, sigma_m=0.3))
    found, first = _sigmas_m(network), network.track.first
    assert found[first[2] : first[2] + 3].tolist() == pytest.approx([0.0] * 3, abs=0.01)
    assert found[first[3]] == pytest.approx(0.0, abs=0.01)


def test_points_on_a_chord_change_nothing() -> None:
    """But for how straight a line in degrees is: 0.01 mrad at 100 m."""
    points = arc([0.0, 0.2, 0.4, 0.6, 0.8])
    halves = np.vstack([np.column_stack([points[:-1], 0.5 * (points[:-1] + points[1:])]).reshape(-1, 2), points[-1:]])
    assert np.repeat(sigmas_m(points), 2) == pytest.approx(sigmas_m(halves), abs=1e-3)
    # A centimetre beside the chord turns by 0.4 mrad: less of the chord's own turn, by as little.
    halves[3] += [0.0, 0.01]
    assert sigmas_m(halves)[2] == pytest.approx(1.25, abs=0.02)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("at", [1, 2, 3, 4])
def test_borders_of_elements_change_nothing(turned: bool, at: int) -> None:
    """Cut at a point, at the middle of a chord (2, 4), with a turnout there or without."""
    points = np.insert(arc([0.0, 0.2, 0.4, 0.6]), [2, 3], 0.5 * (arc([0.2, 0.4]) + arc([0.4, 0.6])), axis=0)
    one, other = points[: at + 1], points[at:]
    end = 0 if turned else 1
    links: list[Link] = [("a", end, "b", 0, "both"), ("a", end, "t", 0, "both")]
    turnout = line(tuple(points[at]), tuple(points[at] + [-20.0, 60.0]))
    parts = {"a": one[::-1] if turned else one, "b": other, "t": turnout}
    found = _sigmas_m(site_network(site(parts, links, sigma_m=0.3)))
    first = found[: len(one) - 1]
    whole = [*(first[::-1] if turned else first), *found[len(one) : len(points)]]
    assert whole == pytest.approx(sigmas_m(points), abs=1e-6)


def test_two_points_at_one_place_are_one() -> None:
    """A centimetre apart across the line: each turns by a right angle, both together by nothing."""
    points = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 0.01], [200.0, 0.01], [200.0, 0.0], [300.0, 0.0]])
    assert sigmas_m(points) == pytest.approx([0.0] * 5, abs=0.02)
