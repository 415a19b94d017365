"""A world whose truth is known: ground, ride and instruments make a run, a site and a vehicle file.

Nothing here comes from the program but the frames' column contracts: the judge is held against this truth, so both
share no code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.config import Vehicle
from schemas.run import RunLog, Site
from tests.stages.judge.faults import Slip
from tests.stages.judge.ground import Balise, Floats, Ground, balises_every, make_site
from tests.stages.judge.ride import Leg, Ride, make_ride
from tests.stages.judge.sensors import Better, Counter, Receiver, gnss, odometer, reads, reference

READ_SIGMA_M = 0.4
RECEIVER, COUNTER, REFERENCE = Receiver(), Counter(), Better()
VEHICLE = Vehicle(odometer_scale=1.0, odometer_scale_sigma=0.001, gnss_latency_s=0.0, gnss_latency_sigma_s=0.01)


@dataclass(frozen=True, repr=False)
class World:
    """What there is; `vehicle` none: no vehicle file."""

    ground: Ground
    legs: tuple[Leg, ...]
    receiver: Receiver = RECEIVER
    counter: Counter | None = COUNTER
    better: Better | None = REFERENCE
    vehicle: Vehicle | None = VEHICLE
    start_m: float = 400.0
    virtual_every_m: float = 500.0
    physical_every_m: float = 2000.0
    first_physical_m: float = 600.0
    extra: tuple[Balise, ...] = ()


@dataclass(frozen=True, repr=False)
class Journey:
    """The world's record, with its truth beside it."""

    name: str
    world: World
    ride: Ride
    balises: tuple[Balise, ...]
    run: RunLog
    site: Site
    vehicle: Vehicle
    epoch_s: Floats
    reported_chainage_m: Floats

    def judged_at_s(self, time_s: Floats) -> Floats:
        """The instant at which a position is judged: its stamp less the latency of the vehicle file."""
        return time_s - (self.vehicle.gnss_latency_s or 0.0)

    def true_chainage_m(self, time_s: Floats) -> Floats:
        """Way of the balise antenna at the instant at which positions of these stamps are judged."""
        return self.ride.chainage_m(self.judged_at_s(time_s))

    def error_m(self) -> Floats:
        """True along-track error of each epoch, in the direction of travel."""
        apart: Floats = self.reported_chainage_m - self.true_chainage_m(self.epoch_s)
        return apart * self.sense(self.epoch_s)

    def sense(self, time_s: Floats) -> Floats:
        return self.ride.sense(self.judged_at_s(time_s))

    def true_place(self, time_s: Floats) -> tuple[list[str], Floats]:
        """Net element and measure of the train at the instant of judging."""
        index, measure = self.world.ground.route.locate(self.true_chainage_m(time_s))
        return [self.world.ground.route.elements[k].name for k in index], measure

    def chainage_of(self, netelement_id: list[str | None], measure_m: Floats) -> Floats:
        """Way abreast of places on any element; NaN where there is no place."""
        ways = np.full(len(measure_m), np.nan)
        for element in self.world.ground.elements:
            here = np.array([name == element.name for name in netelement_id], bool)
            ways[here] = self._abreast(element.name, measure_m[here])
        return ways

    def _abreast(self, name: str, measure_m: Floats) -> Floats:
        ground = self.world.ground
        names = [element.name for element in ground.route.elements]
        starts: Floats = ground.route.starts_m
        if name in names:
            return np.asarray(starts[names.index(name)] + measure_m)
        element = ground.element(name)
        base = np.interp(measure_m, element.measure_m, element.base_m)
        number = next(k for k, other in enumerate(ground.route.elements) if other.base_m[0] == element.base_m[0])
        twin = ground.route.elements[number]
        return np.asarray(starts[number] + np.interp(base, twin.base_m, twin.measure_m))

    def on_route(self, netelement_id: list[str | None]) -> NDArray[np.bool_]:
        names = {element.name for element in self.world.ground.route.elements}
        return np.array([name in names for name in netelement_id], bool)

    def apart_m(self, chainage_m: Floats) -> Floats:
        """How far another track lies beside the route there; infinite where there is none."""
        return np.nan_to_num(np.abs(self.world.ground.other_left_m(chainage_m)), nan=np.inf)

    @property
    def slips(self) -> tuple[Slip, ...]:
        return self.world.counter.slips if self.world.counter is not None else ()

    def weaker(self, *gone: str) -> RunLog:
        """The run without some of its streams."""
        return self.run.with_streams(**dict.fromkeys(gone))


def make_journey(world: World, seed: int, name: str = "run") -> Journey:
    """The world as it writes itself down."""
    rng = np.random.default_rng(seed)
    ride = make_ride(list(world.legs), world.start_m)
    route, vehicle = world.ground.route, world.vehicle or Vehicle()
    low, high = float(ride.track_m.min()), float(ride.track_m.max())
    if low < 100.0 or high > route.length_m - 100.0:
        raise ValueError(f"the ride from {low:.0f} to {high:.0f} m leaves the route of {route.length_m:.0f} m")
    balises = [
        *balises_every(world.ground, world.virtual_every_m, "virtual", 250.0, "V"),
        *balises_every(world.ground, world.physical_every_m, "physical", world.first_physical_m, "B"),
        *world.extra,
    ]
    # An odometer that falls along the route belongs to a train that runs backwards over it.
    polarity = world.counter.polarity if world.counter is not None else 1
    ahead_m = vehicle.gnss_antenna_ahead_m * polarity
    place = gnss(rng, ride, world.ground, replace(world.receiver, antenna_ahead_m=ahead_m))
    run = RunLog(
        run_id=name,
        gnss=place.frame,
        odometer=None if world.counter is None else odometer(rng, ride, world.counter),
        reference=None if world.better is None else reference(rng, ride, route, world.better, ahead_m),
        balise_reads=reads(rng, ride, route, balises, READ_SIGMA_M),
        input_digest=f"{name}-{seed}",
    )
    site = replace(make_site(world.ground, balises), digest="made")
    return Journey(name, world, ride, tuple(balises), run, site, vehicle, place.time_s, place.along_m)
