"""Virtual balises offered and accepted, on journeys of a few rows.

The train runs 20 m a second, one epoch a second, so V1 at 110 m is passed at 5.5 s.
"""

from __future__ import annotations

import random
from typing import Any

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.stages.lds.scripted import ScriptedBank, balises_at, epochs_of, negations, passage_rows, reads_at, run, steps

V1, V2 = {"V1": 110.0}, {"V1": 110.0, "V2": 510.0}
STATUS = ("balise_id", "status", "t_offered")


def with_hole(values: list[float], first: int, last: int) -> list[float | None]:
    return [None if first <= k <= last else value for k, value in enumerate(values)]


def test_crossing_time_and_odometer_distance_are_interpolated() -> None:
    # The odometer reads 2 m more than the path; V2 lies at 515 m: a quarter of the way from 500 to 520 m.
    epochs = epochs_of(steps(0.0, 20.0, 40), steps(2.0, 20.0, 40))
    result = run(epochs, balises_at({"V1": 110.0, "V2": 515.0}))
    assert passage_rows(result, *STATUS, "odometer_distance_m", "confidence_m") == [
        ("V1", "accepted", 5.5, None, 6.18),
        ("V2", "accepted", 25.75, pytest.approx(405.0), 6.18),
    ]


def test_a_balise_reached_but_not_left_is_passed() -> None:
    assert passage_rows(run(epochs_of([90.0, 100.0, 110.0]), balises_at(V1)), *STATUS) == [("V1", "accepted", 2.0)]


def test_a_journey_that_starts_on_a_balise_does_not_pass_it() -> None:
    assert run(epochs_of([110.0, 120.0, 130.0]), balises_at(V1)).passages.is_empty()


def test_falling_path_is_detected_alike() -> None:
    assert passage_rows(run(epochs_of(steps(200.0, -20.0, 10)), balises_at(V1)), *STATUS, "direction") == [
        ("V1", "accepted", 4.5, "falling")
    ]


@pytest.mark.parametrize(
    ("gap_s", "status", "t_offered"),
    [(1.5, "accepted", 5.75), (1.6, "not_available", None)],
)
def test_interpolated_over_one_and_a_half_periods_at_most(gap_s: float, status: str, t_offered: float | None) -> None:
    t_s = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0 + gap_s, 6.0 + gap_s, 7.0 + gap_s]
    path_m = [0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0, 160.0]
    assert passage_rows(run(epochs_of(path_m, t_s=t_s), balises_at(V1)), *STATUS) == [("V1", status, t_offered)]


def test_a_faster_log_interpolates_over_one_second() -> None:
    t_s = [0.1 * k for k in range(50)] + [5.9, 6.0]
    path_m = [20.0 * t for t in t_s]
    [row] = passage_rows(run(epochs_of(path_m, t_s=t_s), balises_at(V1)), *STATUS)
    assert row == ("V1", "accepted", pytest.approx(5.5))


def test_lost_in_a_gap_it_is_missed_by_linking_and_not_available() -> None:
    # No position from 24 to 27 s; V2 would be passed at 25.5 s. Its window closes at 561.6 m, 28.1 s.
    path_m = steps(0.0, 20.0, 40)
    result = run(epochs_of(with_hole(path_m, 24, 27), path_m), balises_at(V2))
    assert passage_rows(result, *STATUS, "linking_error", "reaction", "t_reckoned") == [
        ("V1", "accepted", 5.5, "none", "none", None),
        ("V2", "not_available", None, "missed", "service_brake", 25.5),
    ]


def test_not_available_although_the_window_closed_inside_the_outage() -> None:
    path_m = steps(0.0, 20.0, 60)
    result = run(epochs_of(with_hole(path_m, 20, 45), path_m), balises_at(V2))
    assert passage_rows(result, *STATUS, "linking_error") == [
        ("V1", "accepted", 5.5, "none"),
        ("V2", "not_available", None, "missed"),
    ]


def test_outage_to_the_end_of_the_run() -> None:
    # The run ends 30 m beyond V2, before its window closes.
    path_m = steps(0.0, 20.0, 28)
    result = run(epochs_of(with_hole(path_m, 20, 27), path_m), balises_at(V2))
    assert passage_rows(result, *STATUS, "linking_error") == [
        ("V1", "accepted", 5.5, "none"),
        ("V2", "not_available", None, "none"),
    ]


def test_position_that_lags_offers_it_late() -> None:
    # From 20 s on the position lags by 60 m: V2 is offered at 28.5 s, 460 m after V1; closed at 451.6 m.
    odometer_m = steps(0.0, 20.0, 40)
    path_m = [value - (60.0 if k >= 20 else 0.0) for k, value in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V2), ScriptedBank())
    # The linking distance is out of bounds at 20 s already, so the position is negated by then.
    assert passage_rows(result, *STATUS, "linking_error", "odometer_distance_m")[1] == (
        "V2",
        "rejected_monitor",
        28.5,
        "missed",
        460.0,
    )


def test_position_that_never_arrives_misses_it() -> None:
    odometer_m = steps(0.0, 20.0, 60)
    path_m = [min(value, 480.0) for value in odometer_m]
    result = run(epochs_of(path_m, odometer_m), balises_at(V2))
    assert passage_rows(result, *STATUS, "linking_error", "t_reckoned")[1] == ("V2", "missed", None, "missed", 25.5)


@pytest.mark.parametrize(
    ("columns", "status"),
    [
        ({"confidence_m": [14.0] * 12}, "accepted"),
        ({"confidence_m": [14.01] * 12}, "rejected_confidence"),
        ({"confidence_m": [None] * 6 + [6.0] * 6}, "accepted"),
        ({"confidence_m": [6.0] * 6 + [None] * 6}, "rejected_confidence"),
        ({"gate_probability": [0.99] * 12}, "accepted"),
        ({"gate_probability": [0.98] * 12}, "rejected_ambiguous"),
        ({"gate_probability": [None] * 12}, "rejected_ambiguous"),
        ({"on_track": [True] * 6 + [False] * 6}, "rejected_ambiguous"),
        ({"on_track": [False] * 6 + [True] * 6}, "rejected_ambiguous"),
        ({"on_track": [False] * 5 + [True] * 7}, "accepted"),
        ({"on_track": [False] * 12, "confidence_m": [20.0] * 12}, "rejected_ambiguous"),
    ],
)
def test_conditions_of_a_detection(columns: dict[str, Any], status: str) -> None:
    epochs = epochs_of(steps(0.0, 20.0, 12), **columns)
    assert passage_rows(run(epochs, balises_at(V1)), *STATUS) == [("V1", status, 5.5)]


def test_passed_while_the_position_is_placed_nowhere() -> None:
    path_m = steps(0.0, 20.0, 12)
    epochs = epochs_of(with_hole(path_m, 4, 7), path_m, fix_valid=[True] * 12)
    assert passage_rows(run(epochs, balises_at(V1)), *STATUS) == [("V1", "rejected_ambiguous", None)]


def test_failed_monitor_at_the_epoch_that_passes_it() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 12)), balises_at(V1), ScriptedBank(fails=[6]))
    assert passage_rows(result, *STATUS) == [("V1", "rejected_monitor", 5.5)]


def test_refused_balise_is_not_found_in_its_window() -> None:
    confidence_m = [20.0 if k == 26 else 6.0 for k in range(40)]
    result = run(epochs_of(steps(0.0, 20.0, 40), confidence_m=confidence_m), balises_at(V2))
    assert passage_rows(result, *STATUS, "linking_error", "reaction")[1] == (
        "V2",
        "rejected_confidence",
        25.5,
        "missed",
        "service_brake",
    )


def test_not_announced_virtual_balise() -> None:
    balises = balises_at({"V1": 110.0, "X": 300.0, "V2": 510.0}, linked=[True, False, True])
    result = run(epochs_of(steps(0.0, 20.0, 40)), balises)
    assert passage_rows(result, *STATUS, "linking_error", "reaction") == [
        ("V1", "accepted", 5.5, "none", "none"),
        ("X", "rejected_unlinked", 15.0, "none", "none"),
        ("V2", "accepted", 25.5, "none", "none"),
    ]


def test_two_balises_in_one_step_that_the_odometer_explains() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 12)), balises_at({"V1": 103.0, "V2": 117.0}))
    assert passage_rows(result, *STATUS) == [("V1", "accepted", 5.15), ("V2", "accepted", 5.85)]


# Standing, turning, shunting


def test_noise_at_standstill_on_a_balise_detects_it_once() -> None:
    noise = random.Random(7)
    at_m = [*steps(90.0, 2.0, 10), *[110.0] * 300, *steps(111.0, 2.0, 20)]
    path_m = [value + noise.gauss(0.0, 1.0) for value in at_m]
    t_s = [0.1 * k for k in range(len(at_m))]
    result = run(epochs_of(path_m, at_m, t_s=t_s), balises_at(V1))
    assert [row[:2] for row in passage_rows(result, *STATUS)] == [("V1", "accepted")]


@pytest.mark.parametrize(("sigma_m", "rows"), [(1.0, 2), (4.5, 2), (4.6, 1)])
def test_rearmed_after_ten_metres_or_three_sigma(sigma_m: float, rows: int) -> None:
    # Passed at 110 m, 13.6 m on to 123.6 m, and back over it: 3 sigma is 13.5 and 13.8 m.
    at_m = [90.0, 100.0, 108.0, 115.0, 123.6, 115.0, 108.0, 100.0, 90.0]
    epochs = epochs_of(at_m, position_sigma_m=[sigma_m] * len(at_m), confidence_m=[6.0] * len(at_m))
    assert run(epochs, balises_at(V1)).passages.height == rows


def test_shunting_back_over_a_balise() -> None:
    # Passed at 5.5 s, turned at 200 m (10 s), passed again at 14.5 s, turned at 0 m (20 s), and again.
    there, back = steps(0.0, 20.0, 10), steps(200.0, -20.0, 10)
    result = run(epochs_of(there + back + there), balises_at(V1))
    assert passage_rows(result, *STATUS, "direction", "linking_error") == [
        ("V1", "accepted", 5.5, "growing", "none"),
        ("V1", "accepted", 14.5, "falling", "none"),
        ("V1", "accepted", 25.5, "growing", "none"),
    ]


def test_turned_and_passed_within_one_step() -> None:
    # At 5 s the train stands at 122 m, 12 m beyond V1; at 6 s it is back at 102 m.
    at_m = [22.0, 42.0, 62.0, 82.0, 102.0, 122.0, 102.0, 82.0, 62.0]
    assert passage_rows(run(epochs_of(at_m), balises_at(V1)), *STATUS, "direction") == [
        ("V1", "accepted", 4.4, "growing"),
        ("V1", "accepted", 5.6, "falling"),
    ]


def test_turning_inside_a_window_misses_nothing() -> None:
    # Turned at 490 m, inside the window of V2 at 510 m; V1 is passed again on the way back.
    at_m = steps(0.0, 10.0, 50) + steps(490.0, -10.0, 50)
    result = run(epochs_of(at_m), balises_at(V2))
    assert passage_rows(result, "balise_id", "status", "direction") == [
        ("V1", "accepted", "growing"),
        ("V1", "accepted", "falling"),
    ]


def test_after_a_turn_the_way_back_is_linked_too() -> None:
    # V1, V2 growing; turned at 700 m; V2 again; then no position over V1.
    at_m = steps(0.0, 20.0, 35) + steps(700.0, -20.0, 36)
    result = run(epochs_of(with_hole(at_m, 60, 68), at_m), balises_at(V2))
    assert passage_rows(result, "balise_id", "status", "direction", "linking_error") == [
        ("V1", "accepted", "growing", "none"),
        ("V2", "accepted", "growing", "none"),
        ("V2", "accepted", "falling", "none"),
        ("V1", "not_available", "falling", "missed"),
    ]


def test_zigzag_over_a_switch_starts_a_new_leg_with_its_own_balises() -> None:
    # Leg 0 ends at 300 m; on leg 1 the path falls again, over another element with its own balise W.
    at_m = steps(0.0, 20.0, 15) + steps(300.0, -20.0, 16)
    balises = balises_at({"V1": 110.0, "W": 90.0}, leg=[0, 1])
    legs = [0 if k < 15 else 1 for k in range(len(at_m))]
    result = run(epochs_of(at_m, leg=legs), balises)
    assert passage_rows(result, "balise_id", "status", "direction", "odometer_distance_m") == [
        ("V1", "accepted", "growing", None),
        ("W", "accepted", "falling", 20.0),
    ]


# Jumps


def test_jump_over_two_balises_offers_both_in_order() -> None:
    # From 14 to 15 s the position goes from 280 to 420 m, the odometer 20 m: V2 and V3 are early.
    odometer_m = steps(0.0, 20.0, 30)
    path_m = [value + (120.0 if k >= 15 else 0.0) for k, value in enumerate(odometer_m)]
    balises = balises_at({"V1": 110.0, "V2": 350.0, "V3": 400.0})
    # The linking distance fails at the same epoch, and a failing monitor comes first.
    outcome = run(epochs_of(path_m, odometer_m), balises)
    assert [row[1] for row in passage_rows(outcome, *STATUS)] == ["accepted", "rejected_monitor", "rejected_monitor"]
    result = run(epochs_of(path_m, odometer_m), balises, disabled=["link_distance"])
    assert passage_rows(result, *STATUS, "odometer_distance_m", "linking_error") == [
        ("V1", "accepted", 5.5, None, "none"),
        ("V2", "rejected_window", 14.5, 180.0, "early"),
        ("V3", "rejected_window", pytest.approx(14 + 120 / 140), pytest.approx(170 + 120 / 7), "early"),
    ]
    assert result.epochs["link_order_value"][14:16].to_list() == [0.0, 2.0]
    assert [first for first, _ in negations(result)] == [15]


@pytest.mark.parametrize(
    ("rows_m", "disordered", "reason"), [(0.0, 2.0, None), (2.3, 0.0, None), (3.0, None, "noise too large")]
)
def test_a_coarse_count_over_two_balises_near_each_other_is_no_disorder(
    rows_m: float, disordered: float | None, reason: str | None
) -> None:
    """At 2 m/s the position passes V1 and V2, half a metre apart, just when the counter counts on by 16 m."""
    path_m = [2.0 * k for k in range(40)]
    odometer_m = [16.0 * ((k + 5) // 8) for k in range(40)]
    epochs = epochs_of(path_m, odometer_m, odometer_rows_m=[rows_m] * 40)
    result = run(epochs, balises_at({"V1": 37.0, "V2": 37.5}), disabled=["link_distance"]).epochs
    assert (result["link_order_value"][19], result["link_order_reason"][19]) == (disordered, reason)
    assert result["alarm"].any() == (disordered == 2.0)


def test_the_same_jump_that_fails_the_bank_is_rejected_by_it() -> None:
    odometer_m = steps(0.0, 20.0, 30)
    path_m = [value + (120.0 if k >= 15 else 0.0) for k, value in enumerate(odometer_m)]
    result = run(
        epochs_of(path_m, odometer_m),
        balises_at({"V1": 110.0, "V2": 350.0, "V3": 400.0}),
        ScriptedBank(fails=[15]),
    )
    assert [row[1] for row in passage_rows(result, *STATUS)] == ["accepted", "rejected_monitor", "rejected_monitor"]


def test_the_same_jump_without_an_odometer_is_not_detected() -> None:
    path_m = [value + (120.0 if k >= 15 else 0.0) for k, value in enumerate(steps(0.0, 20.0, 30))]
    bank = ScriptedBank(blind=range(30))
    result = run(epochs_of(path_m, [None] * 30), balises_at({"V1": 110.0, "V2": 350.0, "V3": 400.0}), bank)
    assert [row[1] for row in passage_rows(result, *STATUS)] == ["accepted"] * 3
    assert result.passages["window_open_m"].null_count() == 3
    assert not result.epochs["alarm"].any()
    assert not result.epochs["tvb"].any()
    assert result.epochs["diagnosis_faulty"].all()
    assert set(result.epochs["link_order_reason"]) == {"no odometer"}


def test_jump_back_is_an_offer_beyond_the_passage() -> None:
    # Jump ahead over V2 at 15 s, back at 18 s, and V2's own passage at 22.5 s, all under alarm.
    odometer_m = steps(0.0, 20.0, 40)
    path_m = [value + (120.0 if 15 <= k < 18 else 0.0) for k, value in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at({"V1": 110.0, "V2": 410.0}), ScriptedBank([15, 18]))
    assert passage_rows(result, "balise_id", "status", "linking_error", "direction") == [
        ("V1", "accepted", "none", "growing"),
        ("V2", "rejected_monitor", "none", "growing"),
        ("V2", "rejected_monitor", "none", "growing"),
        ("V2", "rejected_monitor", "missed", "growing"),
    ]


def test_offset_that_stays_has_one_row_for_the_passage() -> None:
    odometer_m = steps(0.0, 20.0, 40)
    path_m = [value + (120.0 if k >= 15 else 0.0) for k, value in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at({"V1": 110.0, "V2": 410.0}), ScriptedBank([15]))
    assert passage_rows(result, "balise_id", "status", "linking_error", "reaction") == [
        ("V1", "accepted", "none", "none"),
        ("V2", "rejected_monitor", "missed", "service_brake"),
    ]


# Close spacing: why the TVB is needed (LOC section III)


def test_overlapping_windows_cannot_tell_two_balises_apart() -> None:
    """V2 lies 400 m after V1 and V3 40 m further, far less than the 103.2 m that linking needs.

    The position runs 40 m ahead of the train from 12 s on, and no bank looks on. V2 is offered
    40 m early (360 m) and V3 at 400 m: both lie inside V2's window (353.3 to 451.6 m), so linking alone
    takes a balise 40 m off as good. Validated positions between the balises (the TVB) find
    the fault 13 s earlier, and neither is accepted.
    """
    odometer_m = steps(0.0, 20.0, 40)
    path_m = [value + (40.0 if k >= 12 else 0.0) for k, value in enumerate(odometer_m)]
    balises = balises_at({"V1": 110.0, "V2": 510.0, "V3": 550.0})
    epochs = epochs_of(path_m, odometer_m)
    by_linking_alone = run(epochs, balises, ScriptedBank(), disabled=["link_distance", "link_order"])
    assert [row[1] for row in passage_rows(by_linking_alone, *STATUS)] == ["accepted"] * 3
    with_tvb = run(epochs, balises, ScriptedBank())
    assert [row[1] for row in passage_rows(with_tvb, *STATUS)] == ["accepted"] + ["rejected_monitor"] * 2
    assert negations(with_tvb)[0][0] == 12


# Properties


@given(seed=st.integers(0, 10_000), sigma_m=st.floats(0.01, 1.0))
@settings(max_examples=30, deadline=None)
def test_each_balise_is_accepted_once_on_a_healthy_run(seed: int, sigma_m: float) -> None:
    noise = random.Random(seed)
    odometer_m = steps(0.0, 3.0, 700)
    path_m = [value + noise.gauss(0.0, sigma_m) for value in odometer_m]
    places = {f"V{i}": 100.0 + 300.0 * i for i in range(6)}
    result = run(epochs_of(path_m, odometer_m), balises_at(places))
    assert [row[:2] for row in passage_rows(result, *STATUS)] == [(name, "accepted") for name in places]
    assert not result.epochs["alarm"].any()


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_falling_runs_mirror_growing_ones(seed: int) -> None:
    noise = random.Random(seed)
    odometer_m = steps(0.0, 20.0, 120)
    offset_m = [noise.choice([0.0, 60.0, -60.0]) for _ in range(12)]
    path_m = [value + offset_m[k // 10] + 0.001 for k, value in enumerate(odometer_m)]
    places = {f"V{i}": 105.0 + 310.0 * i for i in range(7)}
    fails = [k for k in range(10, 120, 10) if offset_m[k // 10] != offset_m[k // 10 - 1]]
    columns = ("balise_id", "status", "linking_error", "reaction", "t_offered", "t_reckoned")
    growing = run(epochs_of(path_m, odometer_m), balises_at(places), ScriptedBank(fails))
    mirrored = {name: -place for name, place in reversed(places.items())}
    falling = run(epochs_of([-x for x in path_m], [-x for x in odometer_m]), balises_at(mirrored), ScriptedBank(fails))
    assert passage_rows(falling, *columns) == passage_rows(growing, *columns)


def test_without_an_odometer_a_balise_is_re_armed_by_the_way_of_the_position() -> None:
    """The position goes to and fro over 110 m by a few metres, then 40 m back and over it again."""
    path_m = [60.0, 80.0, 100.0, 112.0, 108.0, 113.0, 120.0, 80.0, 100.0, 120.0]
    result = run(epochs_of(path_m, [None] * len(path_m)), balises_at({"V1": 110.0}))
    crossed = result.crossings.select(pl.col("epoch"), "offered").rows()
    # 112 m is no farther from it than `rearm_m`; 120 m is, and so is 80 m.
    assert crossed == [(3, True), (4, False), (5, False), (7, True), (9, True)]


def test_where_a_telegram_was_read_the_telegram_before_and_the_odometer_say() -> None:
    """A balise stands on the path twice; the position is 400 m ahead of the train."""
    odometer_m = steps(0.0, 20.0, 40)
    epochs = epochs_of([x + 400.0 for x in odometer_m], odometer_m)
    places = balises_at({"P1": 110.0, "P2": 500.0, "P3": 100.0, "P4": 900.0}, kind="physical")
    twice = places.with_columns(balise_id=pl.col("balise_id").replace({"P3": "P2", "P4": "P2"}))
    result = run(epochs, twice, reads=reads_at([(5.5, "P1"), (25.0, "P2")]))
    assert result.crossings.select("balise_id", "path_m").rows() == [("P1", 110.0), ("P2", 500.0)]
