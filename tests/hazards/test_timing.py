"""Onset, failure, detection, negation, budget: each definition of DOMAIN section 5 on a few epochs."""

from __future__ import annotations

import pytest

from tests.hazards.synthetic import Journey, judge, seconds, with_hazards

STEP = Journey(steps=((34.0, 38.0, 45.0),))
DRIFT = Journey(ramps=((10.0, 80.0, 0.5),))  # 3 sigma after 16.0 s, failure from 50.1 s, V5 at 53.9 s


def only(journey, **settings):
    rows = judge(journey, config=with_hazards(**settings) if settings else None).hazards.to_dicts()
    assert len(rows) == 1
    return rows[0]


def test_detection_of_a_step():
    row = only(STEP.but(fails={"along_raw": ((34.2, 34.2),), "along_ewma_0p1": ((34.2, 36.0),)}))
    assert row["detected"] is True
    assert row["monitor"] == "along_raw"
    assert seconds(row["t_detected"]) == 34.2
    assert row["time_to_detect_s"] == pytest.approx(0.2)
    assert row["time_since_failure_s"] == pytest.approx(0.2)
    assert seconds(row["t_negated"]) == pytest.approx(34.3)  # one epoch later
    assert row["hazardous_s"] == pytest.approx(0.3)
    assert row["within_budget"] is True
    assert row["budget_s"] == pytest.approx(1.675)
    assert row["alarm_before_onset"] is False


def test_reaction_time_can_be_configured():
    row = only(STEP.but(fails={"along_raw": ((34.2, 34.2),)}), reaction_s=2.0)
    assert seconds(row["t_negated"]) == pytest.approx(36.2)
    assert row["hazardous_s"] == pytest.approx(2.2)
    assert row["within_budget"] is False


def test_detection_before_failure_has_negative_t_dsf():
    row = only(DRIFT.but(fails={"along_ewma_0p01": ((40.0, 90.0),)}))
    assert seconds(row["t_onset"]) == pytest.approx(16.1)
    assert row["time_to_detect_s"] == pytest.approx(23.9)
    assert row["time_since_failure_s"] == pytest.approx(-10.1)
    assert row["hazardous_s"] == 0.0
    assert row["within_budget"] is True
    assert row["monitor"] == "along_ewma_0p01"


def test_undetected_hazard_says_so():
    row = only(DRIFT)
    assert row["detected"] is False
    for column in ("t_detected", "t_negated", "monitor", "time_to_detect_s", "time_since_failure_s", "hazardous_s"):
        assert row[column] is None
    assert row["within_budget"] is False


def test_monitor_that_sees_only_the_return_has_not_detected_the_fault():
    row = only(DRIFT.but(fails={"along_raw": ((80.0, 80.5),)}))
    assert row["detected"] is False


def test_alarm_up_to_30_s_before_three_sigma_is_the_onset_of_a_drift():
    row = only(DRIFT.but(fails={"along_ewma_0p1": ((12.0, 60.0),)}))
    assert seconds(row["t_onset"]) == 12.0
    assert row["time_to_detect_s"] == 0.0
    assert row["alarm_before_onset"] is False


def test_alarm_longer_before_was_standing():
    late = Journey(duration_s=160.0, ramps=((60.0, 130.0, 0.5),), fails={"cross_raw": ((30.0, 100.0),)})
    row = only(late)
    assert seconds(row["t_onset"]) == pytest.approx(66.1)
    assert row["alarm_before_onset"] is True
    assert row["time_to_detect_s"] == 0.0
    assert row["monitor"] == "cross_raw"


def test_negation_that_still_lasts_counts_as_standing_alarm():
    row = only(STEP.but(fails={"along_doppler": ((5.0, 6.0),)}, negated=((5.1, 100.0),)))
    assert row["alarm_before_onset"] is True
    assert row["monitor"] == "along_doppler"
    assert row["time_to_detect_s"] == 0.0


def test_old_alarm_that_is_over_does_not_count():
    row = only(STEP.but(fails={"along_doppler": ((1.0, 2.0),)}))
    assert row["detected"] is False


def test_named_fault_gives_the_onset():
    row = only(DRIFT.but(faults=((10.0, 80.0, "ramp", "along"), (12.0, 14.0, "slip", "odometer"))))
    assert seconds(row["t_onset"]) == 10.0
    assert row["rate_mps"] == pytest.approx(0.5)


def test_faults_on_the_odometer_in_other_words_name_no_onset():
    faults = ((10.0, 80.0, "ramp", "along"), (12.0, 80.0, "wheel_slip", "odometry"), (13.0, 80.0, "GNSS gap", "gnss"))
    assert seconds(only(DRIFT.but(faults=faults))["t_onset"]) == 10.0


def test_step_after_an_error_a_little_beyond_noise_is_the_onset():
    # 3.5 m is beyond 3 sigma (3.00015 m) for a second before the step of 45 m: noise, not a drift up to it.
    row = only(Journey(steps=((30.0, 31.0, 3.5), (31.0, 500.0, 45.0))))
    assert seconds(row["t_onset"]) == 31.0
    assert row["rate_mps"] is None
    assert seconds(row["t_failure"]) == 31.0


def test_step_on_top_of_a_drift_leaves_the_drift_its_onset():
    # 0.5 m/s from 10 s: 10.5 m at 31 s, then 30 m more.
    row = only(Journey(steps=((31.0, 500.0, 30.0),), ramps=((10.0, 500.0, 0.5),)))
    assert seconds(row["t_onset"]) == pytest.approx(16.1)


def test_fault_that_was_over_names_no_onset():
    row = only(DRIFT.but(faults=((2.0, 6.0, "bias", "along"),)))
    assert seconds(row["t_onset"]) == pytest.approx(16.1)


def test_failure_of_a_drift_needs_a_second():
    # 5 m/s from 54.0 s: beyond 20 m from 58.1 s on, back at 58.6 s: half a second of it. VB at 1188 m:
    # 20 t + 5 (t - 54) = 1188 -> t = 58.32 s, e = 21.6 m; the fall from 1192.9 to 1172 m re-crosses it.
    journey = Journey(balises_m=(1188.0,), ramps=((54.0, 58.6, 5.0),))
    row, back = judge(journey).hazards.to_dicts()
    assert row["hazard"] == "VB_SHIFT"
    assert row["t_failure"] is None
    assert row["within_budget"] is None
    assert seconds(row["t_onset"]) == pytest.approx(54.7)  # 3.5 m is the first beyond 3.00015 m
    assert (back["hazard"], back["caused_by"]) == ("VB_JUMP_1B", 0)
    held = only(Journey(balises_m=(1188.0,), ramps=((54.0, 60.0, 5.0),)))
    assert seconds(held["t_failure"]) == pytest.approx(58.1)


def test_episode_ends_when_the_error_is_calm_for_ten_seconds():
    # 45 m from 31 s, then from 50 s on 2 m: within 3 sigma, a step of 43 m is the jump back.
    row = only(Journey(steps=((31.0, 50.0, 45.0), (50.0, 200.0, 2.0))))
    assert seconds(row["t_end"]) == 50.0
    # Fading away at -2 m/s from 50 s: 3.0 m at 71.0 s is the first within 3 sigma (3.00015 m).
    fading = Journey(steps=((31.0, 72.5, 45.0),), ramps=((50.0, 72.5, -2.0),))
    assert seconds(only(fading)["t_end"]) == pytest.approx(71.0)


def test_episode_that_lasts_ends_with_the_log():
    row = only(Journey(steps=((31.0, 500.0, 45.0),)))
    assert seconds(row["t_end"]) == 120.0


def test_hit_after_a_calm_is_an_episode_of_its_own():
    rows = judge(Journey(steps=((34.0, 38.0, 45.0), (54.0, 58.0, 45.0)))).hazards.to_dicts()
    assert [row["balise_ids"] for row in rows] == [["V3"], ["V5"]]
    assert [row["hazard_id"] for row in rows] == [0, 1]


def test_jump_back_is_detected_by_the_alarm_that_stands():
    rows = judge(
        Journey(steps=((31.0, 36.0, 300.0),), fails={"along_raw": ((31.0, 31.0),), "along_ewma_0p1": ((31.0, 39.0),)})
    ).hazards.to_dicts()
    assert rows[0]["time_to_detect_s"] == 0.0
    assert rows[0]["alarm_before_onset"] is False
    assert rows[1]["alarm_before_onset"] is True
    assert rows[1]["time_to_detect_s"] == 0.0
    assert rows[1]["caused_by"] == 0
