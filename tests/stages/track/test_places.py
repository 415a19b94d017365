"""Places moved and ends of net elements, against PROJ and by hand."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from pipeline.stages.track.geodesy import moved_deg
from pipeline.stages.track.network import site_network
from pipeline.stages.track.survey import end_places, track_of
from tests.stages.matching.builders import line, site

GEOD = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("latitude", [-33.0, 0.0, 50.0, 69.0])
def test_a_place_moved_300_m_east_and_400_m_north_is_500_m_away(latitude: float) -> None:
    at = np.array([latitude]), np.array([4.0]), np.zeros(1)
    to_latitude, to_longitude = moved_deg(*at, np.array([300.0]), np.array([400.0]))
    azimuth, _, way_m = GEOD.inv(4.0, latitude, to_longitude[0], to_latitude[0])
    assert way_m == pytest.approx(500.0, abs=0.03)
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


def test_ways_on_are_those_of_one_end_of_one_element() -> None:
    """a, b and c in a row: 0 and 1 are a along its measure and against it, 2 and 3 b, 4 and 5 c."""
    elements = {name: line((at, 0.0), (at + 100.0, 0.0)) for name, at in (("a", 0.0), ("b", 100.0), ("c", 200.0))}
    ways = site_network(site(elements, [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both")])).successors
    onward = [[edge.to for edge in ways[oriented]] for oriented in range(len(ways))]
    assert onward == [[2], [], [4], [1], [], [3]]
