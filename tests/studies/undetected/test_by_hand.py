"""Ten rows worked by hand: how far apart balises may be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.studies.undetected import spacing
from pipeline.studies.undetected.spacing import largest_spacing
from pipeline.studies.undetected.watched import Watched
from schemas.config import Configuration
from tests.studies.undetected.oracle import watched
from tests.studies.undetected.test_errors import constant

WAY_M = 30.0 * np.arange(10)


def settings(limit_m: float) -> Configuration:
    limits = {"failure_limit_m": limit_m, "jump_limit_m": limit_m}
    return Configuration.model_validate({"hazards": limits, "undetected": {"spacing_step_s": 3.0}})


@pytest.mark.parametrize(
    ("limit_m", "spacing_m", "starts"),
    [
        # Of one average k rows let pass 0.5 + 0.01 (k - 1) m: beyond 0.4 m after one row, beyond 0.525 m after four.
        (0.4, 0.0, 3),
        # Within the limit for three rows, 90 m; a balise just before the next row has 30 m less.
        (0.525, 60.0, None),
        (0.7, None, 3),
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
    found, _ = largest_spacing(watched(constant(10, 0.01, 0.02)), WAY_M, settings(limit_m))
    assert found.way_m == (None if spacing_m is None else pytest.approx(spacing_m))
    # 0 m cannot become less: only the first starts are tried.
    assert starts is None or len(searched) == starts
