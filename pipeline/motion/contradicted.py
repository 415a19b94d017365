"""Stretches in which the odometer stands and the positions move on: is it frozen, or are they wrong?

An odometer that goes on reporting but no longer counts (a cable, a wheel that slides locked) looks like a standing
train. So does nothing else: a train that stands while its position drifts has a healthy odometer. What else was
recorded decides between the two, in this order; where nothing does, nobody knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.columns import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns, truths
from pipeline.hazards.arrays import runs_of
from pipeline.motion.position_rate import HOLE_S, PositionRate
from pipeline.statistics import SURE_SIGMAS
from schemas.config import Configuration
from schemas.enums import Evidence

# Movements of the positions that are no farther apart are one.
_APART_S = 10.0
# A train does not come from this speed to a stand within a second, nor leave like that: no brake does a fifth of it.
_ABRUPT_MPS, _ABRUPT_S, _NEAR_S = 10.0, 2.0, 15.0
# Drifts of positions that the papers look at end at 5 m/s (DIAG); a train is faster, and for longer.
_TRAIN_MPS, _TRAIN_M = 8.0, 200.0
# From one second to the next but one no train changes its speed by so much, a position that begins to drift does.
_PULLS_MPS = 6.0
# Share of a movement that a witness has to have seen.
_HALF = 0.5


@dataclass(frozen=True)
class Contradiction:
    """Epochs `first..last` from each of which to the next the odometer stood and positions moved.

    `way_m`: along growing path, beyond what the odometer counted. `moved`: whether the train did; None where nothing
    tells.
    """

    first: int
    last: int
    way_m: float
    moved: bool | None


@dataclass(frozen=True)
class Witness:
    """What can tell, per epoch; NaN where not known. `stood`: from here to the next by the odometer."""

    t_s: Floats
    positions: PositionRate
    path_m: Floats
    sigma_m: Floats
    odometer_m: Floats
    stretch: Ints
    stood: Bools
    reference_m: Floats
    reads_m: Floats
    velocity_mps: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, truth: pl.DataFrame, positions: PositionRate, moving: Bools) -> Witness:
        t_ns = times_ns(epochs)
        evidence, place = truth["evidence"], floats(truth, "truth_path_m")
        odometer = floats(epochs, "odometer_m")
        counted = np.isfinite(odometer) & np.isfinite(np.append(odometer[1:], np.nan))
        known = flags(epochs, "fix_valid") & flags(epochs, "on_track")
        return cls(
            t_s=(t_ns - t_ns[0]) / NS_PER_S,
            positions=positions,
            path_m=np.where(known, floats(epochs, "path_m"), np.nan),
            sigma_m=floats(epochs, "sigma_along_m"),
            odometer_m=odometer,
            stretch=ints(epochs["odometer_stretch"]),
            stood=counted & ~moving,
            reference_m=np.where(truths(evidence == Evidence.REFERENCE.value), place, np.nan),
            reads_m=np.where(truths(evidence == Evidence.BALISE.value), place, np.nan),
            velocity_mps=floats(epochs, "velocity_along_mps"),
        )


@dataclass(frozen=True)
class _Movement:
    """Positions that moved while the odometer stood over epochs `stand`: as a contradiction, and its cells of time.

    `seen`: share of it in which there were positions.
    """

    first: int
    last: int
    way_m: float
    seen: float
    cells: tuple[int, int]
    stand: tuple[int, int]


def contradictions(w: Witness, config: Configuration) -> tuple[Contradiction, ...]:
    """Movements of the positions that a standing odometer contradicts, without those that prove to be wrong."""
    found = []
    for movement in _movements(w, config):
        votes = (vote(w, movement) for vote in _VOTES)
        moved = next((vote for vote in votes if vote is not None), None)
        if moved is not False:
            found.append(Contradiction(movement.first, movement.last, movement.way_m, moved))
    return tuple(found)


def _movements(w: Witness, config: Configuration) -> list[_Movement]:
    """Movements of the positions, leaps apart, by more than a failure and than chance, while the odometer stood."""
    edges, rate = w.positions.edges_s, w.positions.rate_mps
    centres, lengths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    moves = np.abs(rate) > config.matching.deadband_mps
    found = []
    for a, b in zip(*runs_of(w.stood), strict=True):
        inside = (centres >= w.t_s[a]) & (centres <= w.t_s[b + 1])
        for i, j in _joined(inside & moves, round(_APART_S / lengths[0])):
            first = max(int(a), int(np.searchsorted(w.t_s, edges[i], side="right")) - 1)
            last = min(int(b), int(np.searchsorted(w.t_s, edges[j + 1])) - 1)
            counted_m = w.odometer_m[last + 1] - w.odometer_m[first]
            way_m = float(np.nansum(rate[i : j + 1] * lengths[i : j + 1]) - counted_m)
            if abs(way_m) > _limit_m(w.sigma_m[first : last + 2], config.hazards.failure_limit_m):
                seen = float(w.positions.seen[i : j + 1].mean())
                found.append(_Movement(first, last, way_m, seen, (i, j), (int(a), int(b))))
    return found


def _joined(mask: Bools, most: int) -> list[tuple[int, int]]:
    """First and last of the runs of true values, those joined that are no farther apart."""
    joined: list[tuple[int, int]] = []
    for first, last in zip(*runs_of(mask), strict=True):
        if joined and first - joined[-1][1] <= most + 1:
            joined[-1] = (joined[-1][0], int(last))
        else:
            joined.append((int(first), int(last)))
    return joined


def _limit_m(sigma_m: Floats, failure_limit_m: float) -> float:
    """Two positions of a standing train are no farther apart."""
    known = sigma_m[np.isfinite(sigma_m)]
    chance_m = SURE_SIGMAS * np.sqrt(2.0) * float(np.median(known)) if known.size else 0.0
    return max(failure_limit_m, chance_m)


def _by_reference(w: Witness, movement: _Movement) -> bool | None:
    """The reference went along, or it stood."""
    return _agrees(w, movement, w.reference_m)


def _by_reads(w: Witness, movement: _Movement) -> bool | None:
    """Balises were read in places that the odometer did not reach; beyond the last one they tell nothing."""
    return True if _agrees(w, movement, w.reads_m) else None


def _by_brakes(w: Witness, movement: _Movement) -> bool | None:
    """The odometer came to its stand, or left it, as no train can."""
    a, b = movement.stand
    stopped = w.t_s[movement.first] - w.t_s[a] <= _NEAR_S and _speed_mps(w, w.t_s[a] - 1.0 - _ABRUPT_S) > _ABRUPT_MPS
    left = w.t_s[b] - w.t_s[movement.last] <= _NEAR_S and _speed_mps(w, w.t_s[b + 1] + 1.0) > _ABRUPT_MPS
    return True if stopped or left else None


def _speed_mps(w: Witness, begin_s: float) -> float:
    """Mean speed of the odometer over two seconds [m/s], 0 where it is not known throughout."""
    end_s = begin_s + _ABRUPT_S
    if begin_s < w.t_s[0] or end_s > w.t_s[-1]:
        return 0.0
    first, last = int(np.searchsorted(w.t_s, begin_s, side="right")) - 1, int(np.searchsorted(w.t_s, end_s))
    rows, span_s = slice(first, last + 1), w.t_s[last] - w.t_s[first]
    if not np.isfinite(w.odometer_m[rows]).all() or np.ptp(w.stretch[rows]) > 0 or span_s > 2.0 * _ABRUPT_S:
        return 0.0
    return float(abs(w.odometer_m[last] - w.odometer_m[first]) / span_s)


def _by_doppler(w: Witness, movement: _Movement) -> bool | None:
    """The GNSS velocity went along, or it stood."""
    rows = slice(movement.first, movement.last + 2)
    velocity, dt_s = w.velocity_mps[rows], np.diff(w.t_s[rows])
    steps_m = 0.5 * (velocity[1:] + velocity[:-1]) * dt_s
    known = np.isfinite(steps_m) & (dt_s <= HOLE_S)
    share = float(dt_s[known].sum() / dt_s.sum())
    driven_m = float(steps_m[known].sum()) * np.sign(movement.way_m)
    return bool(driven_m > _HALF * abs(movement.way_m) * share) if share > _HALF else None


def _agrees(w: Witness, movement: _Movement, place_m: Floats) -> bool | None:
    """Whether places of another source moved like the positions; None where they hardly reach."""
    rows = np.arange(movement.first, movement.last + 2)
    rows = rows[np.isfinite(place_m[rows])]
    length_s = w.t_s[movement.last + 1] - w.t_s[movement.first]
    if rows.size < 2 or w.t_s[rows[-1]] - w.t_s[rows[0]] < _HALF * length_s:
        return None
    way_m = (place_m[rows[-1]] - place_m[rows[0]]) * np.sign(movement.way_m)
    return bool(way_m > _HALF * abs(movement.way_m))


def _by_return(w: Witness, movement: _Movement) -> bool | None:
    """The position leaped back to where the odometer has the train: it was wrong."""
    rows = np.flatnonzero(np.isfinite(w.path_m) & np.isfinite(w.odometer_m))
    rows = rows[(rows >= movement.last) & (w.stretch[rows] == w.stretch[movement.last])]
    if rows.size < 2:
        return None
    short = np.diff(w.t_s[rows]) <= max(1.0, 1.5 * float(np.median(np.diff(w.t_s))))
    back_m = -np.sign(movement.way_m) * np.diff(w.path_m[rows])
    past_m = back_m + np.sign(movement.way_m) * np.diff(w.odometer_m[rows])
    least_m, most_m = _HALF * abs(movement.way_m), (1.0 + _HALF) * abs(movement.way_m)
    returns = short & (back_m > least_m) & (past_m > least_m) & (past_m < most_m)
    return False if returns.any() else None


def _by_speed(w: Witness, movement: _Movement) -> bool | None:
    """The positions moved on like a train, seen all along: no drift is so fast for so long and begins so slowly."""
    speed_mps = abs(movement.way_m) / (w.t_s[movement.last + 1] - w.t_s[movement.first])
    steady = speed_mps > _TRAIN_MPS and abs(movement.way_m) > _TRAIN_M and movement.seen > _HALF
    begin, end = max(movement.cells[0] - 2, 0), movement.cells[1] + 3
    rate = w.positions.rate_mps[begin:end]
    jerks = np.abs(rate[2:] - rate[:-2]) > _PULLS_MPS
    return True if steady and not jerks.any() else None


_VOTES: tuple[Callable[[Witness, _Movement], bool | None], ...] = (
    _by_reference,
    _by_reads,
    _by_brakes,
    _by_doppler,
    _by_return,
    _by_speed,
)
