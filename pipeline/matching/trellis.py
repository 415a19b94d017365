"""Candidates of all steps as states, and the transitions between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geodesy import Bools, Floats, Ints
from pipeline.matching.candidates import Candidates
from pipeline.matching.likelihood import Likelihood, expected_m, log_density
from pipeline.matching.moves import Way, best_move, mismatch_scores
from pipeline.matching.network import Network
from pipeline.matching.steps import Steps
from schemas.config import MatchingConfig

# Log-probability of a move that the network does not know: only where nothing else is possible.
BREAK = -200.0
# Steps longer than this are judged move by move, since more than one element may lie within them.
_LONG_STEP_M = 30.0


@dataclass(frozen=True)
class Trellis:
    """States in order of step; `first[k] : first[k + 1]` are those of step k; `stays[k]`: from step k - 1 to
    k no state can change for another, so `stay` holds the log-probability of each to go on.
    """

    network: Network
    steps: Steps
    like: Likelihood
    config: MatchingConfig
    polarity: int
    first: Ints
    oriented: Ints
    candidate: Ints
    place_m: Floats
    offset_m: Floats
    initial: Floats
    stay: Floats
    stays: Bools

    def __len__(self) -> int:
        return len(self.first) - 1

    def states(self, step: int) -> range:
        return range(int(self.first[step]), int(self.first[step + 1]))

    def way(self, step: int) -> tuple[Way, float]:
        """What the step's length is measured against, and how far to search the network."""
        chord, by_odometer = float(self.steps.chord_m[step]), float(self.steps.odometer_m[step])
        if not np.isfinite(by_odometer):
            return Way(chord, False), 1.5 * chord + 100.0
        limit = 1.5 * max(chord, abs(by_odometer)) + 100.0
        if self.polarity:
            return Way(self.polarity * by_odometer, True), limit
        return Way(abs(by_odometer), False), limit

    def transitions(self, step: int) -> Floats:
        """Log-probabilities from the states of step - 1 (rows) to those of `step` (columns)."""
        before, after = self.states(step - 1), self.states(step)
        moves = np.array([[self._move_score(one, other, step) for other in after] for one in before])
        rows, columns = np.array(before)[:, None], np.array(after)[None, :]
        candidate = self.candidate[columns]
        mean = expected_m(self.offset_m[rows], candidate, self.like)
        offset = log_density(self.offset_m[columns], mean, self.like.fresh_m2[candidate], self.like)
        continued = moves + offset + self.like.fixed[candidate]
        broken = BREAK + self.initial[columns]
        return np.asarray(np.maximum(continued, broken))

    def _move_score(self, one: int, other: int, step: int) -> float:
        way, limit = self.way(step)
        move = best_move(
            self.network,
            int(self.oriented[one]),
            float(self.place_m[one]),
            int(self.oriented[other]),
            float(self.place_m[other]),
            way,
            limit,
            self.config,
        )
        return -np.inf if move is None else move.score


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
    initial = log_density(offset, np.zeros(len(offset)), like.variance_m2[candidate], like)
    initial += (like.fixed + like.heading)[candidate]
    polarity = _polarity(steps, first, oriented, place, offset) if network.orientable else 0
    draft = Trellis(
        network, steps, like, config, polarity, first, oriented, candidate, place, offset, initial,
        np.zeros(0), np.zeros(0, dtype=bool),
    )  # fmt: skip
    stays = _stays(draft)
    return Trellis(**{**draft.__dict__, "stay": _stay_scores(draft, stays), "stays": stays})


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
    stays &= np.nan_to_num(way, nan=np.inf) <= _LONG_STEP_M
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
    score = _stay_moves(trellis, step[rows], displacement)
    candidate = trellis.candidate[rows]
    mean = expected_m(trellis.offset_m[before], candidate, trellis.like)
    score += log_density(trellis.offset_m[rows], mean, trellis.like.fresh_m2[candidate], trellis.like)
    stay = np.full(len(trellis.oriented), -np.inf)
    stay[rows] = score + trellis.like.fixed[candidate]
    return stay


def _stay_moves(trellis: Trellis, step: Ints, displacement: Floats) -> Floats:
    """As `moves.best_move` within one element, for many at once."""
    by_odometer, chord = trellis.steps.odometer_m[step], trellis.steps.chord_m[step]
    signed = trellis.polarity * by_odometer
    size = np.where(np.isfinite(by_odometer), np.abs(by_odometer), chord)
    plain = np.abs(np.abs(displacement) - size)
    mismatch = np.where(np.isfinite(by_odometer) & (trellis.polarity != 0), np.abs(displacement - signed), plain)
    return mismatch_scores(mismatch, size, trellis.config)


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
