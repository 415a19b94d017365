"""Positions withheld: noise not known, slip by the odometer's own word, a bank that has just begun (DOMAIN 5.2).

One epoch a second at 20 m/s; V1 is crossed at 5.5 s, the first TVB is at 7 s.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import pytest

from tests.stages.lds.scripted import (
    LdsTables,
    ScriptedBank,
    balises_at,
    epochs_of,
    negations,
    passage_rows,
    reads_at,
    run,
    steps,
)
from tests.stages.lds.test_modes import changes

BEGIN, END = 20, 30  # slip from 20 s on, up to 30 s
V = {"V1": 110.0, "V2": 490.0, "V3": 1410.0}


def slipping(
    offset_m: float, doubt_m: float = 5.0, slipped_m: float = 0.0, later: dict[int, float] | None = None, **given: Any
) -> LdsTables:
    """Slip from 20 to 30 s, in which the odometer counts `slipped_m` too much and is in doubt by `doubt_m`.

    The position is off by `offset_m` from 25 s on; `later`: off by so much from these epochs on.
    """
    count = 90
    offsets = {25: offset_m} | (later or {})
    path_m = [
        x + next((off for k0, off in sorted(offsets.items(), reverse=True) if k >= k0), 0.0)
        for k, x in enumerate(steps(0.0, 20.0, count))
    ]
    slips = [BEGIN <= k < END for k in range(count)]
    odometer_m = [
        None if slips[k] else x + (slipped_m if k >= END else 0.0) for k, x in enumerate(steps(0.0, 20.0, count))
    ]
    columns: dict[str, Any] = {
        "odometer_slips": slips,
        "doubt_m": [max(1e-9 * min(max(k - BEGIN + 1, 0), END - BEGIN), doubt_m * (k >= END)) for k in range(count)],
    }
    bank = ScriptedBank(blind=range(BEGIN, END + 1), begins=[END], **given.pop("bank", {}))
    return run(epochs_of(path_m, odometer_m, **columns), balises_at(V), bank, **given)


def test_before_the_noise_is_known_nothing_is_accepted_and_no_diagnosis_is_missing() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 90)), balises_at(V), ScriptedBank(unknown=range(30)))
    assert changes(result, "withheld_for") == [(0, "noise"), (30, None)]
    assert passage_rows(result, "balise_id", "status") == [
        ("V1", "rejected_monitor"),
        ("V2", "rejected_monitor"),
        ("V3", "accepted"),
    ]
    assert not result.epochs["diagnosis_faulty"].any()
    # Ten consistent seconds count from where the noise is known.
    assert changes(result, "tvb") == [(0, False), (40, True)]


def test_noise_that_is_no_longer_known_withholds_again() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(V), ScriptedBank(unknown=range(40, 45)))
    assert changes(result, "withheld_for") == [(0, "relink"), (1, None), (40, "noise"), (45, None)]
    assert not result.epochs["tvb"][40:45].any()
    assert result.epochs["tvb"][45]


def test_slip_costs_its_own_time_and_no_more() -> None:
    result = slipping(0.0)
    assert changes(result, "withheld_for") == [(0, "relink"), (1, None), (20, "slip"), (30, "relink"), (31, None)]
    assert changes(result, "tvb") == [(0, False), (7, True), (20, False), (31, True)]
    assert changes(result, "lds_mode") == [(0, "initialising"), (6, "linked"), (20, "odometry"), (31, "linked")]
    assert not result.epochs["diagnosis_faulty"].any()
    assert negations(result) == []
    assert passage_rows(result, "balise_id", "status") == [
        ("V1", "accepted"),
        ("V2", "rejected_monitor"),
        ("V3", "accepted"),
    ]


@pytest.mark.parametrize("offset_m", [30.0, -30.0, 10.1, -10.1])
def test_a_fault_during_slip_does_not_get_through(offset_m: float) -> None:
    """Noise allows for 7.6 m, slip for 5 m; half the failure limit is the most."""
    result = slipping(offset_m)
    assert set(result.epochs["withheld_for"][30:]) == {"relink"}
    assert passage_rows(result, "balise_id", "status")[2] == ("V3", "rejected_monitor")
    assert not result.epochs["alarm"].any()


@pytest.mark.parametrize(("doubt_m", "moved_m"), [(0.0, 7.5), (1.0, 8.5), (5.0, 9.9), (10.0, 9.9)])
def test_what_slip_explains_is_no_fault(doubt_m: float, moved_m: float) -> None:
    """The first TVB is the anchor, 23 s before: 5.33 sqrt(2 m2 + 0.0025 m2/s t) = 7.6 m."""
    assert slipping(0.0, doubt_m, slipped_m=moved_m).epochs["withheld_for"][31] is None
    if doubt_m < 5.0:
        assert slipping(0.0, doubt_m, slipped_m=moved_m + 0.2).epochs["withheld_for"][31] == "relink"


def test_a_fault_right_after_slip_is_the_banks() -> None:
    result = slipping(0.0, later={31: 30.0}, bank={"fails": [31]})
    assert negations(result) == [(31, None)]


def test_where_slip_may_hide_a_failure_nothing_links_again() -> None:
    """12 m counted too much and a position 12 m ahead agree; with 10.1 m in doubt they might be 20.1 m."""
    assert set(slipping(12.0, 10.1, slipped_m=12.0).epochs["withheld_for"][30:]) == {"relink"}
    result = slipping(12.0, 9.9, slipped_m=12.0)
    assert result.epochs["withheld_for"][31] is None
    assert result.held[-1].bound_m == pytest.approx(19.9)


@pytest.mark.parametrize("later_s", [0, 1020])
def test_slips_add_up_since_the_first_tvb(later_s: int) -> None:
    """An alarm at 8 s, held from 38 s for 1000 s; in it and later 12 m of slip are more than a re-link may explain."""
    count = later_s + 200
    slips = [k >= later_s and (k - later_s) % 60 in range(40, 50) for k in range(count)]
    counted_m = [6.0 * sum(k >= later_s + 60 * leg + 50 for leg in range(3)) for k in range(count)]
    odometer_m = [None if slips[k] else x + counted_m[k] for k, x in enumerate(steps(0.0, 20.0, count))]
    epochs = epochs_of(
        steps(0.0, 20.0, count),
        odometer_m,
        odometer_slips=slips,
        doubt_m=[1e-9 * slipped + more_m for slipped, more_m in zip(accumulate(slips), counted_m, strict=True)],
    )
    result = run(epochs, balises_at(V), ScriptedBank([8]))
    assert negations(result) == [(8, 38)]
    assert [result.epochs["withheld_for"][later_s + k] for k in (51, 111, 171)] == [None, "relink", "relink"]


def test_a_position_that_comes_back_after_slip_links_again() -> None:
    result = slipping(30.0, later={50: 0.0})
    assert changes(result, "withheld_for")[-2:] == [(30, "relink"), (50, None)]


def test_without_a_vehicle_file_only_a_telegram_ends_the_wait() -> None:
    assert set(slipping(0.0, scale_sigma=None).epochs["withheld_for"][30:]) == {"relink"}
    balises = balises_at(V | {"P1": 1000.0}, kind=["virtual"] * 3 + ["physical"])
    path_m, count = steps(0.0, 20.0, 90), 90
    slips = [BEGIN <= k < END for k in range(count)]
    epochs = epochs_of(
        path_m,
        [None if slip else x for slip, x in zip(slips, path_m, strict=True)],
        odometer_slips=slips,
        doubt_m=[1e-9 * min(max(k - BEGIN + 1, 0), END - BEGIN) + 500.0 * (k >= END) for k in range(count)],
    )
    bank = ScriptedBank(blind=range(BEGIN, END + 1), begins=[END])
    result = run(epochs, balises, bank, reads_at([(50.0, "P1")]), scale_sigma=None)
    assert changes(result, "withheld_for")[-2:] == [(30, "relink"), (50, None)]


def test_slip_before_anything_was_validated_needs_no_re_link() -> None:
    slips = [k < 4 for k in range(40)]
    path_m = steps(0.0, 20.0, 40)
    odometer_m = [None if k < 4 else x for k, x in enumerate(path_m)]
    bank = ScriptedBank(blind=range(5), begins=[4])
    result = run(epochs_of(path_m, odometer_m, odometer_slips=slips), balises_at(V), bank)
    assert changes(result, "withheld_for") == [(0, "slip"), (4, "relink"), (5, None)]
    assert passage_rows(result, "balise_id", "status")[0] == ("V1", "accepted")


def test_the_first_epoch_after_a_restart_accepts_nothing() -> None:
    """V2 is crossed at 24.5 s; the bank begins anew at 25 s."""
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(V), ScriptedBank(blind=[25], begins=[25]))
    assert passage_rows(result, "balise_id", "status")[1] == ("V2", "rejected_monitor")
    assert changes(result, "withheld_for")[-2:] == [(25, "relink"), (26, None)]
    assert not result.epochs["diagnosis_faulty"].any()


def test_an_acceptance_before_anything_was_validated_is_initialising() -> None:
    """V1 at 5.5 s comes before the first TVB; a V1 after ten consistent seconds does not."""
    early = run(epochs_of(steps(0.0, 20.0, 40)), balises_at({"V1": 110.0, "V2": 490.0}))
    assert passage_rows(early, "balise_id", "initialising") == [("V1", True), ("V2", False)]
    late = run(epochs_of(steps(0.0, 20.0, 40)), balises_at({"V1": 310.0}))
    assert passage_rows(late, "balise_id", "status", "initialising") == [("V1", "accepted", False)]
