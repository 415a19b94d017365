"""The grid of biases across the track, worked out by hand: nine values 0.9 sigmas apart."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.matching.likelihood import hypotheses_of
from schemas.config import MatchingConfig

CONFIG = MatchingConfig(cross_bias_sigma_m=3.0, slow_share=0.5)


def test_a_bias_goes_on_by_the_share_that_outlasts_the_element() -> None:
    """3 m of the run, 6 m of the survey: of 45 m2 a fifth goes on, and 1 - 0.2^2 of the variance is drawn anew."""
    found = hypotheses_of(0.0, 36.0, 1.0, CONFIG).renewal
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    # From the middle, 0.9 sigmas away against none; from 0.9 sigmas, 0.72 away against 0.18.
    assert found[4, 5] / found[4, 4] == pytest.approx(np.exp(-0.5 * 0.81 / 0.96))
    assert found[5, 5] / found[5, 4] == pytest.approx(np.exp(-0.5 * (0.72**2 - 0.18**2) / 0.96))


def test_with_a_perfect_survey_the_bias_stays() -> None:
    """8 m2 of slow errors, half of the position's 16, and 9 m2 of the run: 4.1231 m, scattered by half the spacing."""
    found = hypotheses_of(16.0, 0.0, 1.0, CONFIG)
    np.testing.assert_allclose(found.renewal, np.eye(9), atol=1e-9)
    assert found.bias_m[-1] == pytest.approx(3.6 * 4.1231 * np.sqrt(1.0 - 0.45**2), abs=1e-3)
    assert found.within_m == pytest.approx(np.full(9, 0.45 * 4.1231), abs=1e-3)
    assert found.log_prior[4] - found.log_prior[5] == pytest.approx(0.5 * 0.81)


def test_the_truth_may_be_larger_than_stated() -> None:
    """Four times as large: 1, 2 and 4 times, the larger the likelier; each with its own slow errors."""
    found = hypotheses_of(16.0, 0.0, 4.0, CONFIG)
    assert found.scale.tolist() == pytest.approx([1.0] * 9 + [2.0] * 9 + [4.0] * 9)
    assert np.exp(found.log_prior).reshape(3, 9).sum(axis=1) == pytest.approx([1 / 7, 2 / 7, 4 / 7])
    assert found.within_m[[0, 9, 18]] == pytest.approx(0.45 * np.sqrt([17.0, 41.0, 137.0]))
    assert (found.renewal[:9, 9:] == 0.0).all()
