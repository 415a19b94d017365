"""An odometer that goes on reporting and counts no more; and trains that stand while their positions drift or leap."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.report.availability import availability_pieces
from pipeline.stages import replay
from tests.replay.journeys import VEHICLE, journey

VELOCITY = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
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
    if form == "leap":
        steps[np.flatnonzero(inside)[-1]] = np.diff(distance, prepend=distance[0])[inside].sum()
    held = pl.Series(distance[0] + np.cumsum(steps))
    return odometer.with_columns(distance_m=held, speed_mps=pl.lit(None, pl.Float64))


def told_by(run, witness):
    """The run with one kind of evidence at most beside positions and odometer."""
    nothing = [pl.lit(None, pl.Float64).alias(name) for name in VELOCITY]
    return run.with_streams(
        gnss=run.gnss if witness == "doppler" else run.gnss.with_columns(nothing),
        balise_reads=run.balise_reads if witness == "reads" else None,
        reference=run.reference if witness == "reference" else None,
    )


def row(tables):
    return tables.runs.row(0, named=True)


def between(tables, begin_s, end_s):
    since = (pl.col("t") - pl.col("t").first()).dt.total_nanoseconds() * 1e-9
    return tables.epochs.filter(since.is_between(begin_s, end_s))


@pytest.mark.parametrize("witness", ["reference", "reads", "doppler", "nothing"])
@pytest.mark.parametrize("form", ["distance", "speed", "leap"])
@pytest.mark.parametrize("end_s", [160.0, 1e9])
def test_a_frozen_odometer_is_no_standing_train(witness, form, end_s):
    run, site = journey()
    run = told_by(run, witness)
    plain = replay(run, site, VEHICLE)
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, end_s, form)), site, VEHICLE)
    stretch = between(tables, 101.0, min(end_s, 240.0) - 1.0)
    assert stretch["moving"].to_list() == [True] * stretch.height
    assert stretch["speed_mps"].min() > 20.0
    assert not stretch["tvb"].any()
    same = plain.epochs.filter(pl.col("moving"))["t"].is_in(tables.epochs.filter(pl.col("tvb"))["t"].implode())
    assert row(tables)["availability"] == pytest.approx(same.mean(), abs=0.01)
    assert row(tables)["availability"] < 0.45
    assert row(tables)["distance_m"] == pytest.approx(row(plain)["distance_m"], abs=25.0)
    assert "it was frozen" in row(tables)["notes"]


def test_the_report_counts_the_epochs_of_a_frozen_odometer():
    run, site = journey()
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 1e9, "distance")), site, VEHICLE)
    pieces = availability_pieces(tables.epochs.lazy())
    assert pieces["tvb"].sum() / pieces["epochs"].sum() == pytest.approx(row(tables)["availability"], abs=0.01)


def test_an_odometer_that_never_counts_leaves_nothing_available():
    run, site = journey()
    tables = replay(run.with_streams(odometer=frozen(run.odometer, -1.0, 1e9, "speed")), site, VEHICLE)
    assert row(tables)["availability"] == pytest.approx(0.0, abs=0.002)
    assert row(tables)["distance_m"] == pytest.approx(7800.0, abs=30.0)


def test_a_train_that_leaves_with_a_frozen_odometer():
    """It froze while the train stood; nothing but the positions tells, and they gather speed as a train does."""
    run, site = journey(motion=STOP)
    run = told_by(run, "nothing")
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 300.0, 1e9, "distance")), site, VEHICLE)
    assert set(between(tables, *STANDS_S)["moving"]) == {False}
    assert set(between(tables, 400.0, 500.0)["moving"]) == {True}
    assert "it was frozen" in row(tables)["notes"]


def test_a_slow_train_with_a_frozen_odometer_is_known_by_the_balises_that_it_reads():
    """At 5 m/s positions alone could be drifting."""
    slow = {**STOP, "phases": [*STOP["phases"][:2], {"speed_mps": 5.0}, {"stop_at_m": 8000.0}]}
    run, site = journey(motion=slow)
    dead = run.with_streams(odometer=frozen(run.odometer, 300.0, 1e9, "distance"))
    nothing, reads = (replay(told_by(dead, witness), site, VEHICLE) for witness in ("nothing", "reads"))
    before, after = (400.0, 445.0), (700.0, 740.0)
    assert between(nothing, *before)["moving"].null_count() == between(nothing, *before).height
    assert "nothing tells which is right" in row(nothing)["notes"]
    assert set(between(reads, *before)["moving"]) == set(between(reads, *after)["moving"]) == {True}
    assert row(nothing)["availability"] == pytest.approx(row(reads)["availability"], abs=0.01)


def test_no_brake_stops_a_train_like_a_frozen_odometer():
    """120 m within four seconds are too few to tell by the positions alone."""
    run, site = journey()
    dead = run.with_streams(odometer=frozen(run.odometer, 100.0, 104.0, "distance"))
    tables = replay(told_by(dead, "nothing"), site, VEHICLE)
    assert set(between(tables, 100.5, 103.5)["moving"]) == {True}
    assert "it was frozen" in row(tables)["notes"]


def test_a_frozen_odometer_whose_train_stops_at_a_station():
    run, site = journey(motion=STOP)
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 1e9, "distance")), site, VEHICLE)
    assert between(tables, 200.0, 380.0)["moving"].mean() == 0.0
    assert between(tables, 101.0, 180.0)["moving"].mean() == 1.0


WRONG = {
    "drift": [{"kind": "ramp", "rate_mps": 2.0, "start_s": 200.0, "duration_s": 60.0}],
    "fast drift": [{"kind": "ramp", "rate_mps": 12.0, "start_s": 200.0, "duration_s": 60.0}],
    "leap": [{"kind": "step", "size_m": 500.0, "start_s": 200.0}],
    "leap and back": [{"kind": "step", "size_m": 500.0, "start_s": 200.0, "duration_s": 6.0}],
}


@pytest.mark.parametrize("witness", ["reference", "doppler"])
@pytest.mark.parametrize("fault", WRONG)
def test_a_train_that_stands_while_its_position_is_wrong(fault, witness):
    run, site = journey(*WRONG[fault], motion=STOP)
    tables = replay(told_by(run, witness), site, VEHICLE)
    stands = between(tables, *STANDS_S)
    assert set(stands["moving"]) == {False}
    assert stands["speed_mps"].abs().max() < 0.3
    assert "stood still" not in (row(tables)["notes"] or "")
    assert row(tables)["distance_m"] == pytest.approx(7800.0, abs=10.0)


@pytest.mark.parametrize("fault", ["leap", "leap and back"])
def test_a_leap_alone_moves_no_train(fault):
    run, site = journey(*WRONG[fault], motion=STOP)
    tables = replay(told_by(run, "nothing"), site, VEHICLE)
    assert set(between(tables, *STANDS_S)["moving"]) == {False}


@pytest.mark.parametrize("rate_mps", [0.6, 2.0, 12.0])
def test_a_drift_that_leaps_back_was_one(rate_mps):
    fault = {"kind": "ramp", "rate_mps": rate_mps, "start_s": 200.0, "duration_s": 60.0, "returns": True}
    run, site = journey(fault, motion=STOP)
    tables = replay(told_by(run, "nothing"), site, VEHICLE)
    assert set(between(tables, *STANDS_S)["moving"]) == {False}


@pytest.mark.parametrize("fault", ["drift", "fast drift"])
def test_nobody_knows_whether_a_drift_without_a_witness_was_the_train(fault):
    run, site = journey(motion=STOP)
    wrong, _ = journey(*WRONG[fault], motion=STOP)
    plain, tables = (replay(told_by(log, "nothing"), site, VEHICLE) for log in (run, wrong))
    drift = between(tables, 202.0, 258.0)
    assert drift["moving"].null_count() == drift["speed_mps"].null_count() == drift.height
    assert set(between(tables, 270.0, 388.0)["moving"]) == {False}
    assert "nothing tells which is right" in row(tables)["notes"]
    assert row(tables)["distance_m"] == pytest.approx(row(plain)["distance_m"], abs=1.0)
    # All of the drift's minute counts as moving without a TVB.
    moving_s = 0.1 * plain.epochs["moving"].sum()
    valid_s = 0.1 * tables.epochs.filter("moving")["tvb"].sum()
    assert row(tables)["availability"] == pytest.approx(valid_s / (moving_s + 60.0), abs=0.01)


def test_where_the_train_was_after_an_outage_tells_not_how_it_came_there():
    outage = {"kind": "outage", "start_s": 200.0, "duration_s": 60.0}
    run, site = journey(outage, {"kind": "step", "size_m": 300.0, "start_s": 220.0}, motion=STOP)
    tables = replay(told_by(run, "doppler"), site, VEHICLE)
    assert "nothing tells which is right" in row(tables)["notes"]
    run, site = journey(outage, {"kind": "step", "size_m": 15.0, "start_s": 220.0}, motion=STOP)
    tables = replay(told_by(run, "doppler"), site, VEHICLE)
    assert "stood still" not in (row(tables)["notes"] or "")


def test_a_tunnel_with_a_frozen_odometer_counts():
    """No position for a minute of 30 m/s, over which the odometer gained nothing: no time of standing."""
    run, site = journey({"kind": "outage", "start_s": 100.0, "duration_s": 60.0})
    run = told_by(run, "doppler")
    tables = replay(run.with_streams(odometer=frozen(run.odometer, 100.0, 160.0, "distance")), site, VEHICLE)
    plain = replay(run, site, VEHICLE)
    assert row(tables)["availability"] <= row(plain)["availability"]
    assert "stood still" in row(tables)["notes"]


def test_an_odometer_that_ends_early_does_not_stand_from_then_on():
    run, site = journey()
    until = run.odometer["t"][0] + pl.duration(seconds=130)
    tables = replay(run.with_streams(odometer=run.odometer.filter(pl.col("t") < until)), site, VEHICLE)
    rest = between(tables, 135.0, 230.0)
    assert rest["moving"].mean() == 1.0
    assert not rest["tvb"].any()
    assert row(tables)["availability"] < 0.6


def kept(**gnss):
    """A run that keeps its epochs without a position; the train stops at a station in the middle of 120 s of them."""
    station = {**STOP, "phases": [STOP["phases"][0], {"stop_at_m": 3900.0, "hold_s": 40.0}, *STOP["phases"][2:]]}
    fault = {"kind": "outage", "start_s": 120.0, "duration_s": 120.0}
    return journey(fault, motion=station, gnss={"keep_lost": True, **gnss})


@pytest.mark.parametrize("rate_hz", [10.0, 1.0])
def test_a_station_in_a_tunnel_is_a_stand_of_a_healthy_odometer(rate_hz):
    run, site = kept(rate_hz=rate_hz)
    tables = replay(told_by(run, "doppler"), site, VEHICLE)
    assert set(between(tables, 192.0, 226.0)["moving"]) == {False}
    assert tables.epochs["moving"].null_count() == tables.epochs["speed_mps"].null_count() == 0
    assert "stood still" not in (row(tables)["notes"] or "")


def test_what_an_odometer_loses_at_a_station_in_a_tunnel_is_missed():
    """It stays at its count when the train leaves the station, 300 m before the end of the tunnel."""
    run, site = kept()
    run = told_by(run, "doppler")
    dead = run.with_streams(odometer=frozen(run.odometer, 200.0, 254.0, "distance"))
    tables = replay(dead, site, VEHICLE)
    assert "stood still" in row(tables)["notes"]
    assert row(tables)["availability"] <= row(replay(run, site, VEHICLE))["availability"]


@pytest.mark.parametrize("sigma_m", [2.0, 5.0])
@pytest.mark.parametrize("seed", [5, 6])
def test_noise_of_positions_adds_up_to_no_movement_however_long_the_train_stands(sigma_m, seed):
    """White noise for half an hour, beside which the odometer is healthy."""
    stand = {**STOP, "phases": [STOP["phases"][0], {"stop_at_m": 3900.0, "hold_s": 1800.0}, *STOP["phases"][2:]]}
    noise = {"kind": "noise", "sigma_m": sigma_m, "start_s": 200.0, "duration_s": 1700.0}
    run, site = journey(noise, motion=stand, gnss={"rate_hz": 1.0}, seed=seed)
    tables = replay(told_by(run, "nothing"), site, VEHICLE)
    assert set(between(tables, 192.0, 1980.0)["moving"]) == {False}
    assert "stood still" not in (row(tables)["notes"] or "")


def test_a_train_that_turns_at_once_did_not_stand_where_it_began():
    """1500 m ahead and as many back with an odometer that counts nothing come to nothing in the sum."""
    ahead = [{"speed_mps": 20.0}, {"stop_at_m": 4000.0}]
    back = [{"speed_mps": -20.0}, {"stop_at_m": 2500.0, "hold_s": 20.0}]
    rest = [{"speed_mps": 30.0}, {"stop_at_m": 8000.0}]
    run, site = journey(motion={"start_m": 2500.0, "phases": [*ahead, *back, *rest]})
    dead = run.with_streams(odometer=frozen(run.odometer, 20.0, 1e9, "distance"))
    tables = replay(told_by(dead, "nothing"), site, VEHICLE)
    assert between(tables, 25.0, 200.0)["moving"].mean() > 0.98
    assert row(tables)["distance_m"] == pytest.approx(8500.0, abs=60.0)


def test_reads_tell_of_an_odometer_that_was_frozen_between_them():
    """At 5 m/s nothing else can. It counts again before the last read, so that nobody knows when the way was lost."""
    slow = [{"speed_mps": 5.0, "hold_s": 500.0}, {"speed_mps": 30.0}, {"stop_at_m": 8000.0}]
    run, site = journey(motion={"start_m": 200.0, "phases": slow})
    dead = run.with_streams(odometer=frozen(run.odometer, 190.0, 430.0, "distance"))
    tables = replay(told_by(dead, "reads"), site, VEHICLE)
    assert set(between(tables, 195.0, 425.0)["moving"]) == {True}
    assert row(tables)["distance_m"] == pytest.approx(7800.0, abs=20.0)


@pytest.mark.parametrize("witness", ["nothing", "reference"])
def test_no_alarm_is_right_by_an_odometer_that_was_frozen(witness):
    """The hazard stands, for nobody can exclude it; whether the alarm was a false one the reference knows alone."""
    run, site = journey()
    dead = told_by(run, witness).with_streams(odometer=frozen(run.odometer, 100.0, 1e9, "distance"))
    tables = replay(dead, site, VEHICLE)
    verdicts = set(tables.alarms["verdict"])
    if witness == "reference":
        assert verdicts == {"false"}
        assert row(tables)["false_alarm_rate_per_h"] > 0.0
        return
    assert verdicts == {"unknown"}
    assert set(tables.hazards["suspect"]) == {"unknown"}
    assert row(tables)["false_alarm_rate_per_h"] is None
    assert row(tables)["failures"] > 0


def test_an_alarm_before_the_odometer_froze_keeps_its_verdict():
    leap = {"kind": "step", "size_m": 850.0, "start_s": 60.0, "duration_s": 6.0}
    run, site = journey(leap)
    dead = run.with_streams(odometer=frozen(run.odometer, 200.0, 1e9, "distance"))
    alarms = replay(told_by(dead, "nothing"), site, VEHICLE).alarms
    assert alarms["verdict"][0] == "true"
    assert alarms["verdict"][-1] == "unknown"
