"""Ten rows worked by hand: how far apart balises may be, and what bounds the fault itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.stages.lds.link_monitors import Held
from pipeline.stages.monitors.pseudorange import Equations
from pipeline.studies.undetected import spacing
from pipeline.studies.undetected.position_tests import _worst_satellites_m, with_bounds
from pipeline.studies.undetected.spacing import largest_spacing
from pipeline.studies.undetected.watched import Watched, _with_relinks, windows_between_fixes
from schemas.config import Configuration
from tests.studies.undetected.oracle import watched
from tests.studies.undetected.test_errors import constant

TRAVELLED_M = 30.0 * np.arange(10)


def settings(limit_m: float, resolution_s: float = 0.0) -> Configuration:
    limits = {"failure_limit_m": limit_m, "jump_limit_m": limit_m}
    undetected = {"spacing_step_s": 3.0, "spacing_resolution_s": resolution_s}
    return Configuration.model_validate({"hazards": limits, "undetected": undetected})


@pytest.mark.parametrize(
    ("limit_m", "spacing_m", "starts"),
    [
        # Of one average k rows let pass 0.5 + 0.01 (k - 1) m: beyond 0.4 m after one row, beyond 0.525 m after four.
        (0.4, 0.0, 3),
        # Within the limit for three rows, 90 m; a balise just before the next row has 30 m less.
        (0.525, 60.0, None),
        # What the first start keeps to the end, the later ones keep too.
        (0.7, None, 1),
    ],
)
def test_balises_may_be_as_far_apart_as_the_error_stays_within_the_limit(
    limit_m: float, spacing_m: float | None, starts: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[int] = []
    search = spacing._first_beyond

    def counted(both: tuple[Watched, Watched], start: int, **rest: Any) -> int:
        searched.append(start)
        return search(both, start, **rest)

    monkeypatch.setattr(spacing, "_first_beyond", counted)
    found, _ = largest_spacing(watched(constant(10, 0.01, 0.02)), TRAVELLED_M, settings(limit_m))
    assert found.distance_m == (None if spacing_m is None else pytest.approx(spacing_m))
    # 0 m cannot become less: only the first starts are tried.
    assert starts is None or len(searched) == starts


@pytest.mark.parametrize(
    ("resolution_s", "spacing_m"),
    [
        # Every start keeps three rows: a balise before each row has 60 m.
        (0.9, 60.0),
        # Starts two rows apart are near enough: from the second to where the first reaches the limit is one row.
        (2.0, 30.0),
        # The limit is reached within the resolution itself.
        (3.0, 0.0),
    ],
)
def test_starts_lie_no_nearer_than_the_resolution(resolution_s: float, spacing_m: float) -> None:
    found, _ = largest_spacing(watched(constant(10, 0.01, 0.02)), TRAVELLED_M, settings(0.525, resolution_s))
    assert found.distance_m == pytest.approx(spacing_m)


def test_relinks_bound_the_fault_by_what_they_measured() -> None:
    """Row 3 by a telegram: moved 2 m of 5 m; row 6 against row 3: moved -1 m of 4 m; the rest binds nothing."""
    rows = watched(constant(10, 0.01, 0.02))
    late = replace(rows, learned_late_m=np.where(np.arange(10) == 3, 0.5, 0.0))
    held = _with_relinks(late, (held_at(3, None, 2.0, 5.0), held_at(6, 3, -1.0, 4.0), held_at(99, None, 0.0, 1.0)))
    assert (held.low_m[3], held.high_m[3]) == (-7.5, 3.5)
    assert (held.anchor[6], held.held_low_m[6], held.held_high_m[6]) == (3, -3.5, 5.5)
    assert held.free.nonzero()[0].tolist() == [3, 6]
    assert np.isinf(np.delete(held.high_m, 3)).all()


def held_at(epoch: int, anchor_epoch: int | None, moved_m: float, bound_m: float) -> Held:
    return Held(epoch=epoch, anchor_epoch=anchor_epoch, moved_m=moved_m, bound_m=bound_m)


def test_bounds_keep_the_nearer_one_and_turn_with_the_direction() -> None:
    rows = watched(constant(10, 0.01, 0.02))
    both = with_bounds(with_bounds(rows, np.full(10, -4.0), np.full(10, 9.0)), np.full(10, -6.0), np.full(10, 3.0))
    assert (both.low_m[0], both.high_m[0]) == (-4.0, 3.0)
    assert (both.in_other_direction().low_m[0], both.in_other_direction().high_m[0]) == (-3.0, 4.0)


def test_windows_begin_at_the_last_fix_before_a_row() -> None:
    """Rows at 0, 1, ... 9 s; fixes at -5 s (before the run), 2.2 s, 2.8 s (the later counts), 7 s (at a row), 20 s."""
    rows = watched(constant(10, 0.01, 0.02))
    t_ns = np.arange(10, dtype=np.int64) * 10**9
    fixes = (np.array([-5.0, 2.2, 2.8, 7.0, 20.0]) * 1e9).astype(np.int64)
    parts = [(part.start, part.end, part.since_s) for part in windows_between_fixes(rows, t_ns, fixes)]
    assert parts == [(0, 2, 0.0), (2, 7, 2.8), (7, 9, 7.0)]


def test_one_range_may_move_the_position_by_its_gain_and_the_room_under_the_threshold() -> None:
    """Two satellites on a line, weights 1, one unknown: each residual 0, so SS = b^2 / 2 and the gain is one half.

    SS below 8 leaves |b| of 4 m, and so 2 m of position; an epoch that is not tested leaves any amount.
    """
    part = Equations(
        epoch=np.array([0, 1]),
        held=np.ones((2, 2), dtype=np.bool_),
        rows=np.tile([1.0, 0.0, 0.0], (2, 2, 1)),
        clocks=np.zeros((2, 2, 1)),
        weight=np.ones((2, 2)),
        residual_m=np.zeros((2, 2)),
        design=np.ones((2, 2, 1)),
        prior=np.zeros((2, 1)),
        freedom=np.array([1, 0]),
        along=np.tile([1.0, 0.0, 0.0], (2, 1)),
    )
    low, high = _worst_satellites_m(part, np.array([8.0, np.inf]))
    assert (low[0], high[0]) == (pytest.approx(-2.0), pytest.approx(2.0))
    assert (low[1], high[1]) == (-np.inf, np.inf)
