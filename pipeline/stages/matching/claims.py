"""How sure the matched track is at each epoch, at the time and in hindsight, and the stretches where it is in doubt."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.paths.path_set import LifeSpan, Node, PathSet
from pipeline.stages.track.network import Network
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of
from schemas.config import MatchingConfig
from schemas.frozen import frozen
from schemas.stages import ONE_TRACK_LEFT, MatchedEpochs

# Numerics: branches of the longest switches part by 1.5 m within 60 m; no farther is looked.
_LONGEST_M = 300.0


def distances_to_branch_m(network: Network, wanted: set[int]) -> dict[int, float]:
    """Distance from each oriented element's exit to the next branch of tracks [m], infinite to an open end."""
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
class SwitchZone:
    """One end of a line without a branch: the oriented element that leads to the switch there (`leading`).

    `length_m`: how far behind the switch the branches are nearer to each other than tracks can be [m].
    """

    leading: int
    length_m: float


class SwitchZones:
    """Stretches behind switches in which the branches are nearer to each other than tracks can be: `apart_m`.

    A zone counts for paths that came in there, over the switch or at the beginning: of others it is known on which of
    the tracks they are.
    """

    def __init__(self, found: PathSet, apart_m: float) -> None:
        self._network = found.network
        self._apart_m = apart_m
        self._zones: dict[int, SwitchZone] = {}
        self._near = self._zones_by_node(found)

    def zone_lengths_m(self, node: Node) -> Floats:
        """Lengths of the zones at start and end of the node's element that count for its path [m], shape (2,)."""
        zones = (self.zone_beyond(2 * node.element + 1), self.zone_beyond(2 * node.element))
        near = self._near.get(id(node), set())
        return np.array([zone.length_m if zone.leading in near else 0.0 for zone in zones])

    def zone_beyond(self, oriented: int) -> SwitchZone:
        """The zone at the end of a line, beyond the exit of an oriented element of it."""
        if oriented not in self._zones:
            self._zones[oriented] = self._measure_zone(oriented)
        return self._zones[oriented]

    def _zones_by_node(self, found: PathSet) -> dict[int, set[int]]:
        """Per hypothesis the zones that count for it, by the elements that lead to their switches."""
        onward: dict[int, list[Node]] = {}
        near: dict[int, set[int]] = {}
        waiting = []
        for node in found.nodes:
            along = [origin for origin in node.origins if found.groups[origin.element] == found.groups[node.element]]
            for origin in along:
                onward.setdefault(id(origin), []).append(node)
            if len(along) < len(node.origins) or not along:
                near[id(node)] = self._zones_of_begin(node)
                waiting.append(node)
        while waiting:
            node = waiting.pop()
            for child in onward.get(id(node), ()):
                known = near.setdefault(id(child), set())
                if not near[id(node)] <= known:
                    known |= near[id(node)]
                    waiting.append(child)
        return near

    def _zones_of_begin(self, node: Node) -> set[int]:
        """Zones in which a hypothesis begins, by the elements that lead to their switches."""
        begun_m = node.left_m[0] if len(node.left_m) else np.zeros(2)
        near = set()
        for side in (0, 1):
            # Towards its start an element is left as `2 e + 1`, towards its end as `2 e`.
            leaving = 2 * node.element + 1 - side
            zone = self.zone_beyond(leaving)
            if begun_m[side] + self._distance_between_exits_m(leaving, zone.leading) < zone.length_m:
                near.add(zone.leading)
        return near

    def _distance_between_exits_m(self, oriented: int, last: int) -> float:
        """Distance from the exit of an element to the exit of a later one on its line [m]."""
        beyond_m = 0.0
        while oriented != last:
            oriented = self._network.successors[oriented][0].to
            beyond_m += self._network.length_m(oriented)
        return beyond_m

    def _measure_zone(self, oriented: int) -> SwitchZone:
        """Follow a line to its first switch and measure how far behind that the branches are one track."""
        network = self._network
        line, distance_m = [oriented], 0.0
        while distance_m < _LONGEST_M and len(onward := network.successors[line[-1]]) == 1 and onward[0].to not in line:
            back = network.successors[onward[0].to ^ 1]
            if len(back) > 1:
                own = line[-1] ^ 1
                shared_m = (self._shared_length_m(own, edge.to) for edge in back if edge.to != own)
                return SwitchZone(line[-1], max(shared_m))
            line.append(onward[0].to)
            distance_m += network.length_m(line[-1])
        return SwitchZone(line[-1], 0.0)

    def _shared_length_m(self, one: int, other: int) -> float:
        """Distance from their common begin over which two branches are nearer than `apart_m` [m]."""
        distances_m, places = zip(*(self._line_from(oriented) for oriented in (one, other)), strict=True)
        last_m = min(float(distance_m[-1]) for distance_m in distances_m)
        at_m = np.union1d(*distances_m)
        at_m = at_m[at_m <= last_m]
        first, second = (
            np.column_stack([np.interp(at_m, distance_m, place[:, axis]) for axis in range(3)])
            for distance_m, place in zip(distances_m, places, strict=True)
        )
        apart_m = np.linalg.norm(first - second, axis=1)
        wide = np.flatnonzero(apart_m >= self._apart_m)
        if not wide.size:
            return last_m
        row = int(wide[0])
        if not row:
            return 0.0
        return float(np.interp(self._apart_m, apart_m[row - 1 : row + 1], at_m[row - 1 : row + 1]))

    def _line_from(self, oriented: int) -> tuple[Floats, Floats]:
        """The line from an element's entry on, up to the next choice.

        Distances from there [m], and places of its points.
        """
        network, track = self._network, self._network.track
        line = [oriented]
        length_m = network.length_m(oriented)
        while length_m < _LONGEST_M and len(onward := network.successors[line[-1]]) == 1 and onward[0].to not in line:
            line.append(onward[0].to)
            length_m += network.length_m(line[-1])
        parts = [track.surface[track.vertex_range(at // 2)][:: -1 if at % 2 else 1] for at in line]
        places = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))]), places


# No other track within reach; more than one left of the set.
ALONE, MOST_IN_DOUBT = 1.0, 0.95


# What ended a stretch of doubt: a balise read, a switch taken, positions (tracks that part, offsets), or nothing.
RESOLVED_BY = ("read", "switch", "positions", "nothing")
AMBIGUOUS_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
    "netelement_id": pl.String,
    "other_netelement_id": pl.String,
    "gate_probability": pl.Float64,
    "path_probability": pl.Float64,
    "resolved_by": pl.Enum(RESOLVED_BY),
}

OFF_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
    "netelement_id": pl.String,
    "from_m": pl.Float64,
    "to_m": pl.Float64,
    "offset_m": pl.Float64,
}


@frozen
class Possible:
    """Per step of a second the net elements that no position refutes in hindsight, and the confidence in each.

    `epoch[k]` is the first row of step k; `first[k] : first[k + 1]` are its elements, as numbers of the path's track.
    """

    epoch: Ints
    first: Ints
    element: Ints
    confidence: Floats


@frozen
class Claims:
    """Per epoch the confidence in its track: `live`, by what came before, and in `hindsight`; NaN off the network.

    `rival`: the element that is hardest to tell from it, -1 where none is left; `possible`: all of them.
    """

    live: Floats
    hindsight: Floats
    rival: Ints
    possible: Possible


@frozen
class _LinesLeft:
    """Per step what is left of a set: line (-1: none, -2: several), the two likeliest lines, distance to a branch [m].

    `line`, `element`, `p`: of the two lines with the largest p-values, shapes (n, 2), -1 and 0 without one.
    """

    group: Ints
    line: Ints
    element: Ints
    p: Floats
    branch_m: Floats

    def likeliest_rival(self, step: Ints, group: Ints) -> tuple[Ints, Floats]:
        """The likeliest element off the line of each epoch, -1 for none, and its p-value; `group`: lines of epochs."""
        other = np.where(self.line[step, 0] != group, 0, 1)
        return self.element[step, other], self.p[step, other]


def claim_tracks(found: PathSet, t_s: Floats, element: Ints, sigma_m: Floats, config: MatchingConfig) -> Claims:
    """The confidence that each epoch lies on the track shown, as known at the time and in hindsight.

    Live an epoch uses the steps that ended before it, and of their rejections those of `paths_delay_s` ago. The set is
    carried to the epoch over every relation that the train may have reached since, confidence interval included.

    Args:
        found: the paths that the positions do not reject.
        t_s: times of the epochs since the first position [s], shape (n,).
        element: net element of the path shown at each epoch, -1 for none, shape (n,).
        sigma_m: standard deviation of each position along the track [m], shape (n,).
        config: the section `matching` of the configuration.

    Returns:
        Confidences and rival elements per epoch, and the elements possible at each step.

    Source:
        DOMAIN section 2, rules 10 and 13.
    """
    steps = found.steps
    count = len(steps)
    if not count:
        nothing = np.full(t_s.size, np.nan)
        none = np.zeros(0, dtype=np.int64)
        return Claims(nothing, nothing, np.full(t_s.size, -1), Possible(none, np.zeros(1, np.int64), none, np.zeros(0)))
    before = np.searchsorted(steps.end_s, t_s, side="right") - 1
    about = np.clip(np.searchsorted(steps.end_s, t_s, side="left"), 0, count - 1)
    speed_mps = steps.distance_m / np.maximum(np.diff(steps.end_s, prepend=steps.begin_s[0]), 1e-3)
    since_s = np.where(before >= 0, t_s - steps.end_s[np.maximum(before, 0)], 0.0)
    # How far the train may have come since the last test: a branch nearer than that may lie behind it already.
    driven_m = config.paths_faster * speed_mps[np.maximum(before, 0)] * since_s
    carried_m = driven_m + config.paths_along_sigmas * np.nan_to_num(sigma_m)
    group = np.where(element >= 0, found.groups[np.maximum(element, 0)], -1)
    alone = _have_one_line(found)
    live = _lines_left(found, found.living(config.paths_delay_s), SwitchZones(found, config.paths_one_track_m))
    at = np.maximum(before, 0)
    gate = _confidence_by_step(live, at, group, carried_m, alone)
    gate[before < 0] = 0.0
    gate[found.unclaimed[at]] = np.minimum(gate[found.unclaimed[at]], MOST_IN_DOUBT)
    spans = found.surviving_spans()
    left = _lines_left(found, spans)
    later = _confidence_in_hindsight(left, about, group, alone)
    later[found.unclaimed[about]] = np.minimum(later[found.unclaimed[about]], MOST_IN_DOUBT)
    now, p_now = live.likeliest_rival(at, group)
    then, p_then = left.likeliest_rival(about, group)
    rival = np.where((now >= 0) & (p_now >= p_then), now, then)
    epoch = np.minimum(np.searchsorted(t_s, steps.begin_s), t_s.size - 1)
    return Claims(gate, later, rival, _possible_elements(found, spans, epoch))


def doubtful_stretches(claimed: Claims, t_ns: Ints, element: Ints, read: Bools, network: Network) -> pl.DataFrame:
    """Stretches where the track is doubtful, at the time or in hindsight; rows of `AMBIGUOUS_COLUMNS`.

    `read`: epochs at which a balise was read.
    """
    least = np.fmin(np.nan_to_num(claimed.live), np.nan_to_num(claimed.hindsight))
    ids = network.track.ids
    groups = network.line_of_element
    rows = []
    for begin, last in spans_of((least < ONE_TRACK_LEFT) & (element >= 0)):
        part = slice(begin, last + 1)
        worst = begin + int(np.argmin(least[part]))
        rival = int(claimed.rival[worst])
        after = min(last + 1, t_ns.size - 1)
        if after == last:
            ended = "nothing"
        elif read[begin : after + 1].any():
            ended = "read"
        else:
            ended = "switch" if groups[element[after]] != groups[element[begin]] else "positions"
        here = (int(t_ns[begin]), int(t_ns[last]), ids[element[worst]], ids[rival] if rival >= 0 else None)
        confidences = (float(np.nan_to_num(values[part]).min()) for values in (claimed.live, claimed.hindsight))
        rows.append((*here, *confidences, ended))
    return pl.DataFrame(rows, schema=AMBIGUOUS_COLUMNS, orient="row")


def off_network_stretches(claimed: Claims, epochs: MatchedEpochs, least_s: float) -> pl.DataFrame:
    """Stretches of at least `least_s` on no path of the network, by what was known then; rows of `OFF_COLUMNS`.

    Shorter ones are jumps. Named by the element next to which most of them lay; `offset_m` left of its own sense.
    """
    off = np.isnan(claimed.live) & epochs.near_track & (epochs.element >= 0)
    parts = []
    for begin, last in spans_of(off):
        if (epochs.t_ns[last] - epochs.t_ns[begin]) / NS_PER_S < least_s:
            continue
        part = epochs.table[begin : last + 1]
        name = part["netelement_id"].mode().sort()[0]
        near_element = part.filter(pl.col("netelement_id") == name)
        turned = pl.cov("measure_m", "path_m").sign().fill_nan(1.0).fill_null(1.0)
        side = pl.when(turned < 0).then(-1.0).otherwise(1.0)
        parts.append(
            near_element.select(
                t_start=pl.lit(part["t"][0]),
                t_end=pl.lit(part["t"][-1]),
                netelement_id=pl.lit(name),
                from_m=pl.col("measure_m").min(),
                to_m=pl.col("measure_m").max(),
                offset_m=pl.col("cross_track_m").median() * side,
            )
        )
    return pl.concat(parts) if parts else pl.DataFrame(schema=OFF_COLUMNS)


def _possible_elements(found: PathSet, spans: list[LifeSpan], epoch: Ints) -> Possible:
    """Elements that hypotheses cover at each step, with a confidence shared among their lines."""
    count = len(found.steps)
    elements = found.network.count
    # Step and element in one number, so that one `unique` sorts and removes doubles.
    keys = [np.arange(begin, end) * elements + node.element for node, begin, end, _ in spans]
    step, element = np.divmod(np.unique(np.concatenate([*keys, np.zeros(0, dtype=np.int64)])), elements)
    lines = np.unique(step * elements + found.groups[element]) // elements
    number = np.bincount(lines, minlength=count)[step]
    confidence = np.where(number == 1, ONE_TRACK_LEFT, MOST_IN_DOUBT / np.maximum(number, 1))
    return Possible(epoch, np.searchsorted(step, np.arange(count + 1)), element, confidence)


def _lines_left(found: PathSet, spans: list[LifeSpan], one_track: SwitchZones | None = None) -> _LinesLeft:
    """What is left of the set at each step: its line, and the two likeliest, of equal ones that found first.

    `one_track`: a path is near the branch until the other branches of a switch that it came over are another track.
    """
    count = len(found.steps)
    ends = {2 * node.element + side for node, *_ in spans for side in (0, 1)}
    beyond_m = distances_to_branch_m(found.network, ends)
    line = np.full((count, 2), -1)
    element = np.full((count, 2), -1)
    p = np.zeros((count, 2))
    branch_m = np.full(count, np.inf)
    for node, begin, end, value in spans:
        own = int(found.groups[node.element])
        _enter_among_likeliest(line[begin:end], element[begin:end], p[begin:end], (own, node.element), value)
        beyond = np.array([beyond_m[2 * node.element + 1], beyond_m[2 * node.element]])
        ends_m = node.left_m[: end - begin] + beyond
        if one_track is not None:
            ends_m -= one_track.zone_lengths_m(node)
        part = slice(begin, begin + len(ends_m))
        branch_m[part] = np.minimum(branch_m[part], ends_m.min(axis=1))
    group = np.where(line[:, 1] < 0, line[:, 0], -2)
    return _LinesLeft(group, line, element, p, branch_m)


def _enter_among_likeliest(line: Ints, element: Ints, p: Floats, one: tuple[int, int], value: Floats) -> None:
    """Enter a path, `one` its line and element, with its p-values among the two likeliest lines of each step."""
    for place in (0, 1):
        better = (line[:, place] < 0) | (value > p[:, place])
        if place == 0:
            # What it puts out of the first place goes to the second, but for its own line.
            moved = better & (line[:, 0] >= 0) & (line[:, 0] != one[0])
            for column in (line, element, p):
                column[moved, 1] = column[moved, 0]
        better &= (line[:, 0] != one[0]) if place else True
        line[better, place], element[better, place], p[better, place] = *one, value[better]


def _confidence_by_step(left: _LinesLeft, step: Ints, group: Ints, carried_m: Floats, alone: Floats) -> Floats:
    """Confidence of each epoch in its line, by the step that speaks for it; NaN off the network.

    `carried_m`: how far the train may have come since. Near a branch the rivals are those behind it: nothing is known
    of them yet.
    """
    one = (left.group[step] == group) & (group >= 0) & (carried_m < left.branch_m[step])
    rival, p = left.likeliest_rival(step, group)
    doubted = np.minimum(MOST_IN_DOUBT, 1.0 - np.where(rival >= 0, p, 0.5))
    claimed = np.where(alone[step] > 0, ALONE, ONE_TRACK_LEFT)
    return np.where(one, claimed, np.where(left.group[step] == -1, np.nan, doubted))


def _confidence_in_hindsight(left: _LinesLeft, step: Ints, group: Ints, alone: Floats) -> Floats:
    """Confidence by paths that live to the end; where one goes over to the next line, positions say when."""
    confidence = _confidence_by_step(left, step, group, np.zeros(step.size), alone)
    neighbours = [np.clip(step + by, 0, left.group.size - 1) for by in (-1, 0, 1)]
    one = np.logical_and.reduce([left.group[row] >= 0 for row in neighbours])
    one &= np.logical_or.reduce([left.group[row] == group for row in neighbours])
    return np.where(one & (confidence < ONE_TRACK_LEFT), ONE_TRACK_LEFT, confidence)


def _have_one_line(found: PathSet) -> Floats:
    """1 at steps at which one line alone is within reach, else 0."""
    lines = found.groups[found.candidates.element]
    most = found.network.count
    pairs = np.unique(found.candidates.step * most + lines)
    return np.asarray(np.bincount(pairs // most, minlength=len(found.steps)) == 1, dtype=np.float64)
