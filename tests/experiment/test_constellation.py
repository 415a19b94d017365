"""Nominal constellations: published parameters, repeating tracks, look angles of known directions."""

import numpy as np
import pytest

from datasets.constellation import GALILEO, GPS, SIDEREAL_DAY_S, look_angles, satellite_positions, visible_satellites

T0_NS = 1_710_892_800_000_000_000


def test_sizes_and_radii() -> None:
    for slots, radius_m in ((GPS, 26_559_700.0), (GALILEO, 29_599_800.0)):
        assert len({slot.sv for slot in slots}) == len(slots) == 24
        distance = np.linalg.norm(satellite_positions(slots, np.array([T0_NS])), axis=-1)
        assert distance == pytest.approx(radius_m, rel=1e-12)


def test_galileo_is_walker_24_3_1() -> None:
    planes = sorted({slot.raan_deg for slot in GALILEO})
    assert np.diff(planes) == pytest.approx([120.0, 120.0])
    first = {slot.sv: slot.argument_deg for slot in GALILEO}
    assert (first["E02"] - first["E01"]) % 360.0 == pytest.approx(45.0)
    assert (first["E09"] - first["E01"]) % 360.0 == pytest.approx(15.0)


def test_gps_tracks_repeat_after_a_turn_of_the_earth_against_the_node() -> None:
    node_rad_per_s = np.radians(GPS[0].raan_rate_deg_per_day) / 86400.0
    turn_s = 2 * np.pi / (2 * np.pi / SIDEREAL_DAY_S - node_rad_per_s)
    later = T0_NS + round(turn_s * 1e9)
    before, after = satellite_positions(GPS, np.array([T0_NS, later]))
    assert np.abs(after - before).max() < 500.0


def test_orbital_speed_is_keplerian() -> None:
    t = T0_NS + np.array([0, 1_000_000_000])
    earth = 7.2921151467e-5
    for slots, radius_m in ((GPS, 26_559_700.0), (GALILEO, 29_599_800.0)):
        before, after = satellite_positions(slots, t)
        velocity = after - before + np.cross([0.0, 0.0, earth], 0.5 * (before + after))
        speed = np.linalg.norm(velocity, axis=-1)
        assert speed == pytest.approx(np.sqrt(3.986005e14 / radius_m), rel=2e-4)


def test_a_satellite_in_the_zenith_and_one_in_the_south() -> None:
    position = satellite_positions(GPS, np.array([T0_NS]))[0, 7]
    longitude = float(np.degrees(np.arctan2(position[1], position[0])))
    latitude = float(np.degrees(np.arcsin(position[2] / np.linalg.norm(position))))
    _, elevation = look_angles(GPS, np.array([T0_NS]), latitude, longitude)
    assert elevation[0, 7] > 89.0
    azimuth, elevation = look_angles(GPS, np.array([T0_NS]), latitude + 30.0, longitude)
    assert azimuth[0, 7] == pytest.approx(180.0, abs=0.5)
    assert 50.0 < elevation[0, 7] < 56.0


def test_visible_respects_the_mask_and_order() -> None:
    t = T0_NS + np.arange(3) * 3_600_000_000_000
    frame = visible_satellites(GPS + GALILEO, t, 50.85, 4.35, mask_deg=10.0)
    assert frame["elevation_deg"].min() >= 10.0  # type: ignore[operator]
    assert frame["t"].is_sorted()
    counts = frame.group_by("t", maintain_order=True).len()["len"].to_list()
    assert all(10 <= count <= 22 for count in counts)
