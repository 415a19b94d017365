"""The fast noise of one axis, measured in the run from what came before (DOMAIN section 3).

What second differences of the offset (GNSS minus odometer or track) show beyond the model is added to the thresholds: a
constant ramp has no second difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri

from pipeline.stages.monitors.axis import AxisSeries, error_model
from schemas.arrays import Bools, Floats, Ints, median
from schemas.config import Configuration, MonitorConfig
from schemas.frozen import frozen

# M = (second difference)^2 / 4 is exact for a random walk; for white noise, whose second differences have six times its
# variance, it is 6 / 4 of it, so on the safe side (DOMAIN section 3).
OF_WALK = 4.0
OF_WHITE_NOISE = 6.0


class NoiseMeter:
    """Fast noise of one axis, row by row of its series; rows under alarm never enter."""

    def __init__(
        self,
        series: AxisSeries,
        moving: Bools,
        given_m: tuple[float, ...] | None,
        config: Configuration,
        sampler: Sampler | None = None,
    ):
        """Prepare the second differences of all lags, unless the noise is given.

        Args:
            series: increments of the axis over the whole run, n rows.
            moving: whether the train moves at each of them, shape (n,).
            given_m: deviation of the noise by monitor (raw, then the EWMAs) [m]; replaces what is measured.
            config: the configuration; used is `monitors`.
            sampler: of the same series, where another meter made one.
        """
        self._series = series
        self._config = config.monitors
        self._limit_m2 = config.noise_limit_m**2
        self._given_m2 = None if given_m is None else np.square(np.array(given_m))
        self._memories_s = np.array([0.0, *(1.0 / alpha for alpha in self._config.ewma_alphas)])
        sampler = sampler or Sampler(series, moving, self._config)
        self._renewal = sampler.renewal
        self._lags_s: list[float] = []
        self._samples: list[_SecondDifferences] = []
        if given_m is None and series.dt_s.size > 2:
            self._lags_s = _lags_s(sampler.period_s, self._memories_s)
            longest_s = max(self._config.noise_longest_lag_s, sampler.period_s)
            self._samples = [sampler.over(lag_s) for lag_s in self._lags_s if lag_s <= longest_s]
        self._entering = [np.arange(samples.row.size) for samples in self._samples]

    def freeze(self, row: int) -> None:
        """No row from this one on enters the noise."""
        for index, samples in enumerate(self._samples):
            entering = self._entering[index]
            self._entering[index] = entering[: np.searchsorted(samples.row[entering], row)]

    def restart(self, row: int) -> None:
        """From this row on samples enter the noise again, those whose three rows all lie at it or after it."""
        self.freeze(row)
        for index, samples in enumerate(self._samples):
            later = np.arange(np.searchsorted(samples.oldest, row), samples.row.size)
            self._entering[index] = np.concatenate([self._entering[index], later])

    def known_from(self) -> int:
        """The first row whose noise is known; the number of rows where none is."""
        if self._given_m2 is not None:
            return 0
        if not self._samples or self._samples[0].row.size < self._samples[0].ready:
            return self._renewal.size
        enough = self._samples[0].renewal[self._samples[0].ready - 1]
        return int(np.searchsorted(self._renewal, enough, side="right"))

    def variance_m2(self, begin: int, end: int) -> Floats:
        """M of the rows [begin, end) by monitor: raw, then the EWMAs; NaN where not known yet."""
        if self._given_m2 is not None:
            return np.tile(self._given_m2[:, None], (1, end - begin)).T
        if not self._samples or begin == end:
            return np.full((end - begin, self._memories_s.size), np.nan)
        renewals = np.arange(self._renewal[begin], self._renewal[end - 1] + 1)
        by_lag = self._by_lag(renewals)
        of_row = self._renewal[begin:end] - renewals[0]
        # A monitor takes the noise of the lag nearest to its memory; after a pause, that of a lag as long as the pause.
        bounds_s = 1.5 * np.array(self._lags_s[:-1])
        nearest = np.searchsorted(bounds_s, self._memories_s)
        at_least = np.searchsorted(bounds_s, self._series.dt_s[begin:end])
        columns = (by_lag[:, lag][of_row] for lag in nearest)
        noise_m2 = np.vstack(list(columns)).T
        after_pause = np.flatnonzero(at_least)
        lags = np.maximum(nearest, at_least[after_pause, None])
        noise_m2[after_pause] = by_lag[of_row[after_pause, None], lags]
        return np.asarray(noise_m2)

    def stated_excess_m2(self) -> Floats:
        """What the lags of 10 and 100 s that are ready show beyond the stated sigma, row by row [m^2], causally.

        0 until one is ready; s_L^2 - S_L is four times M without its doubt.
        """
        renewals, of_row = np.unique(self._renewal, return_inverse=True)
        row = np.searchsorted(self._renewal, renewals)
        excess_m2 = np.zeros(renewals.size)
        for index, samples in enumerate(self._samples):
            if self._lags_s[index] in self._memories_s[1:]:
                end, ready = self._until(index, renewals)
                ends, window = np.unique(end, return_inverse=True)
                found_m2, error, _ = samples.looked_back(self._entering[index], ends)
                model_m2 = _model_at_m2(self._series, row, self._lags_s[index], self._config)
                shown_m2 = model_m2 + OF_WALK * found_m2[window]
                lag_m2 = excess_of(shown_m2, model_m2, error[window], self._config)
                excess_m2 = np.maximum(excess_m2, np.where(ready, lag_m2, 0.0))
        return np.asarray(excess_m2[of_row])

    def _until(self, index: int, renewals: Ints) -> tuple[Ints, Bools]:
        """How many samples of a lag count at each renewal, and whether they are enough."""
        samples = self._samples[index]
        before = np.searchsorted(samples.renewal[self._entering[index]], renewals)
        # The latest samples wait: a drift, whose onset shows in samples for 2 L, must not raise its own thresholds.
        waiting = round(self._config.noise_wait_spans * samples.span)
        end = np.maximum(before - waiting, np.minimum(before, samples.ready))
        return end, end >= samples.ready

    def _by_lag(self, renewals: Ints) -> Floats:
        """M of every lag (columns) at these renewals (rows): measured, or expected from the shorter lags until it is.

        M(lag) = M(shorter) + growth x (model(lag) - model(shorter)). The growth is that of the lag before, 0 for white
        noise; at the shortest lag all noise is taken for smooth. A decline from lag to lag goes on in the same ratio;
        it never rises.
        """
        row = np.searchsorted(self._renewal, renewals)
        model_m2 = np.column_stack([_model_at_m2(self._series, row, lag_s, self._config) for lag_s in self._lags_s])
        noise_m2 = np.empty_like(model_m2)
        measured_m2, ready = self._measured(0, renewals, row)
        noise_m2[:, 0] = np.where(ready, measured_m2, np.nan)
        growth = _ratio(noise_m2[:, 0], model_m2[:, 0])
        for index in range(1, len(self._lags_s)):
            shorter_m2 = noise_m2[:, index - 1]
            more_m2 = model_m2[:, index] - model_m2[:, index - 1]
            expected_m2 = self._capped(shorter_m2, shorter_m2 + growth * more_m2)
            if index < len(self._samples):
                measured_m2, ready = self._measured(index, renewals, row)
                expected_m2 = np.where(ready, measured_m2, expected_m2)
            # A sigma stated too large hides white noise at long lags; after a restart it is there all the same.
            noise_m2[:, index] = np.maximum(expected_m2, shorter_m2)
            grown = _ratio(noise_m2[:, index] - shorter_m2, more_m2)
            # The same ratio again, from growth to grown to the next: a decline goes on, a rise does not.
            growth = grown * np.minimum(1.0, _ratio(grown, growth))
        return noise_m2

    def _measured(self, index: int, renewals: Ints, row: Ints) -> tuple[Floats, Bools]:
        """M of one lag by the samples before each renewal (first row `row`), and whether they were enough."""
        samples = self._samples[index]
        entering = self._entering[index]
        end, ready = self._until(index, renewals)
        if not ready.any():
            return np.zeros(end.size), ready
        ends, window = np.unique(end, return_inverse=True)
        shown_m2, error, stated_m2 = samples.looked_back(entering, ends)
        doubted = 1.0 + self._config.noise_doubt * error[window]
        # The noise grows with the sigma that the receiver states now: measured anew, it would come too late.
        larger = np.maximum(1.0, _ratio(_stated_m2(self._series, row, self._config), stated_m2[window]))
        return self._capped(shown_m2[window], shown_m2[window] * doubted * larger), ready

    def _capped(self, known_m2: Floats, more_m2: Floats) -> Floats:
        """Noise with its doubt, up to the limit: doubt alone does not make an axis blind."""
        return np.minimum(more_m2, np.maximum(known_m2, self._limit_m2))


@frozen
class _SecondDifferences:
    """Second differences over one lag, in order of time.

    `row`, `oldest`: of t and t - 2 L; `renewal`: period of t; `noise_m2` (quantiles, samples): what would explain the
    sample if it were that quantile; `stated_m2`: variance of the smooth errors. In samples: `window` to look back at,
    `ready` are enough, `span` fill 2 L.
    """

    row: Ints
    oldest: Ints
    renewal: Ints
    quantiles: tuple[float, ...]
    noise_m2: Floats
    stated_m2: Floats
    window: int
    ready: int
    span: float

    def looked_back(self, entering: Ints, ends: Ints) -> tuple[Floats, Floats, Floats]:
        """M of the counted samples in a window before each of `ends`, its relative error, the stated variance.

        M is the largest over the quantiles.
        """
        begins = np.maximum(ends - self.window, 0)
        count = np.maximum(ends - begins, 1)
        rank = np.ceil(np.array(self.quantiles)[:, None] * count).astype(np.int64) - 1
        short = ends < self.window
        shown_m2 = np.zeros(ends.size)
        if short.any():
            shown_m2[short] = self._of_short_windows(entering[: self.window], ends[short], count[short], rank[:, short])
        if not short.all():
            shown_m2[~short] = self._of_whole_windows(entering, begins[~short], rank[:, ~short][:, 0])
        total_m2 = np.concatenate([[0.0], np.cumsum(self.stated_m2[entering[: int(ends.max())]])])
        pieces = np.maximum(count / self.span, 1.0)
        return np.maximum(shown_m2, 0.0), np.sqrt(2.0 / pieces), (total_m2[ends] - total_m2[begins]) / count

    def _of_whole_windows(self, entering: Ints, begins: Ints, ranks: Ints) -> Floats:
        """The largest over the quantiles, by their rank, of the windows that begin at these samples [m^2]."""
        first = int(begins.min())
        samples_m2 = self.noise_m2[:, entering[first : int(begins.max()) + self.window]]
        windows = sliding_window_view(samples_m2, self.window, axis=1)[:, begins - first]
        largest_m2 = np.full(begins.size, -np.inf)
        for of_quantile, rank in zip(windows, ranks.tolist(), strict=True):
            of_quantile.partition(rank, axis=1)
            np.maximum(largest_m2, of_quantile[:, rank], out=largest_m2)
        return largest_m2

    def _of_short_windows(self, entering: Ints, ends: Ints, count: Ints, rank: Ints) -> Floats:
        """The same of windows that begin at the first sample: filled in front with -inf, which sorts first."""
        nothing = np.full((len(self.quantiles), self.window), -np.inf)
        windows = sliding_window_view(np.hstack([nothing, self.noise_m2[:, entering]]), self.window, axis=1)
        rank = (self.window - count + rank)[..., None]
        return np.asarray(np.take_along_axis(np.sort(windows[:, ends]), rank, axis=2).max(axis=(0, 2)))


class _Triples(NamedTuple):
    """Rows at t, t - L and t - 2 L."""

    last: Ints
    middle: Ints
    oldest: Ints

    def where(self, kept: Bools) -> _Triples:
        """Some of them."""
        return _Triples(*(rows[kept] for rows in self))

    def second_difference(self, values: Floats) -> Floats:
        """x(t) - 2 x(t - L) + x(t - 2 L) of a series."""
        return np.asarray(values[self.last] - 2.0 * values[self.middle] + values[self.oldest])


class Sampler:
    """Second differences by running sums, whose differences are what happened between two rows; those of a lag are made
    once.
    """

    def __init__(self, series: AxisSeries, moving: Bools, config: MonitorConfig) -> None:
        self._series = series
        self._config = config
        self._t_s = np.cumsum(series.dt_s) - series.dt_s[:1]
        self._between_s = 0.5 * (self._t_s[1:] + self._t_s[:-1])
        self._firsts: dict[float, Ints] = {}
        self._over: dict[float, _SecondDifferences] = {}
        self.renewal: Ints = (self._t_s // config.noise_renewal_s).astype(np.int64)
        # Only of the time before the noise is first known: later rows must not change the lags (causal).
        steps_s = series.dt_s[1:]
        first_s = steps_s[: max(int(np.searchsorted(self._t_s[1:], config.noise_first_s, side="right")), 1)]
        self.period_s = round(median(first_s), 6) if first_s.size else 0.0
        unknown = ~np.isfinite(series.rate_mps + series.sigma_m.sum(axis=1))
        self._countable = moving & ~unknown
        self._piece = np.cumsum(series.fresh | unknown)  # the same number for rows joined by increments
        self._offset_m = np.cumsum(np.where(series.border | unknown, 0.0, series.rate_mps) * series.dt_s)
        self._white_m2 = np.cumsum(series.white_m2)
        # Of sources with a correlation of their own: sum of dt / tau.
        self._ages = [
            (source, -np.cumsum(np.log1p(-np.minimum(series.decorrelation[:, source], 1.0 - 1e-12))))
            for source in range(error_model(config)[1].size, series.sigma_m.shape[1])
        ]
        self._lasting_m = [np.cumsum(rate_mps * series.dt_s) for rate_mps in series.lasting_mps.T if rate_mps.any()]

    def over(self, lag_s: float) -> _SecondDifferences:
        """The second differences over a lag."""
        if lag_s not in self._over:
            self._over[lag_s] = self._sampled(lag_s)
        return self._over[lag_s]

    def _sampled(self, lag_s: float) -> _SecondDifferences:
        """M = (second difference^2 / quantile of chi^2 - model) / 4 (DOMAIN section 3)."""
        config = self._config
        spacing_s = max(self.period_s, 0.1 * lag_s, config.noise_spacing_s)
        rows = self._triples(lag_s, spacing_s)
        rows = rows.where((self._piece[rows.oldest] == self._piece[rows.last]) & self._countable[rows.last])
        shown_m2 = rows.second_difference(self._offset_m) ** 2
        # The longest lag has too few samples for the last quantile.
        quantiles = config.noise_quantiles if lag_s < config.noise_longest_lag_s else config.noise_quantiles[:-1]
        gaussian_m2 = ndtri(0.5 + 0.5 * np.array(quantiles)[:, None]) ** 2
        ready_s = max(config.noise_first_s, config.noise_ready_lags * lag_s) - 2.0 * lag_s
        return _SecondDifferences(
            row=rows.last,
            oldest=rows.oldest,
            renewal=self.renewal[rows.last],
            quantiles=quantiles,
            noise_m2=(shown_m2 / gaussian_m2 - self._model_m2(lag_s, rows)) / OF_WALK,
            stated_m2=_stated_m2(self._series, rows.last, config),
            window=round(max(config.noise_window_s, config.noise_window_lags * lag_s) / spacing_s),
            # No sample begins where the run does: rounded up, logs faster than 2 Hz waited for a renewal more.
            ready=max(int(ready_s / spacing_s + 1e-6), 1),
            span=max(2.0 * lag_s / spacing_s, 1.0),
        )

    def _triples(self, lag_s: float, spacing_s: float) -> _Triples:
        """The first row t in every `spacing_s`, and the rows nearest to t - L and t - 2 L, if near enough."""
        t_s = self._t_s
        reach_s = max(0.1 * lag_s, 0.5 * self.period_s)
        last = self._firsts_in(spacing_s)
        last_s = t_s[last]
        middle, oldest = (np.searchsorted(self._between_s, last_s - lags * lag_s) for lags in (1, 2))
        near = (np.abs(last_s - lag_s - t_s[middle]) <= reach_s) & (middle < last)
        near &= (np.abs(last_s - 2.0 * lag_s - t_s[oldest]) <= reach_s) & (oldest < middle)
        return _Triples(last, middle, oldest).where(near)

    def _firsts_in(self, spacing_s: float) -> Ints:
        """The first row in every `spacing_s`; most lags have the same spacing."""
        if spacing_s not in self._firsts:
            cell = np.floor(self._t_s / spacing_s + 1e-6)
            self._firsts[spacing_s] = np.flatnonzero(np.diff(cell, prepend=cell[:1] - 1.0) > 0.0)
        return self._firsts[spacing_s]

    def _model_m2(self, lag_s: float, rows: _Triples) -> Floats:
        """Variance of the second differences by the whole model, sample by sample [m^2].

        Smooth errors; digits, jitter, rows and survey; the odometer's white noise; scale and latency.
        """
        series = self._series
        model_m2 = _smooth_m2(series, rows.last, lag_s, self._config)
        for source, age in self._ages:
            later = np.exp(age[rows.middle] - age[rows.last])
            earlier = np.exp(age[rows.oldest] - age[rows.middle])
            variance_m2 = series.sigma_m[rows.last, source] ** 2
            model_m2 += variance_m2 * (6.0 - 4.0 * (later + earlier) + 2.0 * later * earlier)
        for lasting_m in self._lasting_m:
            model_m2 += rows.second_difference(lasting_m) ** 2
        return np.asarray(model_m2 + self._white_m2[rows.last] - self._white_m2[rows.oldest])


def excess_of(shown_m2: Floats, model_m2: Floats, error: Floats, config: MonitorConfig) -> Floats:
    """Variance that second differences over one lag add to the stated one (DOMAIN section 3) [m^2].

    `shown_m2`: s_L^2; `model_m2`: S_L; `error`: relative standard error of s_L^2, sqrt(2 / stretches of 2 L seen).
    """
    beyond_m2 = shown_m2 - model_m2 * (1.0 + config.stated_excess_errors * error)
    return np.asarray(config.stated_excess_share * np.maximum(beyond_m2, 0.0))


def _lags_s(period_s: float, memories_s: Floats) -> list[float]:
    """One epoch, 1 s, and the memories of the averages, if longer."""
    return [period_s, *(lag_s for lag_s in sorted({1.0, *memories_s.tolist()}) if lag_s > 1.5 * period_s)]


def _ratio(part: Floats, whole: Floats) -> Floats:
    """A part of a whole; 0 where the whole is 0."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)


def _stated_m2(series: AxisSeries, row: Ints, config: MonitorConfig) -> Floats:
    """Variance of the Gauss-Markov errors [m^2]."""
    return np.asarray((series.sigma_m[row, : error_model(config)[1].size] ** 2).sum(axis=1))


def _model_at_m2(series: AxisSeries, row: Ints, lag_s: float, config: MonitorConfig) -> Floats:
    """Variance of second differences by the model: smooth errors, and the odometer's walk [m^2]."""
    return _smooth_m2(series, row, lag_s, config) + 2.0 * lag_s * (series.white_m2[row] / series.dt_s[row])


def _smooth_m2(series: AxisSeries, row: Ints, lag_s: float, config: MonitorConfig) -> Floats:
    """Sum of R_j (6 - 8 exp(-L/tau) + 2 exp(-2L/tau)) (DOMAIN section 3) [m^2]."""
    taus_s = error_model(config)[1]
    decay = np.exp(-lag_s / taus_s)
    return np.asarray(series.sigma_m[row, : taus_s.size] ** 2 @ (2.0 * (1.0 - decay) * (3.0 - decay)))
