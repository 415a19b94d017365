"""Bounds against printed values, against scipy.stats, and by their coverage of a known truth."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.stages.run_row.bounds import (
    UNKNOWN,
    clopper_pearson,
    hours_still_needed,
    hours_to_substantiate,
    poisson_rate,
    poisson_rate_upper,
)


def test_no_event_gives_the_well_known_bounds() -> None:
    estimate = poisson_rate(0, 1.0)
    assert (estimate.value, estimate.low) == (0.0, 0.0)
    assert estimate.high == pytest.approx(3.6889, abs=5e-5)
    assert poisson_rate_upper(0, 1.0) == pytest.approx(2.9957, abs=5e-5)


@pytest.mark.parametrize(
    ("events", "low", "high"),
    [(1, 0.0253, 5.5716), (2, 0.2422, 7.2247), (5, 1.6235, 11.6683), (10, 4.7954, 18.3904), (50, 37.1110, 65.9188)],
)
def test_two_sided_poisson_bounds_as_in_printed_tables(events: int, low: float, high: float) -> None:
    estimate = poisson_rate(events, 1.0)
    assert (estimate.low, estimate.high) == (pytest.approx(low, abs=5e-4), pytest.approx(high, abs=5e-4))


@given(st.integers(0, 500), st.floats(1e-3, 1e6), st.floats(0.5, 0.999))
def test_poisson_bounds_are_chi_square_quantiles(events: int, hours: float, confidence: float) -> None:
    from scipy import stats  # takes long to load, in each of the test processes

    tail = (1 - confidence) / 2
    estimate = poisson_rate(events, hours, confidence)
    low = stats.chi2.ppf(tail, 2 * events) / 2 / hours if events else 0.0
    assert estimate.low == pytest.approx(low, rel=1e-7)
    assert estimate.high == pytest.approx(stats.chi2.ppf(1 - tail, 2 * events + 2) / 2 / hours, rel=1e-7)
    assert estimate.low <= events / hours <= estimate.high


@given(st.integers(0, 300), st.integers(0, 300), st.floats(0.5, 0.999))
def test_clopper_pearson_bounds_are_those_of_scipy(successes: int, failures: int, confidence: float) -> None:
    from scipy import stats  # takes long to load, in each of the test processes

    trials = successes + failures
    estimate = clopper_pearson(successes, trials, confidence)
    if trials == 0:
        assert estimate == UNKNOWN
        return
    expected = stats.binomtest(successes, trials).proportion_ci(confidence, method="exact")
    assert estimate.low == pytest.approx(expected.low, rel=1e-7, abs=1e-12)
    assert estimate.high == pytest.approx(expected.high, rel=1e-7)
    assert estimate.low <= successes / trials <= estimate.high


def test_without_exposure_nothing_is_known() -> None:
    assert poisson_rate(0, 0.0) == UNKNOWN
    assert poisson_rate(3, float("nan")) == UNKNOWN
    assert poisson_rate_upper(0, 0.0) is None
    assert clopper_pearson(0, 0) == UNKNOWN


def test_all_or_none_of_the_trials() -> None:
    assert clopper_pearson(0, 10).low == 0.0
    assert clopper_pearson(0, 10).high == pytest.approx(0.3085, abs=5e-5)
    assert clopper_pearson(10, 10).low == pytest.approx(0.6915, abs=5e-5)
    assert clopper_pearson(10, 10).high == 1.0


@pytest.mark.parametrize("call", [lambda: poisson_rate(-1, 1.0), lambda: clopper_pearson(3, 2)])
def test_impossible_counts_are_refused(call: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"events|successes"):
        call()


@pytest.mark.parametrize("confidence", [0.0, 1.0, float("nan")])
def test_impossible_confidence_is_refused(confidence: float) -> None:
    with pytest.raises(ValueError, match="confidence"):
        poisson_rate(1, 1.0, confidence)


def test_thr_of_a_virtual_balise_needs_billions_of_hours() -> None:
    """DOMAIN section 6: 4.47e9 fault-free hours for 0.67e-9/h at 95 %."""
    assert hours_to_substantiate(0.67e-9) == pytest.approx(4.47e9, abs=0.005e9)


def test_an_event_makes_the_claim_dearer() -> None:
    assert hours_to_substantiate(1e-3, events=1) == pytest.approx(4743.9, abs=0.1)
    assert hours_still_needed(1e-3, 1, 743.9) == pytest.approx(4000.0, abs=0.1)
    assert hours_still_needed(1e-3, 0, 1e9) == 0.0


def test_hours_substantiate_just_the_bound() -> None:
    hours = hours_to_substantiate(2e-4, events=3)
    assert poisson_rate_upper(3, hours) == pytest.approx(2e-4, rel=1e-9)


# Exact bounds are conservative for few expected events (97.5 % or more at 0.5) and close in on 95 %
# from above as there are more: hence a floor for all and a ceiling for many.
COVERAGE_FLOOR = 0.93


@pytest.mark.parametrize(("mean", "ceiling"), [(0.5, 1.0), (3.0, 1.0), (30.0, 0.97), (200.0, 0.97)])
def test_poisson_bounds_cover_the_truth(mean: float, ceiling: float) -> None:
    counts = np.random.default_rng(41).poisson(mean, 1000)
    hits = [estimate.low <= mean <= estimate.high for estimate in (poisson_rate(int(k), 1.0) for k in counts)]
    assert COVERAGE_FLOOR <= np.mean(hits) <= ceiling


@pytest.mark.parametrize(("share", "trials", "ceiling"), [(0.02, 50, 1.0), (0.3, 40, 1.0), (0.5, 1000, 0.97)])
def test_clopper_pearson_covers_the_truth(share: float, trials: int, ceiling: float) -> None:
    counts = np.random.default_rng(43).binomial(trials, share, 1000)
    hits = [e.low <= share <= e.high for e in (clopper_pearson(int(k), trials) for k in counts)]
    assert COVERAGE_FLOOR <= np.mean(hits) <= ceiling


@pytest.mark.parametrize("mean", np.geomspace(0.05, 80.0, 40))
def test_poisson_coverage_is_never_below_what_it_claims(mean: float) -> None:
    """Without chance: the probability of all counts whose bounds hold the truth."""
    from scipy import stats  # takes long to load, in each of the test processes

    counts = np.arange(400)
    holds = [e.low <= mean <= e.high for e in (poisson_rate(int(k), 1.0) for k in counts)]
    assert stats.poisson.pmf(counts, mean)[holds].sum() >= 0.95 - 1e-12


def test_one_sided_bound_covers_the_truth() -> None:
    counts = np.random.default_rng(47).poisson(100.0, 1000)
    hits = [poisson_rate_upper(int(k), 10.0) >= 10.0 for k in counts]
    assert 0.93 <= np.mean(hits) <= 0.97
