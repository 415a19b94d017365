"""The evidence ladder: weaker evidence says the same or unknown, and no evidence speaks against the truth."""

from __future__ import annotations

import pytest

from schemas.config import Vehicle
from tests.stages.judge.faults import Fault, Slip
from tests.stages.judge.findings import findings, rung_of, rungs_of
from tests.stages.judge.ground import make_ground
from tests.stages.judge.random_worlds import random_journey
from tests.stages.judge.ride import Leg
from tests.stages.judge.sensors import Better, Counter, Receiver, seconds
from tests.stages.judge.world import World, make_journey

# Each of these worlds meets what none of the others does: another branch of the judge, the odometer or the path.
SEEDS = ((0, 2, 4, 7, 400), (402, 404, 405, 406, 407))


@pytest.mark.parametrize("seeds", SEEDS, ids=["first", "second"])
def test_random_runs(seeds: tuple[int, ...]) -> None:
    """One random run judged with its reference, with its reads alone, with its odometer alone."""
    found: list[str] = []
    for seed in seeds:
        journey = random_journey(seed)
        rungs = rungs_of(journey)
        # A slip that contradicts the reference leaves open which of the two failed: then neither need decide.
        disputed = "reference" in rungs and "evidence_contradicted" in rungs["reference"].row["reasons"]
        of_run = findings(journey, rungs, crooked=disputed)
        found += [text for text in of_run if not (disputed and "unknown" in text)]
    assert not found, f"{len(found)} findings:\n" + "\n".join(found[:20])


@pytest.mark.parametrize("vehicle", [True, False], ids=["vehicle", "no_vehicle"])
def test_a_slide_that_takes_back_a_slip_when_the_odometer_says_so(vehicle: bool) -> None:
    """40 m too many and 40 m too few between two reads close to nothing; the flag is what tells it (DOMAIN 5.1)."""
    slips = (
        Slip("slip", 110.0, 120.0, extra_m=40.0, flagged=True),
        Slip("slip", 140.0, 150.0, extra_m=-40.0, flagged=True),
    )
    exact = Vehicle(odometer_scale=1.0, odometer_scale_sigma=0.0005, gnss_latency_s=0.0)
    world = World(
        make_ground(16000.0),
        (Leg(0.0, 10.0), Leg(25.0, 260.0)),
        counter=Counter(slips=slips),
        vehicle=exact if vehicle else None,
    )
    journey = make_journey(world, 8, "slip and slide")
    found = findings(journey, rungs_of(journey))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("in_velocity", [True, False], ids=["filtered", "own_velocity"])
def test_an_odometer_that_stands_behind_the_last_read(in_velocity: bool) -> None:
    """Behind the last read nothing holds an odometer that stands: positions are unknown, not wrong."""
    world = World(
        make_ground(16000.0),
        (Leg(0.0, 10.0), Leg(25.0, 200.0)),
        receiver=Receiver(faults=(Fault("ramp", 150.0, 190.0, rate_mps=0.2, in_velocity=in_velocity),)),
        counter=Counter(slips=(Slip("freeze", 200.0, 215.0),)),
    )
    journey = make_journey(world, 9, "frozen")
    found = findings(journey, rungs_of(journey))
    assert not found, "\n".join(found)


def test_a_read_that_contradicts_a_reference_aside_does_not_settle_for_it() -> None:
    """Reference and positions stand 47 m ahead for 40 s, and a read at 138 s says so; no other read follows.

    What the read carries is wide enough 20 s on to reach the wrong reference: the train is not there for that.
    """
    world = World(
        make_ground(16000.0),
        (Leg(0.0, 10.0), Leg(33.6, 220.0)),
        receiver=Receiver(faults=(Fault("step", 131.0, 171.0, size_m=47.0),)),
        better=Better(sigma_m=1.0, aside=(131.0, 171.0, 47.0)),
        vehicle=None,
        physical_every_m=20000.0,
        first_physical_m=3760.0,
    )
    journey = make_journey(world, 18, "aside")
    rung = rung_of(journey, "reference")
    aside = (rung.epochs.time_s > 139.0) & (rung.epochs.time_s < 171.0)
    assert journey.run.balise_reads is not None
    read_s = seconds(journey.run.balise_reads["t"])
    assert read_s.size == 1
    assert 131.0 < read_s[0] < 139.0, read_s
    assert "right" not in set(rung.epochs.judgement[aside])
