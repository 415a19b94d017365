"""When a record of positions passes places, and how a second record of the same journey fits it: lag and shift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.plausibility.records import Places
from pipeline.plausibility.robust import LEAST, Shift, explains, regressed, sampled
from schemas.arrays import Floats, Ints
from schemas.config import PlausibilityConfig


@dataclass(frozen=True)
class PlaceFit(Shift):
    """How a record of places fits the GNSS: `lag_s` is its stamp of a moment minus the GNSS's.

    The shift is the record's place minus the GNSS's. `agreeing`: share of moving epochs that agree then, and
    `as_recorded` as they are. Steady is what both halves of the run show. `reason`: why nothing is told.
    """

    east_m: float = 0.0
    north_m: float = 0.0
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    agreeing: float = 0.0
    as_recorded: float = 0.0
    lag_is_steady: bool = True
    shift_is_steady: bool = True
    reason: str = ""


def fit_places(gnss: Places, record: Places) -> PlaceFit:
    """Lag and shift of another record of the same journey; a shift of its clock has to explain more than none."""
    config, as_recorded = gnss.config, _refined(gnss, record, 0.0)
    moving = sampled(gnss.moving, 100)
    number, passed_s = passes(record, gnss.points.surface[moving], config.same_place_m)
    lag_s, _ = common_lag(passed_s - gnss.t_s[moving][number], int(moving.sum()), config)
    if lag_s is None or abs(lag_s) <= config.passing_s:
        return as_recorded
    shifted = _refined(gnss, record, lag_s)
    if shifted.reason or not explains(shifted.agreeing, 0.0 if as_recorded.reason else as_recorded.agreeing):
        return as_recorded
    return replace(shifted, as_recorded=0.0 if as_recorded.reason else as_recorded.as_recorded)


def passes(track: Places, places_m: Floats, within_m: float) -> tuple[Ints, Floats]:
    """Which places at height zero a moving record passes, and when [s]; a place as often as it is passed."""
    surface = track.points.surface
    centre = surface.mean(axis=0)
    points, places = surface - centre, places_m - centre
    squares = (places**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * places @ points.T
    inner = squares[:, 1:-1]
    # Between two rows the train may be half their distance away from both.
    step_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    near = inner < (within_m + np.maximum(step_m[:-1], step_m[1:])) ** 2
    place, row = np.nonzero(near & (inner <= squares[:, :-2]) & (inner < squares[:, 2:]))
    away_m, at_s = np.full(place.size, np.inf), np.full(place.size, np.nan)
    for begin in (row, row + 1):
        step, from_m = points[begin + 1] - points[begin], places[place] - points[begin]
        part = np.clip((from_m * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-9), 0.0, 1.0)
        left_m = np.linalg.norm(from_m - part[:, None] * step, axis=1)
        period_s = track.t_s[begin + 1] - track.t_s[begin]
        better = (left_m < away_m) & (period_s <= track.limit_s)
        at_s = np.where(better, track.t_s[begin] + part * period_s, at_s)
        away_m = np.where(better, left_m, away_m)
    kept = (away_m < within_m) & track.moves(at_s)
    return place[kept], at_s[kept]


def common_lag(lags_s: Floats, count: int, config: PlausibilityConfig) -> tuple[float | None, float]:
    """What most of so many passages agree on, with its sigma [s]; None where they do not."""
    if lags_s.size < 3:
        return None, np.inf
    ordered = np.sort(lags_s)
    near_s = config.passing_s
    counts = np.searchsorted(ordered, lags_s + near_s, "right") - np.searchsorted(ordered, lags_s - near_s, "left")
    best = int(counts.argmax())
    if counts[best] < max(config.passing_share * count, 3):
        return None, np.inf
    agreeing = lags_s[np.abs(lags_s - lags_s[best]) <= near_s]
    return float(np.median(agreeing)), float(np.std(agreeing) / np.sqrt(agreeing.size))


def _refined(gnss: Places, record: Places, lag_s: float) -> PlaceFit:
    """Shift and the rest of the lag by robust regression of what both are apart on the velocity."""
    config, t_s = gnss.config, gnss.t_s
    known = record.known(t_s + lag_s) & record.known(t_s + lag_s + 1.0) & record.known(t_s + lag_s - 1.0)
    rows = np.flatnonzero(sampled(known))
    t_s = t_s[rows] + lag_s
    axes = np.stack([gnss.points.east[rows], gnss.points.north[rows]], axis=1)
    velocity = np.einsum("ijk,ik->ij", axes, (record.at(t_s + 1.0) - record.at(t_s - 1.0)) / 2.0)
    apart = np.einsum("ijk,ik->ij", axes, record.at(t_s) - gnss.values[rows])
    moves = np.linalg.norm(velocity, axis=1) > config.moving_mps
    if moves.sum() < 3 * LEAST:
        return PlaceFit(reason="hardly any movement in common")
    velocity, apart = velocity[moves], apart[moves]
    design = np.concatenate([velocity[:, :, None], np.broadcast_to(np.eye(2), (len(apart), 2, 2))], axis=2)
    # Along one heading at constant speed a lag and a shift look alike: it is taken for a lag.
    fit = regressed(design, apart, floor=0.2, told=1e-4)
    # What is told besides is no disagreement, nor what positions scatter beyond it.
    bound = 1.5 * config.shift_told_m + config.lag_told_s * np.linalg.norm(velocity, axis=1)
    agreeing = float(np.mean(np.linalg.norm(apart - design @ fit.estimate, axis=1) < bound))
    before = float(np.mean(np.linalg.norm(apart, axis=1) < bound))
    # The record is ahead by so much way at its stamp: it stamps a place so much too early.
    rest_s, east_m, north_m = fit.estimate.tolist()
    sigma_s = 3.0 * float(fit.sigma[0]) if fit.whole else fit.spread / float(np.linalg.norm(velocity))
    steady = fit.steady(0, 1, lag_s), fit.steady(1, 3)
    return PlaceFit(east_m, north_m, lag_s - rest_s, sigma_s, agreeing, before, *steady)
