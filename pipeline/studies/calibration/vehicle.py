"""Odometer scale and GNSS latency of a vehicle, with their uncertainty, from runs known to be fault-free.

Along the path, GNSS position against odometer distance D is

    x(t) = offset + scale * D(t - latency) + correlated GNSS errors + random walk of the odometer

by generalised least squares under the monitor bank's error model (DIAG Table 1). Unlike the causal filter of a replay
this looks at whole runs, which is right only because they are not the runs to be diagnosed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_solve, solve_triangular

from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.scale_lag import scale_and_lag
from schemas.arrays import Floats
from schemas.config import CalibrationConfig

# Numerics: points of one dense covariance, which takes time by their third power.
_BLOCK_POINTS = 900
_ITERATIONS = 4
# Numerics: of what a run seems to tell of the latency at least so much counts, so that its sigma stays finite.
_LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class RunEstimate:
    """One run's scale and latency [s]; `misfit` is the root of chi-square per degree of freedom.

    Sigmas are widened by the misfit where it exceeds 1.
    """

    scale: float
    scale_sigma: float
    latency_s: float
    latency_sigma_s: float
    misfit: float
    points: int


@dataclass(frozen=True)
class Observations:
    """Usable epochs of one run: time [s on the odometer's scale], path position and its sigma [m]."""

    t_s: Floats
    path_m: Floats
    sigma_m: Floats


def estimate_run(
    seen: Observations,
    odometry: Odometry,
    shares: Floats,
    taus_s: Floats,
    config: CalibrationConfig,
    latency_s: float = 0.0,
) -> RunEstimate | None:
    """None where too little can be compared; `odometry` grows with the path. Gauss-Newton steps from `latency_s`."""
    blocks = _blocks(seen, odometry, config)
    if not blocks:
        return None
    factors = [_factor(_covariance(block, odometry, shares, taus_s, config)) for block in blocks]
    by_chance = sum(_chance_information(block, factor, odometry) for block, factor in zip(blocks, factors, strict=True))
    scale = scale_sigma = latency_sigma_s = misfit = 0.0
    for _ in range(_ITERATIONS):
        normal, right, left_over, freedom = _accumulate(blocks, factors, odometry, latency_s)
        misfit = float(np.sqrt(max(left_over, 0.0) / max(freedom, 1)))
        estimate = scale_and_lag(normal, right, max(1.0, misfit), latency_s)
        if estimate is None:
            return None
        scale, scale_sigma, latency_s, latency_sigma_s = estimate
    latency_sigma_s = _widened(latency_sigma_s, scale**2 * by_chance)
    points = sum(block.t_s.size for block in blocks)
    return RunEstimate(scale, scale_sigma, latency_s, latency_sigma_s, misfit, points)


def _blocks(seen: Observations, odometry: Odometry, config: CalibrationConfig) -> list[Observations]:
    """Thinned observations in pieces of unbroken odometry, each with an offset of its own."""
    begin_s, end_s = odometry.span_s(seen.t_s)
    known = (
        odometry.known_at_s(seen.t_s)
        & odometry.known_at_s(seen.t_s - 1.0)
        & odometry.known_at_s(begin_s)
        & odometry.known_at_s(end_s)
    )
    rows = np.flatnonzero(known & np.isfinite(seen.path_m) & np.isfinite(seen.sigma_m) & (seen.sigma_m > 0))
    rows = rows[_thinned(seen.t_s[rows], config)]
    pieces: list[Observations] = []
    for piece in np.split(rows, np.flatnonzero(np.diff(odometry.doubt_at_s(seen.t_s[rows]))) + 1):
        for part in np.array_split(piece, max(1, -(-piece.size // _BLOCK_POINTS))):
            if part.size >= config.least_points:
                pieces.append(Observations(seen.t_s[part], seen.path_m[part], seen.sigma_m[part]))
    return pieces


def _thinned(t_s: Floats, config: CalibrationConfig) -> npt.NDArray[np.int64]:
    """Indices a step apart that suits the length of the run."""
    if t_s.size == 0:
        return np.zeros(0, dtype=np.int64)
    step_s = np.clip((t_s[-1] - t_s[0]) / (_BLOCK_POINTS - 1), config.step_least_s, config.step_most_s)
    slot = np.floor((t_s - t_s[0]) / step_s + 1e-6).astype(np.int64)
    return np.flatnonzero(np.diff(slot, prepend=-1))


def _covariance(
    block: Observations, odometry: Odometry, shares: Floats, taus_s: Floats, config: CalibrationConfig
) -> Floats:
    """Covariance of GNSS minus odometer [m^2]: Gauss-Markov sources, a white rest, the odometer's walk and rows."""
    lag = np.abs(block.t_s[:, None] - block.t_s[None, :])
    correlation = sum(share * np.exp(-lag / tau) for share, tau in zip(shares, taus_s, strict=True))
    gnss = np.outer(block.sigma_m, block.sigma_m) * correlation
    since = block.t_s - block.t_s[0]
    walk = odometry.noise.white_m2_per_s * np.minimum(since[:, None], since[None, :])
    result: Floats = gnss + walk + np.diag(config.white_share * block.sigma_m**2)
    return result + _of_rows(odometry, block.t_s, block.t_s) if odometry.noise.quantisation else result


def _factor(covariance: Floats) -> Floats:
    """Lower triangle of Cholesky."""
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _of_rows(odometry: Odometry, one_s: Floats, other_s: Floats) -> Floats:
    """Covariance of the noise of the odometer's rows between two sets of times [m^2] (`QuantisationNoise`).

    A counter is off by the same while the train stands: many rows tell no more than one. After a share x of its step
    the correlation is 1 - 6 x + 6 x^2, by the first terms. Other noise is each row's own.
    """
    sigmas = [odometry.row_sigma_m(at_s) for at_s in (one_s, other_s)]
    ways = (one_s, other_s)
    scale = odometry.period_s
    if odometry.noise.counter_m > 0.0:
        counts = np.flatnonzero(np.diff(odometry.distance_m, prepend=np.nan) != 0)
        at_s = odometry.t_s[counts]
        at_m = odometry.distance_m[counts]
        ways = (np.interp(one_s, at_s, at_m), np.interp(other_s, at_s, at_m))
        scale = odometry.noise.counter_m / 6.0
    apart = np.abs(ways[0][:, None] - ways[1][None, :])
    result: Floats = np.outer(*sigmas) * np.maximum(1.0 - apart / scale, 0.0)
    return result


def _accumulate(
    blocks: list[Observations], factors: list[Floats], odometry: Odometry, latency_s: float
) -> tuple[Floats, Floats, float, int]:
    """Normal equations of `scale_and_lag`, chi-square of the residuals, and its degrees of freedom.

    Each block has an offset of its own, which is eliminated.
    """
    normal = np.zeros((2, 2))
    right = np.zeros(2)
    left_over = 0.0
    freedom = -2
    for block, factor in zip(blocks, factors, strict=True):
        way_m, speed_mps = odometry.reading_at_s(block.t_s - latency_s)
        columns = [np.ones(way_m.size), way_m - way_m[0], -speed_mps, block.path_m - block.path_m[0]]
        # Whitened by the factor; what is left after projection on the whitened offset does not depend on it.
        white = solve_triangular(factor, np.column_stack(columns), lower=True)
        offset = white[:, 0] / np.linalg.norm(white[:, 0])
        free = white[:, 1:] - np.outer(offset, offset @ white[:, 1:])
        normal += free[:, :2].T @ free[:, :2]
        right += free[:, :2].T @ free[:, 2]
        left_over += float(free[:, 2] @ free[:, 2])
        freedom += way_m.size - 1
    if np.linalg.matrix_rank(normal) == normal.shape[0]:
        left_over -= float(right @ np.linalg.solve(normal, right))
    return normal, right, left_over, freedom


def _chance_information(block: Observations, factor: Floats, odometry: Odometry) -> float:
    """What the odometer's noise alone, taken for changes of speed, seems to tell of the latency [1/s^2], on average.

    In a speed over 2 S seconds it has covariance r (2 S - lag) / (2 S)^2, r the variance of its walk per second, beside
    that of the rows at both ends.
    """
    span_s = 2.0 * odometry.config.latency_span_s
    lag = np.abs(block.t_s[:, None] - block.t_s[None, :])
    noise = odometry.noise.white_m2_per_s * np.maximum(span_s - lag, 0.0) / span_s**2
    if odometry.noise.quantisation:
        begin_s, end_s = odometry.span_s(block.t_s)
        across = _of_rows(odometry, begin_s, end_s)
        rows = _of_rows(odometry, begin_s, begin_s) + _of_rows(odometry, end_s, end_s) - across - across.T
        noise = noise + rows / span_s**2
    solved = cho_solve((factor, True), np.column_stack([noise, np.ones(block.t_s.size)]))
    inverse_ones = solved[:, -1]
    return float(np.trace(solved[:, :-1]) - inverse_ones @ noise @ inverse_ones / inverse_ones.sum())


def _widened(sigma_s: float, by_chance: float) -> float:
    """Sigma without the information of chance: twice its mean, as chance often shows more than that."""
    information = 1.0 / sigma_s**2
    return float(1.0 / np.sqrt(max(information - 2.0 * by_chance, _LEAST_SHARE * information)))


@dataclass(frozen=True)
class Pooled:
    """Of the next run of the vehicle."""

    value: float
    sigma: float


def pooled(values: Floats, sigmas: Floats) -> Pooled:
    """Runs together (DerSimonian and Laird 1986); the sigma includes their scatter: wheels wear and sensors drift."""
    weight = 1.0 / sigmas**2
    mean = float(weight @ values / weight.sum())
    scatter = float(weight @ (values - mean) ** 2)
    spare = weight.sum() - float(weight @ weight) / weight.sum()
    between = max(0.0, (scatter - (values.size - 1)) / spare) if values.size > 1 else 0.0
    weight = 1.0 / (sigmas**2 + between)
    mean = float(weight @ values / weight.sum())
    return Pooled(mean, float(np.sqrt(1.0 / weight.sum() + between)))
