"""Robust regression of movements on movements: scale, lag, and how sure both are."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from schemas.arrays import Bools, Floats, Ints, median
from schemas.frozen import frozen

# 1.4826 MAD is the sigma of normal residuals, whatever less than half of them do.
_MAD = 1.4826
# A change of speed, as a share of the usual one.
_CHANGES = 0.5
# So many lengths of a movement are left out to see how much depends on them.
_LEFT_OUT = 6
# Numerics: with less independent information about scale and lag, as a share of the whole, they are not told apart.
_LEAST_INDEPENDENT = 1e-12
# Noise is correlated over so many lengths of a movement, beyond those that overlap.
_MEMORY = 10
# Changes of speed, and movements, are more than noise by so many sigmas; far lags are worse than the one found by so
# many.
SHOWN, WORSE = 6.0, 3.0


class LagState(StrEnum):
    """Whether a lag is measured, and why not."""

    MEASURED = "measured"
    TOO_FEW = "too few ways"
    CONSTANT_SPEED = "the speed changes too little"
    AMBIGUOUS = "several lags fit"


@frozen
class ScaleLag:
    """Movement of the other recorder over that counted; stamp of a moment by the other minus the counter's [s].

    Standard deviations next to them, infinite where a figure is not measured: 4 of them hold whatever the noise is
    like. `halves`: scale and lag of the first and the second half of the run alone.
    """

    scale: float = 1.0
    scale_sigma: float = float("inf")
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    state: LagState = LagState.TOO_FEW
    halves: tuple[tuple[float, float], ...] = ()

    @property
    def measured(self) -> bool:
        """Both scale and lag are known."""
        return self.state is LagState.MEASURED


@frozen
class Regression:
    """movement = design @ (scale, scale * rest of the lag), by instrumental variables, over the `used` movements.

    `instruments`: the same columns from other rows of the counter, so that their noise is not that of `design`.
    `overlap_count`: movements that overlap each one, itself included.
    """

    design: Floats
    instruments: Floats
    moved_m: Floats
    used: Bools
    overlap_count: int

    def solved(self, assumed_s: float) -> ScaleLag:
        """Scale and lag."""
        if not self._changes_show():
            return ScaleLag(state=LagState.CONSTANT_SPEED)
        scale, sigma, rest_s, sigma_s = self.with_sigmas(slice(None))
        halves = self.halves(assumed_s)
        return ScaleLag(
            scale=scale,
            scale_sigma=max(sigma, half_apart(halves)),
            lag_s=assumed_s + rest_s / scale,
            lag_sigma_s=sigma_s / abs(scale),
            state=LagState.MEASURED,
            halves=halves,
        )

    def with_sigmas(self, parts: slice) -> list[float]:
        """Each part of the estimate, and its sigma: the largest of several estimates of the noise."""
        design, instruments = (values[:, parts] * self.used[:, None] for values in (self.design, self.instruments))
        inverse = np.linalg.inv(instruments.T @ design)
        # Instrumental variables: theta = (Z' X)^-1 Z' y; its covariance (Z' X)^-1 S (Z' X)^-T, S that of Z' e.
        theta = inverse @ (instruments.T @ self.moved_m)
        left = np.where(self.used, self.moved_m - design @ theta, 0.0)
        spreads = [
            _spread(instruments, left, self.used, reach) for reach in (self.overlap_count, _MEMORY * self.overlap_count)
        ]
        variances = np.max([np.diag(inverse @ one @ inverse.T) for one in spreads], axis=0)
        sigmas = student_factor(self.used.sum() / self.overlap_count - 2.0) * np.sqrt(np.maximum(variances, 0.0))
        sigmas = np.maximum(sigmas, self._without_one(design, instruments, theta))
        return [float(value) for pair in zip(theta, sigmas, strict=True) for value in pair]

    def _without_one(self, design: Floats, instruments: Floats, theta: Floats) -> Floats:
        """Largest change of each part of the estimate without one change of speed, one minute, one quarter.

        One change of speed alone looks like a step or drift of the other recorder, or a slip, that came with it and
        may last as long.
        """
        moments = instruments[:, :, None] * np.concatenate([design, self.moved_m[:, None]], axis=1)[:, None, :]
        # Sums up to each row: what any stretch contributes is the difference of two of them.
        sums = np.cumsum(np.concatenate([np.zeros((1, *moments.shape[1:])), moments]), axis=0)
        reach = max(self.overlap_count + 1, min(_LEFT_OUT * self.overlap_count, len(design) // 4))
        begin = np.arange(len(design) - reach + 1)
        end = begin + reach
        if theta.size > 1:
            changes = self._changes()
            begin, end = np.append(begin, changes[0]), np.append(end, changes[1])
        left = sums[-1] - (sums[end] - sums[begin])
        normal, right = left[:, :, :-1], left[:, :, -1:]
        if not np.all(np.linalg.det(normal)):
            return np.full(theta.size, np.inf)
        return np.asarray(np.abs(np.linalg.solve(normal, right)[:, :, 0] - theta).max(axis=0))

    def _changes(self) -> tuple[Ints, Ints]:
        """First row of each change of speed, and the one after its last: one sense, whatever outliers are in it.

        Where the speed changes by less than half as much as it does usually it does not change.
        """
        used = np.flatnonzero(self.used)
        change = self.instruments[used, 1]
        usual = float(np.sqrt(np.mean(change[change != 0.0] ** 2)))
        rows = np.flatnonzero(np.abs(change) > _CHANGES * usual)
        other = (np.diff(rows) > self.overlap_count) | (np.diff(np.sign(change[rows])) != 0.0)
        begin, end = used[rows[np.append(True, other)]], used[rows[np.append(other, True)]] + 1
        return begin, end

    def _changes_show(self) -> bool:
        """Two figures of each change of speed, by other rows, have in common more than their noise would by chance."""
        if _alike_columns(self.instruments[self.used].T @ self.design[self.used]):
            return False
        near, instruments = self.design[self.used, 1], self.instruments[self.used, 1]
        noise = 0.5 * float(((near - instruments) ** 2).sum()) / np.sqrt(near.size / self.overlap_count)
        return bool(near @ instruments > SHOWN * noise)

    def halves(self, assumed_s: float, parts: slice = slice(None)) -> tuple[tuple[float, float], ...]:
        """Scale and lag by the first and by the second half of the movements."""
        rows = np.flatnonzero(self.used)
        found = []
        for half in (rows[: rows.size // 2], rows[rows.size // 2 :]):
            design, instruments = self.design[half, parts], self.instruments[half, parts]
            if not _alike_columns(instruments.T @ design):
                scale, *rest = np.linalg.solve(instruments.T @ design, instruments.T @ self.moved_m[half]).tolist()
                found.append((scale, assumed_s + (rest[0] / scale if rest and scale else 0.0)))
        return tuple(found)


def half_apart(halves: Sequence[tuple[float, float]]) -> float:
    """Half of what the scales of both halves differ by: a drift of the other recorder is one of them for a while."""
    return 0.5 * abs(halves[0][0] - halves[1][0]) if len(halves) == 2 else float("inf")


def solved_moments(design: Floats, instruments: Floats, moved_m: Floats) -> Floats:
    """Scale and scale * lag; the scale alone where nothing tells the lag."""
    normal = instruments.T @ design
    if _alike_columns(normal):
        return np.array([float(design[:, 0] @ moved_m / (design[:, 0] @ design[:, 0])), 0.0])
    return np.asarray(np.linalg.solve(normal, instruments.T @ moved_m))


def has_enough_movements(values: Floats) -> Bools:
    """Lags (rows) at which at least half as many movements are known as at any."""
    counts = np.isfinite(values).sum(axis=1)
    enough: Bools = counts >= max(0.5 * counts.max(initial=0), 3)
    return enough


def _alike_columns(normal: Floats) -> bool:
    """Movements and changes of speed are proportional, or there are no changes: nothing tells the two apart."""
    return bool(abs(np.linalg.det(normal)) <= _LEAST_INDEPENDENT * abs(float(np.prod(np.diag(normal)))))


def widened(rows: Bools, reach: int) -> Bools:
    """These rows, and so many on both sides: an outlier's neighbour begins or ends in the same slip or step."""
    return np.asarray(np.convolve(rows, np.ones(2 * reach + 1), "same")[: rows.size] > 0.5)


def robust_sigma(size: Floats) -> float:
    """Sigma of normal values of this size, whatever a part of them does."""
    return _MAD * median(size) if size.size else 0.0


def huber_loss(size: Floats, limit: float) -> Floats:
    """Square up to the limit, then straight on (Huber 1964)."""
    return np.where(size <= limit, size**2, limit * (2.0 * size - limit))


def least_absolute_scale(counted: Floats, moved_m: Floats) -> Floats:
    """Per row of `counted` (lags, movements) the scale with the least sum of absolute differences: a weighted
    median.
    """
    weight = np.where(np.isnan(counted), 0.0, np.abs(counted))
    ratio = np.where(weight > 0.0, moved_m / np.where(weight > 0.0, counted, 1.0), np.inf)
    order = np.argsort(ratio, axis=1)
    sums = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    middle = np.minimum((sums < 0.5 * sums[:, -1:]).sum(axis=1), ratio.shape[1] - 1)
    scale = np.take_along_axis(ratio, np.take_along_axis(order, middle[:, None], axis=1), axis=1)[:, 0]
    return np.where(np.isfinite(scale), scale, 1.0)


def _spread(instruments: Floats, left: Floats, used: Bools, reach: int) -> Floats:
    """Variance of the moments where the noise is alike everywhere: by its autocovariance up to `reach` movements."""
    count = min(reach + 1, left.size)
    counts = used.astype(np.float64)
    # How many pairs are so far apart: of whole numbers all products at once are the same to the last bit.
    pairs = sliding_window_view(np.append(counts, np.zeros(count - 1)), left.size) @ counts
    sums = np.array([left[apart:] @ left[: left.size - apart] for apart in range(count)])
    share = 1.0 - np.arange(count) / (reach + 1.0)
    covariance = share * sums / np.maximum(pairs, 1.0)
    total: Floats = covariance[0] * instruments.T @ instruments
    for apart in range(1, count):
        product = covariance[apart] * instruments[apart:].T @ instruments[:-apart]
        total += product + product.T
    return total


def student_factor(free: float) -> float:
    """What makes 4 sigmas from so many degrees of freedom as sure as of a normal one (Abramowitz, Stegun 26.7.5)."""
    free = max(free, 2.0)
    return 1.0 + 4.25 / free + 16.0 / free**2
