"""The verdict of a run, and what heads runs and campaigns, from plain numbers (DOMAIN section 5.4)."""

from typing import Any

import polars as pl
import pytest

from pipeline.figures.independent import independent_episodes
from pipeline.figures.verdict import head_of, run_verdicts, verdict_of, verdict_reasons, worst_verdict
from schemas.enums import RunVerdict
from schemas.tables import Runs
from tests.summary.tables import NS, hazards, table

UNSAFE, UNPROVEN, SAFE = RunVerdict.UNSAFE, RunVerdict.UNPROVEN, RunVerdict.SAFE
CLEAN: dict[str, Any] = {
    "unsafe_accepted": 0,
    "failures": 0,
    "failures_within_budget": 0,
    "failures_beyond_budget": 0,
    "unproven_accepted": 0,
    "balises_accepted": 10,
    "share_unknown": 0.0,
}


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        ({}, SAFE),
        ({"failures": 2, "failures_within_budget": 2}, SAFE),
        ({"share_unknown": 0.01}, SAFE),
        ({"share_unknown": 0.0101}, UNPROVEN),
        ({"share_unknown": None}, UNPROVEN),
        ({"balises_accepted": 0}, UNPROVEN),
        ({"unproven_accepted": 1}, UNPROVEN),
        ({"failures": 2, "failures_within_budget": 1}, UNPROVEN),
        ({"failures": 2, "failures_within_budget": 1, "failures_beyond_budget": 1}, UNSAFE),
        ({"unsafe_accepted": 1}, UNSAFE),
        ({"unsafe_accepted": 1, "unproven_accepted": 5, "share_unknown": 1.0}, UNSAFE),
    ],
)
def test_the_worst_that_applies(found: dict[str, Any], verdict: RunVerdict) -> None:
    assert verdict_of(CLEAN | found, 0.01) is verdict


@pytest.mark.parametrize(
    ("several", "head"),
    [
        ([SAFE, SAFE], SAFE),
        ([SAFE, UNPROVEN], UNPROVEN),
        ([SAFE, UNPROVEN, UNSAFE, None], UNSAFE),
        ([SAFE, None], UNPROVEN),
        ([None, None], None),
        ([], None),
    ],
)
def test_several_are_headed_by_their_worst(several: list[RunVerdict | None], head: RunVerdict | None) -> None:
    assert worst_verdict(several) is head


def test_a_campaign_is_headed_by_its_worst_run_with_counts() -> None:
    rows = table(
        Runs,
        6,
        solution=["gps", "primary", "primary", "primary", "gps", "primary"],
        verdict=["unsafe", "safe", "safe", None, "unproven", "safe"],
    ).with_columns(run_id=pl.Series(["a", "a", "b", "c", "d", "d"]))
    assert run_verdicts(rows) == {"a": UNSAFE, "b": SAFE, "c": None, "d": UNPROVEN}
    head = head_of(run_verdicts(rows).values())
    assert str(head) == "unsafe: 1 unsafe, 1 unproven, 1 safe, 1 failed"
    assert head_of([None]).word == "failed"


def test_rows_of_one_fault_are_one_event() -> None:
    """Begin at 100 s in two rows and a third that follows; the last is seen 2 s after the failure, too late."""
    frame = hazards(
        5,
        solution="primary",
        budget_s=1.675,
        t_onset=[100 * NS, 100 * NS, 150 * NS, 900 * NS, None],
        t_hazard=[110 * NS, 120 * NS, 150 * NS, 905 * NS, 990 * NS],
        caused_by=[None, None, 0, None, None],
        t_failure=[112 * NS, None, 150 * NS, None, 990 * NS],
        t_detected=[113 * NS, None, None, None, 992 * NS],
        time_to_detect_s=[12.0, 13.0, None, None, None],
        evidence=["reference", "odometer", "reference", "reference", "reference"],
    ).with_columns(run_id=pl.lit("r0"))
    events = independent_episodes(frame)
    assert events["failed"].to_list() == [True, False, True]
    assert events["missed"].to_list() == [False, False, True]
    assert events["with_truth"].to_list() == [False, True, True]
    assert events["time_to_detect_s"].to_list() == [13.0, None, None]


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"verdict": "safe"}, "every acceptance right, every position failure within the time allowed"),
        ({"verdict": "unproven"}, "its streams do not fit each other, as the notes say"),
        (
            {"verdict": "unsafe", "unsafe_accepted": 1, "unproven_accepted": 5},
            "VBs accepted despite a wrong position: 1; VBs accepted that nothing can check: 5",
        ),
    ],
)
def test_the_reasons_are_said_one_after_the_other(found: dict[str, Any], said: str) -> None:
    assert verdict_reasons({**CLEAN, **found}, 0.01) == said
