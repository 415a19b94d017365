"""A run without faults stays provable: what is right is shown to be right where the evidence allows it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.stages.judge.findings import Rung, findings, rungs_of
from tests.stages.judge.ground import make_ground
from tests.stages.judge.ride import Leg
from tests.stages.judge.sensors import Better, Counter, Receiver
from tests.stages.judge.world import Journey, World, make_journey

GROUNDS = {
    "straight": make_ground(18000.0, heading_deg=200.0),
    "curved_chain": make_ground(18000.0, bend_deg=10.0, joints_m=(3000.0, 7000.0, 12000.0)),
    "neighbour_20m": make_ground(18000.0, bend_deg=4.0, neighbour=(3000.0, 9000.0, 20.0)),
}
# Both ends of the run lie within 300 m of a read (first 600 m, then every 2 km: the last at 12.6 km).
LEGS = (Leg(0.0, 15.0), Leg(25.0, 200.0), Leg(0.0, 40.0), Leg(25.0, 212.0), Leg(0.0, 15.0))


def _rungs(world: World, seed: int, name: str) -> tuple[Journey, dict[str, Rung]]:
    journey = make_journey(world, seed, name)
    return journey, rungs_of(journey)


@pytest.mark.parametrize(("ground", "rate_hz"), [*((ground, 1.0) for ground in GROUNDS), ("curved_chain", 5.0)])
def test_with_a_vehicle_file(ground: str, rate_hz: float) -> None:
    journey, rungs = _rungs(World(GROUNDS[ground], LEGS, Receiver(rate_hz=rate_hz)), 11, ground)
    assert findings(journey, rungs) == []
    assert rungs["reference"].row["verdict"] == "safe"
    assert rungs["reference"].number("share_unknown") < 0.01
    assert rungs["balise"].number("share_unknown") < 0.15
    assert rungs["balise"].row["verdict"] != "unsafe"
    assert rungs["odometer"].row["verdict"] == "unproven"
    assert {rung.row["vehicle"] for rung in rungs.values()} == {"file"}


def test_reads_near_both_ends_prove_a_run() -> None:
    """DOMAIN 5.4: with reads a clean run is safe when both ends lie within some 300 m of one."""
    world = replace(World(GROUNDS["straight"], LEGS), virtual_every_m=700.0)
    journey, rungs = _rungs(world, 12, "near reads")
    reads = journey.run.balise_reads
    assert reads is not None
    ends = [journey.ride.track_m.min(), journey.ride.track_m.max()]
    places = [600.0 + 2000.0 * k for k in range(9)]
    assert all(min(abs(end - place) for place in places) < 300.0 for end in ends), ends
    assert rungs["balise"].row["verdict"] == "safe", (rungs["balise"].row["share_unknown"], journey.ride.track_m.max())


@pytest.mark.parametrize("scale", [1.0, 0.992])
def test_without_a_vehicle_file(scale: float) -> None:
    """The reference needs no vehicle file; with reads 0.8 % of scale leave 16 m over 2 km."""
    world = replace(World(GROUNDS["curved_chain"], LEGS), vehicle=None, counter=Counter(scale=scale))
    journey, rungs = _rungs(world, 13, f"scale {scale}")
    assert findings(journey, rungs) == []
    assert rungs["reference"].row["verdict"] == "safe"
    assert rungs["reference"].number("share_unknown") < 0.01
    assert rungs["balise"].row["verdict"] != "unsafe"
    assert rungs["balise"].number("share_unknown") < 0.15 or scale != 1.0
    assert {rung.row["vehicle"] for rung in rungs.values()} == {"learned"}


def test_without_an_odometer() -> None:
    """The reference still judges; reads alone judge next to nothing, and nobody calls that safe."""
    world = replace(World(GROUNDS["straight"], LEGS), counter=None)
    journey = make_journey(world, 14, "no odometer")
    rungs = {name: rung for name, rung in rungs_of(journey).items() if name != "odometer"}
    assert findings(journey, rungs) == []
    assert rungs["reference"].number("share_unknown") < 0.01
    assert rungs["balise"].row["verdict"] == "unproven"
    assert {rung.row["vehicle"] for rung in rungs.values()} == {"none"}


@pytest.mark.parametrize("sigma_m", [0.05, 1.0])
def test_with_a_worse_reference(sigma_m: float) -> None:
    journey, rungs = _rungs(replace(World(GROUNDS["straight"], LEGS), better=Better(sigma_m=sigma_m)), 15, "reference")
    assert findings(journey, rungs) == []
    assert rungs["reference"].row["verdict"] == "safe"


def test_a_reference_that_pauses_is_carried() -> None:
    better = Better(pauses=((100.0, 130.0), (200.0, 245.0)))
    journey, rungs = _rungs(replace(World(GROUNDS["straight"], LEGS), better=better), 16, "pauses")
    assert findings(journey, rungs) == []
    assert rungs["reference"].row["verdict"] == "safe"


def test_a_train_that_turns() -> None:
    legs = (Leg(0.0, 15.0), Leg(25.0, 160.0), Leg(0.0, 30.0), Leg(-20.0, 120.0), Leg(0.0, 10.0))
    journey, rungs = _rungs(replace(World(GROUNDS["curved_chain"], legs), start_m=500.0), 17, "turn")
    assert findings(journey, rungs) == []
    assert rungs["reference"].row["verdict"] == "safe"
