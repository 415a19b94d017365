"""What a step says of the run's bias, and what becomes of it where tracks join: tables worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.matching.likelihood import Likelihood, Terms, initial_terms, step_terms
from pipeline.stages.matching.search import log_mass, merged
from schemas.arrays import Ints

# One candidate, one scale: bias 2 m, noise 1 m about it, of which 0.9 is left at the next step.
LIKE = Likelihood(
    log_prior=np.zeros(1),
    bias_m2=np.array([4.0]),
    variance_m2=np.array([[1.0]]),
    fresh_m2=np.array([[0.19]]),
    keep=np.array([0.9]),
    fixed=np.array([-0.5]),
    direct=np.array([-0.25]),
    off=np.array([False]),
    outlier_sigmas=3.0,
)
FIRST: Ints = np.zeros(1, dtype=np.int64)


def at(terms: Terms, bias_m: float) -> float:
    """Log-likelihood of a bias."""
    constant, linear, precision = terms[:, 0, 0]
    return float(constant + linear * bias_m - 0.5 * precision * bias_m**2)


@pytest.mark.parametrize(
    ("movement_m", "level_m", "bias_m", "expected"),
    [
        # 0.9 movement + 0.1 (level - bias) is Gaussian of 0.19 m2: log density -0.0886 - value^2 / 0.38.
        (0.0, 0.0, 0.0, -0.0886),
        (0.0, 2.0, 2.0, -0.0886),
        (0.1, 1.0, 0.0, -0.1836),
        (0.1, 1.0, 1.0, -0.1099),
        (-0.1, 1.0, 0.0, -0.0888),
        (1.0, 0.0, 0.0, -2.2201),
        # The level is held at 3 sqrt(4 + 1) = 6.708 m: it says nothing of the bias.
        (0.0, 10.0, 0.0, -1.2728),
        (0.0, 10.0, 5.0, -1.2728),
        # A movement of 1.8 m is beyond 3 sqrt(0.19): it counts as three sigmas of 0.6 m.
        (2.0, 0.0, 0.0, -4.9081),
        (-2.0, 0.0, 0.0, -4.9081),
    ],
)
def test_a_step_is_judged_by_what_it_adds(movement_m: float, level_m: float, bias_m: float, expected: float) -> None:
    terms = step_terms(np.array([movement_m]), np.array([level_m]), FIRST, LIKE)
    assert at(terms, bias_m) == pytest.approx(expected - 0.5, abs=1e-4)


@pytest.mark.parametrize(
    ("offset_m", "bias_m", "expected"),
    [
        # Offset less bias is Gaussian of 1 m2: -0.9189 - value^2 / 2.
        (0.0, 0.0, -0.9189),
        (1.0, 0.0, -1.4189),
        (1.0, 1.0, -0.9189),
        (-3.0, 1.0, -8.9189),
        # 9 m are beyond 3 sqrt(4 + 1): of 3^2 m2 together with the bias, so of 5 m2 without.
        (9.0, 0.0, -9.8237),
        (9.0, 4.0, -4.2237),
    ],
)
def test_a_first_step_is_judged_by_its_offset(offset_m: float, bias_m: float, expected: float) -> None:
    terms = initial_terms(np.array([offset_m]), FIRST, LIKE)
    assert at(terms, bias_m) == pytest.approx(expected - 0.75, abs=1e-4)


def test_the_bias_is_weighed_by_its_prior() -> None:
    """Over all biases an offset is Gaussian of 4 + 1 m2; the prior alone has its scale's probability."""
    assert log_mass(LIKE.prior()) == pytest.approx(LIKE.log_prior)
    masses = [log_mass(LIKE.prior() + initial_terms(np.array([y]), FIRST, LIKE)[:, 0]) for y in (0.0, 1.0, 2.0, -4.0)]
    assert [float(one[0] - masses[0][0]) for one in masses] == pytest.approx([0.0, -0.1, -0.4, -1.6])


def gaussian(mass: float, mean_m: float, variance_m2: float) -> list[float]:
    """Terms of a Gaussian of the bias."""
    return [
        np.log(mass) - 0.5 * mean_m**2 / variance_m2 - 0.5 * np.log(variance_m2),
        mean_m / variance_m2,
        1 / variance_m2,
    ]


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        # Mass, mean and variance: the variance is that within and that of the means.
        ((0.5, 0.0, 1.0), (0.5, 2.0, 1.0), (1.0, 1.0, 2.0)),
        ((0.5, 1.0, 1.0), (0.5, 1.0, 3.0), (1.0, 1.0, 2.0)),
        ((0.75, 0.0, 1.0), (0.25, 4.0, 1.0), (1.0, 1.0, 4.0)),
        ((3.0, 2.0, 0.5), (1.0, 2.0, 0.5), (4.0, 2.0, 0.5)),
    ],
)
def test_where_tracks_join_their_biases_become_one(
    one: tuple[float, ...], other: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    entered = np.array([gaussian(*one), gaussian(*other)]).T[:, :, None, None]
    constant, linear, precision = merged(entered, log_mass(entered))[:, 0, 0]
    assert (linear / precision, 1.0 / precision) == pytest.approx(expected[1:])
    assert np.exp(log_mass(np.array([constant, linear, precision]))) == pytest.approx(expected[0])
