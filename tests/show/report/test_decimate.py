"""Short series keep what matters of long ones."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.show.report.decimate import detail_rows, kept_rows, state_band


def test_short_series_stay_whole() -> None:
    assert kept_rows(np.arange(10.0), np.zeros(10, dtype=bool), bins=3).tolist() == list(range(10))


# A busy machine draws slowly; that says nothing of the code.
@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))), min_size=41, max_size=300),
    st.integers(2, 10),
)
def test_extremes_of_every_bin_stay(values: list[float], bins: int) -> None:
    series = np.array(values)
    rows = kept_rows(series, np.zeros(len(series), dtype=bool), bins)
    assert rows.tolist() == sorted(set(rows.tolist()))
    if len(series) <= 4 * bins:
        assert len(rows) == len(series)
        return
    assert len(rows) <= 6 * bins + 2
    edges = np.linspace(0, len(series), bins + 1).astype(int)
    for begin, end in itertools.pairwise(edges):
        part, kept = series[begin:end], series[rows[(rows >= begin) & (rows < end)]]
        if np.isfinite(part).any():
            assert np.nanmax(kept) == np.nanmax(part)
            assert np.nanmin(kept) == np.nanmin(part)


def test_a_gap_of_one_epoch_stays() -> None:
    series = np.sin(np.arange(10_000) / 50.0)
    series[4321] = np.nan
    rows = kept_rows(series, np.zeros(len(series), dtype=bool), bins=100)
    assert 4321 in rows
    assert {4320, 4322} & set(rows.tolist())


def test_marked_rows_stay() -> None:
    whole = np.zeros(10_000, dtype=bool)
    whole[700:900] = True
    rows = kept_rows(np.zeros(10_000), whole, bins=10)
    assert set(range(700, 900)) <= set(rows.tolist())


def test_detail_is_near_the_moments_and_within_its_limit() -> None:
    t_ns = np.arange(0, 3600 * 10) * 100_000_000
    moments = np.array([1000, 2000]) * 1_000_000_000
    near = detail_rows(t_ns, moments, reach_s=60.0, limit=10_000)
    assert near.sum() == 2 * 1201
    fewer = detail_rows(t_ns, moments, reach_s=60.0, limit=700)
    assert 2 * 300 <= fewer.sum() <= 700
    assert fewer[10_000]
    assert fewer[20_000]
    assert not detail_rows(t_ns, np.array([], dtype=np.int64)).any()


def test_pieces_of_a_band() -> None:
    t_ms = np.array([0, 100, 200, 300, 5000, 5100])
    pieces = state_band(t_ms, np.array([1, 1, 2, 1, 1, 1]), hold_ms=1000, gap_code=0)
    assert pieces.starts_ms.tolist() == [0, 200, 300, 1300, 5000]
    assert pieces.codes.tolist() == [1, 2, 1, 0, 1]
    assert pieces.end_ms == 6100


@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(st.lists(st.integers(1, 3), min_size=50, max_size=400), st.integers(1, 20))
def test_the_worst_state_of_a_crowded_band_is_seen(codes: list[int], limit: int) -> None:
    """Wherever an epoch has a state, what is drawn there is at least as bad."""
    t_ms = np.arange(len(codes)) * 100
    pieces = state_band(t_ms, np.array(codes), hold_ms=1000, gap_code=0, pieces=limit)
    assert len(pieces.starts_ms) <= max(limit, 1) or len(pieces.starts_ms) <= len(codes)
    drawn = pieces.codes[np.searchsorted(pieces.starts_ms, t_ms, side="right") - 1]
    assert np.all(drawn >= np.array(codes))
    assert max(codes) == pieces.codes.max()


def test_no_epochs_no_pieces() -> None:
    nothing = np.array([], dtype=np.int64)
    assert len(state_band(nothing, nothing, 1000, 0).starts_ms) == 0


@pytest.mark.parametrize("size", [1, 2, 41])
def test_ends_stay(size: int) -> None:
    rows = kept_rows(np.full(size, np.nan), np.zeros(size, dtype=bool), bins=5)
    assert {0, size - 1} <= set(rows.tolist())
