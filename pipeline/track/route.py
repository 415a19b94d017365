"""A given route (`route.parquet`): it overrides what the search would find."""

from __future__ import annotations

import itertools

import polars as pl

from pipeline.track.leg import Visit
from pipeline.track.network import Edge, Network, network_of, oriented_sheet
from pipeline.track.pieces import pieces_of, track_in_parts
from pipeline.track.survey import Track, end_places, gaps_m, track_of
from schemas.run import Site

# `Site.route` names directions as the site reader writes them: from an element's start to its end, or back.
_FORWARD = "AB"


def visits_of(track: Track, route: pl.DataFrame) -> list[Visit]:
    """The route's elements in order, each in its sense."""
    return [
        Visit(track.index[name], direction == _FORWARD)
        for name, direction in route.select("netelement_id", "direction").iter_rows()
    ]


def network_along(track: Track, visits: list[Visit]) -> Network:
    """A network of nothing but the route, in pieces; an element passed twice is there twice, one after the other."""
    pieces = pieces_of(track)
    parts = [(visit, part) for visit in visits for part in pieces[visit.element][:: 1 if visit.forward else -1]]
    split = track_in_parts(track, [(visit.element, part) for visit, part in parts])
    usable = [visit.forward == (side == 0) for visit, _ in parts for side in (0, 1)]
    along = [Visit(number, visit.forward) for number, (visit, _) in enumerate(parts)]
    return Network(split, _joined(split, along), usable, orientable=True)


def _joined(track: Track, visits: list[Visit]) -> list[list[Edge]]:
    """Successors of each oriented element by the relations that the route uses, and no other."""
    successors: list[list[Edge]] = [[] for _ in range(2 * len(track.ids))]
    ends = end_places(track)
    for here, there in itertools.pairwise(visits):
        gap = float(
            gaps_m(ends[[here.element], [int(here.forward)]], ends[[there.element], [int(not there.forward)]])[0]
        )
        leaving, entering = 2 * here.element + (not here.forward), 2 * there.element + (not there.forward)
        for one, other in ((leaving, entering), (entering ^ 1, leaving ^ 1)):
            if all(edge.to != other for edge in successors[one]):
                successors[one].append(Edge(other, gap, True, True))
    return successors


def site_network(site: Site) -> Network:
    """The network of a site; where it gives a route, the elements of the survey with its relations alone."""
    track = track_of(site.track)
    if site.route is None:
        return network_of(track, site.links)
    successors = _joined(track, visits_of(track, site.route))
    return Network(track, successors, *oriented_sheet(successors))
