"""Where, how fast and how well known: columns of passages and alarms that the campaign's tables rest on."""

from __future__ import annotations

import polars as pl
import pytest

from datasets.motion import MotionSpec, build_motion
from tests.replay.journeys import PLACES_M, VEHICLE, journey, replay

OFFSET = {"kind": "step", "size_m": 45.0, "start_s": 150.0, "duration_s": 60.0}
BRAKING = {"start_m": 200.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 8000.0, "acceleration_mps2": 0.2}]}


def own_accuracy(site, balise, accuracy_m):
    own = pl.when(pl.col("balise_id") == balise).then(accuracy_m).otherwise(pl.col("location_accuracy_m"))
    return site.__class__(**{**vars(site), "balises": site.balises.with_columns(location_accuracy_m=own)})


def test_passages_carry_the_speed_and_the_accuracy_of_their_balise():
    run, site = journey(motion=BRAKING)
    found = replay(run, own_accuracy(site, "VB2", 5.0), VEHICLE).passages
    accuracy = dict(found.select("balise_id", "location_accuracy_m").iter_rows())
    assert (accuracy.pop("VB2"), set(accuracy.values())) == (5.0, {12.0})
    speed = dict(found.filter(pl.col("kind") == "virtual").select("balise_id", "speed_mps").iter_rows())
    # 2 a s back from the stop at 8000 m: 900 m before it at 0.2 m/s2, cruising farther off.
    assert speed["VB7"] == pytest.approx((2 * 0.2 * 900.0) ** 0.5, abs=0.2)
    assert speed["VB3"] == pytest.approx(30.0, abs=0.2)


def test_the_speed_in_a_hole_of_the_epochs_is_not_known():
    run, site = journey({"kind": "outage", "start_s": 80.0, "duration_s": 20.0})
    found = replay(run, site, VEHICLE).passages
    lost = found.filter(pl.col("t_offered").is_null())
    assert lost["balise_id"].to_list() == ["VB1"]
    assert lost["t_true"].null_count() == 0
    assert lost["speed_mps"].to_list() == [None]


STOPPING = {
    "start_m": 200.0,
    "phases": [{"speed_mps": 30.0}, {"stop_at_m": 2600.0, "hold_s": 15.0}, {"speed_mps": 25.0}, {"stop_at_m": 8000.0}],
}


@pytest.mark.parametrize("duration_s", [90.0, 140.0])
@pytest.mark.parametrize("lost", [[], ["reference"]])
def test_passages_inside_a_hole_of_the_epochs_are_timed_by_what_goes_on_there(lost, duration_s):
    # The train brakes, stands and starts inside the hole, longer than the speeds at its ends can bridge or not.
    run, site = journey({"kind": "outage", "start_s": 80.0, "duration_s": duration_s}, motion=STOPPING)
    found = replay(run.with_streams(**dict.fromkeys(lost)), site, VEHICLE).passages
    motion = build_motion(MotionSpec.model_validate(STOPPING))
    hidden = found.filter(pl.col("t_offered").is_null())
    assert hidden["balise_id"].to_list()[:2] == ["VB1", "VB2"]
    at_s = (hidden["t_true"] - run.gnss["t"][0]).dt.total_nanoseconds() * 1e-9
    places = dict(zip([f"VB{i}" for i in range(len(PLACES_M))], PLACES_M, strict=True))
    expected = [motion.time_at(places[balise]) for balise in hidden["balise_id"]]
    assert at_s.to_list() == pytest.approx(expected, abs=0.2)


def test_alarms_stand_at_the_place_of_their_first_fail():
    run, site = journey(OFFSET)
    tables = replay(run, site, VEHICLE)
    first = tables.alarms.row(0, named=True)
    epoch = tables.epochs.filter(pl.col("t") == first["t_start"]).row(0, named=True)
    assert first["netelement_id"] is not None
    assert (first["netelement_id"], first["measure_m"]) == (epoch["netelement_id"], epoch["measure_m"])


def test_the_odometer_alone_tells_no_true_passage():
    run, site = journey()
    alone = replay(run.with_streams(reference=None, balise_reads=None), site, VEHICLE).passages
    assert alone["t_true"].null_count() == alone["location_error_m"].null_count() == alone.height
