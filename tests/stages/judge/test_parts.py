"""Single rules of the judge on a handful of rows, worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from pipeline.stages.epochs.verdicts import AlarmEpisode, FailureLog, MonitoredEpochs
from pipeline.stages.evidence.evidence import KINDS, NOTHING, Alternative, EvidenceSet
from pipeline.stages.judge.episodes import (
    Detection,
    Episode,
    Extent,
    _earliest_failure_ns,
    _failure_begin,
    _is_alarm_of,
    _leads_back,
    alarm_verdict,
    find_episodes,
    injected_onset_ns,
    suspected_source,
    verdict_of_intervals,
    within_noise_across,
)
from pipeline.stages.judge.epochs import (
    OdometerSteps,
    TimeInUse,
    cross_errors_m,
    exceeds_odometer_confidence,
    injected_at,
    lds_states,
    moves_and_may_move,
    time_in_use,
    travel_direction,
)
from pipeline.stages.judge.failures import (
    ErrorHistory,
    Failure,
    Jump,
    find_failures,
    find_jumps,
    keeps_budget,
    position_changes,
)
from pipeline.stages.judge.hazards import (
    HazardRow,
    _evidence_of_row,
    crossed_by_jump,
    error_growth_mps,
    hazard_rows,
    hazard_size_m,
    instant_columns,
)
from pipeline.stages.judge.judge import _is_interpolated, _take_true_times, failure_columns
from pipeline.stages.judge.judged import RIGHT, UNKNOWN, WRONG, Judgements
from pipeline.stages.judge.judgement import (
    JudgeInput,
    MatchedPositions,
    Solution,
    healthy_margins_m,
    judge_by_own_anchors,
    judge_positions,
)
from pipeline.stages.judge.train_crossings import TrueCrossing, true_crossings, with_instants_between
from pipeline.stages.track.path import Place, RoutePath
from schemas.config import Configuration, HazardConfig, LdsConfig, Vehicle
from schemas.enums import Evidence, Hazard, Judgement, LdsState, PassageStatus, Suspect, Verdict
from schemas.stages import Crossings
from tests.arrays_of_table import arrays_of_table
from tests.stages.judge.frames import NS, history, offers, positions

EPISODE = Episode(
    mark=0, onset=0, end=1, begin_ns=0, onset_ns=0, end_ns=1, step=None, jump_back=None, failed=None, may_ns=None,
    detection=Detection(), failure=Failure(0, 0, 0, 1, 0.0, 0.0, 0.0, Judgement.RIGHT, True),
)  # fmt: skip
DEG_PER_M = np.degrees(1.0 / 6378137.0)  # east along the equator


def proving(kind: Any, alternatives: Sequence[Alternative]) -> EvidenceSet:
    """Evidence by independent witnesses on a survey that is complete."""
    return EvidenceSet(kind, tuple(alternatives), *np.ones((2, kind.size), dtype=np.bool_))


def seconds(*t_s: float) -> Any:
    return np.array([round(t * NS) for t in t_s], dtype=np.int64)


def ns(t_s: float | None) -> int | None:
    return None if t_s is None else round(t_s * NS)


def episodes(of: ErrorHistory) -> list[Episode]:
    """Where no monitor fails and nothing was offered."""
    within_noise = FailureLog(of.t_ns, np.zeros(of.size, dtype=bool), np.zeros(0, dtype=np.int64), (), ())
    return find_episodes(of, find_failures(of), within_noise, None)


def test_settled_and_within_noise_is_half_of_the_limit_that_holds_then() -> None:
    """12 m off for 16 s, of which noise explains 30 m: within half of 24 m from 3 s on, not within half of 20 m."""
    frame = positions(range(16), 12.0, 0.0, sigma_along_m=10.0)
    limit_m = np.where(np.arange(16) >= 3, 24.0, 20.0)
    judged = history(replace(frame, judgements=replace(frame.judgements, limit_m=limit_m)))
    assert judged.within_noise.tolist() == [False] * 3 + [True] * 13
    # Ten seconds of it have to lie ahead.
    assert judged.settled_from.tolist() == [3, 3, 3, 3, 4, 5] + [16] * 10


@pytest.mark.parametrize(
    ("judged", "accepted", "epoch", "may_s", "kept"),
    [
        ("wrong", True, 1, 0.2, True),  # accepted before the failure
        ("wrong", False, 3, 0.2, True),  # offered in it, not accepted
        ("wrong", True, 3, 0.2, False),
        ("unknown", True, 3, 0.2, None),
        ("right", True, 3, 0.7, None),  # 0.2 s wrong for sure, 0.7 s at most, 0.5 s allowed
    ],
)
def test_a_budget_is_kept_where_nothing_wrong_was_accepted_in_the_failure(
    judged: str, accepted: bool, epoch: int, may_s: float, kept: bool | None
) -> None:
    """From the third of eight positions on."""
    offered = offers([epoch], judgement=judged, accepted=accepted)
    worst = history(positions(range(8)), offered=offered).worst_accepted(2, 8)
    assert keeps_budget(0.2, may_s, worst, 0.5) is kept


def test_the_distance_counts_from_the_last_accepted_balise() -> None:
    """The odometer misses 30 m between 1 s and 2 s; a balise accepted at 3 s is a new begin."""
    t_ns, odometer_m = seconds(0, 1, 2, 3, 4), np.linspace(0.0, 40.0, 5)
    train_m = odometer_m + np.array([0.0, 0.0, 30.0, 30.0, 30.0])
    beyond = exceeds_odometer_confidence(t_ns, odometer_m, train_m, np.zeros(5), seconds(1, 3), LdsConfig())
    assert beyond.tolist() == [False, False, True, False, False]


@pytest.mark.parametrize(("detected_ns", "until_ns"), [(None, 30), (20, 20)])
def test_a_fault_is_undetected_until_a_monitor_fails_or_to_its_end(detected_ns: int | None, until_ns: int) -> None:
    episode = replace(EPISODE, begin_ns=1, end_ns=30, detection=Detection(detected_ns))
    assert episode.undetected_span_ns == (1, until_ns)


def test_what_a_step_offers_on_its_way_lies_before_its_first_position() -> None:
    """A step from the second to the third position: it begins right after the second."""
    frame = positions(range(30), [0.0, 0.0] + [30.0] * 5 + [0.0] * 23)
    (episode,) = episodes(history(frame, Jump(2, 2, 30.0)))
    assert (episode.onset_ns, episode.begin_ns) == (2 * NS, NS + 1)


@pytest.mark.parametrize(
    ("low_m", "high_m", "judged", "verdict"),
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
    low_m: list[float], high_m: list[float], judged: list[bool], verdict: Verdict
) -> None:
    margin_m = np.full(len(judged), 5.0)
    assert verdict_of_intervals(np.array(low_m), np.array(high_m), margin_m, np.array(judged, dtype=bool)) is verdict


def errors_across(fixes: pl.DataFrame, heading_deg: Any, at_s: list[float], reference: pl.DataFrame) -> list[Any]:
    absent: Any = None
    stamps = pl.DataFrame({"t": seconds(*at_s)}).cast(pl.Datetime("ns", "UTC"))
    epochs = arrays_of_table(MonitoredEpochs, stamps)
    solution = Solution("primary", fixes, epochs, absent, absent, absent, absent)
    given = JudgeInput(solution, absent, None, Vehicle(), Configuration(), reference)
    return list(cross_errors_m(given, heading_deg))


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
        across, up = errors_across(fixes, np.full(5, heading_deg), at_s, reference)
        # The third is 25 m ahead, the last after the reference ended.
        assert across == pytest.approx([left_m, left_m, np.nan, left_m, np.nan], abs=1e-3, nan_ok=True)
        assert up == pytest.approx([4.0, 3.0, np.nan, 2.0, np.nan], abs=1e-3, nan_ok=True)
    assert all(np.isnan(values).all() for values in errors_across(fixes, np.full(5, 90.0), at_s, reference.head(1)))


def test_a_train_passes_a_balise_between_two_routes_that_the_evidence_tells_of() -> None:
    """On element 0 alone up to 98 m at 2 s, from 106 m at 3 s on over element 1, which begins at 100 m."""
    before = RoutePath(*(np.array([value]) for value in (0, True, 0.0, 0.0, 100.0)))
    after = RoutePath(
        np.array([0, 1]), np.array([True, True]), np.array([0.0, 100.0]), np.array([0.0, 0.0]), np.array([100.0, 100.0])
    )
    alternatives = tuple(
        Alternative(np.array(rows), route, np.array(at_m) - 1.0, np.array(at_m) + 1.0)
        for rows, route, at_m in (
            ([0, 1, 2], before, [80.0, 90.0, 98.0]),
            ([3, 4, 5], after, [106.0, 114.0, 122.0]),
        )
    )
    evidence = proving(np.zeros(6, dtype=np.int64), alternatives)
    places = {"V1": Place(1, 2.0), "V2": Place(1, 60.0)}
    config = Configuration(lds=LdsConfig(rearm_m=3.0))
    found = true_crossings(seconds(0, 1, 2, 3, 4, 5), evidence, places, config)
    # 102 m lies in the middle between 98 m and 106 m; 160 m was not reached.
    assert found == {"V1": [TrueCrossing(round(2.5 * NS), 1, True)], "V2": []}


@pytest.mark.parametrize(("half_m", "last_m", "crossings"), [(5.0, 105.0, 1), (40.0, 145.0, 1), (40.0, 135.0, 0)])
def test_a_balise_is_passed_where_the_whole_interval_passes_it(half_m: float, last_m: float, crossings: int) -> None:
    """From 5 m on at 10 m/s past a balise at 100 m; a place known to 5 m passes with its middle."""
    at_m = np.arange(5.0, last_m + 1.0, 10.0)
    route = RoutePath(*(np.array([value]) for value in (0, True, 0.0, 0.0, 200.0)))
    rows = np.arange(at_m.size)
    evidence = proving(np.zeros(rows.size, np.int64), (Alternative(rows, route, at_m - half_m, at_m + half_m),))
    found = true_crossings(rows * NS, evidence, {"V": Place(0, 100.0)}, Configuration())
    # 95 m at 9 s, 105 m at 10 s; it is far enough beyond only where the run goes on.
    assert found == {"V": [TrueCrossing(round(9.5 * NS), 1, half_m > 5.0)] * crossings}


@pytest.mark.parametrize(("turn_m", "passed_s"), [(110.0, []), (150.0, [9.5, 19.5])])
def test_a_train_that_turns_at_a_balise_has_not_surely_passed_it(turn_m: float, passed_s: list[float]) -> None:
    """From 5 m on at 10 m/s to a turn beyond a balise at 100 m, and back to 5 m, known to 40 m."""
    there_m = np.arange(5.0, turn_m, 10.0)
    at_m = np.concatenate([there_m, there_m[::-1]])
    rows = np.arange(at_m.size)
    route = RoutePath(*(np.array([value]) for value in (0, True, 0.0, 0.0, 200.0)))
    evidence = proving(np.zeros(rows.size, np.int64), (Alternative(rows, route, at_m - 40.0, at_m + 40.0),))
    found = true_crossings(rows * NS, evidence, {"V": Place(0, 100.0)}, Configuration())
    assert [crossing.t_ns / NS for crossing in found["V"]] == passed_s
    assert [crossing.sense for crossing in found["V"]] == [1, -1][: len(passed_s)]


@pytest.mark.parametrize("half_m", [1.0, 15.0])
def test_a_train_that_stands_on_a_balise_and_goes_on_has_passed_it_once(half_m: float) -> None:
    """From 5 m to a stand at 100 m, where the middle wavers by half a metre, and on to 195 m."""
    wavering_m = 100.0 + 0.5 * np.where(np.arange(20) % 2 == 0, 1.0, -1.0)
    at_m = np.concatenate([np.arange(5.0, 100.0, 10.0), wavering_m, np.arange(105.0, 196.0, 10.0)])
    rows = np.arange(at_m.size)
    route = RoutePath(*(np.array([value]) for value in (0, True, 0.0, 0.0, 200.0)))
    evidence = proving(np.zeros(rows.size, np.int64), (Alternative(rows, route, at_m - half_m, at_m + half_m),))
    (found,) = true_crossings(rows * NS, evidence, {"V": Place(0, 100.0)}, Configuration())["V"]
    assert (found.sense, found.clear) == (1, True)


@pytest.mark.parametrize(("alarm_s", "onset_s", "standing"), [(3, 3, True), (12, 10, False), (None, 10, False)])
def test_an_alarm_shortly_before_a_drift_is_its_onset_and_was_there_before_it(
    alarm_s: int | None, onset_s: int, standing: bool
) -> None:
    """5 m more each second from 10 s on, beyond 20 m from 15 s on; at most 30 s before lies the alarm."""
    frame = positions(range(40), np.clip(5.0 * (np.arange(40.0) - 9.0), 0.0, 60.0))
    drift = history(frame)
    failing = np.array([] if alarm_s is None else [alarm_s], dtype=np.int64)
    alarms = tuple(AlarmEpisode(t, t, t * NS, t * NS, ("along_raw",), 2.0) for t in failing.tolist())
    log = FailureLog(drift.t_ns, np.zeros(drift.size, bool), failing, ("along_raw",) * failing.size, alarms)
    (episode,) = find_episodes(drift, find_failures(drift), log, None)
    assert episode.onset_ns == onset_s * NS
    assert episode.detection.standing is standing
    assert episode.detection.t_ns == ns(alarm_s)


def test_the_margin_of_a_healthy_position() -> None:
    """max(5 m, min(3 sigma, limit)); the limit where no sigma is known. It is 20 m, and in the end 30 m."""
    sigma_m, limit_m = np.array([0.5, 3.0, 20.0, np.nan, 20.0]), np.array([20.0, 20.0, 20.0, 20.0, 30.0])
    assert healthy_margins_m(sigma_m, limit_m, HazardConfig()).tolist() == [5.0, 9.0, 20.0, 20.0, 30.0]


def test_what_an_episode_hit() -> None:
    """Of ten offers: 20 m and less are no shift, nor is what was not offered, not wrong, or outside numbers 2 to 7."""
    least_m = np.array([30.0, 30.0, 30.0, 10.0, 30.0, 30.0, 0.0, 30.0, 20.0, 20.1])
    code = ["wrong"] * 4 + ["right", "unknown"] + ["wrong"] * 4
    epoch = [1, 2, 3, 4, 5, 6, 7, 8, 3, 4]
    offered = offers(
        epoch, judgement=code, error_low_m=least_m, error_high_m=least_m + 2.0,
        offered=[k != 2 for k in range(10)], track_assumed=False, wrong_track=[number == 7 for number in epoch],
    )  # fmt: skip
    judged = history(positions(range(10)), offered=offered)
    found = hazard_rows([replace(EPISODE, onset=2, end=8)], judged)
    assert [(row.hazard, row.hits) for row in found] == [(Hazard.VB_SHIFT, [1, 9]), (Hazard.VB_WRONG_TRACK, [6])]


@pytest.mark.parametrize(
    ("before_m", "step_m", "after_m", "limit_m", "code", "back"),
    [
        (30.0, -30.0, 0.0, 20.0, RIGHT, True),
        (-30.0, 30.0, 0.0, 20.0, RIGHT, True),
        (30.0, 30.0, 0.0, 20.0, RIGHT, False),  # farther away
        (0.1, 8.0, 8.1, 20.0, RIGHT, False),  # on from a place that was hardly wrong
        (30.0, -30.0, 20.0, 20.0, UNKNOWN, True),
        (30.0, -30.0, 20.1, 20.0, UNKNOWN, False),  # still beyond the limit
        (30.0, -30.0, 20.1, 20.2, UNKNOWN, True),  # within the limit that holds then
        (30.0, -30.0, 0.0, 20.0, WRONG, False),  # on another track
    ],
)
def test_a_jump_back_leads_to_a_place_that_is_not_wrong(
    before_m: float, step_m: float, after_m: float, limit_m: float, code: int, back: bool
) -> None:
    middle_m, hazard_size_m = np.array([before_m, 0.0]), np.array([0.0, after_m])
    low_m = np.where(np.arange(2) == 0, middle_m, hazard_size_m)
    kind, track = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=bool)
    judged = Judgements(
        np.array([WRONG, code]), low_m, low_m, kind, track, np.zeros(2, dtype=bool), np.array([20.0, limit_m])
    )
    of_judged = history(replace(positions(range(2)), judgements=judged))
    assert bool(_leads_back(of_judged, Jump(1, 1, step_m))) is back


@pytest.mark.parametrize(("may_s", "detected_s"), [(104.5, 107.0), (None, 107.0), (104.5, None)])
def test_the_times_of_a_hazard(may_s: float | None, detected_s: float | None) -> None:
    """Onset at 103 s, a VB hit at 104 s, failure at 105 s or a little before, alarm at 107 s, end at 109 s."""
    judged = history(positions([100.0 + k for k in range(10)]), offered=offers([1, 4], t=[101 * NS, 104 * NS]))
    episode = replace(
        EPISODE, onset_ns=103 * NS, end_ns=109 * NS, failed=5, may_ns=ns(may_s), detection=Detection(ns(detected_s))
    )
    found = instant_columns(HazardRow(Hazard.VB_SHIFT, episode, None, [1]), judged)
    times = [found[name] for name in ("t_onset", "t_hazard", "t_failure", "t_end")]
    assert times == seconds(103, 104, 105, 109).tolist()
    detected = detected_s is not None
    assert (found["detected"], found["t_negated"]) == (detected, 108 * NS if detected else None)  # one epoch to react
    assert found["time_to_detect_s"] == (4.0 if detected else None)
    assert found["time_since_failure_s"] == (2.0 if detected else None)
    assert found["time_since_failure_may_s"] == (2.5 if detected and may_s is not None else None)


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
    at_fault = np.arange(10) == 5
    epochs = positions(
        range(10), np.where(at_fault, error_m, 0.0), 0.0, evidence=kind.value, odometer_standing=at_fault & stood,
        odometer_wrong=at_fault & counted_wrong, gate_probability=np.where(~at_fault | sure, 1.0, 0.5),
    )  # fmt: skip
    assert suspected_source(epochs, 6 * NS, 6 * NS, Configuration()) is suspect
    # What was before the time looked back on does not count.
    late = 70 * NS
    assert suspected_source(epochs, 6 * NS + late, 6 * NS + late, Configuration()) is Suspect.UNKNOWN


@pytest.mark.parametrize(
    ("wrong", "step", "failure"),
    [
        ([0, 1, 2, 4, 5, 6], None, 4),  # 2 s at the begin lie before the onset
        ([3, 5], None, 3),  # none lasts a second: the first
        ([3, 5], (5, 5), 5),  # a step counts at once
        ([0, 1], None, None),
    ],
)
def test_a_failure_is_a_second_of_wrong_from_the_onset_on(
    wrong: list[int], step: tuple[int, int] | None, failure: int | None
) -> None:
    """Positions each 0.5 s, the onset is the third."""
    frame = positions(0.5 * np.arange(8), [30.0 if k in wrong else 0.0 for k in range(8)])
    jump = None if step is None else Jump(*step, 30.0)
    assert _failure_begin(history(frame), Extent(2, 2, 8, jump, None)) == failure


@pytest.mark.parametrize(
    ("evidence", "judgement", "may_s"),
    [
        (["reference"] * 6, ["right", "unknown", "unknown", "unknown", "unknown", "wrong"], 3),
        (["reference"] * 6, ["right", "unknown", "unknown", "unknown", "right", "wrong"], 5),
        (["reference", None, *["reference"] * 4], ["right", "unknown", "unknown", "unknown", "unknown", "wrong"], None),
        ([None, *["reference"] * 5], ["unknown", "right", "unknown", "unknown", "unknown", "wrong"], 3),
    ],
)
def test_since_when_a_drift_may_have_failed(
    evidence: list[str | None], judgement: list[str], may_s: int | None
) -> None:
    """6 m more each second, known to 5 m: beyond 20 m for certain at 5 s, and possibly from 3 s on."""
    frame = positions(range(6), 6.0 * np.arange(6), 5.0, judgement=judgement, evidence=evidence)
    assert _earliest_failure_ns(history(frame), 5) == ns(may_s)


def test_a_drift_may_have_failed_since_the_limit_of_that_instant() -> None:
    """As before, right until 0 s; of 23 m at 3 s the limit is 24 m, and of 29 m at 4 s it is 20 m."""
    frame = positions(range(6), 6.0 * np.arange(6), 5.0, judgement=["right", *["unknown"] * 4, "wrong"])
    judgements = replace(frame.judgements, limit_m=np.array([20.0, 20.0, 20.0, 24.0, 20.0, 20.0]))
    assert _earliest_failure_ns(history(replace(frame, judgements=judgements)), 5) == ns(4)


def placed(path_m: list[float], element: int = 0) -> MatchedPositions:
    """Positions on one element, whose measure is the path position."""
    at_m, size = np.array(path_m), len(path_m)
    of_element = np.where(np.isnan(at_m), -1, element)
    leg = np.zeros(size, dtype=np.int64)
    return MatchedPositions(of_element, at_m, leg, at_m, np.ones(size, dtype=bool))


def test_each_alternative_is_weighed_however_few_instants_it_tells_of() -> None:
    """On element 0 the train is at 50 m; at 2 s it is there or at 90 m, and at 3 s the position is not known."""
    route = RoutePath(*(np.array([value]) for value in (0, True, 0.0, 0.0, 100.0)))
    alternatives = [Alternative(np.array(rows), route, np.array(low), np.array(low) + 2.0) for rows, low in (
        ([0, 1, 2, 3], [49.0] * 4), ([2], [89.0]), ([3], [89.0]))]  # fmt: skip
    evidence = proving(np.full(4, KINDS.index(Evidence.BALISE)), tuple(alternatives))
    found = judge_positions(placed([50.0, 80.0, 50.0, np.nan]), evidence, [route], np.full(4, 20.0))
    assert found.code.tolist() == [RIGHT, WRONG, UNKNOWN, UNKNOWN]
    assert found.low_m == pytest.approx([-1.0, 29.0, -41.0, np.nan], nan_ok=True)
    assert found.high_m == pytest.approx([1.0, 31.0, 1.0, np.nan], nan_ok=True)
    assert found.kind.tolist() == [KINDS.index(Evidence.BALISE)] * 3 + [NOTHING]


def test_the_odometer_since_a_balise_shows_only_what_was_wrong() -> None:
    """20 m is the limit: 15 to 25 m off is unknown, 21 to 31 m wrong; nothing without a position, interval or need."""
    given = placed([115.0, 121.0, 121.0, np.nan, 121.0, 79.0])
    nothing, balise = NOTHING, KINDS.index(Evidence.BALISE)
    before = np.array([nothing, nothing, balise, nothing, nothing, nothing])
    unknown = np.full(6, np.nan)
    judged = Judgements(np.full(6, UNKNOWN), unknown, unknown, before, *np.zeros((2, 6), dtype=bool), np.full(6, 20.0))
    low_m = np.array([90.0, 90.0, 90.0, 90.0, np.nan, 100.0])
    found = judge_by_own_anchors(judged, given, (low_m, low_m + 10.0))
    assert found.code.tolist() == [UNKNOWN, WRONG, UNKNOWN, UNKNOWN, UNKNOWN, WRONG]
    odometer = KINDS.index(Evidence.ODOMETER)
    assert found.kind.tolist() == [odometer, odometer, balise, nothing, nothing, odometer]
    assert found.low_m[[0, 1, 5]].tolist() == [15.0, 21.0, -31.0]
    assert found.high_m[[0, 1, 5]].tolist() == [25.0, 31.0, -21.0]
    # In the direction of travel: against growing path what is ahead is behind.
    turned = found.turned(np.array([1, -1, 1, 1, 1, -1]))
    # Each is held against its own limit: 21 m and more off is not wrong by 21 m, 31 to 21 m behind not by 22 m.
    wider = replace(judged, limit_m=np.array([20.0, 21.0, 20.0, 20.0, 20.0, 22.0]))
    assert judge_by_own_anchors(wider, given, (low_m, low_m + 10.0)).code.tolist() == [UNKNOWN] * 6
    assert turned.low_m[[0, 1, 5]].tolist() == [15.0, -31.0, 21.0]
    assert turned.high_m[[0, 1, 5]].tolist() == [25.0, -21.0, 31.0]


def used(t_s: Sequence[float], code: Sequence[int] | int, **columns: Any) -> TimeInUse:
    """Time in use of good positions at these times."""
    size = len(t_s)
    plain = {"path_m": 1.0, "on_track": True, "gate_probability": 1.0, "confidence_m": 5.0}
    plain |= {"negated": False, "withheld_for": None}
    values = {name: value if isinstance(value, list) else [value] * size for name, value in (plain | columns).items()}
    stamps = pl.Series("t", [round(t * NS) for t in t_s], dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    values["withheld_for"] = pl.Series(values["withheld_for"], dtype=pl.String)
    epochs = arrays_of_table(MonitoredEpochs, pl.DataFrame({"t": stamps, **values}))
    return time_in_use(epochs, np.broadcast_to(code, size), Configuration())


def test_a_position_is_in_use_since_the_one_before_it_until_it_is_negated() -> None:
    """At 1 Hz with a gap of 5 s; the alarm at 9 s takes one epoch to negate, until 12 s; the last is not confident."""
    t_s = [0, 1, 2, 7, 8, 9, 10, 11, 12, 13]
    given = {"confidence_m": [5.0] * 9 + [500.0], "negated": [t in (9, 10, 11) for t in t_s]}
    found = used(t_s, RIGHT, **given)
    # Each second counts for the position at its end; of the gap no more than a step that is none, however wrong.
    in_use_s = [1.0, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert found.used_s.tolist() == in_use_s
    assert found.in_use.tolist() == [True] * 7 + [False] * 3
    assert found.counted_s.tolist() == [1.0] * 3 + [1.5] + [1.0] * 6
    assert used(t_s, WRONG, **given).wrong_s.tolist() == in_use_s
    assert used([0.0], WRONG).wrong_s.tolist() == [0.0]


def test_a_wrong_position_counts_whole_since_the_one_before_it_and_an_unknown_one_too() -> None:
    """At 10 Hz with 0.9 s of nothing: right before it, wrong behind it; then unknown and wrong, 0.9 s later."""
    t_s = [0.0, 0.1, 1.0, 1.1, 2.0, 2.1, 2.2]
    found = used(t_s, [RIGHT, RIGHT, WRONG, WRONG, UNKNOWN, WRONG, WRONG])
    assert found.wrong_s == pytest.approx([0.0, 0.0, 0.9, 0.1, 0.0, 0.1, 0.1])
    assert found.used_s == pytest.approx([0.1, 0.1, 0.9, 0.1, 0.9, 0.1, 0.1])


def test_a_stretch_of_a_slower_log_hides_no_second() -> None:
    """10 Hz, then 1 Hz: wrong at the first slow epoch, which raises the alarm; negated at the next one."""
    t_s = [*np.arange(200) / 10.0, 20.9, 21.9, 22.9]
    code, size = np.full(203, RIGHT), 203
    code[200:] = WRONG
    found = used(t_s, code.tolist(), negated=[row >= 200 for row in range(size)])
    assert found.wrong_s[199:] == pytest.approx([0.0, 1.0, 1.0, 0.0])
    assert found.in_use.tolist()[199:] == [True, True, True, False]


@pytest.mark.parametrize(
    ("target", "end_s", "under"),
    [
        ("along", 20.0, "--++++---"),  # to 50 s: 30 s of recovery
        ("G08", None, "--+++++++"),
        ("satellites", 40.0, "--++++++-"),
        ("odometer", 20.0, "---------"),
        ("door", None, "---------"),
    ],
)
def test_only_an_injected_fault_of_gnss_is_not_natures(target: str, end_s: float | None, under: str) -> None:
    """Every 10 s; the fault begins at 20 s."""
    stamps = [pl.Series([None if t is None else ns(t)], dtype=pl.Int64) for t in (20.0, end_s)]
    begin, end = (stamp.cast(pl.Datetime("ns", "UTC")) for stamp in stamps)
    faults = pl.DataFrame({"t_start": begin, "t_end": end, "target": [target]})
    found = injected_at(seconds(*range(0, 90, 10)), faults, recovery_s=30.0).tolist()
    assert found == [letter == "+" for letter in under]
    assert not injected_at(seconds(20.0), None, 30.0).any()


def test_a_withheld_position_is_not_in_use_nor_what_follows_upon_its_alarm() -> None:
    """The bank restarts at 2 s, and fails at once: nothing was in use in its reaction. Back at 5 s."""
    negated = [t in (2, 3, 4) for t in range(7)]
    found = used(range(7), WRONG, negated=negated, withheld_for=["relink" if t == 2 else None for t in range(7)])
    assert found.in_use.tolist() == [True, True, False, False, False, False, True]
    assert used(range(7), WRONG, negated=negated).in_use.tolist() == [True, True, True, True, False, False, True]


def test_rows_without_a_position_stand_for_no_time_between_near_positions() -> None:
    """Positions each second, rows each 0.5 s; from 2 s on none for 5 s."""
    t_s = 0.5 * np.arange(15)
    path_m = [1.0 if t in (0.0, 1.0, 2.0, 7.0) else None for t in t_s]
    found = used(t_s, RIGHT, path_m=path_m)
    positions_s = [time for time in found.used_s if time > 0.0]
    assert positions_s == pytest.approx([1.0, 1.0, 1.0, 1.5])
    assert found.used_s[np.equal(path_m, None)].sum() == 0.0
    assert found.counted_s.sum() == pytest.approx(3 * 1.0 + 10 * 0.5)


@pytest.mark.parametrize(
    ("code", "in_use", "negated", "blind", "state"),
    [
        (WRONG, True, True, True, "P1"),  # wrong in use until it is negated
        (WRONG, False, True, True, "P2"),
        (RIGHT, True, False, True, "P3"),
        (RIGHT, True, False, False, "P0"),
        (UNKNOWN, True, False, False, None),
        (WRONG, False, False, False, None),
    ],
)
def test_the_first_state_that_applies(code: int, in_use: bool, negated: bool, blind: bool, state: str | None) -> None:
    (found,) = lds_states(*(np.array([value]) for value in (negated, code, in_use, blind)))
    assert found == (-1 if state is None else list(LdsState).index(LdsState(state)))


def test_a_train_moves_farther_in_a_second_than_the_noise_of_its_places() -> None:
    """Places each 0.5 s, known to 0.1 m: 0.4 m in a second are less than 0.3 m and both noises, 0.6 m are more."""
    at_m = np.array([0.0, 0.2, 0.4, 0.8, 1.2, 1.6, np.nan, np.nan, np.nan, np.nan])
    moves = np.array([True] * 8 + [False] * 2)
    counted = np.array([False] * 6 + [True] * 3 + [False])
    odometer, stood = OdometerSteps(moves, counted), np.arange(10) == 7
    moves, may_move = moves_and_may_move(
        seconds(*(0.5 * np.arange(10))), at_m, np.full(10, 0.1), odometer, stood, Configuration()
    )
    # By the reference up to 1.5 s, as far as it goes; then by the odometer from 3 s on, but for what it stood.
    known = [None if may and not moved else bool(moved) for moved, may in zip(moves, may_move, strict=True)]
    assert known == [False, True, True, True, None, None, True, None, False, False]


def along(error_m: Any, half_m: float, kind: Evidence) -> Judgements:
    """Errors along growing path."""
    size = len(error_m)
    number, track = np.full(size, KINDS.index(kind)), np.zeros(size, dtype=bool)
    sure, limit_m = np.zeros(size, dtype=bool), np.full(size, 20.0)
    return Judgements(np.full(size, RIGHT), error_m - half_m, error_m + half_m, number, track, sure, limit_m)


def test_without_an_odometer_the_train_turns_where_its_own_place_does() -> None:
    """10 m forward each second, back from 6 s on; the position jumps back by 40 m from 3 s on, which turns nothing."""
    train_m = 10.0 * np.array([0, 1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1], dtype=np.float64)
    error_m = np.where(np.arange(12) >= 3, -40.0, 0.0)
    judged = along(error_m, 1.0, Evidence.REFERENCE)
    given = np.ones(12, dtype=np.int64)
    found = travel_direction(given, judged, seconds(*range(12)), train_m + error_m, False, HazardConfig())
    assert found.tolist() == [1] * 6 + [-1] * 6


@pytest.mark.parametrize("turns", [True, False])
def test_an_odometer_without_a_sign_is_corrected_by_the_reference_but_not_over_a_turn(turns: bool) -> None:
    """Back from 6 s on. An odometer that knows it is left alone, also while it turns; one that counts up is not."""
    train_m = 10.0 * np.array([0, 1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1], dtype=np.float64)
    given = np.where((np.arange(12) >= 7) & turns, -1, 1)
    judged = along(np.zeros(12), 1.0, Evidence.REFERENCE)
    found = travel_direction(given, judged, seconds(*range(12)), train_m, True, HazardConfig())
    # Two seconds ahead are seen: the odometer's own turn stays where it says, the other's comes by the reference.
    assert found.tolist() == ([1] * 7 + [-1] * 5 if turns else [1] * 6 + [-1] * 6)
    by_reads = along(np.zeros(12), 1.0, Evidence.BALISE)
    kept = travel_direction(given, by_reads, seconds(*range(12)), train_m, True, HazardConfig())
    assert kept.tolist() == given.tolist()


@pytest.mark.parametrize(("latency_s", "at_s"), [(0.3, 9.7), (None, 10.0), (-0.2, 10.2)])
def test_a_position_is_judged_at_its_stamp_less_the_latency(latency_s: float | None, at_s: float) -> None:
    given = JudgeInput(cast(Any, None), cast(Any, None), None, Vehicle(gnss_latency_s=latency_s), Configuration())
    assert given.instants(seconds(10)).tolist() == [round(at_s * NS)]


def test_what_an_interval_of_errors_says() -> None:
    """From 4 m late to 6 m early; from 2 to 4 m early; from 9 to 5 m late, by the odometer alone."""
    kinds = np.array([KINDS.index(kind) for kind in (Evidence.REFERENCE, Evidence.BALISE, Evidence.ODOMETER)])
    low_m, high_m = np.array([-4.0, 2.0, -9.0]), np.array([6.0, 4.0, -5.0])
    judged = Judgements(np.full(3, UNKNOWN), low_m, high_m, kinds, *np.zeros((2, 3), dtype=bool), np.full(3, 20.0))
    assert judged.middle_m.tolist() == [1.0, 3.0, -7.0]
    assert judged.half_m.tolist() == [5.0, 1.0, 2.0]
    assert judged.least_m.tolist() == [0.0, 2.0, 5.0]
    assert judged.largest_m.tolist() == [6.0, 4.0, 9.0]
    assert judged.known_error_m(4.9) == pytest.approx([np.nan, 3.0, np.nan], nan_ok=True)
    assert judged.known_error_m(5.0) == pytest.approx([1.0, 3.0, np.nan], nan_ok=True)


@pytest.mark.parametrize(("onward", "code"), [([0], RIGHT), ([0, 2], WRONG), ([0, 1], RIGHT)])
def test_where_the_evidence_ends_the_position_is_held_to_it_by_its_own_path(onward: list[int], code: int) -> None:
    """The train at 95 to 97 m of element 0, the position 10 m on, on element 1; the evidence may go on elsewhere."""

    def route(elements: list[int]) -> RoutePath:
        size = len(elements)
        entry_m = 100.0 * np.arange(size)
        return RoutePath(np.array(elements), np.full(size, True), entry_m, np.zeros(size), np.full(size, 100.0))

    at_m, leg, sure = np.array([110.0]), np.zeros(1, dtype=np.int64), np.ones(1, dtype=bool)
    given = MatchedPositions(np.array([1]), at_m - 100.0, leg, at_m, sure)
    end = Alternative(np.array([0]), route(onward), np.array([95.0]), np.array([97.0]))
    evidence = proving(np.array([KINDS.index(Evidence.BALISE)]), (end,))
    found = judge_positions(given, evidence, [route([0, 1])], np.full(1, 20.0))
    assert found.code.tolist() == [code]
    assert found.wrong_track.tolist() == [code == WRONG]
    if code == RIGHT:
        assert (found.low_m[0], found.high_m[0]) == pytest.approx((13.0, 15.0))


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
    places = (unknown, np.full(9, 10.0)) if by_odometer else (train_m, unknown[:9])
    steps = position_changes(t_ns, train_m + error_m, *places, np.full(10, round(gap_s * NS)))
    found = find_jumps(steps, np.full(10, direction), HazardConfig())
    assert [(one.first, one.last, one.step_m) for one in found] == jumps


@pytest.mark.parametrize(("train_m", "crossed"), [(120.0, [2, 3]), (np.nan, [1, 2, 3]), (128.0, [1, 3])])
def test_a_jump_crosses_what_the_train_itself_did_not(train_m: float, crossed: list[int]) -> None:
    """From 100 m to 140 m by a jump of 30 m: the train's own 10 m cross what lies in them, from where it is known."""
    path_m, virtual = [99.0, 125.0, 135.0, 111.0, 138.0, 145.0], [True, True, True, True, False, True]
    offered = offers([2, 3, 3, 3, 3, 4], path_m=path_m, virtual=virtual)
    at = positions(range(5), path_m=[80.0, 90.0, 100.0, 140.0, 150.0], train_m=np.full(5, train_m))
    assert crossed_by_jump(Jump(3, 3, 30.0), history(at, offered=offered)) == crossed


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
    found = injected_onset_ns(faults, onset_s * NS, mark_s * NS)
    assert found == (None if named_s is None else named_s * NS)
    assert injected_onset_ns(faults.clear(), onset_s * NS, mark_s * NS) is None
    assert injected_onset_ns(None, onset_s * NS, mark_s * NS) is None


def test_evidence_is_looked_at_between_positions_that_are_far_apart() -> None:
    """A look each second at least; a step of 1.5 s is none to fill."""
    found = with_instants_between(seconds(0, 0.5, 2.0, 5.0, 6.0), 1.0)
    assert (found / NS).tolist() == [0.0, 0.5, 2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("half_m", "jump", "back", "size", "rate"),
    [
        (1.0, None, False, -25.0, -2.5),  # the largest error, and its slope from the onset on
        (6.0, None, False, -25.0, -2.5),  # by the interval's centre at any width
        (np.nan, Jump(3, 3, 30.0), False, 30.0, None),  # no place along the track: the step
        (1.0, Jump(3, 3, 30.0), False, -25.0, None),
        (1.0, Jump(3, 3, 30.0), True, -30.0, None),  # of a jump back ahead by 30 m the error behind that it ended
    ],
)
def test_the_size_and_slope_of_a_hazard(
    half_m: float, jump: Jump | None, back: bool, size: float, rate: float | None
) -> None:
    """2.5 m more each second; the third position is the onset, and the failure the one after it."""
    offered = offers([9], error_low_m=np.nan, error_high_m=np.nan)
    drift = history(positions(range(12), -2.5 * np.arange(12.0) + 2.5, half_m), offered=offered)
    episode = replace(EPISODE, onset=2, end=12, mark=10, failed=3, onset_ns=2 * NS, jump_back=jump if back else None)
    row = HazardRow(Hazard.VB_SHIFT, episode, jump, [0])
    assert hazard_size_m(row, drift) == pytest.approx(size)
    found = error_growth_mps(row, drift)
    assert found == (None if rate is None else pytest.approx(rate))


@pytest.mark.parametrize(("first", "kind"), [("reference", Evidence.REFERENCE), (None, Evidence.BALISE)])
def test_a_hazard_rests_on_what_judged_its_first_balise_else_on_its_first_position(
    first: str | None, kind: Evidence
) -> None:
    offered = offers([2, 3], evidence=[first, "odometer"])
    judged = history(positions(range(5), evidence=["balise", *["odometer"] * 4]), offered=offered)
    assert _evidence_of_row(HazardRow(Hazard.VB_SHIFT, EPISODE, None, [0, 1]), judged) is kind


def test_pulses_are_one_failure_and_a_calm_half_minute_ends_it() -> None:
    """60 m for 0.3 s in each of ten seconds at 10 Hz, right for 45 s, one pulse more: 3.0 s and 0.3 s wrong in use."""
    t_s = 0.1 * np.arange(600)
    pulse = ((t_s % 1.0) < 0.25) & (t_s < 9.95) | ((t_s > 54.95) & (t_s < 55.25))
    found = find_failures(history(positions(t_s, np.where(pulse, 60.0, 0.0))))
    assert [one.hazardous_s for one in found] == pytest.approx([3.0, 0.3])
    assert [one.within_budget for one in found] == [False, True]


@pytest.mark.parametrize(("apart_s", "between_m", "failures"), [(29, 0.0, 1), (31, 0.0, 2), (31, 12.0, 1)])
def test_a_failure_goes_on_until_it_is_calm_for_long_enough(apart_s: int, between_m: float, failures: int) -> None:
    """Two wrong seconds; between them right, or within the limit and never within half of it."""
    error_m = np.full(60, 0.0)
    error_m[10 : 10 + apart_s] = between_m
    error_m[[10, 10 + apart_s]] = 60.0
    assert len(find_failures(history(positions(range(60), error_m)))) == failures


def test_unknown_time_in_use_counts_to_the_failure_that_it_belongs_to() -> None:
    """Wrong for a second, then nobody knows for 3 s, then right: 1 s for certain, 4 s at most, and one VB accepted."""
    error_m = np.full(30, 0.0)
    error_m[5:9] = [60.0, np.nan, np.nan, np.nan]
    frame = positions(range(30), error_m, path_m=10.0 * np.arange(30))
    (found,) = find_failures(history(frame, offered=offers([7], judgement="unknown")))
    assert (found.hazardous_s, found.hazardous_may_s, found.accepted) == (1.0, 4.0, Judgement.UNKNOWN)


def stamps(t_s: Sequence[float | None]) -> pl.Series:
    return pl.Series([ns(t) for t in t_s], dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))


def test_each_crossing_of_the_train_belongs_to_one_passage() -> None:
    """V1 offered at 11 s and again at 13 s, passed at 12.2 s; V2 reckoned at 30 s; V3 without either, passed twice."""
    passages = pl.DataFrame({
        "balise_id": ["V1", "V1", "V2", "V3", "V4"],
        "t_offered": stamps([11.0, 13.0, None, None, 50.0]),
        "t_reckoned": stamps([None, None, 30.0, None, None]),
    })  # fmt: skip
    crossings = {
        name: [TrueCrossing(round(t * NS), 1, True) for t in passed]
        for name, passed in {"V1": [12.2], "V2": [20.0, 29.0], "V3": [40.0, 41.0], "V4": []}.items()
    }
    found = _take_true_times(passages, crossings)
    assert found.to_list() == [None, ns(12.2), ns(29.0), ns(40.0), None]
    assert {name: [round(left.t_ns / NS) for left in several] for name, several in crossings.items()} == {
        "V1": [], "V2": [20], "V3": [41], "V4": [],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("t_s", "positioned"),
    [(-0.5, False), (0.0, True), (1.5, True), (3.0, False), (5.5, False), (6.5, True), (7.0, True), (7.5, False)],
)
def test_a_crossing_is_positioned_between_two_positions_near_each_other(t_s: float, positioned: bool) -> None:
    """Positions each second, but none between 2 s and 6 s."""
    at_ns = np.array([0, 1, 2, 6, 7]) * NS
    assert _is_interpolated(at_ns, np.array([ns(t_s)]), LdsConfig()).tolist() == [positioned]
    assert _is_interpolated(at_ns[:1], np.array([0]), round(1.5 * NS)).tolist() == [False]


PASSAGES = [
    # status, offered, odometer way, judgement, inserted, positioned | failure mode, cause
    ("accepted", True, 100.0, "right", False, True, "none", "none"),
    ("accepted", True, 100.0, "wrong", True, True, "insertion", "position"),
    ("rejected_window", True, 300.0, "right", False, True, "deletion", "none"),  # beyond its window at 200 m
    ("rejected_window", True, 300.0, "wrong", False, True, "deletion", "position"),
    ("rejected_window", True, 300.0, "wrong", True, True, "insertion", "position"),
    ("rejected_monitor", True, None, "unknown", False, True, "none", "none"),
    ("missed", False, None, None, False, True, "deletion", "position"),
    ("missed", False, None, None, False, False, "deletion", "no_position"),
    ("not_available", False, None, None, False, True, "deletion", "no_position"),
    ("not_available", True, None, None, True, True, "insertion", "position"),
]


def test_failure_mode_and_cause_of_a_passage() -> None:
    names = ("status", "offered", "odometer_distance_m", "judgement", "_inserted", "_positioned", "mode", "why")
    frame = pl.DataFrame(PASSAGES, schema=names, orient="row").with_columns(
        t_offered=pl.when("offered").then(pl.lit(0)),
        window_close_m=pl.lit(200.0),
    )
    modes, causes = failure_columns(frame, frame["_inserted"].to_numpy(), frame["_positioned"].to_numpy())
    assert modes.to_list() == frame["mode"].to_list()
    assert causes.to_list() == frame["why"].to_list()


@pytest.mark.parametrize(
    ("error_m", "half_m", "evidence", "monitor", "verdict"),
    [
        (0.0, 1.0, "reference", "along_raw", Verdict.FALSE),
        (0.0, 1.0, "balise", "along_raw", Verdict.FALSE),
        (0.0, 1.0, "balise", "cross_raw", Verdict.UNKNOWN),  # four metres aside are another track
        (0.0, 1.0, "reference", "cross_raw", Verdict.FALSE),
        (0.0, 1.0, "odometer", "along_raw", Verdict.UNKNOWN),
        (0.0, 6.0, "reference", "along_raw", Verdict.UNKNOWN),  # 5 m is the margin
        (7.0, 1.0, "reference", "along_raw", Verdict.TRUE),
        (7.0, 1.0, "odometer", "along_raw", Verdict.TRUE),  # it can show that something was wrong
    ],
)
def test_whether_an_alarm_was_due(error_m: float, half_m: float, evidence: str, monitor: str, verdict: Verdict) -> None:
    """Ten epochs, an alarm at the sixth; the error is that of the fourth, across the track there is none."""
    across = np.full(10, np.nan if evidence != "reference" else 0.0)
    error = np.where(np.arange(10) == 3, error_m, 0.0)
    sigmas = {"sigma_cross_m": 1.0, "sigma_up_m": 1.0}
    epochs = positions(range(10), error, half_m, evidence=evidence, error_cross_m=across, error_up_m=across, **sigmas)
    alarm = AlarmEpisode(5, 5, 5 * NS, 5 * NS, (monitor,), 2.0)
    config = HazardConfig()
    assert alarm_verdict(alarm, epochs, within_noise_across(epochs, config), config) is verdict
    # What comes after the alarm says nothing of it.
    early = AlarmEpisode(2, 2, 2 * NS, 2 * NS, (monitor,), 2.0)
    assert alarm_verdict(early, epochs, within_noise_across(epochs, config), config) is not Verdict.TRUE


def test_by_which_limit_an_alarm_was_due_and_positions_are_suspected() -> None:
    """25 m off at 5 s, noise explains 30 m: beyond the margin where the limit is 20 m, not where it is 26 m."""
    error_m = np.where(np.arange(10) == 5, 25.0, 0.0)
    epochs = positions(range(10), error_m, sigma_along_m=10.0, gate_probability=1.0)
    at_6_s = AlarmEpisode(6, 6, 6 * NS, 6 * NS, ("along_raw",), 2.0)
    found = []
    for limit_m in (20.0, 26.0):
        limits_m = np.where(np.arange(10) == 5, limit_m, 20.0)
        held = replace(epochs, judgements=replace(epochs.judgements, limit_m=limits_m))
        due = alarm_verdict(at_6_s, held, within_noise_across(held, HazardConfig()), HazardConfig())
        found.append((due, suspected_source(held, 6 * NS, 6 * NS, Configuration())))
    assert found == [(Verdict.TRUE, Suspect.GNSS), (Verdict.FALSE, Suspect.UNKNOWN)]


@pytest.mark.parametrize(
    ("onset_s", "end_s", "detected_s", "belongs"),
    [
        (3, 6, None, True),  # the fault lasted into the alarm
        (6, 7, None, True),
        (7, 12, None, True),
        (1, 4, None, False),
        (9, 12, None, False),
        (1, 4, 5, True),  # over before the alarm that showed it
        (1, 4, 8, True),
        (1, 4, 4, False),
        (1, 4, 9, False),  # shown by a later alarm
    ],
)
def test_an_alarm_belongs_to_the_fault_that_lasted_or_that_it_showed(
    onset_s: int, end_s: int, detected_s: int | None, belongs: bool
) -> None:
    """An alarm from 5 s to 8 s."""
    alarm = AlarmEpisode(5, 8, 5 * NS, 8 * NS, ("along_raw",), 2.0)
    episode = replace(EPISODE, onset_ns=onset_s * NS, end_ns=end_s * NS, detection=Detection(ns(detected_s)))
    assert _is_alarm_of(alarm, episode) is belongs


def test_what_was_offered_and_of_it_what_the_lds_accepted() -> None:
    """Two crossings came to no passage: one before the balise was armed again, one that is no offer at all."""
    rows = [
        # balise, virtual, status, offered
        ("V1", True, PassageStatus.ACCEPTED, True),
        ("P1", False, PassageStatus.ACCEPTED, True),
        ("V1", True, None, False),
        ("V2", True, PassageStatus.REJECTED_WINDOW, True),
        ("V3", True, PassageStatus.ACCEPTED, True),
        ("V4", True, PassageStatus.MISSED, False),
    ]
    names, virtual, status, offered = zip(*rows, strict=True)
    at = np.arange(len(rows))
    crossings = Crossings(
        balise_id=names, netelement_id=["n"] * len(rows), measure_m=at * 1.0, leg=at, path_m=at * 1.0,
        virtual=np.array(virtual), before=at, epoch=at, t_ns=at, offered=np.array(offered),
        sense=np.ones_like(at), direction=np.ones_like(at), odometer_m=at * 1.0,
        status=np.array([-1 if one is None else list(PassageStatus).index(one) for one in status]),
    )  # fmt: skip
    absent: Any = None
    solution = Solution("primary", absent, absent, crossings, absent, absent, absent)
    assert [names[row] for row in solution.offers] == ["V1", "P1", "V1", "V2", "V3"]
    assert [names[row] for row in np.flatnonzero(crossings.accepted)] == ["V1", "V3"]
