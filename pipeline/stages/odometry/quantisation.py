"""Quantisation noise: what single rows of an odometer's distance are off by, measured from the rows themselves.

A counter of whole metres, stamps on receipt, noise of the reading: nothing of it adds up, but at 10 Hz a counter of
half metres seems to change its speed by metres per second from epoch to epoch. Detection uses what the rows before
show, evidence and calibration what the run shows.
"""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import periods_before_s
from pipeline.stages.odometry.rows import CountStep
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, median
from schemas.config import AlignConfig, Configuration
from schemas.frozen import frozen

# Numerics of the fit: so many rows of a piece, and the degree of its curve.
_MOST_ROWS = 16
_FEWEST_ROWS = 8
_DEGREE = 3
# Enough for the median, however long the run is; with fewer it is chance.
_PIECES = 400
_FEWEST_PIECES = 8
# So many rows, at most and at least, show a first figure; a normal distribution's median of |x|, in sigmas.
_FIRST_ROWS, _FEWEST_FIRST = 100, 5
_MEDIAN_SIGMAS = 0.6745


@frozen
class QuantisationNoise:
    """Variance [m^2] of a row at a stand, and its growth with the square of the speed [s^2]."""

    still_m2: float = 0.0
    moving_s2: float = 0.0

    def variance_m2(self, speed_mps: Floats) -> Floats:
        """Variance of a row at these speeds."""
        return self.still_m2 + self.moving_s2 * speed_mps**2

    def of_counter(self, counter_m: float) -> QuantisationNoise:
        """The scatter, at least that of the counter's step, which does not show at one speed."""
        return QuantisationNoise(max(self.still_m2, counter_m**2 / 12.0), self.moving_s2)

    def __bool__(self) -> bool:
        return self.still_m2 > 0.0 or self.moving_s2 > 0.0


NO_QUANTISATION = QuantisationNoise()


class ScatterPieces(NamedTuple):
    """Pieces of rows in which the train moves, in order of time: the row at which each is known, its mean speed [m/s],
    its variance about a smooth curve [m^2], and what white noise of the increments makes of that.
    """

    end: Ints
    speed_mps: Floats
    scatter_m2: Floats
    explained_m2: Floats

    def take(self, pieces: Ints | slice) -> ScatterPieces:
        """Some of the pieces."""
        return ScatterPieces(
            self.end[pieces], self.speed_mps[pieces], self.scatter_m2[pieces], self.explained_m2[pieces]
        )


def scatter_pieces(
    t_s: Floats,
    distance_m: Floats,
    whole: Bools,
    period_s: Floats,
    white_m2_per_s: Floats,
    deadband_mps: float,
    config: AlignConfig,
) -> ScatterPieces:
    """`whole` (rows - 1,): steps that are recorded; `period_s` of the rows and their white noise, as known at each."""
    if not whole.any():
        return ScatterPieces(np.zeros(0, dtype=np.int64), *np.zeros((3, 0)))
    shape = _moving_pieces(t_s, distance_m, whole, period_s, deadband_mps, config)
    pieces = ScatterPieces(shape.end, *np.zeros((3, shape.end.size)))
    for count in np.unique(shape.rows).tolist():
        of_count = np.flatnonzero(shape.rows == count)
        rows = shape.begin[of_count, None] + shape.stride[of_count, None] * np.arange(count)
        since_s = t_s[rows] - t_s[rows[:, :1]]
        moved_m = distance_m[rows] - distance_m[rows[:, :1]]
        pieces.speed_mps[of_count] = np.abs(moved_m[:, -1]) / since_s[:, -1]
        scatter_m2, walked_s = _scatter(since_s, moved_m)
        pieces.scatter_m2[of_count] = scatter_m2
        pieces.explained_m2[of_count] = white_m2_per_s[shape.end[of_count]] * walked_s
    return pieces


def of_the_run(pieces: ScatterPieces, config: AlignConfig) -> QuantisationNoise:
    """What rows scatter about smooth curves beyond white noise of the increments; of pieces spread over the run."""
    count = pieces.end.size
    return _fit(pieces.take(np.arange(0, count, max(1, count // _PIECES))), config)


class KnownScatter(NamedTuple):
    """Per row the terms of `QuantisationNoise`; `shown`: enough pieces before it show them.

    `shown_mps`: the one speed at which they do, infinite where noise of the stamps and of the reading are told apart.
    """

    still_m2: Floats
    moving_s2: Floats
    shown_mps: Floats
    shown: Bools


def known_at_rows(
    pieces: ScatterPieces, first_m2: Floats, renewal_s: float, t_s: Floats, config: AlignConfig
) -> KnownScatter:
    """The scatter at each row, as the last pieces before it show it.

    `first_m2`: the scatter [m^2] of each row until there are enough pieces.
    """
    size = t_s.size
    known = KnownScatter(first_m2.copy(), np.zeros(size), np.full(size, np.inf), np.zeros(size, dtype=np.bool_))
    renewed_s = -np.inf
    for number, end in enumerate(pieces.end.tolist(), start=1):
        if number >= _FEWEST_PIECES and t_s[end] - renewed_s >= renewal_s:
            last = pieces.take(slice(max(number - _PIECES, 0), number))
            found = _fit(last, config)
            known.shown_mps[end:] = np.inf if _speeds(last, config).differ else median(last.speed_mps)
            known.still_m2[end:] = found.still_m2
            known.moving_s2[end:] = found.moving_s2
            known.shown[end:] = True
            renewed_s = t_s[end]
    return known


def first_scatter_m2(
    t_s: Floats, distance_m: Floats, period_s: Floats, white_m2_per_s: Floats, config: AlignConfig
) -> Floats:
    """Variance of a row [m^2] by the rows up to each: how far each lies off the straight line through its neighbours.

    Less the same of the row before, which constant braking leaves as it is: noise of rows has 5 sigma^2 of that, white
    noise of the increments 1.5 r dt. A median of few is uncertain: by 3 / root of their number more.
    """
    if t_s.size < 4:
        return np.zeros(t_s.size)
    share = np.diff(t_s)[:-1] / np.maximum(t_s[2:] - t_s[:-2], 1e-9)
    off_line_m = distance_m[1:-1] - distance_m[:-2] - share * (distance_m[2:] - distance_m[:-2])
    changes_m = np.abs(np.diff(off_line_m))
    median_m = pl.Series(changes_m).rolling_median(_FIRST_ROWS, min_samples=_FEWEST_FIRST).fill_null(0.0).to_numpy()
    count = np.minimum(np.arange(1, changes_m.size + 1), _FIRST_ROWS)
    sigma_m = median_m / _MEDIAN_SIGMAS * (1.0 + 3.0 / np.sqrt(count))
    scatter_m2 = np.concatenate([np.zeros(3), sigma_m**2 / 5.0])
    explained_m2 = 0.3 * white_m2_per_s * period_s
    beyond = (scatter_m2 > config.quantisation_factor * explained_m2) & (period_s <= config.straight_s)
    return np.where(beyond, scatter_m2 - explained_m2, 0.0)


def _fit(pieces: ScatterPieces, config: AlignConfig) -> QuantisationNoise:
    """Medians over pieces, so that slips do not count.

    Noise of stamps grows with the square of the speed: low and high speeds are separated where their squares differ by
    `quantisation_factor`.
    """
    if pieces.end.size < _FEWEST_PIECES:
        return NO_QUANTISATION
    scatter, explained = pieces.scatter_m2, pieces.explained_m2
    fast, low_mps, high_mps, differ = _speeds(pieces, config)
    if not differ:
        return QuantisationNoise(_beyond(scatter, explained, config))
    low_m2, high_m2 = (_beyond(scatter[part], explained[part], config) for part in (~fast, fast))
    moving_s2 = max(high_m2 - low_m2, 0.0) / (high_mps**2 - low_mps**2)
    return QuantisationNoise(max(low_m2 - moving_s2 * low_mps**2, 0.0), moving_s2)


class _Speeds(NamedTuple):
    """The pieces above the median speed, the medians of both halves, and whether these differ enough."""

    fast: Bools
    low_mps: float
    high_mps: float
    differ: bool


def _speeds(pieces: ScatterPieces, config: AlignConfig) -> _Speeds:
    """Which pieces are faster than the median, and whether both halves differ enough to tell."""
    fast: Bools = pieces.speed_mps > median(pieces.speed_mps)
    low_mps, high_mps = (median(pieces.speed_mps[part]) if part.any() else 0.0 for part in (~fast, fast))
    differ = bool(fast.sum() >= _FEWEST_PIECES) and high_mps**2 >= config.quantisation_factor * low_mps**2
    return _Speeds(fast, low_mps, high_mps, differ)


class _Shapes(NamedTuple):
    """First and last row of each piece, how many rows of it are taken, and how far apart they are."""

    begin: Ints
    end: Ints
    rows: Ints
    stride: Ints


def _moving_pieces(
    t_s: Floats, distance_m: Floats, whole: Bools, period_s: Floats, deadband_mps: float, config: AlignConfig
) -> _Shapes:
    """Pieces without a gap in which the train moves, one after the other.

    None where rows are so far apart that the train drives otherwise from one to the next.
    """
    usable = (period_s > 0.0) & (period_s <= config.straight_s)
    periods_s = np.where(usable, period_s, 1.0)
    counts = np.clip(np.ceil(config.quantisation_span_s / periods_s) + 1, _FEWEST_ROWS, _MOST_ROWS).astype(np.int64)
    strides = np.maximum(1, np.round(config.quantisation_span_s / periods_s / (counts - 1))).astype(np.int64)
    ends = np.arange(t_s.size) + (counts - 1) * strides
    inside = usable & (ends < t_s.size)
    last = np.where(inside, ends, 0)
    broken = np.concatenate([[0], np.cumsum(~whole)])
    moves = np.abs(distance_m[last] - distance_m) > deadband_mps * (t_s[last] - t_s)
    taken = inside & moves & (broken[last] == broken)
    # One begins where the one before ends, wherever it can.
    begins: list[int] = []
    next_taken = np.append(np.where(taken, np.arange(t_s.size), t_s.size)[::-1], t_s.size)
    next_taken = np.minimum.accumulate(next_taken[:-1])[::-1]
    row = 0
    while row < t_s.size and (begin := int(next_taken[row])) < t_s.size:
        begins.append(begin)
        row = int(ends[begin])
    chosen = np.array(begins, dtype=np.int64)
    return _Shapes(chosen, ends[chosen], counts[chosen], strides[chosen])


def _scatter(since_s: Floats, moved_m: Floats) -> tuple[Floats, Floats]:
    """Variance about the curves [m^2] of each piece, and what white noise of the increments of 1 m^2/s makes of it."""
    count = since_s.shape[1]
    powers = (2.0 * since_s / since_s[:, -1:] - 1.0)[:, :, None] ** np.arange(_DEGREE + 1)
    curves, _ = np.linalg.qr(powers)
    fitted = curves @ (curves.transpose(0, 2, 1) @ moved_m[:, :, None])
    scatter = ((moved_m - fitted[:, :, 0]) ** 2).sum(axis=1)
    walk = np.minimum(since_s[:, :, None], since_s[:, None, :])
    left = since_s.sum(axis=1) - (curves * (walk @ curves)).sum(axis=(1, 2))
    free = count - _DEGREE - 1
    return scatter / free, left / free


def _beyond(scatter_m2: Floats, explained_m2: Floats, config: AlignConfig) -> float:
    """The median scatter less what explains it [m^2]; none where that is most of it."""
    scatter = median(scatter_m2)
    explained = median(explained_m2)
    return scatter - explained if scatter > config.quantisation_factor * explained else 0.0


@frozen
class Noise:
    """Noise of the distance as the whole run shows it: what gathers in a second, and the scatter of rows. For
    evidence and calibration; detection uses `KnownNoise`.
    """

    white_m2_per_s: float
    quantisation: QuantisationNoise = NO_QUANTISATION


@frozen
class KnownNoise:
    """The same as the rows up to each sample show it, and the period of the rows [s].

    `still_m2`, `moving_s2`: of `QuantisationNoise`; a first figure where too few rows show them yet (not `shown`). What
    shows at one speed may be noise of the stamps: beyond `shown_mps` it grows by `faster_s2` with the speed squared.
    """

    white_m2_per_s: Floats
    still_m2: Floats
    moving_s2: Floats
    faster_s2: Floats
    shown_mps: Floats
    period_s: Floats
    shown: Bools

    @cached_property
    def scatters(self) -> bool:
        """Any row has a scatter."""
        return bool(self.still_m2.any() or self.moving_s2.any() or self.faster_s2.any())

    def at(self, samples: Ints) -> KnownNoise:
        """The scatter at some of the samples."""
        return KnownNoise(*(getattr(self, each.name)[samples] for each in fields(self)))

    def row_m2(self, speed_mps: Floats) -> Floats:
        """Variance of a row [m^2]."""
        faster = np.maximum(speed_mps**2 - self.shown_mps**2, 0.0)
        return np.asarray(self.still_m2 + self.moving_s2 * speed_mps**2 + self.faster_s2 * faster)


def row_periods_s(t_ns: Ints) -> Floats:
    """The period of the rows as known before each; of the first step nothing is known but that step."""
    steps_ns = np.diff(t_ns)
    first_s = steps_ns[0] / NS_PER_S
    if (steps_ns == steps_ns[0]).all():
        return np.full(t_ns.size, first_s)
    period_s = periods_before_s(t_ns)
    period_s[:2] = first_s
    return period_s


def noise_of_rows(
    t_s: Floats,
    distance_m: Floats,
    whole: Bools,
    counts: CountStep,
    period_s: Floats,
    declared_mps: Floats,
    config: Configuration,
) -> tuple[Noise, KnownNoise]:
    """Noise as the run shows it, and as the rows up to each do.

    `whole`: steps that the counter recorded without a gap; `counts`, `period_s`, `declared_mps`: step of the counter,
    period and sigma of the speed as known at each row.
    """
    align = config.align
    least_m2_per_s = config.monitors.odometer_sigma_mps**2
    white_m2_per_s = np.maximum(least_m2_per_s, np.nan_to_num(declared_mps) ** 2 * period_s)
    pieces = scatter_pieces(t_s, distance_m, whole, period_s, white_m2_per_s, config.matching.deadband_mps, align)
    noise = Noise(
        white_m2_per_s=median(white_m2_per_s),
        quantisation=of_the_run(pieces, align).of_counter(float(counts.step_m[-1])),
    )
    # Rows far apart, or of speeds alone, have no such noise.
    none = (period_s > align.straight_s) | ~np.concatenate([whole[:1], whole])
    first_m2 = np.zeros(t_s.size)
    if not none.all():
        first_m2 = np.where(none, 0.0, first_scatter_m2(t_s, distance_m, period_s, white_m2_per_s, align))
    known = known_at_rows(pieces, first_m2, config.monitors.noise_renewal_s, t_s, align)
    return noise, KnownNoise(
        white_m2_per_s=white_m2_per_s,
        still_m2=np.maximum(known.still_m2, counts.step_m**2 / 12.0),
        moving_s2=known.moving_s2,
        # Twice what the counts explain are still the counts.
        faster_s2=np.maximum(known.still_m2 - counts.step_m**2 / 6.0, 0.0) / known.shown_mps**2,
        shown_mps=known.shown_mps,
        period_s=period_s,
        shown=known.shown | none | counts.shown,
    )
