"""The clock of reference or reads against the odometer's, measured over the run and never with the GNSS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.evidence.carrying import Counter
from schemas.arrays import NS_PER_S, Floats, Ints
from schemas.config import HazardConfig

# Numerics: range and step of the search for a coarse lag [s]; rounds of the regression after it.
_FARTHEST_S = 30.0
_STEP_S = 0.5
_ROUNDS = 4
# Least number of ways for a lag, and for a coarse lag of seconds.
_FEWEST, _FEWEST_FAR = 6, 12
# A lag of seconds leaves less than this share of what the ways differ by as recorded.
_EXPLAINS = 0.5
# Outliers, in robust standard deviations: slip, or a step of the reference.
_USUAL = 4.0


@dataclass(frozen=True)
class RecorderLag:
    """Stamp of a moment by the recorder minus that by the odometer [s]; an infinite sigma: not known."""

    lag_s: float = 0.0
    sigma_s: float = float("inf")


@dataclass(frozen=True)
class RecorderClock:
    """How a recorder's clock is taken: its stamps less `shift_s`, +- `delta_s`; `assumed`: it could not be measured."""

    shift_s: float
    delta_s: float
    assumed: bool = False


def clock_of(lag: RecorderLag, vehicle_file: bool, config: HazardConfig) -> RecorderClock:
    """DOMAIN section 5.1: delta = k sigma on the odometer's clock with a vehicle file, else |lag| + k sigma.

    `vehicle_file`: it gives the latency of the GNSS against the odometer, whose clock the judge uses then.
    """
    noise_s = config.evidence_factor * lag.sigma_s
    measured = noise_s <= config.evidence_clock_s
    if measured and vehicle_file:
        return RecorderClock(lag.lag_s, noise_s)
    if measured or abs(lag.lag_s) > noise_s:
        return RecorderClock(0.0, abs(lag.lag_s) + noise_s)
    return RecorderClock(0.0, config.evidence_clock_s, assumed=True)


def lag_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter | None) -> RecorderLag:
    """The lag of a recorder by the ways `way_m` that it saw between its stamps, positive as the odometer counts up.

    way = scale * counted - lag * change of speed, by least squares without outliers; sigma is that of the fit, or half
    the difference between the two halves of the run if that is larger.
    """
    if counter is None or begin_ns.size < _FEWEST:
        return RecorderLag()
    coarse_s = _coarse_lag_s(begin_ns, end_ns, way_m, counter) if begin_ns.size >= _FEWEST_FAR else 0.0
    lag_s = coarse_s
    sigma_s = np.inf
    for _ in range(_ROUNDS):
        rest_s, sigma_s = _rest_of_lag(begin_ns, end_ns, way_m, counter, lag_s)
        if not np.isfinite(sigma_s) or abs(lag_s + rest_s - coarse_s) > 2.0 * _STEP_S + 3.0 * sigma_s:
            return RecorderLag()
        lag_s += rest_s
    half = begin_ns.size // 2
    parts = (slice(None, half), slice(half, None))
    halves = [_rest_of_lag(begin_ns[part], end_ns[part], way_m[part], counter, lag_s) for part in parts]
    if max(half_sigma_s for _, half_sigma_s in halves) < 3.0 * sigma_s:
        sigma_s = max(sigma_s, 0.5 * abs(halves[0][0] - halves[1][0]))
    return RecorderLag(float(lag_s), float(sigma_s))


def _coarse_lag_s(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> float:
    """The lag with the least median difference of the ways; 0 where it does not halve that without a lag."""
    lags_s = np.arange(-_FARTHEST_S, _FARTHEST_S + _STEP_S, _STEP_S)
    spreads = []
    for lag_s in lags_s.tolist():
        lag_ns = round(lag_s * NS_PER_S)
        counted = counter.distance_m(begin_ns - lag_ns, end_ns - lag_ns)
        known = np.isfinite(counted)
        enough = known.sum() >= 0.5 * known.size and float(np.abs(counted[known]).sum()) > 0.0
        spreads.append(float(np.median(np.abs(way_m - counted)[known])) if enough else np.inf)
    none = spreads[lags_s.size // 2]
    best = int(np.argmin(spreads))
    return float(lags_s[best]) if spreads[best] < _EXPLAINS * none else 0.0


def _rest_of_lag(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter, lag_s: float) -> tuple[float, float]:
    """The remaining lag once `lag_s` is taken off, and its sigma [s], infinite where the ways cannot show it."""
    lag_ns = round(lag_s * NS_PER_S)
    counted = counter.distance_m(begin_ns - lag_ns, end_ns - lag_ns)
    change = counter.speed_mps(end_ns - lag_ns) - counter.speed_mps(begin_ns - lag_ns)
    # Noise of the odometer would look like a lag. Where its recording begins or ends the speed is NaN, not a change.
    change = np.where(np.abs(change) <= counter.odometer.deadband_mps, 0.0, change)
    design = np.column_stack([counted, -change])
    used = np.isfinite(design).all(axis=1)
    estimate = np.array([1.0, 0.0])
    sigma = np.inf
    for _ in range(_ROUNDS):
        normal = design[used].T @ design[used]
        singular = np.linalg.det(normal) <= 1e-9 * max(float(np.prod(np.diag(normal))), 1e-9)
        if used.sum() < _FEWEST or singular:
            return 0.0, np.inf
        estimate = np.linalg.solve(normal, design[used].T @ way_m[used])
        residual = way_m - design @ estimate
        spread = float(np.std(residual[used]) * np.sqrt(used.sum() / (used.sum() - 2.0)))
        sigma = spread * float(np.sqrt(np.linalg.inv(normal)[1, 1]))
        # 1.4826 MAD is the sigma of normal residuals, whatever a few outliers do.
        robust = 1.4826 * float(np.median(np.abs(residual[np.isfinite(residual)])))
        used = np.isfinite(residual) & (np.abs(residual) <= _USUAL * robust + 1e-6)
    return float(estimate[1]), float(sigma)
