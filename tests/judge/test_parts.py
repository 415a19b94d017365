"""Single rules of the judge on a handful of rows, worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest
from pipeline.judge.bench import Bench
from pipeline.judge.passings import Passing, train_passings
from pipeline.judge.states import in_use_s, odometer_beyond_confidence

from pipeline.evidence.evidence import KINDS, NOTHING, Alternative, EvidenceSet
from pipeline.judge.alarms import verdict_within
from pipeline.judge.episodes import Episode, _failure, _is_back, _named_onset_ns
from pipeline.judge.hazards import _instants, crossed_by, drafts_of, rate_mps, size_m, within_budget
from pipeline.judge.judge import _look_at, errors_across
from pipeline.judge.judgement import (
    RIGHT,
    UNKNOWN,
    WRONG,
    Judgements,
    Positions,
    judge_positions,
    margins_m,
    with_own_anchors,
)
from pipeline.judge.jumps import Jump, find_jumps, steps_of
from pipeline.judge.suspect import suspect_of
from pipeline.track.path import Place, Route
from schemas.config import Configuration, HazardConfig, LdsConfig
from schemas.enums import Evidence, Hazard, Suspect, Verdict

NS = 1_000_000_000
DEG_PER_M = np.degrees(1.0 / 6378137.0)  # east along the equator


def seconds(*t_s: float) -> Any:
    return np.array([round(t * NS) for t in t_s], dtype=np.int64)


@pytest.mark.parametrize(
    ("codes", "accepted", "numbers", "may_s", "kept"),
    [
        ([WRONG], [True], [1], 0.2, True),  # accepted before the episode
        ([WRONG], [False], [3], 0.2, True),  # offered in it, not accepted
        ([WRONG], [True], [3], 0.2, False),
        ([UNKNOWN], [True], [3], 0.2, None),
        ([RIGHT], [True], [3], 0.7, None),  # 0.2 s wrong for sure, 0.7 s at most, 0.5 s allowed
    ],
)
def test_a_budget_is_kept_where_nothing_wrong_was_accepted_in_the_episode(
    codes: list[int], accepted: list[bool], numbers: list[int], may_s: float, kept: bool | None
) -> None:
    episode = SimpleNamespace(holds=lambda number: number >= 2, hazardous_s=0.2, hazardous_may_s=may_s)
    judged = SimpleNamespace(code=np.array(codes))
    offers = SimpleNamespace(judged=judged, accepted=np.array(accepted), number=np.array(numbers))
    assert within_budget(cast(Any, episode), cast(Any, offers), 0.5) is kept


def test_the_distance_counts_from_the_last_accepted_balise() -> None:
    """The odometer misses 30 m between 1 s and 2 s; a balise accepted at 3 s is a new begin."""
    t_ns, odometer_m = seconds(0, 1, 2, 3, 4), np.linspace(0.0, 40.0, 5)
    train_m = odometer_m + np.array([0.0, 0.0, 30.0, 30.0, 30.0])
    beyond = odometer_beyond_confidence(t_ns, odometer_m, train_m, np.zeros(5), seconds(1, 3), LdsConfig())
    assert beyond.tolist() == [False, False, True, False, False]


@pytest.mark.parametrize(("first", "begin_ns"), [(None, 10), (1, 1), (2, 10)])
def test_what_a_step_offers_on_its_way_lies_before_its_first_position(first: int | None, begin_ns: int) -> None:
    step = None if first is None else SimpleNamespace(first=first)
    episode = SimpleNamespace(onset_ns=10, end_ns=30, detected_ns=None, step=step)
    series = SimpleNamespace(t_ns=np.array([0, 10, 20]))
    assert Episode.undetected_ns(cast(Any, episode), cast(Any, series)) == (begin_ns, 30)


@pytest.mark.parametrize(
    ("low_m", "high_m", "told", "verdict"),
    [
        ([-1.0, 4.0], [1.0, 9.0], [True, True], Verdict.UNKNOWN),  # 4 to 9 m against 5 m
        ([-1.0, 6.0], [1.0, 9.0], [False, False], Verdict.TRUE),
        ([-9.0, 0.0], [-6.0, 1.0], [True, True], Verdict.TRUE),
        ([-1.0, -5.0], [1.0, 5.0], [True, True], Verdict.FALSE),
        ([-1.0, -5.0], [1.0, 5.0], [True, False], Verdict.UNKNOWN),
        ([-1.0, np.nan], [1.0, np.nan], [True, True], Verdict.UNKNOWN),
        ([], [], [], Verdict.UNKNOWN),
    ],
)
def test_an_alarm_is_false_only_where_all_of_its_positions_were_well(
    low_m: list[float], high_m: list[float], told: list[bool], verdict: Verdict
) -> None:
    margin_m = np.full(len(told), 5.0)
    assert verdict_within(np.array(low_m), np.array(high_m), margin_m, np.array(told, dtype=bool)) is verdict


def test_errors_across_are_left_of_growing_path_and_upwards() -> None:
    """Two samples of a reference on the equator, 2 s and 20 m east apart; positions 1 m north and 3 m above."""
    stamps = pl.Series("t", [0, 2 * NS], dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    reference = pl.DataFrame(
        {"t": stamps, "latitude_deg": [0.0, 0.0], "longitude_deg": [0.0, 20.0 * DEG_PER_M], "height_m": [50.0, 52.0]}
    )
    at_s, east_m = [0.0, 1.0, 1.0, 2.0, 2.5], np.array([0.0, 10.0, 35.0, 20.0, 25.0])
    north_deg = np.degrees(1.0 / 6335439.3)  # radius of curvature of the meridian at the equator, WGS 84
    fixes = pl.DataFrame({"latitude_deg": [north_deg] * 5, "longitude_deg": east_m * DEG_PER_M, "height_m": [54.0] * 5})
    for heading_deg, left_m in ((90.0, 1.0), (270.0, -1.0)):
        across, up = errors_across(fixes, np.full(5, heading_deg), seconds(*at_s), reference, 2.0, 20.0)
        # The third is 25 m ahead, the last after the reference ended.
        assert across == pytest.approx([left_m, left_m, np.nan, left_m, np.nan], abs=1e-3, nan_ok=True)
        assert up == pytest.approx([4.0, 3.0, np.nan, 2.0, np.nan], abs=1e-3, nan_ok=True)
    nothing = errors_across(fixes, np.full(5, 90.0), seconds(*at_s), reference.head(1), 2.0, 20.0)
    assert all(np.isnan(values).all() for values in nothing)


def test_a_train_passes_a_balise_between_two_routes_that_the_evidence_tells_of() -> None:
    """On element 0 alone up to 98 m at 2 s, from 106 m at 3 s on over element 1, which begins at 100 m."""
    before = Route(*(np.array([value]) for value in (0, True, 0.0, 0.0, 100.0)))
    after = Route(
        np.array([0, 1]), np.array([True, True]), np.array([0.0, 100.0]), np.array([0.0, 0.0]), np.array([100.0, 100.0])
    )
    alternatives = tuple(
        Alternative(np.array(rows), route, np.array(at_m) - 1.0, np.array(at_m) + 1.0)
        for rows, route, at_m in (
            ([0, 1, 2], before, [80.0, 90.0, 98.0]),
            ([3, 4, 5], after, [106.0, 114.0, 122.0]),
        )
    )
    none = np.zeros(0, dtype=np.int64)
    evidence = EvidenceSet(np.zeros(6, dtype=np.int64), alternatives, none, none)
    places = {"V1": Place(1, 2.0), "V2": Place(1, 60.0)}
    found = train_passings(seconds(0, 1, 2, 3, 4, 5), evidence, places, 5.0, 3.0)
    # 102 m lies in the middle between 98 m and 106 m; 160 m was not reached.
    assert found == {"V1": [Passing(round(2.5 * NS), 1, True)], "V2": []}
    # Where the place is known to 0.5 m only, evidence of 1 m to both sides tells of no passing.
    assert train_passings(seconds(0, 1, 2, 3, 4, 5), evidence, places, 0.5, 3.0) == {"V1": [], "V2": []}


def test_the_margin_of_a_healthy_position() -> None:
    """max(5 m, min(3 sigma, 20 m)); 20 m where no sigma is known."""
    assert margins_m(np.array([0.5, 3.0, 20.0, np.nan]), HazardConfig()).tolist() == [5.0, 9.0, 20.0, 20.0]


def test_what_an_episode_hit() -> None:
    """Of ten offers: 20 m and less are no shift, nor is what was not offered, not wrong, or outside numbers 2 to 7."""
    number = np.array([1, 2, 3, 4, 5, 6, 7, 8, 3, 4])
    least_m = np.array([30.0, 30.0, 30.0, 10.0, 30.0, 30.0, 0.0, 30.0, 20.0, 20.1])
    code = np.array([WRONG, WRONG, WRONG, WRONG, RIGHT, UNKNOWN, WRONG, WRONG, WRONG, WRONG])
    astray, offered = number == 7, np.arange(10) != 2
    judged = SimpleNamespace(least_m=least_m, code=code, wrong_track=astray)
    offers = SimpleNamespace(number=number, judged=judged, offered=offered, t_ns=np.arange(10))
    episode = SimpleNamespace(onset=2, end=8, jump_back=None, holds=lambda own: (own >= 2) & (own < 8))
    bench = SimpleNamespace(series=SimpleNamespace(jumps=[]), offers=offers, config=Configuration())
    found = drafts_of(cast(Any, [episode]), cast(Any, bench))
    assert [(draft.hazard, draft.hits) for draft in found] == [
        (Hazard.VB_SHIFT, [1, 9]),
        (Hazard.VB_WRONG_TRACK, [6]),
    ]


@pytest.mark.parametrize(
    ("before_m", "step_m", "after_m", "code", "back"),
    [
        (30.0, -30.0, 0.0, RIGHT, True),
        (-30.0, 30.0, 0.0, RIGHT, True),
        (30.0, 30.0, 0.0, RIGHT, False),  # farther away
        (0.1, 8.0, 8.1, RIGHT, False),  # on from a place that was hardly wrong
        (30.0, -30.0, 20.0, UNKNOWN, True),
        (30.0, -30.0, 20.1, UNKNOWN, False),  # still beyond the limit
        (30.0, -30.0, 0.0, WRONG, False),  # on another track
    ],
)
def test_a_jump_back_leads_to_a_place_that_is_not_wrong(
    before_m: float, step_m: float, after_m: float, code: int, back: bool
) -> None:
    judged = SimpleNamespace(
        middle_m=np.array([before_m, 0.0]), least_m=np.array([0.0, after_m]), code=np.array([WRONG, code])
    )
    found = _is_back(cast(Any, SimpleNamespace(judged=judged)), Jump(1, 1, step_m), HazardConfig())
    assert bool(found) is back


@pytest.mark.parametrize(("known", "detected_s"), [(True, 7.0), (False, 7.0), (True, None)])
def test_the_times_of_a_hazard(known: bool, detected_s: float | None) -> None:
    """From 100 s on each second: onset at 103 s, a VB hit at 104 s, failure at 105 s, alarm at 107 s, end at 109 s."""
    begin = 100 * NS
    detected_ns = None if detected_s is None else begin + round(detected_s * NS)
    episode = SimpleNamespace(
        onset_ns=begin + 3 * NS, end_ns=begin + 9 * NS, failure=5, failure_known=known, detected_ns=detected_ns,
        monitor=None if detected_ns is None else "raw", alarm_before_onset=False,
    )  # fmt: skip
    t_ns = begin + seconds(*range(10))
    series = SimpleNamespace(t_ns=t_ns, row=np.arange(10))
    offers = SimpleNamespace(t_ns=begin + seconds(1, 4), number=np.array([1, 4]))
    bench = SimpleNamespace(
        series=series,
        offers=offers,
        t_ns=t_ns,
        position_ns=t_ns,
        positions=SimpleNamespace(direction=np.full(10, -1), leg=np.zeros(10, dtype=np.int64)),
        judged=SimpleNamespace(middle_m=np.full(10, 25.0)),
        path_m=500.0 - 10.0 * np.arange(10),
        solution=SimpleNamespace(path=SimpleNamespace(locate=lambda leg, at_m: (["e"], np.array([at_m - 400.0])))),
        speed_at=lambda at_ns: np.array([10.0]),
        config=Configuration(),
    )
    draft = SimpleNamespace(episode=episode, jump=None, hits=[1])
    found = _instants(cast(Any, draft), cast(Any, bench))
    assert (found["t_onset"], found["t_hazard"], found["t_failure"], found["t_end"]) == tuple(
        begin + seconds(3, 4, 5, 9)
    )
    seen = detected_s is not None
    assert (found["detected"], found["t_negated"]) == (seen, begin + 8 * NS if seen else None)  # one epoch to react
    assert found["time_to_detect_s"] == (4.0 if seen else None)
    assert found["time_since_failure_s"] == (2.0 if seen and known else None)
    # At 460 m against growing path, 25 m ahead of the train.
    assert (found["path_m"], found["measure_m"], found["speed_mps"]) == (485.0, 85.0, 10.0)


@pytest.mark.parametrize(
    ("kind", "error_m", "stood", "counted_wrong", "sure", "suspect"),
    [
        (Evidence.REFERENCE, 9.0, False, True, True, Suspect.GNSS),
        (Evidence.ODOMETER, 9.0, True, False, True, Suspect.ODOMETER),
        (Evidence.ODOMETER, 9.0, False, True, True, Suspect.ODOMETER),
        (Evidence.ODOMETER, 9.0, False, False, False, Suspect.GNSS),
        (Evidence.REFERENCE, 5.0, False, False, False, Suspect.TRACK),  # 5 m is the margin
        (Evidence.REFERENCE, 0.0, False, False, True, Suspect.UNKNOWN),
    ],
)
def test_who_is_suspected(
    kind: Evidence, error_m: float, stood: bool, counted_wrong: bool, sure: bool, suspect: Suspect
) -> None:
    """Ten epochs, of which the sixth tells; an alarm at 6 s. The odometer and the Doppler are silent."""
    told = np.arange(10) == 5
    error = np.where(told, error_m, 0.0)
    nothing = pl.Series([None] * 10, dtype=pl.Float64)
    bench = SimpleNamespace(
        t_ns=seconds(*range(10)),
        at_ns=seconds(*range(10)),
        judged=Judgements(np.full(10, RIGHT), error, error, np.full(10, KINDS.index(kind)), np.zeros(10, dtype=bool)),
        margin_m=np.full(10, 5.0),
        stood=[(5 * NS, 6 * NS)] if stood else [],
        odometer_wrong=told & counted_wrong,
        path_m=np.arange(10.0),
        positions=SimpleNamespace(unambiguous=~told | sure),
        epochs=pl.DataFrame({"odometer_m": nothing, "velocity_along_mps": nothing}),
        config=Configuration(),
    )
    assert suspect_of(cast(Any, bench), 6 * NS, 6 * NS) is suspect
    # What was before the time looked back on does not count.
    late = 70 * NS
    assert suspect_of(cast(Any, bench), 6 * NS + late, 6 * NS + late) is Suspect.UNKNOWN


@pytest.mark.parametrize(
    ("codes", "step", "failure"),
    [
        ([WRONG, WRONG, WRONG, RIGHT, WRONG, WRONG, WRONG, RIGHT], None, 4),  # 2 s at the begin lie before the onset
        ([RIGHT, RIGHT, RIGHT, WRONG, RIGHT, WRONG, RIGHT, RIGHT], None, None),
        ([RIGHT, RIGHT, RIGHT, WRONG, RIGHT, WRONG, RIGHT, RIGHT], (5, 5), 5),  # a step counts at once
    ],
)
def test_a_failure_is_a_second_of_wrong_from_the_onset_on(
    codes: list[int], step: tuple[int, int] | None, failure: int | None
) -> None:
    """Positions each 0.5 s, the onset is the third."""
    series = SimpleNamespace(judged=SimpleNamespace(code=np.array(codes)), t_ns=seconds(*(0.5 * np.arange(8))))
    jump = None if step is None else SimpleNamespace(first=step[0], last=step[1])
    assert _failure(cast(Any, series), 2, 8, cast(Any, jump), HazardConfig()) == failure


def placed(path_m: list[float], direction: int = 1, element: int = 0) -> Positions:
    """Positions on one element, whose measure is the path position."""
    at_m, size = np.array(path_m), len(path_m)
    of_element = np.where(np.isnan(at_m), -1, element)
    leg = np.zeros(size, dtype=np.int64)
    return Positions(of_element, at_m, leg, at_m, np.full(size, direction), np.ones(size, dtype=bool))


def test_each_alternative_is_weighed_however_few_instants_it_tells_of() -> None:
    """On element 0 the train is at 50 m; at 2 s it is there or at 90 m, and at 3 s the position is not known."""
    route = Route(*(np.array([value]) for value in (0, True, 0.0, 0.0, 100.0)))
    told = [Alternative(np.array(rows), route, np.array(low), np.array(low) + 2.0) for rows, low in (
        ([0, 1, 2, 3], [49.0] * 4), ([2], [89.0]), ([3], [89.0]))]  # fmt: skip
    none = np.zeros(0, dtype=np.int64)
    evidence = EvidenceSet(np.full(4, KINDS.index(Evidence.BALISE)), tuple(told), none, none)
    found = judge_positions(placed([50.0, 80.0, 50.0, np.nan]), evidence, [route], HazardConfig())
    assert found.code.tolist() == [RIGHT, WRONG, UNKNOWN, UNKNOWN]
    assert found.low_m == pytest.approx([-1.0, 29.0, -41.0, np.nan], nan_ok=True)
    assert found.high_m == pytest.approx([1.0, 31.0, 1.0, np.nan], nan_ok=True)
    assert found.kind.tolist() == [KINDS.index(Evidence.BALISE)] * 3 + [NOTHING]


@pytest.mark.parametrize("direction", [1, -1])
def test_the_odometer_since_a_balise_shows_only_what_was_wrong(direction: int) -> None:
    """20 m is the limit: 15 to 25 m off is unknown, 21 to 31 m wrong; nothing without a position, interval or need."""
    positions = placed([115.0, 121.0, 121.0, np.nan, 121.0, 79.0], direction)
    nothing, balise = NOTHING, KINDS.index(Evidence.BALISE)
    before = np.array([nothing, nothing, balise, nothing, nothing, nothing])
    unknown = np.full(6, np.nan)
    judged = Judgements(np.full(6, UNKNOWN), unknown, unknown, before, np.zeros(6, dtype=bool))
    low_m = np.array([90.0, 90.0, 90.0, 90.0, np.nan, 100.0])
    found = with_own_anchors(judged, positions, (low_m, low_m + 10.0), HazardConfig())
    assert found.code.tolist() == [UNKNOWN, WRONG, UNKNOWN, UNKNOWN, UNKNOWN, WRONG]
    odometer = KINDS.index(Evidence.ODOMETER)
    assert found.kind.tolist() == [odometer, odometer, balise, nothing, nothing, odometer]
    low, high = (15.0, 21.0, -31.0), (25.0, 31.0, -21.0)
    if direction < 0:
        low, high = (-25.0, -31.0, 21.0), (-15.0, -21.0, 31.0)
    assert found.low_m[[0, 1, 5]].tolist() == list(low)
    assert found.high_m[[0, 1, 5]].tolist() == list(high)


def test_a_position_is_in_use_since_the_one_before_it_until_it_is_negated() -> None:
    """At 1 Hz with a gap of 5 s; the alarm at 9 s takes one epoch to negate, until 12 s; the last is not confident."""
    t_s = [0, 1, 2, 7, 8, 9, 10, 11, 12, 13]
    stamps = pl.Series("t", np.array(t_s) * NS, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    epochs = pl.DataFrame(
        {
            "t": stamps, "path_m": [10.0 * t for t in t_s], "on_track": True, "gate_probability": 1.0,
            "confidence_m": [5.0] * 9 + [500.0], "negated": [t in (9, 10, 11) for t in t_s],
        }
    )  # fmt: skip
    # Each second counts for the position at its end; of the gap 1.5 s, as long as a movement is interpolated over.
    expected = [1.0, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert in_use_s(epochs, Configuration()).tolist() == expected
    assert in_use_s(epochs.head(1), Configuration()).tolist() == [0.0]


def test_a_train_moves_farther_in_a_second_than_the_noise_of_its_places() -> None:
    """Places each 0.5 s, known to 0.1 m: 0.4 m in a second are less than 0.3 m and both noises, 0.6 m are more."""
    at_m = np.array([0.0, 0.2, 0.4, 0.8, 1.2, 1.6, np.nan, np.nan, np.nan, np.nan])
    bench = SimpleNamespace(
        at_ns=seconds(*(0.5 * np.arange(10))),
        by_reference_m=at_m,
        judged=SimpleNamespace(half_m=np.full(10, 0.1)),
        odometer_moves=np.array([True] * 8 + [False] * 2),
        odometer_told=np.array([False] * 6 + [True] * 3 + [False]),
        stood=[(round(3.5 * NS), 4 * NS)],
        config=Configuration(),
    )
    bench._came = lambda *given: Bench._came(cast(Any, bench), *given)
    moves, sure = cast(Any, Bench.moving).func(bench)
    # By the reference up to 1.5 s, as far as it goes; then by the odometer from 3 s on, but for what it stood.
    assert sure.tolist() == [True, True, True, True, False, False, True, False, True, True]
    assert moves[sure].tolist() == [False, True, True, True, True, False, False]


def test_what_an_interval_of_errors_says() -> None:
    """From 4 m late to 6 m early; from 2 to 4 m early; from 9 to 5 m late, by the odometer alone."""
    kinds = np.array([KINDS.index(kind) for kind in (Evidence.REFERENCE, Evidence.BALISE, Evidence.ODOMETER)])
    low_m, high_m = np.array([-4.0, 2.0, -9.0]), np.array([6.0, 4.0, -5.0])
    judged = Judgements(np.full(3, UNKNOWN), low_m, high_m, kinds, np.zeros(3, dtype=bool))
    assert judged.middle_m.tolist() == [1.0, 3.0, -7.0]
    assert judged.half_m.tolist() == [5.0, 1.0, 2.0]
    assert judged.least_m.tolist() == [0.0, 2.0, 5.0]
    assert judged.largest_m.tolist() == [6.0, 4.0, 9.0]
    assert judged.known_m(4.9) == pytest.approx([np.nan, 3.0, np.nan], nan_ok=True)
    assert judged.known_m(5.0) == pytest.approx([1.0, 3.0, np.nan], nan_ok=True)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("onward", "code"), [([0], RIGHT), ([0, 2], WRONG), ([0, 1], RIGHT)])
def test_where_the_evidence_ends_the_position_is_held_to_it_by_its_own_path(
    onward: list[int], code: int, direction: int
) -> None:
    """The train at 95 to 97 m of element 0, the position 10 m on, on element 1; the evidence may go on elsewhere."""

    def route(elements: list[int]) -> Route:
        size = len(elements)
        entry_m = 100.0 * np.arange(size)
        return Route(np.array(elements), np.full(size, True), entry_m, np.zeros(size), np.full(size, 100.0))

    at_m, leg, sure = np.array([110.0]), np.zeros(1, dtype=np.int64), np.ones(1, dtype=bool)
    positions = Positions(np.array([1]), at_m - 100.0, leg, at_m, np.array([direction]), sure)
    told = Alternative(np.array([0]), route(onward), np.array([95.0]), np.array([97.0]))
    evidence = EvidenceSet(np.array([KINDS.index(Evidence.BALISE)]), (told,), leg[:0], leg[:0])
    found = judge_positions(positions, evidence, [route([0, 1])], HazardConfig())
    assert found.code.tolist() == [code]
    assert found.wrong_track.tolist() == [code == WRONG]
    expected_m = (13.0, 15.0) if direction > 0 else (-15.0, -13.0)
    if code == RIGHT:
        assert (found.low_m[0], found.high_m[0]) == pytest.approx(expected_m)


@pytest.mark.parametrize(
    ("by_odometer", "gap_s", "direction", "jumps"),
    [
        (True, 1.0, 1, [(3, 4, 30.0), (8, 8, -30.0)]),
        (False, 1.0, 1, [(3, 4, 30.0), (8, 8, -30.0)]),
        (True, 1.0, -1, [(3, 4, -30.0), (8, 8, 30.0)]),
        (True, 0.4, 1, []),  # no movement is interpolated over such a step
    ],
)
def test_a_jump_is_what_gathers_within_a_second(
    by_odometer: bool, gap_s: float, direction: int, jumps: list[tuple[int, int, float]]
) -> None:
    """10 m each 0.5 s; 15 m too far at the fourth and again at the fifth position, back at the ninth."""
    error_m = np.array([0.0, 0.0, 0.0, 15.0, 30.0, 30.0, 30.0, 30.0, 0.0, 0.0])
    train_m, t_ns = 10.0 * np.arange(10), seconds(*(0.5 * np.arange(10)))
    unknown = np.full(10, np.nan)
    told = (unknown, np.full(9, 10.0)) if by_odometer else (train_m, unknown[:9])
    steps = steps_of(t_ns, train_m + error_m, *told, round(gap_s * NS))
    found = find_jumps(steps, np.full(10, direction), HazardConfig())
    assert [(one.first, one.last, one.step_m) for one in found] == jumps


@pytest.mark.parametrize(("train_m", "crossed"), [(120.0, [2, 3]), (np.nan, [1, 2, 3]), (128.0, [1, 3])])
def test_a_jump_crosses_what_the_train_itself_did_not(train_m: float, crossed: list[int]) -> None:
    """From 100 m to 140 m by a jump of 30 m: the train's own 10 m cross what lies in them, from where it is known."""
    offers = SimpleNamespace(
        virtual=np.array([True, True, True, True, False, True]), number=np.array([2, 3, 3, 3, 3, 4]),
        path_m=np.array([99.0, 125.0, 135.0, 111.0, 138.0, 145.0]),
    )  # fmt: skip
    series = SimpleNamespace(
        path_m=np.array([80.0, 90.0, 100.0, 140.0, 150.0]), direction=np.ones(5), train_m=np.full(5, train_m)
    )
    assert crossed_by(Jump(3, 3, 30.0), cast(Any, offers), cast(Any, series)) == crossed


@pytest.mark.parametrize(
    ("onset_s", "mark_s", "named_s"),
    [
        (12, 20, 11),  # the last fault that had begun, of those that lasted
        (5, 20, 8),  # else the first one after
        (5, 7, None),
        (40, 50, 35),  # without an end it lasts
        (25, 27, None),  # all of the positions' have ended, and the odometer's is none
    ],
)
def test_the_onset_is_that_of_a_fault_of_the_positions_that_lasted(
    onset_s: int, mark_s: int, named_s: int | None
) -> None:
    begins, ends = [8, 11, 21, 35], [15, 14, 60, None]
    faults = pl.DataFrame(
        {
            "t_start": pl.Series(begins, dtype=pl.Int64) * NS,
            "t_end": pl.Series(ends, dtype=pl.Int64) * NS,
            "target": ["position", "along", "odometer", "G08"],
        }
    ).with_columns(pl.col("t_start", "t_end").cast(pl.Datetime("ns", "UTC")))
    found = _named_onset_ns(faults, onset_s * NS, mark_s * NS)
    assert found == (None if named_s is None else named_s * NS)
    assert _named_onset_ns(faults.clear(), onset_s * NS, mark_s * NS) is None
    assert _named_onset_ns(None, onset_s * NS, mark_s * NS) is None


def test_evidence_is_looked_at_between_positions_that_are_far_apart() -> None:
    """A look each second at least; a step of 1.5 s is none to fill."""
    bench = SimpleNamespace(at_ns=seconds(0, 0.5, 2.0, 5.0, 6.0), config=Configuration())
    assert (_look_at(cast(Any, bench)) / NS).tolist() == [0.0, 0.5, 2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("half_m", "jump", "back", "size", "rate"),
    [
        (1.0, None, False, -25.0, -2.5),  # the largest error known to 5 m, and its slope from the onset on
        (6.0, None, False, -19.0, None),  # none is known: the largest that is sure
        (6.0, Jump(3, 3, 30.0), False, 30.0, None),
        (1.0, Jump(3, 3, 30.0), False, -25.0, None),
        (1.0, Jump(3, 3, 30.0), True, 30.0, None),  # of a jump back its step
    ],
)
def test_the_size_and_slope_of_a_hazard(
    half_m: float, jump: Jump | None, back: bool, size: float, rate: float | None
) -> None:
    """2.5 m more each second; the third position is the onset, and the failure the one after it."""
    middle_m = -2.5 * np.arange(12.0) + 2.5
    kind = np.full(12, KINDS.index(Evidence.REFERENCE))
    judged = Judgements(np.full(12, WRONG), middle_m - half_m, middle_m + half_m, kind, np.zeros(12, dtype=bool))
    episode = SimpleNamespace(onset=2, end=12, mark=10, failure=3, onset_ns=2 * NS, step=None, jump_back=None)
    if back:
        episode.jump_back = jump
    bench = SimpleNamespace(
        series=SimpleNamespace(judged=judged, t_ns=seconds(*range(12))), offers=SimpleNamespace(judged=judged),
        config=Configuration(),
    )  # fmt: skip
    draft = cast(Any, SimpleNamespace(episode=episode, jump=jump, hits=[9]))
    assert size_m(draft, cast(Any, bench)) == pytest.approx(size)
    found = rate_mps(draft, cast(Any, bench))
    assert found == (None if rate is None else pytest.approx(rate))
