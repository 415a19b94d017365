"""The findings find: nothing on tables that tell the truth, and every kind of lie on tables that do not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import polars as pl
import pytest

from tests.stages.judge.faults import Fault
from tests.stages.judge.findings import Rung, findings, rung_of
from tests.stages.judge.ground import make_ground
from tests.stages.judge.perfect import perfect
from tests.stages.judge.ride import Leg
from tests.stages.judge.sensors import Receiver
from tests.stages.judge.world import World, make_journey

GONE: dict[str, tuple[str, ...]] = {"reference": (), "balise": ("reference",)}
LEGS = (Leg(0.0, 10.0), Leg(30.0, 180.0), Leg(0.0, 10.0))
LINE = World(make_ground(16000.0, bend_deg=4.0), LEGS)
PARALLEL = World(make_ground(16000.0, neighbour=(1500.0, 6000.0, 20.0)), LEGS)
WORLDS = {
    "clean": LINE,
    "step": replace(LINE, receiver=Receiver(faults=(Fault("step", 100.0, 130.0, size_m=45.0),))),
    "late": replace(LINE, receiver=Receiver(faults=(Fault("latency", 0.0, 1e9, size_s=1.0),)), vehicle=None),
    "other_track": replace(PARALLEL, receiver=Receiver(faults=(Fault("other_track", 0.0, 1e9),))),
}


@lru_cache(maxsize=16)
def _true(world: str, name: str) -> Rung:
    journey = make_journey(WORLDS[world], 3, world)
    return perfect(rung_of(journey, name, GONE[name]), 0.4 if name == "reference" else 4.0)


def _breaches_of(rung: Rung) -> str:
    return "\n".join(findings(rung.journey, {rung.name: rung}))


def _epochs(rung: Rung, *columns: pl.Expr) -> Rung:
    return replace(rung, tables=replace(rung.tables, epochs=rung.tables.epochs.with_columns(*columns)))


def _runs(rung: Rung, **values: object) -> Rung:
    row = rung.tables.runs.with_columns(**{name: pl.lit(value) for name, value in values.items()})
    return replace(rung, tables=replace(rung.tables, runs=row))


@pytest.mark.parametrize("world", WORLDS)
def test_the_truth_gives_no_findings(world: str) -> None:
    rungs = {name: _true(world, name) for name in GONE}
    assert findings(rungs["reference"].journey, rungs) == []


def test_a_wrong_position_called_right_is_found() -> None:
    assert "is beyond the limit" in _breaches_of(
        _epochs(_true("step", "reference"), pl.lit("right").alias("judgement"))
    )


def test_a_right_position_called_wrong_is_found() -> None:
    assert "it is within the limit" in _breaches_of(
        _epochs(_true("step", "reference"), pl.lit("wrong").alias("judgement"))
    )


def test_another_track_called_right_is_found() -> None:
    assert _true("other_track", "reference").epochs.beside.sum() > 50, "no position is matched there: nothing is tested"
    assert "is on another track" in _breaches_of(
        _epochs(_true("other_track", "reference"), pl.lit("right").alias("judgement"))
    )


def test_unknown_is_no_way_out() -> None:
    breaches = _breaches_of(_epochs(_true("step", "reference"), pl.lit("unknown").alias("judgement")))
    assert "the reference shows it beyond" in breaches
    assert "the reference shows it within" in breaches


def test_an_interval_beside_the_truth_is_found() -> None:
    shifted = (pl.col("error_low_m") + 3.0, pl.col("error_high_m") + 3.0)
    assert "the interval is" in _breaches_of(_epochs(_true("clean", "reference"), *shifted))


def test_a_weaker_rung_that_knows_better_is_found() -> None:
    strong, weak = _true("step", "reference"), _true("step", "balise")
    flipped = pl.col("judgement").replace_strict({"right": "unknown", "wrong": "right", "unknown": "unknown"})
    breaches = findings(strong.journey, {"reference": strong, "balise": _epochs(weak, flipped)})
    assert any("balise against reference" in text for text in breaches)


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
    rung = _true("late", "reference")
    assert rung.number("hazardous_max_s") > 2.0, "no failure in use: nothing is tested"
    assert text in _breaches_of(_runs(rung, **{column: value}))


def test_a_false_accusation_is_found() -> None:
    rung = _true("clean", "reference")
    assert np.abs(rung.epochs.error_m).max() < 19.0
    assert "nothing was wrong by truth" in _breaches_of(_runs(rung, verdict="unsafe"))
