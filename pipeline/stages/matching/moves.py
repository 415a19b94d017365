"""How plausible it is that a train went from one place on the network to another within a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig


@dataclass(frozen=True)
class StepDistances:
    """How far each step is thought to have led [m]: signed in the odometer's sense where `measured`, else its size.

    `limit_m` is how far to search the network for it; `polarity` the odometer's sign against each oriented element.
    """

    distance_m: Floats
    measured: Bools
    limit_m: Floats
    polarity: Ints

    def along(self, steps: Ints, oriented: Ints) -> MoveDistances:
        """Of some steps, along the oriented element that each of them begins on."""
        polarity = self.polarity[oriented]
        signed = self.measured[steps] & (polarity != 0)
        return MoveDistances(np.where(signed, polarity, 1) * self.distance_m[steps], signed, self.limit_m[steps])


class MoveDistances(NamedTuple):
    """As `StepDistances`, one row for each of some moves: signed along the path where `signed`."""

    distance_m: Floats
    signed: Bools
    limit_m: Floats


class Move(NamedTuple):
    """The elements between two places, and how the first is left.

    `sense`: +1 ahead, -1 behind, 0 not at all.
    """

    between: tuple[int, ...]
    sense: int


def move_scores(
    network: Network, start: Ints, start_m: Floats, end: Ints, end_m: Floats, way: MoveDistances, config: MatchingConfig
) -> Floats:
    """Log-probability of each move between pairs of places, -inf where there is none: `[sense, pair]`.

    Rows: on the element, ahead, behind. Places are oriented elements and metres from their entries.
    """
    ahead_m, ahead_barred, behind_m, behind_barred = _network_distances(network, start, end, way.limit_m)
    length = network.track.length_m
    start_left_m = length[start // 2] - start_m
    end_left_m = length[end // 2] - end_m
    stay = np.where(start == end, distance_scores(end_m - start_m, way, config), -np.inf)
    ahead = distance_scores(start_left_m + ahead_m + end_m, way, config) - config.barred_cost * ahead_barred
    behind = distance_scores(-(start_m + behind_m + end_left_m), way, config) - config.barred_cost * behind_barred
    ahead[~np.isfinite(ahead_m)] = behind[~np.isfinite(behind_m)] = -np.inf
    return np.stack([stay, ahead, behind])


def distance_scores(displacement_m: Floats, way: MoveDistances, config: MatchingConfig) -> Floats:
    """Exponential in the difference of distances (Newson & Krumm 2009, eq. 2), limited."""
    plain = np.abs(np.abs(displacement_m) - np.abs(way.distance_m))
    mismatch = np.where(way.signed, np.abs(displacement_m - way.distance_m), plain)
    scale = config.transition_scale_m + config.transition_share * np.abs(way.distance_m)
    return np.asarray(-np.minimum(mismatch / scale, config.mismatch_limit))


def best_moves(
    network: Network, start: Ints, start_m: Floats, end: Ints, end_m: Floats, way: MoveDistances, config: MatchingConfig
) -> list[Move | None]:
    """The most plausible move of each pair of places, none where the network has none."""
    scores = move_scores(network, start, start_m, end, end_m, way, config)
    chosen = np.where(np.isfinite(scores.max(axis=0)), scores.argmax(axis=0), -1)
    rows = zip(chosen.tolist(), start.tolist(), end.tolist(), way.limit_m.tolist(), strict=True)
    return [_move(network, *row) for row in rows]


def _move(network: Network, chosen: int, start: int, end: int, limit_m: float) -> Move | None:
    """The move of a row of `move_scores`, -1 for none."""
    if chosen <= 0:
        return None if chosen else Move((), 0)
    if chosen == 1:
        return Move(network.reach(start, limit_m)[end].between, 1)
    return Move(network.reach(end, limit_m)[start].between[::-1], -1)


def _network_distances(network: Network, start: Ints, end: Ints, limit_m: Floats) -> tuple[Floats, ...]:
    """From exit to entry, ahead and behind, with the relations not navigable that way; inf where none leads."""
    pairs, inverse = np.unique(start * len(network.successors) + end, return_inverse=True)
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
