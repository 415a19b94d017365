"""The findings find: nothing on tables that tell the truth, and every kind of lie on tables that do not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import polars as pl
import pytest

from tests.judge.findings import Rung, findings, rung_of
from tests.judge.perfect import perfect
from tests.judge.random_worlds import random_journey

GONE = {"reference": (), "balise": ("reference",)}


@lru_cache(maxsize=8)
def _true(seed: int, name: str) -> Rung:
    return perfect(rung_of(random_journey(seed), name, GONE[name]), 0.4 if name == "reference" else 4.0)


def _told(rung: Rung) -> str:
    return "\n".join(findings(rung.journey, {rung.name: rung}))


def _epochs(rung: Rung, *columns: pl.Expr) -> Rung:
    return replace(rung, tables=replace(rung.tables, epochs=rung.tables.epochs.with_columns(*columns)))


def _runs(rung: Rung, **values: object) -> Rung:
    row = rung.tables.runs.with_columns(**{name: pl.lit(value) for name, value in values.items()})
    return replace(rung, tables=replace(rung.tables, runs=row))


@pytest.mark.parametrize("seed", [2, 9, 13, 25, 43, 48, 55, 57])
def test_the_truth_gives_no_findings(seed: int) -> None:
    rungs = {name: _true(seed, name) for name in GONE}
    assert findings(rungs["reference"].journey, rungs) == []


def test_a_wrong_position_called_right_is_found() -> None:
    assert "is beyond the limit" in _told(_epochs(_true(9, "reference"), pl.lit("right").alias("judgement")))


def test_a_right_position_called_wrong_is_found() -> None:
    assert "it is within the limit" in _told(_epochs(_true(9, "reference"), pl.lit("wrong").alias("judgement")))


def test_another_track_called_right_is_found() -> None:
    assert "is on another track" in _told(_epochs(_true(25, "reference"), pl.lit("right").alias("judgement")))


def test_unknown_is_no_way_out() -> None:
    told = _told(_epochs(_true(9, "reference"), pl.lit("unknown").alias("judgement")))
    assert "the reference shows it beyond" in told
    assert "the reference shows it within" in told


def test_an_interval_beside_the_truth_is_found() -> None:
    shifted = (pl.col("error_low_m") + 3.0, pl.col("error_high_m") + 3.0)
    assert "the interval is" in _told(_epochs(_true(2, "reference"), *shifted))


def test_a_weaker_rung_that_knows_better_is_found() -> None:
    strong, weak = _true(9, "reference"), _true(9, "balise")
    flipped = pl.col("judgement").replace_strict({"right": "unknown", "wrong": "right", "unknown": "unknown"})
    told = findings(strong.journey, {"reference": strong, "balise": _epochs(weak, flipped)})
    assert any("balise against reference" in text for text in told)


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        ("verdict", "safe", "of failure in use by truth"),
        ("hazardous_max_s", 0.0, "hazardous_max_s is"),
        ("failures", 0, "failures is"),
        ("unsafe_accepted", 77, "unsafe_accepted is"),
        ("share_unknown", 0.5, "share_unknown is"),
    ],
)
def test_a_sum_that_does_not_follow_is_found(column: str, value: object, text: str) -> None:
    rung = _true(_IN_USE, "reference")
    assert rung.number("hazardous_max_s") > 2.0, "no failure in use: nothing is tested"
    assert text in _told(_runs(rung, **{column: value}))


_IN_USE = 13


def test_a_false_accusation_is_found() -> None:
    rung = _true(44, "reference")
    assert np.abs(rung.epochs.error_m).max() < 19.0
    assert "nothing was wrong by truth" in _told(_runs(rung, verdict="unsafe"))
