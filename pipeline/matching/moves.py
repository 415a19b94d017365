"""How a train may get from one place of the network to another, and how plausible that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Log-probabilities: mismatch between network and travelled distance counts at most the first (a GNSS that
# jumps along the track must not send the path on a detour); each relation passed in a direction that is not
# navigable costs the second.
_MISMATCH_LIMIT = 12.0
_BARRED = 20.0
_ODOMETER_SHARE = 0.01


@dataclass(frozen=True)
class Ways:
    """How far each step is thought to have led [m]: signed along the path where `signed`, else its size.

    `limit_m` is how far to search the network for it.
    """

    distance_m: Floats
    signed: Bools
    limit_m: Floats

    def take(self, rows: Ints) -> Ways:
        """Some of the steps, or one of them several times."""
        return Ways(self.distance_m[rows], self.signed[rows], self.limit_m[rows])


class Move(NamedTuple):
    """Displacement [m] along the path, the elements between, and how the element is left.

    `sense`: +1 ahead, -1 behind, 0 not at all; between places at one joint the displacement is 0 either way.
    """

    displacement_m: float
    between: tuple[int, ...]
    sense: int


def move_scores(
    network: Network, one: Ints, one_m: Floats, other: Ints, other_m: Floats, ways: Ways, config: MatchingConfig
) -> Floats:
    """Log-probability of the most plausible move of each pair of places, -inf where there is none.

    Places are oriented elements and metres from their entries.
    """
    ahead_m, ahead_barred, behind_m, behind_barred = _network_distances(network, one, other, ways.limit_m)
    length = network.track.length_m
    left_m, other_left_m = length[one // 2] - one_m, length[other // 2] - other_m
    stay = np.where(one == other, distance_scores(other_m - one_m, ways, config), -np.inf)
    ahead = distance_scores(left_m + ahead_m + other_m, ways, config) - _BARRED * ahead_barred
    behind = distance_scores(-(one_m + behind_m + other_left_m), ways, config) - _BARRED * behind_barred
    ahead[~np.isfinite(ahead_m)] = behind[~np.isfinite(behind_m)] = -np.inf
    return np.maximum(stay, np.maximum(ahead, behind))


def distance_scores(displacement_m: Floats, ways: Ways, config: MatchingConfig) -> Floats:
    """Exponential in the difference of distances (Newson & Krumm 2009, eq. 2), limited."""
    plain = np.abs(np.abs(displacement_m) - np.abs(ways.distance_m))
    mismatch = np.where(ways.signed, np.abs(displacement_m - ways.distance_m), plain)
    scale = config.transition_scale_m + _ODOMETER_SHARE * np.abs(ways.distance_m)
    return np.asarray(-np.minimum(mismatch / scale, _MISMATCH_LIMIT))


def best_move(
    network: Network, one: int, one_m: float, other: int, other_m: float, way: Ways, config: MatchingConfig
) -> Move | None:
    """The most plausible move between two places and what lies between, none where the network has none."""
    limit_m = float(way.limit_m[0])
    moves = [(0, Move(other_m - one_m, (), 0))] if one == other else []
    ahead = network.reach(one, limit_m).get(other)
    if ahead is not None:
        displacement = network.length_m(one) - one_m + ahead.distance_m + other_m
        moves.append((ahead.barred_forward, Move(displacement, ahead.between, 1)))
    behind = network.reach(other, limit_m).get(one)
    if behind is not None:
        displacement = -(one_m + behind.distance_m + network.length_m(other) - other_m)
        moves.append((behind.barred_backward, Move(displacement, behind.between[::-1], -1)))
    if not moves:
        return None
    distances = np.array([move.displacement_m for _, move in moves])
    scores = distance_scores(distances, way, config) - _BARRED * np.array([barred for barred, _ in moves])
    return moves[int(np.argmax(scores))][1]


def _network_distances(network: Network, one: Ints, other: Ints, limit_m: Floats) -> tuple[Floats, ...]:
    """From exit to entry, ahead and behind, with the relations not navigable that way; inf where none leads."""
    pairs, inverse = np.unique(one * len(network.successors) + other, return_inverse=True)
    limit = np.zeros(len(pairs))
    np.maximum.at(limit, inverse, limit_m)
    table = np.full((4, len(pairs)), np.inf)
    for index, (pair, far) in enumerate(zip(pairs.tolist(), limit.tolist(), strict=True)):
        here, there = divmod(pair, len(network.successors))
        ahead = network.reach(here, far).get(there)
        if ahead is not None:
            table[:2, index] = ahead.distance_m, ahead.barred_forward
        behind = network.reach(there, far).get(here)
        if behind is not None:
            table[2:, index] = behind.distance_m, behind.barred_backward
    return tuple(table[:, inverse])
