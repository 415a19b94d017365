"""What many runs say together of unnoticed errors."""

from __future__ import annotations

from typing import Any

import polars as pl
import pytest

from pipeline.results.figures.campaign_tables import spacing_of_runs, undetected_spread
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.studies.undetected.columns import Undetected
from pipeline.studies.undetected.figures import Spacing, undetected_figures
from schemas.config import Configuration
from tests.arrays_of_table import arrays_of_table
from tests.tables import epochs, passages


def test_of_a_run_only_what_was_in_use() -> None:
    ahead, behind = [1.0, 2.0, 21.0, 90.0, None], [3.0, 1.0, 0.0, 95.0, None]
    used = epochs(
        [0.0, 1.0, 2.0, 3.0, 4.0],
        undetected_ahead_m=ahead,
        undetected_behind_m=behind,
        in_use=[True, True, True, False, True],
    )
    found = undetected_figures(arrays_of_table(JudgedEpochs, used), used, Spacing(900.0, 30.0, 7, 2), 20.0)
    assert found == {
        "physical_spacing_m": 900.0,
        "physical_spacing_s": 30.0,
        "physical_spacing_starts": 7,
        "physical_spacing_reached": 2,
        "undetected_median_m": 3.0,
        "undetected_p95_m": 21.0,
        "undetected_max_m": 21.0,
        "undetected_share_beyond": pytest.approx(1 / 3),
        "t_undetected_beyond": 2_000_000_000,
        "undetected_beyond_path_m": 40.0,
    }
    nothing: Any = None
    assert Undetected(used, nothing).figures(arrays_of_table(JudgedEpochs, used), Configuration()) == {}


def test_of_a_balise_the_larger_of_both_directions() -> None:
    rows = passages(
        4,
        undetected_ahead_m=[1.0, 5.0, None, 2.0],
        undetected_behind_m=[4.0, 3.0, None, 1.0],
        physical_before_m=[None, 9000.0, 7000.0, 8000.0],
    )
    found = rows.select(**undetected_spread()).row(0, named=True)
    assert found == {
        "undetected_count": 3,
        "undetected_median_m": 4.0,
        "undetected_p95_m": 5.0,
        "undetected_max_m": 5.0,
        "physical_before_count": 3,
        "physical_before_median_m": 8000.0,
        "physical_before_p05_m": 7000.0,
        "physical_before_min_m": 7000.0,
    }


def test_of_runs_the_shortest_spacing_and_the_share_that_keeps_it() -> None:
    # One of four was not asked, one did not reach the limit. 0.05^(1/3) by hand: e^(-2.9957 / 3).
    rows = pl.DataFrame(
        {
            "undetected_max_m": [12.0, 31.0, 25.0, None],
            "physical_spacing_m": [None, 4000.0, 5000.0, None],
            "physical_spacing_starts": [5, 5, 9, None],
        }
    )
    found = rows.select(**spacing_of_runs()).row(0, named=True)
    assert found["undetected_max_m"] == 31.0
    assert (found["physical_spacing_runs"], found["physical_spacing_m"]) == (3, 4000.0)
    assert found["physical_spacing_share_low"] == pytest.approx(0.3684, abs=1e-4)
    assert rows.clear().select(**spacing_of_runs())["physical_spacing_share_low"].item() is None
