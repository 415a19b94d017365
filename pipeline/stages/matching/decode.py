"""From the course of the path over oriented elements to its legs."""

from __future__ import annotations

import numpy as np

from pipeline.stages.matching.least_squares import Course
from pipeline.stages.paths.moves import Move, Moves
from pipeline.stages.track.chain import Chain, moved_on
from pipeline.stages.track.leg import Leg, Visit, leg_of, segments_at, shifted
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen


@frozen
class Decoded:
    """Legs, and for each step its leg, element number in it and place from that element's entry [m]."""

    chains: tuple[Chain, ...]
    leg: Ints
    number: Ints
    place_m: Floats

    def turned(self, network: Network, legs: range) -> Decoded:
        """Some legs run the other way round."""
        chains = tuple(chain.turned(network) if index in legs else chain for index, chain in enumerate(self.chains))
        inside = (self.leg >= legs.start) & (self.leg < legs.stop)
        length = np.array(
            [
                network.length_m(self.chains[leg].oriented[number - self.chains[leg].low])
                for leg, number in zip(self.leg.tolist(), self.number.tolist(), strict=True)
            ]
        )
        number = np.where(inside, -self.number, self.number)
        return Decoded(chains, self.leg, number, np.where(inside, length - self.place_m, self.place_m))


def decode(course: Course, moves: Moves) -> Decoded:
    """Follow the course over the network, elements without any fix included."""
    oriented = course.oriented
    chains = [Chain((int(oriented[0]),), (0.0,))]
    leg = np.zeros(len(oriented), dtype=np.int64)
    number = np.zeros(len(oriented), dtype=np.int64)
    at = 0
    before = 0
    for row in np.flatnonzero(_to_be_asked(course)).tolist():
        leg[before:row] = len(chains) - 1
        number[before:row] = at
        before = row
        move = moves.best(course.place(row - 1), course.place(row))
        at = _follow(chains, moves.network, at, move, int(oriented[row]))
    leg[before:] = len(chains) - 1
    number[before:] = at
    return Decoded(tuple(chains), leg, number, course.place_m)


def _to_be_asked(course: Course) -> Bools:
    """Rows at which the course comes to another element."""
    return np.concatenate([[False], course.oriented[1:] != course.oriented[:-1]])


def legs_of(moves: Moves, course: Course, decoded: Decoded) -> list[Leg]:
    """Legs with one path position: equal on what two legs share, carried on by distance over a break."""
    legs: list[Leg] = []
    for index, chain in enumerate(decoded.chains):
        visits = [Visit(oriented // 2, oriented % 2 == 0) for oriented in chain.oriented]
        leg = leg_of(moves.network.track, visits)
        if legs and chain.shared is not None:
            before = decoded.chains[index - 1]
            there = legs[-1].entry_m(chain.shared - before.low)
            leg = shifted(leg, there - leg.entry_m(chain.shared - chain.low))
        elif legs:
            leg = shifted(leg, _over_break(moves, course, decoded, legs[-1], leg, index))
        legs.append(leg)
    return legs


def positions_m(decoded: Decoded, legs: list[Leg]) -> Floats:
    """Path position of each step."""
    entries = [[leg.entry_m(number) for number in range(len(leg.visits))] for leg in legs]
    return np.array(
        [
            entries[leg][number - decoded.chains[leg].low] + place
            for leg, number, place in zip(
                decoded.leg.tolist(), decoded.number.tolist(), decoded.place_m.tolist(), strict=True
            )
        ]
    )


def aligned(moves: Moves, course: Course, decoded: Decoded) -> Decoded:
    """After a break the path goes on in the direction it had: legs beyond it are turned where needed."""
    for index, chain in enumerate(decoded.chains):
        if index and chain.shared is None:
            legs = legs_of(moves, course, decoded)
            turn = _heading_at(decoded, legs, index) - _heading_at(decoded, legs, index, before=True)
            if np.cos(np.radians(turn)) < 0:
                decoded = decoded.turned(moves.network, range(index, _next_break(decoded, index)))
    return decoded


def _follow(chains: list[Chain], network: Network, at: int, move: Move | None, to: int) -> int:
    """Extend the legs by one move; where the network does not lead there, begin a new one."""
    if move is None:
        number = chains[-1].high + 1
        chains.append(Chain((to,), (0.0,), number))
        return number
    for oriented in (*move.between, to) if move.sense else ():
        at = moved_on(chains, network, at, oriented, move.sense)
    return at


def _next_break(decoded: Decoded, index: int) -> int:
    later = range(index + 1, len(decoded.chains))
    return next((number for number in later if decoded.chains[number].shared is None), len(decoded.chains))


def _border(decoded: Decoded, index: int) -> int:
    """First step of a leg."""
    return int(np.searchsorted(decoded.leg, index))


def _heading_at(decoded: Decoded, legs: list[Leg], index: int, before: bool = False) -> float:
    step = _border(decoded, index) - before
    leg = legs[int(decoded.leg[step])]
    segment, _ = segments_at(leg, positions_m(decoded, legs)[[step]])
    return float(leg.heading_deg[segment[0]])


def _over_break(moves: Moves, course: Course, decoded: Decoded, before: Leg, after: Leg, index: int) -> float:
    """Shift of a leg beyond a break, so that path position grows by the distance in between."""
    step = _border(decoded, index)
    last = decoded.chains[index - 1]
    there = before.entry_m(int(decoded.number[step - 1]) - last.low) + float(decoded.place_m[step - 1])
    here = after.entry_m(int(decoded.number[step]) - decoded.chains[index].low) + float(decoded.place_m[step])
    way = moves.way(int(course.step[step - 1]), int(course.step[step]))
    return there + abs(way.distance_m) - here
