"""Linking case by case (SUBSET-026 3.4.4.4.3, 3.16.2.3.1, 3.16.2.7), on telegrams of physical balises.

The train runs 20 m a second from odometer 0. P1 lies at 100 m, P2 at 500 m, P3 at 900 m. From P1 the
window of P2 (D = 400 m) is 371/1.05 = 353.3 to 429/0.95 = 451.6 m of odometer distance, that of P3
(D = 800 m) 771/1.05 = 734.3 to 829/0.95 = 872.6 m. From P2 the window of P3 is 353.3 to 451.6 m.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.stages.lds.scripted import balises_at, epochs_of, passage_rows, reads_at, run, steps

PLACES = {"P1": 100.0, "P2": 500.0, "P3": 900.0}
COLUMNS = ("balise_id", "status", "t_offered", "linking_error", "reaction")


def passages(reads: list[tuple[float, str]], **columns: Any) -> list[tuple[Any, ...]]:
    epochs = epochs_of(steps(0.0, 20.0, 60))
    result = run(epochs, balises_at(PLACES, kind="physical", **columns), reads=reads_at(reads))
    return passage_rows(result, *COLUMNS)


def test_each_found_in_its_window() -> None:
    assert passages([(5, "P1"), (25, "P2"), (45, "P3")]) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "accepted", 25, "none", "none"),
        ("P3", "accepted", 45, "none", "none"),
    ]


def test_window_columns_are_odometer_distances_from_the_last_balise() -> None:
    result = run(
        epochs_of(steps(0.0, 20.0, 60)),
        balises_at(PLACES, kind="physical"),
        reads=reads_at([(5, "P1"), (25, "P2")]),
    )
    first, second, _ = result.passages.select("window_open_m", "window_close_m", "odometer_distance_m").rows()
    assert first == (None, None, None)
    assert second == pytest.approx((353.333, 451.579, 400.0), abs=1e-3)


@pytest.mark.parametrize(
    ("t_s", "status", "error"),
    [
        (22.5, "rejected_window", "early"),  # 350 m
        (22.7, "accepted", "none"),  # 354 m
        (27.5, "accepted", "none"),  # 450 m
        (27.7, "rejected_window", "missed"),  # 454 m
    ],
)
def test_borders_of_the_window(t_s: float, status: str, error: str) -> None:
    rows = passages([(5, "P1"), (t_s, "P2"), (45, "P3")])
    assert rows[1] == ("P2", status, t_s, error, "none" if error == "none" else "service_brake")


def test_early_is_rejected_and_the_balise_stays_expected() -> None:
    # Found at 340 m; P3 is then measured from P1 still: 800 m.
    assert passages([(5, "P1"), (22, "P2"), (45, "P3")]) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "rejected_window", 22, "early", "service_brake"),
        ("P3", "accepted", 45, "none", "none"),
    ]


def test_early_and_found_again_inside_the_window_are_two_rows() -> None:
    assert passages([(5, "P1"), (22, "P2"), (25, "P2")])[:3] == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "rejected_window", 22, "early", "service_brake"),
        ("P2", "accepted", 25, "none", "none"),
    ]


def test_not_found_has_one_row_with_the_reaction_of_that_balise() -> None:
    assert passages([(5, "P1"), (45, "P3")], link_reaction=["none", "trip", "none"]) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "missed", None, "missed", "trip"),
        ("P3", "accepted", 45, "none", "none"),
    ]


def test_found_after_its_window_is_the_same_passage_rejected() -> None:
    # 480 m: the window closed at 451.6 m, where the balise was missed.
    assert passages([(5, "P1"), (29, "P2"), (45, "P3")])[1] == (
        "P2",
        "rejected_window",
        29,
        "missed",
        "service_brake",
    )


def test_second_in_a_row_brakes_whatever_its_own_reaction() -> None:
    assert passages([(5, "P1")], link_reaction="none") == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "missed", None, "missed", "none"),
        ("P3", "missed", None, "missed", "service_brake"),
    ]


def test_one_accepted_between_breaks_the_row() -> None:
    places = {"P1": 100.0, "P2": 300.0, "P3": 600.0, "P4": 900.0}
    epochs = epochs_of(steps(0.0, 20.0, 70))
    balises = balises_at(places, kind="physical", link_reaction="none")
    result = run(epochs, balises, reads=reads_at([(5, "P1"), (30, "P3")]))
    assert passage_rows(result, "balise_id", "status", "reaction") == [
        ("P1", "accepted", "none"),
        ("P2", "missed", "none"),
        ("P3", "accepted", "none"),
        ("P4", "missed", "none"),
    ]


def test_later_announced_inside_the_window_takes_the_reaction_of_the_expected() -> None:
    # P3 follows P2 by 40 m only; it is found at 440 m, inside the window of P2.
    epochs = epochs_of(steps(0.0, 20.0, 60))
    balises = balises_at(
        {"P1": 100.0, "P2": 500.0, "P3": 540.0}, kind="physical", link_reaction=["none", "trip", "none"]
    )
    result = run(epochs, balises, reads=reads_at([(5, "P1"), (27, "P3")]))
    assert passage_rows(result, *COLUMNS) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "missed", None, "missed", "trip"),
        ("P3", "rejected_window", 27, "order", "trip"),
    ]


def test_later_announced_before_any_window_is_early() -> None:
    assert passages([(5, "P1"), (15, "P3"), (25, "P2"), (45, "P3")]) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P3", "rejected_window", 15, "early", "service_brake"),
        ("P2", "accepted", 25, "none", "none"),
        ("P3", "accepted", 45, "none", "none"),
    ]


def test_not_announced_is_rejected_without_reaction_once_linking_holds() -> None:
    assert passages([(5, "P1"), (25, "P2"), (45, "P3")], linked=[True, False, True]) == [
        ("P1", "accepted", 5, "none", "none"),
        ("P2", "rejected_unlinked", 25, "none", "none"),
        ("P3", "accepted", 45, "none", "none"),
    ]


def test_not_announced_is_never_missed() -> None:
    rows = passages([(5, "P1"), (45, "P3")], linked=[True, False, True])
    assert [row[0] for row in rows] == ["P1", "P3"]


def test_before_linking_every_balise_counts() -> None:
    rows = passages([(5, "P1"), (25, "P2"), (45, "P3")], linked=[False, True, True])
    assert [row[1] for row in rows] == ["accepted", "accepted", "accepted"]


def test_one_passage_read_twice_is_one_row() -> None:
    assert [row[0] for row in passages([(5, "P1"), (5.2, "P1"), (25, "P2"), (45, "P3")])] == [
        "P1",
        "P2",
        "P3",
    ]


def test_falling_path_mirrors_growing_path() -> None:
    # From P3 at 900 m downwards; P2 comes 340 m after P3: early. P1 is 800 m from P3.
    epochs = epochs_of(steps(1000.0, -20.0, 60))
    balises = balises_at(PLACES, kind="physical")
    result = run(epochs, balises, reads=reads_at([(5, "P3"), (22, "P2"), (45, "P1")]))
    assert passage_rows(result, "balise_id", "direction", "status", "linking_error", "odometer_distance_m") == [
        ("P3", "falling", "accepted", "none", None),
        ("P2", "falling", "rejected_window", "early", pytest.approx(340.0)),
        ("P1", "falling", "accepted", "none", pytest.approx(800.0)),
    ]


def test_telegrams_of_balises_off_the_path_are_reported() -> None:
    result = run(
        epochs_of(steps(0.0, 20.0, 10)),
        balises_at(PLACES, kind="physical"),
        reads=reads_at([(3, "Q9"), (5, "P1")]),
    )
    assert result.unknown_reads["balise_id"].to_list() == ["Q9"]
    assert result.passages["balise_id"].to_list() == ["P1"]


def test_without_a_reader_physical_balises_have_no_passages() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(PLACES, kind="physical"))
    assert result.passages.is_empty()


def test_reader_goes_beside_the_position_and_both_are_reported() -> None:
    balises = balises_at(
        {"V1": 110.0, "P1": 110.0, "V2": 510.0, "P2": 510.0},
        kind=["virtual", "physical", "virtual", "physical"],
    )
    result = run(epochs_of(steps(0.0, 20.0, 40)), balises, reads=reads_at([(5.5, "P1"), (25.5, "P2")]))
    assert passage_rows(result, "balise_id", "kind", "status", "t_offered") == [
        ("P1", "physical", "accepted", 5.5),
        ("V1", "virtual", "accepted", 5.5),
        ("P2", "physical", "accepted", 25.5),
        ("V2", "virtual", "accepted", 25.5),
    ]
