"""The first position after a break of the diagnosis: hand-worked rows, one epoch a second at 20 m/s."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import Any

import polars as pl
import pytest

from pipeline.lds import LdsResult
from pipeline.lds.breaks import LOST, TOO_FAR
from tests.lds.scripted import LIMITS, ScriptedBank, balises_at, epochs_of, reads_at, run, told

V1 = {"V1": 110.0}
K_T = LIMITS.threshold_factor
BEFORE = 21  # epochs 0 to 20 s


def outage(
    gap_s: float, offset_m: float, after: int = 60, balises: pl.DataFrame | None = None, **columns: Any
) -> LdsResult:
    """No epochs for `gap_s` after 20 s; from its end on the position is off. The bank has no increment over it."""
    t_s = [*map(float, range(BEFORE)), *(20.0 + gap_s + k for k in range(after))]
    odometer_m = [20.0 * t for t in t_s]
    path_m = [x + (offset_m if k >= BEFORE else 0.0) for k, x in enumerate(odometer_m)]
    settings = {name: columns.pop(name) for name in ("reads", "limits", "entry_from_unfitted_area") if name in columns}
    wide = {name: [value] * len(t_s) if isinstance(value, float) else value for name, value in columns.items()}
    epochs = epochs_of(path_m, odometer_m, t_s, **wide)
    return run(epochs, balises_at(V1) if balises is None else balises, ScriptedBank(blind=[BEFORE]), **settings)


def first_after(result: LdsResult) -> dict[str, Any]:
    return result.epochs.row(BEFORE, named=True)


@pytest.mark.parametrize("gap_s", [2.0, 30.0, 70.0, 90.0, 300.0])
def test_the_bound_is_that_of_a_relink_from_the_last_validated_position(gap_s: float) -> None:
    # The last TVB is at 20 s, 400 m; sigma 1 m, odometer 0.05 m at one second, scale 1e-4.
    bound_m = K_T * sqrt(2.0 + 0.05**2 * gap_s + (1e-4 * 20.0 * gap_s) ** 2)
    for offset_m, state in ((0.0, "pass"), (bound_m - 0.01, "pass"), (-bound_m - 0.01, "fail"), (45.0, "fail")):
        result = outage(gap_s, offset_m)
        row = first_after(result)
        assert row["link_distance_state"] == state
        # Within the gap that is bridged in any case the bounds of linking are as narrow and come first.
        assert (row["link_distance_value"], row["alarm"]) == (pytest.approx(offset_m), state == "fail")
        assert [n.first_epoch for n in result.negations] == ([BEFORE] if state == "fail" else [])
    assert first_after(outage(gap_s, 1.0))["link_distance_threshold"] == pytest.approx(bound_m)


def test_no_break_no_test() -> None:
    # 8 m from one epoch to the next: the bank's to judge; 5 m + 5 % and noise let it pass.
    row = first_after(outage(1.0, 8.0))
    assert (row["link_distance_state"], row["link_distance_threshold"] > 20.0) == ("pass", True)


def test_a_failed_test_negates_until_the_position_is_what_it_was() -> None:
    t_s = [*map(float, range(BEFORE)), *(110.0 + k for k in range(100))]
    odometer_m = [20.0 * t for t in t_s]
    for back, end in ((10, BEFORE + 30), (60, BEFORE + 60), (1000, None)):
        path_m = [x + (40.0 if BEFORE <= k < BEFORE + back else 0.0) for k, x in enumerate(odometer_m)]
        result = run(epochs_of(path_m, odometer_m, t_s), balises_at({"V1": 110.0, "V2": 2710.0}))
        assert [(n.first_epoch, n.end_epoch) for n in result.negations] == [(BEFORE, end)]
        # V2 lies 25 s after the outage, inside its wide window: 40 m off it would have been taken as good.
        assert told(result, "balise_id", "status")[1] == ("V2", "rejected_monitor")
        assert not result.epochs["tvb"][BEFORE : end and end + 1].any()


@pytest.mark.parametrize(("offset_m", "state"), [(0.0, "not_evaluated"), (28.0, "not_evaluated"), (30.3, "fail")])
def test_beyond_the_failure_limit_the_odometer_proves_nothing_but_a_large_move(offset_m: float, state: str) -> None:
    # 1800 m at 0.3 %: 5.3267 sqrt(2.225 + 5.4^2) = 29.8 m.
    result = outage(90.0, offset_m, scale_sigma=0.003)
    row = first_after(result)
    assert row["link_distance_state"] == state
    assert row["link_distance_reason"] == (TOO_FAR if state == "not_evaluated" else None)
    assert result.undecided == ([BEFORE] if state == "not_evaluated" else [])


def test_what_nothing_can_tell_begins_the_chain_anew_and_says_so() -> None:
    result = outage(90.0, 0.0, scale_sigma=0.003)
    # The bank judges again one second after the break; ten seconds later there is a TVB.
    assert result.epochs["tvb"].to_list() == [k > 6 and not BEFORE <= k < BEFORE + 11 for k in range(BEFORE + 60)]
    reasons = result.epochs["link_distance_reason"].to_list()
    assert [k for k, reason in enumerate(reasons) if reason == TOO_FAR] == list(range(BEFORE, BEFORE + 12))
    assert result.epochs["lds_mode"][BEFORE] == "linked"
    # Linking holds on: the distance still counts from V1.
    assert result.epochs["link_distance_threshold"][BEFORE + 12] > 100.0


def test_a_balise_inside_its_window_begins_the_chain_anew() -> None:
    balises = balises_at({"V1": 110.0, "V2": 2270.0})
    result = outage(90.0, 0.0, balises=balises, scale_sigma=0.003)
    assert told(result, "balise_id", "status") == [("V1", "accepted"), ("V2", "accepted")]
    assert result.epochs["tvb"][BEFORE : BEFORE + 6].to_list() == [False] * 5 + [True]
    entering = outage(90.0, 0.0, balises=balises, scale_sigma=0.003, entry_from_unfitted_area=True)
    assert told(entering, "balise_id", "status")[1] == ("V2", "rejected_monitor")


def test_a_physical_balise_read_meanwhile_tells_what_the_odometer_cannot() -> None:
    balises = balises_at({"V1": 110.0, "P1": 2010.0}, kind=["virtual", "physical"])
    # P1 is read 190 m before the position comes back: 5.3267 sqrt(2.025 + 0.57^2) = 8.2 m, and 12 m of P1 itself.
    for offset_m, state in ((0.0, "pass"), (8.0, "pass"), (15.0, "not_evaluated"), (21.0, "fail")):
        reads = reads_at([(100.5, "P1")]).with_columns(odometer_m=pl.lit(2010.0))
        result = outage(90.0, offset_m, balises=balises, scale_sigma=0.003, reads=reads)
        assert first_after(result)["link_distance_state"] == state, offset_m


def test_a_lost_odometer_distance_is_never_compared_through() -> None:
    # The odometer says at 20 s that it slipped: its distance is 500 m off from then on, the position is right.
    at_m = [20.0 * k for k in range(60)]
    odometer_m = [x + (500.0 if k >= BEFORE else 0.0) for k, x in enumerate(at_m)]
    stretch = [int(k >= BEFORE) for k in range(60)]
    result = run(epochs_of(at_m, odometer_m, odometer_segment=stretch), balises_at(V1), ScriptedBank(blind=[BEFORE]))
    assert not result.epochs["alarm"].any()
    reasons = result.epochs["link_distance_reason"].to_list()
    assert [k for k, reason in enumerate(reasons) if reason == LOST] == list(range(BEFORE, BEFORE + 12))
    assert result.epochs["tvb"].to_list() == [k > 6 and not BEFORE <= k < BEFORE + 11 for k in range(60)]
    assert result.undecided == [BEFORE]


def test_a_change_of_speed_counts_with_the_latency() -> None:
    # 20 m/s before, standing after: 5 m at one sigma of 0.25 s.
    speed = pl.Series("speed_mps", [20.0] * BEFORE + [0.0] * 60)
    bound_m = K_T * sqrt(2.0 + 0.05**2 * 30.0 + (1e-4 * 600.0) ** 2 + 2.5**2)
    assert bound_m == pytest.approx(15.4, abs=0.1)
    for offset_m, state in ((bound_m - 0.01, "pass"), (bound_m + 0.01, "fail")):
        row = first_after(outage(30.0, offset_m, speed_mps=speed, latency_sigma_s=0.125))
        assert row["link_distance_state"] == state


def test_a_turn_inside_the_outage_counts_with_the_way_run() -> None:
    # 600 m on and 600 m back inside 60 s: 1200 m at 0.2 %, although the train is where it was.
    before_m = [20.0 * k for k in range(BEFORE)]
    ways_m = [420.0 + 20.0 * k for k in range(29)] + [1000.0 - 20.0 * k for k in range(30)]
    odometer_m = [*before_m, *ways_m, 400.0, 380.0]
    for offset_m, state in ((13.0, "pass"), (18.0, "fail")):
        path_m: list[float | None] = [*before_m, *[None] * 59, 400.0 + offset_m, 380.0 + offset_m]
        epochs = epochs_of(path_m, odometer_m, scale_sigma=[0.002] * len(path_m))
        result = run(epochs, balises_at(V1), ScriptedBank(blind=range(BEFORE, BEFORE + 60)))
        row = result.epochs.row(BEFORE + 59, named=True)
        assert (row["link_distance_state"], row["link_distance_reason"]) == (state, None)
        assert row["link_distance_threshold"] == pytest.approx(K_T * sqrt(2.0 + 0.15 + 2.4**2), rel=0.01)


def test_a_poor_first_position_is_held_against_once_it_is_good_enough() -> None:
    sigma = [1.0] * BEFORE + [9.0, 9.0, 1.0] + [1.0] * 57
    confidence = [6.18 * s for s in sigma]
    result = outage(90.0, 30.0, position_sigma_m=sigma, confidence_m=confidence)
    states = result.epochs["link_distance_state"].to_list()
    assert states[BEFORE : BEFORE + 3] == ["not_evaluated", "not_evaluated", "fail"]
    assert not result.epochs["tvb"][BEFORE:].any()
    healthy = outage(90.0, 0.0, position_sigma_m=sigma, confidence_m=confidence)
    assert healthy.epochs["tvb"][BEFORE : BEFORE + 4].to_list() == [False, False, False, True]


def test_without_the_monitor_there_is_no_test() -> None:
    limits = replace(LIMITS, disabled=("link_distance",))
    result = outage(90.0, 40.0, limits=limits)
    assert result.undecided == []
    assert first_after(result)["link_distance_reason"] == "disabled by configuration"


def test_what_is_learned_of_the_scale_after_a_break_does_not_mend_the_way_before() -> None:
    # 0.3 % while the outage was run through, 0.01 % from two seconds after it on: still nothing can tell.
    scale = [0.003] * (BEFORE + 2) + [1e-4] * 58
    result = outage(90.0, 20.0, scale_sigma=scale)
    assert result.negations == []
    assert result.epochs["link_distance_reason"][BEFORE : BEFORE + 11].to_list() == [TOO_FAR] * 11


def test_no_relink_through_a_lost_odometer_distance() -> None:
    # 40 m off since 40 s; at 50 s the odometer loses 40 m of its way, so that the two agree again.
    true_m = [20.0 * k for k in range(160)]
    path_m = [x - (40.0 if k >= 40 else 0.0) for k, x in enumerate(true_m)]
    odometer_m = [x - (40.0 if k >= 50 else 0.0) for k, x in enumerate(true_m)]
    stretch = [int(k >= 50) for k in range(160)]
    epochs = epochs_of(path_m, odometer_m, odometer_segment=stretch)
    balises = balises_at(V1 | {"V2": 2710.0})
    result = run(epochs, balises, ScriptedBank(fails=[40]))
    assert [(n.first_epoch, n.end_epoch) for n in result.negations] == [(40, None)]
    assert told(result, "balise_id", "status") == [("V1", "accepted"), ("V2", "rejected_monitor")]
    # What is read after the loss says what they should be.
    balises = balises_at(V1 | {"B": 1400.0, "V2": 2710.0}, kind=["virtual", "physical", "virtual"])
    for off_m, end in ((40.0, None), (0.0, 70)):
        path_m = [x - (off_m if k >= 40 else 0.0) for k, x in enumerate(true_m)]
        epochs = epochs_of(path_m, odometer_m, odometer_segment=stretch)
        result = run(epochs, balises, ScriptedBank(fails=[40]), reads_at([(70.0, "B")]))
        assert [(n.first_epoch, n.end_epoch) for n in result.negations] == [(40, end)]


@pytest.mark.parametrize("offset_m", [0.0, 40.0])
def test_a_read_before_the_distance_was_lost_tells_nothing_after_it(offset_m: float) -> None:
    # P1 is read at 100 s, inside the outage; at 105 s the odometer says that it slipped by 40 m; position at 110 s.
    t_s = [*map(float, range(BEFORE)), *(110.0 + k for k in range(60))]
    true_m = [20.0 * t for t in t_s]
    slipped = [t > 105.0 for t in t_s]
    odometer_m = [x + 40.0 * late for x, late in zip(true_m, slipped, strict=True)]
    path_m = [x + offset_m * late for x, late in zip(true_m, slipped, strict=True)]
    epochs = epochs_of(path_m, odometer_m, t_s, odometer_segment=[int(late) for late in slipped])
    balises = balises_at({"V1": 110.0, "P1": 2000.0}, kind=["virtual", "physical"])
    reads = reads_at([(100.0, "P1")]).with_columns(odometer_m=pl.lit(2000.0))
    result = run(epochs, balises, ScriptedBank(blind=[BEFORE]), reads)
    assert not result.epochs["alarm"].any()
    row = first_after(result)
    assert (row["link_distance_state"], row["link_distance_reason"]) == ("not_evaluated", LOST)


@pytest.mark.parametrize(("stretch", "state"), [(0, "pass"), (1, "not_evaluated")])
def test_a_read_between_two_epochs_counts_where_the_odometer_held(stretch: int, state: str) -> None:
    # Read half a second before the position comes back; no odometer is given with it.
    t_s = [*map(float, range(BEFORE)), 50.0, *(51.0 + k for k in range(60))]
    path_m = [None if t == 50.0 else 20.0 * t for t in t_s]
    odometer_m = [20.0 * t for t in t_s]
    stretches = [stretch * (t >= 51.0) for t in t_s]
    epochs = epochs_of(path_m, odometer_m, t_s, odometer_segment=stretches)
    balises = balises_at({"V1": 110.0, "P1": 1010.0}, kind=["virtual", "physical"])
    result = run(epochs, balises, ScriptedBank(blind=[BEFORE, BEFORE + 1]), reads_at([(50.5, "P1")]))
    assert result.epochs["link_distance_state"][BEFORE + 1] == state
