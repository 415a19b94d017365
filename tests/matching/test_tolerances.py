"""How far beside a track a position may lie, and covariances that contradict themselves, worked out by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.matching.epochs import on_track_limit_m
from pipeline.matching.fixes import contradictory_covariances
from schemas.config import MatchingConfig


@pytest.mark.parametrize(
    ("sigma_m", "survey_m", "limit_m"),
    [
        (3.0, 2.0, 3.0 * np.sqrt(9.0 + 4.0 + 2.25)),
        (3.0, np.nan, 3.0 * np.sqrt(9.0 + 1.0 + 2.25)),  # 1 m where the survey says nothing
        (40.0, 0.0, 50.0),  # no track is looked for farther away
    ],
)
def test_a_position_is_on_track_within_three_roots_of_all_it_may_err(
    sigma_m: float, survey_m: float, limit_m: float
) -> None:
    found = on_track_limit_m(np.array([sigma_m]), np.array([survey_m]), MatchingConfig())
    assert found[0] == pytest.approx(limit_m)


@pytest.mark.parametrize(
    ("east_m2", "both_m2", "north_m2", "count"),
    [(0.5, 0.5, 0.5, 1), (0.5, -0.6, 0.5, 1), (0.5, 0.49, 0.5, 0), (0.0, 0.5, 0.5, 0), (0.5, 0.5, 0.0, 0)],
)
def test_no_covariance_is_larger_than_its_variances_allow(
    east_m2: float, both_m2: float, north_m2: float, count: int
) -> None:
    frame = pl.DataFrame({"cov_ee_m2": [east_m2], "cov_en_m2": [both_m2], "cov_nn_m2": [north_m2]})
    assert contradictory_covariances(frame) == count
