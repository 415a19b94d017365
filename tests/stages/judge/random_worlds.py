"""Random worlds for the evidence ladder: one seed, one journey.

They keep to the two assumptions of DOMAIN section 5.1. Slip, slide and scale never cancel each other between two
anchors: a run has one odometer fault; without a vehicle file it errs to the same side as the scale, and a train that
turns has no scale error. Beside the outermost reads the odometer is within 5 m + 5 %, or says that it slips, or stands
while the positions move on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from schemas.config import Vehicle
from tests.stages.judge.faults import Fault, Slip
from tests.stages.judge.ground import Ground, make_ground
from tests.stages.judge.ride import Leg, Ride, make_ride
from tests.stages.judge.sensors import Better, Counter, Receiver
from tests.stages.judge.world import Journey, World, make_journey

T = TypeVar("T")

LENGTH_M = 16000.0
START_M = 400.0
TAIL_S = 30.0


@dataclass(frozen=True)
class Draw:
    """Random choices by one generator."""

    rng: np.random.Generator

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> int:
        return 1 if self.rng.random() < 0.5 else -1

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def one(self, *things: T) -> T:
        return things[int(self.rng.integers(len(things)))]


def random_journey(seed: int) -> Journey:
    """The journey of a seed."""
    draw = Draw(np.random.default_rng([seed, 19]))
    ground, aside_m = _ground(draw)
    legs, turns = _legs(draw)
    ride = make_ride(list(legs), START_M)
    vehicle, scale = _vehicle(draw, turns)
    latency_s = (vehicle.gnss_latency_s or 0.0) if vehicle is not None else draw.one(0.0, 0.0, 0.08)
    faults = tuple(_fault(draw, ride.length_s, aside_m) for _ in range(draw.one(0, 1, 1, 1, 2)))
    world = World(
        ground,
        legs,
        receiver=Receiver(
            rate_hz=draw.one(1.0, 1.0, 1.0, 2.0, 5.0),
            sigma_m=draw.between(0.4, 1.2),
            latency_s=latency_s,
            with_velocity=draw.chance(0.85),
            faults=faults,
        ),
        counter=Counter(scale=scale, polarity=draw.one(1, 1, -1)),
        better=_better(draw, ride.length_s),
        vehicle=vehicle,
        start_m=START_M,
        virtual_every_m=draw.one(300.0, 450.0, 700.0, 1000.0),
        physical_every_m=draw.one(1000.0, 2000.0, 2000.0, 3000.0),
    )
    if draw.chance(0.5):
        world = _with_slip(draw, world, ride, faults)
    return make_journey(world, seed, f"seed {seed}")


def _ground(draw: Draw) -> tuple[Ground, float]:
    """The ground, and how far to the left another track lies (0: none)."""
    heading = draw.between(0.0, 360.0)
    kind = draw.one("straight", "curved", "chain", "neighbour", "neighbour", "over")
    if kind in ("straight", "curved"):
        return make_ground(LENGTH_M, 0.0 if kind == "straight" else draw.between(3.0, 15.0), heading), 0.0
    if kind == "chain":
        joints = (draw.one(2000.0, 2345.0), draw.one(5000.0, 5500.0), 9000.0)
        return make_ground(LENGTH_M, draw.between(0.0, 10.0), heading, joints), 0.0
    aside = draw.sign() * draw.one(4.5, 20.0)
    neighbour = (draw.one(1500.0, 2500.0), draw.one(6000.0, 8000.0), aside)
    ground = make_ground(LENGTH_M, draw.between(0.0, 6.0), heading, (), neighbour, over_neighbour=kind == "over")
    return ground, -aside if kind == "over" else aside


def _legs(draw: Draw) -> tuple[tuple[Leg, ...], bool]:
    """Stand, go, perhaps stop and go on, perhaps turn."""
    speed = draw.between(12.0, 35.0)
    legs = [Leg(0.0, draw.between(5.0, 20.0)), Leg(speed, draw.between(120.0, 200.0), draw.between(0.3, 0.9))]
    if draw.chance(0.4):
        legs += [Leg(0.0, draw.between(10.0, 40.0)), Leg(draw.between(10.0, 30.0), draw.between(60.0, 120.0))]
    turns = draw.chance(0.15)
    if turns:
        legs += [Leg(0.0, 30.0), Leg(-draw.between(10.0, 18.0), draw.between(60.0, 120.0))]
    return (*legs, Leg(0.0, 10.0)) if draw.chance(0.5) else tuple(legs), turns


def _vehicle(draw: Draw, turns: bool) -> tuple[Vehicle | None, float]:
    """The vehicle file, if any, and the true scale of the odometer."""
    if draw.chance(0.5):
        return None, 1.0 + (draw.between(-1e-4, 1e-4) if turns else draw.between(-0.02, 0.02))
    stated, sigma = 1.0 + draw.between(-0.01, 0.01), draw.one(0.0003, 0.0005, 0.001)
    vehicle = Vehicle(
        odometer_scale=stated,
        odometer_scale_sigma=sigma,
        gnss_latency_s=draw.one(0.0, 0.1, 0.25),
        gnss_latency_sigma_s=0.01,
        gnss_antenna_ahead_m=0.0 if turns else draw.one(0.0, 0.0, 12.0, -8.0),
    )
    return vehicle, stated + sigma * draw.between(-2.0, 2.0)


def _better(draw: Draw, length_s: float) -> Better:
    begin = draw.between(30.0, length_s - 90.0)
    pauses = ((begin, begin + draw.between(5.0, 60.0)),) if draw.chance(0.3) else ()
    stated = draw.chance(0.8)
    sigma = draw.one(0.05, 0.2, 0.5, 1.0) if stated else draw.one(0.05, 0.5)
    return Better(draw.one(1.0, 2.0), sigma, stated, pauses)


def _fault(draw: Draw, length_s: float, aside_m: float) -> Fault:
    kinds = ["step", "ramp", "return", "standing", "latency", "tunnel", "outage", "spoof", "step", "ramp"]
    kind = draw.one(*kinds, *(["cross", "cross", "other_track", "other_track", "other_track"] if aside_m else []))
    begin = draw.between(40.0, length_s - TAIL_S - 30.0)
    end = min(begin + draw.between(5.0, 90.0), length_s - (0.0 if draw.chance(0.3) else TAIL_S))
    size, carried = draw.sign() * draw.between(5.0, 120.0), draw.chance(0.5)
    if kind == "step" and draw.chance(0.3):
        # At one position a second all of them are hit, or none; at five one in five to three in five.
        return Fault("pulses", begin, end, size_m=size, size_s=draw.between(0.1, 0.6))
    if kind == "standing":
        return Fault("step", 0.0, 1e9, size_m=size / 2)
    if kind == "latency":
        whole = draw.chance(0.5)
        return Fault(kind, 0.0 if whole else begin, 1e9 if whole else end, size_s=draw.one(1.0, -1.0, 0.4, 2.0))
    if kind in ("ramp", "spoof"):
        rate = size / (end - begin) if draw.chance(0.5) else draw.sign() * draw.between(0.1, 3.0)
        return Fault("ramp", begin, end, rate_mps=rate, in_velocity=carried or kind == "spoof")
    if kind == "other_track":
        whole = draw.chance(0.7)
        return Fault(kind, 0.0 if whole else begin, 1e9 if whole else end)
    if kind == "cross":
        return Fault(kind, begin, end, size_m=aside_m)
    if kind in ("tunnel", "outage"):
        return Fault(kind, begin, end, size_m=size / 2 if kind == "tunnel" else 0.0)
    return Fault(kind, begin, end, size_m=size, in_velocity=carried)


def _with_slip(draw: Draw, world: World, ride: Ride, faults: tuple[Fault, ...]) -> World:
    """One fault of the odometer that keeps to the assumptions, where one fits."""
    counter = world.counter
    assert counter is not None
    begin = draw.between(40.0, ride.length_s - 60.0)
    end = begin + draw.between(5.0, 20.0)
    time = np.arange(begin, end, 0.1)
    moved = abs(float(ride.chainage_m(np.array(end)) - ride.chainage_m(np.array(begin))))
    steady = moved > 60.0 and bool((np.abs(ride.speed_mps(time)) > 3.0).all())
    kind = draw.one("slip", "slip", "freeze", "outage")
    if not steady:
        return world
    learned = world.vehicle is None
    lost = counter.scale > 1.0 if learned else draw.chance(0.5)
    if kind == "freeze" and learned and not lost:
        return world
    sane = all(np.all(fault.along_m(time) == 0.0) and not fault.silent(time).any() for fault in faults)
    between = _between_reads(world, ride, begin, end)
    flagged = draw.chance(0.4) or not (between or (kind == "freeze" and sane))
    extra = draw.between(25.0, min(60.0, moved / 2)) * (-1.0 if lost else 1.0)
    slip = Slip(kind, begin, end, extra_m=extra, flagged=flagged and kind != "outage")
    return replace(world, counter=replace(counter, slips=(slip,)))


def _between_reads(world: World, ride: Ride, begin_s: float, end_s: float) -> bool:
    """A physical balise was read before, and one after."""
    places = np.arange(world.first_physical_m, LENGTH_M, world.physical_every_m)
    passed = [time for place in places for time in ride.passings_s(float(place))]
    return any(time < begin_s - 5.0 for time in passed) and any(time > end_s + 5.0 for time in passed)
