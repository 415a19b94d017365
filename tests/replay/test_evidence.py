"""The same faults with a reference, with physical balises alone, and with nothing but the odometer."""

from __future__ import annotations

import dataclasses
from datetime import timedelta

import polars as pl
import pytest

from schemas.run import Finding
from tests.replay.journeys import VEHICLE, journey, replay

JUMP = {"kind": "step", "size_m": 850.0, "start_s": 150.0, "duration_s": 6.0}
OFFSET = {"kind": "step", "size_m": 50.0, "start_s": 140.0, "duration_s": 60.0}
# 2 m/s from just after VB3 (accepted 3400 m) on: 60 m at VB4, 900 m beyond, where the odometer knows 50 m.
EARLY = {"kind": "ramp", "rate_mps": 2.5, "at_m": 3450.0, "duration_s": 30.0}
SLIP = {"kind": "slip", "rate_mps": 20.0, "start_s": 150.0, "duration_s": 2.0}
FAULTS = {"jump": JUMP, "offset": OFFSET, "early": EARLY}


def kinds_of(run):
    """The run with each kind of evidence."""
    return {
        "reference": run,
        "balise": run.with_streams(reference=None),
        "odometer": run.with_streams(reference=None, balise_reads=None),
    }


def rows(tables):
    return [
        (row["hazard"], row["balise_ids"], row["caused_by"], row["timing"])
        for row in tables.hazards.iter_rows(named=True)
    ]


@pytest.mark.parametrize("name", FAULTS)
def test_balise_reads_find_what_the_reference_finds(name):
    run, site = journey(FAULTS[name])
    found = {kind: replay(logs, site, VEHICLE) for kind, logs in kinds_of(run).items()}
    assert rows(found["reference"])
    assert rows(found["balise"]) == rows(found["reference"])
    for kind, tables in found.items():
        assert tables.runs["evidence"].to_list() == [kind]
        assert tables.hazards["evidence"].to_list() == [kind] * tables.hazards.height


def test_odometer_alone_finds_what_exceeds_its_confidence():
    run, site = journey(JUMP)
    logs = kinds_of(run)
    assert rows(replay(logs["odometer"], site, VEHICLE)) == rows(replay(run, site, VEHICLE))
    ramp, _ = journey({**EARLY, "rate_mps": 5.0})
    hazards = rows(replay(kinds_of(ramp)["odometer"], site, VEHICLE))
    assert [row[0] for row in hazards] == ["VB_SHIFT"]


def test_odometer_alone_does_not_see_an_offset_within_its_confidence_and_says_so():
    # 30 m, 900 m beyond the last accepted balise, where 5 m + 5 % are 50 m.
    run, site = journey({**OFFSET, "size_m": 30.0})
    logs = kinds_of(run)
    assert len(rows(replay(run, site, VEHICLE))) == 1
    blind = replay(logs["odometer"], site, VEHICLE)
    assert rows(blind) == []
    notes = blind.runs["notes"].item()
    assert "never that it was right" in notes
    with_reference = replay(logs["reference"], site, VEHICLE).runs["notes"].item()
    assert "available for" in with_reference
    assert "never that it was right" not in with_reference


def test_balises_accepted_while_no_odometer_could_contradict_are_reported():
    run, site = journey(OFFSET)
    undiagnosed = "virtual balises accepted without a monitor along the track"
    assert undiagnosed not in (replay(run, site, VEHICLE).runs["notes"].item() or "")
    without = replay(run.with_streams(odometer=None), site, VEHICLE)
    accepted = without.passages.filter((pl.col("kind") == "virtual") & (pl.col("status") == "accepted"))
    assert f"{accepted.height} {undiagnosed} (no odometer): a jump" in without.runs["notes"].item()
    begin = run.odometer["t"][0]
    pause = pl.col("t").is_between(begin + timedelta(seconds=135), begin + timedelta(seconds=205))
    paused = replay(run.with_streams(odometer=run.odometer.filter(~pause)), site, VEHICLE)
    inside = paused.passages.filter(
        (pl.col("kind") == "virtual")
        & (pl.col("status") == "accepted")
        & pl.col("t_offered").is_between(begin + timedelta(seconds=137), begin + timedelta(seconds=205))
    )
    assert inside.height > 0
    assert f"{inside.height} {undiagnosed} (odometer interrupted or slipping): a jump" in paused.runs["notes"].item()
    middle = begin + timedelta(seconds=100)
    for kept, word in ((pl.col("t") < middle, "begins +0 s and ends -"), (pl.col("t") > middle, "begins +100 s")):
        part = replay(run.with_streams(odometer=run.odometer.filter(kept)), site, VEHICLE)
        undiagnosed_passages = part.passages.filter(
            (pl.col("kind") == "virtual") & (pl.col("status") == "accepted"),
            (pl.col("t_offered") >= middle) if "ends" in word else (pl.col("t_offered") <= middle),
        )
        assert undiagnosed_passages.height > 0
        notes = part.runs["notes"].item()
        assert f"{undiagnosed_passages.height} {undiagnosed} (outside the odometer's time span): a jump" in notes
        assert f"the odometer {word}" in notes


def test_positions_left_out_for_their_time_are_reported():
    run, site = journey(OFFSET)
    undated = run.gnss.head(3).with_columns((pl.col("t") - timedelta(weeks=1024)).cast(run.gnss["t"].dtype))
    doubled = run.gnss[500:510].with_columns(pl.col("latitude_deg") + 0.001)
    both = run.with_streams(gnss=pl.concat([undated, run.gnss, doubled]))
    row, plain = replay(both, site, VEHICLE).runs, replay(run, site, VEHICLE).runs
    assert "3 positions left out: their time is more than a day from the others" in row["notes"].item()
    assert "10 positions left out: they contradict an earlier record with the same time stamp" in row["notes"].item()
    assert row["duration_s"].item() == plain["duration_s"].item()
    assert row["distance_m"].item() == plain["distance_m"].item()


@pytest.mark.parametrize("kind", ["reference", "balise", "odometer"])
def test_slip_is_no_hazard_with_any_evidence(kind):
    run, site = journey(SLIP)
    tables = replay(kinds_of(run)[kind], site, VEHICLE)
    assert rows(tables) == []
    assert tables.alarms["suspect"].unique().to_list() == ["odometer"]


def test_slip_between_two_reads_is_no_hazard_without_doppler_either():
    # 40 m between two reads 900 m apart: within 5 m + 5 % from both sides, but far beyond the odometer's noise.
    run, site = journey(SLIP, gnss={"velocity": False})
    tables = replay(kinds_of(run)["balise"], site, VEHICLE)
    assert rows(tables) == []
    assert tables.runs["unsafe_accepted"].item() == 0
    assert tables.alarms["verdict"].to_list() == ["unknown"]
    both, _ = journey(SLIP, {**OFFSET, "size_m": 120.0, "start_s": 170.0}, gnss={"velocity": False})
    assert rows(replay(kinds_of(both)["balise"], site, VEHICLE))


SLIDE = {"kind": "slip", "rate_mps": -30.0, "start_s": 150.0, "duration_s": 4.0}


def test_slide_as_quick_as_a_jump_between_two_reads_leaves_errors_unknown():
    run, site = journey(SLIDE, gnss={"velocity": False})
    tables = replay(kinds_of(run)["balise"], site, VEHICLE)
    assert rows(tables) == []
    assert tables.runs["unsafe_accepted"].item() == 0
    assert tables.alarms["verdict"].to_list() == ["unknown"]
    assert tables.runs["odometer_contradicted"].item() == 1
    assert "disagrees with 1 distances" in tables.runs["notes"].item()
    unknown = tables.passages.filter(pl.col("judgement") == "unknown")
    assert unknown.height
    between = tables.epochs.filter(pl.col("t").is_between(unknown["t_offered"][0], unknown["t_offered"][-1]))
    assert between["error_along_m"].null_count() == between.height
    unknown = between.filter(pl.col("judgement") == "unknown")
    assert unknown.height
    assert not unknown["lds_state"].is_in(["P0", "P1"]).any()


@pytest.mark.parametrize(("size_m", "detected"), [(300.0, True), (-300.0, True), (60.0, True), (-60.0, False)])
def test_a_jump_beside_a_slip_is_wrong_where_the_slip_cannot_account_for_it(size_m, detected):
    """The odometer slips by 120 m between two reads: anything less may as well be the odometer's."""
    step = {"kind": "step", "size_m": size_m, "at_m": 4260.0 if size_m > 0 else 4330.0, "duration_s": 10.0}
    slip = {"kind": "slip", "rate_mps": 30.0, "start_s": 188.0, "duration_s": 4.0}
    run, site = journey(slip, step, gnss={"velocity": False})
    by_reference, by_reads = replay(run, site, VEHICLE), replay(kinds_of(run)["balise"], site, VEHICLE)
    assert rows(by_reference)
    assert bool(rows(by_reads)) is detected
    assert by_reads.runs["verdict"].item() != "safe"


def test_physical_balises_are_judged_beside_the_virtual_ones():
    run, site = journey()
    passages = replay(run, site, VEHICLE).passages
    assert passages.group_by("kind", "status").len().sort("kind").rows() == [
        ("virtual", "accepted", 8),
        ("physical", "accepted", 8),
    ]
    physical = passages.filter(pl.col("kind") == "physical")
    assert physical["location_error_m"].abs().max() < 0.5


def test_physical_balise_brings_a_position_back():
    # A persisting 50 m offset never re-links; after the slip of 40 m only the next balise group can tell.
    run, site = journey(SLIP)
    by_read = replay(run, site, VEHICLE).passages
    blind = replay(run.with_streams(balise_reads=None), site, VEHICLE).passages
    accepted = [
        frame.filter((pl.col("kind") == "virtual") & (pl.col("status") == "accepted")).height
        for frame in (by_read, blind)
    ]
    assert accepted[0] > accepted[1]


def test_distance_and_speed_by_turns_are_an_odometer():
    """Two sensors in one stream: each row holds the one or the other."""
    run, site = journey(JUMP)
    logs = run.with_streams(reference=None, balise_reads=None)
    odd = pl.int_range(pl.len()) % 2 == 1
    turns = logs.odometer.with_columns(
        distance_m=pl.when(~odd).then(pl.col("distance_m")), speed_mps=pl.when(odd).then(pl.col("speed_mps"))
    )
    found, whole = (replay(logs.with_streams(odometer=stream), site, VEHICLE) for stream in (turns, logs.odometer))
    assert rows(found) == rows(whole)
    assert rows(whole)
    assert found.alarms["monitors"].to_list() == whole.alarms["monitors"].to_list()


def test_a_covariance_that_contradicts_itself_stands_in_the_notes():
    run, site = journey()
    ee = pl.col("cov_ee_m2")
    broken = run.with_streams(gnss=run.gnss.with_columns(cov_en_m2=pl.when(pl.int_range(pl.len()) < 7).then(9.0 * ee)))
    assert "cov_en_m2 is inconsistent with the variances at 7 epochs" in replay(broken, site, VEHICLE).runs["notes"][0]


def test_windows_stand_after_a_pause_of_an_odometer_of_speed_alone():
    """The way of the pause is guessed from the speeds around it; taken as none, the next balise would come early."""
    run, site = journey()
    at_s = (pl.col("t") - run.odometer["t"][0]).dt.total_microseconds() / 1e6
    paused = run.odometer.with_columns(distance_m=pl.lit(None, pl.Float64)).filter(~at_s.is_between(120.0, 124.0))
    passages = replay(run.with_streams(odometer=paused), site, VEHICLE).passages
    whole = replay(run, site, VEHICLE).passages
    assert passages["linking_error"].cast(str).to_list() == ["none"] * whole.height
    assert passages["status"].to_list() == whole["status"].to_list()


def test_a_balise_read_inside_an_outage_is_placed_by_the_odometer_of_then():
    # The train stands for 40 s inside the outage; a straight line over it would put the read 150 m away.
    stops = [{"speed_mps": 30.0}, {"stop_at_m": 3150.0, "hold_s": 40.0}, {"speed_mps": 30.0}, {"stop_at_m": 8000.0}]
    run, site = journey(motion={"start_m": 200.0, "phases": stops})
    read = run.balise_reads.filter(balise_id="BG3")
    at, s = read["t"].item(), timedelta(seconds=1)
    outage = pl.col("t").is_between(at - 60 * s, at + 5 * s)
    logs = run.with_streams(reference=None, balise_reads=read, gnss=run.gnss.filter(~outage))
    tables = replay(logs, site, VEHICLE)
    assert tables.hazards.height == 0
    assert tables.runs["unsafe_accepted"].item() == 0
    assert "wrong" not in set(tables.epochs["judgement"])


def test_balises_that_lie_off_their_net_element_are_reported():
    run, site = journey(OFFSET)
    assert "off their net element" not in (replay(run, site, VEHICLE).runs["notes"].item() or "")
    finding = Finding("error", "balises: VB9", "measure 99999.0 m is off element A", "Correct measure_m.")
    notes = replay(run, dataclasses.replace(site, findings=(finding,)), VEHICLE).runs["notes"].item()
    assert "no run passes them (`balise inspect SITE` says why): VB9" in notes


STOPPING = {
    "start_m": 200.0,
    "phases": [
        {"speed_mps": 30.0, "acceleration_mps2": 0.8},
        {"stop_at_m": 2200.0, "acceleration_mps2": 0.8},
        {"speed_mps": 30.0, "acceleration_mps2": 0.8},
        {"stop_at_m": 4800.0, "acceleration_mps2": 0.8},
        {"speed_mps": 20.0, "acceleration_mps2": 0.8},
        {"stop_at_m": 7500.0, "acceleration_mps2": 0.8},
    ],
}


def thinned(run, period_s):
    """The run with a reference sample each `period_s` only."""
    reference = run.reference
    step = (reference["t"][1] - reference["t"][0]).total_seconds()
    return run.with_streams(reference=reference.gather_every(round(period_s / step)))


@pytest.mark.parametrize("period_s", [5.0, 30.0])
def test_errors_are_the_same_by_a_reference_of_few_samples(period_s):
    # The train starts and brakes; a straight line over 10 s is up to 9 m off, over 30 s up to 80 m.
    run, site = journey(motion=STOPPING)
    dense, sparse = (replay(log, site, VEHICLE) for log in (run, thinned(run, period_s)))
    assert sparse.hazards.is_empty()
    judged = sparse.epochs.select("t", "error_along_m").drop_nulls().join(dense.epochs, on="t", suffix="_dense")
    assert judged.height > 0.8 * run.gnss.height
    assert (judged["error_along_m"] - judged["error_along_m_dense"]).abs().max() < 1.0
    assert sparse.runs["unsafe_accepted"].item() == 0


def test_offset_is_found_by_a_reference_of_few_samples():
    run, site = journey({**OFFSET, "size_m": 60.0})
    dense, sparse = (replay(log, site, VEHICLE).hazards for log in (run, thinned(run, 5.0)))
    columns = ("hazard", "failure_mode", "timing", "evidence", "balise_ids", "accepted_ids", "detected")
    assert dense.select(columns).rows() == sparse.select(columns).rows() != []
    assert sparse["evidence"].unique().to_list() == ["reference"]
    assert sparse["size_m"][0] == pytest.approx(60.0, abs=5.0)


def test_without_an_odometer_a_reference_of_few_samples_tells_nothing_between_them():
    run, site = journey({**OFFSET, "size_m": 60.0})
    tables = replay(thinned(run, 5.0).with_streams(odometer=None), site, VEHICLE)
    assert (tables.epochs["judgement"] == "unknown").mean() > 0.95
    assert tables.runs["verdict"].item() != "safe"


def test_a_counter_that_is_reset_costs_nothing_and_is_reported():
    run, site = journey()
    row = pl.int_range(pl.len())
    reset = pl.col("distance_m") - pl.when(row >= 4000).then(2000.0).otherwise(0.0)
    plain, found = (
        replay(logs, site, VEHICLE) for logs in (run, run.with_streams(odometer=run.odometer.with_columns(reset)))
    )
    same = ("balises_accepted", "balises_rejected", "balises_missed", "alarms")
    assert found.runs.select(same).row(0) == plain.runs.select(same).row(0)
    assert found.passages["status"].unique().to_list() == ["accepted"]
    assert found.runs["distance_m"].item() == pytest.approx(plain.runs["distance_m"].item(), abs=5.0)
    assert "the odometer distance jumps 1 times by more than a train can run" in found.runs["notes"].item()


def test_an_odometer_with_a_row_every_five_seconds_raises_no_alarm():
    run, site = journey()
    sparse = run.with_streams(odometer=run.odometer.gather_every(100))
    found = replay(sparse, site, VEHICLE)
    assert found.runs["alarms"].item() == 0
    assert found.passages["status"].unique().to_list() == ["accepted"]
    assert "the odometer has only one row every 5 s" in found.runs["notes"].item()
