"""Lines that come back to a place: which passage is meant is known from the journey, not from the place alone."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.one_run import replay
from schemas.inputs import Balises, Gnss, Odometer, Reference
from schemas.run import RunLog, Site
from tests.replay.test_shunting import KNOWN, RATE_HZ, moved, stream
from tests.stages.matching import builders

RADIUS_M = 300.0


def ring():
    """A test ring, once round from the east, to the left."""
    angle = np.linspace(0.0, 2.0 * np.pi, 190)
    return np.column_stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle)])


def figure_of_eight():
    """One element that crosses itself at right angles in the middle of two rings."""
    t = np.linspace(0.02, 2.0 * np.pi - 0.02, 400)
    return np.column_stack([1200.0 * np.sin(t), 1200.0 * np.sin(t) * np.cos(t)])


def lengths(points):
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def journey(points, chainage_m, rounds, links, measures, error_m=0.0):
    """Points of element `r` run along `rounds` times; balises at `measures`."""
    along = lengths(points)
    at = np.mod(chainage_m, along[-1]) if rounds > 1 else chainage_m
    x, y = np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])
    noise = np.random.default_rng(4).standard_normal((3, chainage_m.size))
    slow = [0.4 * np.convolve(part, np.ones(200) / 200.0**0.5, "same") for part in noise[:2]]
    shifted = np.mod(chainage_m + error_m, along[-1]) if rounds > 1 else chainage_m + error_m
    gx, gy = np.interp(shifted, along, points[:, 0]), np.interp(shifted, along, points[:, 1])
    gnss = stream(Gnss, builders.run(gx + slow[0], gy + slow[1], RATE_HZ))
    odometer = stream(Odometer, builders.odometer(chainage_m + 0.05 * np.cumsum(noise[2]) / RATE_HZ**0.5, RATE_HZ))
    truth = builders.run(x, y, RATE_HZ, sigma_m=None).select("t", "latitude_deg", "longitude_deg", "height_m")
    bare = builders.site({"r": points}, links)
    balises = pl.DataFrame({"balise_id": [f"V{i}" for i in range(len(measures))], "measure_m": measures}).with_columns(
        netelement_id=pl.lit("r"),
        kind=pl.lit("virtual"),
        location_accuracy_m=pl.lit(12.0),
        linked=pl.lit(True),
        link_reaction=pl.lit("service_brake"),
        direction=pl.lit("both"),
    )
    site = Site(bare.track, bare.links, balises=stream(Balises, balises))
    return RunLog("loop", gnss, odometer=odometer, reference=stream(Reference, truth)), site


def test_a_ring_run_two_and_a_half_times():
    points = ring()
    way = 100.0 + np.concatenate([np.zeros(150), moved(4700.0)])
    run, site = journey(points, way, 3, [("r", 1, "r", 0, "both")], [600.0, 1400.0])
    tables = replay(run, site, KNOWN)
    assert tables.passages["balise_id"].to_list() == ["V0", "V1", "V0", "V1", "V0"]
    assert set(tables.passages["status"]) == {"accepted"}
    assert tables.passages["location_error_m"].abs().max() < 3.0
    assert tables.epochs["error_along_m"].abs().max() < 5.0
    assert tables.hazards.height == tables.alarms.height == 0


@pytest.mark.parametrize("error_m", [0.0, 60.0])
def test_a_line_that_crosses_itself_is_not_left_at_the_crossing(error_m):
    points = figure_of_eight()
    total = lengths(points)[-1]
    way = 50.0 + np.concatenate([np.zeros(150), moved(total - 200.0)])
    error = np.where(np.arange(way.size) > 900, error_m, 0.0)
    run, site = journey(points, way, 1, [], [1000.0, total - 1000.0], error)
    tables = replay(run, site, KNOWN)
    assert tables.epochs["error_along_m"].abs().max() < error_m + 6.0
    assert tables.passages["balise_id"].to_list() == ["V0", "V1"]
    assert tables.hazards["hazard"].to_list() == (["VB_SHIFT"] if error_m else [])
    assert tables.alarms.height == (1 if error_m else 0)
