"""Hazards in words: how far off an accepted balise was, and what a safe run withstood; by hand."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from pipeline.results.figures.hazard_words import hazard_words, withstood_words
from tests.tables import NS, hazards, passages

JUMP: dict[str, Any] = {
    "solution": "primary",
    "hazard": "VB_JUMP_1B",
    "size_m": 502.0,
    "timing": "early",
    "detected": False,
    "within_budget": None,
    "balise_ids": [["VB04"]],
    "accepted_ids": [["VB04"]],
}


def offers(**columns: Any) -> pl.DataFrame:
    plain = {"solution": "primary", "balise_id": "VB04", "status": "accepted", "judgement": "wrong", "hazard_id": 0}
    return passages(1, **(plain | columns))


@pytest.mark.parametrize(
    ("offer", "said"),
    [
        ({"location_error_m": 303.6}, "VB_JUMP_1B: VB04 accepted 303.6 m early; no monitor saw it"),
        ({"location_error_m": -25.04}, "VB_JUMP_1B: VB04 accepted 25.0 m late; no monitor saw it"),
        ({"location_error_m": None}, "VB_JUMP_1B: VB04 accepted at a wrong place; no monitor saw it"),
        ({"location_error_m": 3.0, "judgement": "right"}, "VB_JUMP_1B: VB04 502 m early, accepted; no monitor saw it"),
        ({"location_error_m": 303.6, "hazard_id": 1}, "VB_JUMP_1B: VB04 502 m early, accepted; no monitor saw it"),
        ({"location_error_m": 303.6, "solution": "gps"}, "VB_JUMP_1B: VB04 502 m early, accepted; no monitor saw it"),
    ],
)
def test_a_balise_is_as_far_off_as_it_was_accepted(offer: dict[str, Any], said: str) -> None:
    """The position was up to 502 m off in this fault; the balise itself was not."""
    assert hazard_words(hazards(1, **JUMP), offers(**offer)) == [said]


@pytest.mark.parametrize(("since_failure_s", "side"), [(-48.6, "48.6 s before"), (3.0, "3 s after")])
def test_a_drift_is_held_against_its_failure(since_failure_s: float, side: str) -> None:
    """The onset of a drift may be the alarm itself; a time to detect of 0 s would say nothing of it."""
    drift = {
        **JUMP, "hazard": "VB_SHIFT", "detected": True, "monitor": "along_ewma_0p1", "rate_mps": 0.4,
        "time_to_detect_s": 0.0, "time_since_failure_s": since_failure_s, "accepted_ids": [[]],
    }  # fmt: skip
    none = offers(status="rejected_monitor")
    words = f"VB_SHIFT: VB04 502 m early, not accepted; along_ewma_0p1 saw it {side} the position failed"
    assert hazard_words(hazards(1, **drift), none) == [words]


def test_of_several_the_worst_is_named() -> None:
    found = hazards(1, **JUMP | {"accepted_ids": [["VB04", "VB05", "VB06"]]})
    errors = passages(
        3, solution="primary", balise_id=["VB04", "VB05", "VB06"], status="accepted", judgement="wrong", hazard_id=0,
        location_error_m=[30.0, None, -60.0],
    )  # fmt: skip
    assert hazard_words(found, errors) == ["VB_JUMP_1B: VB06 accepted 60.0 m late, and 2 more; no monitor saw it"]


def test_what_a_safe_run_withstood() -> None:
    """Two jumps blocked 0.1 s and 0.2 s after they began, a shift after 31 s, one that nobody saw; a jump back."""
    rows = hazards(
        5,
        hazard_id=[0, 1, 2, 3, 4],
        hazard=["VB_JUMP_1A", "VB_JUMP_1B", "VB_SHIFT", "VB_SHIFT", "VB_JUMP_1B"],
        caused_by=[None, None, None, None, 0],
        detected=[True, True, True, False, True],
        t_onset=[NS, 10 * NS, 20 * NS, 90 * NS, 2 * NS],
        t_negated=[NS + NS // 10, 10 * NS + NS // 5, 51 * NS, None, 2 * NS],
    )
    assert withstood_words(rows) == (
        "2 jumps negated within 0.2 s, 1 shift negated within 31 s, 1 shift that no monitor saw, none accepted"
    )
    assert withstood_words(rows.clear()) == ""
