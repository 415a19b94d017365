"""The net elements that a train may have visited one after the other, and the ways through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise


@dataclass(frozen=True)
class Transition:
    """From an oriented element at one step to one at the next, over those `between`; `back`: against its sense."""

    start: int
    to: int
    between: tuple[int, ...] = ()
    back: bool = False

    @property
    def stays(self) -> bool:
        return self.start == self.to and not self.between


@dataclass(eq=False)
class Node:
    """A visit of an oriented element, at steps `first` to `last`; `sampled`: some sample lies on it."""

    oriented: int
    first: int
    last: int
    sampled: bool = True
    after: list[Link] = field(default_factory=list)
    before: list[Link] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Link:
    """From one visit to the next, behind the step `at`."""

    here: Node
    there: Node
    at: int
    back: bool


@dataclass(frozen=True)
class ElementStay:
    """An oriented element from step `first` to `last`; `back`: entered against its sense."""

    oriented: int
    first: int
    last: int
    back: bool


def nodes_of(starts: set[int], layers: Sequence[Sequence[Transition]]) -> list[Node]:
    """Visits of every element that lies on a way from the first step to the last.

    `starts`: elements at the first step; `layers`: moves from each step to the next.
    """
    layers = _leading_on(layers)
    starts = {move.start for move in layers[0]} if layers else starts
    current = {oriented: Node(oriented, 0, 0) for oriented in sorted(starts)}
    nodes = list(current.values())
    known: set[tuple[Node, tuple[int, ...], Node]] = set()
    for step, moves in enumerate(layers):
        following: dict[int, Node] = {}
        for move in moves:
            if move.stays:
                following[move.to] = current[move.start]
                current[move.start].last = step + 1
        for move in moves:
            if move.to not in following:
                following[move.to] = Node(move.to, step + 1, step + 1)
                nodes.append(following[move.to])
            ends = current[move.start], following[move.to]
            if not move.stays and (ends[0], move.between, ends[1]) not in known:
                known.add((ends[0], move.between, ends[1]))
                nodes += _linked(move, *ends, step)
        current = following
    return nodes


def _linked(move: Transition, start: Node, to: Node, step: int) -> list[Node]:
    """Link two visits over the elements between them; returns the new visits there, on which no sample lies."""
    between = [Node(oriented, step, step, False) for oriented in move.between]
    for here, there in pairwise([start, *between, to]):
        link = Link(here, there, step, move.back)
        here.after.append(link)
        there.before.append(link)
    return between


def _leading_on(layers: Sequence[Sequence[Transition]]) -> list[list[Transition]]:
    """The moves from which a way leads on to the last step."""
    kept: list[list[Transition]] = []
    open_ends: set[int] | None = None
    for moves in reversed(layers):
        kept.append([move for move in moves if open_ends is None or move.to in open_ends])
        open_ends = {move.start for move in kept[-1]}
    return kept[::-1]


def pieces_of(nodes: Sequence[Node]) -> list[list[Node]]:
    """The visits between places where ways part or meet."""
    pieces: dict[Node, list[Node]] = {node: [node] for node in nodes}
    for node in nodes:
        onward = {link.there for link in node.after}
        following = onward.pop() if len(onward) == 1 else None
        if following is not None and {link.here for link in following.before} == {node}:
            merged = pieces[node]
            if merged is not pieces[following]:
                merged += pieces[following]
                pieces.update(dict.fromkeys(pieces[following], merged))
    return list({id(piece): piece for piece in pieces.values()}.values())


def ways_over(nodes: Sequence[Node], last: int, failed: set[Node], most: int) -> list[list[ElementStay]]:
    """Ways from the first step to the last that together run over every link between visits that did not fail.

    Nothing where there are more than `most`.
    """
    ends = {node for node in nodes if node.last == last and node.sampled} - failed
    leading_on = _closure(ends, failed, forward=False)
    begins = {node for node in leading_on if node.first == 0 and node.sampled}
    alive = leading_on & _closure(begins, failed, forward=True)
    ways = [_stays(node, [], last) for node in nodes if node in begins & ends & alive]
    covered: set[Link] = set()
    for link in [link for node in nodes if node in alive for link in node.after if link.there in alive]:
        links = None if link in covered else _way_over(link, begins, ends, alive, covered)
        if links is not None:
            ways.append(_stays(links[0].here, links, last))
            covered |= set(links)
        if len(ways) > most:
            return []
    return ways


def _closure(start: set[Node], failed: set[Node], forward: bool) -> set[Node]:
    """All visits reachable from `start` over visits that did not fail, forward or backward in time."""
    seen: set[Node] = set()
    to_visit = list(start)
    while to_visit:
        node = to_visit.pop()
        if node not in seen:
            seen.add(node)
            onward = [link.there for link in node.after] if forward else [link.here for link in node.before]
            to_visit += [neighbour for neighbour in onward if neighbour not in failed]
    return seen


def _way_over(
    link: Link, begins: set[Node], ends: set[Node], alive: set[Node], covered: set[Link]
) -> list[Link] | None:
    """A whole way over a link, grown at both ends; each next link is the nearest in time, then one not yet covered."""

    def nearest(links: list[Link]) -> Link | None:
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


def _stays(start: Node, links: Sequence[Link], last: int) -> list[ElementStay]:
    """The elements that a way from a visit over these links runs over, in order of time; `last`: the last step."""
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
