"""The table of crossings: every crossing and every telegram once, and passages that join to it."""

from __future__ import annotations

import random

import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.stages.lds.scripted import LdsTables, ScriptedBank, balises_at, epochs_of, reads_at, run, steps
from tests.stages.lds.test_invariants import Chaos

V1 = {"V1": 110.0}
SECONDS = (pl.col("t").dt.epoch("ns") / 1e9).round(6)


def crossings(result: LdsTables, *columns: str) -> list[tuple[object, ...]]:
    return result.crossings.with_columns(t=SECONDS).select(columns).rows()


@given(seed=st.integers(0, 100_000))
@settings(max_examples=30, deadline=None)
def test_each_offer_is_one_crossing_and_one_passage(seed: int) -> None:
    chaos = Chaos(seed)
    result = chaos.replayed()
    table = result.crossings
    assert table["crossing_id"].to_list() == list(range(table.height))
    assert table["t"].is_sorted()
    joined = result.passages.join(table, on="crossing_id", how="left", suffix="_of_crossing")
    assert joined["crossing_id"].is_null().equals(joined["t_offered"].is_null())
    offers = joined.drop_nulls("crossing_id")
    for column in ("balise_id", "kind", "path_m", "status"):
        assert offers[column].to_list() == offers[f"{column}_of_crossing"].to_list(), column
    assert offers["t_offered"].equals(offers["t"], check_names=False)
    assert sorted(offers["crossing_id"]) == table.filter("offered")["crossing_id"].to_list()
    known = {f"P{i:02d}" for i in range(5)}
    assert table.filter(pl.col("kind") == "physical").height == sum(name in known for _, name in chaos.reads)


@given(seed=st.integers(0, 100_000))
@settings(max_examples=30, deadline=None)
def test_a_crossing_lies_between_its_epochs(seed: int) -> None:
    chaos = Chaos(seed)
    result = chaos.replayed()
    at = result.epochs["t"]
    for row in result.crossings.filter(pl.col("kind") == "virtual").iter_rows(named=True):
        assert row["before"] < row["epoch"]
        assert at[row["before"]] <= row["t"] <= at[row["epoch"]]
        ends_m = chaos.path_m[row["before"]], chaos.path_m[row["epoch"]]
        assert ends_m[0] is not None
        assert ends_m[1] is not None
        assert (row["sense"] > 0) == (ends_m[1] > ends_m[0])
        assert min(ends_m) <= row["path_m"] <= max(ends_m)


def test_a_crossing_is_interpolated_and_says_what_became_of_it() -> None:
    epochs = epochs_of(steps(0.0, 20.0, 40), steps(2.0, 20.0, 40))
    result = run(epochs, balises_at({"V1": 110.0, "V2": 515.0}), ScriptedBank([26]))
    columns = ("crossing_id", "balise_id", "before", "epoch", "t", "sense", "direction", "odometer_m", "status")
    assert crossings(result, *columns) == [
        (0, "V1", 5, 6, 5.5, 1, 1, 112.0, "accepted"),
        (1, "V2", 25, 26, 25.75, 1, 1, 517.0, "rejected_monitor"),
    ]


def test_a_telegram_is_a_crossing_at_its_own_time() -> None:
    balises = balises_at({"V1": 110.0, "P1": 112.0}, kind=["virtual", "physical"])
    result = run(epochs_of(steps(0.0, 20.0, 12)), balises, reads=reads_at([(5.6, "P1"), (5.7, "P1")]))
    assert crossings(result, "balise_id", "kind", "t", "before", "epoch", "offered", "status") == [
        ("V1", "virtual", 5.5, 5, 6, True, "accepted"),
        ("P1", "physical", 5.6, 5, 6, True, "accepted"),
        ("P1", "physical", 5.7, 5, 6, False, None),
    ]


def test_noise_at_standstill_crosses_often_and_offers_once() -> None:
    noise = random.Random(7)
    at_m = [*steps(90.0, 2.0, 10), *[110.0] * 300, *steps(111.0, 2.0, 20)]
    path_m = [value + noise.gauss(0.0, 1.0) for value in at_m]
    result = run(epochs_of(path_m, at_m, t_s=[0.1 * k for k in range(len(at_m))]), balises_at(V1))
    assert result.crossings.height > 100
    assert result.crossings["offered"].sum() == 1
    assert result.crossings["status"].drop_nulls().to_list() == ["accepted"]
    assert result.passages["crossing_id"].to_list() == [0]


def test_crossings_in_gaps_off_track_and_out_of_ambiguity_are_in_the_table() -> None:
    path_m = steps(0.0, 20.0, 40)
    balises = balises_at({"V1": 110.0, "V2": 510.0})
    holes = [None if 24 <= k <= 27 else x for k, x in enumerate(path_m)]
    for columns, status, offered in (
        ({}, "not_available", False),
        ({"fix_valid": [True] * 40}, "rejected_ambiguous", False),
    ):
        result = run(epochs_of(holes, path_m, **columns), balises)
        assert crossings(result, "balise_id", "before", "epoch", "t", "offered", "status")[1] == (
            "V2",
            23,
            28,
            28.0,
            offered,
            status,
        )
        assert result.passages["crossing_id"].to_list() == [0, None]
    for column in (
        {"on_track": [k != 25 for k in range(40)]},
        {"gate_probability": [0.5 * (k > 25) for k in range(40)]},
    ):
        result = run(epochs_of(path_m, **column), balises)
        assert crossings(result, "balise_id", "offered", "status")[1] == ("V2", True, "rejected_ambiguous")


def test_direction_is_the_train_s_and_sense_the_position_s() -> None:
    # The train goes on, the position jumps back over V1 at 10 s.
    odometer_m = steps(0.0, 20.0, 30)
    path_m = [x - (120.0 if k >= 10 else 0.0) for k, x in enumerate(odometer_m)]
    result = run(epochs_of(path_m, odometer_m), balises_at(V1))
    assert crossings(result, "sense", "direction") == [(1, 1), (-1, 1), (1, 1)]


def test_of_a_balise_with_several_places_the_odometer_says_which_was_read() -> None:
    """A loop of 1000 m run twice; the position has jumped a lap ahead before the second reading of P1 and P2."""
    odometer_m = steps(0.0, 20.0, 90)
    path_m = [x + (1000.0 if 20 <= k < 30 else 0.0) for k, x in enumerate(odometer_m)]
    balises = pl.concat([balises_at({"P1": at_m, "P2": at_m + 400.0}, kind="physical") for at_m in (100.0, 1100.0)])
    reads = reads_at([(5, "P1"), (25, "P2"), (55, "P1"), (75, "P2")])
    result = run(epochs_of(path_m, odometer_m), balises, reads=reads)
    assert crossings(result, "balise_id", "path_m") == [("P1", 100.0), ("P2", 500.0), ("P1", 1100.0), ("P2", 1500.0)]
