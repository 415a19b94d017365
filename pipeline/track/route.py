"""A given route (`route.parquet`): it overrides what the search would find."""

from __future__ import annotations

import itertools

import numpy as np
import polars as pl

from pipeline.track.geodesy import points_of
from pipeline.track.leg import Visit
from pipeline.track.network import Edge, Network, network_of, oriented_sheet
from pipeline.track.survey import Track, end_places, gaps_m, track_of
from schemas.run import Site

# `Site.route` names directions as the site reader writes them: from an element's start to its end, or back.
_FORWARD = "AB"
# An element's direction is taken over so much of it [m]: single vertices may lie a centimetre apart.
_DIRECTION_OVER_M = 10.0


def visits_of(track: Track, route: pl.DataFrame) -> list[Visit]:
    """The route's elements in order, each in its sense."""
    return [
        Visit(track.index[name], direction == _FORWARD)
        for name, direction in route.select("netelement_id", "direction").iter_rows()
    ]


def network_along(track: Track, visits: list[Visit]) -> Network:
    """A network of nothing but the route; an element passed twice is there twice, one after the other.

    An element that turns round is there in pieces that do not, so that no place is near two places of one piece:
    a ramp that crosses itself, a road up and down beside itself.
    """
    pieces, parts = _pieces(track, visits)
    split = _of_parts(track, [visit.element for visit in pieces], parts)
    usable = [bool(visit.forward) == (side == 0) for visit in pieces for side in (0, 1)]
    along = [Visit(number, piece.forward) for number, piece in enumerate(pieces)]
    return Network(split, _joined(split, along), usable, orientable=True)


def _pieces(track: Track, visits: list[Visit]) -> tuple[list[Visit], list[slice]]:
    """Per piece, in order of travel, the visit that it belongs to and its vertices."""
    pieces: list[Visit] = []
    parts: list[slice] = []
    for visit in visits:
        whole = track.vertices(visit.element)
        cuts = [whole.start, *_turning_vertices(track, whole), whole.stop - 1]
        own = [slice(begin, end + 1) for begin, end in itertools.pairwise(cuts)]
        parts += own if visit.forward else own[::-1]
        pieces += [visit] * len(own)
    return pieces, parts


def _turning_vertices(track: Track, part: slice) -> list[int]:
    """Vertices where an element has turned by more than a right angle since its start or the vertex before."""
    measure = track.measure_m[part]
    rows = np.flatnonzero(np.diff(np.floor((measure - measure[0]) / _DIRECTION_OVER_M), prepend=-1.0) > 0)
    along = np.diff(points_of(track.latitude_deg[part], track.longitude_deg[part]).surface[rows], axis=0)
    cuts: list[int] = []
    since = 0
    for number in range(1, len(along)):
        if along[number] @ along[since] < 0.0:
            cuts.append(part.start + int(rows[number]))
            since = number
    return cuts


def _of_parts(track: Track, elements: list[int], parts: list[slice]) -> Track:
    """Parts of elements in the given order, as elements of their names and measures."""
    rows = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    names = tuple(track.ids[element] for element in elements)
    return Track(
        ids=names,
        index={name: number for number, name in reversed(list(enumerate(names)))},
        first=np.concatenate([[0], np.cumsum([part.stop - part.start for part in parts])]),
        latitude_deg=track.latitude_deg[rows],
        longitude_deg=track.longitude_deg[rows],
        height_m=track.height_m[rows],
        measure_m=track.measure_m[rows],
        sigma_m=track.sigma_m[rows],
        length_m=np.array([track.measure_m[part.stop - 1] - track.measure_m[part.start] for part in parts]),
    )


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
