"""False alarms of the pseudorange monitor by heading, constellation and survey, counted and in theory.

A survey error is constant in place. Over many places it has the survey's own sigma, which the monitor's covariance
holds; at one place it is a bias, and the alarms there are those of a noncentral chi-square: fewer or more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl
from scipy.special import chdtrc, chdtri

from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.ranges import HEADINGS_DEG, RangePlan, Statistic, held_rows, statistic
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from pipeline.figures.bounds import clopper_pearson
from schemas.arrays import Floats

# Error of the survey across and in height, in its stated sigma; none: drawn anew for every epoch.
SURVEYS: tuple[float | None, ...] = (None, 0.0, 1.0, 2.0)
_BLOCK = 50_000


@dataclass(frozen=True)
class _Count:
    constellation: Constellation
    probabilities: tuple[float, ...]
    key: tuple[int, ...]
    epochs: int


def range_alarms(probabilities: tuple[float, ...], epochs: int, seed: int, jobs: int = 1) -> pl.DataFrame:
    """One row per constellation, heading, survey and probability; the epochs are drawn independently."""
    rows = []
    for number, constellation in enumerate(CONSTELLATIONS):
        works = [
            _Count(constellation, probabilities, (seed, 53, number, block), size)
            for block, size in enumerate(in_blocks(epochs, _BLOCK))
        ]
        counts = np.sum(mapped(_counted, works, jobs), axis=0)
        plan = RangePlan(default_geometry(constellation))
        for h, heading in enumerate(HEADINGS_DEG):
            one = statistic(plan, heading)
            for s, survey in enumerate(SURVEYS):
                for p, probability in enumerate(probabilities):
                    share = clopper_pearson(int(counts[h, s, p]), epochs)
                    rows.append(
                        {
                            "constellation": constellation,
                            "heading_deg": heading,
                            "survey_error_sigmas": survey,
                            "intended": probability,
                            "expected": _expected(plan, one, heading, survey, probability),
                            "runs": epochs,
                            "alarms": int(counts[h, s, p]),
                            "measured": share.value,
                            "measured_low": share.low,
                            "measured_high": share.high,
                            "at_1e_7": _expected(plan, one, heading, survey, 1e-7),
                        }
                    )
    return pl.DataFrame(rows, infer_schema_length=None)


def _counted(work: _Count) -> npt.NDArray[np.int64]:
    """Epochs beyond each limit, (headings, surveys, probabilities)."""
    plan, rng = RangePlan(default_geometry(work.constellation)), generator(*work.key)
    sigma = np.sqrt(plan.geometry.range_variance_m2.sum(axis=1))[:, None]
    errors = sigma * rng.standard_normal((sigma.size, work.epochs))
    drawn = plan.survey_m * rng.standard_normal((2, work.epochs))
    counts = np.zeros((len(HEADINGS_DEG), len(SURVEYS), len(work.probabilities)), dtype=np.int64)
    for h, heading in enumerate(HEADINGS_DEG):
        one, held = statistic(plan, heading), held_rows(plan, heading)
        limits = chdtri(one.project.shape[0], np.array(work.probabilities))
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
