"""What the truth adds to passages, and the state of the LDS."""

from __future__ import annotations

import numpy as np
import pytest

from tests.hazards.synthetic import Journey, judge, seconds


def passages(journey, rows):
    return judge(journey, journey.passages(rows)).passages.to_dicts()


def test_accepted_passage_of_a_healthy_run():
    (row,) = passages(Journey(steps=((0.0, 120.0, 2.0),)), [{"balise_id": "V3", "t_offered": 34.9}])
    # Position 2 m ahead: V3 (700 m) offered when the train is at 698 m, 34.9 s; passed at 35.0 s.
    assert seconds(row["t_true"]) == pytest.approx(35.0)
    assert row["location_error_m"] == pytest.approx(2.0)
    assert (row["failure_mode"], row["cause"], row["hazard_id"]) == ("none", "none", None)


def test_early_shift_is_an_insertion_linked_to_its_hazard():
    journey = Journey(steps=((31.0, 60.0, 45.0),))
    offers = [
        {"balise_id": "V3", "t_offered": 32.75, "status": "accepted"},
        {"balise_id": "V4", "t_offered": 42.75, "status": "rejected_monitor"},
    ]
    result = judge(journey, journey.passages(offers))
    first, second = result.passages.to_dicts()
    assert first["location_error_m"] == pytest.approx(45.0)
    assert seconds(first["t_true"]) == pytest.approx(35.0)
    assert (first["failure_mode"], first["cause"], first["hazard_id"]) == ("insertion", "position", 0)
    assert first["suspect_after_the_fact"] is True
    assert (second["failure_mode"], second["hazard_id"], second["suspect_after_the_fact"]) == ("insertion", 0, False)
    (hazard,) = result.hazards.to_dicts()
    assert hazard["accepted_ids"] == ["V3"]
    assert hazard["balise_ids"][:2] == ["V3", "V4"]


def test_accepted_after_detection_is_not_suspect():
    journey = Journey(steps=((31.0, 60.0, 45.0),), fails={"along_raw": ((31.2, 31.2),)})
    (row,) = passages(journey, [{"balise_id": "V3", "t_offered": 32.75}])
    assert row["suspect_after_the_fact"] is False


def test_late_beyond_the_window_is_a_deletion():
    journey = Journey(steps=((38.0, 60.0, -30.0),))
    offer = {"balise_id": "V4", "t_offered": 46.5, "status": "rejected_window", "odometer_distance_m": 230.0}
    inside = {**offer, "window_open_m": 162.0, "window_close_m": 240.0}
    beyond = {**offer, "window_open_m": 162.0, "window_close_m": 220.0}
    (row,) = passages(journey, [inside])
    assert (row["failure_mode"], row["cause"]) == ("none", "none")
    result = judge(journey, journey.passages([beyond]))
    (row,) = result.passages.to_dicts()
    assert (row["failure_mode"], row["cause"]) == ("deletion", "position")
    assert row["location_error_m"] == pytest.approx(-30.0)
    assert result.hazards["failure_mode"].to_list() == ["deletion"]


def test_a_window_behind_a_train_that_turned_round_is_no_deletion():
    # Distances to a balise ahead of a reference that the train now runs back to are negative.
    offer = {"balise_id": "V3", "t_offered": 34.9, "window_open_m": -2612.6, "window_close_m": -2187.4}
    inside, early, late = -2398.9, -2700.0, -2100.0
    modes = {}
    for distance_m in (inside, early, late):
        (row,) = passages(Journey(), [{**offer, "odometer_distance_m": distance_m}])
        modes[distance_m] = row["failure_mode"]
    assert modes == {inside: "none", early: "none", late: "deletion"}


def test_outage_is_a_deletion_without_hazard():
    journey = Journey(outages=((33.0, 37.0),))
    result = judge(journey, journey.passages([{"balise_id": "V3", "status": "not_available"}]))
    (row,) = result.passages.to_dicts()
    assert (row["failure_mode"], row["cause"]) == ("deletion", "no_position")
    assert seconds(row["t_true"]) == pytest.approx(35.0)
    assert row["location_error_m"] is None
    assert result.hazards.height == 0


def test_jump_over_a_balise_is_an_insertion_however_small_its_error():
    # Step of 45 m at 34.0 s from 678 to 725 m: V3 at 33.9 + 0.1 * 22/47 s, error 45 * 22/47 = 21.06 m.
    journey = Journey(steps=((34.0, 38.0, 45.0),))
    t_offered = 33.9 + 0.1 * 22.0 / 47.0
    (row,) = passages(journey, [{"balise_id": "V3", "t_offered": t_offered, "status": "rejected_monitor"}])
    assert row["location_error_m"] == pytest.approx(45.0 * 22.0 / 47.0, abs=1e-3)
    assert (row["failure_mode"], row["hazard_id"]) == ("insertion", 0)


def test_lds_states():
    journey = Journey(steps=((31.0, 60.0, 45.0),), negated=((40.0, 50.0),))
    states = judge(journey).epochs_columns["lds_state"].to_list()
    at = {s: states[round(s * 10)] for s in (30.0, 35.0, 45.0, 55.0, 70.0)}
    assert at == {30.0: "P0", 35.0: "P1", 45.0: "P2", 55.0: "P1", 70.0: "P0"}


def test_odometer_beyond_its_confidence_is_a_faulty_diagnosis():
    # V4 (900 m) accepted at 45 s. Slip counts 6 m/s too much from 50 s on: 12 m at 52 s against 5 + 0.05 * 152 =
    # 12.6 m; 18 m at 53 s against 5 + 0.05 * 178 = 13.9 m.
    journey = Journey(slip=(50.0, 60.0, 6.0), accepted={"V4": 45.0})
    states = judge(journey).epochs_columns["lds_state"].to_list()
    assert (states[520], states[530]) == ("P0", "P3")


def test_suspicion_ends_with_a_fault_that_nobody_detected():
    # Jump over V3 at 34.0 s (offered on the way, 33.947 s) and back at 38 s; V4 at 45 s is sound.
    journey = Journey(steps=((34.0, 38.0, 45.0),))
    offers = [{"balise_id": "V3", "t_offered": 33.9 + 0.1 * 22.0 / 47.0}, {"balise_id": "V4", "t_offered": 45.0}]
    assert [row["suspect_after_the_fact"] for row in passages(journey, offers)] == [True, False]


def test_accepted_in_an_excursion_that_hits_no_balise_is_suspect():
    # 0.5 m/s from 40 s: beyond 3 sigma from 46.1 s on; V5 (1100 m) accepted at 54.4 s with e = 7.2 m. Alarm at 60 s.
    journey = Journey(ramps=((40.0, 70.0, 0.5),), balises_m=(100.0, 300.0, 500.0, 700.0, 900.0, 1100.0))
    offers = [{"balise_id": "V4", "t_offered": 44.9}, {"balise_id": "V5", "t_offered": 54.634}]
    detected = journey.but(fails={"along_ewma_0p1": ((60.0, 72.0),)})
    result = judge(detected, detected.passages(offers))
    assert result.hazards.height == 0
    assert result.passages["suspect_after_the_fact"].to_list() == [False, True]
    assert result.alarms["verdict"].to_list() == ["true"]
    silent = judge(journey.but(ramps=((40.0, 55.0, 0.5),)), journey.passages(offers))
    assert silent.passages["suspect_after_the_fact"].to_list() == [False, False]


def test_each_true_passage_is_given_to_one_offer():
    # Jump over V4 (900 m) at 41 s (train at 820 m) and back at 42 s; the right offer follows at 45 s.
    journey = Journey(steps=((41.0, 42.0, 100.0),))
    offers = [
        {"balise_id": "V4", "t_offered": 40.98, "status": "rejected_monitor"},
        {"balise_id": "V4", "t_offered": 41.96, "status": "rejected_monitor"},
        {"balise_id": "V4", "t_offered": 45.0},
    ]
    rows = passages(journey, offers)
    assert [seconds(row["t_true"]) for row in rows] == [None, None, pytest.approx(45.0)]
    assert [row["hazard_id"] for row in rows] == [0, 1, None]
    assert [row["failure_mode"] for row in rows] == ["insertion", "insertion", "none"]


def test_a_telegram_is_not_suspect_for_a_fault_of_the_position():
    """V3 as a physical balise, read while the position is 45 m off and no monitor has found it."""
    journey = Journey(steps=((31.0, 60.0, 45.0),))
    offers = [{"balise_id": "V3", "t_offered": 35.0}, {"balise_id": "V3", "t_offered": 35.0, "kind": "physical"}]
    assert [row["suspect_after_the_fact"] for row in passages(journey, offers)] == [True, False]


def test_tvbs_between_onset_and_detection_are_suspect_too():
    """1 m/s from 30 s on, beyond 3 sigma from 33 s, found at 52 s: TVBs of the time between, none before or after."""
    journey = Journey(ramps=((30.0, 60.0, 1.0),), fails={"along_raw": ((52.0, 53.0),)}, negated=((52.0, 90.0),))
    result = judge(journey)
    (row,) = result.hazards.to_dicts()
    marked = np.flatnonzero(result.epochs_columns["suspect_after_the_fact"].to_numpy()) / 10.0
    assert (marked[0], marked[-1]) == (pytest.approx(seconds(row["t_onset"]), abs=0.06), pytest.approx(51.9))
    assert marked.size == round((51.9 - marked[0]) * 10.0) + 1
    assert not judge(Journey()).epochs_columns["suspect_after_the_fact"].any()
