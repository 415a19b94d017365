"""The five defects of the judge before: each a run that it called healthy, by name (issue 19)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.stages.judge.accounts import BUDGET_S
from tests.stages.judge.faults import Fault, Slip
from tests.stages.judge.findings import CI_LIMIT_M, LIMIT_M, Rung, findings, rungs_of
from tests.stages.judge.ground import make_ground
from tests.stages.judge.ride import Leg
from tests.stages.judge.sensors import Better, Counter
from tests.stages.judge.world import World, make_journey

LINE = make_ground(18000.0, bend_deg=3.0)
LEGS = (Leg(0.0, 15.0), Leg(25.0, 400.0), Leg(0.0, 15.0))
BASE = World(LINE, LEGS, virtual_every_m=300.0)
PARALLEL = World(make_ground(18000.0, neighbour=(2000.0, 9000.0, 4.0)), LEGS, virtual_every_m=300.0)
# No read on the parallel part: none tells the program the track.
NEIGHBOUR = replace(PARALLEL, physical_every_m=9600.0)


def _judged(world: World, seed: int, name: str) -> dict[str, Rung]:
    """All rungs, each without a breach of the definitions."""
    journey = make_journey(world, seed, name)
    rungs = rungs_of(journey)
    found = findings(journey, rungs)
    assert not found, "\n".join(found)
    return rungs


def _faulty(*faults: Fault, base: World = BASE, **receiver: float) -> World:
    return replace(base, receiver=replace(base.receiver, faults=faults, **receiver))  # type: ignore[arg-type]


def _wrong(rung: Rung, begin_s: float, end_s: float) -> float:
    """Share of the epochs from begin to end that are judged wrong."""
    inside = (rung.epochs.time_s >= begin_s) & (rung.epochs.time_s < end_s)
    return float((rung.epochs.judgement[inside] == "wrong").mean())


def _accepted_wrong_by_truth(rung: Rung) -> int:
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy()
    return int((accepted & (np.abs(rung.passages.error_m) > LIMIT_M + 1.0)).sum())


@pytest.mark.parametrize("size_m", [-40.0, 181.0])
def test_position_and_doppler_with_the_same_fault(size_m: float) -> None:
    """30 s between two reads that agree with the odometer, the velocity carries the fault."""
    rungs = _judged(_faulty(Fault("step", 150.0, 180.0, size_m=size_m, in_velocity=True)), 21, f"same fault {size_m}")
    for name in ("reference", "balise"):
        rung = rungs[name]
        assert _wrong(rung, 150.5, 179.5) > 0.95, f"{name}: errors of {size_m} m are not judged wrong"
        assert rung.tables.hazards.height > 0, f"{name}: no hazard"
        assert rung.row["verdict"] == "unsafe", name
    verdicts = rungs["reference"].tables.alarms["verdict"].cast(pl.String).to_list()
    assert verdicts.count("false") == 0, f"a right alarm is called false: {verdicts}"
    sizes = rungs["reference"].tables.hazards["size_m"].to_numpy()
    assert np.abs(np.abs(sizes).max() - abs(size_m)) < 5.0


@pytest.mark.parametrize("in_velocity", [True, False], ids=["in_velocity", "position_alone"])
def test_an_early_slow_drift(in_velocity: bool) -> None:
    """0.15 m/s from the 20th second, without a vehicle file: learned away as scale, with VBs accepted far off."""
    legs = (Leg(0.0, 15.0), Leg(18.0, 620.0))
    drift = Fault("ramp", 20.0, 1e9, rate_mps=0.15, in_velocity=in_velocity)
    world = replace(_faulty(drift, base=replace(BASE, legs=legs)), vehicle=None)
    rungs = _judged(world, 22, "early drift")
    wrong = _accepted_wrong_by_truth(rungs["reference"])
    assert rungs["reference"].row["unsafe_accepted"] == wrong or wrong == 0
    assert _wrong(rungs["reference"], 170.0, 600.0) > 0.99
    for name, rung in rungs.items():
        assert rung.row["verdict"] != "safe", name
    if wrong:
        assert rungs["reference"].row["verdict"] == "unsafe"


def test_the_neighbour_track() -> None:
    """Positions run on the track 4 m aside; a reference of 5 cm lies on the other one."""
    world = replace(_faulty(Fault("other_track", 0.0, 1e9), base=NEIGHBOUR, sigma_m=0.1), better=Better(sigma_m=0.05))
    rungs = _judged(world, 23, "neighbour")
    rung = rungs["reference"]
    deep = rung.epochs.beside & rung.epochs.sure & (rung.epochs.apart_m > 3.5)
    assert deep.sum() > 50, "the positions are not matched to the other track: nothing is tested"
    assert (rung.epochs.judgement[deep] == "wrong").mean() > 0.98
    accepted = (rung.offers["status"].cast(pl.String) == "accepted").to_numpy() & rung.passages.beside
    assert rung.number("unsafe_accepted") >= int((accepted & (rung.passages.apart_m > 3.5)).sum())
    assert rung.number("hazards_wrong_track") >= 1
    assert "VB_WRONG_TRACK" in rung.tables.hazards["hazard"].cast(pl.String).to_list()
    assert rung.row["verdict"] == "unsafe"
    share = rung.row["share_p0"]
    assert share is None or rung.number("share_p0") < 0.6
    assert rungs["odometer"].row["verdict"] != "safe"


def test_reads_tell_the_track() -> None:
    """Physical balises of the train's own track are read between both switches; positions lie on the other track."""
    world = _faulty(Fault("other_track", 0.0, 1e9), base=PARALLEL, sigma_m=0.1)
    rung = _judged(world, 24, "neighbour by reads")["balise"]
    between = rung.epochs.beside & rung.epochs.sure & (rung.epochs.apart_m > 3.5)
    if between.sum() > 50:
        assert (rung.epochs.judgement[between] == "right").sum() == 0
        assert rung.row["verdict"] != "safe"


def test_a_returned_fault_counts_its_whole_time() -> None:
    """A slow drift to 60 m that stays: where the LDS returns to it, the time after the return counts too."""
    fault = (Fault("step", 120.0, 320.0, size_m=45.0, in_velocity=True),)
    rungs = _judged(_faulty(*fault, base=replace(BASE, vehicle=None)), 25, "returned")
    rung = rungs["reference"]
    surely, at_most = rung.in_use
    wrong = rung.epochs.judgement == "wrong"
    counted, most = float(rung.counted_s(wrong & surely).sum()), float(rung.counted_s(wrong & at_most).sum())
    assert counted > 0 or most > 0, "the fault was never in use: nothing is tested"
    hazardous = float(rung.tables.hazards["hazardous_s"].sum())
    assert max(hazardous, rung.number("hazardous_max_s")) >= counted - 1e-6
    assert rung.row["verdict"] == "unsafe"
    assert not rung.tables.hazards["within_budget"].fill_null(False).all()
    if _accepted_wrong_by_truth(rung):
        hit = rung.tables.hazards.filter(pl.col("accepted_ids").list.len() > 0)
        assert hit.height > 0
        assert not hit["within_budget"].fill_null(False).any(), "a VB was accepted wrong, yet within the budget"


@pytest.mark.parametrize("late_s", [1.0, -1.0])
def test_stamps_a_second_off(late_s: float) -> None:
    """No vehicle file: what a learned latency explains is still 30 m that a train would have been wrong by."""
    legs = (Leg(0.0, 15.0), Leg(30.0, 340.0), Leg(0.0, 15.0))
    fault = Fault("latency", 0.0, 1e9, size_s=late_s)
    rungs = _judged(replace(_faulty(fault, base=replace(BASE, legs=legs)), vehicle=None), 26, f"stamps {late_s} s late")
    rung = rungs["reference"]
    assert _wrong(rung, 90.0, 330.0) > 0.99
    assert _accepted_wrong_by_truth(rung) == rung.row["unsafe_accepted"]
    assert rung.number("along_error_max_m") == pytest.approx(30.0, abs=3.5)
    surely, _ = rung.in_use
    if (surely & (np.abs(rung.epochs.error_m) > LIMIT_M + 1.0)).any():
        assert rung.row["verdict"] == "unsafe"
    assert rung.tables.hazards.height > 0
    assert all(other.row["verdict"] != "safe" for other in rungs.values())


def test_a_reference_that_pauses_with_the_receiver() -> None:
    """Both are silent for 45 s in a tunnel; the receiver comes back 45 m off before the reference does."""
    world = _faulty(Fault("tunnel", 150.0, 195.0, size_m=45.0))
    rungs = _judged(replace(world, better=Better(pauses=((150.0, 200.0),))), 27, "pause")
    rung = rungs["reference"]
    assert _wrong(rung, 195.0, 205.0) > 0.95
    surely, _ = rung.in_use
    used = surely & (np.abs(rung.epochs.error_m) > LIMIT_M + 1.0)
    assert rung.number("failures") >= 1 or not used.any()


def test_a_pause_over_an_error() -> None:
    """The reference is silent for 45 s while the receiver is 45 m off: anchors on both sides tell it."""
    world = _faulty(Fault("step", 160.0, 185.0, size_m=45.0, in_velocity=True))
    world = replace(world, better=Better(pauses=((150.0, 195.0),)))
    rung = _judged(world, 28, "pause over an error")["reference"]
    assert _wrong(rung, 160.5, 184.5) > 0.95
    assert rung.number("failures") >= 1
    assert rung.row["verdict"] == "unsafe"


def test_a_step_at_1_hz_costs_two_seconds() -> None:
    """One second before anyone can see it, one until the negation (DOMAIN 5.3)."""
    rung = _judged(_faulty(Fault("step", 150.0, 175.0, size_m=60.0)), 29, "step")["reference"]
    alarm = rung.tables.epochs["alarm"].to_numpy()
    first = rung.epochs.time_s[alarm].min()
    assert first == pytest.approx(150.0), f"the step is not detected at once but at {first} s: nothing is tested"
    assert rung.number("hazardous_max_s") == pytest.approx(2.0, abs=0.01)
    assert rung.row["verdict"] == "unsafe"
    assert rung.row["failures_within_budget"] == 0
    kept = dict(zip(rung.tables.runs["service_levels"][0], rung.tables.runs["level_verdict"][0], strict=True))
    assert {kept["lpv200"], kept["egnos_observed"]} == {"exceeded"}


def test_a_large_stated_sigma_hides_no_hazard() -> None:
    """The receiver states 50 m and is 60 m off: not in use, but offered and judged all the same."""
    world = _faulty(Fault("step", 0.0, 1e9, size_m=60.0), stated_sigma_m=50.0)
    rung = _judged(world, 30, "sigma 50 m")["reference"]
    assert rung.tables.epochs["confidence_m"].min() > CI_LIMIT_M  # type: ignore[operator]
    assert _wrong(rung, 60.0, 400.0) > 0.99
    assert rung.tables.hazards.height > 0
    assert (rung.passages.judgement == "wrong").sum() >= 15
    assert rung.row["verdict"] != "safe"


@pytest.mark.parametrize(
    "fault",
    [Fault("step", 0.0, 1e9, size_m=40.0), Fault("step", 150.0, 1e9, size_m=-100.0, in_velocity=True)],
    ids=["standing", "stepped"],
)
def test_with_the_odometer_alone_nothing_is_p0(fault: Fault) -> None:
    """An error of 40 to 100 m, standing from the start or stepped, is never healthy by the odometer alone."""
    rung = _judged(_faulty(fault), 31, f"odometer alone, {fault.size_m} m")["odometer"]
    assert rung.row["verdict"] != "safe"
    assert (rung.tables.epochs["lds_state"].cast(pl.String) == "P0").sum() == 0
    assert rung.row["share_p0"] in (None, 0.0)
    assert rung.number("unproven_accepted") + rung.number("unsafe_accepted") == rung.number("balises_accepted")


def test_a_drift_is_counted_from_its_failure() -> None:
    """At 5 Hz a drift of 1 m/s to 60 m: time in use beyond the limit is what is counted, no more."""
    fault = Fault("ramp", 150.0, 210.0, rate_mps=1.0)
    rung = _judged(_faulty(fault, rate_hz=5.0), 32, "drift")["reference"]
    surely, _ = rung.in_use
    used_s = float(rung.counted_s(surely & (np.abs(rung.epochs.error_m) > LIMIT_M + 1.0)).sum())
    assert (rung.row["verdict"] == "unsafe") == (used_s > BUDGET_S) or _accepted_wrong_by_truth(rung) > 0


def test_seven_seconds_that_nobody_knows_of_are_no_proof() -> None:
    """The odometer is silent for 8 s between two reads, and the position 60 m ahead for 7 of them: 1 % of the run."""
    legs = (Leg(0.0, 15.0), Leg(20.0, 835.0), Leg(0.0, 15.0))
    silent = Counter(slips=(Slip("outage", 400.0, 408.0),))
    base = replace(BASE, legs=legs, counter=silent, virtual_every_m=1000.0, physical_every_m=1000.0)
    fault = Fault("step", 400.6, 407.6, size_m=60.0, in_velocity=True)
    rungs = _judged(replace(_faulty(fault, base=base), better=Better(sigma_m=0.1)), 41, "seven seconds")
    assert rungs["reference"].row["verdict"] == "unsafe"
    weaker = rungs["balise"].row
    assert weaker["verdict"] == "unproven"
    assert "unknown_in_use" in rungs["balise"].tables.runs["reasons"][0]
