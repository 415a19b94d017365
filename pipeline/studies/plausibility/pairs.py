"""One robust regression for every comparison, and what is asked of its result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.stages.odometry.scale_lag import CounterRows, scale_and_lag
from pipeline.studies.plausibility.records import MOVING_MPS, SPEED_S, Places, Record
from schemas.arrays import Bools, Floats
from schemas.frozen import frozen

# Tukey's biweight, 95 % efficient on Gaussian noise (Huber and Ronchetti 2009), after least absolute deviations.
_BIWEIGHT = 4.685
_ROUNDS = 6
# Numerics: an estimate stays where none of its parts (metres, seconds, shares) moves by more.
_STAYS = 1e-6
# Fewer observations show nothing.
LEAST = 6
# Lags and factors differ where they are so many sigmas apart: windows overlap and errors last.
SIGNIFICANT_SIGMAS = 5.0


@frozen
class Regression:
    """`estimate` with `sigma` (inf: not known); `weight` of each observation, `spread` of what is left [m].

    `halves`: the estimates of the first and the second half of the run alone. `whole`: every part of the estimate is
    known.
    """

    estimate: Floats
    sigma: Floats
    weight: Floats
    spread: float
    halves: tuple[Floats, ...]
    whole: bool


def split_in_half(count: int) -> tuple[slice, slice]:
    """The first and the second half of so many rows."""
    return slice(None, count // 2), slice(count // 2, None)


def halves_agree(whole: Floats, *halves: Floats) -> bool:
    """Whether each half shows more than half of what the whole run does, in the same direction.

    Vectors of one shape, such as a shift north and east. A drift in one half alone is not shown by the other.
    """
    return all(float(half @ whole) > 0.5 * float(whole @ whole) for half in halves)


def regressed(design: Floats, target: Floats, floor: float, least_known: float = 1e-12) -> Regression:
    """Robust regression; `design` (n, m, k), `target` (n, m): the m parts of one observation share a weight.

    `floor`: least spread of what is left. Directions with less than the share `least_known` of the information of the
    best known one stay zero.
    """
    estimate = np.zeros(design.shape[2])
    left = np.zeros(len(target))
    # Least absolute deviations, then the biweight; each until it stays.
    for least_absolute in (True, False):
        for _ in range(_ROUNDS):
            before = estimate
            spread = max(1.4826 * quantile_of_known(left), floor)
            if least_absolute:
                weight = floor / np.maximum(left, floor)
            else:
                weight = np.clip(1.0 - (left / (_BIWEIGHT * spread)) ** 2, 0.0, None) ** 2
            estimate, variance = _solved(design, target, weight, least_known)
            left = _lengths(target - design @ estimate)
            if np.abs(estimate - before).max() <= _STAYS:
                break
    alone = (_solved(design[part], target[part], weight[part], least_known)[0] for part in split_in_half(len(target)))
    halves = tuple(alone) if len(target) >= 2 * LEAST else ()
    whole = bool(np.isfinite(variance).all())
    return Regression(estimate, spread * np.sqrt(variance), weight, spread, halves, whole)


def _lengths(vectors: Floats) -> Floats:
    """Lengths of the rows."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=1)))


def _solved(design: Floats, target: Floats, weight: Floats, least_known: float) -> tuple[Floats, Floats]:
    """Weighted least squares, and the variance of each part at a spread of 1 (inf where a direction is not known)."""
    parts = design.reshape(-1, design.shape[2])
    weighted = (design * weight[:, None, None]).reshape(parts.shape)
    # Normal equations by eigenvectors: those with hardly any information are left out (pseudo-inverse).
    strengths, axes = np.linalg.eigh(weighted.T @ parts)
    known = strengths > least_known * max(float(strengths[-1]), 1e-300)
    inverse = (axes[:, known] / strengths[known]) @ axes[:, known].T
    variance = np.diag(inverse) if known.all() else np.full(len(inverse), np.inf)
    return inverse @ (weighted.T @ target.ravel()), variance


def explains(share: float, before: float) -> bool:
    """Whether a cause explains a misfit: most of the run agrees with it, and it leaves half of the rest at most.

    `share`: of the run that agrees with the cause, `before`: without it, both 0 to 1.
    """
    return share >= 0.5 and 1.0 - share <= 0.5 * (1.0 - before)


def sampled(rows: Bools, most: int = 800) -> Bools:
    """At most so many of the true rows, evenly."""
    chosen = np.flatnonzero(rows)
    kept = np.zeros_like(rows)
    kept[chosen[:: max(1, chosen.size // most)]] = True
    return kept


def quantile_of_known(values: Floats, share: float = 0.5) -> float:
    """Quantile of the finite values, by default their median; NaN where there are none.

    `share`: of the values that lie below it, 0 to 1.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan")
    # As `np.quantile`, which takes ten times as long for some hundred values.
    place = share * (known.size - 1)
    below = int(place)
    above = min(below + 1, known.size - 1)
    part = np.partition(known, (below, above))
    return float(part[below] + (place - below) * (part[above] - part[below]))


# Windows of this length show distances to 2 % where positions scatter by 2 m; they last neither so short that stamps
# tell little nor so long that a train does not keep its speed.
_WINDOW_M = 150.0
_WINDOW_LEAST_S = 8.0
_WINDOW_MOST_S = 60.0
_WINDOWS_OVERLAP = 4.0
# Numerics: no more windows are looked at, evenly; longer runs show no more of a unit or a clock.
_WINDOWS_MOST = 1_000
# A window agrees on a factor within so much: positions, curves and slip together.
_WINDOW_AGREES = 0.12
# Below this share of the usual speed a record tells more of noise than of the scale.
_SLOW_SHARE = 0.2
# A lag is known where its sigma is smaller.
_LAG_SIGMA_S = 0.5
# With less in common, of all and of the shorter record, any two journeys look alike.
_COMMON_S = 90.0
_COMMON_SHARE = 0.6
# Constant speed shows no lag: its scatter over its mean.
_SPEED_CHANGE = 0.08
# Nobody looks for another lag where speeds agree in so much of the moving time; a journey that repeats itself agrees
# nearly as well at another one.
_SPEEDS_AGREE = 0.93
_LAG_RIVAL = 0.05
# Speeds agree within this share of themselves and this one of the usual speed: scatter of 0.7 m/s at 17 m/s.
_ALIKE_SHARE = 0.07
_ALIKE_USUAL = 0.04
# Speeds are means over 4 s, and show a lag to half of that.
_SPEED_LAG_S = SPEED_S / 2.0
# Lags that are worth a closer look: so many, so far from each other [s], and those next to them: a stuck counter moves
# a correlation by seconds.
_CANDIDATES = 4
_APART_S = 15.0
_NEARBY_S = np.arange(-8.0, 9.0)
# All shifts of two records are tried on their longest parts without a longer pause, of so many rows at least per time.
_PAUSE_S = 3_600.0
_SPARSE_S = 100.0


@frozen
class PairFit:
    """How a counter fits positions.

    `scale`: metres per counted unit, negative where the counter falls; `lag_s`: the counter's stamp of a moment minus
    the GNSS's; sigmas of both (inf: not known). `halves`: scale and lag of the first and the second half alone.
    `constant`: share of windows that agree on the scale, of all in which the positions move. `reason`: why the scale
    is not known; `stands`: the counter stands while the positions move.
    `shifted`: the lag is one of the clocks, by the whole journey's speed; `clock_reason`: why that showed nothing.
    """

    scale: float = float("nan")
    scale_sigma: float = float("inf")
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    halves: tuple[tuple[float, float], ...] = ()
    constant: float = 0.0
    reason: str = ""
    stands: bool = False
    shifted: bool = False
    clock_reason: str = ""

    @property
    def known(self) -> bool:
        """The scale is known."""
        return not self.reason

    @property
    def lag_known(self) -> bool:
        """The lag is known, to half a second."""
        return self.known and self.lag_sigma_s < _LAG_SIGMA_S

    @property
    def factor(self) -> float:
        """How many times the true distance is counted."""
        return 1.0 / abs(self.scale)

    def other_lag(self, lag_s: float, least_s: float) -> bool:
        """Whether the lag differs from `lag_s` by more than `least_s` and than its noise, in both halves of the run."""
        apart_s = np.array([self.lag_s, *(lag for _, lag in self.halves)]) - lag_s
        return self.lag_known and _beyond(apart_s, max(least_s, SIGNIFICANT_SIGMAS * self.lag_sigma_s))

    def other_scale(self, scale: float, least: float) -> bool:
        """Whether the scale differs from this one by a larger share than `least`, in both halves of the run."""
        apart = scale / np.abs([self.scale, *(half for half, _ in self.halves)]) - 1.0
        return self.known and _beyond(apart, max(least, SIGNIFICANT_SIGMAS * self.scale_sigma / abs(self.scale)))


def _beyond(apart: Floats, least: float) -> bool:
    """Whether a share of the whole run (first) and of its halves (then) is larger than `least`, and lasts."""
    return abs(apart[0]) > least and halves_agree(*apart[:, None])


def fit_pair(gnss: Places, counter: Record) -> PairFit:
    """Scale and lag of a counter against positions; first the clocks, then both at once."""
    coarse_s, clock_reason = clock_lag(gnss, counter)
    fit = _fit_by_windows(gnss, counter, coarse_s)
    if coarse_s and abs(fit.lag_s - coarse_s) > _SPEED_LAG_S:
        fit = replace(fit, lag_s=coarse_s, lag_sigma_s=_SPEED_LAG_S / 2.0)
    return replace(fit, shifted=coarse_s != 0.0, clock_reason="" if fit.lag_known else clock_reason)


def _fit_by_windows(gnss: Places, counter: Record, lag_s: float) -> PairFit:
    """Scale and lag by distances over windows, once the clocks agree to within half a minute.

    `lag_s`: of the clocks, as `clock_lag` found it [s].
    """
    begin_s, end_s = _common(gnss, counter, lag_s)
    if end_s - begin_s < 3.0 * _WINDOW_LEAST_S:
        return PairFit(reason="nothing in common")
    starts, ends, distance_m = _windows(gnss, begin_s, end_s)
    found = scale_and_lag(starts, ends, distance_m, _driven(counter, lag_s))
    counted = counter.gained(starts + lag_s - found.lag_s, ends + lag_s - found.lag_s)
    known = np.isfinite(counted)
    # Neither a counter that stands most of the time nor one that is reset shows what is usual.
    counts = np.abs(counted) > _SLOW_SHARE * quantile_of_known(np.abs(counted), 0.8)
    share = float(counts[known].mean()) if known.any() else 1.0
    stands = share < 0.1
    if counts.sum() < LEAST or not np.isfinite(found.scale_sigma):
        reason = "the odometer stands while the positions move" if stands else "hardly any movement in common"
        return PairFit(reason=reason, stands=stands)
    ratio = np.abs(counted[counts]) / distance_m[counts]
    agree = np.abs(np.log(ratio / np.median(ratio))) < _WINDOW_AGREES
    return PairFit(
        scale=found.scale if np.median(counted[counts]) > 0 else -found.scale,
        scale_sigma=found.scale_sigma,
        lag_s=lag_s - found.lag_s,
        lag_sigma_s=found.lag_sigma_s,
        halves=tuple((scale, lag_s - rest_s) for scale, rest_s in found.halves),
        constant=share * float(np.mean(agree)),
    )


def _driven(counter: Record, lag_s: float) -> CounterRows:
    """The counter as distance driven, by the clock of the positions: their distances have no sign. None over a
    pause.
    """
    paused = np.diff(counter.t_s) > counter.limit_s
    return CounterRows(counter.t_s - lag_s, counter.values, np.concatenate([[0.0], np.cumsum(paused)])).driven()


def _windows(gnss: Places, begin_s: float, end_s: float) -> tuple[Floats, Floats, Floats]:
    """Begins and ends of windows in which the positions move, and the distance run in each [m]."""
    speed = gnss.speed(np.linspace(begin_s, end_s, 400))
    fast = speed[np.nan_to_num(speed) > MOVING_MPS]
    if not fast.size:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    length_s = float(np.clip(_WINDOW_M / np.median(fast), _WINDOW_LEAST_S, _WINDOW_MOST_S))
    step_s = max(length_s / _WINDOWS_OVERLAP, (end_s - begin_s) / _WINDOWS_MOST)
    starts = gnss.instants(step_s, begin_s, end_s - length_s)
    distance_m = gnss.distance_m(starts, starts + length_s)
    moves = np.nan_to_num(distance_m) > max(_SLOW_SHARE * quantile_of_known(distance_m, 0.9), MOVING_MPS * length_s)
    return starts[moves], starts[moves] + length_s, distance_m[moves]


def clock_lag(gnss: Places, other: Record) -> tuple[float, str]:
    """The lag of the clocks that makes the speeds agree, 0 where they do as recorded; and why none is known.

    A lag is the other's stamp of a moment minus the GNSS's. A fault of one of the two leaves part of the journey that
    agrees, and with it the right lag ahead of all others.
    """
    as_recorded = _agreement(gnss, other, 0.0, 0.0)
    if as_recorded >= _SPEEDS_AGREE:
        return 0.0, ""
    possible_s, reason = _possible_lags(gnss, other)
    if reason:
        return 0.0, reason
    rated = [_best_nearby(gnss, other, lag_s) for lag_s in possible_s]
    rated = sorted((lag for lag in rated if abs(lag[1]) > _SPEED_LAG_S), reverse=True)
    if not rated or not explains(rated[0][0], as_recorded):
        return 0.0, "" if explains(as_recorded, 0.0) else "no shift of the clocks makes the speeds agree"
    agreement, lag_s = rated[0]
    if any(agreement - rival < _LAG_RIVAL for rival, rival_s in rated if abs(rival_s - lag_s) > _APART_S):
        return 0.0, "several shifts of the clocks make the speeds agree"
    return lag_s, ""


def _best_nearby(gnss: Places, other: Record, lag_s: float) -> tuple[float, float]:
    """Best agreement of the speeds near a lag, and the lag."""
    return max((_agreement(gnss, other, near_s, _COMMON_SHARE), near_s) for near_s in (lag_s + _NEARBY_S).tolist())


def _possible_lags(gnss: Places, other: Record) -> tuple[list[float], str]:
    """Lags at which both speeds look alike, to a second, best correlated first; and why there are none."""
    speeds: list[Floats] = []
    begins_s: list[float] = []
    for record in (gnss, other):
        parts = np.split(record.t_s, np.flatnonzero(np.diff(record.t_s) > _PAUSE_S) + 1)
        part = max(parts, key=np.ptp)
        if np.ptp(part) > _SPARSE_S * part.size:
            return [], "the rows are too far apart"
        speed = np.abs(record.speed(np.arange(part[0], part[-1] + 0.5, 1.0)))
        # Without speeds that only a jump of the position has.
        speed[speed > 1.5 * quantile_of_known(speed, 0.95) + 1e-9] = np.nan
        if np.isfinite(speed).sum() < _COMMON_S:
            return [], f"less than {_COMMON_S:.0f} s of movement are known"
        if np.nanstd(speed) < _SPEED_CHANGE * max(float(np.nanmean(speed)), 1e-9):
            return [], "the speed hardly changes"
        speeds.append(speed)
        begins_s.append(float(part[0]))
    rho = _correlations(*speeds)
    lags_s = begins_s[1] - begins_s[0] + speeds[1].size - 1.0 - np.arange(rho.size)
    peaks: list[float] = []
    while len(peaks) < _CANDIDATES and rho.max() > 0.0:
        peaks.append(float(lags_s[rho.argmax()]))
        rho[np.abs(lags_s - peaks[-1]) < _APART_S] = 0.0
    return peaks, ""


def _correlations(first: Floats, second: Floats) -> Floats:
    """Correlation at every shift over what both know; 0 where that is too little (Padfield 2012, masked FFT)."""
    size = first.size + second.size - 1
    known = [np.isfinite(values).astype(np.float64) for values in (first, second)]
    apart = [np.nan_to_num(values / max(float(np.nanmean(values)), 1e-9) - 1.0) for values in (first, second)]

    def at_every_shift(one: Floats, other: Floats) -> Floats:
        """Sums of products at every shift of the one against the other, by FFT."""
        # A power of two is a fast length; the other one reversed makes a correlation of a convolution.
        fast = 1 << (size - 1).bit_length()
        return np.fft.irfft(np.fft.rfft(one, fast) * np.fft.rfft(other[::-1], fast), fast)[:size]

    spread = at_every_shift(apart[0] ** 2, known[1]) * at_every_shift(known[0], apart[1] ** 2)
    least = max(_COMMON_S, _COMMON_SHARE * min(known[0].sum(), known[1].sum()))
    enough = (np.round(at_every_shift(*known)) >= least) & (spread > _SPEED_CHANGE**4)
    return np.where(enough, at_every_shift(*apart) / np.sqrt(np.where(enough, spread, 1.0)), 0.0)


def _common(gnss: Places, other: Record, lag_s: float) -> tuple[float, float]:
    """Begin and end of what both records have in common at this lag, by the stamps of the GNSS [s]."""
    return max(gnss.t_s[0], other.t_s[0] - lag_s), min(gnss.t_s[-1], other.t_s[-1] - lag_s)


def _agreement(gnss: Places, other: Record, lag_s: float, least_overlap: float) -> float:
    """Share of the moving time in which both speeds agree at this lag, times what of the shorter record they have in
    common then: a shift that cuts a fault off explains nothing. 0 where that is too little.
    """
    begin_s, end_s = _common(gnss, other, lag_s)
    shorter_s = min(np.ptp(gnss.t_s), np.ptp(other.t_s))
    if end_s - begin_s < max(least_overlap * shorter_s, 20.0):
        return 0.0
    grid = np.linspace(begin_s, end_s, int(np.clip(end_s - begin_s, 20, 800)))
    speeds = np.stack([gnss.speed(grid), np.abs(other.speed(grid + lag_s))])
    of_gnss, of_other = speeds[:, np.isfinite(speeds).all(axis=0)]
    moves = [speed > _SLOW_SHARE * quantile_of_known(speed, 0.9) for speed in (of_gnss, of_other)]
    both = moves[0] & moves[1]
    if both.sum() < LEAST:
        return 0.0
    factor = float(np.median(of_other[both] / of_gnss[both]))
    bound = _ALIKE_SHARE * of_gnss + _ALIKE_USUAL * quantile_of_known(of_gnss, 0.9)
    alike = np.abs(of_other / factor - of_gnss) < bound
    return float(np.mean(alike[moves[0] | moves[1]])) * float(end_s - begin_s) / float(shorter_s)
