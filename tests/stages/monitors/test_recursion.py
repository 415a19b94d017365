"""Recursions of the bank against the formulas written out, epoch by epoch, and against simulation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.stages.monitors.axis import (
    AxisSeries,
    AxisState,
    before_steps,
    errors_of,
    ewma_weight,
    increment_variance,
    linear_recurrence,
    run_axis,
    variance_of_ewma,
)
from schemas.config import MonitorConfig

SHARES = np.array([0.083, 0.014, 0.150, 0.752])
TAUS_S = np.array([360.0, 1800.0, 3600.0, 100.0])
ALPHAS = np.array([0.1, 0.01, 0.001])


def by_hand(alpha, dt_s, sigma2_m2, odometer_sigma_mps):
    """DOMAIN section 3, as printed, for one alpha."""
    v, c, result = 0.0, np.zeros(4), []
    for dt, sigma2 in zip(dt_s, sigma2_m2, strict=True):
        r, phi = SHARES * sigma2, np.exp(-dt / TAUS_S)
        weight = 1.0 - (1.0 - alpha) ** dt
        b, g = 1.0 - weight, 1.0 / dt
        gain = weight * g
        sources = gain**2 * ((1 - phi) ** 2 * r + r * (1 - phi**2)) - 2 * gain * b * (1 - phi) * c
        v = b**2 * v + sources.sum() + gain**2 * odometer_sigma_mps**2 * dt
        c = b * phi * c + gain * (phi * (phi - 1) * r + r * (1 - phi**2))
        result.append(v)
    return np.array(result)


def exact(dt_s, sigma2_m2, odometer_sigma_mps=0.05):
    weight = ewma_weight(ALPHAS, dt_s)
    sigma_m = np.sqrt(np.outer(sigma2_m2, SHARES))
    decorrelation = -np.expm1(-dt_s[:, None] / TAUS_S)
    errors = sigma_m, before_steps(sigma_m, decorrelation, 1.5), decorrelation
    white_m2 = odometer_sigma_mps**2 * dt_s
    variance, _ = variance_of_ewma(
        1.0 - weight,
        weight / dt_s[:, None],
        *errors,
        increment_variance(*errors) + white_m2,
        white_m2,
        AxisState.at_restart(3, 4),
    )
    return variance


@pytest.mark.parametrize("period_s", [0.1, 1.0])
@pytest.mark.parametrize("sigma2", [0.5, 4.0])
def test_variance_follows_the_recursion_through_gaps(period_s, sigma2):
    dt_s = np.full(700, period_s)
    dt_s[200], dt_s[450] = 40.0, 7.3
    sigma2_m2 = np.full(dt_s.size, sigma2)
    expected = np.column_stack([by_hand(alpha, dt_s, sigma2_m2, 0.05) for alpha in ALPHAS])
    np.testing.assert_allclose(exact(dt_s, sigma2_m2), expected, rtol=1e-9)


@pytest.mark.parametrize("period_s", [0.1, 1.0])
@pytest.mark.parametrize("accuracy", ["slow", "restless"])
def test_a_changing_accuracy_follows_the_printed_recursion(period_s, accuracy):
    t_s = np.arange(600.0 / period_s) * period_s
    restless = np.random.default_rng(8).uniform(0.9, 1.6, t_s.size)
    sigma2_m2 = restless if accuracy == "restless" else 1.0 + 0.5 * np.sin(t_s / 200.0)
    dt_s = np.full(t_s.size, period_s)
    dt_s[t_s.size // 2] = 25.0
    expected = np.column_stack([by_hand(alpha, dt_s, sigma2_m2, 0.05) for alpha in ALPHAS])
    np.testing.assert_allclose(exact(dt_s, sigma2_m2), expected, rtol=1e-9)


def test_an_accuracy_that_jumps_up_and_creeps_down_for_hours_keeps_its_variance_bounded():
    sigma2_m2 = np.tile(np.geomspace(25.0, 0.25, 30), 400)
    found = exact(np.ones(sigma2_m2.size), sigma2_m2)
    first, last = found[3000:3030], found[-30:]
    assert (found > 0).all()
    np.testing.assert_allclose(last[:, :2], first[:, :2], rtol=1e-3)
    assert (last[:, 2] < 2.0 * first[:, 2]).all()


def test_a_variance_is_never_less_than_what_is_new_in_it():
    """Sigma falls by 1.4 a second, phi is 1/2: the printed form falls below what is new, g^2 (R (1 - phi^2) + w)."""
    sigma_m, lost, gain = 10.0 * 1.4 ** -np.arange(14.0)[:, None], np.full((14, 1), 0.5), np.full((14, 1), 0.3)
    white_m2, printed, c = np.full(14, 0.01), [], 0.0
    for r in (sigma_m**2).ravel().tolist():
        v = printed[-1] if printed else 0.0
        printed.append(0.7**2 * v + 0.3**2 * (0.25 * r + 0.75 * r + 0.01) - 2.0 * 0.3 * 0.7 * 0.5 * c)
        c = 0.7 * 0.5 * c + 0.3 * (0.75 - 0.25) * r
    errors = sigma_m, sigma_m, lost
    increment_m2 = increment_variance(*errors) + white_m2
    found, _ = variance_of_ewma(1.0 - gain, gain, *errors, increment_m2, white_m2, AxisState.at_restart(1, 1))
    least = 0.3**2 * (0.75 * sigma_m.ravel() ** 2 + 0.01)
    below = np.flatnonzero(np.array(printed) < least)
    assert 3 <= below.size < 14
    np.testing.assert_allclose(found[: below[0], 0], printed[: below[0]], rtol=1e-12)
    np.testing.assert_allclose(found[below[0], 0], least[below[0]], rtol=1e-12)


def test_variance_stays_true_where_the_accuracy_jumps():
    """Sigma between 0.1 and 5 m every 20 s, against 4,000 sampled paths: within 15 %, and never negative."""
    from scipy.signal import lfilter  # takes long to load

    rng = np.random.default_rng(5)
    paths, n = 4_000, 121
    sigma_m = np.where((np.arange(n) // 20) % 2 == 0, 0.1, 5.0)
    error = np.zeros((paths, n))
    for share, tau in zip(SHARES, TAUS_S, strict=True):
        phi = np.exp(-1.0 / tau)
        noise = rng.standard_normal((paths, n)) * np.sqrt(1 - phi**2)
        noise[:, 0] = rng.standard_normal(paths)
        error += np.sqrt(share) * sigma_m * lfilter([1.0], [1.0, -phi], noise, axis=1)
    rate = np.diff(error, axis=1)
    sampled = np.column_stack([lfilter([a], [1.0, a - 1.0], rate, axis=1).var(axis=0) for a in ALPHAS])
    weight = ewma_weight(ALPHAS, np.ones(n - 1))
    sources = np.outer(sigma_m, np.sqrt(SHARES))
    errors = sources[1:], sources[:-1], np.broadcast_to(-np.expm1(-1.0 / TAUS_S), (n - 1, 4))
    found, _ = variance_of_ewma(
        1.0 - weight,
        weight,
        *errors,
        increment_variance(*errors),
        np.zeros(n - 1),
        AxisState.at_restart(3, 4),
    )
    assert (found > 0).all()
    np.testing.assert_allclose(found, sampled, rtol=0.15)


@pytest.mark.parametrize("period_s", [0.1, 1.0])
def test_variance_tends_to_the_derived_limit(period_s):
    """g^2 a/(2-a) [sum 2R(1-phi) - 2R(1-phi)^2 b/(1-b phi) + s^2], DOMAIN section 3."""
    n = int(15_000 / period_s)
    last = exact(np.full(n, period_s), np.ones(n))[-1]
    weight = 1.0 - (1.0 - ALPHAS) ** period_s
    b, phi = 1.0 - weight, np.exp(-period_s / TAUS_S)
    rise = 2 * SHARES * (1 - phi)
    back = 2 * SHARES * (1 - phi) ** 2 * b[:, None] / (1 - b[:, None] * phi)
    limit = weight / (2 - weight) / period_s**2 * ((rise - back).sum(axis=1) + 0.05**2 * period_s)
    np.testing.assert_allclose(last, limit, rtol=1e-6)


def test_variance_agrees_with_simulation():
    """2,000 seeded paths at 1 Hz, epoch 300 after a restart: within 10 % of the sampled variance."""
    from scipy.signal import lfilter  # takes long to load

    rng = np.random.default_rng(11)
    paths, n = 2_000, 301
    error = np.zeros((paths, n))
    for share, tau in zip(SHARES, TAUS_S, strict=True):
        phi = np.exp(-1.0 / tau)
        noise = rng.standard_normal((paths, n)) * np.sqrt(share * (1 - phi**2))
        noise[:, 0] = rng.standard_normal(paths) * np.sqrt(share)
        error += lfilter([1.0], [1.0, -phi], noise, axis=1)
    rate = np.diff(error, axis=1) - 0.05 * rng.standard_normal((paths, n - 1))
    sampled = [lfilter([a], [1.0, a - 1.0], rate, axis=1)[:, -1].var() for a in ALPHAS]
    np.testing.assert_allclose(exact(np.ones(n - 1), np.ones(n - 1))[-1], sampled, rtol=0.1)


@given(st.integers(0, 300), st.integers(1, 4), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_linear_recurrence_is_the_loop(n, channels, seed):
    rng = np.random.default_rng(seed)
    decay = rng.uniform(0, 1, (n, channels))
    decay[rng.random((n, channels)) < 0.05] = 0.0
    drive, state = rng.standard_normal((n, channels)), rng.standard_normal(channels)
    result = linear_recurrence(decay, drive, state.copy())
    for k in range(n):
        state = decay[k] * state + drive[k]
        np.testing.assert_allclose(result[k], state, rtol=1e-12, atol=1e-12)


def test_a_weight_of_two_half_seconds_is_that_of_one_second():
    half, whole = ewma_weight(ALPHAS, np.array([0.5, 1.0]))
    np.testing.assert_allclose(1 - (1 - half) ** 2, whole, rtol=1e-12)
    np.testing.assert_allclose(whole, ALPHAS, rtol=1e-12)


def test_sigmas_before_steps_leave_the_sigmas_as_they_are():
    """The first source steps at row 2, the second at row 1; a source without memory knows no step."""
    sigma_m = np.array([[1.0, 1.0, 1.0], [1.0, 3.0, 3.0], [2.0, 3.0, 1.0], [2.0, 3.0, 1.0]], order="F")
    kept, decorrelation = sigma_m.copy(), np.tile([0.01, 0.01, 1.0], (4, 1))
    before = before_steps(sigma_m, decorrelation, 1.5)
    assert sigma_m.tolist() == kept.tolist()
    assert before.tolist() == [[1.0, 1.0, 1.0], [1.0, 1.0, 3.0], [1.0, 3.0, 1.0], [2.0, 3.0, 1.0]]


@pytest.mark.parametrize("first", [1, 2, 9])
def test_an_axis_goes_on_from_where_it_stopped(first):
    """Averages and sigmas, uncertain scale and latency among them, are those of a run in one go."""
    dice, count = np.random.default_rng(5), 20
    dt_s, zero, nothing = dice.uniform(0.5, 2.0, count), np.zeros(count), np.zeros(count, dtype=bool)
    series = AxisSeries(
        epoch=np.arange(count),
        fresh=np.arange(count) == 0,
        border=nothing,
        dt_s=dt_s,
        rate_mps=dice.normal(size=count),
        **errors_of(dice.uniform(0.5, 3.0, count), dt_s, [], MonitorConfig()),
        white_m2=0.0025 * dt_s,
        border_m2=zero,
        lasting_mps=np.column_stack([dice.uniform(0.1, 1.0, count), dice.normal(size=count)]),
    )
    value, sigma, _ = run_axis(series, ALPHAS)
    *before, state = run_axis(series.rows_between(0, first), ALPHAS)
    *after, _ = run_axis(series.rows_between(first, count), ALPHAS, state)
    for whole, parts in zip((value, sigma), zip(before, after, strict=True), strict=True):
        np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-9)


def test_where_a_block_ends_leaves_the_sigmas_as_they_are():
    """Noise that falls brings the recursion below what is new: cut anywhere, it goes on as in one go."""
    count = 14
    dt_s, zero, nothing = np.ones(count), np.zeros(count), np.zeros(count, dtype=bool)
    series = AxisSeries(
        epoch=np.arange(count),
        fresh=np.arange(count) == 0,
        border=nothing,
        dt_s=dt_s,
        rate_mps=zero,
        **errors_of(np.full(count, 1e-3), dt_s, [], MonitorConfig()),
        white_m2=zero,
        border_m2=zero,
        lasting_mps=np.zeros((zero.size, 0)),
    )
    alphas, noise_m2 = np.array([0.3]), np.tile(np.where(np.arange(count) < 6, 4.0, 0.04)[:, None], (1, 2))
    whole = run_axis(series, alphas, None, noise_m2)[1]
    for cut in range(1, count):
        _, before, state = run_axis(series.rows_between(0, cut), alphas, None, noise_m2[:cut])
        _, after, _ = run_axis(series.rows_between(cut, count), alphas, state, noise_m2[cut:])
        np.testing.assert_allclose(np.concatenate([before, after]), whole, rtol=1e-12)
