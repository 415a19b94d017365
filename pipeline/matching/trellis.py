"""Candidates of all steps as states, how a train may get from one to another, and how plausible that is."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pipeline.matching.candidates import Candidates
from pipeline.matching.likelihood import Likelihood, initial_score, step_score
from pipeline.matching.steps import Steps
from pipeline.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Log-probability of a move that the network does not know: only where nothing else is possible.
BREAK = -200.0


@dataclass(frozen=True)
class Trellis:
    """States in order of step; `first[k] : first[k + 1]` are those of step k.

    Probabilities are logarithms with a column per hypothesis.
    """

    network: Network
    steps: Steps
    ways: Ways
    like: Likelihood
    config: MatchingConfig
    first: Ints
    oriented: Ints
    candidate: Ints
    place_m: Floats
    offset_m: Floats

    def __len__(self) -> int:
        return len(self.first) - 1

    @cached_property
    def initial(self) -> Floats:
        """Of each state without a step before it."""
        return initial_score(self.offset_m, self.candidate, self.like)

    def pairs(self, steps: Ints) -> list[tuple[Floats, Floats]]:
        """Per given step, for its states and those of the step before: how probable each move is.

        Two arrays `[before, after, hypothesis]`, the largest of a step being one: moves that stay on an element, and
        those that change to another; zero elsewhere.
        """
        count = np.diff(self.first)
        sizes = count[steps - 1] * count[steps]
        begin = np.concatenate([[0], np.cumsum(sizes)])
        number, width = np.arange(begin[-1]) - np.repeat(begin[:-1], sizes), np.repeat(count[steps], sizes)
        one, other = np.repeat(self.first[steps - 1], sizes) + number // width, np.repeat(self.first[steps], sizes)
        other = other + number % width
        places = self.oriented[one], self.place_m[one], self.oriented[other], self.place_m[other]
        move = move_scores(self.network, *places, self.ways.take(np.repeat(steps, sizes)), self.config).max(axis=0)
        changes = self.oriented[one] != self.oriented[other]
        score = step_score(self.offset_m[one], self.offset_m[other], self.candidate[other], changes, self.like)
        score = np.maximum(move[:, None] + score, BREAK + self.initial[other])
        most = np.maximum.reduceat(score.max(axis=1), begin[:-1])
        weight = np.exp(score - np.repeat(most, sizes)[:, None])
        parts = [slice(*ends) for ends in itertools.pairwise(begin.tolist())]
        shapes = [(*shape, weight.shape[1]) for shape in zip(count[steps - 1], count[steps], strict=True)]
        moves = weight * ~changes[:, None], weight * changes[:, None]
        return [
            (moves[0][part].reshape(shape), moves[1][part].reshape(shape))
            for part, shape in zip(parts, shapes, strict=True)
        ]

    @cached_property
    def stays(self) -> Bools:
        """Steps over which no state can change: the same states as before, none linked to another, no long way."""
        way = np.fmax(np.abs(self.steps.odometer_m), self.steps.chord_m)
        stays = self._unchanged() & (np.nan_to_num(way, nan=np.inf) <= self.config.long_step_m)
        apart: dict[tuple[int, ...], bool] = {}
        oriented, first = self.oriented.tolist(), self.first.tolist()
        for step in np.flatnonzero(stays).tolist():
            group = tuple(oriented[first[step] : first[step + 1]])
            if group not in apart:
                apart[group] = not any(self.network.linked(one, other) for one in group for other in group)
            stays[step] = apart[group]
        return stays

    def _unchanged(self) -> Bools:
        """Steps that have the same states as the one before."""
        count = np.diff(self.first)
        state = np.arange(len(self.oriented))
        equal = self.oriented == self.oriented[np.maximum(state - np.repeat(count, count), 0)]
        return np.asarray((np.diff(count, prepend=0) == 0) & np.logical_and.reduceat(equal, self.first[:-1]))

    @cached_property
    def stay(self) -> Floats:
        """Of each state to go on from its own state of the step before, where steps stay; no other is known."""
        count = np.diff(self.first)
        step = np.repeat(np.arange(len(count)), count)
        rows = np.flatnonzero(self.stays[step])
        before = rows - count[step[rows]]
        moved = distance_scores(self.place_m[rows] - self.place_m[before], self.ways.take(step[rows]), self.config)
        unchanged = np.zeros(len(rows), dtype=bool)
        offsets_m = self.offset_m[before], self.offset_m[rows]
        stay = np.full(self.initial.shape, -np.inf)
        stay[rows] = moved[:, None] + step_score(*offsets_m, self.candidate[rows], unchanged, self.like)
        return stay


def trellis_of(
    network: Network, steps: Steps, candidates: Candidates, like: Likelihood, config: MatchingConfig
) -> Trellis:
    """States are candidates in each orientation in use; every step has at least one."""
    usable = np.array(network.usable)
    both = np.column_stack([2 * candidates.element, 2 * candidates.element + 1])
    index = np.flatnonzero(usable[both].ravel())
    oriented, candidate = both.ravel()[index], index // 2
    backward = (oriented % 2).astype(bool)
    along = candidates.along_m[candidate]
    length = network.track.length_m[candidates.element[candidate]]
    offset = np.where(backward, -1.0, 1.0) * candidates.offset_m[candidate]
    place = np.where(backward, length - along, along)
    first = np.searchsorted(candidates.step[candidate], np.arange(len(steps) + 1))
    polarity = _polarity(steps, first, oriented, place, offset) if network.orientable else 0
    ways = _ways(steps, polarity, config)
    return Trellis(network, steps, ways, like, config, first, oriented, candidate, place, offset)


def _ways(steps: Steps, polarity: int, config: MatchingConfig) -> Ways:
    """What each step's length is measured against: the odometer, signed once its sign is known, else GNSS."""
    known = np.isfinite(steps.odometer_m)
    chord = np.nan_to_num(steps.chord_m)
    distance = np.where(known, (polarity or 1) * steps.odometer_m, chord)
    limit = (1.0 + config.detour_share) * np.maximum(chord, np.abs(distance)) + config.detour_m
    return Ways(distance, known & (polarity != 0), limit)


def _polarity(steps: Steps, first: Ints, oriented: Ints, place_m: Floats, offset_m: Floats) -> int:
    """Sign of the odometer against the orientation in use: +1, -1, or 0 where it cannot be told.

    From the steps whose nearest candidate stays on one element; the sign is a property of the installation,
    one for the whole run.
    """
    count = np.diff(first)
    step = np.repeat(np.arange(len(count)), count)
    order = np.lexsort((np.abs(offset_m), step))
    nearest = order[first[:-1]]
    same = oriented[nearest[1:]] == oriented[nearest[:-1]]
    product = np.diff(place_m[nearest]) * steps.odometer_m[1:]
    return int(np.sign(np.nansum(np.sign(product[same]) * np.abs(steps.odometer_m[1:][same]))))


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
    """The elements between two places, and how the first is left.

    `sense`: +1 ahead, -1 behind, 0 not at all.
    """

    between: tuple[int, ...]
    sense: int


def move_scores(
    network: Network, one: Ints, one_m: Floats, other: Ints, other_m: Floats, ways: Ways, config: MatchingConfig
) -> Floats:
    """Log-probability of each move between pairs of places, -inf where there is none: `[sense, pair]`.

    Rows: on the element, ahead, behind. Places are oriented elements and metres from their entries.
    """
    ahead_m, ahead_barred, behind_m, behind_barred = _network_distances(network, one, other, ways.limit_m)
    length = network.track.length_m
    left_m, other_left_m = length[one // 2] - one_m, length[other // 2] - other_m
    stay = np.where(one == other, distance_scores(other_m - one_m, ways, config), -np.inf)
    ahead = distance_scores(left_m + ahead_m + other_m, ways, config) - config.barred_cost * ahead_barred
    behind = distance_scores(-(one_m + behind_m + other_left_m), ways, config) - config.barred_cost * behind_barred
    ahead[~np.isfinite(ahead_m)] = behind[~np.isfinite(behind_m)] = -np.inf
    return np.stack([stay, ahead, behind])


def distance_scores(displacement_m: Floats, ways: Ways, config: MatchingConfig) -> Floats:
    """Exponential in the difference of distances (Newson & Krumm 2009, eq. 2), limited."""
    plain = np.abs(np.abs(displacement_m) - np.abs(ways.distance_m))
    mismatch = np.where(ways.signed, np.abs(displacement_m - ways.distance_m), plain)
    scale = config.transition_scale_m + config.transition_share * np.abs(ways.distance_m)
    return np.asarray(-np.minimum(mismatch / scale, config.mismatch_limit))


def best_moves(
    network: Network, one: Ints, one_m: Floats, other: Ints, other_m: Floats, ways: Ways, config: MatchingConfig
) -> list[Move | None]:
    """The most plausible move of each pair of places, none where the network has none."""
    scores = move_scores(network, one, one_m, other, other_m, ways, config)
    chosen = np.where(np.isfinite(scores.max(axis=0)), scores.argmax(axis=0), -1)
    rows = zip(chosen.tolist(), one.tolist(), other.tolist(), ways.limit_m.tolist(), strict=True)
    return [_move(network, *row) for row in rows]


def _move(network: Network, chosen: int, one: int, other: int, limit_m: float) -> Move | None:
    """The move of a row of `move_scores`, -1 for none."""
    if chosen <= 0:
        return None if chosen else Move((), 0)
    if chosen == 1:
        return Move(network.reach(one, limit_m)[other].between, 1)
    return Move(network.reach(other, limit_m)[one].between[::-1], -1)


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
