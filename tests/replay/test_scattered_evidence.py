"""Balise reads carried on by an odometer whose rows scatter: a truth that says how sure it is."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.alignment.align import align
from pipeline.hazards import establish_truth
from pipeline.hazards.anchors import Anchors, carry
from pipeline.hazards.travel import Travel
from pipeline.lds.telegrams import place_reads
from pipeline.matching import match
from pipeline.odometry import odometry_of
from schemas.config import Configuration
from tests.replay.journeys import VEHICLE, journey

CONFIG = Configuration()
MOTION = {
    "start_m": 200.0,
    "phases": [{"speed_mps": 30.0}, {"stop_at_m": 3900.0, "hold_s": 40.0}, {"speed_mps": 30.0}, {"stop_at_m": 8000.0}],
}


def truth_by_reads(run, site, odometer):
    odometry = odometry_of(odometer, VEHICLE, CONFIG)
    found = match(run.gnss, odometry, site, VEHICLE, CONFIG.matching, CONFIG.fix_sigma, run.balise_reads)
    odometry = odometry.oriented(found.odometer_sign)
    aligned = align(found.epochs, odometry, VEHICLE, CONFIG)
    reads = place_reads(run.balise_reads, aligned, found.path.balises(site.balises), odometry)
    epochs = aligned.with_columns(alarm=False, negated=False)
    return establish_truth(epochs, None, reads.drop_nulls("path_m"), None, CONFIG)


def scattered(odometer, kind, size_m, seed):
    rows = odometer["distance_m"].to_numpy()
    noise = np.random.default_rng(seed).normal(0.0, size_m, rows.size)
    return odometer.with_columns(
        distance_m=pl.Series(np.floor(rows / size_m) * size_m if kind == "counts" else rows + noise)
    )


@pytest.mark.parametrize(("kind", "size_m"), [("counts", 1.0), ("counts", 5.0), ("noise", 0.5)])
def test_sigma_and_slip_allow_for_rows_that_scatter(kind, size_m):
    squares = []
    for seed in range(1, 9):
        run, site = journey(motion=MOTION, seed=seed)
        fine = truth_by_reads(run, site, run.odometer)
        coarse = truth_by_reads(run, site, scattered(run.odometer, kind, size_m, seed))
        assert (coarse["truth_slip_m"].fill_null(0.0) == 0.0).all()
        apart = (coarse["truth_path_m"] - fine["truth_path_m"]) / coarse["truth_sigma_m"]
        squares.append(apart.drop_nulls().pow(2).mean())
        assert (coarse["truth_sigma_m"] >= fine["truth_sigma_m"]).all()
    assert np.sqrt(np.mean(squares)) < 1.1


def test_rows_that_do_not_scatter_add_nothing():
    run, site = journey(motion=MOTION)
    odometry = odometry_of(run.odometer, VEHICLE, CONFIG)
    found = match(run.gnss, odometry, site, VEHICLE, CONFIG.matching, CONFIG.fix_sigma, None)
    aligned = align(found.epochs, odometry, VEHICLE, CONFIG)
    assert set(aligned["odometer_rows_m"]) == {0.0}


@pytest.mark.parametrize(("reading_m", "slipped"), [(0.0, True), (0.5, False)])
def test_what_rows_scatter_is_no_slip_between_two_reads(reading_m, slipped):
    """Over 100 m in 10 s the odometer counted 2 m too far: beyond its walk, and within two rows of 0.5 m."""
    at_ns = np.arange(11, dtype=np.int64) * 10**9
    counted = 10.2 * np.arange(11.0)
    travel = Travel(
        at_ns=at_ns,
        distance_m=counted,
        odometer_m=counted,
        stretch=np.zeros(11, dtype=np.int64),
        scale_sigma=np.zeros(11),
        white_m2_per_s=np.full(11, 0.0025),
        reading_m2=np.full(11, reading_m**2),
    )
    carried = carry(Anchors.of(at_ns[[0, 10]], np.array([0.0, 100.0])), travel, at_ns, CONFIG.lds, both_ways=True)
    assert (carried.slip_m[1:-1] != 0.0).all() == slipped
    assert (carried.slip_m[1:-1] == 0.0).all() != slipped
