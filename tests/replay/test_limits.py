"""Each limit of `schemas.limits` decides what its name says, and nothing else does: one is changed, the rest stand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import polars as pl
import pytest

import schemas.config_judge
from pipeline import one_run
from pipeline.results.places import stretches_of
from pipeline.stages.evidence.carrying import carry_from_accepted
from pipeline.stages.judge.judgement import JudgeInput, healthy_margins_m
from pipeline.stages.run_row.lost_time import LostTime, remedies
from pipeline.studies.line.spans import SpanState, spans_of, states_of
from schemas.arrays import NS_PER_S, Floats, Ints, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.enums import Judgement, Remedy
from schemas.limits import Limits, limits_of
from schemas.run import RunLog, RunTables
from tests.replay.journeys import MOTION, VEHICLE, journey, replay
from tests.stages.evidence.test_evidence import counting, seconds
from tests.stages.run_row.test_lost_time import ALL_KNOWN, CONFIG, RUN
from tests.studies.line.tables import alarms_of, epochs_of

STEP = {"kind": "step", "size_m": 30.0, "start_s": 140.0, "duration_s": 60.0}
LEAP = {"kind": "step", "size_m": 850.0, "start_s": 150.0, "duration_s": 6.0}
SLIP = {"kind": "slip", "rate_mps": 20.0, "start_s": 150.0, "duration_s": 2.0}
READS, ODOMETER = ("reference",), ("reference", "balise_reads")
STANDING = {"start_m": 200.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 3000.0, "hold_s": 60.0}, *MOTION["phases"]]}

Changed = Callable[[str, float], None]


@pytest.fixture
def changed(monkeypatch: pytest.MonkeyPatch) -> Changed:
    """Multiplies one limit, and leaves all others as they are."""

    def change(name: str, factor: float) -> None:
        def one_changed(hazards: HazardConfig) -> Limits:
            limits = limits_of(hazards)
            return limits._replace(**{name: factor * getattr(limits, name)})

        monkeypatch.setattr(schemas.config_judge, "limits_of", one_changed)

    return change


def _without_rows_between(run: RunLog, from_s: float, to_s: float) -> RunLog:
    assert run.odometer is not None
    since_s = (pl.col("t") - run.odometer["t"][0]).dt.total_nanoseconds() / NS_PER_S
    return run.with_streams(odometer=run.odometer.filter(~since_s.is_between(from_s, to_s)))


CASES: dict[str, tuple[list[dict[str, Any]], dict[str, Any], float, set[str]]] = {
    # A step of 30 m is a failure no more when 40 m are the limit.
    "failure_m": (
        *([STEP], {}, 2.0),
        {"epochs.judgement", "hazards", "runs.hazards_shift", "runs.proof_margin_m", "runs.failure_hazardous_may_s"},
    ),
    "shift_m": ([STEP], {}, 2.0, {"hazards", "runs.hazards_shift"}),
    "jump_m": ([LEAP], {}, 50.0, {"hazards", "runs.hazards_1b", "runs.hazards_shift"}),
    "settled_m": ([STEP], {"drop": READS}, 0.25, {"hazards.hazardous_may_s", "runs.failure_hazardous_may_s"}),
    "relink_m": ([STEP], {"drop": ODOMETER}, 0.25, {"epochs.alarm", "epochs.along_raw_threshold", "runs.availability"}),
    "stand_m": (
        [{**STEP, "start_s": 125.0}],
        {"motion": STANDING, "drop": ODOMETER},
        4.0,
        {"alarms.suspect", "epochs.evidence", "runs.availability"},
    ),
    "doubt_m": (
        [],
        {"drop": READS, "rows_lost_s": (100.0, 103.0)},
        0.1,
        {"epochs.judgement", "epochs.evidence", "runs.proof_margin_m"},
    ),
    "confirming_m": (
        *([SLIP], {}, 0.25),
        {"epochs.judgement", "epochs.evidence", "runs.proof_margin_m", "runs.availability"},
    ),
    "moved_m": ([], {"vehicle": None, "rows_lost_s": (100.0, 103.0)}, 0.1, {"epochs.along_raw_threshold"}),
    "abreast_m": ([STEP], {}, 2.0, {"epochs.error_cross_m", "epochs.error_up_m", "runs.cross_error_epochs"}),
}
"""Faults, world, factor of the limit, and what must move among `COMPARED`: tables by name where rows come or go."""

COMPARED = (
    *("epochs.judgement", "epochs.evidence", "epochs.alarm", "epochs.error_cross_m", "epochs.error_up_m"),
    *("epochs.along_raw_threshold", "hazards.hazardous_may_s", "hazards.suspect", "alarms.suspect"),
    *("runs.proof_margin_m", "runs.availability", "runs.hazards_shift", "runs.hazards_1b"),
    *("runs.failure_hazardous_may_s", "runs.cross_error_epochs"),
)


def _moved(before: RunTables, after: RunTables) -> set[str]:
    tables = {name: (getattr(before, name), getattr(after, name)) for name in ("epochs", "hazards", "alarms", "runs")}
    resized = {name for name, (old, new) in tables.items() if old.height != new.height}
    columns = (name for name in COMPARED if name.split(".")[0] not in resized)
    pairs = ((name, *(frame[name.split(".")[1]] for frame in tables[name.split(".")[0]])) for name in columns)
    return resized | {name for name, old, new in pairs if not old.equals(new, null_equal=True)}


@pytest.mark.parametrize("limit", CASES)
def test_a_limit_moves_what_its_name_says(limit: str, changed: Changed) -> None:
    faults, world, factor, expected = CASES[limit]
    run, site = journey(*faults, motion=world.get("motion"))
    run = run.with_streams(**dict.fromkeys(world.get("drop", ())))
    if "rows_lost_s" in world:
        run = _without_rows_between(run, *world["rows_lost_s"])
    vehicle = world.get("vehicle", VEHICLE)
    before = replay(run, site, vehicle, Configuration())
    changed(limit, factor)
    assert _moved(before, one_run.replay(run, site, vehicle, Configuration())) == expected


def test_a_limit_that_differs_from_instant_to_instant_judges_each_by_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of 30 m from 140 to 200 s; the limit is 40 m up to 170 s, and 20 m from there on."""
    run, site = journey(STEP)
    until_ns = int(times_ns(run.gnss)[0]) + 170 * NS_PER_S

    def with_limits(early_m: float, late_m: float) -> RunTables:
        def failure_limit_m(_: JudgeInput, at_ns: Ints) -> Floats:
            return np.where(at_ns < until_ns, early_m, late_m)

        monkeypatch.setattr(JudgeInput, "failure_limit_m", failure_limit_m)
        return one_run.replay(run, site, VEHICLE, Configuration())

    narrow, wide, both = with_limits(20.0, 20.0), with_limits(40.0, 40.0), with_limits(40.0, 20.0)
    early, is_wrong = both.epochs["t"].dt.timestamp("ns") < until_ns, pl.col("judgement") == Judgement.WRONG
    for part, single in ((early, wide), (~early, narrow)):
        assert both.epochs["judgement"].filter(part).equals(single.epochs["judgement"].filter(part), null_equal=True)
    # The step is wrong at once by 20 m, from 170 s on by both, never by 40 m.
    wrong_ns = [times_ns(tables.epochs.filter(is_wrong)) for tables in (narrow, both, wide)]
    assert wrong_ns[0][0] < until_ns == wrong_ns[1][0]
    assert wrong_ns[2].size == 0
    # What is left up to its limit at each accepted balise, and the least of all.
    offered_early = both.passages["t_offered"].dt.timestamp("ns") < until_ns
    margin_m, wide_m, narrow_m = (tables.passages["proof_margin_m"] for tables in (both, wide, narrow))
    assert margin_m.equals(wide_m.zip_with(offered_early, narrow_m), null_equal=True)
    assert both.runs["proof_margin_m"].equals(wide.runs["proof_margin_m"])


def test_the_margin_of_a_healthy_position_is_no_wider(changed: Changed) -> None:
    """Three sigma of 5, 15 and 30 m, at most the limit."""
    sigma_m = np.array([5.0, 15.0, 30.0])
    assert healthy_margins_m(sigma_m, np.full(3, 20.0), HazardConfig()).tolist() == [15.0, 20.0, 20.0]
    changed("healthy_m", 2.0)
    assert healthy_margins_m(sigma_m, np.full(3, 20.0), HazardConfig()).tolist() == [15.0, 40.0, 40.0]


def test_an_accepted_balise_that_the_one_before_contradicts_is_no_anchor(changed: Changed) -> None:
    """10 m/s; accepted at 1 s, and at 6 s 60 m further than driven: 52.5 m beyond 5 m + 5 % of 50 m."""
    counted = counting(np.arange(0.0, 110.0, 10.0))
    accepted_ns, path_m, at_ns = seconds(1, 6), np.array([10.0, 120.0]), seconds(8)

    def low_m() -> float:
        return float(carry_from_accepted(accepted_ns, path_m, at_ns, counted, [], Configuration())[0][0])

    assert low_m() == pytest.approx(10.0 + 70.0 - 5.0 - 3.5)
    changed("agreement_m", 3.0)
    assert low_m() == pytest.approx(120.0 + 20.0 - 5.0 - 1.0)


def test_a_part_of_the_line_is_unknown_where_the_train_may_be_further_along(changed: Changed) -> None:
    epochs = epochs_of(0, (), falling=False)

    def states() -> set[int]:
        found = states_of(epochs, alarms_of(epochs)["t_start"], Configuration())
        return set(spans_of(epochs, found, stretches_of(epochs), Configuration())["state"])

    assert states() == {int(SpanState.RIGHT)}
    changed("span_m", 0.05)
    assert states() == {int(SpanState.UNKNOWN)}


def test_clocks_are_a_remedy_where_they_take_half_of_the_room(changed: Changed) -> None:
    lacking = RUN | {"evidence": "balise", "reasons": ["unknown_in_use"]}

    def cures() -> list[Remedy]:
        return list(remedies(lacking, LostTime(), ALL_KNOWN, True, CONFIG, clock_open_m=15.0))

    assert Remedy.CLOCK not in cures()
    changed("clock_open_m", 0.5)
    assert Remedy.CLOCK in cures()


def test_every_limit_is_changed_here() -> None:
    """Five of them by one function each."""
    assert {*CASES, "healthy_m", "agreement_m", "span_m", "clock_open_m"} == set(Limits._fields)
