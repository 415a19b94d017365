"""Two elements of 100 m as one leg, the second surveyed the other way round: path positions and measures by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.segments import Leg, Visit, leg_of, nearest_on_leg, path_at
from pipeline.stages.track.survey import track_of
from tests.stages.matching.builders import degrees, line, site

ALONG, AGAINST = Visit(0, True), Visit(1, False)


def path_of(gap_m: float, *legs: list[Visit]) -> TravelledPath:
    """a runs east from 0 m; b lies `gap_m` behind its end and runs west, points every 50 m; legs begin at 0 m."""
    elements = {"a": line((0.0, 0.0), (100.0, 0.0), 50.0), "b": line((200.0 + gap_m, 0.0), (100.0 + gap_m, 0.0), 50.0)}
    track = track_of(site(elements).track)
    return TravelledPath(track, tuple(leg_of(track, visits) for visits in legs))


def segments(leg: Leg) -> list[list[float]]:
    """Path position and measure at the begin and at the end of each segment."""
    table = (leg.path_start_m, leg.path_end_m, leg.measure_start_m, leg.measure_end_m)
    return [[round(float(column[row]), 2) for column in table] for row in range(len(leg.visit))]


A = [[0, 50, 0, 50], [50, 100, 50, 100]]


def test_elements_follow_each_other_without_a_segment_between_them() -> None:
    (leg,) = path_of(0.0, [ALONG, AGAINST]).legs
    assert segments(leg) == [*A, [100, 150, 100, 50], [150, 200, 50, 0]]
    assert leg.visit.tolist() == [0, 0, 1, 1]


def test_a_gap_counts_as_track_at_the_start_of_the_element_after_it() -> None:
    """2 m apart; along b its measure falls, and b is entered behind the gap."""
    (leg,) = path_of(2.0, [ALONG, AGAINST]).legs
    assert segments(leg) == [*A, [100, 102, 100, 100], [102, 152, 100, 50], [152, 202, 50, 0]]
    assert leg.visit.tolist() == [0, 0, 1, 1, 1]
    assert [leg.entry_m(number) for number in (0, 1)] == pytest.approx([0.0, 102.0], abs=0.01)


@pytest.mark.parametrize(
    ("leg", "path_m", "place"),
    [
        (0, 30.0, ("a", 30.0)),
        (0, 130.0, ("b", 70.0)),
        (0, 205.0, ("b", -5.0)),  # beyond the end the measure goes on
        (0, -5.0, ("a", -5.0)),
        (1, 30.0, ("b", 70.0)),
        (1, 100.0, ("b", 0.0)),
        (0, np.nan, (None, np.nan)),
    ],
)
def test_a_path_position_is_a_place_of_its_own_leg(leg: int, path_m: float, place: tuple[str | None, float]) -> None:
    """The first leg runs over both elements, the second over b alone."""
    names, measures = path_of(0.0, [ALONG, AGAINST], [AGAINST]).locate(leg, path_m)
    assert names[0] == place[0]
    assert measures[0] == pytest.approx(place[1], abs=0.01, nan_ok=True)


def kinked() -> Leg:
    """East for 100 m, 9 cm to the north-east by 45 degrees, east again: a step of 6 cm aside within 9 cm."""
    step = 0.0636
    elements = {
        "a": line((0.0, 0.0), (100.0, 0.0), 10.0),
        "t": line((100.0, 0.0), (100.0 + step, step), 0.09),
        "b": line((100.0 + step, step), (200.0, step), 10.0),
    }
    track = track_of(site(elements).track)
    return leg_of(track, [Visit(number, True) for number in range(3)])


def test_a_chord_of_centimetres_has_the_direction_of_the_line_about_it() -> None:
    """6 cm aside over 5 m are 0.7 degrees, not 45."""
    leg = kinked()
    assert np.abs(leg.heading_deg - 90.0).max() < 1.5
    assert np.abs(leg.turn_start_rad).max() < np.radians(1.5)
    assert leg.end_m == pytest.approx(200.0 + 0.09 - 0.0636, abs=0.02)


def test_a_position_beside_a_kink_moves_on_as_the_train_does() -> None:
    """5 m to the left, a metre a step: on the kinked line some step would be 3 m short."""
    leg = kinked()
    east, north = 90.0 + np.arange(21.0), np.full(21, 5.0)
    steps = np.diff(path_at(leg, nearest_on_leg(points_of(*degrees(east, north)), leg)))
    assert np.abs(steps - 1.0).max() < 0.2
