"""The re-link and its anchor (DOMAIN section 4), after alarms and after outages: one epoch a second at 20 m/s."""

from __future__ import annotations

from datetime import UTC, datetime
from math import sqrt
from typing import Any

import pytest

from pipeline.stages.lds.crossings import Journey, telegrams_on_path
from pipeline.stages.lds.link_monitors import Relink
from pipeline.stages.lds.run import balises_of_kind
from pipeline.stages.odometry.bound import LOST_M
from schemas.enums import BaliseKind, NotEvaluated
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.stages.lds.scripted import (
    K_T,
    SCALE_SIGMA,
    LdsTables,
    ScriptedBank,
    balises_at,
    epochs_of,
    negations,
    passage_rows,
    reads_at,
    run,
    settings,
    steps,
)

V1 = {"V1": 110.0}
V1_P1 = {"V1": 110.0, "P1": 1410.0}
KINDS = ["virtual", "physical"]


def relink_of(offsets_m: list[float], tvb: list[int], **columns: Any) -> tuple[Relink, Any]:
    """Ten epochs whose position is `offsets_m` ahead of the odometer; `tvb`: epochs that are TVBs."""
    odometer_m = steps(0.0, 20.0, 10)
    path_m = [x + offset_m for x, offset_m in zip(odometer_m, offsets_m, strict=True)]
    journey = Journey(arrays_of_table(AlignedEpochs, epochs_of(path_m, odometer_m, **columns)), SCALE_SIGMA, settings())
    return Relink(journey, [k in tvb for k in range(10)], settings()), journey


def moved_m(relink: Relink, epoch: int) -> float | None:
    """Against the anchor in force; None without one."""
    comparison = relink.compare(epoch)
    return comparison.moved_m if comparison.reason is None else None


# The anchor, by tables of ten rows


@pytest.mark.parametrize(
    ("epoch", "suspected", "anchor"),
    [(9, True, 2), (9, False, 8), (8, False, 6), (6, False, 5), (3, True, 2), (2, True, None), (2, False, None)],
)
def test_the_anchor_is_the_first_tvb_where_the_position_is_suspected_else_the_last_before(
    epoch: int, suspected: bool, anchor: int | None
) -> None:
    """TVBs at 2, 3, 5, 6 and 8 s; at each second the position is a metre farther ahead."""
    relink, _ = relink_of([float(k) for k in range(10)], [2, 3, 5, 6, 8])
    relink.withhold(epoch, suspected)
    assert moved_m(relink, 9) == (None if anchor is None else 9.0 - anchor)


def test_a_later_return_does_not_move_the_anchor_of_an_alarm() -> None:
    """Alarm at 3 s, return at 5 s; what nothing watched before 8 s is held to the same anchor, as is a second alarm."""
    relink, _ = relink_of([float(k) for k in range(10)], [2, 5, 6, 7])
    relink.withhold(3, suspected=True)
    relink.hold(5)
    for suspected in (False, True, False):
        relink.withhold(8, suspected)
        assert moved_m(relink, 9) == 7.0
    # After an outage alone the next one has its own.
    relink, _ = relink_of([float(k) for k in range(10)], [2, 5, 6, 7])
    relink.withhold(4, suspected=False)
    assert moved_m(relink, 9) == 7.0
    relink.hold(5)
    relink.withhold(8, suspected=False)
    assert moved_m(relink, 9) == 2.0


def test_a_start_of_mission_forgets_what_was_before() -> None:
    relink, _ = relink_of([0.0] * 10, [2, 7])
    relink.begin_mission(5)
    relink.withhold(6, suspected=True)
    assert moved_m(relink, 9) is None
    relink.withhold(9, suspected=True)
    assert moved_m(relink, 9) == 0.0


@pytest.mark.parametrize("suspected", [True, False])
def test_a_telegram_is_the_anchor_from_then_on(suspected: bool) -> None:
    """The balise at 100 m is read at 5.5 s, where the odometer is at 110 m: GNSS minus odometer should be -10 m."""
    relink, journey = relink_of([-12.0] * 10, [0, 1, 2, 3])
    relink.withhold(4, suspected)
    assert moved_m(relink, 6) == pytest.approx(0.0)
    physical = balises_of_kind(balises_at({"P1": 100.0}, kind="physical"), BaliseKind.PHYSICAL)
    [read], _ = telegrams_on_path(reads_at([(5.5, "P1")]).with_columns(odometer_m=110.0), physical, journey)
    relink.note_read(read)
    for _ in range(2):
        found = relink.compare(9)
        assert found.moved_m == pytest.approx(-2.0)
        # 3.5 s and 70 m since the telegram: sigma 1 m of the position and 1 m of the read.
        assert found.bound_m == pytest.approx(K_T * sqrt(2.0 + 0.05**2 * 3.5 + (1e-4 * 70.0) ** 2))
        relink.withhold(9, suspected=True)


@pytest.mark.parametrize(("suspected", "moved"), [(True, -2.0), (False, 0.0)])
def test_after_an_outage_a_tvb_after_the_telegram_is_the_anchor(suspected: bool, moved: float) -> None:
    relink, journey = relink_of([-12.0] * 10, list(range(10)))
    physical = balises_of_kind(balises_at({"P1": 20.0}, kind="physical"), BaliseKind.PHYSICAL)
    [read], _ = telegrams_on_path(reads_at([(1.5, "P1")]).with_columns(odometer_m=30.0), physical, journey)
    relink.note_read(read)
    relink.withhold(8, suspected)
    assert moved_m(relink, 9) == pytest.approx(moved)


def test_the_bound_adds_the_variances_of_both_positions() -> None:
    """Sigma 0.5 m at the anchor (2 s) and 1.2 m now (9 s), 140 m later."""
    relink, _ = relink_of([0.0] * 10, [2], position_sigma_m=[0.5] * 5 + [1.2] * 5)
    relink.withhold(9, suspected=True)
    expected = K_T * sqrt(0.25 + 1.44 + 0.05**2 * 7.0 + (1e-4 * 140.0) ** 2)
    assert relink.compare(9).bound_m == pytest.approx(expected)


# Returns


@pytest.mark.parametrize(("scale_sigma", "bound_m"), [(1e-4, K_T * sqrt(2.0 + 0.05**2 * 43 + 0.086**2)), (0.01, 10.0)])
def test_bound_of_the_relink(scale_sigma: float, bound_m: float) -> None:
    # First TVB at 7 s, test at 50 s, 860 m later; never more than half the failure limit.
    odometer_m = steps(0.0, 20.0, 52)
    for offset_m, end in ((bound_m - 0.01, 50), (bound_m + 0.01, None)):
        path_m = [x + (offset_m if k >= 20 else 0.0) for k, x in enumerate(odometer_m)]
        result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([20]), scale_sigma=scale_sigma)
        assert negations(result) == [(20, end)]


def test_a_slow_drift_does_not_come_back_step_by_step() -> None:
    """0.1 m/s from 340 s on, an alarm every 90 s: 9 m at the return, and 11 s later more than half the limit."""
    odometer_m = steps(0.0, 20.0, 700)
    path_m = [x + max(0.0, 0.1 * (k - 340)) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([400, 490, 580]))
    assert negations(result) == [(400, 430), (441, None)]


def test_false_alarms_one_after_the_other_all_return() -> None:
    bank = ScriptedBank([100, 190, 280])
    result = run(epochs_of(steps(0.0, 20.0, 400)), balises_at(V1), bank)
    assert negations(result) == [(100, 130), (190, 220), (280, 310)]


def test_a_position_that_healed_returns_to_its_old_anchor() -> None:
    """A drift to 25 m that is over at 250 s: the anchor is from before it, so no balise is needed."""
    odometer_m = steps(0.0, 20.0, 400)
    path_m = [x + (min(25.0, 0.5 * max(0, k - 100)) if k < 250 else 0.0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([140, 250]))
    assert negations(result) == [(140, 280)]


def test_a_telegram_says_where_the_train_is_and_the_same_test_decides() -> None:
    """The position is off from 20 s on; P1, where the train is at 45.5 s, or one that lies 20 m ahead of it."""
    odometer_m = steps(0.0, 20.0, 90)
    for place_m, offset_m, end in ((910.0, 0.0, 50), (910.0, 9.0, None), (930.0, 0.0, None), (930.0, 20.0, 50)):
        path_m = [x + (offset_m if k >= 20 else 0.0) for k, x in enumerate(odometer_m)]
        balises = balises_at({"V1": 110.0, "P1": place_m}, kind=KINDS)
        result = run(epochs_of(path_m, odometer_m), balises, ScriptedBank([20]), reads_at([(45.5, "P1")]))
        assert negations(result) == [(20, end)], (place_m, offset_m)


def test_without_a_vehicle_file_only_a_telegram_returns_a_position() -> None:
    epochs, balises = epochs_of(steps(0.0, 20.0, 90)), balises_at(V1_P1, kind=KINDS)
    for reads, end in ((None, None), (reads_at([(70.5, "P1")]), 71), (reads_at([(45.5, "P1")]), None)):
        result = run(epochs, balises, ScriptedBank([20]), reads, scale_sigma=None)
        assert negations(result) == [(20, end)]


def test_the_switch_forbids_every_return() -> None:
    balises = balises_at(V1_P1, kind=KINDS)
    result = run(epochs_of(steps(0.0, 20.0, 90)), balises, ScriptedBank([20]), reads_at([(70.5, "P1")]), relink=False)
    assert negations(result) == [(20, None)]


def test_no_return_through_a_lost_odometer_distance() -> None:
    # 40 m off since 40 s; at 50 s the odometer loses 40 m of its way, so that the two agree again.
    true_m = steps(0.0, 20.0, 160)
    path_m = [x - (40.0 if k >= 40 else 0.0) for k, x in enumerate(true_m)]
    odometer_m = [x - (40.0 if k >= 50 else 0.0) for k, x in enumerate(true_m)]
    epochs = epochs_of(path_m, odometer_m, doubt_m=[LOST_M * (k >= 50) for k in range(160)])
    assert negations(run(epochs, balises_at(V1), ScriptedBank([40])))[0] == (40, None)


def test_at_a_configured_start_of_mission_the_lds_begins_anew() -> None:
    """Negated since 20 s, 45 m off; the mission begins at 60 s, and ten consistent seconds later there is a TVB."""
    odometer_m = steps(0.0, 20.0, 90)
    path_m = [x + (45.0 if k >= 20 else 0.0) for k, x in enumerate(odometer_m)]
    start = datetime.fromtimestamp(59.5, tz=UTC)
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([20]), starts_of_mission=(start,))
    assert negations(result) == [(20, 60)]
    assert result.epochs["lds_mode"][60:72].to_list() == ["initialising"] * 11 + ["linked"]
    assert result.epochs["lrvb_id"][59:61].to_list() == ["V1", None]


def test_the_anchor_is_the_first_tvb_however_old() -> None:
    """0.02 m/s from 50 s on, found at 600 s with 11 m: at 630 s 11.6 m from the first TVB, 9.6 m from that at 150 s."""
    odometer_m = steps(0.0, 20.0, 640)
    path_m = [x + 0.02 * max(k - 50, 0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([600], fast=[]))
    assert negations(result) == [(600, None)]


# Held after a return, for the memory of the slowest average


@pytest.mark.parametrize(("drift_mps", "again"), [(0.2, 80), (0.0, None)])
def test_a_drift_that_goes_on_after_a_return_is_negated_again(drift_mps: float, again: int | None) -> None:
    """First TVB at 7 s, alarm at 20 s, return at 50 s with 2 m; at 80 s 8 m are beyond k_T sqrt(2.2 m2) = 7.9 m."""
    odometer_m = steps(0.0, 20.0, 120)
    path_m = [x + drift_mps * max(k - 40, 0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1), ScriptedBank([20]))
    assert negations(result)[:2] == [(20, 50), *([(again, None)] if again else [])]
    assert result.epochs["alarm"][again or 80] is (again is not None)


@pytest.mark.parametrize(("ahead_m", "again"), [(0.0, 78), (6.0, 109)])
def test_a_telegram_renews_what_a_position_is_held_to_after_a_return(ahead_m: float, again: int) -> None:
    """The telegram at 70.5 s lies where the train is, or where the position is, 6 m ahead; bounds are 7.5 and 7.7 m."""
    odometer_m = steps(0.0, 20.0, 120)
    path_m = [x + 0.2 * max(k - 40, 0) for k, x in enumerate(odometer_m)]
    balises = balises_at({"V1": 110.0, "P1": 1410.0 + ahead_m}, kind=KINDS)
    result = run(epochs_of(path_m, odometer_m), balises, ScriptedBank([20]), reads_at([(70.5, "P1")]))
    assert negations(result) == [(20, 50), (again, None)]


# After an outage

BEFORE = 21  # epochs 0 to 20 s


def outage(gap_s: float, offset_m: float, **settings: Any) -> LdsTables:
    """No epochs for `gap_s` after 20 s; from its end on the position is off, and the bank has begun anew."""
    t_s = [*map(float, range(BEFORE)), *(20.0 + gap_s + k for k in range(60))]
    odometer_m = [20.0 * t for t in t_s]
    path_m = [x + (offset_m if k >= BEFORE else 0.0) for k, x in enumerate(odometer_m)]
    places = {"V1": 110.0, "V2": 20.0 * (gap_s + 40.0)}
    lost = settings.pop("lost", False)
    columns = {"doubt_m": [LOST_M * (lost and k >= BEFORE) for k in range(len(t_s))]}
    balises = settings.pop("balises", balises_at(places))
    return run(epochs_of(path_m, odometer_m, t_s, **columns), balises, ScriptedBank(blind=[BEFORE]), **settings)


@pytest.mark.parametrize("gap_s", [70.0, 90.0, 300.0])
def test_a_position_after_an_outage_has_to_re_link(gap_s: float) -> None:
    # The last TVB is at 20 s.
    waited_s = gap_s
    travelled_m = 20.0 * waited_s
    bound_m = min(10.0, K_T * sqrt(2.0 + 0.05**2 * waited_s + (1e-4 * travelled_m) ** 2))
    for offset_m, state in ((0.0, "pass"), (bound_m - 0.01, "pass"), (-bound_m - 0.01, "fail"), (30.0, "fail")):
        result = outage(gap_s, offset_m)
        row = result.epochs.row(BEFORE, named=True)
        assert (row["link_distance_state"], row["alarm"]) == (state, state == "fail")
        assert row["link_distance_value"] == pytest.approx(offset_m)
        assert row["link_distance_threshold"] == pytest.approx(bound_m)
        assert [first for first, _ in negations(result)] == ([BEFORE] if state == "fail" else [])
        # 30 m lie well inside the window of V2, 5 m + 5 % of its way: linking alone would accept it.
        expected = "rejected_monitor" if state == "fail" else "accepted"
        assert passage_rows(result, "balise_id", "status")[1] == ("V2", expected)


def test_over_a_gap_that_the_bank_bridges_its_increment_decides() -> None:
    row = outage(59.0, 8.0).epochs.row(BEFORE, named=True)
    assert (row["link_distance_state"], row["link_distance_threshold"] > 50.0) == ("pass", True)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"scale_sigma": None}, NotEvaluated.RELINK_NO_VEHICLE),
        ({"lost": True}, NotEvaluated.RELINK_DISTANCE_LOST),
        ({"relink": False}, NotEvaluated.RELINK_OFF),
    ],
)
def test_what_cannot_re_link_after_an_outage_is_not_used_and_raises_no_alarm(
    settings: dict[str, Any], reason: str
) -> None:
    result = outage(90.0, 0.0, **settings)
    row = result.epochs.row(BEFORE, named=True)
    assert (row["link_distance_state"], row["link_distance_reason"]) == ("not_evaluated", reason)
    assert negations(result) == []
    assert set(result.epochs["withheld_for"][BEFORE:]) == {"relink"}
    assert not result.epochs["alarm"].any()
    assert not result.epochs["tvb"][BEFORE:].any()


def test_a_telegram_after_an_outage_returns_the_position_without_a_vehicle_file() -> None:
    # P1 is read at 145.5 s, 35 s after the outage.
    balises = balises_at({"V1": 110.0, "P1": 2910.0}, kind=KINDS)
    result = outage(90.0, 0.0, balises=balises, reads=reads_at([(145.5, "P1")]), scale_sigma=None)
    withheld = result.epochs["withheld_for"].is_not_null().to_list()
    assert withheld[BEFORE:] == [k < BEFORE + 36 for k in range(BEFORE, len(withheld))]


def test_a_place_in_doubt_for_minutes_is_no_outage() -> None:
    """A stand on a switch without a vehicle file: the bank watched on, so that the position need not re-link."""
    odometer_m = [*steps(0.0, 20.0, 21), *[400.0] * 100, *steps(420.0, 20.0, 40)]
    doubt = [0.5 if 21 <= k < 121 else 1.0 for k in range(len(odometer_m))]
    balises = balises_at({"V1": 110.0, "V2": 700.0})
    result = run(epochs_of(odometer_m, gate_probability=doubt), balises, scale_sigma=None)
    assert negations(result) == []
    assert passage_rows(result, "status") == [("accepted",), ("accepted",)]
    assert result.epochs["tvb"][121:].all()


@pytest.mark.parametrize(("noise_s", "offset_m", "negated"), [(90, 0.0, False), (90, 30.0, True), (60, 0.0, False)])
def test_a_position_after_noise_too_large_has_to_re_link(noise_s: int, offset_m: float, negated: bool) -> None:
    """Nobody could look on in the noise: a step of 30 m inside it came back into use without an alarm."""
    end = BEFORE + noise_s
    odometer_m = steps(0.0, 20.0, end + 60)
    path_m = [x + (offset_m if k >= BEFORE + 10 else 0.0) for k, x in enumerate(odometer_m)]
    balises = balises_at({"V1": 110.0, "V2": 20.0 * (end + 40.0)})
    result = run(epochs_of(path_m, odometer_m), balises, ScriptedBank(unknown=range(BEFORE, end)))
    assert negations(result) == ([(end, None)] if negated else [])
    assert result.epochs["alarm"][end] == negated
    assert passage_rows(result, "status")[1] == ("rejected_monitor" if negated else "accepted",)


def test_noise_without_a_vehicle_file_ends_the_use_as_an_outage_does() -> None:
    end = BEFORE + 90
    result = run(
        epochs_of(steps(0.0, 20.0, end + 60)),
        balises_at({"V1": 110.0}),
        ScriptedBank(unknown=range(BEFORE, end)),
        scale_sigma=None,
    )
    assert set(result.epochs["withheld_for"][end:]) == {"relink"}
    assert result.epochs["link_distance_reason"][end] == NotEvaluated.RELINK_NO_VEHICLE


@pytest.mark.parametrize(("offset_m", "withheld"), [(40.0, {"relink"}), (0.0, {None})])
def test_without_the_monitor_the_re_link_decides_without_an_alarm(offset_m: float, withheld: set[str | None]) -> None:
    result = outage(90.0, offset_m, disabled=["link_distance"])
    assert negations(result) == []
    assert set(result.epochs["withheld_for"][BEFORE:]) == withheld


@pytest.mark.parametrize(("drift_mps", "again"), [(0.3, True), (0.0, False)])
def test_a_position_is_held_after_an_outage_too(drift_mps: float, again: bool) -> None:
    """Back at 110 s on its place, then a drift that no average sees: 28 s later 8.2 m off the last TVB."""
    t_s = [*map(float, range(BEFORE)), *(110.0 + k for k in range(60))]
    odometer_m = [20.0 * t for t in t_s]
    path_m = [x + drift_mps * max(t - 110.0, 0.0) for t, x in zip(t_s, odometer_m, strict=True)]
    result = run(epochs_of(path_m, odometer_m, t_s), balises_at(V1), ScriptedBank())
    assert [first - BEFORE for first, _ in negations(result)] == ([28] if again else [])


@pytest.mark.parametrize(("read_s", "moved_m"), [(26.0, 0.0), (17.0, 180.0)])
def test_a_telegram_inside_an_outage_is_what_the_position_after_it_is_held_against(
    read_s: float, moved_m: float
) -> None:
    """Ten epochs at 20 m/s, none from 5 s to 94 s; P1 at 520 m is passed at 26 s, or was stamped 9 s early."""
    t_s = [0.0, 1.0, 2.0, 3.0, 4.0, 95.0, 96.0, 97.0, 98.0, 99.0]
    path_m: list[float | None] = [20.0 * at_s for at_s in t_s]
    balises = balises_at({"V1": 10.0, "P1": 520.0}, kind=KINDS)
    result = run(epochs_of(path_m, t_s=t_s), balises, reads=reads_at([(read_s, "P1")]))
    value, threshold, state = result.epochs.select("^link_distance_(value|threshold|state)$").row(5)
    assert abs(value) == pytest.approx(moved_m)
    # Sigma 1 m of position and read; the time and the way since the telegram.
    since_s = 95.0 - read_s
    assert threshold == pytest.approx(min(10.0, K_T * sqrt(2.0 + 0.05**2 * since_s + (1e-4 * 20.0 * since_s) ** 2)))
    assert (state, negations(result)) == (("pass", []) if moved_m == 0.0 else ("fail", [(5, None)]))
