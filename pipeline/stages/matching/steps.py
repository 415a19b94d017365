"""Which epochs can change what is known of the path: the steps of the search.

Position errors last for a minute or more, so epochs a few metres apart say the same about the track; and an
epoch that lies further from the last one than the train can have moved says nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.matching.fixes import Fixes
from pipeline.stages.odometry import Odometry
from pipeline.stages.track.geodesy import way_m
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig


@dataclass(frozen=True)
class Steps:
    """Epochs that are judged; distances [m] and times [s] since the step before (NaN at the first).

    `odometer_m` is signed in the odometer's own sense, NaN where it is not known.
    """

    epoch: Ints
    elapsed_s: Floats
    chord_m: Floats
    odometer_m: Floats
    speed_mps: Floats
    heading_rad: Floats

    def __len__(self) -> int:
        return len(self.epoch)


@dataclass(frozen=True)
class Travelled:
    """Odometer distance at each epoch [m], NaN where it is not known; comparable where nothing is in doubt between."""

    distance_m: Floats
    doubt_m: Floats

    def between(self, earlier: Ints, later: Ints) -> Floats:
        """Signed distance from some epochs to others, NaN where the odometer does not know it."""
        same = self.doubt_m[earlier] == self.doubt_m[later]
        return np.where(same, self.distance_m[later] - self.distance_m[earlier], np.nan)


def travelled(fixes: Fixes, odometry: Odometry | None) -> Travelled:
    """The odometer at the epochs' times."""
    if odometry is None:
        return Travelled(np.full(len(fixes), np.nan), np.zeros(len(fixes)))
    return Travelled(odometry.distance_at(fixes.t_ns), odometry.doubt_at_s(odometry.seconds(fixes.t_ns)))


def spaced(fixes: Fixes, rows: Ints, config: MatchingConfig) -> Ints:
    """Of the given epochs one every `step_distance_m` of movement and `step_time_s` of time, and the last."""
    far = np.floor(way_m(fixes.points.surface[rows]) / config.step_distance_m)
    late = np.floor((fixes.t_s[rows] - fixes.t_s[rows[0]]) / config.step_time_s)
    fresh = (np.diff(far, prepend=-1.0) > 0) | (np.diff(late, prepend=-1.0) > 0)
    fresh[-1] = True
    return np.asarray(rows[fresh])


def believable(fixes: Fixes, usable: Bools, way: Travelled, config: MatchingConfig) -> Ints:
    """Usable epochs that the train can have reached from the last believed one; after `jump_hold_s` any.

    Causal: an epoch is judged by those before it.
    """
    rows = np.flatnonzero(usable)
    believed = np.ones(len(rows), dtype=bool)
    t_s = fixes.t_s[rows]
    since = _span_before(t_s, config.jump_speed_least_s)

    def reachable(before: Ints, after: Ints) -> Bools:
        """Whether the train can have come from one usable epoch to another, or the first one holds no longer."""
        velocity = _velocity_mps(fixes, rows, since[before], before, config.jump_speed_most_s)
        return _reachable(fixes, rows[before], rows[after], velocity, way, config) | (
            t_s[after] - t_s[before] > config.jump_hold_s
        )

    number = np.arange(len(rows))
    doubtful = np.flatnonzero(~reachable(number[:-1], number[1:]))
    while len(doubtful):
        # Follow the first doubtful epoch until one is believed again; from there the pairs above hold.
        last = int(doubtful[0])
        held = int(np.searchsorted(t_s, t_s[last] + config.jump_hold_s, side="right"))
        later = number[last + 1 : held + 1]
        reached = np.flatnonzero(reachable(np.full(len(later), last), later))
        again = int(later[reached[0]]) if len(reached) else len(rows)
        believed[last + 1 : again] = False
        # Velocities of later epochs must not start at an epoch that is not believed.
        near = number[again : int(np.searchsorted(since, again))]
        since[near] = np.minimum(since[near], last)
        pairs = near[near < len(rows) - 1]
        doubt = pairs[~reachable(pairs, pairs + 1)]
        doubtful = np.concatenate([doubt, doubtful[doubtful >= again + len(near)]])
    return rows[believed]


def _span_before(t_s: Floats, span_s: float) -> Ints:
    """Per time the number of the last one at least so long before, -1 without one."""
    return np.searchsorted(t_s, t_s - span_s, side="right") - 1


def _velocity_mps(fixes: Fixes, rows: Ints, since: Ints, until: Ints, most_s: float) -> Floats:
    """Mean velocity between numbers of `rows`, one vector each, NaN where they are too far apart to say."""
    begin = rows[np.maximum(since, 0)]
    end = rows[until]
    elapsed = np.where(since >= 0, fixes.t_s[end] - fixes.t_s[begin], np.nan)
    elapsed[elapsed > most_s] = np.nan
    return np.asarray((fixes.points.surface[end] - fixes.points.surface[begin]) / elapsed[:, None])


def _reachable(
    fixes: Fixes, earlier: Ints, later: Ints, velocity_mps: Floats, way: Travelled, config: MatchingConfig
) -> Bools:
    """Whether the train can have been at the positions of both epochs, by odometer or else by its velocity.

    By the velocity a position is as suspect behind the place where the train was heading as ahead of it.
    """
    moved = fixes.points.surface[later] - fixes.points.surface[earlier]
    elapsed = fixes.t_s[later] - fixes.t_s[earlier]
    apart = np.linalg.norm(moved, axis=1)
    aside = np.linalg.norm(moved - velocity_mps * elapsed[:, None], axis=1)
    by_odometer = np.abs(way.between(earlier, later))
    variance = 0.5 * (fixes.cov_ee_m2 + fixes.cov_nn_m2)
    margin = config.jump_margin_m + config.jump_sigmas * (np.sqrt(variance[earlier]) + np.sqrt(variance[later]))
    turned = aside > config.jump_acceleration_mps2 * elapsed**2 + margin
    heading_there = (apart <= elapsed * config.jump_speed_mps + margin) & ~turned
    counted = apart <= by_odometer * (1 + config.jump_odometer_share) + margin
    return np.asarray(np.where(np.isfinite(by_odometer), counted, heading_there))


def steps_of(fixes: Fixes, rows: Ints, way: Travelled) -> Steps:
    """Given epochs as steps, each with what happened since the one before."""
    unknown = np.full(1, np.nan)
    elapsed = np.concatenate([unknown, np.diff(fixes.t_s[rows])])
    moved = np.diff(fixes.points.surface[rows], axis=0, prepend=np.nan)
    chord = np.linalg.norm(moved, axis=1)
    east = np.einsum("ij,ij->i", moved, fixes.points.east[rows])
    north = np.einsum("ij,ij->i", moved, fixes.points.north[rows])
    # The receiver's own velocity where there is one; else the way between steps.
    vel_e = fixes.vel_e_mps[rows]
    vel_n = fixes.vel_n_mps[rows]
    doppler = np.isfinite(vel_e) & np.isfinite(vel_n)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.where(doppler, np.hypot(vel_e, vel_n), chord / elapsed)
    heading = np.where(doppler, np.arctan2(vel_e, vel_n), np.arctan2(east, north))
    by_odometer = np.concatenate([unknown, way.between(rows[:-1], rows[1:])])
    return Steps(rows, elapsed, chord, by_odometer, speed, heading)
