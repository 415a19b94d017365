"""The clock of reference or reads against the odometer's, measured over the run and never with the GNSS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.stages.evidence.carrying import Counter
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import HazardConfig

# Numerics: range and step of the search for a coarse lag [s], and of the one about what the regression finds.
_FARTHEST_S, _STEP_S = 30.0, 0.5
_ABOUT_S, _FINE_S = 2.0, 0.1
_ROUNDS = 6
# Least number of ways for a lag, and for one of more than a second.
_FEWEST, _FEWEST_FAR = 6, 12
_NEAR_S = 1.0
# The ways of nine in ten differ by less: where most are driven at one speed, half of them show no lag.
_SHARE = 0.9
# A lag of seconds leaves less than this share of what the ways differ by as recorded.
_EXPLAINS = 0.7
# Outliers, in robust standard deviations: slip, or a step of the reference.
_USUAL = 4.0
# A lag of less than so many of its sigmas may be none.
_SHOWN_SIGMAS = 2.0
# Two lags of one recorder differ beyond so many.
_DIFFER_SIGMAS = 4.0


@dataclass(frozen=True)
class RecorderLag:
    """Stamp of a moment by the recorder minus that by the odometer [s]; an infinite sigma: not known.

    `scale`: way of the recorder over that of the odometer, found with the lag.
    """

    lag_s: float = 0.0
    sigma_s: float = float("inf")
    scale: float = 1.0
    scale_sigma: float = float("inf")


@dataclass(frozen=True)
class RecorderClock:
    """How a recorder's clock is taken: its stamps less `shift_s`, +- `delta_s`; `assumed`: it could not be measured."""

    shift_s: float
    delta_s: float
    assumed: bool = False

    @property
    def lags_s(self) -> tuple[float, float]:
        """Least and largest lag that it leaves possible."""
        return self.shift_s - self.delta_s, self.shift_s + self.delta_s


def clock_of(lags: Sequence[RecorderLag], independent: bool, config: HazardConfig) -> RecorderClock:
    """DOMAIN section 5.1: the hull of no lag and the measured ones, each +- k sigma.

    A measured lag belongs to nobody: odometer and GNSS may share it, or the recorder has it. By odometers that are not
    `independent` it may widen what is assumed, and never narrow it.
    """
    measured = [lag for lag in lags if _measured(lag, config)]
    noises_s = [config.evidence_factor * lag.sigma_s for lag in measured]
    least_s = 0.0 if measured and independent else config.evidence_clock_s
    lows = [min(lag.lag_s, 0.0) - noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
    highs = [max(lag.lag_s, 0.0) + noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
    low_s, high_s = min([-least_s, *lows]), max([least_s, *highs])
    return RecorderClock(0.5 * (low_s + high_s), 0.5 * (high_s - low_s), assumed=not (measured and independent))


def _measured(lag: RecorderLag, config: HazardConfig) -> bool:
    """Not where it may be none and is known to no better than what is assumed."""
    noise_s = config.evidence_factor * lag.sigma_s
    return abs(lag.lag_s) >= _SHOWN_SIGMAS * lag.sigma_s or noise_s <= config.evidence_clock_s


def lags_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> list[RecorderLag]:
    """The lags of a recorder by the ways that it saw: one of the run, or two where its halves disagree.

    A clock that changes in the middle of a run, at a stand or after a restart, has no lag of the run.
    """
    order = begin_ns.argsort(kind="stable")
    begin_ns, end_ns, way_m = begin_ns[order], end_ns[order], way_m[order]
    half = begin_ns.size // 2
    halves = [lag_of(begin_ns[part], end_ns[part], way_m[part], counter) for part in (slice(half), slice(half, None))]
    sigma_s = float(np.hypot(halves[0].sigma_s, halves[1].sigma_s))
    if abs(halves[0].lag_s - halves[1].lag_s) > _DIFFER_SIGMAS * sigma_s:
        return halves
    return [lag_of(begin_ns, end_ns, way_m, counter)]


def lag_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> RecorderLag:
    """The lag of a recorder by the ways `way_m` that it saw between its stamps, positive as the odometer counts up.

    way = scale * counted - lag * change of speed, by least squares without outliers, begun at the best of a search over
    +- 30 s and again at the best about what it finds; sigma is that of the fit, or half the difference between the two
    halves of the run if that is larger.
    """
    if begin_ns.size < _FEWEST:
        return RecorderLag()
    ways = _Ways(begin_ns, end_ns, way_m, counter)
    coarse_s = ways.best_s(0.0, _FARTHEST_S, _STEP_S, _EXPLAINS) if begin_ns.size >= _FEWEST_FAR else 0.0
    lag = ways.converged(coarse_s)
    if np.isfinite(lag.sigma_s):
        lag = ways.converged(ways.best_s(lag.lag_s, _ABOUT_S, _FINE_S, 1.0))
    if not np.isfinite(lag.sigma_s) or (begin_ns.size < _FEWEST_FAR and abs(lag.lag_s) > _NEAR_S):
        return RecorderLag()
    half = begin_ns.size // 2
    parts = (slice(None, half), slice(half, None))
    halves = [ways.of(part).rest(lag.lag_s) for part in parts]
    if max(part.sigma_s for part in halves) < 3.0 * lag.sigma_s:
        return replace(lag, sigma_s=max(lag.sigma_s, 0.5 * abs(halves[0].lag_s - halves[1].lag_s)))
    return lag


@dataclass(frozen=True)
class _Ways:
    """Ways that a recorder saw between its stamps, and the odometer that counted them too."""

    begin_ns: Ints
    end_ns: Ints
    way_m: Floats
    counter: Counter

    def of(self, part: slice) -> _Ways:
        return _Ways(self.begin_ns[part], self.end_ns[part], self.way_m[part], self.counter)

    def counted_m(self, lag_s: float) -> Floats:
        lag_ns = round(lag_s * NS_PER_S)
        return self.counter.distance_m(self.begin_ns - lag_ns, self.end_ns - lag_ns)

    def best_s(self, about_s: float, farthest_s: float, step_s: float, explains: float) -> float:
        """The lag that leaves nine in ten ways the least difference; `about_s` where it leaves no smaller share."""
        offsets = np.arange(-round(farthest_s / step_s), round(farthest_s / step_s) + 1)
        lags_s = about_s + step_s * offsets
        spreads = np.array([self._spread_m(lag_s) for lag_s in lags_s.tolist()])
        best = int(np.argmin(spreads))
        return float(lags_s[best]) if spreads[best] < explains * spreads[offsets.size // 2] else about_s

    def _spread_m(self, lag_s: float) -> float:
        counted = self.counted_m(lag_s)
        known = np.isfinite(counted)
        if known.sum() < 0.5 * known.size or float(np.abs(counted[known]).sum()) == 0.0:
            return float("inf")
        return float(np.quantile(np.abs(self.way_m - counted)[known], _SHARE))

    def converged(self, lag_s: float) -> RecorderLag:
        """The regression from here until it stays; not known where it does not."""
        for _ in range(_ROUNDS):
            rest = self.rest(lag_s)
            if not np.isfinite(rest.sigma_s) or abs(lag_s + rest.lag_s) > _FARTHEST_S:
                return RecorderLag()
            lag_s += rest.lag_s
            if abs(rest.lag_s) <= 0.1 * rest.sigma_s:
                return replace(rest, lag_s=lag_s)
        return replace(rest, lag_s=lag_s, sigma_s=max(rest.sigma_s, abs(rest.lag_s)))

    def rest(self, lag_s: float) -> RecorderLag:
        """The remaining lag once `lag_s` is taken off; an infinite sigma where the ways cannot show it."""
        lag_ns = round(lag_s * NS_PER_S)
        counted = self.counted_m(lag_s)
        change = self.counter.speed_mps(self.end_ns - lag_ns) - self.counter.speed_mps(self.begin_ns - lag_ns)
        # Noise of the odometer would look like a lag. Where its recording begins or ends the speed is NaN, no change.
        change = np.where(np.abs(change) <= self.counter.odometer.deadband_mps, 0.0, change)
        design = np.column_stack([counted, -change])
        used = np.isfinite(design).all(axis=1)
        for _ in range(_ROUNDS):
            normal = design[used].T @ design[used]
            singular = np.linalg.det(normal) <= 1e-9 * max(float(np.prod(np.diag(normal))), 1e-9)
            if used.sum() < _FEWEST or singular:
                return RecorderLag()
            estimate = np.linalg.solve(normal, design[used].T @ self.way_m[used])
            residual = self.way_m - design @ estimate
            spread = float(np.std(residual[used]) * np.sqrt(used.sum() / (used.sum() - 2.0)))
            sigmas = spread * np.sqrt(np.diag(np.linalg.inv(normal)))
            # 1.4826 MAD is the sigma of normal residuals, whatever a few outliers do.
            robust = 1.4826 * float(np.median(np.abs(residual[np.isfinite(residual)])))
            kept = np.isfinite(residual) & (np.abs(residual) <= _USUAL * robust + 1e-6)
            if np.array_equal(kept, used):
                break
            used = kept
        return RecorderLag(float(estimate[1]), float(sigmas[1]), float(estimate[0]), float(sigmas[0]))
