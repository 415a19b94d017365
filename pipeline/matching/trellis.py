"""Candidates of all steps as states, and the transitions between them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from pipeline.matching.candidates import Candidates
from pipeline.matching.likelihood import Likelihood, initial_score, step_score
from pipeline.matching.moves import Ways, distance_scores, move_scores
from pipeline.matching.steps import Steps
from pipeline.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Log-probability of a move that the network does not know: only where nothing else is possible.
BREAK = -200.0


@dataclass(frozen=True)
class Trellis:
    """States in order of step; `first[k] : first[k + 1]` are those of step k; `stays[k]`: from step k - 1 to
    k no state can change for another, so `stay` holds the log-probability of each to go on. For the other
    steps `pair_move` holds those of the moves of all pairs, from `pair_first[k]` on. `initial` and `stay` have a column
    per hypothesis.
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
    initial: Floats
    stay: Floats
    stays: Bools
    pair_first: Ints
    pair_move: Floats

    def __len__(self) -> int:
        return len(self.first) - 1

    def pairs(self, steps: Ints) -> list[tuple[Floats, Floats]]:
        """Per given step, for its states and those of the step before: how probable each move is.

        Two arrays `[before, after, hypothesis]`, the largest of a step being one: moves that stay on an element, and
        those that change to another; zero elsewhere.
        """
        begin, step, number, one, other = _pairs(self.first, steps)
        changes = self.oriented[one] != self.oriented[other]
        score = step_score(self.offset_m[one], self.offset_m[other], self.candidate[other], changes, self.like)
        move = self.pair_move[self.pair_first[step] + number]
        score = np.maximum(move[:, None] + score, BREAK + self.initial[other])
        most = np.maximum.reduceat(score.max(axis=1), begin[:-1])
        weight = np.exp(score - np.repeat(most, np.diff(begin))[:, None])
        parts = [slice(*ends) for ends in itertools.pairwise(begin.tolist())]
        count = np.diff(self.first)
        shapes = [(*shape, weight.shape[1]) for shape in zip(count[steps - 1], count[steps], strict=True)]
        moves = weight * ~changes[:, None], weight * changes[:, None]
        return [
            (moves[0][part].reshape(shape), moves[1][part].reshape(shape))
            for part, shape in zip(parts, shapes, strict=True)
        ]


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
    initial = initial_score(offset, candidate, like)
    polarity = _polarity(steps, first, oriented, place, offset) if network.orientable else 0
    nothing, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    draft = Trellis(
        network, steps, _ways(steps, polarity, config), like, config, first, oriented, candidate, place, offset,
        initial, nothing, none.astype(bool), none, nothing,
    )  # fmt: skip
    stays = _stays(draft)
    pair_first, pair_move = _pair_moves(draft, np.flatnonzero(~stays)[1:])
    stay = _stay_scores(draft, stays)
    return replace(draft, stay=stay, stays=stays, pair_first=pair_first, pair_move=pair_move)


def _ways(steps: Steps, polarity: int, config: MatchingConfig) -> Ways:
    """What each step's length is measured against: the odometer, signed once its sign is known, else GNSS."""
    known = np.isfinite(steps.odometer_m)
    chord = np.nan_to_num(steps.chord_m)
    distance = np.where(known, (polarity or 1) * steps.odometer_m, chord)
    limit = (1.0 + config.detour_share) * np.maximum(chord, np.abs(distance)) + config.detour_m
    return Ways(distance, known & (polarity != 0), limit)


def _pairs(first: Ints, steps: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """All pairs of states of the given steps and of the steps before them, row by row.

    Where those of each step begin; per pair its step, its number there, and the numbers of both states.
    """
    count = np.diff(first)
    sizes = count[steps - 1] * count[steps]
    begin = np.concatenate([[0], np.cumsum(sizes)])
    step, width = np.repeat(steps, sizes), np.repeat(count[steps], sizes)
    number = np.arange(begin[-1]) - np.repeat(begin[:-1], sizes)
    return begin, step, number, first[step - 1] + number // width, first[step] + number % width


def _pair_moves(trellis: Trellis, steps: Ints) -> tuple[Ints, Floats]:
    """Moves of all the given steps: where those of each step begin, and all of them, row by row."""
    begin, step, _, one, other = _pairs(trellis.first, steps)
    moves = move_scores(
        trellis.network,
        trellis.oriented[one],
        trellis.place_m[one],
        trellis.oriented[other],
        trellis.place_m[other],
        trellis.ways.take(step),
        trellis.config,
    )
    first = np.zeros(len(trellis), dtype=np.int64)
    first[steps] = begin[:-1]
    return first, moves.max(axis=0)


def _unchanged(trellis: Trellis) -> Bools:
    """Steps that have the same states as the one before."""
    count = np.diff(trellis.first)
    same_count = np.concatenate([[False], count[1:] == count[:-1]])
    own = np.repeat(count, count)
    state = np.arange(len(trellis.oriented))
    equal = trellis.oriented == trellis.oriented[np.maximum(state - own, 0)]
    return same_count & np.logical_and.reduceat(equal, trellis.first[:-1])


def _stays(trellis: Trellis) -> Bools:
    """Steps over which no state can change: the same states as before, none linked to another, no long way."""
    stays = _unchanged(trellis)
    way = np.fmax(np.abs(trellis.steps.odometer_m), trellis.steps.chord_m)
    stays &= np.nan_to_num(way, nan=np.inf) <= trellis.config.long_step_m
    apart: dict[tuple[int, ...], bool] = {}
    oriented, first = trellis.oriented.tolist(), trellis.first.tolist()
    for step in np.flatnonzero(stays).tolist():
        group = tuple(oriented[first[step] : first[step + 1]])
        known = apart.get(group)
        if known is None:
            known = not any(trellis.network.linked(one, other) for one in group for other in group)
            apart[group] = known
        stays[step] = known
    return stays


def _stay_scores(trellis: Trellis, stays: Bools) -> Floats:
    """Log-probability of each state to go on from its own state of the step before, where steps stay."""
    count = np.diff(trellis.first)
    step = np.repeat(np.arange(len(count)), count)
    rows = np.flatnonzero(stays[step])
    before = rows - count[step[rows]]
    displacement = trellis.place_m[rows] - trellis.place_m[before]
    stay = np.full((len(trellis.oriented), len(trellis.like.hypotheses)), -np.inf)
    moved = distance_scores(displacement, trellis.ways.take(step[rows]), trellis.config)
    unchanged = np.zeros(len(rows), dtype=bool)
    offset, candidate = trellis.offset_m, trellis.candidate[rows]
    stay[rows] = moved[:, None] + step_score(offset[before], offset[rows], candidate, unchanged, trellis.like)
    return stay


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
