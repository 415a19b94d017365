"""What moving time was lost to, and what would mend it, from ten-row tables worked by hand."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.run_row.lost_time import InUse, LostTime, in_use_of, lost_columns, lost_time, remedies
from schemas.config import Configuration
from schemas.enums import LostTo, Remedy
from schemas.words import remedy_words
from tests.arrays_of_table import arrays_of_table
from tests.tables import NS, alarms, epochs

CONFIG = Configuration()
TEN_S = [float(k) for k in range(10)]
NO_ALARMS = alarms()


def lost(t_s: list[float] = TEN_S, found: Any = NO_ALARMS, **columns: Any) -> LostTime:
    judged = arrays_of_table(JudgedEpochs, epochs(t_s, **columns))
    return lost_time(judged, lost_columns(judged, CONFIG), found, CONFIG)


def test_each_epoch_counts_for_the_first_cause_that_applies() -> None:
    """Nine seconds: two without a position, of which one is ambiguous too, one ambiguous, one without a TVB."""
    path: list[float | None] = [20.0 * t for t in TEN_S]
    path[2:4] = [None, None]
    gate = [1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0]
    tvb = [True, True, False, False, False, False, True, True, True, True]
    found = lost(path_m=path, gate_probability=gate, tvb=tvb)
    assert found.share == pytest.approx(4 / 9)
    assert found.causes == pytest.approx({LostTo.NO_POSITION: 2 / 9, LostTo.TRACK_AMBIGUOUS: 1 / 9})
    assert found.words.startswith(
        "22% no position on the track, 11% positions that fit more than one track, 11% not validated"
    )


def test_a_gap_is_time_without_a_position() -> None:
    """Eight epochs over 27 s, of which 20 s and 3 s without any."""
    found = lost([0, 1, 2, 5, 6, 7, 27, 28])
    assert found.causes == pytest.approx({LostTo.NO_POSITION: 23 / 28})


def test_after_an_alarm_the_recovery_is_the_alarms_and_the_wait_is_the_re_links() -> None:
    """Alarm at 1 s; 30 s of recovery; negated until the end at 60 s."""
    times = [float(k) for k in range(61)]
    alarm = [k == 1 for k in range(61)]
    fails = ["fail" if k == 1 else "pass" for k in range(61)]
    negated: dict[str, Any] = {"lds_mode": "fail_safe", "tvb": False, "alarm": alarm, "along_raw_state": fails}
    negated["lds_mode"] = ["linked", *["fail_safe"] * 60]
    negated["tvb"] = [True, *[False] * 60]
    found = lost(times, **negated)
    assert found.causes == pytest.approx({LostTo.ALARM: 31 / 60, LostTo.RELINK: 28 / 60})
    assert (found.monitor, found.unfounded) == ("along_raw", True)
    due = {"solution": "primary", "t_start": [NS], "t_end": [NS], "verdict": "true", "hazard_id": None}
    assert not lost(times, alarms(1, **due), **negated).unfounded
    assert not lost(times, alarms(1, **due | {"verdict": "unknown", "hazard_id": [0]}), **negated).unfounded
    assert lost(times, alarms(1, **due | {"verdict": "false"}), **negated).unfounded


@pytest.mark.parametrize(
    ("columns", "cause"),
    [
        ({"confidence_m": 20.0}, LostTo.CONFIDENCE),
        ({"along_raw_reason": "noise too large", "withheld_for": "noise"}, LostTo.NOISE),
        ({"withheld_for": "slip"}, LostTo.SLIP),
        ({"odometer_reason": "no odometer"}, LostTo.NO_ODOMETER),
        ({"lds_mode": "fail_safe"}, LostTo.RELINK),
        ({"lds_mode": "fail_safe", "alarm": True}, LostTo.ALARM),
        ({"lds_mode": "fail_safe", "alarm": True, "withheld_for": "relink"}, LostTo.RELINK),
    ],
)
def test_one_cause(columns: dict[str, Any], cause: LostTo) -> None:
    assert lost(tvb=False, **columns).causes == {cause: 1.0}


def test_a_train_that_never_moves_loses_nothing() -> None:
    assert lost(moving=False, tvb=False) == LostTime()


RUN: dict[str, Any] = {
    "verdict": "unproven",
    "evidence": "reference",
    "vehicle": "file",
    "availability": 0.5,
    "failures": 0,
    "failures_within_budget": 0,
    "failures_beyond_budget": 0,
    "share_unknown": 0.0,
    "unproven_accepted": 0,
    "gnss_rate_hz": 10.0,
    "faults_injected": False,
    "failure_hazardous_may_s": [],
    "failure_accepted": [],
}
ONE_LATE = {
    "failures": 1,
    "failures_beyond_budget": 1,
    "failure_hazardous_may_s": [2.0],
    "failure_accepted": ["right"],
}
CHECKED_LITTLE = {"evidence": "balise", "reasons": ["unknown_in_use"]}
ALL_KNOWN = InUse(moving_s=100.0, in_use_s=50.0)
AT_ENDS = InUse(100.0, 50.0, unknown_at_ends_s=20.0)
BETWEEN = InUse(100.0, 50.0, unknown_between_s=30.0)


def cures(
    run: dict[str, Any] | None = None,
    causes: dict[LostTo, float] | None = None,
    used: InUse = ALL_KNOWN,
    monitor: str = "along_raw",
    unfounded: bool = True,
    stated: bool = True,
) -> list[Remedy]:
    lost = LostTime(0.5, causes or {}, monitor, unfounded)
    return list(remedies(RUN | (run or {}), lost, used, stated, CONFIG))


def test_an_odometer_that_may_be_of_the_gnss_is_mended_first_and_calibrates_nothing() -> None:
    lacking = {"evidence": None, "verdict": "unproven", "vehicle": "learned"}
    unknown = {"reasons": ["unknown_in_use", "odometer_origin_unknown"], "odometer_origin": "unknown"}
    assert cures(lacking | unknown, {LostTo.ALARM: 0.5}) == [Remedy.ODOMETER_ORIGIN, Remedy.REFERENCE]
    # What was declared, or found, to be of the GNSS is not to be declared a wheel.
    assert cures(lacking | unknown | {"odometer_origin": "gnss"}) == [Remedy.ODOMETER, Remedy.REFERENCE]
    follows = {"reasons": ["unknown_in_use", "odometer_follows_gnss"], "odometer_origin": "wheel"}
    assert cures(lacking | follows) == [Remedy.ODOMETER, Remedy.REFERENCE]


def test_alarms_that_nothing_explains_are_mended_by_calibration_and_not_by_more_evidence() -> None:
    """The NMEA log of issue 35: availability 0, raw monitors fail, no evidence at all."""
    noisy = {LostTo.ALARM: 0.5}
    blind = {"evidence": None, "share_unknown": None, "availability": 0.0}
    assert cures(blind, noisy) == [Remedy.CALIBRATE]
    assert cures({}, noisy, monitor="up_ewma_0p1") == [Remedy.CALIBRATE]
    assert cures({"vehicle": "learned"}, noisy) == [Remedy.CALIBRATE], "which measures the odometer too"
    assert cures({}, {LostTo.RELINK: 0.5}) == [Remedy.CALIBRATE]
    assert cures({}, {LostTo.NOISE: 0.5}) == [Remedy.CALIBRATE]
    assert cures({}, {LostTo.NOISE: 0.08, LostTo.CONFIDENCE: 0.42}) == [], "the begin of a short run"
    done = Configuration.model_validate({"calibration": {"runs": ["b", "c"]}})
    assert Remedy.CALIBRATE not in remedies(RUN, LostTime(0.5, noisy, "along_raw", True), ALL_KNOWN, True, done)
    assert cures({}, noisy, unfounded=False) == []
    assert cures({"faults_injected": True}, noisy) == []
    assert cures({}, noisy, monitor="along_ewma_0p001") == []
    assert cures({}, {LostTo.ALARM: 0.01}) == []
    assert cures({"availability": 0.95}, noisy) == []


@pytest.mark.parametrize(
    ("run", "used", "cure"),
    [
        ({"evidence": "odometer", "reasons": ["unknown_in_use"]}, ALL_KNOWN, [Remedy.REFERENCE]),
        ({"evidence": None, "reasons": ["accepted_unknown"]}, ALL_KNOWN, [Remedy.REFERENCE]),
        (CHECKED_LITTLE, AT_ENDS, [Remedy.READS_AT_ENDS]),
        (CHECKED_LITTLE, BETWEEN, [Remedy.READS_CLOSER]),
        ({"evidence": "balise", "reasons": []}, AT_ENDS, []),
        ({"vehicle": "learned"}, ALL_KNOWN, [Remedy.VEHICLE_FILE]),
        ({"vehicle": "none"}, ALL_KNOWN, [Remedy.ODOMETER]),
        ({"reasons": ["clock_assumed"]}, ALL_KNOWN, [Remedy.CLOCK]),
        (ONE_LATE | {"gnss_rate_hz": 1.0}, ALL_KNOWN, [Remedy.FASTER_LOG]),
        (ONE_LATE, ALL_KNOWN, []),
        (ONE_LATE | {"gnss_rate_hz": 1.0, "failure_hazardous_may_s": [2.1]}, ALL_KNOWN, []),
        (ONE_LATE | {"gnss_rate_hz": 1.0, "failure_accepted": ["wrong"]}, ALL_KNOWN, []),
    ],
)
def test_a_verdict_names_its_cure(run: dict[str, Any], used: InUse, cure: list[Remedy]) -> None:
    assert cures(run, used=used) == cure


def test_clocks_that_leave_too_much_open_are_to_be_declared() -> None:
    """Of the 40 m that an error may span the clocks alone take 21 m: 0.7 s at 30 m/s."""

    def remedies_for(run: dict[str, Any], open_m: float) -> list[Remedy]:
        return list(remedies(RUN | run, LostTime(), ALL_KNOWN, True, CONFIG, open_m))

    lacking = {"evidence": "balise", "reasons": ["unknown_in_use"]}
    assert (remedies_for(lacking, 21.0), remedies_for(lacking, 19.0)) == ([Remedy.CLOCK], [])
    assert remedies_for({"evidence": "balise", "reasons": ["not_diagnosed"]}, 21.0) == [], "nothing is unknown"
    assert remedies_for({"evidence": "odometer", "reasons": ["unknown_in_use"]}, 21.0) == [Remedy.REFERENCE]


def test_an_ambiguous_track_needs_a_route_and_a_survey_that_states_its_accuracy() -> None:
    twin = {LostTo.TRACK_AMBIGUOUS: 0.4}
    assert cures({}, twin) == [Remedy.ROUTE]
    assert cures({}, twin, stated=False) == [Remedy.ROUTE, Remedy.SURVEY_SIGMA]


def test_what_wins_back_most_time_comes_first() -> None:
    """Of 100 s of motion 60 s are lost to the track, 10 s to re-links, and of 30 s in use 20 s are unknown."""
    run = {"vehicle": "learned", "evidence": None, "reasons": ["unknown_in_use"]}
    lost = LostTime(0.7, {LostTo.TRACK_AMBIGUOUS: 0.6, LostTo.RELINK: 0.1}, "along_raw")
    found = remedies(RUN | run, lost, InUse(100.0, 30.0, 5.0, 15.0), False, CONFIG)
    gains = {Remedy.ROUTE: 0.6, Remedy.SURVEY_SIGMA: 0.6, Remedy.VEHICLE_FILE: 0.3, Remedy.REFERENCE: 0.2}
    assert found == pytest.approx(gains)
    assert list(found) == list(gains)


def test_a_remedy_says_what_it_would_win_back() -> None:
    assert "up to 62% of the moving time" in remedy_words(Remedy.ROUTE, 0.62)
    assert "moving time" not in remedy_words(Remedy.ROUTE, 0.001)


def test_where_the_unknown_lies() -> None:
    """Of nine seconds the first two are unknown (the last epoch holds for none), then one in the middle."""
    word = {True: "right", False: "unknown"}

    def parts(known: list[bool], **columns: Any) -> InUse:
        judged = arrays_of_table(JudgedEpochs, epochs(TEN_S, judgement=[word[k] for k in known], **columns))
        return in_use_of(judged, float(lost_columns(judged, CONFIG).moving_s.sum()))

    ends = [False, False, True, True, True, True, True, True, True, False]
    middle = [True, True, True, False, True, True, True, True, True, True]
    assert parts(ends) == InUse(9.0, 9.0, 2.0, 0.0)
    assert parts(middle) == InUse(9.0, 9.0, 0.0, 1.0)
    assert parts(ends, in_use=False) == InUse(moving_s=9.0)


def test_the_epochs_say_what_each_was_lost_to() -> None:
    """Ten epochs a second apart but for 20 s after the fifth; the train stands at the second, the third is no TVB."""
    t_s = [0.0, 1.0, 2.0, 3.0, 4.0, 24.0, 25.0, 26.0]
    moving = [True, False, True, True, True, True, None, True]
    frame = epochs(t_s, moving=moving, tvb=[k != 3 for k in range(8)], confidence_m=[5.0, 5.0, 5.0, 50.0, *[5.0] * 4])
    found = pl.DataFrame(lost_columns(arrays_of_table(JudgedEpochs, frame), CONFIG).columns())
    assert found["step_s"].to_list() == [1.0, 1.0, 1.0, 1.0, 20.0, 1.0, 1.0, 0.0]
    assert found["gap"].to_list() == [False, False, False, False, True, False, False, False]
    assert found["moving_s"].to_list() == [1.0, 0.0, 1.0, 1.0, 20.0, 1.0, 1.0, 0.0]
    assert found["lost_s"].to_list() == [0.0, 0.0, 0.0, 1.0, 20.0, 0.0, 1.0, 0.0]
    assert found["lost_to"].to_list() == [None, None, None, "confidence", "no_position", None, None, None]
