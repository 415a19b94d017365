"""Recorders that lag by their own word, stand still, or end beside a train that stands; odometers without origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from pipeline.stages.evidence.evidence import KINDS, NOTHING
from pipeline.stages.evidence.gathering import without_frozen, without_latency
from pipeline.stages.odometry import odometry_of
from schemas.config import Configuration, HazardConfig, Vehicle
from schemas.enums import Evidence as Kind
from schemas.enums import Origin
from tests.stages.evidence.worlds import (
    KNOWN,
    Ride,
    bounds,
    known,
    ns,
    odometer,
    reads,
    reference,
    straight,
    wavy,
)

GROUND = straight()


def counted(stream: pl.DataFrame, vehicle: Vehicle = KNOWN):
    found = odometry_of(stream, vehicle, Configuration())
    assert found is not None
    return found


def of_origin(stream: pl.DataFrame, origin: Origin) -> pl.DataFrame:
    return stream.with_columns(origin=pl.lit(origin.value, pl.Enum(Origin)))


def test_a_declared_lag_is_taken_off_the_stamps() -> None:
    rng = np.random.default_rng(1)
    late = reference(wavy(30.0), rng, late_s=0.5)
    taken = without_latency(late, 0.5)
    assert taken is not None
    assert ((late["t"] - taken["t"]).dt.total_milliseconds() == 500).all()
    assert without_latency(late, 0.0) is late
    assert without_latency(None, 0.5) is None


@pytest.mark.parametrize("origin", [Origin.WHEEL, Origin.UNKNOWN])
def test_a_reference_that_stands_still_beside_an_odometer_is_left_out(origin: Origin) -> None:
    """One of unknown origin proves nothing, but it contradicts: without its declaration nothing may become right."""
    rng = np.random.default_rng(2)
    ride = wavy(30.0)
    whole = reference(ride, rng)
    rows = np.arange(whole.height)
    held = np.where((rows >= 1000) & (rows < 1040), 1000, rows)
    frozen = whole.with_columns(whole[held].select("latitude_deg", "longitude_deg"))
    moving = without_frozen(frozen, [counted(of_origin(odometer(ride, rng), origin))], HazardConfig())
    assert moving is not None
    assert whole.height - moving.height > 30
    # A copy that stands with the reference confirms nothing against a wheel that counts on.
    stands = of_origin(odometer(ride, rng), Origin.UNKNOWN).with_columns(distance_m=pl.lit(0.0))
    both = [counted(of_origin(odometer(ride, rng), Origin.WHEEL)), counted(stands)]
    beside_a_wheel = without_frozen(frozen, both, HazardConfig())
    assert beside_a_wheel is not None
    assert whole.height - beside_a_wheel.height > 30


def test_a_train_that_stands_repeats_its_place_and_is_heard() -> None:
    rng = np.random.default_rng(3)
    ride = Ride((0.0, 100.0, 110.0, 150.0, 160.0, 300.0), (20.0, 20.0, 0.0, 0.0, 20.0, 20.0))
    whole = reference(ride, rng)
    rows = np.arange(whole.height)
    held = np.where((rows >= 1150) & (rows < 1450), 1150, rows)
    still = whole.with_columns(whole[held].select("latitude_deg", "longitude_deg"))
    moving = without_frozen(still, [counted(odometer(ride, rng))], HazardConfig())
    assert moving is not None
    assert moving.height == still.height


def test_a_train_that_stood_at_the_last_row_stands_for_a_second_more() -> None:
    rng = np.random.default_rng(4)
    ride = Ride((0.0, 100.0, 110.0, 120.0), (20.0, 20.0, 0.0, 0.0))
    short = odometer(ride, rng)
    found = known(GROUND, short, of_reads=reads(ride, GROUND, rng))
    last_s = float((short["t"].cast(pl.Int64).to_numpy()[-1] - ns([0.0])[0]) / 1e9)
    at_s = np.array([last_s - 0.5, last_s + 0.6, last_s + 1.5])
    kinds = found.at(ns(at_s)).kind.tolist()
    assert kinds == [KINDS.index(Kind.BALISE), KINDS.index(Kind.BALISE), NOTHING]
    low, high, holds = bounds(found.at(ns(at_s[:2])), ride.at(at_s[:2]))
    assert holds.all()
    assert (high - low)[1] - (high - low)[0] == pytest.approx(1.8 * 0.6**2, abs=0.05)


@pytest.mark.parametrize("origin", [Origin.UNKNOWN, Origin.GNSS, Origin.FUSED])
def test_an_odometer_that_is_not_independent_proves_nothing_between_reads(origin: Origin) -> None:
    rng = np.random.default_rng(5)
    ride = wavy(30.0)
    read = reads(ride, GROUND, rng)
    counted_stream = of_origin(odometer(ride, rng), origin)
    at_s = np.arange(20.0, 380.0, 7.0)
    found = known(GROUND, counted_stream, of_reads=read).at(ns(at_s))
    assert (found.kind == KINDS.index(Kind.BALISE)).all()
    assert not found.proves.any()
    wheel = known(GROUND, of_origin(counted_stream, Origin.WHEEL), of_reads=read).at(ns(at_s))
    assert wheel.proves.all()
    assert wheel.on_survey.mean() > 0.9


def test_it_contradicts_a_reference() -> None:
    rng = np.random.default_rng(6)
    ride = wavy(30.0)
    drift = np.clip((np.arange(4000) / 10.0 - 150.0), 0.0, 60.0)
    of_reference = reference(ride, rng, ahead_m=drift)
    found = known(GROUND, of_origin(odometer(ride, rng), Origin.UNKNOWN), of_reference=of_reference)
    assert found.contradiction_count > 0


@pytest.mark.parametrize(("late_s", "least_s"), [(0.0, 0.2), (0.6, 0.75)])
def test_its_lag_widens_what_is_assumed_of_a_clock_and_never_narrows_it(late_s: float, least_s: float) -> None:
    rng = np.random.default_rng(6)
    ride = wavy(30.0)
    of_reference = reference(ride, rng, late_s=late_s)
    found = known(GROUND, of_origin(odometer(ride, rng), Origin.UNKNOWN), of_reference=of_reference)
    assert found.clock_assumed
    at_s = np.arange(20.0, 380.0, 7.0)
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    narrower = bounds(known(GROUND, odometer(ride, rng), of_reference=of_reference).at(ns(at_s)), ride.at(at_s))
    assert (high - low > narrower[1] - narrower[0] - 0.1).all()
    assert (high - low).max() > least_s * 20.0


@pytest.mark.parametrize(("scale", "parted"), [(1.0, False), (1.02, False), (1.2, True)])
def test_an_odometer_of_unknown_origin_that_parts_from_a_wheel_disputes(scale: float, parted: bool) -> None:
    rng = np.random.default_rng(7)
    ride = wavy(30.0)
    wheel = of_origin(odometer(ride, rng), Origin.WHEEL)
    other = of_origin(odometer(ride, rng), Origin.UNKNOWN).with_columns(pl.col("distance_m") * scale)
    found = known(GROUND, wheel, other, of_reads=reads(ride, GROUND, rng))
    assert found.odometers_disagree is parted
    # It narrows nothing, and widens nothing.
    at_s = np.arange(20.0, 380.0, 7.0)
    alone = known(GROUND, wheel, of_reads=reads(ride, GROUND, np.random.default_rng(7)))
    assert len(found.carried) == len(alone.carried) == 1
    assert found.at(ns(at_s)).proves.all()


@pytest.mark.parametrize(
    ("aside_m", "sigma_m", "complete", "shown"),
    [(0.0, 0.05, False, True), (2.9, 0.05, False, False), (0.0, 1.0, False, False), (2.9, 1.0, True, True)],
)
def test_a_reference_shows_its_track_where_no_neighbour_can_have_made_it(
    aside_m: float, sigma_m: float, complete: bool, shown: bool
) -> None:
    """Tracks 3.4 m apart, a survey of 0.3 m: within 3.4 - 3 sqrt(0.3^2 + 0.05^2) = 2.5 m of its track."""
    rng = np.random.default_rng(8)
    ride = wavy(30.0)
    ground = straight()
    stated = ground.track.with_columns(sigma_m=pl.lit(0.3))
    ground = replace(ground, track=stated)
    of_reference = reference(ride, rng, sigma_m=sigma_m, aside_m=aside_m)
    config = Configuration.model_validate({"evidence": {"survey_complete": complete}})
    found = known(ground, odometer(ride, rng), of_reference=of_reference, config=config)
    samples = found.at(ns(np.arange(20.0, 380.0, 7.0)))
    assert bool(samples.on_survey.all()) is shown
    assert bool(samples.on_survey.any()) is shown
