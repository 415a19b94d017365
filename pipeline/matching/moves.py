"""How a train may get from one place of the network to another, and how plausible that is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geodesy import Floats
from pipeline.matching.network import Network
from schemas.config import MatchingConfig

# Log-probabilities: mismatch between network and travelled distance counts at most the first (a GNSS that
# jumps along the track must not send the path on a detour); each relation passed in a direction that is not
# navigable costs the second.
_MISMATCH_LIMIT = 12.0
_BARRED = 20.0
_ODOMETER_SHARE = 0.01


class Way(NamedTuple):
    """How far a step is thought to have led [m]: signed along the path where `signed`, else its size."""

    distance_m: float
    signed: bool


class Move(NamedTuple):
    """A move with its log-probability: displacement [m] along the path, and the elements between."""

    score: float
    displacement_m: float
    between: tuple[int, ...]
    leaves: bool


def best_move(
    network: Network,
    one: int,
    one_m: float,
    other: int,
    other_m: float,
    way: Way,
    limit_m: float,
    config: MatchingConfig,
) -> Move | None:
    """The most plausible move between places (metres from the oriented elements' entries), if any."""
    moves = []
    if one == other:
        displacement = other_m - one_m
        moves.append(Move(_score(displacement, way, 0, config), displacement, (), False))
    ahead = network.reach(one, limit_m).get(other)
    if ahead is not None:
        displacement = network.length_m(one) - one_m + ahead.distance_m + other_m
        score = _score(displacement, way, ahead.barred_forward, config)
        moves.append(Move(score, displacement, ahead.between, True))
    behind = network.reach(other, limit_m).get(one)
    if behind is not None:
        displacement = -(one_m + behind.distance_m + network.length_m(other) - other_m)
        score = _score(displacement, way, behind.barred_backward, config)
        moves.append(Move(score, displacement, behind.between[::-1], True))
    return max(moves, key=lambda move: move.score) if moves else None


def mismatch_scores(mismatch_m: Floats, way_m: Floats, config: MatchingConfig) -> Floats:
    """As `_score`, for many moves over which nothing is barred."""
    scale = config.transition_scale_m + _ODOMETER_SHARE * way_m
    return np.maximum(-mismatch_m / scale, -_MISMATCH_LIMIT)


def _score(displacement_m: float, way: Way, barred: int, config: MatchingConfig) -> float:
    """Exponential in the difference of distances (Newson & Krumm 2009, eq. 2), limited."""
    size = abs(displacement_m)
    mismatch = abs(displacement_m - way.distance_m) if way.signed else abs(size - way.distance_m)
    scale = config.transition_scale_m + _ODOMETER_SHARE * abs(way.distance_m)
    return -min(mismatch / scale, _MISMATCH_LIMIT) - _BARRED * barred
