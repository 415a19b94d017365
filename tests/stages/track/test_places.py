"""Places moved and ends of net elements, against PROJ and by hand."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from pipeline.stages.track.geodesy import moved_deg
from pipeline.stages.track.network import network_of, site_network
from pipeline.stages.track.survey import end_places, in_pieces, track_of
from tests.stages.matching.builders import line, site

GEOD = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("latitude", [-33.0, 0.0, 50.0, 69.0])
def test_a_place_moved_300_m_east_and_400_m_north_is_500_m_away(latitude: float) -> None:
    at = np.array([latitude]), np.array([4.0]), np.zeros(1)
    to_latitude, to_longitude = moved_deg(*at, np.array([300.0]), np.array([400.0]))
    azimuth, _, distance_m = GEOD.inv(4.0, latitude, to_longitude[0], to_latitude[0])
    assert distance_m == pytest.approx(500.0, abs=0.03)
    assert azimuth == pytest.approx(np.degrees(np.arctan2(3.0, 4.0)), abs=0.01)


def test_high_up_a_metre_is_a_smaller_angle() -> None:
    """At 1 km by 1000 in 6.37 to 6.39 million."""
    high, low = (
        np.ravel(moved_deg(np.array([50.0]), np.array([4.0]), np.array([height_m]), np.ones(1), np.ones(1)))
        for height_m in (1000.0, 0.0)
    )
    moved = (low - [50.0, 4.0]) / (high - [50.0, 4.0]) - 1.0
    assert moved == pytest.approx(1000.0 / 6.38e6, rel=0.01)


def test_ends_are_those_of_each_element() -> None:
    """One of three points, one of two."""
    track = track_of(
        site({"a": np.array([[0.0, 0.0], [50.0, 0.0], [90.0, 0.0]]), "b": np.array([[0.0, 9.0], [90.0, 9.0]])}).track
    )
    assert end_places(track)[:, 0] == pytest.approx(track.surface[[0, 3]])
    assert end_places(track)[:, 1] == pytest.approx(track.surface[[2, 4]])


@pytest.mark.parametrize(
    ("name", "measure_m", "element"),
    [("a", 0.0, 0), ("b", 30.0, 1), ("b", 40.0, 1), ("b", 42.0, None), ("b", -2.0, None), ("c", 1.0, None)],
)
def test_an_element_is_found_by_its_name_if_it_holds_the_measure(
    name: str, measure_m: float, element: int | None
) -> None:
    """a has 100 m, b 40 m; c is not there."""
    track = track_of(site({"a": line((0.0, 0.0), (100.0, 0.0)), "b": line((0.0, 9.0), (40.0, 9.0))}).track)
    assert track.element_at(name, measure_m) == element


def test_pieces_of_an_element_follow_each_other_both_ways() -> None:
    """a, then b that turns back on itself and so comes in two pieces: 2 and 3, 4 and 5; c follows the second."""
    bend = np.array([[100.0, 0.0], [200.0, 0.0], [200.0, 50.0], [100.0, 50.0], [100.0, 100.0]])
    elements = {"a": line((0.0, 0.0), (100.0, 0.0)), "b": bend, "c": line((100.0, 100.0), (300.0, 100.0))}
    place = site(elements, [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both")])
    track = in_pieces(track_of(place.track))
    assert track.ids == ("a", "b", "b", "c")
    network = network_of(track, place.links)
    onward = [[edge.to for edge in network.successors[oriented]] for oriented in range(8)]
    assert onward == [[2], [], [4], [1], [6], [3], [], [5]]


def test_ways_on_are_those_of_one_end_of_one_element() -> None:
    """a, b and c in a row: 0 and 1 are a along its measure and against it, 2 and 3 b, 4 and 5 c."""
    elements = {name: line((at, 0.0), (at + 100.0, 0.0)) for name, at in (("a", 0.0), ("b", 100.0), ("c", 200.0))}
    ways = site_network(site(elements, [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both")])).successors
    onward = [[edge.to for edge in ways[oriented]] for oriented in range(len(ways))]
    assert onward == [[2], [], [4], [1], [], [3]]
