"""Stretches in which the odometer stands and the positions move on: is it frozen, or are they wrong?

An odometer that goes on reporting but no longer counts (a cable, a wheel that slides locked) looks like a standing
train. So does nothing else: a train that stands while its position drifts has a healthy odometer. What else was
recorded decides between the two, in this order; where nothing does, nobody knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.figures.bounds import SURE_SIGMAS
from pipeline.hazards.arrays import runs_of
from pipeline.motion.position_rate import PositionRate
from pipeline.motion.votes import moved_by_votes
from pipeline.motion.witness import Movement, Witness
from schemas.arrays import Bools, Floats
from schemas.config import Configuration

# Movements of the positions that are no farther apart are one.
_APART_S = 10.0


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


def contradictions(w: Witness, config: Configuration) -> tuple[Contradiction, ...]:
    """Movements of the positions that a standing odometer contradicts, without those that prove to be wrong."""
    found = []
    for movement in _movements(w, config):
        moved = moved_by_votes(w, movement)
        if moved is not False:
            found.append(Contradiction(movement.first, movement.last, movement.way_m, moved))
    return tuple(found)


def _movements(w: Witness, config: Configuration) -> list[Movement]:
    """Movements of the positions, leaps apart, by more than a failure and than chance, while the odometer stood."""
    edges, rate = w.positions.edges_s, w.positions.rate_mps
    centres, lengths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    moves = np.abs(rate) > config.matching.deadband_mps
    found = []
    for a, b in zip(*runs_of(w.stood), strict=True):
        inside = (centres >= w.t_s[a]) & (centres <= w.t_s[b + 1])
        for i, j in _joined(inside & moves, round(_APART_S / lengths[0])):
            first, last = _epochs(w, (int(a), int(b)), (i, j))
            limit_m = _limit_m(w.sigma_m[first : last + 2], config.hazards.failure_limit_m)
            for cells, way_m in _legs(w.positions, (i, j), limit_m):
                first, last = _epochs(w, (int(a), int(b)), cells)
                beyond_m = way_m - float(w.odometer_m[last + 1] - w.odometer_m[first])
                if abs(beyond_m) > limit_m:
                    seen = float(w.positions.seen[cells[0] : cells[1] + 1].mean())
                    found.append(Movement(first, last, beyond_m, seen, cells, (int(a), int(b))))
    return found


def _epochs(w: Witness, stand: tuple[int, int], cells: tuple[int, int]) -> tuple[int, int]:
    """First and last epoch of a stand from each of which to the next the cells reach."""
    first = int(np.searchsorted(w.t_s, w.positions.edges_s[cells[0]], side="right")) - 1
    last = int(np.searchsorted(w.t_s, w.positions.edges_s[cells[1] + 1])) - 1
    return max(stand[0], first), min(stand[1], last)


def _legs(positions: PositionRate, cells: tuple[int, int], limit_m: float) -> list[tuple[tuple[int, int], float]]:
    """Parts of a movement between its turns, and the way of each [m].

    To and fro it comes to nothing in the sum. What turns by less than twice the limit is wander, of which only the sum
    tells.
    """
    edges = slice(cells[0], cells[1] + 2)
    steps = np.diff(positions.place_m[edges])
    smooth = positions.rate_mps[cells[0] : cells[1] + 1] * np.diff(positions.edges_s[edges])
    # Where there is no leap the places count: noise adds up in a sum of speeds, in theirs it ends.
    way = np.concatenate([[0.0], np.cumsum(np.nan_to_num(np.where(np.abs(steps - smooth) > limit_m, smooth, steps)))])
    turns = _turns(way, 2.0 * limit_m) or [0, way.size - 1]
    return [((cells[0] + i, cells[0] + j - 1), float(way[j] - way[i])) for i, j in pairwise(turns)]


def _turns(way_m: Floats, least_m: float) -> list[int]:
    """Where a way begins, turns and ends that goes on by more than `least_m` between them; none where it does not."""
    turns: list[int] = []
    low = high = 0
    sign = 0.0
    values = way_m.tolist()
    for at, value in enumerate(values):
        low, high = (at if value < values[low] else low), (at if value > values[high] else high)
        fell, rose = values[high] - value > least_m, value - values[low] > least_m
        if fell and sign >= 0.0:
            turns.append(high)
            sign, low = -1.0, at
        elif rose and sign <= 0.0:
            turns.append(low)
            sign, high = 1.0, at
    return [*turns, high if sign > 0.0 else low] if turns else []


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
