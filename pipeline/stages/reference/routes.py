"""The net elements that a train may have visited one after the other, and the routes through them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from pipeline.stages.paths.path_set import Node, PathSet
from pipeline.stages.paths.path_steps import Moves, Place
from schemas.config import MatchingConfig
from schemas.frozen import frozen


@dataclass(eq=False)
class VisitNode:
    """A visit of an oriented element, at steps `first` to `last`; `sampled`: some sample lies on it."""

    oriented: int
    first: int
    last: int
    sampled: bool = True
    after: list[Link] = field(default_factory=list)
    before: list[Link] = field(default_factory=list)


@frozen(eq=False)
class Link:
    """From one visit to the next, behind the step `at`."""

    here: VisitNode
    there: VisitNode
    at: int
    back: bool


@frozen
class ElementStay:
    """An oriented element from step `first` to `last`; `back`: entered against its sense."""

    oriented: int
    first: int
    last: int
    back: bool


def find_routes(nodes: Sequence[VisitNode], last: int, most: int) -> list[list[ElementStay]]:
    """Routes from the first step to the last that together run over every link between visits.

    [] if more than `most`.
    """
    ends = {node for node in nodes if node.last == last and node.sampled}
    leading_on = _reachable_visits(ends, forward=False)
    begins = {node for node in leading_on if node.first == 0 and node.sampled}
    alive = leading_on & _reachable_visits(begins, forward=True)
    routes = [_stays_on_route(node, [], last) for node in nodes if node in begins & ends & alive]
    covered: set[Link] = set()
    for link in [link for node in nodes if node in alive for link in node.after if link.there in alive]:
        links = None if link in covered else _route_over(link, begins, ends, alive, covered)
        if links is not None:
            routes.append(_stays_on_route(links[0].here, links, last))
            covered |= set(links)
        if len(routes) > most:
            return []
    return routes


def _reachable_visits(start: set[VisitNode], forward: bool) -> set[VisitNode]:
    """All visits reachable from `start`, forward or backward in time."""
    reached: set[VisitNode] = set()
    to_visit = list(start)
    while to_visit:
        node = to_visit.pop()
        if node not in reached:
            reached.add(node)
            to_visit += [link.there for link in node.after] if forward else [link.here for link in node.before]
    return reached


def _route_over(
    link: Link, begins: set[VisitNode], ends: set[VisitNode], alive: set[VisitNode], covered: set[Link]
) -> list[Link] | None:
    """A whole route over a link, grown at both ends; each next link is the nearest in time, then one not yet
    covered.
    """

    def nearest(links: list[Link]) -> Link | None:
        """The link nearest in time to the one grown from; of equal ones one that no route covers yet."""
        return min(links, key=lambda option: (abs(option.at - link.at), option in covered), default=None)

    links = [link]
    while links[-1].there not in ends:
        at = links[-1].at
        onward = nearest([option for option in links[-1].there.after if option.there in alive and option.at >= at])
        if onward is None:
            return None
        links.append(onward)
    while links[0].here not in begins:
        at = links[0].at
        before = nearest([option for option in links[0].here.before if option.here in alive and option.at <= at])
        if before is None:
            return None
        links.insert(0, before)
    return links


def _stays_on_route(start: VisitNode, links: Sequence[Link], last: int) -> list[ElementStay]:
    """The elements that a route from a visit over these links runs over, in order of time; `last`: the last step."""
    stays: list[ElementStay] = []
    node = start
    entered = 0
    back = False
    for link in links:
        stays.append(ElementStay(node.oriented, entered, link.at, back))
        node = link.there
        # A link behind step `at` enters a sampled element at the next step, one passed between samples at the same.
        entered = link.at + int(node.sampled)
        back = link.back
    return [*stays, ElementStay(node.oriented, entered, last, back)]


def unrefuted_routes(found: PathSet, config: MatchingConfig, most: int) -> tuple[int, list[list[ElementStay]]]:
    """The first step, and the routes from it to the last that together run over every hypothesis nothing refutes.

    Steps of stays count from the first: that of the samples, or where a movement led back after every path was refuted.
    No routes where there are more than `most`, and where every path is refuted: a set that began anew without such a
    movement knows nothing of what went wrong before.
    """
    count = len(found.steps)
    first = max((node.stretch for node in found.nodes), default=0)
    if found.overflow < count or first not in (0, *found.returned):
        return first, []
    nodes = {id(node): node for node in _unrefuted_hypotheses(found, first)}
    visits = {
        key: VisitNode(node.oriented, node.begin - first, node.end - 1 - first)
        for key, node in nodes.items()
        if _covers_a_step(node)
    }
    moves = Moves.without_odometer(found.network, found.steps, config)
    every = list(visits.values())
    for key, visit in visits.items():
        node = nodes[key]
        for origin, end in _sampled_origins(node):
            every += _link_visits(moves, visits[id(origin)], visit, origin, node, end, first)
    return first, [_joined_stays(route) for route in find_routes(every, count - 1 - first, most)]


def _unrefuted_hypotheses(found: PathSet, stretch: int) -> Iterator[Node]:
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


def _covers_a_step(node: Node) -> bool:
    """Whether a hypothesis covers a step: others only led from one element to the next."""
    return node.end > node.begin


def _sampled_origins(node: Node) -> Iterator[tuple[Node, int]]:
    """The hypotheses with steps that a hypothesis came from, and the step before which it did."""
    waiting = [(origin, node.begin if origin is node.parent else origin.end) for origin in node.origins]
    while waiting:
        origin, step = waiting.pop()
        if _covers_a_step(origin):
            yield origin, step
        else:
            waiting += [(further, step) for further in origin.origins]


def _link_visits(
    moves: Moves, here: VisitNode, there: VisitNode, origin: Node, node: Node, step: int, first: int
) -> list[VisitNode]:
    """Link two visits behind the step before `step`; returns visits of elements between, on which no sample lies.

    Visits count steps from `first` on.
    """
    begin = _place_at_step(origin, step - 1)
    end = _place_at_step(node, step)
    move = moves.best_move(begin, end)
    if move is None or moves.least_cost(begin, end, moves.distance(begin.step, end.step)) >= moves.break_cost:
        return []
    at = step - 1 - first
    sense = move.sense or 1
    between = [VisitNode(oriented, at, at, sampled=False) for oriented in move.between]
    for one, other in pairwise([here, *between, there]):
        link = Link(one, other, at, sense < 0)
        one.after.append(link)
        other.before.append(link)
    return between


def _place_at_step(node: Node, step: int) -> Place:
    """Place of a path at one of its steps."""
    row = min(max(step - node.begin, 0), node.end - node.begin - 1)
    return Place(step, node.oriented, float(node.left_m[row, node.oriented % 2]))


def _joined_stays(stays: list[ElementStay]) -> list[ElementStay]:
    """Stays on one element after each other are one: a pause of the samples was between them."""
    kept = [stays[0]]
    for stay in stays[1:]:
        before = kept[-1]
        if stay.oriented == before.oriented:
            kept[-1] = ElementStay(before.oriented, before.first, stay.last, before.back)
        else:
            kept.append(stay)
    return kept
