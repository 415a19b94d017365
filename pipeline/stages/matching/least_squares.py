"""The path shown: of the paths of the set the one with the least sum of squared residuals (Viterbi 1967).

It goes on over relations only, reversals included. Where positions leave every track of the set, the path is carried on
without them, each costing what one costs that no error explains; it begins anew on a track that no relation leads to
only where positions stay there for long enough.
"""

from __future__ import annotations

import numpy as np

from pipeline.stages.matching.path_states import PathStates, unbroken
from pipeline.stages.paths.moves import Moves, Place
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

# Numerics: more than a step that no error explains costs one that is left out, in squares of sigmas.
_LEFT_OUT = 1.0


@frozen(eq=False)
class _Reached:
    """The cheapest way to a state of a block; `place`: at its last step."""

    cost: float
    block: int
    number: int
    place: Place
    before: _Reached | None


@frozen
class Course:
    """Steps of the set in order of time with the oriented element of the path at each, and metres from its entry."""

    step: Ints
    oriented: Ints
    place_m: Floats

    def place(self, row: int) -> Place:
        return Place(int(self.step[row]), int(self.oriented[row]), float(self.place_m[row]))


def least_squares(states: PathStates, moves: Moves) -> Course:
    """The steps that lie on the path of least cost."""
    begins = np.flatnonzero(~(unbroken(states, moves.steps, moves.config) & _apart(states, moves)))
    ends = np.append(begins[1:], len(states.step))
    alive: dict[int, _Reached] = {}
    for block, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        alive = _entered(states, moves, alive, block, begin, end)
    return _course(states, begins, ends, min(alive.values(), key=lambda reached: reached.cost))


def _apart(states: PathStates, moves: Moves) -> Bools:
    """Steps at which no state leads to another at once."""
    apart = np.ones(len(states.step), dtype=np.bool_)
    known: dict[tuple[int, ...], bool] = {}
    oriented = states.oriented.tolist()
    first = states.first.tolist()
    for step in np.flatnonzero(np.diff(states.first) > 1).tolist():
        group = tuple(oriented[first[step] : first[step + 1]])
        if group not in known:
            known[group] = not any(moves.network.linked(here, there) for here in group for there in group)
        apart[step] = known[group]
    return apart


def _entered(
    states: PathStates, moves: Moves, alive: dict[int, _Reached], block: int, begin: int, end: int
) -> dict[int, _Reached]:
    """The cheapest way to each state of a block of steps with the same states, and those carried on past it."""
    rows = slice(int(states.first[begin]), int(states.first[begin + 1]))
    size = rows.stop - rows.start
    sums = states.cost[rows.start : int(states.first[end])].reshape(end - begin, size).sum(axis=0).tolist()
    oriented = states.oriented[rows].tolist()
    first_m = states.place_m[rows].tolist()
    last_m = states.place_m[int(states.first[end - 1]) :][:size].tolist()
    step = int(states.step[begin])
    ways = {at: moves.way(at, step) for at in {reached.place.step for reached in alive.values()}}
    cheapest = min(alive.values(), key=lambda reached: reached.cost, default=None)
    after: dict[int, _Reached] = {}
    for number, here in enumerate(oriented):
        there = Place(step, here, first_m[number])
        least = 0.0 if cheapest is None else cheapest.cost + moves.break_cost
        before = cheapest
        for reached in alive.values():
            if reached.cost < least:
                cost = reached.cost + moves.cost(reached.place, there, ways[reached.place.step])
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


def _course(states: PathStates, begins: Ints, ends: Ints, last: _Reached) -> Course:
    """Follow the cheapest way back."""
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
    return Course(states.step[part], states.oriented[row], states.place_m[row])
