"""The Markov model: formulas against the generator, against an integration, and at their limits."""

import math
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pipeline.studies.safety import safety_tables
from pipeline.studies.safety.markov import (
    LdsModel,
    approximate_p1,
    approximation_error,
    exact_probabilities,
    generator_matrix,
    numeric_probabilities,
)
from schemas.config import SafetyConfig

LPV200 = LdsModel(4.8e-6, 1e-9, 0.5025 / 3600)


def test_eq_1_as_printed() -> None:
    rate, diagnosis, mu, t = 0.3, 0.2, 4.0, 0.7
    printed = -rate * (math.exp(-(rate + diagnosis) * t) - math.exp(-mu * t)) / (rate + diagnosis - mu)
    assert exact_probabilities(LdsModel(rate, diagnosis, 1 / mu), t).p1 == pytest.approx(printed, rel=1e-12)


def test_eq_2_after_an_hour() -> None:
    assert approximate_p1(LPV200) == pytest.approx(0.67e-9, rel=1e-12)
    assert approximation_error(LPV200, 1.0) == pytest.approx(4.8e-6, rel=0.01)


def test_eq_2_is_reached_by_63_percent_after_the_time_to_detect() -> None:
    share = exact_probabilities(LPV200, LPV200.time_to_detect_h).p1 / approximate_p1(LPV200)
    assert share == pytest.approx(1 - math.exp(-1), abs=1e-6)
    assert approximation_error(LPV200, LPV200.time_to_detect_h) == pytest.approx(0.58, abs=0.005)


def test_equal_rates_are_the_limit_and_no_division_by_zero() -> None:
    model = LdsModel(0.5, 0.5, 1.0)
    assert exact_probabilities(model, 2.0).p1 == pytest.approx(0.5 * 2.0 * math.exp(-2.0))
    near = LdsModel(0.5, 0.5, 1.0 / (1.0 + 1e-12))
    assert exact_probabilities(near, 2.0).p1 == pytest.approx(exact_probabilities(model, 2.0).p1, rel=1e-9)


@settings(deadline=None, max_examples=60)
@given(
    st.floats(1e-9, 1e-2), st.floats(1e-12, 1e-2), st.floats(0.05 / 3600, 1.0), st.floats(1e-4, 10.0)
)  # fmt: skip
def test_formulas_and_generator_agree(rate: float, diagnosis: float, detect_h: float, t_h: float) -> None:
    model = LdsModel(rate, diagnosis, detect_h)
    formula, solved = astuple(exact_probabilities(model, t_h)), astuple(numeric_probabilities(model, t_h))
    assert formula == pytest.approx(solved, rel=1e-6, abs=1e-15)
    assert sum(formula) == pytest.approx(1.0, abs=1e-12)
    assert all(0.0 <= p <= 1.0 for p in formula)


def test_formulas_agree_with_an_integration_in_time() -> None:
    model = LdsModel(0.8, 0.3, 0.25)
    rates = generator_matrix(model)
    path = solve_ivp(lambda _, p: p @ rates, (0.0, 3.0), [1.0, 0.0, 0.0, 0.0], rtol=1e-10, atol=1e-12)
    assert astuple(exact_probabilities(model, 3.0)) == pytest.approx(tuple(path.y[:, -1]), rel=1e-7)


def test_no_probability_leaves_the_model() -> None:
    assert np.allclose(generator_matrix(LPV200).sum(axis=1), 0.0, atol=1e-12)


def test_diagnosis_at_sil_4_alone_exceeds_the_thr() -> None:
    """No HR_Diag is published; at 1e-9/h P3 after an hour is beyond THR_VB."""
    assert exact_probabilities(LPV200, 1.0).p3 == pytest.approx(1e-9, rel=1e-5)
    assert exact_probabilities(LPV200, 1.0).p3 > 0.67e-9
    assert safety_tables(SafetyConfig())["markov"]["p3_rate_beyond_thr"].all()
    table = safety_tables(SafetyConfig())["markov"]
    assert table["p3_rate_per_h"].to_numpy() == pytest.approx(1e-9, rel=1e-4)
    assert table["thr_vb_per_h"].to_list() == [0.67e-9] * table.height
    better = SafetyConfig(diagnosis_hazard_rate_per_h=1e-10)
    assert not safety_tables(better)["markov"]["p3_rate_beyond_thr"].any()


def test_table_holds_its_own_check() -> None:
    assert safety_tables(SafetyConfig())["markov"]["numeric_difference"].max() < 1e-14
