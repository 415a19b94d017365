"""Lengths and places against PROJ's geodesics, which were written by others."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.stages.track.geodesy import distance_between_m, earth_centred_m, point_distances_m, points_of

GEOD = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("azimuth", [0.0, 37.0, 90.0, 205.0])
@pytest.mark.parametrize("latitude", [-33.0, 0.0, 50.0, 69.0])
def test_a_line_of_100_km_is_long_as_the_geodesic_to_1e_minus_5(latitude: float, azimuth: float) -> None:
    ends = GEOD.fwd(4.0, latitude, azimuth, 100_000.0)[:2]
    longitude, latitudes = np.array(GEOD.npts(4.0, latitude, *ends, 20_000 - 1, initial_idx=0, terminus_idx=0)).T
    length = point_distances_m(latitudes, longitude, np.zeros(len(longitude))).sum()
    assert length == pytest.approx(100_000.0, rel=1e-8)


def test_a_grade_lengthens_the_line() -> None:
    run = distance_between_m(50.0, 4.0, 50.0, 4.001)
    slope = point_distances_m(np.array([50.0, 50.0]), np.array([4.0, 4.001]), np.array([0.0, 0.03 * run]))[0]
    assert slope == pytest.approx(run * np.hypot(1.0, 0.03), rel=1e-6)


def test_height_lengthens_the_line() -> None:
    at_sea = point_distances_m(np.array([50.0, 50.0]), np.array([4.0, 4.001]), np.zeros(2))[0]
    high = point_distances_m(np.array([50.0, 50.0]), np.array([4.0, 4.001]), np.full(2, 1000.0))[0]
    assert high / at_sea - 1.0 == pytest.approx(1000.0 / 6.39e6, rel=1e-3)


@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-100, 4000))
def test_earth_centred_coordinates_are_proj_s(latitude: float, longitude: float, height: float) -> None:
    turn = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = turn.transform(longitude, latitude, height)
    found = earth_centred_m(np.array([latitude]), np.array([longitude]), np.array([height]))[0]
    assert np.allclose(found, expected, atol=1e-6, rtol=0)


def test_east_and_north_are_square_units_along_the_surface() -> None:
    here = points_of(np.array([50.0]), np.array([4.0]))
    there = points_of(np.array([50.00001, 50.0]), np.array([4.0, 4.00001])).surface - here.surface
    assert here.east[0] @ here.north[0] == pytest.approx(0.0, abs=1e-15)
    assert there[0] @ here.north[0] == pytest.approx(np.linalg.norm(there[0]), rel=1e-9)
    assert there[1] @ here.east[0] == pytest.approx(np.linalg.norm(there[1]), rel=1e-9)
