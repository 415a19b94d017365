"""Positions on a track that the survey lacks: where, and how far aside."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from schemas.words import say
from tests.stages.matching.builders import line, matched, odometer, run, site


@pytest.mark.parametrize("turned", [False, True])
def test_a_siding_that_the_survey_lacks_is_named_with_place_and_offset(turned: bool) -> None:
    """From 800 m on the train bends away to a siding 4.5 m left, and comes back at 1800 m; surveyed to 0.3 m.

    Another track lies 12 m right: along one alone only offsets are tested, and 4.5 m may be the antenna's.
    """
    ends = ((3000.0, 0.0), (0.0, 0.0)) if turned else ((0.0, 0.0), (3000.0, 0.0))
    place = site({"a": line(*ends), "b": line((0.0, -12.0), (3000.0, -12.0))}, sigma_m=0.3)
    x = np.arange(20.0, 2980.0, 10.0)
    y = np.interp(x, [800.0, 880.0, 1800.0, 1880.0], [0.0, 4.5, 4.5, 0.0])
    found = matched(run(x, y, sigma_m=0.3), place, odometer(x))
    (row,) = found.off.to_dicts()
    assert row["netelement_id"] == "a"
    assert row["offset_m"] == pytest.approx(-4.5 if turned else 4.5, abs=0.2)
    begin, end = (row["from_m"], row["to_m"]) if not turned else (3000.0 - row["to_m"], 3000.0 - row["from_m"])
    assert 840.0 < begin < 1000.0
    assert 1780.0 < end < 2050.0
    # Nothing is claimed meanwhile, and positions stay projected.
    away = (x > 1000.0) & (x < 1780.0)
    assert found.epochs["gate_probability"].is_null().to_numpy()[away].all()
    assert np.allclose(found.epochs["path_m"], x, atol=0.1)


def test_on_the_network_nothing_is_named() -> None:
    x = np.arange(20.0, 2980.0, 10.0)
    found = matched(run(x, np.full(x.size, 1.0), sigma_m=0.5), site({"a": line((0, 0), (3000, 0))}), odometer(x))
    assert found.off.is_empty()


def test_the_note_says_how_far_on_which_side_and_where() -> None:
    begin = datetime(2025, 3, 1, 10, 2, 3, tzinfo=UTC)
    row = {"netelement_id": "a", "from_m": 871.6, "to_m": 1850.2, "t_start": begin, "t_end": begin}
    assert (
        say("off_network", "left", **row, offset_m=4.52) == "4.5 m left of a from 872 to 1850 m, 10:02:03 to 10:02:03"
    )
