"""The ways of a reference: what lives of a set of paths, as visits of net elements with the links between them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from pipeline.stages.paths.moves import Moves, Place
from pipeline.stages.paths.path_set import Node, PathSet
from pipeline.stages.reference.visits import ElementStay, Link, VisitNode, ways_over
from schemas.config import MatchingConfig


def ways_of(found: PathSet, config: MatchingConfig, most: int) -> tuple[int, list[list[ElementStay]]]:
    """Ways to the last step that together run over every hypothesis that nothing refutes, and the step they begin at.

    Steps of stays count from there: the first one, or where a movement led back after every path was refuted. No ways
    where there are more than `most`, and where every path is refuted: a set that began anew without such a movement
    knows nothing of what went wrong before.
    """
    count = len(found.steps)
    first = max((node.stretch for node in found.nodes), default=0)
    if found.overflow < count or first not in (0, *found.returned):
        return first, []
    nodes = {id(node): node for node in _living(found, first)}
    visits = {
        key: VisitNode(node.oriented, node.begin - first, node.end - 1 - first)
        for key, node in nodes.items()
        if _lasts(node)
    }
    moves = Moves.without_odometer(found.network, found.steps, config)
    every = list(visits.values())
    for key, visit in visits.items():
        node = nodes[key]
        for origin, end in _origins(node):
            every += _linked(moves, visits[id(origin)], visit, origin, node, end, first)
    return first, [_without_cuts(way) for way in ways_over(every, count - 1 - first, most)]


def _living(found: PathSet, stretch: int) -> Iterator[Node]:
    """The hypotheses of a stretch that lived to the last step, and all that they went through."""
    count = len(found.steps)
    waiting = [node for node in found.nodes if node.stretch == stretch and node.end >= count and node.rejected >= count]
    known: set[int] = set()
    while waiting:
        node = waiting.pop()
        if id(node) not in known:
            known.add(id(node))
            yield node
            waiting += node.origins


def _lasts(node: Node) -> bool:
    """It covers a step: others only led from one element to the next."""
    return node.end > node.begin


def _origins(node: Node) -> Iterator[tuple[Node, int]]:
    """What a hypothesis came from, and the step before which it did."""
    waiting = [(origin, node.begin if origin is node.parent else origin.end) for origin in node.origins]
    while waiting:
        origin, step = waiting.pop()
        if _lasts(origin):
            yield origin, step
        else:
            waiting += [(further, step) for further in origin.origins]


def _linked(
    moves: Moves, here: VisitNode, there: VisitNode, origin: Node, node: Node, step: int, first: int
) -> list[VisitNode]:
    """Link two visits behind the step before `step`; returns visits of elements between, on which no sample lies.

    Visits count steps from `first` on.
    """
    begin = _place(origin, step - 1)
    end = _place(node, step)
    move = moves.best(begin, end)
    if move is None or moves.cost(begin, end, moves.way(begin.step, end.step)) >= moves.break_cost:
        return []
    at = step - 1 - first
    sense = move.sense or 1
    between = [VisitNode(oriented, at, at, sampled=False) for oriented in move.between]
    for one, other in pairwise([here, *between, there]):
        link = Link(one, other, at, sense < 0)
        one.after.append(link)
        other.before.append(link)
    return between


def _place(node: Node, step: int) -> Place:
    """Where a path was at one of its steps."""
    row = min(max(step - node.begin, 0), node.end - node.begin - 1)
    return Place(step, node.oriented, float(node.left_m[row, node.oriented % 2]))


def _without_cuts(stays: list[ElementStay]) -> list[ElementStay]:
    """Stays on one element after each other are one: a pause of the samples was between them."""
    kept = [stays[0]]
    for stay in stays[1:]:
        before = kept[-1]
        if stay.oriented == before.oriented:
            kept[-1] = ElementStay(before.oriented, before.first, stay.last, before.back)
        else:
            kept.append(stay)
    return kept
