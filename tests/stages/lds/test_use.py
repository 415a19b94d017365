"""The transition table of `Use`, row by row: one epoch a second at 20 m/s, V1 at 5.5 s, the first TVB at 7 s.

A position is in use, negated, or withheld for a reason. The bank begins at 0 s, and anew at a return and after slip.
"""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import pytest

from pipeline.stages.odometry.bound import LOST_M
from tests.stages.lds.scripted import LdsTables, ScriptedBank, balises_at, epochs_of, run, steps

COUNT = 120
IN_USE, NEGATED = "in use", "negated"


def changes(result: LdsTables) -> list[tuple[int, str]]:
    """Epochs at which the use of the position changes, and to what."""
    rows = result.epochs.select("negated", "withheld_for").rows()
    use = [NEGATED if negated else withheld or IN_USE for negated, withheld in rows]
    return [(k + 1, after) for k, (before, after) in enumerate(pairwise(use)) if after != before]


def walk(
    bank: dict[str, Any], offset_m: float = 0.0, slip: range = range(0), silent: range = range(0), **lds: Any
) -> LdsTables:
    """The position is off by `offset_m` from 25 s on; the odometer slips, or is silent and loses its distance."""
    slips = [k in slip for k in range(COUNT)]
    true_m = steps(0.0, 20.0, COUNT)
    epochs = epochs_of(
        [x + (offset_m if k >= 25 else 0.0) for k, x in enumerate(true_m)],
        [None if slips[k] or k in silent else x for k, x in enumerate(true_m)],
        odometer_slips=slips,
        doubt_m=[1e-3 * sum(slips[: k + 1]) + LOST_M * (bool(silent) and k >= silent.stop) for k in range(COUNT)],
    )
    return run(epochs, balises_at({"V1": 110.0}), ScriptedBank(**bank), **lds)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        # An alarm: back after 30 s without a failure, where it re-links; never where it does not.
        ({"bank": {"fails": [20]}}, [(20, NEGATED), (50, "relink"), (51, IN_USE)]),
        ({"bank": {"fails": [20, 40]}}, [(20, NEGATED), (70, "relink"), (71, IN_USE)]),
        ({"bank": {"fails": [25]}, "offset_m": 30.0}, [(25, NEGATED)]),
        # Before anything was validated there is no anchor: a new initialisation.
        ({"bank": {"fails": [3]}}, [(3, NEGATED), (33, "relink"), (34, IN_USE)]),
        # Noise: for longer than 60 s the position has to re-link.
        ({"bank": {"unknown": range(20, 50)}, "offset_m": 30.0}, [(20, "noise"), (50, IN_USE)]),
        ({"bank": {"unknown": range(20, 90)}}, [(20, "noise"), (90, IN_USE)]),
        ({"bank": {"unknown": range(20, 90)}, "offset_m": 30.0}, [(20, "noise"), (90, NEGATED)]),
        ({"bank": {"unknown": range(20, 90)}, "scale_sigma": None}, [(20, "noise"), (90, "relink")]),
        # Distance lost while nothing watched: no fault can be ruled out, with or without one.
        ({"bank": {"begins": [30]}, "silent": range(28, 30)}, [(30, "relink")]),
        ({"bank": {"begins": [30]}, "silent": range(28, 30), "offset_m": 30.0}, [(30, "relink")]),
        # Slip: withheld until it re-links, without an alarm; an alarm in it is one.
        ({"bank": {"begins": [30]}, "slip": range(20, 30)}, [(20, "slip"), (30, "relink"), (31, IN_USE)]),
        ({"bank": {"begins": [30]}, "slip": range(20, 30), "offset_m": 30.0}, [(20, "slip"), (30, "relink")]),
        ({"bank": {"fails": [25]}, "slip": range(20, 30)}, [(20, "slip"), (25, NEGATED), (55, "relink"), (56, IN_USE)]),
    ],
)
def test_use(given: dict[str, Any], expected: list[tuple[int, str]]) -> None:
    assert changes(walk(**given)) == [(1, IN_USE), *expected]


@pytest.mark.parametrize("offset_m", [0.0, 30.0])
def test_distance_lost_between_two_consecutive_positions_is_watched_by_nobody(offset_m: float) -> None:
    """The counter is lost between 29 and 30 s, both of which have a position and a row."""
    lost = [k >= 30 for k in range(COUNT)]
    true_m = steps(0.0, 20.0, COUNT)
    place_m = [x + offset_m * after for x, after in zip(true_m, lost, strict=True)]
    epochs = epochs_of(place_m, true_m, doubt_m=[LOST_M * after for after in lost])
    assert changes(run(epochs, balises_at({"V1": 110.0}), ScriptedBank(begins=[30]))) == [(1, IN_USE), (30, "relink")]


@pytest.mark.parametrize(
    ("offset_m", "doubt_m", "scale_sigma", "expected"),
    [
        # k_T sqrt(2) x 1 m = 7.5 m and the pause's doubt, at most 10 m.
        (0.0, 4.05, 1e-4, [(30, "relink"), (31, IN_USE)]),
        (30.0, 4.05, 1e-4, [(30, NEGATED)]),
        (9.5, 4.05, 1e-4, [(30, "relink"), (31, IN_USE)]),
        (9.5, 0.0, 1e-4, [(30, NEGATED)]),
        # A pause of 5 s: more in doubt than half the failure limit; or no vehicle file.
        (0.0, 11.25, 1e-4, [(30, "relink")]),
        (0.0, 4.05, None, [(30, "relink")]),
    ],
)
def test_a_way_guessed_over_a_pause_asks_for_a_re_link(
    offset_m: float, doubt_m: float, scale_sigma: float | None, expected: list[tuple[int, str]]
) -> None:
    """Speeds alone pause from 27 to 30 s; there is no row, hence no watched epoch, at 28 and 29 s."""
    true_m = steps(0.0, 20.0, COUNT)
    epochs = epochs_of(
        [x + offset_m * (k >= 29) for k, x in enumerate(true_m)],
        [None if k in (28, 29) else x for k, x in enumerate(true_m)],
        doubt_m=[(doubt_m + 1e-3) * (k >= 30) for k in range(COUNT)],
    )
    result = run(epochs, balises_at({"V1": 110.0}), ScriptedBank(begins=[30]), scale_sigma=scale_sigma)
    assert changes(result)[1:] == expected


def test_a_start_of_mission_ends_every_wait() -> None:
    start = datetime(1970, 1, 1, 0, 1, tzinfo=UTC)
    negated = changes(walk({"fails": [25]}, 30.0, starts_of_mission=(start,)))
    assert negated == [(1, IN_USE), (25, NEGATED), (60, "relink"), (61, IN_USE)]
    slipped = changes(walk({"begins": [30]}, 30.0, range(20, 30), starts_of_mission=(start,)))
    assert slipped == [(1, IN_USE), (20, "slip"), (30, "relink"), (60, IN_USE)]
