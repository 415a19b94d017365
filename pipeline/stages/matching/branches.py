"""How far it is to the next branch of tracks, and how far behind a switch its branches are one track."""

from __future__ import annotations

import numpy as np

from pipeline.stages.paths.path_set import Node, PathSet
from pipeline.stages.track.network import Network
from schemas.arrays import Floats
from schemas.frozen import frozen

# Numerics: branches of the longest switches part by 1.5 m within 60 m; no farther is looked.
_LONGEST_M = 300.0


def branches_beyond_m(network: Network, wanted: set[int]) -> dict[int, float]:
    """Per oriented element the way beyond its exit to the next branch of tracks [m], infinite to an open end."""
    beyond: dict[int, float] = {}
    for start in sorted(wanted):
        chain: list[int] = []
        on_chain: set[int] = set()
        oriented = start
        while oriented not in beyond and oriented not in on_chain:
            onward = network.successors[oriented]
            if len(onward) != 1 or len(network.successors[onward[0].to ^ 1]) != 1:
                beyond[oriented] = 0.0 if onward else np.inf
                break
            chain.append(oriented)
            on_chain.add(oriented)
            oriented = onward[0].to
        # A ring without a branch has none.
        ahead_m = beyond.get(oriented, np.inf)
        for at in reversed(chain):
            ahead_m += network.length_m(network.successors[at][0].to)
            beyond[at] = ahead_m
    return beyond


@frozen
class Zone:
    """Of one end of a line without a branch: the oriented element that leads to the switch there, and how far behind it
    the branches are one track [m].
    """

    leading: int
    length_m: float


class OneTrack:
    """How far behind a switch its branches are nearer to each other than tracks can be: `apart_m`.

    That counts for paths that came in there, over the switch or at the beginning: of others it is known on which of the
    tracks they are.
    """

    def __init__(self, found: PathSet, apart_m: float) -> None:
        self._network = found.network
        self._apart_m = apart_m
        self._zones: dict[int, Zone] = {}
        self._near = self._spread(found)

    def behind_m(self, node: Node) -> Floats:
        """Of the switches beyond start and end of the node's element: how far behind them the tracks are one [m]."""
        zones = (self.zone(2 * node.element + 1), self.zone(2 * node.element))
        near = self._near.get(id(node), set())
        return np.array([zone.length_m if zone.leading in near else 0.0 for zone in zones])

    def zone(self, oriented: int) -> Zone:
        """Of the line's end beyond the exit of an element."""
        if oriented not in self._zones:
            self._zones[oriented] = self._measured(oriented)
        return self._zones[oriented]

    def _spread(self, found: PathSet) -> dict[int, set[int]]:
        """Per hypothesis the ends of its line near which the path came to it, by the elements that lead there."""
        onward: dict[int, list[Node]] = {}
        near: dict[int, set[int]] = {}
        waiting = []
        for node in found.nodes:
            along = [origin for origin in node.origins if found.groups[origin.element] == found.groups[node.element]]
            for origin in along:
                onward.setdefault(id(origin), []).append(node)
            if len(along) < len(node.origins) or not along:
                near[id(node)] = self._begun_near(node)
                waiting.append(node)
        while waiting:
            node = waiting.pop()
            for child in onward.get(id(node), ()):
                known = near.setdefault(id(child), set())
                if not near[id(node)] <= known:
                    known |= near[id(node)]
                    waiting.append(child)
        return near

    def _begun_near(self, node: Node) -> set[int]:
        begun_m = node.left_m[0] if len(node.left_m) else np.zeros(2)
        near = set()
        for side in (0, 1):
            # Towards its start an element is left as `2 e + 1`, towards its end as `2 e`.
            leaving = 2 * node.element + 1 - side
            zone = self.zone(leaving)
            if begun_m[side] + self._beyond_m(leaving, zone.leading) < zone.length_m:
                near.add(zone.leading)
        return near

    def _beyond_m(self, oriented: int, last: int) -> float:
        """From the exit of an element to that of a later one on its line."""
        beyond_m = 0.0
        while oriented != last:
            oriented = self._network.successors[oriented][0].to
            beyond_m += self._network.length_m(oriented)
        return beyond_m

    def _measured(self, oriented: int) -> Zone:
        network = self._network
        line, way_m = [oriented], 0.0
        while way_m < _LONGEST_M and len(onward := network.successors[line[-1]]) == 1 and onward[0].to not in line:
            back = network.successors[onward[0].to ^ 1]
            if len(back) > 1:
                own = line[-1] ^ 1
                ways_m = (self._together_m(own, edge.to) for edge in back if edge.to != own)
                return Zone(line[-1], max(ways_m))
            line.append(onward[0].to)
            way_m += network.length_m(line[-1])
        return Zone(line[-1], 0.0)

    def _together_m(self, one: int, other: int) -> float:
        """Way from their common begin on over which two branches are nearer than `apart_m`."""
        ways, places = zip(*(self._drawn(oriented) for oriented in (one, other)), strict=True)
        last_m = min(float(way[-1]) for way in ways)
        at_m = np.union1d(*ways)
        at_m = at_m[at_m <= last_m]
        first, second = (
            np.column_stack([np.interp(at_m, way, place[:, axis]) for axis in range(3)])
            for way, place in zip(ways, places, strict=True)
        )
        apart_m = np.linalg.norm(first - second, axis=1)
        wide = np.flatnonzero(apart_m >= self._apart_m)
        if not wide.size:
            return last_m
        row = int(wide[0])
        if not row:
            return 0.0
        return float(np.interp(self._apart_m, apart_m[row - 1 : row + 1], at_m[row - 1 : row + 1]))

    def _drawn(self, oriented: int) -> tuple[Floats, Floats]:
        """A line from an element's entry on, up to the next choice: way [m] and places of its points."""
        network, track = self._network, self._network.track
        line = [oriented]
        length_m = network.length_m(oriented)
        while length_m < _LONGEST_M and len(onward := network.successors[line[-1]]) == 1 and onward[0].to not in line:
            line.append(onward[0].to)
            length_m += network.length_m(line[-1])
        parts = [track.surface[track.vertices(at // 2)][:: -1 if at % 2 else 1] for at in line]
        places = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))]), places
