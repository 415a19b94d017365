"""What single samples of a reference are as evidence, on ways along one element worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.stages.evidence.anchors import OrientedStretch, orient_stretch, reference_movements
from pipeline.stages.evidence.carrying import Lags, RecorderClock, SignedOdometer, TrueAnchor, measure_lags
from pipeline.stages.evidence.contradictions import Witness
from pipeline.stages.evidence.gathering import stretch_as_evidence
from pipeline.stages.odometry import odometry_of
from pipeline.stages.reference import ReferencePath, ReferenceStretch
from pipeline.stages.track.path import Place, RoutePath
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.enums import Evidence
from tests.stages.matching.builders import odometer

CONFIG = Configuration()
SURE = RecorderClock(0.0, 0.0)


def ns(t_s: Floats) -> Ints:
    return np.round(t_s * NS_PER_S).astype(np.int64)


def stretch(t_s: Floats, at_m: Floats, forward: bool = True) -> ReferenceStretch:
    """Samples to 0.1 m along element 4, which is 10 km long and entered at 0 m."""
    route = RoutePath(np.array([4]), np.array([forward]), np.zeros(1), np.zeros(1), np.array([10_000.0]))
    path = ReferencePath(np.zeros(t_s.size, dtype=np.int64), at_m, (route,), np.zeros(t_s.size), np.full(t_s.size, 0.1))
    return ReferenceStretch(ns(t_s), np.full(t_s.size, 0.1), (path,))


def against(*counters: SignedOdometer) -> tuple[Witness, ...]:
    """These odometers on the reference's clock, their scale within 5 %."""
    return tuple(Witness.with_measured_scale(counter, Lags(), CONFIG) for counter in counters)


def counter(at_m: Floats, rate_hz: float) -> SignedOdometer:
    found = odometry_of(odometer(at_m, rate_hz), Vehicle(), CONFIG)
    assert found is not None
    return SignedOdometer(found)


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("away", [True, False])
def test_a_stretch_faces_along_its_element_as_the_odometer_counts_up(forward: bool, away: bool) -> None:
    """Oriented elements are twice their number in the sense of the measure, and one more against it."""
    t_s = np.arange(0.0, 61.0)
    at_m = 10.0 * t_s if away else 600.0 - 10.0 * t_s
    side = orient_stretch(stretch(t_s, at_m, forward), counter(10.0 * t_s, 1.0), 50.0)
    assert side.sense == (1 if away else -1)
    assert side.first_oriented_element == (8 if forward is away else 9)
    assert (side.with_m, side.against_m) == pytest.approx((600.0, 0.0))


def test_a_shunt_before_the_journey_does_not_turn_the_sense() -> None:
    """An odometer without a sign: 20 m back, less than the 50 m that tell the sense, then 300 m ahead."""
    t_s = np.arange(0.0, 50.0)
    at_m = np.interp(t_s, [0, 4, 19, 49], [100, 80, 80, 380])
    counted_m = np.interp(t_s, [0, 4, 19, 49], [0, 20, 20, 320])
    side = orient_stretch(stretch(t_s, at_m), counter(counted_m, 1.0), 50.0)
    # But for what is left within the noise of 6 m.
    assert (side.sense, side.with_m, side.against_m) == (1, pytest.approx(294.0, abs=6.0), pytest.approx(14.0, abs=6.0))


def no_gaps(begin: TrueAnchor, end: TrueAnchor) -> list[float]:
    raise AssertionError(f"one stretch has no gap from {begin} to {end}")


def test_seventy_seconds_of_changing_speed_tell_a_lag() -> None:
    """Seven ways of ten seconds, and six are enough; the odometer stamps 0.4 s earlier."""
    fine_s = np.arange(0.0, 73.0, 0.01)
    travelled_m = np.cumsum(np.interp(fine_s, [0, 12, 24, 36, 48, 60, 72], [4, 28, 6, 30, 8, 26, 4])) * 0.01
    t_s = np.arange(0.0, 71.0, 0.1)
    late = stretch(t_s + 0.4, np.interp(t_s, fine_s, travelled_m))
    counted = counter(np.interp(np.arange(0.0, 72.0, 0.1), fine_s, travelled_m), 10.0)
    (found,) = measure_lags(*reference_movements([OrientedStretch(late, 1, 1.0, 0.0)], no_gaps), counted, CONFIG).found
    assert found.lag_s == pytest.approx(0.4, abs=0.03)
    assert found.lag_sigma_s < 0.05
    cut = late.t_ns <= 60 * NS_PER_S
    few = ReferenceStretch(late.t_ns[cut], late.sigma_m[cut], (late.paths[0].some_rows(slice(int(cut.sum()))),))
    (unsure,) = measure_lags(*reference_movements([OrientedStretch(few, 1, 1.0, 0.0)], no_gaps), counted, CONFIG).found
    assert not unsure.measured


def test_a_clock_counts_by_the_greatest_speed_that_it_leaves_possible() -> None:
    """t^2 metres: 2 t m/s at each sample over a second about it, 2 (t + 0.5) half a second later."""
    t_s = np.arange(0.0, 10.25, 0.25)
    clock = replace(SURE, shift_s=3.0, delta_s=0.5)
    found = stretch_as_evidence(
        OrientedStretch(stretch(t_s + 3.0, t_s**2), 1, 1.0, 0.0), clock, against(), [], 0.0, CONFIG
    )
    assert found.t_ns.tolist() == ns(t_s).tolist()
    assert found.clock_m[4:36] == pytest.approx(0.5 * 2.0 * (t_s[4:36] + 0.5))
    assert found.clock_m[0] == pytest.approx(0.5 * 1.0)  # at 0.5 s; before the first sample nothing moved faster


@pytest.mark.parametrize(
    ("read_s", "read_m", "behind_m", "ahead_m"),
    [
        (12.0, 120.0, 0.0, 30.0),  # the level after the step is right: the one before may be 30 m behind the train
        (12.0, 124.0, 30.0, 30.0),  # 4 m off: confirms nothing
        (4.0, 40.0, 30.0, 0.0),  # the level before is right: after it the train may be 30 m behind the reference
        (25.0, 250.0, 30.0, 30.0),  # after the stretch
    ],
)
def test_a_step_leaves_both_sides_open_where_no_read_confirms(
    read_s: float, read_m: float, behind_m: float, ahead_m: float
) -> None:
    """10 m/s; at 9 s the reference steps 30 m ahead of the odometer. Reads are true to 3 sqrt(1^2 + 0.1^2) = 3.01 m."""
    t_s = np.arange(0.0, 20.5, 0.5)
    counted = counter(10.0 * t_s, 2.0)
    step_m = np.where(t_s >= 9.0, 30.0, 0.0)
    ahead = step_m[-1] if read_s > 9.0 else 0.0
    read = TrueAnchor(round(read_s * NS_PER_S), (Place(4, read_m + ahead),), 1.0, Evidence.BALISE)
    side = OrientedStretch(stretch(t_s, 10.0 * t_s + step_m), 1, 1.0, 0.0)
    found = stretch_as_evidence(side, SURE, against(counted), [read], 0.0, CONFIG)
    (path,) = found.paths
    assert np.flatnonzero(path.step_m).tolist() == [17]
    assert (path.at_m - path.low_m).tolist() == pytest.approx([0.0] * 18 + [behind_m] * 23)
    assert (path.high_m - path.at_m).tolist() == pytest.approx([ahead_m] * 18 + [0.0] * 23)


@pytest.mark.parametrize("begun_s", [20.0, 80.0, 130.0])
def test_a_drift_shows_wherever_long_windows_begin(begun_s: float) -> None:
    """11 m off within 40 s at sigma 0.4 m: 5.33 roots of two samples are 3 m, not reached in 10 s, and with 5 m 8 m."""
    t_s = np.arange(0.0, 260.0, 0.5)
    drift_m = 11.0 * np.clip((t_s - begun_s) / 40.0, 0.0, 1.0)
    sigma_m = np.full(t_s.size, 0.4)
    drifting = replace(stretch(t_s, 20.0 * t_s + drift_m), sigma_m=sigma_m)
    witness = Witness(counter(20.0 * np.arange(0.0, 261.0, 0.5), 2.0))
    found = stretch_as_evidence(OrientedStretch(drifting, 1, 1.0, 0.0), SURE, (witness,), [], 0.0, CONFIG)
    assert found.levels.count_doubted_steps == 1
    honest = replace(stretch(t_s, 20.0 * t_s), sigma_m=sigma_m)
    assert (
        stretch_as_evidence(
            OrientedStretch(honest, 1, 1.0, 0.0), SURE, (witness,), [], 0.0, CONFIG
        ).levels.count_doubted_steps
        == 0
    )
