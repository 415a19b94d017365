"""Rows that repeat at a higher rate are copies; a frozen receiver stays."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.clean.clean import held_positions


def track(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 50.0 + 1.5e-4 * times + 1e-6 * np.sin(times), 4.5 + 1e-4 * times


@pytest.mark.parametrize("period", [2, 5, 10])
def test_nine_of_ten_rows_are_copies(period):
    t_s = np.arange(1000) / 10.0
    held = held_positions(t_s, *track(t_s[np.arange(1000) // period * period]))
    assert np.flatnonzero(~held).tolist() == list(range(0, 1000, period))


def test_a_frozen_receiver_stays_at_its_own_rate():
    t_s = np.arange(1000) / 10.0
    at = np.arange(1000) // 10 * 10
    at[500:700] = 500
    held = held_positions(t_s, *track(t_s[at]))
    assert np.flatnonzero(~held).tolist() == list(range(0, 1000, 10))


def test_a_receiver_that_freezes_for_ten_seconds_at_its_own_rate_has_no_copies():
    t_s = np.arange(1000) / 10.0
    at = np.arange(1000)
    at[500:600] = 500
    assert not held_positions(t_s, *track(t_s[at])).any()


def test_coarse_digits_are_no_copies():
    """Digits of 1e-5 deg at a speed that grows to 3 m/s."""
    t_s = np.arange(3000) / 10.0
    way = 0.005 * t_s**2
    latitude = np.round(50.0 + way / 111_000.0, 5)
    assert not held_positions(t_s, latitude, np.full(3000, 4.5)).any()


def test_outages_are_no_copies():
    t_s = np.arange(1000) / 10.0
    latitude, longitude = track(t_s)
    latitude[100:900] = np.nan
    assert not held_positions(t_s, latitude, longitude).any()
