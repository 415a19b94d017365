"""How another record of the journey, balise reads and the survey lie to the positions: by which lag and shift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.network import Once, surveyed_track
from pipeline.stages.track.segments import Polyline, project_on_segments
from pipeline.studies.plausibility.pairs import (
    LEAST,
    clock_lag,
    explains,
    halves_agree,
    regressed,
    sampled,
    split_in_half,
)
from pipeline.studies.plausibility.records import MOVING_MPS, Places
from schemas.arrays import Floats, Ints
from schemas.config import PlausibilityConfig
from schemas.frozen import frozen
from schemas.run import Site

# Passages of single places agree on a lag within this time, and so large a share of them has to.
_PASSING_S = 2.0
_PASSING_SHARE = 0.6
# One shift of the survey leaves at most this share of the distance, for so many of the positions.
_SHIFT_LEAVES = 0.5
_SHIFT_POSITIONS = 0.75
# With less of the information across a line of one heading, a shift along the track is not known.
_ONE_HEADING = 0.04
# Each round finds the nearest segments of the track anew, or looks along another part of the journey.
_ROUNDS = 8
_LAG_ROUNDS = 4
# Numerics: a lag that moves by no more shows the same part again.
_STAYS_S = 1e-3


@frozen
class PlaceFit:
    """How a record of places fits the GNSS: `lag_s` is its stamp of a moment minus the GNSS's.

    `shift_m`: the record's place minus the GNSS's, east and north. `agreeing`: share of moving epochs that agree then,
    and `as_recorded` as they are. Steady is what both halves of the run show. `reason`: why nothing is known.
    """

    shift_m: tuple[float, float] = (0.0, 0.0)
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    agreeing: float = 0.0
    as_recorded: float = 0.0
    lag_is_steady: bool = True
    shift_is_steady: bool = True
    reason: str = ""


def in_words(shift_m: tuple[float, float]) -> str:
    """A shift (east, north) as `3 m east, 4 m south`."""
    east_m, north_m = shift_m
    east = "east" if east_m >= 0 else "west"
    north = "north" if north_m >= 0 else "south"
    return f"{abs(east_m):.0f} m {east}, {abs(north_m):.0f} m {north}"


def fit_places(gnss: Places, record: Places, config: PlausibilityConfig) -> PlaceFit:
    """Lag and shift of another record of the same journey; a shift of its clock has to explain more than none."""
    as_recorded = _refined(gnss, record, 0.0, config)
    best = as_recorded
    lag_s = clock_lag(gnss, record)[0] or as_recorded.lag_s
    for _ in range(_LAG_ROUNDS):
        shifted = _refined(gnss, record, lag_s, config)
        if not shifted.reason and explains(shifted.agreeing, as_recorded.agreeing):
            best = shifted
        moved_s = abs(shifted.lag_s - lag_s)
        lag_s = shifted.lag_s
        if moved_s <= _STAYS_S:
            break
    return replace(best, as_recorded=as_recorded.as_recorded)


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
    fit = regressed(design, apart, floor=0.2, least_known=1e-4)
    # What is reported besides is no disagreement, nor what positions scatter beyond it.
    bound = 1.5 * config.reported_shift_m + config.reported_lag_s * np.linalg.norm(velocity, axis=1)
    rest_s, east_m, north_m = fit.estimate.tolist()
    of_parts = (fit.estimate, *fit.halves)
    return PlaceFit(
        shift_m=(east_m, north_m),
        # The record is ahead by so much at its stamp: it stamps a place so much too early.
        lag_s=lag_s - rest_s,
        lag_sigma_s=3.0 * float(fit.sigma[0]) if fit.whole else fit.spread / float(np.linalg.norm(velocity)),
        agreeing=float(np.mean(np.linalg.norm(apart - design @ fit.estimate, axis=1) < bound)),
        as_recorded=float(np.mean(np.linalg.norm(apart, axis=1) < bound)),
        lag_is_steady=halves_agree(*(part[:1] - lag_s for part in of_parts)),
        shift_is_steady=halves_agree(*(part[1:] for part in of_parts)),
    )


def passing_lags(track: Places, places: Floats, stamps_s: Floats, within_m: float) -> Floats:
    """Stamps of places (n, 3) minus the time at which a moving record passes each, as often as it does [s]."""
    centre = track.values.mean(axis=0)
    rows = track.values - centre
    near_to = places - centre
    squares = (near_to**2).sum(axis=1)[:, None] + (rows**2).sum(axis=1) - 2.0 * near_to @ rows.T
    inner = squares[:, 1:-1]
    # Between two rows the train may be half their distance away from both.
    step_m = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    near = inner < (within_m + np.maximum(step_m[:-1], step_m[1:])) ** 2
    place, row = np.nonzero(near & (inner <= squares[:, :-2]) & (inner < squares[:, 2:]))
    at_s = track.t_s[row + 1]
    return np.asarray((stamps_s[place] - at_s)[track.moves(at_s)])


def common_lag(lags_s: Floats, count: int) -> tuple[float | None, float]:
    """What most of so many passages agree on, with its sigma [s]; None where they do not."""
    agreeing = np.abs(lags_s[:, None] - lags_s) <= _PASSING_S
    counts = agreeing.sum(axis=1)
    if counts.max(initial=0) < max(_PASSING_SHARE * count, 3):
        return None, np.inf
    common_s = lags_s[agreeing[counts.argmax()]]
    return float(np.median(common_s)), float(np.std(common_s) / np.sqrt(common_s.size))


@frozen
class SurveyLine(Polyline):
    """The segments of a survey, with the heights of their ends."""

    height_start_m: Floats
    height_end_m: Floats

    def far_m(self, points: Points) -> float:
        """Usual distance of some positions from the track."""
        return float(np.median(self.nearest_sample(points.surface[:: max(1, len(points) // 100)])[0]))


@frozen
class SurveyFit:
    """How positions lie to the track; `shift_m` is the survey's place minus the positions', east and north.

    `aside_m`: usual distance across the track as recorded; `constant`: one shift explains most of it, in both halves of
    the run, and puts the positions on the track: a drift of them is no shift, nor is a run off the network.
    `up_m`: the survey's height minus the positions', one by one.
    """

    shift_m: tuple[float, float]
    aside_m: float
    constant: bool
    up_m: Floats


@Once
def line_of(site: Site) -> SurveyLine:
    """The segments of a site's track."""
    track = surveyed_track(site)
    surface = track.surface
    within = np.any(surface[:-1] != surface[1:], axis=1)
    within[track.first[1:-1] - 1] = False
    rows = np.flatnonzero(within)
    return SurveyLine(surface[rows], surface[rows + 1], track.height_m[rows], track.height_m[rows + 1])


def fit_survey(gnss: Places, line: SurveyLine, near_m: float) -> SurveyFit:
    """The constant shift that brings moving positions onto the track, by repeated projection and robust regression.

    `near_m`: a position is on the track within so much.
    """
    moving = gnss.moves(gnss.t_s)
    rows = np.flatnonzero(sampled(moving if moving.sum() >= 20 else np.ones_like(moving), 400))
    points = gnss.points.take(rows)
    axes = np.stack([points.east, points.north], axis=1)

    def nearest_to(shift_m: Floats) -> Ints:
        """The nearest segment of each moved position."""
        return line.nearest_sample(points.surface + np.einsum("ijk,j->ik", axes, shift_m))[1]

    def across_track(nearest: Ints) -> tuple[Floats, Floats, Floats]:
        """Direction across the track at these segments, how far it is from each position, and its height."""
        along = np.einsum("ijk,ik->ij", axes, line.end[nearest] - line.start[nearest])
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        feet = project_on_segments(points, line, nearest)
        part = np.clip(feet.fraction, 0.0, 1.0)
        low_m = line.height_start_m[nearest]
        return across, -feet.offset_m, low_m + part * (line.height_end_m[nearest] - low_m)

    nearest = nearest_to(np.zeros(2))
    across, apart, height_m = across_track(nearest)
    aside_m = float(np.median(np.abs(apart)))
    for _ in range(_ROUNDS):
        shift = regressed(across[:, None, :], apart[:, None], floor=1.0, least_known=_ONE_HEADING).estimate
        before, nearest = nearest, nearest_to(shift)
        if np.array_equal(nearest, before):
            break
        across, apart, height_m = across_track(nearest)
    explained = across @ shift
    left = np.abs(apart - explained)
    is_steady = all(
        explained[half] @ apart[half] > 0.5 * (explained[half] ** 2).sum() for half in split_in_half(len(left))
    )
    # By metres, not by what is left elsewhere: a shift brings no run onto a network that it left.
    near = float(np.mean(left < near_m)) > _SHIFT_POSITIONS
    constant = float(np.median(left)) < _SHIFT_LEAVES * aside_m and near and is_steady
    return SurveyFit((float(shift[0]), float(shift[1])), aside_m, constant, height_m - gnss.height_m[rows])
