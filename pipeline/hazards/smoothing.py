"""A post-processed truth for trials without reference or balise reads: GNSS and odometer smoothed on the track.

Rauch-Tung-Striebel smoother (Kalman filter forwards, correction backwards) of what the position adds to the
odometer's distance. Epochs under alarm or negation, the lead before them and outliers are left out. It is made
from the position that it judges: a slow error that no monitor saw goes into it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.figures.bounds import SURE_SIGMAS
from pipeline.hazards.travel import Travel
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats

_NODE_S = 1.0
# A position error correlated over tau tells as much in a second as a white one of variance 2 tau sigma^2
# (DIAG Table 1: user error, 100 s).
_CORRELATION_S = 100.0
_LEAST_SCALE_SIGMA = 1e-4


@dataclass(frozen=True)
class Smoothed:
    """Path position and its sigma per epoch [m]; NaN where the odometer does not reach."""

    path_m: Floats
    sigma_m: Floats


@dataclass(frozen=True)
class _Nodes:
    """Observations about a second apart in one stretch of the odometer; NaN where the position is left out."""

    epoch: Ints
    t_s: Floats
    distance_m: Floats
    offset_m: Floats
    sigma_m: Floats
    white_m2_per_s: Floats


def smoothed_truth(epochs: pl.DataFrame, travel: Travel, position_m: Floats, lead_s: float) -> Smoothed:
    """Smooth each stretch of the odometer by itself.

    `lead_s`: how long before an alarm the position is not trusted. `epochs`: `sigma_along_m, alarm, negated`.
    """
    trusted = np.isfinite(position_m) & ~_under_alarm(epochs, travel.at_ns, lead_s)
    offset = np.where(trusted, position_m - travel.distance_m, np.nan)
    sigma = np.nan_to_num(np.hypot(floats(epochs, "sigma_along_m"), np.sqrt(travel.reading_m2)), nan=np.inf)
    path, spread = np.full(offset.size, np.nan), np.full(offset.size, np.nan)
    counted = np.isfinite(travel.distance_m)
    for stretch in np.unique(travel.stretch[counted]):
        rows = np.flatnonzero(counted & (travel.stretch == stretch))
        if np.isfinite(offset[rows]).any():
            nodes = _nodes_of(rows, travel, offset, sigma)
            mean, variance = _smooth(nodes, float(travel.scale_sigma[rows].max()))
            at = (travel.at_ns[rows] - travel.at_ns[rows[0]]) / NS_PER_S
            path[rows] = travel.distance_m[rows] + np.interp(at, nodes.t_s, mean)
            spread[rows] = np.sqrt(np.interp(at, nodes.t_s, variance))
    return Smoothed(path, spread)


def _under_alarm(epochs: pl.DataFrame, at_ns: Ints, lead_s: float) -> Bools:
    bad = flags(epochs, "alarm") | flags(epochs, "negated")
    marked = np.concatenate(([0], np.cumsum(bad)))
    ahead = np.searchsorted(at_ns, at_ns + round(lead_s * NS_PER_S), side="right")
    result: Bools = marked[ahead] - marked[np.arange(at_ns.size)] > 0
    return result


def _nodes_of(rows: Ints, travel: Travel, offset_m: Floats, sigma_m: Floats) -> _Nodes:
    t_s = (travel.at_ns[rows] - travel.at_ns[rows[0]]) / NS_PER_S
    first = np.unique(np.floor(t_s / _NODE_S + 1e-9), return_index=True)[1]
    keep = np.union1d(first, [rows.size - 1])
    chosen = rows[keep]
    return _Nodes(
        chosen,
        t_s[keep],
        travel.distance_m[chosen],
        offset_m[chosen],
        sigma_m[chosen],
        travel.white_m2_per_s[chosen],
    )


def _smooth(nodes: _Nodes, scale_sigma: float) -> tuple[Floats, Floats]:
    """Mean and variance of the offset at each node; the state is offset [m] and scale error of the odometer."""
    size = nodes.epoch.size
    states, covariances = np.zeros((size, 2)), np.zeros((size, 2, 2))
    predicted, predicted_covariances = np.zeros((size, 2)), np.zeros((size, 2, 2))
    moves = np.repeat(np.eye(2)[None], size, axis=0)
    moves[1:, 0, 1] = np.diff(nodes.distance_m)
    first = int(np.flatnonzero(np.isfinite(nodes.offset_m))[0])
    scale_sigma = max(scale_sigma, _LEAST_SCALE_SIGMA)
    # The prior says nothing about the offset but that it is not a kilometre from the first one seen.
    x, p = np.array([nodes.offset_m[first], 0.0]), np.diag([1e6, scale_sigma**2])
    for k in range(size):
        if k:
            q = nodes.white_m2_per_s[k] * (nodes.t_s[k] - nodes.t_s[k - 1])
            x, p = moves[k] @ x, moves[k] @ p @ moves[k].T + np.diag([q, 0.0])
        predicted[k], predicted_covariances[k] = x, p
        x, p = _updated(x, p, float(nodes.offset_m[k]), float(nodes.sigma_m[k]))
        states[k], covariances[k] = x, p
    _backwards(states, covariances, predicted, predicted_covariances, moves)
    return states[:, 0], covariances[:, 0, 0]


def _updated(x: Floats, p: Floats, offset_m: float, sigma_m: float) -> tuple[Floats, Floats]:
    if not (np.isfinite(offset_m) and np.isfinite(sigma_m)):
        return x, p
    innovation = offset_m - x[0]
    if abs(innovation) > SURE_SIGMAS * np.sqrt(p[0, 0] + sigma_m**2):
        return x, p
    gain = p[:, 0] / (p[0, 0] + sigma_m**2 * 2.0 * _CORRELATION_S / _NODE_S)
    return x + gain * innovation, p - np.outer(gain, p[0])


def _backwards(
    states: Floats, covariances: Floats, predicted: Floats, predicted_covariances: Floats, moves: Floats
) -> None:
    """Rauch-Tung-Striebel recursion, in place."""
    for k in range(len(states) - 2, -1, -1):
        gain = covariances[k] @ moves[k + 1].T @ np.linalg.inv(predicted_covariances[k + 1])
        states[k] += gain @ (states[k + 1] - predicted[k + 1])
        covariances[k] += gain @ (covariances[k + 1] - predicted_covariances[k + 1]) @ gain.T
