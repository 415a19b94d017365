"""The path of least squares through the places where each step may have been, and its legs (Viterbi 1967)."""

from __future__ import annotations

import numpy as np

from pipeline.stages.paths.candidates import Candidates, belong_beyond
from pipeline.stages.paths.path_set import PathSet
from pipeline.stages.paths.path_steps import Move, Moves, PathSteps, Place
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import Chain, move_along
from pipeline.stages.track.segments import Leg, Visit, leg_of, segments_at, shift_leg
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen


@frozen
class PathStates:
    """Oriented elements in order of step; `first[k] : first[k + 1]` are those of the step `step[k]` of the set.

    `place_m`: from the entry of the oriented element; `cost`: square of the residual over its sigma, limited;
    `refuted`: the whole run refutes every path over it then.
    """

    step: Ints
    first: Ints
    oriented: Ints
    place_m: Floats
    cost: Floats
    refuted: Bools


def path_states(found: PathSet, height_m: Floats, sigma_up_m: Floats, config: MatchingConfig) -> PathStates:
    """Every place within reach of each step, with its cost; steps without any are left out.

    `height_m`, `sigma_up_m`: of each step over the survey's zero, NaN where unknown. All elements at a step are weighed
    by one sigma, else a coarse survey would win. Where the set knows where the train may have been, every other place
    costs as much as a position that no error explains.
    """
    steps, network = found.steps, found.network
    candidates = found.candidates.take(np.flatnonzero(~belong_beyond(found.candidates, network)), len(steps))
    kept = np.diff(candidates.first) > 0
    variance_m2 = (config.cross_bias_sigma_m**2 + steps.sigma_m**2)[candidates.step]
    most = config.outlier_sigmas**2
    cost = np.minimum(candidates.distance_m**2 / variance_m2, most)
    refuted = _are_refuted(found, candidates)
    cost = np.where(refuted, most, cost + _height_costs(candidates, height_m, sigma_up_m, config))
    candidates = candidates.with_steps_renumbered(kept)
    both = np.column_stack([2 * candidates.element, 2 * candidates.element + 1])
    index = np.flatnonzero(network.usable[both].ravel())
    oriented = both.ravel()[index]
    row = index // 2
    backward = oriented % 2 == 1
    return PathStates(
        step=np.flatnonzero(kept),
        first=np.searchsorted(candidates.step[row], np.arange(int(kept.sum()) + 1)),
        oriented=oriented,
        place_m=np.where(backward, candidates.left_m[row], candidates.along_m[row]),
        cost=cost[row],
        refuted=refuted[row],
    )


def continues_unchanged(states: PathStates, steps: PathSteps, config: MatchingConfig) -> Bools:
    """Steps that follow the one before at once, with the same states.

    But for one every `break_s` where there are several: a path may break off there.
    """
    count = np.diff(states.first)
    number = np.repeat(np.arange(len(count)), count)
    state = np.arange(len(states.oriented))
    # With equal counts, the same place in the step before is `count` states back.
    before = np.maximum(state - count[number], 0)
    equal = (states.oriented == states.oriented[before]) & (states.refuted == states.refuted[before])
    same = np.logical_and.reduceat(equal, states.first[:-1]) & (np.diff(count, prepend=0) == 0)
    at_once = np.diff(states.step, prepend=-2) == 1
    soon = np.diff(steps.end_s, prepend=-np.inf)[states.step] <= config.paths_gap_s
    spell = np.floor(steps.end_s[states.step] / config.break_s)
    return np.asarray(same & at_once & soon & ((count == 1) | (np.diff(spell, prepend=-1.0) == 0.0)))


def _are_refuted(found: PathSet, candidates: Candidates) -> Bools:
    """Candidates on an element that the whole run refutes; none where every path is refuted."""
    count = len(found.steps)
    elements = found.network.count
    lives = found.surviving_spans()
    # Between two elements a step belongs to either.
    spans = [(node.element, max(begin - 1, 0), min(end + 1, count)) for node, begin, end, _ in lives]
    # Step and element in one number, to be looked up by `isin`.
    keys = [np.arange(begin, end) * elements + element for element, begin, end in spans]
    possible = np.unique(np.concatenate([*keys, np.zeros(0, dtype=np.int64)]))
    known = np.zeros(count, dtype=np.bool_)
    for _, begin, end, _ in lives:
        known[begin:end] = True
    step = candidates.step
    return np.asarray(known[step] & ~np.isin(step * elements + candidates.element, possible))


def _height_costs(candidates: Candidates, height_m: Floats, sigma_up_m: Floats, config: MatchingConfig) -> Floats:
    """Cost of each candidate by the height over its track, where tracks lie over each other; 0 without heights.

    Tracks at one level differ by superelevation and errors of the survey, which say nothing of the train.
    """
    track_m = candidates.height_m
    if not np.isfinite(track_m).any():
        return np.zeros(track_m.size)
    begin = candidates.first[:-1][np.diff(candidates.first) > 0]
    of_step = np.repeat(np.arange(begin.size), np.diff(np.append(begin, track_m.size)))
    # How far the highest and the lowest candidate of each step are apart.
    apart_m = (np.maximum.reduceat(track_m, begin) - np.minimum.reduceat(track_m, begin))[of_step]
    variance_m2 = sigma_up_m[candidates.step] ** 2 + config.height_bias_sigma_m**2
    square = (height_m[candidates.step] - track_m) ** 2 / variance_m2
    counts = (apart_m >= config.clearance_m) & np.isfinite(square)
    return np.where(counts, np.minimum(square, config.outlier_sigmas**2), 0.0)


def polarity_of_parts(network: Network, states: PathStates, counted_m: Floats) -> Ints:
    """Sign of the odometer against each oriented element: +1, -1, or 0 where unknown; shape (oriented elements,).

    `counted_m`: per step of the states the distance since the step before, signed, NaN where unknown. The sign belongs
    to the installation and holds for the whole run, but the orientation of a connected part of the network is
    arbitrary: so one sign for each part, by the votes of all states that stay on one element for a step. Of the path
    shown, which looks back; the sign that the train counts with is `odometry.polarity`, by the first metres on it.
    """
    count = len(network.successors)
    if not network.orientable:
        return np.zeros(count, dtype=np.int64)
    part = network.parts
    step = np.repeat(np.arange(len(states.first) - 1), np.diff(states.first))
    # Step and oriented element in one sorted number: the same element a step before is `count` less.
    keys = step * count + states.oriented
    before = np.minimum(np.searchsorted(keys, keys - count), len(keys) - 1)
    stayed = np.flatnonzero((keys[before] == keys - count) & np.isfinite(counted_m[step]))
    moved_m = states.place_m[stayed] - states.place_m[before[stayed]]
    votes = np.sign(moved_m) * counted_m[step[stayed]]
    return np.sign(np.bincount(part[states.oriented[stayed]], votes, part.max() + 1)).astype(np.int64)[part]


# Numerics: more than a step that no error explains costs one that is left out, in squares of sigmas.
_LEFT_OUT = 1.0


@frozen(eq=False)
class _Reached:
    """The cheapest path to a state of a block; `place`: at its last step."""

    cost: float
    block: int
    number: int
    place: Place
    before: _Reached | None


@frozen
class PathCourse:
    """Steps of the set in order of time with the oriented element of the path at each, and metres from its entry."""

    step: Ints
    oriented: Ints
    place_m: Floats

    def place(self, row: int) -> Place:
        """Place of the train at one of the steps."""
        return Place(int(self.step[row]), int(self.oriented[row]), float(self.place_m[row]))


def least_squares_course(states: PathStates, moves: Moves) -> PathCourse:
    """The steps, with their places, on the path of least cost through the states."""
    begins = np.flatnonzero(~(continues_unchanged(states, moves.steps, moves.config) & _are_unrelated(states, moves)))
    ends = np.append(begins[1:], len(states.step))
    alive: dict[int, _Reached] = {}
    for block, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        alive = _extend_to_block(states, moves, alive, block, begin, end)
    return _trace_back(states, begins, ends, min(alive.values(), key=lambda reached: reached.cost))


def _are_unrelated(states: PathStates, moves: Moves) -> Bools:
    """Steps at which no state leads to another one over a relation."""
    apart = np.ones(len(states.step), dtype=np.bool_)
    known: dict[tuple[int, ...], bool] = {}
    oriented = states.oriented.tolist()
    first = states.first.tolist()
    for step in np.flatnonzero(np.diff(states.first) > 1).tolist():
        group = tuple(oriented[first[step] : first[step + 1]])
        if group not in known:
            known[group] = not any(moves.network.are_linked(here, there) for here in group for there in group)
        apart[step] = known[group]
    return apart


def _extend_to_block(
    states: PathStates, moves: Moves, alive: dict[int, _Reached], block: int, begin: int, end: int
) -> dict[int, _Reached]:
    """The cheapest path to each state of a block of steps with equal states, and those carried on past it.

    `alive`: the cheapest paths so far, by oriented element; `begin`, `end`: of the block among the steps of the states.
    """
    rows = slice(int(states.first[begin]), int(states.first[begin + 1]))
    size = rows.stop - rows.start
    sums = states.cost[rows.start : int(states.first[end])].reshape(end - begin, size).sum(axis=0).tolist()
    oriented = states.oriented[rows].tolist()
    first_m = states.place_m[rows].tolist()
    last_m = states.place_m[int(states.first[end - 1]) :][:size].tolist()
    step = int(states.step[begin])
    distances = {at: moves.distance(at, step) for at in {reached.place.step for reached in alive.values()}}
    cheapest = min(alive.values(), key=lambda reached: reached.cost, default=None)
    after: dict[int, _Reached] = {}
    for number, here in enumerate(oriented):
        there = Place(step, here, first_m[number])
        least = 0.0 if cheapest is None else cheapest.cost + moves.break_cost
        before = cheapest
        for reached in alive.values():
            if reached.cost < least:
                cost = reached.cost + moves.least_cost(reached.place, there, distances[reached.place.step])
                if cost < least:
                    least, before = cost, reached
        place = Place(int(states.step[end - 1]), here, last_m[number])
        after[here] = _Reached(least + sums[number], block, number, place, before)
    # A path that costs more than to break off the cheapest has lost.
    most = min(reached.cost for reached in after.values()) + moves.break_cost
    # To leave a step out costs more than to explain it by nothing: positions off the network stay on the path.
    missed = (moves.config.outlier_sigmas**2 + _LEFT_OUT) * (end - begin)
    for here, reached in alive.items():
        if here not in after and reached.cost + missed < most:
            carried = _Reached(reached.cost + missed, reached.block, reached.number, reached.place, reached.before)
            after[here] = carried
    return after


def _trace_back(states: PathStates, begins: Ints, ends: Ints, last: _Reached) -> PathCourse:
    """The course that the cheapest path `last` took, from its first block on."""
    parts: list[Ints] = []
    rows: list[Ints] = []
    reached: _Reached | None = last
    while reached is not None:
        part = np.arange(begins[reached.block], ends[reached.block])
        parts.append(part)
        rows.append(states.first[part] + reached.number)
        reached = reached.before
    part = np.concatenate(parts[::-1])
    row = np.concatenate(rows[::-1])
    return PathCourse(states.step[part], states.oriented[row], states.place_m[row])


@frozen
class LegsOfSteps:
    """The legs of a course as chains, and for each step its leg, element number there and place from its entry [m]."""

    chains: tuple[Chain, ...]
    leg: Ints
    number: Ints
    place_m: Floats

    def with_legs_turned(self, network: Network, legs: range) -> LegsOfSteps:
        """The steps with some legs run in the other direction."""
        chains = tuple(
            chain.in_other_direction(network) if index in legs else chain for index, chain in enumerate(self.chains)
        )
        inside = (self.leg >= legs.start) & (self.leg < legs.stop)
        length = np.array(
            [
                network.length_m(self.chains[leg].oriented[number - self.chains[leg].low])
                for leg, number in zip(self.leg.tolist(), self.number.tolist(), strict=True)
            ]
        )
        number = np.where(inside, -self.number, self.number)
        return LegsOfSteps(chains, self.leg, number, np.where(inside, length - self.place_m, self.place_m))


def split_into_legs(course: PathCourse, moves: Moves) -> LegsOfSteps:
    """The course as legs, elements without any fix included; a new leg begins where the network does not lead on."""
    oriented = course.oriented
    chains = [Chain((int(oriented[0]),), (0.0,))]
    leg = np.zeros(len(oriented), dtype=np.int64)
    number = np.zeros(len(oriented), dtype=np.int64)
    at = 0
    before = 0
    for row in np.flatnonzero(_element_changes(course)).tolist():
        leg[before:row] = len(chains) - 1
        number[before:row] = at
        before = row
        move = moves.best_move(course.place(row - 1), course.place(row))
        at = _extend_legs(chains, moves.network, at, move, int(oriented[row]))
    leg[before:] = len(chains) - 1
    number[before:] = at
    return LegsOfSteps(tuple(chains), leg, number, course.place_m)


def _element_changes(course: PathCourse) -> Bools:
    """Rows at which the course comes to another element."""
    return np.concatenate([[False], course.oriented[1:] != course.oriented[:-1]])


def legs_with_positions(moves: Moves, course: PathCourse, decoded: LegsOfSteps) -> list[Leg]:
    """Legs with one path position: equal on what two legs share, carried on by distance over a break."""
    legs: list[Leg] = []
    for index, chain in enumerate(decoded.chains):
        visits = [Visit(oriented // 2, oriented % 2 == 0) for oriented in chain.oriented]
        leg = leg_of(moves.network.track, visits)
        if legs and chain.shared is not None:
            before = decoded.chains[index - 1]
            there = legs[-1].entry_m(chain.shared - before.low)
            leg = shift_leg(leg, there - leg.entry_m(chain.shared - chain.low))
        elif legs:
            leg = shift_leg(leg, _shift_over_break_m(moves, course, decoded, legs[-1], leg, index))
        legs.append(leg)
    return legs


def step_positions_m(decoded: LegsOfSteps, legs: list[Leg]) -> Floats:
    """Path position of each step [m]."""
    entries = [[leg.entry_m(number) for number in range(len(leg.visits))] for leg in legs]
    return np.array(
        [
            entries[leg][number - decoded.chains[leg].low] + place
            for leg, number, place in zip(
                decoded.leg.tolist(), decoded.number.tolist(), decoded.place_m.tolist(), strict=True
            )
        ]
    )


def with_direction_kept(moves: Moves, course: PathCourse, decoded: LegsOfSteps) -> LegsOfSteps:
    """The legs, those beyond a break turned where needed, so that the path goes on in the direction it had."""
    for index, chain in enumerate(decoded.chains):
        if index and chain.shared is None:
            legs = legs_with_positions(moves, course, decoded)
            turn = _heading_at(decoded, legs, index) - _heading_at(decoded, legs, index, before=True)
            if np.cos(np.radians(turn)) < 0:
                decoded = decoded.with_legs_turned(moves.network, range(index, _next_break(decoded, index)))
    return decoded


def _extend_legs(chains: list[Chain], network: Network, at: int, move: Move | None, to: int) -> int:
    """Extend the legs by one move to the element `to`, whose number is returned; without a move begin a new leg."""
    if move is None:
        number = chains[-1].last_number + 1
        chains.append(Chain((to,), (0.0,), number))
        return number
    for oriented in (*move.between, to) if move.sense else ():
        at = move_along(chains, network, at, oriented, move.sense)
    return at


def _next_break(decoded: LegsOfSteps, index: int) -> int:
    """The next leg that shares no element with the one before it, else the number of legs."""
    later = range(index + 1, len(decoded.chains))
    return next((number for number in later if decoded.chains[number].shared is None), len(decoded.chains))


def _first_step(decoded: LegsOfSteps, index: int) -> int:
    """First step of a leg."""
    return int(np.searchsorted(decoded.leg, index))


def _heading_at(decoded: LegsOfSteps, legs: list[Leg], index: int, before: bool = False) -> float:
    """Heading of the track at the first step of a leg, or at the step before it [deg]."""
    step = _first_step(decoded, index) - before
    leg = legs[int(decoded.leg[step])]
    segment, _ = segments_at(leg, step_positions_m(decoded, legs)[[step]])
    return float(leg.heading_deg[segment[0]])


def _shift_over_break_m(
    moves: Moves, course: PathCourse, decoded: LegsOfSteps, before: Leg, after: Leg, index: int
) -> float:
    """Shift of a leg beyond a break, so that path position grows by the distance in between."""
    step = _first_step(decoded, index)
    last = decoded.chains[index - 1]
    there = before.entry_m(int(decoded.number[step - 1]) - last.low) + float(decoded.place_m[step - 1])
    here = after.entry_m(int(decoded.number[step]) - decoded.chains[index].low) + float(decoded.place_m[step])
    distance = moves.distance(int(course.step[step - 1]), int(course.step[step]))
    return there + abs(distance.distance_m) - here
