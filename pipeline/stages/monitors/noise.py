"""The fast noise of one axis, measured in the run from what came before (DOMAIN section 3).

DIAG's errors are smooth from epoch to epoch, those of receivers are not. What second differences of the offset (GNSS
minus odometer or track) show beyond the model is added to the thresholds: a constant ramp has no second difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from pipeline.stages.monitors.axis import AxisSeries, error_model
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, MonitorConfig

# Numerics: deviations are counted in bins from 0.01 mm to 10 m, each 4.4 % wide and taken at its upper edge.
_LEAST_M, _PER_OCTAVE, _BINS = 1e-5, 16, 321
_EDGES_M2 = np.concatenate([[0.0], _LEAST_M**2 * 4.0 ** (np.arange(1, _BINS) / _PER_OCTAVE)])
# Second differences of a random walk have four times the variance of what it does to an average of that memory; of
# white noise six times: it is taken for 1.5 times as much (DOMAIN section 3).
_OF_WALK = 4.0


@dataclass(frozen=True)
class _Samples:
    """Second differences over one lag, in order of time.

    `row`, `oldest`: of t and of t - 2 L; `renewal`: number of the renewal period of t; `bins`: per quantile, the noise
    that would explain the sample if it were that quantile. `window`: how many samples are looked back at; `ready`: from
    how many on they count; `span`: how many of them fill 2 L, and so are of one piece.
    """

    row: Ints
    oldest: Ints
    renewal: Ints
    bins: dict[float, Ints]
    window: int
    ready: int
    span: float


class NoiseMeter:
    """Fast noise of one axis, row by row of its series; what is under alarm never enters."""

    def __init__(self, series: AxisSeries, moving: Bools, given_m: tuple[float, ...] | None, config: Configuration):
        """`series`: of the whole run; `moving`: per row; `given_m`: by monitor, replaces what is measured."""
        self._series = series
        self._config = config.monitors
        self._limit_m2 = config.noise_limit_m**2
        self._given_m2 = None if given_m is None else np.square(np.array(given_m))
        t_s = np.cumsum(series.dt_s) - series.dt_s[:1]
        self._renewal = (t_s // self._config.noise_renewal_s).astype(np.int64)
        self._memories_s = np.array([0.0, *(1.0 / alpha for alpha in self._config.ewma_alphas)])
        self._lags_s: list[float] = []
        self._samples: list[_Samples] = []
        self._entering: list[Ints] = []
        if given_m is None and t_s.size > 2:
            self._lags_s = _lags_s(float(np.median(np.diff(t_s))), self._memories_s)
            measured_s = [
                lag_s for lag_s in self._lags_s if lag_s <= max(self._config.noise_longest_lag_s, self._lags_s[0])
            ]
            sums = _sums(series, self._config)
            self._samples = [
                _samples(lag_s, series, sums, t_s, self._renewal, moving, self._config) for lag_s in measured_s
            ]
            self._entering = [np.arange(samples.row.size) for samples in self._samples]

    def freeze(self, row: int) -> None:
        """From this row on nothing enters."""
        for index, samples in enumerate(self._samples):
            entering = self._entering[index]
            self._entering[index] = entering[: np.searchsorted(samples.row[entering], row)]

    def restart(self, row: int) -> None:
        """From this row on samples enter again; none reaches back over it."""
        self.freeze(row)
        for index, samples in enumerate(self._samples):
            later = np.arange(np.searchsorted(samples.oldest, row), samples.row.size)
            self._entering[index] = np.concatenate([self._entering[index], later])

    def known_from(self) -> int:
        """The first row whose noise is known; the number of rows where it never is."""
        if self._given_m2 is not None:
            return 0
        if not self._samples or self._samples[0].row.size < self._samples[0].ready:
            return self._renewal.size
        enough = self._samples[0].renewal[self._samples[0].ready - 1]
        return int(np.searchsorted(self._renewal, enough, side="right"))

    def variance_m2(self, begin: int, end: int) -> Floats:
        """M of the rows [begin, end) by monitor: raw, then the EWMAs; NaN where not known yet."""
        if self._given_m2 is not None:
            return np.tile(self._given_m2, (end - begin, 1))
        if not self._samples or begin == end:
            return np.full((end - begin, self._memories_s.size), np.nan)
        renewals = np.arange(self._renewal[begin], self._renewal[end - 1] + 1)
        # After a pause an increment has the noise of that time, which is no less than that of the next longer lag.
        asked_s = np.maximum(self._memories_s, self._series.dt_s[begin:end, None])
        columns = np.searchsorted(1.5 * np.array(self._lags_s[:-1]), asked_s)
        by_lag = self._by_lag(renewals)
        return np.asarray(np.take_along_axis(by_lag[self._renewal[begin:end] - renewals[0]], columns, axis=1))

    def _by_lag(self, renewals: Ints) -> Floats:
        """M of every lag at these renewals: measured, or not yet, and expected by the two shorter ones.

        What grows from lag to lag goes on as the model does: it is smooth noise of a sigma larger than stated. What
        does not is white. (The shortest lag has none before it: all its noise is taken for smooth.)
        """
        by_lag = np.full((renewals.size, len(self._lags_s)), np.nan)
        first = np.searchsorted(self._renewal, renewals)
        nothing = np.zeros(renewals.size)
        before_m2, before_model_m2, grows = by_lag[:, 0], nothing, nothing
        for index, lag_s in enumerate(self._lags_s):
            model_m2 = _smooth_m2(self._series, first, lag_s, self._config)
            model_m2 = model_m2 + 2.0 * lag_s * (self._series.white_m2 / self._series.dt_s)[first]
            more_m2 = model_m2 - before_model_m2
            noise_m2 = self._no_limit_by(before_m2, before_m2 + grows * more_m2)
            if index < len(self._samples):
                measured_m2, doubt, ready = self._measured(index, renewals)
                doubted_m2 = measured_m2 * (1.0 + self._config.noise_doubt * doubt)
                noise_m2 = np.where(ready, self._no_limit_by(measured_m2, doubted_m2), noise_m2)
            if (
                index
            ):  # A sigma stated too large hides white noise at long lags; after a restart it is there all the same.
                noise_m2 = np.maximum(noise_m2, before_m2)
            grew = grows
            grows = _ratio(np.maximum(noise_m2 - (before_m2 if index else nothing), 0.0), more_m2)
            if index:  # It may grow ever less, as noise does beyond its memory, but never more.
                grows = grows * np.minimum(1.0, _ratio(grows, grew))
            by_lag[:, index] = before_m2 = noise_m2
            before_model_m2 = model_m2
        return by_lag

    def _measured(self, index: int, renewals: Ints) -> tuple[Floats, Floats, Bools]:
        return _measured(self._samples[index], self._entering[index], renewals, self._config.noise_wait_spans)

    def _no_limit_by(self, known_m2: Floats, more_m2: Floats) -> Floats:
        """With what is expected, or in doubt: that alone does not make an axis blind."""
        return np.minimum(more_m2, np.maximum(known_m2, self._limit_m2))


def _ratio(part: Floats, whole: Floats) -> Floats:
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)


def _measured(samples: _Samples, entering: Ints, renewals: Ints, wait_spans: float) -> tuple[Floats, Floats, Bools]:
    """M of one lag from the samples before each renewal; its standard error in parts of it; whether they are enough."""
    before = np.searchsorted(samples.renewal[entering], renewals)
    # The onset of a drift touches samples over 2 L. They wait so long again: the thresholds it meets are those before.
    end = np.maximum(before - round(wait_spans * samples.span), np.minimum(before, samples.ready))
    begin = np.maximum(end - samples.window, 0)
    cuts = np.unique(np.concatenate([begin, end]))
    inside = entering[cuts[0] : cuts[-1]]
    group = np.repeat(np.arange(cuts.size - 1), np.diff(cuts))
    low, high = np.searchsorted(cuts, begin), np.searchsorted(cuts, end)
    largest = np.zeros(end.size, dtype=np.int64)
    for quantile, bins in samples.bins.items():
        # Most bins are empty: only those that hold a sample are counted.
        held = np.bincount(bins[inside], minlength=_BINS) > 0
        held[0] = True
        width = int(held.sum())
        place = (np.cumsum(held) - 1)[bins[inside]]
        counts = np.bincount(group * width + place, minlength=(cuts.size - 1) * width).reshape(-1, width)
        up_to = np.concatenate([np.zeros((1, width), np.int64), np.cumsum(counts, axis=0)])
        below = np.cumsum(up_to[high] - up_to[low], axis=1)
        reached = (below >= quantile * (end - begin)[:, None]).argmax(axis=1)
        largest = np.maximum(largest, np.flatnonzero(held)[reached])
    pieces = np.maximum((end - begin) / samples.span, 1.0)
    return _EDGES_M2[largest], np.sqrt(2.0 / pieces), end >= samples.ready


def _lags_s(period_s: float, memories_s: Floats) -> list[float]:
    """One epoch, 1 s, and the memories of the averages, as far as they are longer than an epoch."""
    return [period_s, *(lag_s for lag_s in sorted({1.0, *memories_s.tolist()}) if lag_s > 1.5 * period_s)]


@dataclass(frozen=True)
class _Sums:
    """Running sums of a series, whose differences are what happened between two rows.

    `run`: one number for rows that increments lead through; `offset_m`: GNSS minus odometer or track; `white_m2`: of
    the odometer; `staying_m`: what errors that stay make of the offset; `ages`: of each source beside the smooth
    errors, the sum of dt / tau, by its column in `sigma_m`.
    """

    unknown: Bools
    run: Ints
    offset_m: Floats
    white_m2: Floats
    staying_m: list[Floats]
    ages: dict[int, Floats]


def _sums(series: AxisSeries, config: MonitorConfig) -> _Sums:
    unknown = ~np.isfinite(series.rate_mps + series.sigma_m.sum(axis=1))
    staying_mps = [rate_mps for rate_mps in (series.steady_mps, series.latency_mps) if rate_mps.any()]
    sources = range(error_model(config)[1].size, series.sigma_m.shape[1])
    lost = {source: np.minimum(series.decorrelation[:, source], 1.0 - 1e-12) for source in sources}
    return _Sums(
        unknown=unknown,
        run=np.cumsum(series.fresh | unknown),
        offset_m=np.cumsum(np.where(series.border | unknown, 0.0, series.rate_mps) * series.dt_s),
        white_m2=np.cumsum(series.white_m2),
        staying_m=[np.cumsum(rate_mps * series.dt_s) for rate_mps in staying_mps],
        ages={source: -np.cumsum(np.log1p(-part)) for source, part in lost.items()},
    )


def _samples(
    lag_s: float,
    series: AxisSeries,
    sums: _Sums,
    t_s: Floats,
    renewal: Ints,
    moving: Bools,
    config: MonitorConfig,
) -> _Samples:
    period_s = float(np.median(np.diff(t_s)))
    spacing_s = max(period_s, 0.1 * lag_s, config.noise_spacing_s)
    last, middle, oldest = _triples(t_s, lag_s, spacing_s, max(0.1 * lag_s, 0.5 * period_s))
    kept = (sums.run[oldest] == sums.run[last]) & moving[last] & ~sums.unknown[last]
    last, middle, oldest = last[kept], middle[kept], oldest[kept]
    seen_m2 = _second_difference(sums.offset_m, last, middle, oldest) ** 2
    model_m2 = _model_m2(series, sums, lag_s, last, middle, oldest, config)
    quantiles = config.noise_quantiles if lag_s < config.noise_longest_lag_s else config.noise_quantiles[:-1]
    ready_s = max(config.noise_first_s, config.noise_ready_lags * lag_s) - 2.0 * lag_s
    return _Samples(
        row=last,
        oldest=oldest,
        renewal=renewal[last],
        bins={q: _bin_of((seen_m2 / ndtri(0.5 + 0.5 * q) ** 2 - model_m2) / _OF_WALK) for q in quantiles},
        window=round(max(config.noise_window_s, config.noise_window_lags * lag_s) / spacing_s),
        ready=max(round(ready_s / spacing_s), 1),
        span=max(2.0 * lag_s / spacing_s, 1.0),
    )


def _triples(t_s: Floats, lag_s: float, spacing_s: float, reach_s: float) -> tuple[Ints, Ints, Ints]:
    """Rows t, one such in every `spacing_s`, and the rows nearest to t - L and t - 2 L, where they are near enough."""
    cell = np.floor(t_s / spacing_s + 1e-6)
    last = np.flatnonzero(np.diff(cell, prepend=cell[:1] - 1.0) > 0.0)
    between_s = 0.5 * (t_s[1:] + t_s[:-1])
    middle, oldest = (np.searchsorted(between_s, t_s[last] - lags * lag_s) for lags in (1, 2))
    near = (np.abs(t_s[last] - lag_s - t_s[middle]) <= reach_s) & (middle < last)
    near &= (np.abs(t_s[last] - 2.0 * lag_s - t_s[oldest]) <= reach_s) & (oldest < middle)
    return last[near], middle[near], oldest[near]


def _second_difference(values: Floats, last: Ints, middle: Ints, oldest: Ints) -> Floats:
    return np.asarray(values[last] - 2.0 * values[middle] + values[oldest])


def _smooth_m2(series: AxisSeries, row: Ints, lag_s: float, config: MonitorConfig) -> Floats:
    """Of the Gauss-Markov errors: sum of R_j (6 - 8 exp(-L/tau) + 2 exp(-2L/tau)) (DOMAIN section 3) [m^2]."""
    taus_s = error_model(config)[1]
    decay = np.exp(-lag_s / taus_s)
    return np.asarray(series.sigma_m[row, : taus_s.size] ** 2 @ (2.0 * (1.0 - decay) * (3.0 - decay)))


def _model_m2(
    series: AxisSeries, sums: _Sums, lag_s: float, last: Ints, middle: Ints, oldest: Ints, config: MonitorConfig
) -> Floats:
    """Variance of the second differences by the whole model, sample by sample [m^2].

    Beside the smooth errors: digits, jitter, rows and survey as far as they are modelled, the odometer's white noise,
    and what scale and latency leave uncertain.
    """
    model_m2 = _smooth_m2(series, last, lag_s, config)
    for source, age in sums.ages.items():
        later = np.exp(age[middle] - age[last])
        earlier = np.exp(age[oldest] - age[middle])
        variance_m2 = series.sigma_m[last, source] ** 2
        model_m2 += variance_m2 * (6.0 - 4.0 * (later + earlier) + 2.0 * later * earlier)
    for staying_m in sums.staying_m:
        model_m2 += _second_difference(staying_m, last, middle, oldest) ** 2
    return np.asarray(model_m2 + sums.white_m2[last] - sums.white_m2[oldest])


def _bin_of(variance_m2: Floats) -> Ints:
    """The bin that holds a deviation; what is no more than the least, or below the model, is in the first."""
    octaves = 0.5 * np.log2(np.maximum(variance_m2, _LEAST_M**2) / _LEAST_M**2)
    return np.minimum(np.ceil(_PER_OCTAVE * octaves), _BINS - 1).astype(np.int64)
