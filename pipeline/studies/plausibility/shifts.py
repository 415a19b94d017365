"""How another record of the journey, or the survey, lies to the positions: by which lag and shift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.network import surveyed
from pipeline.stages.track.once import Once
from pipeline.stages.track.segments import Polyline, on_segments
from pipeline.studies.plausibility.records import MOVING_MPS, Places
from pipeline.studies.plausibility.robust import (
    LEAST,
    Regression,
    Shift,
    explains,
    of_halves,
    regressed,
    sampled,
    steady,
)
from schemas.arrays import Floats, Ints
from schemas.config import PlausibilityConfig
from schemas.run import Site

# Two records are of one place within so much: the worst known datum is 700 m off, most 100 to 200.
_SAME_PLACE_M = 400.0
# Passages of single places agree on a lag within this time, and so large a share of them has to.
_PASSING_S = 2.0
_PASSING_SHARE = 0.6
# One shift of the survey leaves at most this share of the distance, for so many of the positions.
_SHIFT_LEAVES = 0.5
_SHIFT_POSITIONS = 0.75
# With less of the information across a line of one heading, a shift along the track is not known.
_ONE_HEADING = 0.04
# Each round finds the nearest segments of the track anew.
_ROUNDS = 8


@dataclass(frozen=True)
class PlaceFit(Shift):
    """How a record of places fits the GNSS: `lag_s` is its stamp of a moment minus the GNSS's.

    The shift is the record's place minus the GNSS's. `agreeing`: share of moving epochs that agree then, and
    `as_recorded` as they are. Steady is what both halves of the run show. `reason`: why nothing is known.
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


def fit_places(gnss: Places, record: Places, config: PlausibilityConfig) -> PlaceFit:
    """Lag and shift of another record of the same journey; a shift of its clock has to explain more than none."""
    as_recorded = _refined(gnss, record, 0.0, config)
    moving = sampled(gnss.moving, 100)
    number, passed_s = passes(record, gnss.points.take(np.flatnonzero(moving)), _SAME_PLACE_M)
    lag_s, _ = common_lag(passed_s - gnss.t_s[moving][number], int(moving.sum()))
    if lag_s is None or abs(lag_s) <= _PASSING_S:
        return as_recorded
    shifted = _refined(gnss, record, lag_s, config)
    if shifted.reason or not explains(shifted.agreeing, as_recorded.agreeing):
        return as_recorded
    return replace(shifted, as_recorded=as_recorded.as_recorded)


def passes(track: Places, places: Points, within_m: float) -> tuple[Ints, Floats]:
    """Which places a moving record passes, and when [s]; a place as often as it is passed."""
    surface = track.points.surface
    centre = surface.mean(axis=0)
    points = surface - centre
    near_to = places.surface - centre
    squares = (near_to**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * near_to @ points.T
    inner = squares[:, 1:-1]
    # Between two rows the train may be half their distance away from both.
    step_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    near = inner < (within_m + np.maximum(step_m[:-1], step_m[1:])) ** 2
    place, row = np.nonzero(near & (inner <= squares[:, :-2]) & (inner < squares[:, 2:]))
    away_m = np.full(place.size, np.inf)
    at_s = np.full(place.size, np.nan)
    line = Polyline(surface[:-1], surface[1:])
    passed = places.take(place)
    for begin in (row, row + 1):
        foot = on_segments(passed, line, begin)
        period_s = track.t_s[begin + 1] - track.t_s[begin]
        better = (foot.distance_m < away_m) & (period_s <= track.limit_s)
        at_s = np.where(better, track.t_s[begin] + np.clip(foot.fraction, 0.0, 1.0) * period_s, at_s)
        away_m = np.where(better, foot.distance_m, away_m)
    kept = (away_m < within_m) & track.moves(at_s)
    return place[kept], at_s[kept]


def common_lag(lags_s: Floats, count: int) -> tuple[float | None, float]:
    """What most of so many passages agree on, with its sigma [s]; None where they do not."""
    ordered = np.sort(lags_s)
    before = np.searchsorted(ordered, lags_s - _PASSING_S, "left")
    counts = np.searchsorted(ordered, lags_s + _PASSING_S, "right") - before
    if counts.max(initial=0) < max(_PASSING_SHARE * count, 3):
        return None, np.inf
    agreeing = lags_s[np.abs(lags_s - lags_s[counts.argmax()]) <= _PASSING_S]
    return float(np.median(agreeing)), float(np.std(agreeing) / np.sqrt(agreeing.size))


def _refined(gnss: Places, record: Places, lag_s: float, config: PlausibilityConfig) -> PlaceFit:
    """Shift and the rest of the lag by robust regression of what both are apart on the velocity."""
    t_s = gnss.t_s
    known = record.known(t_s + lag_s) & record.known(t_s + lag_s + 1.0) & record.known(t_s + lag_s - 1.0)
    rows = np.flatnonzero(sampled(known))
    t_s = t_s[rows] + lag_s
    axes = np.stack([gnss.points.east[rows], gnss.points.north[rows]], axis=1)
    velocity = np.einsum("ijk,ik->ij", axes, (record.at(t_s + 1.0) - record.at(t_s - 1.0)) / 2.0)
    apart = np.einsum("ijk,ik->ij", axes, record.at(t_s) - gnss.values[rows])
    moves = np.linalg.norm(velocity, axis=1) > MOVING_MPS
    if moves.sum() < 3 * LEAST:
        return PlaceFit(reason="hardly any movement in common")
    velocity = velocity[moves]
    apart = apart[moves]
    # Apart = lag * velocity + shift. Along one heading at constant speed the two look alike: it is taken for a lag.
    design = np.concatenate([velocity[:, :, None], np.broadcast_to(np.eye(2), (len(apart), 2, 2))], axis=2)

    def solved(rows: slice) -> Regression:
        return regressed(design[rows], apart[rows], floor=0.2, least_known=1e-4)

    fit = solved(slice(None))
    # What is reported besides is no disagreement, nor what positions scatter beyond it.
    bound = 1.5 * config.shift_told_m + config.lag_told_s * np.linalg.norm(velocity, axis=1)
    rest_s, east_m, north_m = fit.estimate.tolist()
    # The record is ahead by so much way at its stamp: it stamps a place so much too early.
    of_parts = (fit.estimate, *of_halves(solved, len(apart)))
    return PlaceFit(
        east_m=east_m,
        north_m=north_m,
        lag_s=lag_s - rest_s,
        lag_sigma_s=3.0 * float(fit.sigma[0]) if fit.whole else fit.spread / float(np.linalg.norm(velocity)),
        agreeing=float(np.mean(np.linalg.norm(apart - design @ fit.estimate, axis=1) < bound)),
        as_recorded=float(np.mean(np.linalg.norm(apart, axis=1) < bound)),
        lag_is_steady=steady(*(part[:1] - lag_s for part in of_parts)),
        shift_is_steady=steady(*(part[1:] for part in of_parts)),
    )


@dataclass(frozen=True)
class SurveyLine(Polyline):
    """The segments of a survey, with the heights of their ends."""

    height_start_m: Floats
    height_end_m: Floats

    def far_m(self, latitude_deg: Floats, longitude_deg: Floats) -> float:
        """Usual distance of some positions from the track."""
        if np.any(np.abs(latitude_deg) > 90.0):
            return float("inf")
        rows = slice(None, None, max(1, len(latitude_deg) // 100))
        return float(np.median(self.nearest_sample(points_of(latitude_deg[rows], longitude_deg[rows]).surface)[0]))


@dataclass(frozen=True)
class SurveyFit(Shift):
    """How positions lie to the track; the shift is the survey's place minus the positions'.

    `aside_m`: usual distance beside the track as recorded; `constant`: one shift explains most of it, in both halves of
    the run, and puts the positions on the track: a drift of them is no shift, nor is a run beside the network.
    `one_heading`: the shift along the track is not known. `up_m`: the survey's height minus the positions', one by one.
    """

    aside_m: float
    constant: bool
    one_heading: bool
    height_m: Floats
    up_m: Floats


@Once
def line_of(site: Site) -> SurveyLine:
    """The segments of a site's track."""
    track = surveyed(site)
    surface = track.surface
    within = np.any(surface[:-1] != surface[1:], axis=1)
    within[track.first[1:-1] - 1] = False
    rows = np.flatnonzero(within)
    return SurveyLine(surface[rows], surface[rows + 1], track.height_m[rows], track.height_m[rows + 1])


def fit_survey(gnss: Places, line: SurveyLine, near_m: float, start_m: tuple[float, float] = (0.0, 0.0)) -> SurveyFit:
    """The constant shift that brings moving positions onto the track, by repeated projection and robust regression.

    `near_m`: a position is on the track within so much; `start_m`: a shift to begin with.
    """
    moving = gnss.moving
    rows = np.flatnonzero(sampled(moving if moving.sum() >= 20 else np.ones_like(moving), 400))
    points = gnss.points.take(rows)
    axes = np.stack([points.east, points.north], axis=1)

    def beside(shift_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Direction across the track at the nearest segment of each moved position, how far it is, and its height."""
        _, nearest = line.nearest_sample(points.surface + np.einsum("ijk,j->ik", axes, shift_m))
        along = np.einsum("ijk,ik->ij", axes, line.end[nearest] - line.start[nearest])
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        feet = on_segments(points, line, nearest)
        part = np.clip(feet.fraction, 0.0, 1.0)
        low_m = line.height_start_m[nearest]
        return across, -feet.offset_m, low_m + part * (line.height_end_m[nearest] - low_m)

    aside_m = float(np.median(np.abs(beside(np.zeros(2))[1])))
    shift = np.array(start_m)
    for _ in range(_ROUNDS):
        across, apart, height_m = beside(shift)
        fit = regressed(across[:, None, :], apart[:, None], floor=1.0, least_known=_ONE_HEADING)
        shift = fit.estimate
    left = np.abs(apart - across @ shift)
    half = len(apart) // 2
    toward = (across @ shift) * apart
    whole = (across @ shift) ** 2
    is_steady = all(toward[part].sum() > 0.5 * whole[part].sum() for part in (slice(half), slice(half, None)))
    # By metres, not by what is left elsewhere: a shift brings no run onto a network that it left.
    near = float(np.mean(left < near_m)) > _SHIFT_POSITIONS
    return SurveyFit(
        east_m=float(shift[0]),
        north_m=float(shift[1]),
        aside_m=aside_m,
        constant=float(np.median(left)) < _SHIFT_LEAVES * aside_m and near and is_steady,
        one_heading=not fit.whole,
        height_m=gnss.height_m[rows],
        up_m=height_m - gnss.height_m[rows],
    )
