"""The net elements that a train may have visited one after the other, and the ways through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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


def ways_over(nodes: Sequence[VisitNode], last: int, most: int) -> list[list[ElementStay]]:
    """Ways from the first step to the last that together run over every link between visits.

    Nothing where there are more than `most`.
    """
    ends = {node for node in nodes if node.last == last and node.sampled}
    leading_on = _closure(ends, forward=False)
    begins = {node for node in leading_on if node.first == 0 and node.sampled}
    alive = leading_on & _closure(begins, forward=True)
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


def _closure(start: set[VisitNode], forward: bool) -> set[VisitNode]:
    """All visits reachable from `start`, forward or backward in time."""
    seen: set[VisitNode] = set()
    to_visit = list(start)
    while to_visit:
        node = to_visit.pop()
        if node not in seen:
            seen.add(node)
            to_visit += [link.there for link in node.after] if forward else [link.here for link in node.before]
    return seen


def _way_over(
    link: Link, begins: set[VisitNode], ends: set[VisitNode], alive: set[VisitNode], covered: set[Link]
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


def _stays(start: VisitNode, links: Sequence[Link], last: int) -> list[ElementStay]:
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
