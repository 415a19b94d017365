"""Long series made short enough to send: extremes stay, changes stay, and what matters stays whole."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

BINS = 2500
WHOLE_SERIES = 4 * BINS
"""A series of no more values is sent as it is."""


def kept_rows(values: Floats, whole: Bools, bins: int = BINS) -> Ints:
    """Rows of a series to send: of each bin the smallest and largest value and where it begins or ends to be known.

    `whole` marks rows that stay in any case; a series that is short anyway stays as it is.
    """
    count = len(values)
    if count <= 4 * bins:
        return np.arange(count)
    edges = np.linspace(0, count, bins + 1).astype(np.int64)
    known = np.isfinite(values)
    rows = [
        _extreme_rows(np.where(known, values, np.inf), edges, np.minimum),
        _extreme_rows(np.where(known, values, -np.inf), edges, np.maximum),
        _edges_of(known, edges),
        np.flatnonzero(whole),
        np.array([0, count - 1]),
    ]
    return np.unique(np.concatenate(rows))


def worst_rows(codes: Ints, stride: int) -> Ints:
    """The first row with the largest code of every so many: what is bad is not left out."""
    edges = np.append(np.arange(0, len(codes), stride), len(codes))
    return _extreme_rows(codes.astype(np.float64), edges, np.maximum)


def _extreme_rows(values: Floats, edges: Ints, extreme: np.ufunc) -> Ints:
    """The first row of each bin that holds the bin's extreme."""
    # Rows at the extreme of their bin; all others lie behind the last row.
    peaks = extreme.reduceat(values, edges[:-1])
    at_peak = values == np.repeat(peaks, np.diff(edges))
    rows = np.where(at_peak, np.arange(len(values)), len(values))
    return np.minimum.reduceat(rows, edges[:-1])


def _edges_of(known: Bools, edges: Ints) -> Ints:
    """First and last change between known and unknown in each bin, both sides of it."""
    changes = np.flatnonzero(np.diff(known)) + 1
    if not len(changes):
        return np.array([], dtype=np.int64)
    bins = np.searchsorted(edges, changes, side="right")
    first = np.flatnonzero(np.diff(bins, prepend=-1))
    last = np.append(first[1:] - 1, len(changes) - 1)
    chosen = changes[np.unique(np.concatenate([first, last]))]
    return np.concatenate([chosen - 1, chosen])


def detail_rows(t_ns: Ints, moments_ns: Ints, reach_s: float = 60.0, limit: int = 6000) -> Bools:
    """Rows near the moments that matter, with a reach that is halved until no more than `limit` are left."""
    reach_ns = reach_s * 1e9
    if not len(moments_ns) or not len(t_ns):
        return np.zeros(len(t_ns), dtype=np.bool_)
    moments = np.sort(moments_ns)
    after = np.clip(np.searchsorted(moments, t_ns), 0, len(moments) - 1)
    before = np.clip(after - 1, 0, None)
    away = np.minimum(np.abs(moments[after] - t_ns), np.abs(moments[before] - t_ns))
    while (away <= reach_ns).sum() > limit and reach_ns >= 1e6:
        reach_ns /= 2.0
    return np.asarray(away <= reach_ns)


@frozen
class Band:
    """Pieces of constant state: piece i has `codes[i]` from `starts_ms[i]` to the next start, the last to `end_ms`."""

    starts_ms: Ints
    codes: Ints
    end_ms: int


def state_band(t_ms: Ints, codes: Ints, hold_ms: int, gap_code: int, pieces: int = 3000) -> Band:
    """A state over time as pieces; `gap_code` fills what is longer than `hold_ms` after an epoch.

    Codes are ordered by how bad they are. Where there are too many pieces, neighbours are drawn together and
    the worst of them, the largest code, stands for all: an alarm of one epoch stays visible.
    """
    if not len(t_ms):
        return Band(np.array([], dtype=np.int64), np.array([], dtype=np.int64), 0)
    gaps = np.flatnonzero(np.diff(t_ms) > hold_ms)
    times = np.concatenate([t_ms, t_ms[gaps] + hold_ms])
    states = np.concatenate([codes, np.full(len(gaps), gap_code)])
    order = np.argsort(times, kind="stable")
    end_ms = int(t_ms[-1]) + hold_ms
    starts, states = _merge_equal(times[order], states[order])
    if len(starts) > pieces:
        edges = np.linspace(int(t_ms[0]), end_ms, pieces + 1).astype(np.int64)[:-1]
        starts, states = _merge_equal(*_worst_by_bin(starts, states, edges))
    return Band(starts, states, end_ms)


def _merge_equal(starts: Ints, codes: Ints) -> tuple[Ints, Ints]:
    """Neighbouring pieces of one state made one."""
    first = np.flatnonzero(np.diff(codes, prepend=-1))
    return starts[first], codes[first]


def _worst_by_bin(starts: Ints, codes: Ints, edges: Ints) -> tuple[Ints, Ints]:
    """Bins, each with the worst of the pieces that reach into it."""
    first = np.searchsorted(starts, edges, side="right") - 1
    last = np.append(np.searchsorted(starts, edges[1:], side="left"), len(starts))
    # `reduceat` goes from each bound to the next: every other of its values is of a bin.
    bounds = np.column_stack([first, last]).ravel()
    padded = np.append(codes, -1)
    return edges, np.maximum.reduceat(padded, bounds)[::2]
