"""Markov model of the LDS with reactive fail-safety (TVB section 4, Fig. 3b).

P0 works; P1 SBAS faulty, diagnosis works; P2 fault detected and negated; P3 diagnosis faulty.
The transition figure is lost from the text, and eq. 1 fixes P0 and P1: P0 goes to P1 at HR_SBAS and
to P3 at HR_Diag, P1 to P2 at mu = 1/T_D; P2 and P3 are not left.
"""

from __future__ import annotations

import math
from dataclasses import asdict, astuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.studies.safety.budget import S_PER_H, levels_table
from schemas.config import SafetyConfig
from schemas.frozen import frozen


@frozen
class LdsModel:
    """Rates of the model [1/h] and the time to detect and negate [h], whose inverse is mu."""

    hr_sbas_per_h: float
    hr_diag_per_h: float
    time_to_detect_h: float

    @property
    def mu_per_h(self) -> float:
        """Rate of detection and negation, 1 / T_D [1/h]."""
        return 1.0 / self.time_to_detect_h


@frozen
class StateProbabilities:
    """Probabilities of the four states P0 to P3 [1]; they sum to one."""

    p0: float
    p1: float
    p2: float
    p3: float


def exact_probabilities(model: LdsModel, t_h: float) -> StateProbabilities:
    """Probabilities after `t_h` hours, started in P0: P1 is TVB eq. 1 in a form that does not cancel."""
    leave = model.hr_sbas_per_h + model.hr_diag_per_h
    p0 = math.exp(-leave * t_h)
    left = -math.expm1(-leave * t_h)
    p1 = model.hr_sbas_per_h * p0 * _integrated_decay_h(model.mu_per_h - leave, t_h)
    p3 = model.hr_diag_per_h / leave * left
    p2 = model.hr_sbas_per_h / leave * left - p1
    return StateProbabilities(p0, p1, max(0.0, p2), p3)


def _integrated_decay_h(rate_per_h: float, t_h: float) -> float:
    """(1 - exp(-rate t)) / rate, with its limit t at rate 0."""
    return -math.expm1(-rate_per_h * t_h) / rate_per_h if rate_per_h != 0.0 else t_h


def approximate_p1(model: LdsModel) -> float:
    """P1 for t well beyond T_D: HR_SBAS T_D (TVB eq. 2)."""
    return model.hr_sbas_per_h * model.time_to_detect_h


def approximation_error(model: LdsModel, t_h: float) -> float:
    """Relative error of eq. 2 against eq. 1: +0.58 at t = T_D, where P1 has reached 63 % of it."""
    return approximate_p1(model) / exact_probabilities(model, t_h).p1 - 1.0


def generator_matrix(model: LdsModel) -> NDArray[np.float64]:
    """Rates from row state to column state [1/h]; rows sum to zero."""
    rates = np.zeros((4, 4))
    rates[0, 1] = model.hr_sbas_per_h
    rates[0, 3] = model.hr_diag_per_h
    rates[1, 2] = model.mu_per_h
    np.fill_diagonal(rates, -rates.sum(axis=1))
    return rates


def numeric_probabilities(model: LdsModel, t_h: float) -> StateProbabilities:
    """The model solved from its generator alone, as a check on the formulas."""
    from scipy.linalg import expm

    # p(t) = p(0) exp(Q t) with p(0) = (1, 0, 0, 0): the first row of the matrix exponential.
    row = expm(generator_matrix(model) * t_h)[0]
    return StateProbabilities(*(float(value) for value in row))


def lds_hazard_rate_per_h(hr_sbas_per_h: float, time_to_detect_s: float) -> float:
    """HR of the LDS over a mission of one hour [1/h] = HR_SBAS T_D 1/h (TVB section 4, LOC eq. 1)."""
    return hr_sbas_per_h * time_to_detect_s / S_PER_H


def markov_table(config: SafetyConfig) -> pl.DataFrame:
    """The model of each service level at its allowed T_D and later: exact, numeric, approximated."""
    rows = []
    for level, rate, allowed_s in levels_table(config).iter_rows():
        model = LdsModel(rate, config.diagnosis_hazard_rate_per_h, allowed_s / S_PER_H)
        times_h = (model.time_to_detect_h, 0.25, 1.0, 8.0)
        rows += [_markov_row(level, model, t_h, config.thr_vb_per_h) for t_h in times_h]
    return pl.DataFrame(rows)


def _markov_row(level: str, model: LdsModel, t_h: float, thr_per_h: float) -> dict[str, object]:
    """The model of one service level, solved in closed form and numerically."""
    state = exact_probabilities(model, t_h)
    solved = numeric_probabilities(model, t_h)
    difference = max(abs(a - b) for a, b in zip(astuple(state), astuple(solved), strict=True))
    return {
        "service_level": level,
        "hr_sbas_per_h": model.hr_sbas_per_h,
        "hr_diag_per_h": model.hr_diag_per_h,
        "mu_per_h": model.mu_per_h,
        "time_to_detect_s": model.time_to_detect_h * S_PER_H,
        "t_h": t_h,
        **asdict(state),
        "p1_approximate": approximate_p1(model),
        "approximation_error": approximation_error(model, t_h),
        "p1_numeric": solved.p1,
        "numeric_difference": difference,
        # P3 has no way back in this model, so its mean rate stays: at 1e-9 /h it uses up THR_VB alone (DOMAIN 6).
        "p3_rate_per_h": state.p3 / t_h,
        "thr_vb_per_h": thr_per_h,
        "p3_rate_beyond_thr": state.p3 > thr_per_h * t_h,
    }
