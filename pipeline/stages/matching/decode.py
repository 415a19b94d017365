"""From the best sequence of states to the legs of the path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.stages.matching.moves import Move, best_moves
from pipeline.stages.matching.trellis import Trellis
from pipeline.stages.track.leg import Leg, Visit, leg_of, segments_at, shifted
from pipeline.stages.track.network import Network
from schemas.arrays import Floats, Ints


@dataclass(frozen=True)
class LegElements:
    """Oriented elements of one leg, numbered on from `low`; numbers go on over legs that share an element.

    `shared` is the number of the element in common with the leg before; none at the start and where the
    network does not lead from one leg to the next.
    """

    oriented: tuple[int, ...]
    low: int
    shared: int | None = None

    @property
    def high(self) -> int:
        return self.low + len(self.oriented) - 1

    def turned(self) -> LegElements:
        """The same leg run the other way round."""
        around = tuple(oriented ^ 1 for oriented in reversed(self.oriented))
        return LegElements(around, -self.high, None if self.shared is None else -self.shared)


@dataclass(frozen=True)
class Decoded:
    """Legs, and for each step its leg, element number in it and place from that element's entry [m]."""

    chains: tuple[LegElements, ...]
    leg: Ints
    number: Ints
    place_m: Floats

    def turned(self, network: Network, legs: range) -> Decoded:
        """Some legs run the other way round."""
        chains = tuple(chain.turned() if index in legs else chain for index, chain in enumerate(self.chains))
        inside = (self.leg >= legs.start) & (self.leg < legs.stop)
        length = np.array(
            [
                network.length_m(self.chains[leg].oriented[number - self.chains[leg].low])
                for leg, number in zip(self.leg.tolist(), self.number.tolist(), strict=True)
            ]
        )
        number = np.where(inside, -self.number, self.number)
        return Decoded(chains, self.leg, number, np.where(inside, length - self.place_m, self.place_m))


def decode(trellis: Trellis, best: Ints) -> Decoded:
    """Follow the best states over the network, elements without any fix included."""
    oriented = trellis.oriented[best]
    place = trellis.place_m[best]
    chains = [LegElements((int(oriented[0]),), 0)]
    leg = np.zeros(len(best), dtype=np.int64)
    number = np.zeros(len(best), dtype=np.int64)
    at = 0
    before = 0
    steps = np.flatnonzero(oriented[1:] != oriented[:-1]) + 1
    places = oriented[steps - 1], place[steps - 1], oriented[steps], place[steps]
    moves = best_moves(trellis.network, *places, trellis.ways.along(steps, places[0]), trellis.config)
    for step, move in zip(steps.tolist(), moves, strict=True):
        leg[before:step] = len(chains) - 1
        number[before:step] = at
        before = step
        at = _follow(chains, at, move, int(oriented[step]))
    leg[before:] = len(chains) - 1
    number[before:] = at
    return Decoded(tuple(chains), leg, number, place)


def legs_of(trellis: Trellis, decoded: Decoded) -> list[Leg]:
    """Legs with one path position: equal on what two legs share, carried on by distance over a break."""
    legs: list[Leg] = []
    for index, chain in enumerate(decoded.chains):
        visits = [Visit(oriented // 2, oriented % 2 == 0) for oriented in chain.oriented]
        leg = leg_of(trellis.network.track, visits)
        if legs and chain.shared is not None:
            before = decoded.chains[index - 1]
            there = legs[-1].entry_m(chain.shared - before.low)
            leg = shifted(leg, there - leg.entry_m(chain.shared - chain.low))
        elif legs:
            leg = shifted(leg, _over_break(trellis, decoded, legs[-1], leg, index))
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


def aligned(trellis: Trellis, decoded: Decoded) -> Decoded:
    """After a break the path goes on in the direction it had: legs beyond it are turned where needed."""
    for index, chain in enumerate(decoded.chains):
        if index and chain.shared is None:
            legs = legs_of(trellis, decoded)
            turn = _heading_at(decoded, legs, index) - _heading_at(decoded, legs, index, before=True)
            if np.cos(np.radians(turn)) < 0:
                decoded = decoded.turned(trellis.network, range(index, _next_break(decoded, index)))
    return decoded


def _follow(chains: list[LegElements], at: int, move: Move | None, to: int) -> int:
    """Extend the legs by one move; where the last leg does not lead there, begin a new one."""
    if move is None:
        number = chains[-1].high + 1
        chains.append(LegElements((to,), number))
        return number
    for oriented in (*move.between, to) if move.sense else ():
        chain = chains[-1]
        number = at + move.sense
        if not chain.low <= number <= chain.high:
            chains[-1] = _extended(chain, oriented, move.sense)
        elif chain.oriented[number - chain.low] != oriented:
            chains.append(_branched(chain, at, oriented, move.sense))
        at = number
    return at


def _extended(chain: LegElements, oriented: int, sense: int) -> LegElements:
    if sense > 0:
        return replace(chain, oriented=(*chain.oriented, oriented))
    return replace(chain, oriented=(oriented, *chain.oriented), low=chain.low - 1)


def _branched(chain: LegElements, at: int, oriented: int, sense: int) -> LegElements:
    """A new leg: the element the train is on and what lies behind it, then the other way on."""
    here = at - chain.low
    if sense > 0:
        return LegElements((*chain.oriented[: here + 1], oriented), chain.low, at)
    return LegElements((oriented, *chain.oriented[here:]), at - 1, at)


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


def _over_break(trellis: Trellis, decoded: Decoded, before: Leg, after: Leg, index: int) -> float:
    """Shift of a leg beyond a break, so that path position grows by the distance in between."""
    step = _border(decoded, index)
    last = decoded.chains[index - 1]
    there = before.entry_m(int(decoded.number[step - 1]) - last.low) + float(decoded.place_m[step - 1])
    here = after.entry_m(int(decoded.number[step]) - decoded.chains[index].low) + float(decoded.place_m[step])
    return there + abs(float(trellis.ways.distance_m[step])) - here
