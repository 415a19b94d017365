"""False alarms of the pseudorange monitor by heading, constellation and survey, counted and in theory.

A survey error is constant in place. Over many places it has the survey's own sigma, which the monitor's covariance
holds; at one place it is a bias, and the alarms there are those of a noncentral chi-square: fewer or more.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import polars as pl
from scipy.special import chdtrc, chdtri

from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.ranges import HEADINGS_DEG, RangePlan, Statistic, held_rows, statistic
from datasets.experiment.tables import Row, share, table
from datasets.experiment.workers import in_pieces
from schemas.arrays import Floats, Ints

# Error of the survey across and in height, in its stated sigma; none: drawn anew for every epoch.
SURVEYS: tuple[float | None, ...] = (None, 0.0, 1.0, 2.0)
_BLOCK = 50_000


def range_alarms(probabilities: tuple[float, ...], epochs: int, seed: int, jobs: int = 1) -> pl.DataFrame:
    """One row per constellation, heading, survey and probability; the epochs are drawn independently."""
    rows: list[Row] = []
    for number, constellation in enumerate(CONSTELLATIONS):
        count = partial(_count_alarms, constellation, probabilities)
        counts = np.sum(in_pieces(count, epochs, _BLOCK, (seed, 53, number), jobs), axis=0)
        plan = RangePlan(default_geometry(constellation))
        for h, s, p in np.ndindex(counts.shape):
            heading = HEADINGS_DEG[h]
            survey = SURVEYS[s]
            probability = probabilities[p]
            one = statistic(plan, heading)
            rows.append(
                {
                    "constellation": constellation,
                    "heading_deg": heading,
                    "survey_error_sigmas": survey,
                    "intended": probability,
                    "expected": _expected(plan, one, heading, survey, probability),
                    "runs": epochs,
                    "alarms": int(counts[h, s, p]),
                    **share("measured", int(counts[h, s, p]), epochs),
                    "at_1e_7": _expected(plan, one, heading, survey, 1e-7),
                }
            )
    return table(rows)


def _count_alarms(
    constellation: Constellation, probabilities: tuple[float, ...], epochs: int, rng: np.random.Generator
) -> Ints:
    """Epochs beyond each limit, (headings, surveys, probabilities)."""
    plan = RangePlan(default_geometry(constellation))
    sigma = np.sqrt(plan.geometry.range_variance_m2.sum(axis=1))[:, None]
    errors = sigma * rng.standard_normal((sigma.size, epochs))
    drawn = plan.survey_m * rng.standard_normal((2, epochs))
    counts = np.zeros((len(HEADINGS_DEG), len(SURVEYS), len(probabilities)), dtype=np.int64)
    for h, heading in enumerate(HEADINGS_DEG):
        one = statistic(plan, heading)
        held = held_rows(plan, heading)
        limits = chdtri(one.project.shape[0], np.array(probabilities))
        z = one.project @ errors
        for s, survey in enumerate(SURVEYS):
            off = drawn if survey is None else np.full((2, 1), survey * plan.survey_m)
            value = np.square(z - one.project @ held @ off).sum(axis=0)
            counts[h, s] = (value[:, None] > limits).sum(axis=0)
    return counts


def _expected(plan: RangePlan, one: Statistic, heading: float, survey: float | None, probability: float) -> float:
    """Probability in theory: chi-square over all places, at one place that of a sum of squares around its bias."""
    if survey is None:
        return probability
    held = one.project @ held_rows(plan, heading)
    limit = float(chdtri(one.project.shape[0], probability))
    # Known survey error: the residuals' covariance is less by the survey's, in two directions, so the sum of squares
    # is of normals of unequal variance.
    basis, scales, _ = np.linalg.svd(held * plan.survey_m, full_matrices=False)
    variance = 1.0 - scales**2
    centre = basis.T @ held @ np.full(2, survey * plan.survey_m)
    return _tail(one.project.shape[0] - variance.size, variance, centre, limit)


def _tail(plain: int, variance: Floats, centre: Floats, limit: float) -> float:
    """P(chi2 with `plain` degrees + v1 X1^2 + v2 X2^2 > limit), X around centre/sqrt(v), by Gauss-Legendre twice."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    x = 9.0 * nodes
    density = 9.0 * weights * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    first, second = (np.square(np.sqrt(v) * x + c) for v, c in zip(variance, centre, strict=True))
    left = limit - first[:, None] - second[None, :]
    tails = np.where(left > 0.0, chdtrc(plain, np.maximum(left, 0.0)), 1.0)
    return float(density @ tails @ density)
