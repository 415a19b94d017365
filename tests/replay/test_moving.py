"""When the train moved, and what a standing odometer beside moving positions leaves unknown (DOMAIN section 5.5)."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.show.report.ground import availability_pieces
from tests.replay.journeys import VEHICLE, journey, replay

STOP = {
    "start_m": 200.0,
    "phases": [{"speed_mps": 30.0}, {"stop_at_m": 3900.0, "hold_s": 200.0}, {"speed_mps": 30.0}, {"stop_at_m": 8000.0}],
}
STANDS_S = (192.0, 388.0)


def frozen(odometer, begin_s, end_s, form):
    """The odometer with its counts held, or with speeds of zero, in between."""
    t_s = (odometer["t"] - odometer["t"][0]).dt.total_nanoseconds().to_numpy() * 1e-9
    distance = odometer["distance_m"].to_numpy()
    inside = (t_s >= begin_s) & (t_s < end_s)
    if form == "speed":
        speed = np.where(inside, 0.0, np.gradient(distance, t_s))
        return odometer.with_columns(distance_m=pl.lit(None, pl.Float64), speed_mps=pl.Series(speed))
    steps = np.where(inside, 0.0, np.diff(distance, prepend=distance[0]))
    held = pl.Series(distance[0] + np.cumsum(steps))
    return odometer.with_columns(distance_m=held, speed_mps=pl.lit(None, pl.Float64))


def row(tables):
    return tables.runs.row(0, named=True)


def between(tables, begin_s, end_s):
    since = (pl.col("t") - pl.col("t").first()).dt.total_nanoseconds() * 1e-9
    return tables.epochs.filter(since.is_between(begin_s, end_s))


@pytest.mark.parametrize("form", ["distance", "speed"])
def test_by_the_reference_a_frozen_odometer_is_no_standing_train(form):
    run, site = journey()
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 160.0, form)), site, VEHICLE)
    # The odometer contradicts the reference: nobody knows which of the two stands, so nobody says that the train does.
    assert False not in set(between(tables, 101.0, 159.0)["moving"])
    assert not between(tables, 102.0, 159.0)["tvb"].any()
    assert row(tables)["availability"] < 0.6


@pytest.mark.parametrize(
    ("form", "lost"), [("distance", ["reference"]), ("speed", ["reference", "balise_reads"])], ids=["reads", "alone"]
)
def test_without_a_reference_nobody_knows_whether_the_train_moved(form, lost):
    """Unknown counts as moving without a TVB: availability may be too low by that, never too high."""
    run, site = journey()
    run = run.with_streams(**dict.fromkeys(lost))
    plain = replay(run, site, VEHICLE)
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 1e9, form)), site, VEHICLE)
    inside = between(tables, 102.0, 230.0)
    assert inside["moving"].null_count() == inside.height
    moving = plain.epochs.filter(pl.col("moving"))["t"]
    share = moving.is_in(tables.epochs.filter(pl.col("tvb"))["t"].implode()).mean()
    assert row(tables)["availability"] <= share + 0.01
    assert row(tables)["verdict"] != "safe"
    assert "it is not known whether the train moved" in row(tables)["notes"]


def test_behind_the_last_read_a_standing_odometer_leaves_positions_unknown():
    run, site = journey()
    run = run.with_streams(reference=None)
    last_s = (run.balise_reads["t"][-1] - run.gnss["t"][0]).total_seconds()
    tables = replay(run.with_streams(odometer=frozen(run.odometer, last_s + 5.0, 1e9, "distance")), site, VEHICLE)
    assert set(between(tables, last_s + 10.0, 1e9)["judgement"]) == {"unknown"}


def test_a_train_that_stands_is_standing():
    run, site = journey(motion=STOP)
    for logs in (run, run.with_streams(reference=None), run.with_streams(reference=None, balise_reads=None)):
        tables = replay(logs, site, VEHICLE)
        assert set(between(tables, *STANDS_S)["moving"]) == {False}
        assert row(tables)["distance_m"] == pytest.approx(7800.0, abs=30.0)


def test_a_jump_of_the_position_is_no_movement():
    """It leaves the place of a standing train, so nobody knows; a reference does."""
    jump = {"kind": "step", "size_m": 300.0, "start_s": 250.0, "duration_s": 6.0}
    run, site = journey(jump, motion=STOP)
    assert set(between(replay(run, site, VEHICLE), 245.0, 260.0)["moving"]) == {False}
    tables = replay(run.with_streams(reference=None), site, VEHICLE)
    assert True not in set(between(tables, 245.0, 260.0)["moving"])


def test_the_report_counts_the_epochs_of_a_frozen_odometer():
    run, site = journey()
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 1e9, "distance")), site, VEHICLE)
    pieces = availability_pieces(tables.epochs.lazy())
    assert pieces["tvb"].sum() / pieces["epochs"].sum() == pytest.approx(row(tables)["availability"], abs=0.01)
