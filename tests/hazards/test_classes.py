"""Hazard classes: injected faults on straight journeys, expected rows worked out by hand.

Train at 20 m/s from 0 m, VBs V0.. at 100, 300, 500, ... m; V3 at 700 m is passed at 35 s.
"""

from __future__ import annotations

import pytest

from tests.hazards.synthetic import Journey, judge, seconds


def rows(result):
    return result.hazards.to_dicts()


def test_healthy_run_has_no_hazard_and_no_alarm():
    result = judge(Journey())
    assert result.hazards.height == 0
    assert result.alarms.height == 0
    assert result.epochs_columns["error_along_m"].abs().max() < 1e-6
    assert set(result.epochs_columns["lds_state"].cast(str)) == {"P0"}


def test_jump_over_two_balises_and_back():
    # At 31 s the train is at 620 m; +300 m puts the position at 920 m: V3 (700) and V4 (900) crossed.
    # Back at 36 s: train at 720 m, position from 1020-2 m back to 720 m: V4 (900) re-crossed, V3 is passed.
    result = judge(Journey(steps=((31.0, 36.0, 300.0),)))
    first, back = rows(result)
    assert (first["hazard"], first["balise_ids"], first["failure_mode"]) == ("VB_JUMP_1A", ["V3", "V4"], "insertion")
    assert seconds(first["t_onset"]) == seconds(first["t_hazard"]) == seconds(first["t_failure"]) == 31.0
    assert seconds(first["t_end"]) == 36.0
    assert first["size_m"] == pytest.approx(300.0)
    assert first["rate_mps"] is None
    assert (first["timing"], first["evidence"], first["suspect"]) == ("early", "reference", "gnss")
    assert first["path_m"] == pytest.approx(620.0)
    assert (first["netelement_id"], first["measure_m"], first["speed_mps"]) == ("A", pytest.approx(620.0), 20.0)
    assert (first["detected"], first["within_budget"], first["t_detected"]) == (False, False, None)
    assert (back["hazard"], back["balise_ids"], back["failure_mode"]) == ("VB_JUMP_1B", ["V4"], "insertion")
    assert back["caused_by"] == first["hazard_id"] == 0
    assert seconds(back["t_onset"]) == 36.0
    assert back["t_failure"] is None
    assert back["size_m"] == pytest.approx(-300.0)


def test_jump_over_one_balise_whose_return_crosses_none():
    # 34 s: train 680 m, +45 m crosses V3 (700); 38 s: train 760 m, back from 805: nothing between.
    (row,) = rows(judge(Journey(steps=((34.0, 38.0, 45.0),))))
    assert (row["hazard"], row["balise_ids"], row["failure_mode"]) == ("VB_JUMP_1B", ["V3"], "insertion")
    assert (seconds(row["t_hazard"]), seconds(row["t_end"])) == (34.0, 38.0)


def test_jump_between_balises_that_stays_is_a_shift():
    # 31 s: train 620 m, +45 m = 665 m: no VB. The position meets V3 at 700 m when the train is at 655 m: 32.75 s.
    # It stays: V4 (at 42.75 s), V5 are appended.
    (row,) = rows(judge(Journey(steps=((31.0, 60.0, 45.0),))))
    assert (row["hazard"], row["balise_ids"][:3], row["timing"]) == ("VB_SHIFT", ["V3", "V4", "V5"], "early")
    assert row["failure_mode"] == "insertion"
    assert seconds(row["t_onset"]) == seconds(row["t_failure"]) == 31.0
    assert seconds(row["t_hazard"]) == pytest.approx(32.75)
    assert seconds(row["t_end"]) == 60.0
    assert row["size_m"] == pytest.approx(45.0)
    assert row["rate_mps"] is None
    assert row["path_m"] == pytest.approx(655.0)


def test_jump_between_balises_and_back_before_any_is_nothing():
    assert rows(judge(Journey(steps=((31.0, 32.0, 45.0),)))) == []


def test_backward_jump_that_stays_offers_late():
    # 36 s: train 720 m, position 690 m: V3 (700) re-crossed backwards: a jump over one VB.
    (row,) = rows(judge(Journey(steps=((36.0, 50.0, -30.0),))))[:1]
    assert (row["hazard"], row["balise_ids"][0], row["timing"]) == ("VB_JUMP_1B", "V3", "late")
    # 38 s: train 760 m, position 730 m: none crossed; V4 (900) offered when the train is at 930 m.
    (row,) = rows(judge(Journey(steps=((38.0, 60.0, -30.0),))))
    assert (row["hazard"], row["balise_ids"], row["timing"]) == ("VB_SHIFT", ["V4", "V5"], "late")
    assert seconds(row["t_hazard"]) == pytest.approx(46.5)
    assert row["failure_mode"] == "none"  # no window known: nothing says that it was outside


def test_slow_drift_early():
    # 0.5 m/s from 10 s: |e| > 3.00015 m after 16.0 s, > 20 m from 50.1 s on; V5 (1100 m) at e = 22.0 m:
    # 20 t + 0.5 (t - 10) = 1100 -> t = 53.90 s.
    (row,) = rows(judge(Journey(ramps=((10.0, 80.0, 0.5),))))
    assert (row["hazard"], row["timing"], row["failure_mode"]) == ("VB_SHIFT", "early", "insertion")
    assert seconds(row["t_onset"]) == pytest.approx(16.1)
    assert seconds(row["t_failure"]) == pytest.approx(50.1)
    assert seconds(row["t_hazard"]) == pytest.approx(1105.0 / 20.5)
    assert row["balise_ids"][0] == "V5"
    assert row["rate_mps"] == pytest.approx(0.5)
    assert row["size_m"] == pytest.approx(0.5 * 69.9)
    assert seconds(row["t_end"]) == 80.0
    assert row["detected"] is False


def test_slow_drift_late():
    # -0.5 m/s: V5 offered at 20 t - 0.5 (t - 10) = 1100 -> t = 56.15 s, error -23.08 m.
    (row,) = rows(judge(Journey(ramps=((10.0, 80.0, -0.5),))))
    assert (row["hazard"], row["timing"], row["failure_mode"]) == ("VB_SHIFT", "late", "none")
    assert seconds(row["t_hazard"]) == pytest.approx(1095.0 / 19.5)
    assert row["size_m"] == pytest.approx(-0.5 * 69.9)


def test_very_fast_drift_is_a_jump():
    # 40 m/s for 3 s from 31 s: train 620 -> 680 m, position 620 -> 800 m; the true movement reaches none of V3.
    result = judge(Journey(ramps=((31.0, 34.0, 40.0),)))
    first = rows(result)[0]
    assert (first["hazard"], first["balise_ids"]) == ("VB_JUMP_1B", ["V3"])
    assert seconds(first["t_onset"]) == pytest.approx(31.1)


def test_class_does_not_depend_on_the_rate():
    for rate_hz in (1.0, 5.0, 10.0):
        (row,) = rows(judge(Journey(rate_hz=rate_hz, steps=((34.0, 38.0, 45.0),))))
        assert (row["hazard"], row["balise_ids"]) == ("VB_JUMP_1B", ["V3"])
        assert seconds(row["t_hazard"]) == 34.0


def test_outage_over_a_balise_is_no_hazard():
    result = judge(Journey(outages=((33.0, 37.0),)))
    assert result.hazards.height == 0


def test_step_hidden_by_an_outage_is_a_shift():
    (row,) = rows(judge(Journey(outages=((33.0, 37.0),), steps=((35.0, 60.0, 45.0),))))
    assert (row["hazard"], row["balise_ids"][0], row["timing"]) == ("VB_SHIFT", "V4", "early")
    assert seconds(row["t_onset"]) == seconds(row["t_failure"]) == pytest.approx(37.1)


def test_drift_then_jump_makes_a_row_for_each_class():
    # V5 (1100 m) early by 22 m at 53.9 s; at 60 s the train is at 1200 m, e = 25 m; +200 m crosses V6 (1300) only.
    journey = Journey(ramps=((10.0, 80.0, 0.5),), steps=((60.0, 80.0, 200.0),))
    shift, jump = rows(judge(journey))[:2]
    assert (shift["hazard"], jump["hazard"]) == ("VB_SHIFT", "VB_JUMP_1B")
    assert shift["balise_ids"] == ["V5"]
    assert jump["balise_ids"][0] == "V6"
    assert jump["caused_by"] is None
    assert seconds(jump["t_onset"]) == 60.0
    assert seconds(shift["t_end"]) == seconds(jump["t_end"]) == 80.0


def test_travel_against_the_path():
    # From 3000 m at -20 m/s; error -45 m along the path is 45 m ahead. V10 (2100 m) is passed at 45 s.
    journey = Journey(speed_mps=-20.0, start_m=3000.0, steps=((44.0, 48.0, -45.0),))
    (row,) = rows(judge(journey))
    assert (row["hazard"], row["balise_ids"], row["timing"]) == ("VB_JUMP_1B", ["V10"], "early")
    assert row["size_m"] == pytest.approx(45.0)
    assert row["speed_mps"] == 20.0


def test_small_errors_are_no_hazard():
    assert rows(judge(Journey(steps=((31.0, 60.0, 19.0),)))) == []


def test_return_over_a_balise_that_was_passed_unseen():
    # -50 m at 34 s (train 680 m, position 630 m: V2 (500) not reached); back at 37 s: train 740 m, V3 (700) was
    # passed at 35 s and is offered now, late, by a jump over one VB. The error began at 34 s.
    (row,) = rows(judge(Journey(steps=((34.0, 37.0, -50.0),), fails={"along_raw": ((34.0, 34.0), (37.0, 37.0))})))
    assert (row["hazard"], row["balise_ids"], row["timing"]) == ("VB_JUMP_1B", ["V3"], "late")
    assert row["caused_by"] is None
    assert seconds(row["t_onset"]) == seconds(row["t_failure"]) == seconds(row["t_detected"]) == 34.0
    assert seconds(row["t_hazard"]) == seconds(row["t_end"]) == 37.0
    assert row["size_m"] == pytest.approx(-50.0)


def test_late_offer_on_the_way_of_the_return_belongs_to_the_late_episode():
    # 1 Hz, -60 m from 33 s: V3 (700) is met at 38 s by the late position; at 42 s the position is at 780 m.
    # V4 at 785 m lies between the late position of 42 s (780 m) and that of a second later (800 m).
    journey = Journey(rate_hz=1.0, balises_m=(100.0, 300.0, 500.0, 700.0, 785.0), steps=((33.0, 43.0, -60.0),))
    (row,) = rows(judge(journey))
    assert (row["hazard"], row["balise_ids"], row["timing"]) == ("VB_SHIFT", ["V3", "V4"], "late")
