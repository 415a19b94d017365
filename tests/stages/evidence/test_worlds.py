"""The interval of the evidence holds the truth wherever one is given, and weaker evidence leaves no less."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.evidence.evidence import KINDS, NOTHING
from schemas.config import Vehicle
from schemas.enums import Evidence as Kind
from tests.stages.evidence.worlds import (
    KNOWN,
    Ride,
    bounds,
    known,
    ns,
    odometer,
    reads,
    reference,
    stamps,
    straight,
    wavy,
)

GROUND = straight()
# Without a vehicle file the GNSS is on the reference's clock, or on the odometer's: nobody says on which.
FILES = {"file": KNOWN, "none": Vehicle()}


@pytest.mark.parametrize("top_mps", [10.0, 40.0, 80.0])
@pytest.mark.parametrize("late_s", [-0.5, 0.05, 0.28])
@pytest.mark.parametrize("file", FILES)
def test_clocks_that_are_off_leave_the_truth_inside(top_mps: float, late_s: float, file: str) -> None:
    """A lag belongs to nobody: the interval is the hull of none and the measured one, with a vehicle file too."""
    rng = np.random.default_rng(1)
    ride = wavy(top_mps)
    found = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, late_s=late_s), vehicle=FILES[file])
    at_s = np.arange(5.0, 390.0, 1.7)
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    (clock,) = found.clocks
    assert not clock.assumed
    # A lag that may be none is none, and its doubt the wider for it.
    assert clock.shift_s == pytest.approx(late_s if abs(late_s) > 0.1 else 0.0, abs=0.02) or abs(late_s) < 0.1
    assert abs(late_s - clock.shift_s) <= clock.delta_s < 0.04 + abs(late_s) * (clock.shift_s == 0.0)
    assert (high - low).max() < 2.0 * (0.15 + top_mps * (0.5 * abs(late_s) + 0.04) + 0.5)


@pytest.mark.parametrize("late_s", [0.05, 0.3])
@pytest.mark.parametrize("file", FILES)
def test_reads_with_a_clock_of_their_own_leave_the_truth_inside(late_s: float, file: str) -> None:
    rng = np.random.default_rng(2)
    ride = wavy(60.0)
    found = known(GROUND, odometer(ride, rng), of_reads=reads(ride, GROUND, rng, late_s=late_s), vehicle=FILES[file])
    at_s = np.arange(12.0, 380.0, 1.7)
    low, _, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    assert np.isfinite(low).all()


def test_a_clock_that_cannot_be_measured_is_taken_as_a_tenth_of_a_second_and_said() -> None:
    """At constant speed a lag and a shift look alike."""
    rng = np.random.default_rng(3)
    ride = Ride((0.0, 300.0), (30.0, 30.0))
    at_s = np.arange(5.0, 290.0, 2.0)
    found = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, late_s=0.08))
    assert found.clock_assumed
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    assert high - low == pytest.approx(2.0 * (0.15 + 3.0), abs=0.2)
    assert known(GROUND, of_reference=reference(ride, rng)).clock_assumed


@pytest.mark.parametrize("late_s", [-0.09, 0.05, 0.09])
@pytest.mark.parametrize("file", FILES)
def test_a_recording_that_begins_and_ends_at_speed_is_no_change_of_speed(late_s: float, file: str) -> None:
    """Half a second beyond the odometer's recording looked like a stop, and a late clock was measured as none."""
    rng = np.random.default_rng(6)
    ride = Ride((0.0, 220.0), (70.0, 70.0))
    found = known(
        GROUND,
        odometer(ride, rng),
        of_reference=reference(ride, rng, sigma_m=0.02, late_s=late_s),
        vehicle=FILES[file],
    )
    assert found.clock_assumed
    at_s = np.arange(2.0, 215.0, 1.3)
    assert bounds(found.at(ns(at_s)), ride.at(at_s))[2].all()


def test_a_reset_of_the_odometer_is_no_change_of_speed() -> None:
    """At constant speed nothing tells the lag, whatever the counter does in between."""
    rng = np.random.default_rng(7)
    ride = Ride((0.0, 220.0), (70.0, 70.0))
    counted = (
        odometer(ride, rng)
        .with_row_index("row")
        .with_columns(distance_m=pl.col("distance_m") - pl.when(pl.col("row") >= 1003).then(5000.0).otherwise(0.0))
    )
    found = known(GROUND, counted.drop("row"), of_reference=reference(ride, rng, sigma_m=0.02, late_s=0.05))
    assert found.clock_assumed


def test_a_lag_of_seconds_is_found() -> None:
    rng = np.random.default_rng(4)
    ride = wavy(40.0)
    (clock,) = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, late_s=17.0)).clocks
    assert clock.shift_s == pytest.approx(17.0, abs=0.1)
    assert clock.delta_s < 0.1


@pytest.mark.parametrize("file", FILES)
def test_a_slip_inside_the_closing_tolerance_widens_the_interval(file: str) -> None:
    """14.6 m lost at one place of 5 km: with or without a vehicle file the truth is inside all the same."""
    rng = np.random.default_rng(5)
    ride = wavy(40.0)
    lost_m = 14.6 * np.clip((ride.t_s - 150.0) / 5.0, 0.0, 1.0)
    kept = reads(ride, GROUND, rng)[::10]
    vehicle = FILES[file].model_copy(update={"odometer_scale_sigma": 1e-3} if file == "file" else {})
    found = known(GROUND, odometer(ride, rng, lost_m), of_reads=kept, vehicle=vehicle)
    first_s, last_s = ((kept["t"].cast(pl.Int64).to_numpy()[[0, -1]] - ns([0.0])[0]) / 1e9).tolist()
    at_s = np.arange(first_s, last_s, 0.9)
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    assert (high - low).max() > 14.6


def test_of_two_odometers_of_which_one_slips_the_hull_holds_the_truth() -> None:
    """30 m lost by the sensor of the LDS behind the last read, where one side holds it alone."""
    rng = np.random.default_rng(6)
    ride = wavy(30.0)
    slipping = odometer(ride, rng, 60.0 * np.clip((ride.t_s - 300.0) / 5.0, 0.0, 1.0))
    kept = reads(ride, GROUND, rng).filter(pl.col("t") < stamps(np.array([290.0]))[0])
    at_s = np.arange(310.0, 380.0, 1.0)
    alone = bounds(known(GROUND, slipping, of_reads=kept).at(ns(at_s)), ride.at(at_s))
    both = bounds(known(GROUND, slipping, odometer(ride, rng), of_reads=kept).at(ns(at_s)), ride.at(at_s))
    assert not alone[2].all()  # the assumption of DOMAIN 5.1: on one side an odometer is within 5 m + 5 %
    assert both[2].all()
    assert (both[0] <= alone[0]).all()
    assert (both[1] >= alone[1]).all()


def test_a_reference_that_steps_ahead_and_back_leaves_both_sides_all_along() -> None:
    """25 m along the track from 100 to 140 s: nobody says which level was right, before it and after it neither."""
    rng = np.random.default_rng(7)
    ride = wavy(30.0)
    ahead = np.where((np.arange(4000) / 10.0 >= 100.0) & (np.arange(4000) / 10.0 < 140.0), 25.0, 0.0)
    found = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, ahead_m=ahead))
    at_s = np.arange(5.05, 390.0, 0.5)
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    assert found.contradiction_count == 2
    assert (high - low).min() > 25.0
    assert (high - low).max() < 27.0


def test_a_spike_of_the_reference_is_doubted_for_as_long_as_it_lasts() -> None:
    rng = np.random.default_rng(7)
    ride = wavy(30.0)
    ahead = np.where((np.arange(4000) / 10.0 >= 100.0) & (np.arange(4000) / 10.0 < 104.0), 25.0, 0.0)
    found = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, ahead_m=ahead))
    at_s = np.arange(5.05, 390.0, 0.5)
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    spike = (at_s > 100.0) & (at_s < 104.0)
    assert holds.all()
    assert found.contradiction_count == 0
    assert (high - low)[spike].min() > 25.0
    assert (high - low)[~spike].max() < 2.0


@pytest.mark.parametrize("rate_mps", [0.5, 1.0])
@pytest.mark.parametrize("file", FILES)
def test_a_reference_that_drifts_beside_an_odometer_says_nothing(rate_mps: float, file: str) -> None:
    rng = np.random.default_rng(8)
    ride = wavy(30.0)
    drift = np.clip((np.arange(4000) / 10.0 - 150.0) * rate_mps, 0.0, 20.0)
    vehicle = FILES[file]
    found = known(GROUND, odometer(ride, rng), of_reference=reference(ride, rng, ahead_m=drift), vehicle=vehicle)
    assert found.contradiction_count > 0
    assert found.at(ns(np.arange(200.0, 390.0, 1.0))).kind.tolist() == [NOTHING] * 190


def test_a_drift_may_have_begun_where_no_odometer_counted() -> None:
    """The reference drifts off from 150 s on; the odometer's rows from 148 s to 176 s are lost.

    A read at 100 s or so confirmed the reference: up to the drift, and not through the hole.
    """
    rng = np.random.default_rng(15)
    ride = wavy(20.0)
    counted = odometer(ride, rng).filter(~pl.col("t").is_between(*stamps(np.array([148.0, 176.0]))))
    drift_m = np.clip(np.arange(4000) / 10.0 - 150.0, 0.0, 40.0)
    truth = reads(ride, GROUND, rng).head(3)
    found = known(GROUND, counted, of_reference=reference(ride, rng, ahead_m=drift_m), of_reads=truth)
    assert found.contradiction_count
    at_s = np.arange(5.0, 390.0, 0.7)
    evidence = found.at(ns(at_s))
    _, _, holds = bounds(evidence, ride.at(at_s))
    known_rows = evidence.kind != NOTHING
    assert holds[known_rows].all()
    assert known_rows[at_s < 120.0].all()


def _hung(frame: pl.DataFrame, begin_s: float, end_s: float) -> pl.DataFrame:
    """A logger that repeats the values of one instant for a while, with stamps that go on."""
    hangs = pl.col("t").is_between(*stamps(np.array([begin_s, end_s])), closed="right")
    values = [name for name in frame.columns if name != "t"]
    return frame.with_columns(pl.when(~hangs).then(name).forward_fill().alias(name) for name in values)


@pytest.mark.parametrize("lasts_s", [3.4, 8.0])
@pytest.mark.parametrize("counted", ["hangs too", "hangs for longer", "is not there"])
def test_a_leap_that_no_train_can_drive_doubts_the_reference(lasts_s: float, counted: str) -> None:
    """Reference and odometer stand in one logger that hangs at 20 m/s, and reads confirm both before and after.

    What the odometer lost there it cannot contradict: the leap of the reference, 68 m or more in 0.1 s, says it alone.
    """
    rng = np.random.default_rng(16)
    ride = wavy(30.0)
    hung = _hung(reference(ride, rng), 150.0, 150.0 + lasts_s)
    ends_s = 150.0 + lasts_s + (9.0 if counted == "hangs for longer" else 0.0)
    odometers = [] if counted == "is not there" else [_hung(odometer(ride, rng), 150.0, ends_s)]
    found = known(GROUND, *odometers, of_reference=hung, of_reads=reads(ride, GROUND, rng), vehicle=Vehicle())
    # An odometer that bridges the hang has it end where it began, as a spike, which is open while it lasts.
    assert found.contradiction_count or counted == "hangs too"
    at_s = np.arange(5.0, 390.0, 0.3)
    evidence = found.at(ns(at_s))
    _, _, holds = bounds(evidence, ride.at(at_s))
    assert holds[evidence.kind != NOTHING].all()
    assert (evidence.kind[at_s < 100.0] != NOTHING).all()


def test_a_train_that_brakes_hard_leaps_nowhere() -> None:
    """1.6 m/s2 from 50 m/s to a stand and back, at 1 and 10 Hz, without an odometer: nothing is doubted."""
    rng = np.random.default_rng(17)
    ride = Ride((0.0, 30.0, 60.0, 91.0, 101.0, 132.0, 160.0), (0.0, 48.0, 50.0, 0.0, 0.0, 50.0, 50.0))
    for rate_hz in (1.0, 10.0):
        assert known(GROUND, of_reference=reference(ride, rng, rate_hz=rate_hz)).contradiction_count == 0


def test_a_reference_that_stepped_in_a_gap_is_doubted_on_both_sides() -> None:
    """30 m ahead up to 195 s, nothing until 200 s, right from then on: what the gap hides is a step all the same."""
    rng = np.random.default_rng(8)
    ride = wavy(30.0)
    ahead = np.where(np.arange(4000) / 10.0 < 195.0, 30.0, 0.0)
    whole = reference(ride, rng, ahead_m=ahead)
    gap = (pl.col("t") > stamps(np.array([194.95]))[0]) & (pl.col("t") < stamps(np.array([200.0]))[0])
    found = known(GROUND, odometer(ride, rng), of_reference=whole.filter(~gap))
    at_s = np.concatenate([np.arange(5.0, 190.0, 1.0), np.arange(205.0, 390.0, 1.0)])
    low, high, holds = bounds(found.at(ns(at_s)), ride.at(at_s))
    assert found.contradiction_count == 1
    assert holds.all()
    assert (high - low).min() > 28.0


def test_the_last_sample_of_a_slow_reference_has_the_speed_of_the_train() -> None:
    """At 1 Hz its clock was worth nothing there, and what was carried on from it left the truth outside."""
    rng = np.random.default_rng(11)
    ride = Ride((0.0, 50.0, 100.0, 150.0, 200.0), (70.0, 30.0, 70.0, 30.0, 70.0))
    slow = reference(ride, rng, rate_hz=1.0, late_s=0.28)
    found = known(GROUND, odometer(ride, rng), of_reference=slow)
    (stretch,) = found.stretches
    assert not found.clock_assumed
    assert stretch.clock_m[-1] == pytest.approx(stretch.clock_m[-2], rel=0.05)


def test_between_the_samples_of_a_step_no_straight_line_is_evidence() -> None:
    """A reference of 1 Hz steps back after a read: the line in between crossed what the reads say, beside the train."""
    rng = np.random.default_rng(7)
    ride = wavy(30.0)
    ahead = np.where((np.arange(400) >= 100) & (np.arange(400) < 140), 25.0, 0.0)
    stepping = reference(ride, rng, rate_hz=1.0, ahead_m=ahead)
    found = known(GROUND, odometer(ride, rng), of_reference=stepping, of_reads=reads(ride, GROUND, rng))
    at_s = np.arange(95.0, 145.0, 0.05)
    assert bounds(found.at(ns(at_s)), ride.at(at_s))[2].all()


def test_a_read_says_which_side_of_a_step_is_right() -> None:
    """The reference stays 25 m ahead: its step stays open, and the reads say on which side of it the train is."""
    rng = np.random.default_rng(8)
    ride = wavy(30.0)
    ahead = np.where(np.arange(4000) / 10.0 >= 100.0, 25.0, 0.0)
    found = known(
        GROUND, odometer(ride, rng), of_reference=reference(ride, rng, ahead_m=ahead), of_reads=reads(ride, GROUND, rng)
    )
    at_s = np.arange(5.05, 390.0, 0.5)
    evidence = found.at(ns(at_s))
    low, high, holds = bounds(evidence, ride.at(at_s))
    assert holds.all()
    assert np.median((high - low)[at_s > 120.0]) < 25.0
    assert found.count_disputed_reads == 0


def test_an_odometer_that_stands_contradicts_the_reference_which_says_nothing_then() -> None:
    """Odometer or reference stood for 15 s: nobody knows which, so neither proves anything."""
    rng = np.random.default_rng(9)
    ride = wavy(30.0)
    # As a train stands: an odometer that stops dead is a logger that stalls, and says so itself.
    missing = np.interp(ride.t_s, [160.0, 200.0, 215.0, 255.0], [0.0, 1.0, 1.0, 0.0])
    lost = np.cumsum(missing * np.diff(ride.x_m, prepend=ride.x_m[:1]))
    found = known(GROUND, odometer(ride, rng, lost), of_reference=reference(ride, rng))
    at_ns = ns(np.arange(5.05, 390.0, 0.5))
    assert found.contradiction_count > 0
    assert (found.at(at_ns).kind == NOTHING).all()


def test_a_first_read_with_a_wrong_name_carries_nothing_outward() -> None:
    """P1 instead of P0 with the odometer of a vehicle file: before it nothing is known, behind it both sides are."""
    rng = np.random.default_rng(10)
    ride = wavy(30.0)
    true = reads(ride, GROUND, rng)
    wrong = pl.concat([true[:1].with_columns(balise_id=pl.lit("P2")), true[3:]])
    found = known(GROUND, odometer(ride, rng), of_reads=wrong)
    first_s = (true["t"].cast(pl.Int64)[0] - int(ns([0.0])[0])) / 1e9
    before_s, between_s = np.arange(1.0, first_s - 0.1, 0.5), np.arange(first_s + 0.1, first_s + 40.0, 0.5)
    assert set(found.at(ns(before_s)).kind.tolist()) == {NOTHING}
    low, _, holds = bounds(found.at(ns(between_s)), ride.at(between_s))
    assert (holds | ~np.isfinite(low)).all()


def test_a_counter_that_was_reset_between_two_rows_is_carried_by_the_speed_beside_it() -> None:
    rng = np.random.default_rng(11)
    ride = wavy(30.0)
    late = pl.col("t") >= stamps(np.array([200.0]))[0]
    counted = odometer(ride, rng).with_columns(pl.col("distance_m") - pl.when(late).then(2000.0).otherwise(0.0))
    at_s = np.array([150.0, 199.0, 207.0, 300.0])
    found = known(GROUND, counted, of_reads=reads(ride, GROUND, rng)[:2]).at(ns(at_s))
    assert bounds(found, ride.at(at_s))[2].all()


def test_nothing_is_carried_over_a_counter_that_was_silent() -> None:
    rng = np.random.default_rng(11)
    ride = wavy(30.0)
    counted = odometer(ride, rng)
    late = pl.col("t") >= stamps(np.array([200.0]))[0]
    counted = counted.filter(~late | (pl.col("t") >= stamps(np.array([206.0]))[0]))
    kept = reads(ride, GROUND, rng)[:2]
    found = known(GROUND, counted, of_reads=kept).at(ns([150.0, 199.0, 207.0, 300.0]))
    assert found.kind.tolist() == [KINDS.index(Kind.BALISE)] * 2 + [NOTHING] * 2


def test_nothing_is_carried_over_a_stand_of_a_counter_without_sign() -> None:
    """To and fro: the counter grows both ways, and the last read is behind the turn."""
    rng = np.random.default_rng(12)
    knots_s = (0.0, 20.0, 150.0, 170.0, 180.0, 200.0, 300.0, 320.0, 330.0, 350.0, 400.0)
    ride = Ride(knots_s, (0.0, 25.0, 25.0, 0.0, 0.0, -25.0, -25.0, 0.0, 0.0, 25.0, 25.0))
    counted = odometer(ride, rng)
    grown = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(counted["distance_m"].to_numpy())))])
    without = counted.with_columns(distance_m=pl.Series(grown))
    truth = reference(ride, rng).filter(pl.col("t") < stamps(np.array([310.0]))[0])
    at_s = np.array([315.0, 340.0, 390.0])
    signed = known(GROUND, counted, of_reference=truth).at(ns(at_s))
    assert bounds(signed, ride.at(at_s))[2].all()
    found = known(GROUND, without, of_reference=truth).at(ns(at_s))
    assert found.kind.tolist() == [KINDS.index(Kind.REFERENCE), NOTHING, NOTHING]


def test_a_counter_without_sign_has_no_sense_from_another_movement() -> None:
    """Back, then to and fro: the counter grows both ways, and only the second part has a reference of any length."""
    rng = np.random.default_rng(14)
    knots_s = (0.0, 20.0, 60.0, 80.0, 100.0, 120.0, 200.0, 220.0, 240.0, 260.0, 300.0)
    ride = Ride(knots_s, (0.0, -20.0, -20.0, 0.0, 0.0, 25.0, 25.0, 0.0, 0.0, -25.0, -25.0), from_m=20_000.0)
    counted = odometer(ride, rng)
    grown = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(ride.at(np.arange(counted.height) / 10.0))))])
    without = counted.with_columns(distance_m=pl.Series(grown))
    at_ms = pl.col("t").is_between(*stamps(np.array([5.0, 130.0])), closed="none")
    truth = reference(ride, rng).filter(~at_ms)
    at_s = np.arange(6.0, 70.0, 1.0)
    found = known(GROUND, without, of_reference=truth).at(ns(at_s))
    assert bounds(found, ride.at(at_s))[2][found.kind != NOTHING].all()
    assert (found.kind != NOTHING).any()


def test_less_evidence_leaves_no_less() -> None:
    """Reference and reads, the reference alone, the reads alone: each interval holds that of both, where they agree."""
    rng = np.random.default_rng(13)
    ride = wavy(40.0)
    counted, truth, read = odometer(ride, rng), reference(ride, rng, sigma_m=1.0), reads(ride, GROUND, rng)
    at_s = np.arange(15.0, 380.0, 0.7)
    full = known(GROUND, counted, of_reference=truth, of_reads=read)
    assert full.count_disputed_reads == 0
    low, high, holds = bounds(full.at(ns(at_s)), ride.at(at_s))
    assert holds.all()
    for less in ({"of_reference": truth}, {"of_reads": read}):
        weaker = bounds(known(GROUND, counted, **less).at(ns(at_s)), ride.at(at_s))
        assert (weaker[0] <= low + 1e-6).all()
        assert (weaker[1] >= high - 1e-6).all()
