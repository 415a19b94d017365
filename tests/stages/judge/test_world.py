"""The generator against itself, and against what a replay measures of a run without faults."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline import replay
from tests.stages.judge.faults import Fault, Slip
from tests.stages.judge.ground import Ground, geodetic, make_ground
from tests.stages.judge.ride import Leg, make_ride
from tests.stages.judge.sensors import Better, Counter, Receiver, seconds
from tests.stages.judge.world import World, make_journey

GROUNDS = {
    "straight": make_ground(14000.0),
    "curved_chain": make_ground(14000.0, bend_deg=12.0, joints_m=(3000.0, 7000.0)),
    "neighbour": make_ground(14000.0, bend_deg=5.0, neighbour=(3000.0, 9000.0, 5.0)),
    "over_neighbour": make_ground(14000.0, neighbour=(3000.0, 9000.0, 20.0), over_neighbour=True),
}
LEGS = (Leg(0.0, 15.0), Leg(25.0, 200.0), Leg(0.0, 30.0), Leg(20.0, 100.0))
EXACT = Receiver(sigma_m=0.0, white_m=0.001)


@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS.keys())
def test_positions_lie_where_the_truth_says(ground: Ground) -> None:
    """A matched position is the reported chainage to centimetres, so the true error is what was put in."""
    journey = make_journey(World(ground, LEGS, receiver=EXACT), seed=1)
    epochs = replay(journey.run, journey.site, journey.vehicle).epochs
    assert journey.on_route(epochs["netelement_id"].to_list()).all()
    way = journey.chainage_of(epochs["netelement_id"].to_list(), epochs["measure_m"].to_numpy())
    assert np.abs(way - journey.reported_chainage_m).max() < 0.03
    assert np.abs(journey.error_m()).max() < 0.01


@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS.keys())
def test_a_run_without_faults_accepts_every_balise(ground: Ground) -> None:
    journey = make_journey(World(ground, LEGS), seed=2)
    tables = replay(journey.run, journey.site, journey.vehicle)
    assert set(tables.passages["status"]) == {"accepted"}
    assert tables.passages.height > 20
    assert tables.alarms.height == 0


def test_faults_are_in_the_true_error() -> None:
    faults = (
        Fault("step", 100, 120, size_m=40.0),
        Fault("latency", 150, 170, size_s=1.0),
        Fault("tunnel", 180, 190, 30),
    )
    journey = make_journey(World(GROUNDS["straight"], LEGS, receiver=Receiver(sigma_m=0.0, faults=faults)), seed=3)
    error = dict(zip(journey.epoch_s, journey.error_m(), strict=True))
    assert error[99] == pytest.approx(0, abs=0.1)
    assert [error[100], error[119]] == pytest.approx([40, 40], abs=0.1)
    assert error[160] == pytest.approx(-25, abs=0.1)
    assert 185 not in error
    assert error[190] == pytest.approx(30, abs=0.2)


def test_errors_follow_the_direction_of_travel() -> None:
    """Ahead along the growing route is behind for a train that runs against it."""
    legs = (Leg(0.0, 10.0), Leg(20.0, 100.0), Leg(0.0, 20.0), Leg(-20.0, 60.0))
    receiver = Receiver(sigma_m=0.0, faults=(Fault("step", 0, 1e9, size_m=25.0),))
    journey = make_journey(World(GROUNDS["straight"], legs, receiver=receiver), seed=4)
    assert journey.error_m()[60] == pytest.approx(25, abs=0.1)
    assert journey.error_m()[-10] == pytest.approx(-25, abs=0.1)


def test_a_stated_latency_is_no_error() -> None:
    vehicle = World(GROUNDS["straight"], LEGS).vehicle
    assert vehicle is not None
    world = World(
        GROUNDS["straight"],
        LEGS,
        receiver=Receiver(sigma_m=0.0, latency_s=0.3),
        vehicle=vehicle.model_copy(update={"gnss_latency_s": 0.3}),
    )
    assert np.abs(make_journey(world, seed=5).error_m()).max() < 0.1


def test_the_odometer_counts_what_it_should() -> None:
    slips = (Slip("slip", 100, 110, extra_m=30.0, flagged=True), Slip("freeze", 150, 155), Slip("outage", 170, 180))
    world = World(GROUNDS["straight"], LEGS, counter=Counter(scale=1.01, noise_mps=0.0, polarity=-1, slips=slips))
    journey = make_journey(world, seed=6)
    odometer = journey.run.odometer
    assert odometer is not None
    time, counted = seconds(odometer["t"]), -odometer["distance_m"].to_numpy()
    true = (journey.ride.chainage_m(time) - journey.world.start_m) / 1.01

    def lost_m(at_s: float) -> float:
        return float((counted - true)[np.argmin(np.abs(time - at_s))])

    assert lost_m(99) == pytest.approx(0.0, abs=0.02)
    assert lost_m(111) == pytest.approx(30.0, abs=0.02)
    assert lost_m(160) == pytest.approx(30.0 - 5 * 25 / 1.01, abs=0.3)
    assert not ((time >= 170) & (time < 180)).any()
    assert seconds(odometer.filter("slip")["t"])[0] == pytest.approx(100.0)


def test_reads_and_reference_stay_within_their_sigma() -> None:
    journey = make_journey(World(GROUNDS["curved_chain"], LEGS, better=Better(sigma_m=0.5)), seed=7)
    reads = journey.run.balise_reads
    assert reads is not None
    places = {balise.balise_id: (balise.netelement_id, balise.measure_m) for balise in journey.balises}
    for time, name in zip(seconds(reads["t"]), reads["balise_id"], strict=True):
        way = journey.world.ground.route.chainage_m(*places[name])
        assert way is not None
        assert abs(way - float(journey.ride.chainage_m(np.array(time)))) < 2.5 * 0.4 + 0.01
    assert reads.height >= 3


def test_the_ellipsoid_is_the_right_one() -> None:
    """100 m to the north at height h are 100 / (M + h) radians, M the meridian's radius of curvature."""
    latitude, longitude, height = geodetic(np.array([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [100.0, 0.0, 7.0]]))
    meridian = 6378137.0 * (1 - 0.00669437999014) / (1 - 0.00669437999014 * np.sin(np.radians(49.5)) ** 2) ** 1.5
    assert np.radians(latitude[1] - latitude[0]) * (meridian + 320.0) == pytest.approx(100.0, abs=1e-3)
    assert longitude[1] == pytest.approx(longitude[0], abs=1e-12)
    assert height[[0, 2]] == pytest.approx([320.0, 327.0], abs=1e-3)


def test_the_ride_stops_and_turns() -> None:
    ride = make_ride([Leg(20.0, 60.0), Leg(0.0, 10.0), Leg(-10.0, 30.0)], 500.0)
    assert len(ride.passings_s(1000.0)) == 1
    turned = float(ride.track_m.max()) - 100.0
    assert len(ride.passings_s(turned)) == 2
    assert ride.sense(np.array([30.0, ride.length_s])).tolist() == [1.0, -1.0]
