"""Lag and shift of a second record of positions (the reference, balise reads) against the GNSS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.plausibility.clocks import possible_lags
from pipeline.plausibility.course import Places
from schemas.arrays import Floats, Ints

# So far apart two records are not of one journey [m]; nearer, the same place is looked for within so much.
_ELSEWHERE_M = 20_000.0
_SAME_PLACE_M = 400.0
_MOST = 800
# Lags found place by place agree within so much [s], and so many of them must.
_BIN_S, _SHARE = 2.0, 0.6
_MOVES_MPS = 1.0
_ROUNDS = 12
# Positions agree with the fit if what is left is below this [m], or this many seconds of way.
_AGREES_M = 12.0
# Nobody looks for another lag where so many do.
_SURELY = 0.93


@dataclass(frozen=True)
class PlaceFit:
    """How a record of places fits the GNSS: `lag_s` is its stamp of a moment minus the GNSS's.

    `east_m`, `north_m`: the record's place minus the GNSS's. `agreeing`: share of moving epochs that agree then, and
    `as_recorded` as they are. `halves`: lag, east and north of the first and the second half alone. `reason`: why
    nothing is told.
    """

    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    east_m: float = 0.0
    north_m: float = 0.0
    agreeing: float = 0.0
    as_recorded: float = 0.0
    halves: tuple[tuple[float, float, float], ...] = ()
    reason: str = ""

    @property
    def shift_m(self) -> float:
        return float(np.hypot(self.east_m, self.north_m))

    @property
    def lag_is_steady(self) -> bool:
        """Whether both halves show the lag: a drift of the positions is none."""
        return all(lag_s * self.lag_s > 0.5 * self.lag_s**2 for lag_s, _, _ in self.halves)

    @property
    def shift_is_steady(self) -> bool:
        """Whether both halves show the shift."""
        toward = [east_m * self.east_m + north_m * self.north_m for _, east_m, north_m in self.halves]
        return all(one > 0.5 * self.shift_m**2 for one in toward)


def fit_places(gnss: Places, record: Places) -> PlaceFit:
    """Lag and shift of another record of the same journey."""
    from scipy.spatial import cKDTree

    far_m = float(np.min(cKDTree(record.ecef_m[:: max(1, len(record.t_s) // 200)]).query(gnss.ecef_m[::20])[0]))
    if far_m > _ELSEWHERE_M:
        return PlaceFit(reason=f"it is {far_m / 1000:.0f} km from the positions")
    as_recorded = _refined(gnss, record, 0.0)
    if not as_recorded.reason and as_recorded.agreeing >= _SURELY:
        return as_recorded
    spans = [(float(one.t_s[0]), float(one.t_s[-1])) for one in (gnss, record)]
    possible = possible_lags(spans[0], gnss.speed, spans[1], record.speed).lags_s
    others = dict.fromkeys((*possible, _lag_by_place(gnss, record)))
    fitted = [as_recorded, *(_refined(gnss, record, lag_s) for lag_s in others)]
    told = [one for one in fitted if not one.reason]
    if not told:
        return fitted[0]
    # As recorded wins a tie: a shift of the clock has to explain more.
    best = max(told, key=lambda one: one.agreeing - (0.1 if abs(one.lag_s) > 2.0 else 0.0))
    return replace(best, as_recorded=0.0 if as_recorded.reason else as_recorded.as_recorded)


def _lag_by_place(gnss: Places, record: Places) -> float:
    """The lag at which most epochs have the record at the same place; 0 where none has."""
    from scipy.spatial import cKDTree

    grid = np.linspace(record.t_s[0], record.t_s[-1], int(np.clip(record.t_s[-1] - record.t_s[0], 10, 20_000)))
    moving = record.known(grid) & (np.nan_to_num(record.speed(grid)) > _MOVES_MPS)
    rows = _sample(np.flatnonzero(np.nan_to_num(gnss.speed(gnss.t_s)) > _MOVES_MPS))
    if moving.sum() < 10 or rows.size < 10:
        return 0.0
    away_m, nearest = cKDTree(record.at(grid[moving])).query(gnss.ecef_m[rows])
    lags = (grid[moving][nearest] - gnss.t_s[rows])[away_m < _SAME_PLACE_M]
    return common_lag(lags) or 0.0


def common_lag(lags_s: Floats) -> float | None:
    """What most lags agree on; None where they do not."""
    if lags_s.size < 3:
        return None
    ordered = np.sort(lags_s)
    counts = np.searchsorted(ordered, lags_s + _BIN_S, "right") - np.searchsorted(ordered, lags_s - _BIN_S, "left")
    best = int(counts.argmax())
    if counts[best] < _SHARE * lags_s.size:
        return None
    return float(np.median(lags_s[np.abs(lags_s - lags_s[best]) <= _BIN_S]))


def _sample(rows: Ints) -> Ints:
    return rows[:: max(1, rows.size // _MOST)]


def _refined(gnss: Places, record: Places, lag_s: float) -> PlaceFit:
    """Shift and the rest of the lag by robust regression of what both are apart on the velocity."""
    rows = _sample(np.arange(gnss.t_s.size))
    t_s = gnss.t_s[rows]
    known = record.known(t_s + lag_s) & record.known(t_s + lag_s + 1.0) & record.known(t_s + lag_s - 1.0)
    rows, t_s = rows[known], t_s[known]
    axes = np.stack([gnss.points.east[rows], gnss.points.north[rows]], axis=1)
    velocity = np.einsum("ijk,ik->ij", axes, (record.at(t_s + lag_s + 1.0) - record.at(t_s + lag_s - 1.0)) / 2.0)
    apart = np.einsum("ijk,ik->ij", axes, record.at(t_s + lag_s) - gnss.ecef_m[rows])
    moves = np.hypot(velocity[:, 0], velocity[:, 1]) > _MOVES_MPS
    if moves.sum() < 20:
        return PlaceFit(reason="hardly any movement in common")
    velocity, apart = velocity[moves], apart[moves]
    rest_s, shift, sigma_s = _regressed(velocity, apart)
    left = np.linalg.norm(apart - shift - rest_s * velocity, axis=1)
    bound = _AGREES_M + 0.3 * np.linalg.norm(velocity, axis=1)
    agreeing, before = float(np.mean(left < bound)), float(np.mean(np.linalg.norm(apart, axis=1) < bound))
    # The record is ahead by `rest_s` of way at its stamp: it stamps a place so much too early.
    middle = len(apart) // 2
    parts = [_regressed(velocity[part], apart[part]) for part in (slice(middle), slice(middle, None))]
    halves = tuple((lag_s - rest, float(moved[0]), float(moved[1])) for rest, moved, _ in parts)
    return PlaceFit(lag_s - rest_s, sigma_s, float(shift[0]), float(shift[1]), agreeing, before, halves)


def _regressed(velocity: Floats, apart: Floats) -> tuple[float, Floats, float]:
    """Seconds along the way and a constant shift that explain what both are apart; least absolute deviations."""
    count = apart.shape[0]
    design = np.zeros((2 * count, 3))
    design[:, 0] = velocity.ravel()
    design[0::2, 1], design[1::2, 2] = 1.0, 1.0
    target = apart.ravel()
    weight, estimate, normal = np.ones(2 * count), np.zeros(3), np.eye(3)
    # A shift of the size of noise is preferred to none, so that constant speed on a straight line tells a lag.
    prior = np.diag([1e-6, 1e-3, 1e-3]) * count
    for _ in range(_ROUNDS):
        normal = design.T @ (design * weight[:, None]) + prior
        estimate = np.linalg.solve(normal, design.T @ (weight * target))
        left = np.linalg.norm((target - design @ estimate).reshape(-1, 2), axis=1)
        weight = np.repeat(1.0 / np.maximum(left, 0.2), 2)
        weight /= weight.mean()
    spread = 1.4826 * float(np.median(left))
    return float(estimate[0]), estimate[1:], 3.0 * spread * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
