"""Candidates of all steps as states, and how a train may get from one to another."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.stages.matching.innovations import Innovations, innovations_of, movements_m
from pipeline.stages.matching.likelihood import Likelihood, Terms, initial_terms, step_terms
from pipeline.stages.matching.moves import StepDistances, distance_scores, move_scores
from pipeline.stages.matching.steps import Steps
from pipeline.stages.paths.candidates import Candidates
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Log-probability of a move that the network does not know: only where nothing else is possible.
BREAK = -200.0
# Pairs of states that are weighed at once: enough to be quick, few enough to hold.
_AT_ONCE = 50_000


@dataclass(frozen=True)
class Pairs:
    """All states of some steps with all of the step before; `first[k] : first[k + 1]` are those of the k-th step.

    In order of the state before, then the one after. `score`: log-probability of the most plausible move; `enters`:
    by the start (1) or the end (2) of the oriented element, or it stays there (0).
    """

    steps: Ints
    first: Ints
    before: Ints
    after: Ints
    score: Floats
    enters: Ints


@dataclass(frozen=True)
class Trellis:
    """States in order of step; `first[k] : first[k + 1]` are those of step k.

    `stays`: steps over which no state can change. `pairs`: of all other steps but the first.
    """

    network: Network
    steps: Steps
    ways: StepDistances
    like: Likelihood
    config: MatchingConfig
    states: States
    stays: Bools
    pairs: Pairs
    innovations: Innovations
    tolerance_m: Floats

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def first(self) -> Ints:
        return self.states.first

    @property
    def oriented(self) -> Ints:
        return self.states.oriented

    @property
    def place_m(self) -> Floats:
        return self.states.place_m

    @cached_property
    def initial(self) -> Terms:
        """Of each state without a step before it."""
        return initial_terms(self.states.offset_m, self.states.candidate, self.like)

    def moves(self, numbers: slice) -> list[tuple[Terms, Ints]]:
        """Of some steps of `pairs`: the terms `[coefficient, before, after, scale]`, and by which end moves enter."""
        part = slice(int(self.pairs.first[numbers.start]), int(self.pairs.first[numbers.stop]))
        before = self.pairs.before[part]
        after = self.pairs.after[part]
        score = self.pairs.score[part]
        known = np.isfinite(score)
        terms = np.where(known[:, None], self._terms(before, after), self.initial[:, after])
        terms[0] += np.where(known, score, BREAK)[:, None]
        steps = self.pairs.steps[numbers]
        cuts = self.pairs.first[numbers.start + 1 : numbers.stop] - part.start
        count = np.diff(self.first)
        shapes = zip(count[steps - 1].tolist(), count[steps].tolist(), strict=True)
        split = np.split(terms, cuts, axis=1)
        enters = np.split(self.pairs.enters[part], cuts)
        return [
            (values.reshape(3, *shape, values.shape[2]), by.reshape(shape))
            for values, by, shape in zip(split, enters, shapes, strict=True)
        ]

    def batches(self) -> Iterator[slice]:
        """The steps of `pairs` in parts with so many pairs each."""
        batch = self.pairs.first[1:] // _AT_ONCE
        cuts = [0, *(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(batch)]
        yield from (slice(begin, end) for begin, end in itertools.pairwise(cuts) if end > begin)

    @cached_property
    def stay(self) -> Terms:
        """Of each state to go on from its own state of the step before, where steps stay; nothing elsewhere."""
        count, step = _counted(self.first)
        rows = np.flatnonzero(self.stays[step])
        before = rows - count[step[rows]]
        place_m = self.place_m
        stay = np.zeros_like(self.initial)
        stay[:, rows] = self._terms(before, rows)
        way = self.ways.along(step[rows], self.oriented[rows])
        moved = distance_scores(place_m[rows] - place_m[before], way, self.config)
        stay[0, rows] += moved[:, None]
        return stay

    def _terms(self, before: Ints, after: Ints) -> Terms:
        offset_m = self.states.offset_m
        level_m = offset_m[after] - self.innovations.survey_m[after]
        moved_m = movements_m(self.innovations, offset_m, self.tolerance_m, before, after)
        return step_terms(moved_m, level_m, self.states.candidate[after], self.like)


@dataclass(frozen=True)
class States:
    """Candidates in each orientation in use: where on the oriented element, and how far left of it [m]."""

    first: Ints
    oriented: Ints
    candidate: Ints
    place_m: Floats
    offset_m: Floats


def trellis_of(
    network: Network,
    steps: Steps,
    candidates: Candidates,
    survey_sigma_m: Floats,
    like: Likelihood,
    config: MatchingConfig,
) -> Trellis:
    """The candidates as states, every step with at least one, and how a train gets from one to the next."""
    states = _states(network, candidates, len(steps))
    ways = _ways(network, steps, states, config)
    stays = _stays(network, steps, states, config)
    pairs = _pairs(network, states, np.flatnonzero(~stays)[1:], ways, config)
    tolerance_m = _tolerances_m(candidates, survey_sigma_m, like, config)[candidates.step[states.candidate]]
    heading_rad = candidates.heading_rad[states.candidate] + np.pi * (states.oriented % 2)
    keep = np.exp(-np.nan_to_num(steps.chord_m) / config.survey_mean_m)
    before = _before(states, stays, pairs)
    innovations = innovations_of(states.first, states.offset_m, heading_rad, tolerance_m, before, keep)
    return Trellis(network, steps, ways, like, config, states, stays, pairs, innovations, tolerance_m)


def _states(network: Network, candidates: Candidates, steps: int) -> States:
    both = np.column_stack([2 * candidates.element, 2 * candidates.element + 1])
    index = np.flatnonzero(network.usable[both].ravel())
    oriented = both.ravel()[index]
    candidate = index // 2
    backward = (oriented % 2).astype(bool)
    along = candidates.along_m[candidate]
    length = network.track.length_m[candidates.element[candidate]]
    return States(
        first=np.searchsorted(candidates.step[candidate], np.arange(steps + 1)),
        oriented=oriented,
        candidate=candidate,
        place_m=np.where(backward, length - along, along),
        offset_m=np.where(backward, -1.0, 1.0) * candidates.offset_m[candidate],
    )


def _tolerances_m(candidates: Candidates, survey_sigma_m: Floats, like: Likelihood, config: MatchingConfig) -> Floats:
    """Per step by how much the distance of tracks may be wrong; how a position off every track moves tells nothing."""
    begin = candidates.first[:-1]
    worst_m = np.maximum.reduceat(survey_sigma_m, begin)
    lost = np.logical_and.reduceat(like.off, begin)
    return np.where(lost, np.inf, config.survey_sigmas * np.sqrt(2.0) * worst_m)


def _counted(first: Ints) -> tuple[Ints, Ints]:
    """How many states each step has, and the step of each state."""
    count = np.diff(first)
    return count, np.repeat(np.arange(len(count)), count)


def _stays(network: Network, steps: Steps, states: States, config: MatchingConfig) -> Bools:
    """Steps over which no state can change: the same states as before, none linked to another, no long way."""
    way = np.fmax(np.abs(steps.odometer_m), steps.chord_m)
    stays = _unchanged(states) & (np.nan_to_num(way, nan=np.inf) <= config.long_step_m)
    apart: dict[tuple[int, ...], bool] = {}
    oriented = states.oriented.tolist()
    first = states.first.tolist()
    for step in np.flatnonzero(stays).tolist():
        group = tuple(oriented[first[step] : first[step + 1]])
        if group not in apart:
            apart[group] = not any(network.linked(here, there) for here in group for there in group)
        stays[step] = apart[group]
    return stays


def _unchanged(states: States) -> Bools:
    """Steps that have the same states as the one before: as many, and each on the same oriented element."""
    count, step = _counted(states.first)
    state = np.arange(len(states.oriented))
    # With equal counts, the same place in the step before is `count` states back.
    equal = states.oriented == states.oriented[np.maximum(state - count[step], 0)]
    all_equal = np.logical_and.reduceat(equal, states.first[:-1])
    return np.asarray((np.diff(count, prepend=0) == 0) & all_equal)


def _pairs(network: Network, states: States, steps: Ints, ways: StepDistances, config: MatchingConfig) -> Pairs:
    """Every state of these steps with every state of the step before, and the most plausible move between them."""
    count = np.diff(states.first)
    sizes = count[steps - 1] * count[steps]
    begin = np.concatenate([[0], np.cumsum(sizes)])
    number = np.arange(begin[-1]) - np.repeat(begin[:-1], sizes)
    width = np.repeat(count[steps], sizes)
    before = np.repeat(states.first[steps - 1], sizes) + number // width
    after = np.repeat(states.first[steps], sizes) + number % width
    places = states.oriented[before], states.place_m[before], states.oriented[after], states.place_m[after]
    scores = move_scores(network, *places, ways.along(np.repeat(steps, sizes), places[0]), config)
    return Pairs(steps, begin, before, after, scores.max(axis=0), scores.argmax(axis=0))


def _before(states: States, stays: Bools, pairs: Pairs) -> Ints:
    """Per state the state of the step before that its survey error goes on from, -1 for none.

    Where steps stay, the same state. Else of the states that lead to it, those followed since the earliest step; of
    these the one with the least movement aside and the likeliest move. So where a branch joins a track, the error of
    the track goes on: that of the branch is its approach since it came within reach, which is no error of the survey.
    """
    count, step = _counted(states.first)
    before = np.where(stays[step], np.arange(len(step)) - count[step], -1).tolist()
    leading = _leading(states, pairs)
    offset_m = states.offset_m.tolist()
    # Of the chain of states that ends in each state: the step at which it began, and its movement aside so far.
    begun = step.tolist()
    aside_m = [0.0] * len(before)
    for state, origin in enumerate(before):
        if state in leading:
            origin = min(leading[state], key=lambda way: (begun[way[0]], aside_m[way[0]] + way[1]))[0]
        if origin >= 0:
            begun[state] = begun[origin]
            aside_m[state] = aside_m[origin] + abs(offset_m[state] - offset_m[origin])
        before[state] = origin
    return np.array(before, dtype=np.int64)


def _leading(states: States, pairs: Pairs) -> dict[int, list[tuple[int, float]]]:
    """By state those that a possible move leads from, cheapest first; cost: movement aside less the log-probability."""
    possible = np.flatnonzero(np.isfinite(pairs.score))
    origins = pairs.before[possible]
    states_after = pairs.after[possible]
    cost = np.abs(states.offset_m[states_after] - states.offset_m[origins]) - pairs.score[possible]
    order = np.lexsort((cost, states_after))
    leading: dict[int, list[tuple[int, float]]] = {}
    moves = zip(states_after[order].tolist(), origins[order].tolist(), cost[order].tolist(), strict=True)
    for state, origin, move_cost in moves:
        leading.setdefault(state, []).append((origin, move_cost))
    return leading


def _ways(network: Network, steps: Steps, states: States, config: MatchingConfig) -> StepDistances:
    """What each step's length is measured against: the odometer, signed once its sign is known, else GNSS."""
    chord = np.nan_to_num(steps.chord_m)
    known = np.isfinite(steps.odometer_m)
    distance = np.where(known, steps.odometer_m, chord)
    limit = (1.0 + config.detour_share) * np.maximum(chord, np.abs(distance)) + config.detour_m
    return StepDistances(distance, known, limit, _polarity(network, steps, states))


def _polarity(network: Network, steps: Steps, states: States) -> Ints:
    """Sign of the odometer against each oriented element: +1, -1, or 0 where unknown.

    The sign belongs to the installation and holds for the whole run, but the orientation of a connected part of the
    network is arbitrary: so one sign for each part, by the votes of all states that stay on one element for a step.
    """
    count = len(network.successors)
    if not network.orientable:
        return np.zeros(count, dtype=np.int64)
    part = network.parts
    _, step = _counted(states.first)
    # Step and oriented element in one sorted number: the same element a step before is `count` less.
    keys = step * count + states.oriented
    before = np.minimum(np.searchsorted(keys, keys - count), len(keys) - 1)
    stayed = np.flatnonzero((keys[before] == keys - count) & np.isfinite(steps.odometer_m[step]))
    moved_m = states.place_m[stayed] - states.place_m[before[stayed]]
    votes = np.sign(moved_m) * steps.odometer_m[step[stayed]]
    return np.sign(np.bincount(part[states.oriented[stayed]], votes, part.max() + 1)).astype(np.int64)[part]
