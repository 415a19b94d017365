"""A given route (`route.parquet`): it overrides what the search would find."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.matching.leg import Visit
from pipeline.matching.network import Edge, Network
from pipeline.track import Track, end_places, gaps_m

# `Site.route` names directions as the site reader writes them: from an element's start to its end, or back.
_FORWARD = "AB"


def visits_of(track: Track, route: pl.DataFrame) -> list[Visit]:
    """The route's elements in order, each in its sense."""
    return [
        Visit(track.index[name], direction == _FORWARD)
        for name, direction in route.select("netelement_id", "direction").iter_rows()
    ]


def network_along(track: Track, visits: list[Visit]) -> Network:
    """A network of nothing but the route; an element passed twice is there twice, one after the other."""
    doubled = _in_order(track, [visit.element for visit in visits])
    successors: list[list[Edge]] = [[] for _ in range(2 * len(visits))]
    ends = end_places(doubled)
    for number in range(len(visits) - 1):
        here, there = visits[number].forward, visits[number + 1].forward
        gap = float(gaps_m(ends[[number], [int(here)]], ends[[number + 1], [int(not there)]])[0])
        leaving, entering = 2 * number + (not here), 2 * (number + 1) + (not there)
        successors[leaving].append(Edge(entering, gap, True, True))
        successors[entering ^ 1].append(Edge(leaving ^ 1, gap, True, True))
    usable = [bool(visit.forward) == (side == 0) for visit in visits for side in (0, 1)]
    return Network(doubled, successors, usable, orientable=True)


def _in_order(track: Track, elements: list[int]) -> Track:
    """The track's elements in the given order, repeated where the order repeats them."""
    rows = np.concatenate([np.arange(track.first[element], track.first[element + 1]) for element in elements])
    counts = [int(track.first[element + 1] - track.first[element]) for element in elements]
    names = tuple(track.ids[element] for element in elements)
    return Track(
        ids=names,
        index={name: number for number, name in reversed(list(enumerate(names)))},
        first=np.concatenate([[0], np.cumsum(counts)]),
        latitude_deg=track.latitude_deg[rows],
        longitude_deg=track.longitude_deg[rows],
        height_m=track.height_m[rows],
        measure_m=track.measure_m[rows],
        sigma_m=track.sigma_m[rows],
        length_m=track.length_m[elements],
    )
