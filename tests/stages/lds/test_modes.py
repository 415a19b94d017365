"""Initialisation, TVB chain, negation, recovery and re-link on journeys of a few rows.

One epoch a second at 20 m/s; the bank has its first verdict at 1 s (the first increment).
"""

from __future__ import annotations

from itertools import pairwise
from math import sqrt
from typing import Any

import polars as pl
import pytest

from schemas.tables import Epochs, Passages
from tests.stages.lds.scripted import K_T, LdsTables, ScriptedBank, balises_at, epochs_of, passage_rows, run, steps

FAR = {"V9": 1e6}
V1 = {"V1": 110.0}


def changes(result: LdsTables, column: str) -> list[tuple[int, object]]:
    """Epochs at which a column takes a new value."""
    values = result.epochs[column].to_list()
    return [(0, values[0])] + [(k + 1, b) for k, (a, b) in enumerate(pairwise(values)) if a != b]


# Initialisation


def test_tvb_arises_between_balises_after_ten_consistent_seconds() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 15)), balises_at(FAR))
    assert changes(result, "tvb") == [(0, False), (11, True)]
    assert changes(result, "lds_mode") == [(0, "initialising"), (11, "linked")]
    assert result.epochs["lrvb_id"].null_count() == 15


@pytest.mark.parametrize("hole", [4, 9])
def test_a_break_begins_the_ten_seconds_anew(hole: int) -> None:
    path_m = [None if k == hole else x for k, x in enumerate(steps(0.0, 20.0, 30))]
    result = run(epochs_of(path_m, steps(0.0, 20.0, 30)), balises_at(FAR), ScriptedBank(blind=[hole, hole + 1]))
    assert changes(result, "tvb") == [(0, False), (hole + 12, True)]


def test_first_balise_has_no_window_and_begins_the_chain() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 10)), balises_at(V1))
    assert passage_rows(result, "status", "window_open_m", "odometer_distance_m") == [("accepted", None, None)]
    assert changes(result, "tvb") == [(0, False), (7, True)]
    assert changes(result, "lrvb_id") == [(0, None), (6, "V1")]


def test_entry_from_an_unfitted_area_wants_the_diagnosis_behind_the_first_balise() -> None:
    places = {"V1": 110.0, "V2": 510.0}
    entry = run(epochs_of(steps(0.0, 20.0, 40)), balises_at(places), entry_from_unfitted_area=True)
    assert passage_rows(entry, "balise_id", "status", "linking_error") == [
        ("V1", "rejected_monitor", "none"),
        ("V2", "accepted", "none"),
    ]


def test_alarm_before_anything_was_validated_leads_to_a_new_initialisation() -> None:
    bank = ScriptedBank(fails=[5])
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(FAR), bank)
    assert changes(result, "lds_mode") == [(0, "initialising"), (5, "fail_safe"), (35, "initialising"), (46, "linked")]
    assert bank.restarted == [35]
    assert changes(result, "tvb") == [(0, False), (46, True)]


# Exposure, distance, doubt


def test_exposure_is_the_time_since_the_tvb_or_vb_before() -> None:
    path_m = [None if 12 <= k <= 15 else x for k, x in enumerate(steps(0.0, 20.0, 20))]
    result = run(epochs_of(path_m, steps(0.0, 20.0, 20)), balises_at(V1), ScriptedBank(blind=[12, 13, 14, 15, 16]))
    assert result.epochs["exposure_s"].to_list() == pytest.approx(
        [None] * 6 + [0.5, 1.5] + [1.0] * 4 + [1.0, 2.0, 3.0, 4.0, 5.0, 6.0] + [1.0] * 2
    )
    assert changes(result, "lds_mode") == [(0, "initialising"), (6, "linked"), (12, "odometry"), (16, "linked")]
    assert changes(result, "tvb") == [(0, False), (7, True), (12, False), (17, True)]


def test_an_outage_without_epochs_shows_in_the_exposure_after_it() -> None:
    t_s = [*range(20), *range(32, 40)]
    result = run(epochs_of([20.0 * t for t in t_s], t_s=t_s), balises_at(V1))
    assert result.epochs["exposure_s"].max() == pytest.approx(13.0)


def test_distance_and_doubt_since_the_reference() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 12)), balises_at(V1))
    # 220 - 110 m; 12 m of the balise + 5 m + 5 % of 110 m.
    last = result.epochs.row(-1, named=True)
    assert last["distance_from_lrvb_m"] == pytest.approx(110.0)
    assert (last["doubt_over_m"], last["doubt_under_m"]) == pytest.approx((22.5, 22.5))
    assert result.epochs["doubt_over_m"].null_count() == 6


def test_after_a_turn_doubt_grows_with_the_way_run() -> None:
    at_m = steps(0.0, 20.0, 15) + steps(300.0, -20.0, 5)
    last = run(epochs_of(at_m), balises_at(V1)).epochs.row(-1, named=True)
    # At 220 m, 110 m from the reference, after 190 + 80 m.
    assert last["distance_from_lrvb_m"] == pytest.approx(110.0)
    assert last["doubt_over_m"] == pytest.approx(12.0 + 5.0 + 0.05 * 270.0)


def test_without_an_odometer_there_is_no_tvb_and_no_linking() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 20), [None] * 20), balises_at(V1), ScriptedBank(blind=range(20)))
    assert passage_rows(result, "status", "window_open_m") == [("accepted", None)]
    assert changes(result, "lds_mode") == [(0, "initialising")]
    assert result.epochs["diagnosis_faulty"].all()
    assert changes(result, "withheld_for") == [(0, "relink"), (1, None)]
    assert result.epochs["distance_from_lrvb_m"].null_count() == 20


# Negation and return


def test_negation_lasts_thirty_seconds_after_the_last_fast_failure() -> None:
    bank = ScriptedBank(fails=[20, 21, 22])
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(V1), bank)
    assert changes(result, "negated") == [(0, False), (20, True), (52, False)]
    assert changes(result, "alarm") == [(0, False), (20, True), (23, False)]
    assert changes(result, "tvb") == [(0, False), (7, True), (20, False), (53, True)]
    modes = [(0, "initialising"), (6, "linked"), (20, "fail_safe"), (52, "odometry"), (53, "linked")]
    assert changes(result, "lds_mode") == modes
    assert bank.restarted == [52]


def test_slow_monitors_that_ring_do_not_hold_back_the_return() -> None:
    bank = ScriptedBank(rings=range(20, 60), fast=[20])
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(V1), bank)
    assert changes(result, "negated") == [(0, False), (20, True), (50, False)]
    assert changes(result, "alarm") == [(0, False), (20, True), (50, False)]


def test_seconds_that_nobody_looked_at_do_not_count() -> None:
    path_m = [None if 30 <= k < 40 else x for k, x in enumerate(steps(0.0, 20.0, 90))]
    bank = ScriptedBank(fails=[20], blind=range(30, 41))
    result = run(epochs_of(path_m, steps(0.0, 20.0, 90)), balises_at(V1), bank)
    # The bank sees again at 41 s: the thirty seconds begin there.
    assert changes(result, "negated") == [(0, False), (20, True), (71, False)]


def test_an_offset_that_stays_never_links_again() -> None:
    odometer_m = steps(0.0, 20.0, 120)
    path_m = [x + (45.0 if k >= 20 else 0.0) for k, x in enumerate(odometer_m)]
    bank = ScriptedBank([20])
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), bank)
    assert changes(result, "negated") == [(0, False), (20, True)]
    assert bank.restarted == []


def test_an_offset_that_goes_links_again_after_recovery() -> None:
    odometer_m = steps(0.0, 20.0, 120)
    path_m = [x + (45.0 if 20 <= k < 60 else 0.0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([20, 60]))
    assert changes(result, "negated") == [(0, False), (20, True), (90, False)]


def test_linking_goes_on_while_negated() -> None:
    # V2 and V3 pass under alarm: offered, rejected, missed in their windows, the second brakes.
    places = {"V1": 110.0, "V2": 510.0, "V3": 710.0, "V4": 1310.0}
    result = run(epochs_of(steps(0.0, 20.0, 80)), balises_at(places, link_reaction="none"), ScriptedBank(range(20, 32)))
    assert passage_rows(result, "balise_id", "status", "linking_error", "reaction") == [
        ("V1", "accepted", "none", "none"),
        ("V2", "rejected_monitor", "missed", "none"),
        ("V3", "rejected_monitor", "missed", "service_brake"),
        ("V4", "accepted", "none", "none"),
    ]
    assert result.passages["window_open_m"][3] == pytest.approx((1200.0 - 29.0) / 1.05)


def test_without_an_odometer_a_negation_after_a_balise_never_ends() -> None:
    bank = ScriptedBank(fails=[20], blind=range(80))
    result = run(epochs_of(steps(0.0, 20.0, 80), [None] * 80), balises_at({"V1": 110.0, "V2": 1110.0}), bank)
    assert changes(result, "negated") == [(0, False), (20, True)]
    assert [row[0] for row in passage_rows(result, "status")] == ["accepted", "rejected_monitor"]


# Linking monitors


def test_link_distance_bounds() -> None:
    odometer_m = steps(0.0, 20.0, 30)
    path_m = [x + (31.0 if k >= 25 else 0.0) for k, x in enumerate(odometer_m)]
    epochs = run(epochs_of(path_m, odometer_m), balises_at(V1)).epochs
    assert epochs["link_distance_reason"][:6].unique().to_list() == ["no balise or validated position to measure from"]
    # At 25 s: 390 m since V1: 5 m + 19.5 m + 5.3267 sqrt(2) m.
    row = epochs.row(25, named=True)
    assert row["link_distance_value"] == pytest.approx(31.0)
    assert row["link_distance_threshold"] == pytest.approx(24.5 + K_T * sqrt(2.0))
    assert (epochs["link_distance_state"][24], row["link_distance_state"]) == ("pass", "pass")
    # Nearer to the balise the same offset is out of bounds.
    nearer = [x + (31.0 if k >= 24 else 0.0) for k, x in enumerate(odometer_m)]
    assert run(epochs_of(nearer, odometer_m), balises_at(V1)).epochs["link_distance_state"][24] == "pass"
    nearest = [x + (31.0 if k >= 20 else 0.0) for k, x in enumerate(odometer_m)]
    assert run(epochs_of(nearest, odometer_m), balises_at(V1)).epochs["link_distance_state"][20] == "fail"


@pytest.mark.parametrize(
    ("columns", "order_reason", "distance_reason"),
    [
        ({}, None, None),
        ({"on_track": [True] * 9 + [False]}, "match ambiguous or off track", "match ambiguous or off track"),
        ({"fix_valid": [True] * 9 + [False]}, "no position", "no position"),
        (
            {"position_sigma_m": [None] * 10},
            "no standard deviation of the position",
            "no standard deviation of the position",
        ),
        ({"odometer_m": pl.Series([*steps(0.0, 20.0, 9), None])}, "no odometer", "no odometer"),
    ],
)
def test_linking_monitors_say_why_they_were_not_evaluated(
    columns: dict[str, Any], order_reason: str | None, distance_reason: str | None
) -> None:
    last = run(epochs_of(steps(0.0, 20.0, 10), **columns), balises_at(V1)).epochs.row(-1, named=True)
    assert (last["link_order_reason"], last["link_distance_reason"]) == (order_reason, distance_reason)
    assert (last["link_order_state"] == "not_evaluated") is (order_reason is not None)
    assert (last["link_distance_state"] == "not_evaluated") is (distance_reason is not None)


def test_disabled_linking_monitors() -> None:
    epochs = run(epochs_of(steps(0.0, 20.0, 10)), balises_at(V1), disabled=["link_order", "link_distance"]).epochs
    assert set(epochs["link_order_reason"]) == set(epochs["link_distance_reason"]) == {"disabled by configuration"}


def test_jump_back_over_one_balise_is_out_of_order() -> None:
    odometer_m = steps(0.0, 20.0, 30)
    path_m = [x - (120.0 if k >= 10 else 0.0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1))
    assert result.epochs["link_order_value"][10] == 1.0
    assert result.epochs["link_order_state"][10] == "fail"


def test_positions_off_the_track_raise_no_linking_alarm() -> None:
    # From 10 to 20 s the position wanders off the track, back over V1 and ahead over V2.
    odometer_m = steps(0.0, 20.0, 40)
    path_m = [80.0 if 10 <= k < 15 else 700.0 if 15 <= k < 20 else x for k, x in enumerate(odometer_m)]
    on_track = [not 10 <= k < 20 for k in range(40)]
    balises = balises_at({"V1": 110.0, "V2": 610.0})
    result = run(epochs_of(path_m, odometer_m, on_track=on_track), balises)
    assert not result.epochs["alarm"].any()
    assert passage_rows(result, "balise_id", "status", "t_offered") == [
        ("V1", "accepted", 5.5),
        ("V1", "rejected_ambiguous", pytest.approx(9 + 70 / 100)),
        ("V1", "rejected_ambiguous", pytest.approx(14 + 30 / 620)),
        ("V2", "rejected_ambiguous", pytest.approx(14 + 530 / 620)),
        ("V2", "rejected_ambiguous", pytest.approx(19 + 90 / 300)),
        ("V2", "accepted", 30.5),
    ]


# Contract


def test_frames_are_as_the_contract_says() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 40)), balises_at({"V1": 110.0, "V2": 510.0}))
    assert result.passages.columns == [*Passages.columns(), "t_reckoned"]
    Passages.validate(result.passages.drop("t_reckoned"))
    own = [name for name in result.epochs.columns if name in Epochs.columns()]
    for name in own:
        assert result.epochs.schema[name] == Epochs.columns()[name].dtype, name
    assert not any(result.epochs[name].is_nan().any() for name in own if result.epochs[name].dtype == pl.Float64)


def test_no_balises_and_no_positions_are_no_error() -> None:
    empty = balises_at(V1).clear()
    result = run(epochs_of(steps(0.0, 20.0, 20)), empty)
    assert result.passages.is_empty()
    assert result.epochs["tvb"].sum() == 9
    lost = run(epochs_of([None] * 5, [None] * 5), balises_at(V1), ScriptedBank(blind=range(5)))
    assert set(lost.epochs["lds_mode"]) == {"initialising"}
    assert lost.passages.is_empty()


@pytest.mark.parametrize("fails", [range(50, 120), range(70, 75), range(100, 400)])
def test_link_distance_has_a_verdict_through_a_failure_of_the_bank(fails: range) -> None:
    """From the accepted balise on, however many epochs are looked at together."""
    result = run(epochs_of(steps(0.0, 20.0, 400)), balises_at(V1), ScriptedBank(fails=fails))
    assert result.epochs["link_distance_state"].to_list()[6:] == ["pass"] * 394


@pytest.mark.parametrize("step_m", [1.0, 4.0])
def test_a_balise_is_detected_again_on_the_way_back_only_beyond_its_distance(step_m: float) -> None:
    """50 m past it and back; an uneventful way counts as every epoch of it does."""
    there = steps(0.0, step_m, round(160.0 / step_m) + 1)
    result = run(epochs_of([*there, *there[-2::-1]]), balises_at(V1))
    assert [row[:2] for row in passage_rows(result, "balise_id", "status")] == [("V1", "accepted")] * 2
