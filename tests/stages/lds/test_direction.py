"""Virtual balises that are valid in one direction of travel (DOMAIN section 4): in the other they do not exist.

`valid_direction` of these tables is along growing path: +1, -1, or 0 for both.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.enums import Direction
from tests.stages.lds.scripted import LdsTables, ScriptedBank, balises_at, epochs_of, passage_rows, run, steps
from tests.stages.lds.test_invariants import Chaos

AHEAD, BACK, BOTH = 1, -1, 0
COLUMNS = ("balise_id", "direction", "status", "t_offered", "linking_error")
PLACES = {"V1": 110.0, "V2": 510.0, "V3": 910.0}


def shuttle() -> list[float]:
    """Ahead 1,000 m at 20 m/s, 10 s at the stop, and back to the start."""
    ahead = steps(0.0, 20.0, 51)
    return [*ahead, *[1000.0] * 10, *steps(980.0, -20.0, 50)]


def names(result: LdsTables, direction: Direction) -> list[str]:
    return [name for name, way, *_ in passage_rows(result, *COLUMNS) if way == direction.value]


def test_in_the_other_direction_a_balise_is_not_announced_not_offered_and_not_missed() -> None:
    result = run(epochs_of(steps(0.0, 20.0, 60)), balises_at(PLACES, valid_direction=[BOTH, BACK, AHEAD]))
    assert passage_rows(result, *COLUMNS) == [
        ("V1", "growing", "accepted", 5.5, "none"),
        ("V3", "growing", "accepted", 45.5, "none"),
    ]
    assert result.crossings["balise_id"].to_list() == ["V1", "V3"]
    # Its window is measured from V1: V2 was never announced.
    assert result.passages["window_open_m"].to_list()[1] == pytest.approx((800 - 29) / 1.05)


def test_a_shuttle_meets_on_its_way_back_what_it_did_not_on_its_way_out() -> None:
    result = run(epochs_of(shuttle()), balises_at(PLACES, valid_direction=[AHEAD, BACK, BOTH]))
    assert names(result, Direction.GROWING) == ["V1", "V3"]
    assert names(result, Direction.FALLING) == ["V3", "V2"]
    assert set(result.passages["status"]) == {"accepted"}
    assert set(result.passages["linking_error"]) == {"none"}


def test_a_balise_of_the_other_direction_is_not_missed_in_an_outage() -> None:
    path_m = [None if 400.0 < x < 700.0 else x for x in steps(0.0, 20.0, 60)]
    places = balises_at(PLACES, valid_direction=[BOTH, BACK, BOTH])
    assert [row[0] for row in passage_rows(run(epochs_of(path_m, steps(0.0, 20.0, 60)), places), *COLUMNS)] == [
        "V1",
        "V3",
    ]


@pytest.mark.parametrize("with_odometer", [True, False])
def test_a_jump_back_re_crosses_a_balise_in_the_direction_of_the_train(with_odometer: bool) -> None:
    """The position jumps 120 m back at 10 s, over V1 at 110 m, which is valid ahead only: the train goes on ahead."""
    chainage_m = steps(0.0, 20.0, 30)
    path_m = [x - (120.0 if k >= 10 else 0.0) for k, x in enumerate(chainage_m)]
    epochs = epochs_of(path_m, chainage_m if with_odometer else [None] * 30)
    ahead, both, back = (run(epochs, balises_at({"V1": 110.0}, valid_direction=valid)) for valid in (AHEAD, BOTH, BACK))
    assert passage_rows(ahead, *COLUMNS) == passage_rows(both, *COLUMNS)
    assert ahead.crossings["sense"].to_list() == [1, -1, 1]
    assert set(ahead.passages["direction"]) == {"growing"}
    assert back.passages.is_empty()


@pytest.mark.parametrize("beyond_m", [2.0, 8.0])
def test_who_turns_just_behind_a_balise_of_the_other_direction_misses_nothing(beyond_m: float) -> None:
    """A turn is known 5 m after it: whether the balise counts then or not, it is not missed and brakes nobody."""
    ahead = [*steps(0.0, 10.0, 51), 500.0 + beyond_m]
    chainage_m = [*ahead, *[500.0 + beyond_m] * 5, *steps(499.0, -10.0, 49)]
    result = run(epochs_of(chainage_m), balises_at({"V1": 100.0, "V2": 500.5}, valid_direction=[BOTH, BACK]))
    rows = passage_rows(result, *COLUMNS)
    assert all(status == "accepted" for _, _, status, _, _ in rows)
    assert ("V2", "growing") not in [row[:2] for row in rows]
    assert set(result.passages["reaction"]) == {"none"}


@given(seed=st.integers(0, 100_000))
@settings(max_examples=30, deadline=None)
def test_no_row_is_of_a_direction_in_which_its_balise_is_not_valid(seed: int) -> None:
    chaos = Chaos(seed)
    valid = {name: (seed // 7 + number) % 3 - 1 for number, name in enumerate(chaos.places) if name[0] == "V"}
    epochs = epochs_of(chaos.path_m, chaos.odometer_m, doubt_m=chaos.doubt_m)
    columns = {"kind": chaos.kinds, "valid_direction": [valid.get(name, 0) for name in chaos.places]}
    result = run(epochs, balises_at(chaos.places, **columns), ScriptedBank(chaos.fails, blind=chaos.blind))
    facing = {Direction.GROWING.value: 1, Direction.FALLING.value: -1}
    for name, direction, *_ in passage_rows(result, *COLUMNS):
        assert valid.get(name, 0) in (0, facing[direction])


@given(seed=st.integers(0, 100_000))
@settings(max_examples=15, deadline=None)
def test_a_balise_of_the_other_direction_changes_nothing_for_the_rest(seed: int) -> None:
    """Of a train that never turns, with and without them."""
    chaos = Chaos(seed)
    chainage_m = steps(-400.0, 20.0, len(chaos.path_m))
    path_m = [
        None if x is None else way + (x - o if o is not None else 0.0)
        for x, way, o in zip(chaos.path_m, chainage_m, chaos.odometer_m, strict=True)
    ]
    virtual = {name: at_m for name, at_m in chaos.places.items() if name[0] == "V"}
    some = dict(list(virtual.items())[::2])
    bank = {"fails": chaos.fails, "blind": chaos.blind}
    less = run(epochs_of(path_m, chainage_m), balises_at(some), ScriptedBank(**bank))
    valid = [BOTH if name in some else BACK for name in virtual]
    more = run(epochs_of(path_m, chainage_m), balises_at(virtual, valid_direction=valid), ScriptedBank(**bank))
    assert more.passages.equals(less.passages)
    assert more.epochs.equals(less.epochs)
