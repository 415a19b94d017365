"""The tracks that a reference may have run along: a set by distance, without a favourite (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import dist

import numpy as np
import polars as pl

from pipeline.stages.reference.near import Foot, Near, near_elements
from pipeline.stages.reference.open_ends import off_the_survey
from pipeline.stages.reference.visits import ElementStay, Node, Transition, nodes_of, pieces_of, ways_over
from pipeline.stages.track.chain import Chain
from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.network import MIN_REACH_M, Network
from pipeline.stages.track.path import RoutePath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration

# Numerics: between steps so far apart the search asks where the train may have gone [m].
_STEP_M = 10.0
# A way along the track is at most so many times the straight line between two steps: no railway curve is sharper.
_CURVED = 1.5
# ... and no train comes farther between two samples of a stretch; the search ends there [m].
_FARTHEST_M = 600.0


@dataclass(frozen=True)
class ReferencePath:
    """One way that the samples of a stretch may have taken: per sample its leg and the coordinate on it [m]."""

    leg: Ints
    at_m: Floats
    legs: tuple[RoutePath, ...]


@dataclass(frozen=True)
class ReferenceStretch:
    """Reference samples from gap to gap, and every way that they may have taken: the train was on one of them."""

    t_ns: Ints
    sigma_m: Floats
    paths: tuple[ReferencePath, ...]


@dataclass(frozen=True)
class ReferenceSamples:
    """The samples of a run in order of time."""

    t_ns: Ints
    points: Points
    sigma_m: Floats

    def take(self, rows: Ints) -> ReferenceSamples:
        return ReferenceSamples(self.t_ns[rows], self.points.take(rows), self.sigma_m[rows])


def reference_stretches(
    reference: pl.DataFrame | None, network: Network, numbers: dict[str, int], config: Configuration
) -> tuple[list[ReferenceStretch], list[tuple[int, int]]]:
    """Stretches of the reference with their ways, and the times at which it was heard and lay nowhere [ns].

    `network`: with elements that turn round in pieces; `numbers`: net elements as the caller counts them. An element is
    in the set if a navigable way through the whole stretch runs over it, whose median distance from the samples is
    within k roots on each piece between places where ways part.
    """
    if reference is None or reference.is_empty():
        return [], []
    stated = reference["sigma_m"].fill_null(config.hazards.reference_sigma_m).to_numpy()
    points = points_of(floats(reference, "latitude_deg"), floats(reference, "longitude_deg"))
    samples = ReferenceSamples(times_ns(reference), points, stated)
    # A sample beyond k_T roots of every track is no sample of the track.
    factor = config.align.sure_sigmas
    near = near_elements(samples.points, samples.sigma_m, network, factor, config.hazards.survey_sigma_m)
    off_survey = off_the_survey(samples.points, samples.sigma_m, near, network, config.hazards)
    placed = np.flatnonzero(near.any_near & ~off_survey)
    stretches: list[ReferenceStretch] = []
    covered = np.zeros(samples.t_ns.size, dtype=np.bool_)
    for rows in _between_gaps(samples.t_ns, placed, config.hazards.reference_gap_s):
        for stretch in _placed(samples, near, rows, network, numbers, config):
            stretches.append(stretch)
            covered[np.searchsorted(samples.t_ns, stretch.t_ns)] = True
    return stretches, _silent_spans(samples.t_ns, covered, config.hazards.reference_gap_s)


def _between_gaps(t_ns: Ints, rows: Ints, gap_s: float) -> list[Ints]:
    """Samples without a pause or a lost sample among them."""
    if rows.size == 0:
        return []
    broken = (np.diff(t_ns[rows]) > gap_s * NS_PER_S) | (np.diff(rows) > 1)
    return np.split(rows, np.flatnonzero(broken) + 1)


def _silent_spans(t_ns: Ints, covered: Bools, gap_s: float) -> list[tuple[int, int]]:
    """Times beside samples that lie nowhere, up to the next one that does: nobody knows where the train was."""
    gap_ns = round(gap_s * NS_PER_S)
    known_ns = t_ns[covered]
    spans: list[tuple[int, int]] = []
    for at_ns in t_ns[~covered].tolist():
        after = int(np.searchsorted(known_ns, at_ns))
        before_ns = int(known_ns[after - 1]) if after else at_ns - gap_ns
        after_ns = int(known_ns[after]) if after < known_ns.size else at_ns + gap_ns
        begin_ns = max(before_ns, at_ns - gap_ns) + 1
        end_ns = min(after_ns, at_ns + gap_ns)
        if spans and begin_ns <= spans[-1][1]:
            begin_ns = spans.pop()[0]
        spans.append((begin_ns, end_ns))
    return spans


def _placed(
    samples: ReferenceSamples, near: Near, rows: Ints, network: Network, numbers: dict[str, int], config: Configuration
) -> list[ReferenceStretch]:
    """The stretches of samples without a gap among them: each part with a way through, with all ways that do not fail.

    A part without any such way, or with more than `routes_limit`, is left out.
    """
    part_samples = samples.take(rows)
    all_steps = _steps(part_samples)
    stretches: list[ReferenceStretch] = []
    for part in _connected(list(_parts(part_samples, near.feet(rows[all_steps]), all_steps, network))):
        steps = all_steps[part.first : part.last + 1]
        last = len(part.layers)
        nodes = nodes_of(part.starts, part.layers)
        failed = _failed(nodes, near, rows, part_samples.sigma_m, steps, config)
        ways = ways_over(nodes, last, failed, config.hazards.routes_limit)
        if ways:
            paths = tuple(_path(way.stays(last), near, rows, steps, network, numbers) for way in ways)
            inside = slice(int(steps[0]), int(steps[-1]) + 1)
            stretches.append(ReferenceStretch(part_samples.t_ns[inside], part_samples.sigma_m[inside], paths))
    return stretches


def _steps(samples: ReferenceSamples) -> Ints:
    """Samples some metres apart, those where the train turned, the first and the last."""
    surface = samples.points.surface
    apart_m = np.maximum(_STEP_M, 6.0 * samples.sigma_m).tolist()
    places = surface.tolist()
    steps = [0]
    far = 0
    far_m = 0.0
    for number, place in enumerate(places):
        away_m = dist(place, places[steps[-1]])
        turned = far_m - away_m > 0.5 * apart_m[number]
        if turned or away_m >= apart_m[number]:
            steps.append(far if turned else number)
            far = number
            far_m = dist(place, places[steps[-1]])
        elif away_m > far_m:
            far = number
            far_m = away_m
    if steps[-1] != len(places) - 1:
        steps.append(len(places) - 1)
    return np.array(steps, dtype=np.int64)


@dataclass(frozen=True)
class _PassableSteps:
    """Steps with a way through: the first of them, oriented elements there, and the moves to each next step.

    `onward`: whether a train may have gone from the last step of one part to the first of another.
    """

    first: int
    starts: set[int]
    layers: list[list[Transition]]
    onward: Callable[[int, int], bool]

    @property
    def last(self) -> int:
        return self.first + len(self.layers)


def _parts(
    samples: ReferenceSamples, feet: Sequence[Sequence[Foot]], steps: Ints, network: Network
) -> Iterator[_PassableSteps]:
    """The parts of the steps; a new one begins where no move leads on: the reference leapt to another track."""
    at_m = samples.points.surface[steps]
    noise_m = np.maximum(_STEP_M, 6.0 * samples.sigma_m[steps])
    places = [_inside(one, network) for one in feet]

    def limit_m(step: int, next_step: int) -> float:
        return min(float(_CURVED * np.linalg.norm(at_m[next_step] - at_m[step]) + noise_m[next_step]), _FARTHEST_M)

    network_moves = _Onward(network)

    def onward(step: int, next_step: int) -> bool:
        ways_round = [2 * element + side for element in places[step] for side in (0, 1)]
        limit = limit_m(step, next_step)
        return any(any(network_moves.moves(one, places[step], places[next_step], limit)) for one in ways_round)

    first = 0
    layers = list[list[Transition]]()
    alive = starts = {2 * element for element in places[0]}
    for step in range(len(places) - 1):
        here = places[step]
        there = places[step + 1]
        limit = limit_m(step, step + 1)
        moves = [move for one in sorted(alive) for move in network_moves.moves(one, here, there, limit)]
        if moves:
            layers.append(moves)
            alive = {move.to for move in moves}
        else:
            yield _PassableSteps(first, starts, layers, onward)
            first = step + 1
            layers = []
            alive = starts = {2 * element for element in there}
    yield _PassableSteps(first, starts, layers, onward)


def _connected(parts: list[_PassableSteps]) -> list[_PassableSteps]:
    """The longest part, and those that a train can have come from or gone on to: where else it was nobody knows."""
    longest = max(range(len(parts)), key=lambda number: len(parts[number].layers))
    kept = [parts[longest]]
    for ahead in parts[longest + 1 :]:
        if ahead.onward(kept[-1].last, ahead.first):
            kept.append(ahead)
    for before in parts[:longest][::-1]:
        if before.onward(before.last, kept[0].first):
            kept.insert(0, before)
    return kept


def _inside(feet: Sequence[Foot], network: Network) -> dict[int, float]:
    """Net elements of one sample with its measure on each, without those past whose end it is nearer to the next."""
    distances = {foot.element: foot.distance_m for foot in feet}

    def beyond(foot: Foot) -> bool:
        following = () if foot.end is None else network.successors[2 * foot.element + 1 - foot.end]
        return any(distances.get(edge.to // 2, np.inf) < foot.distance_m for edge in following)

    return {foot.element: foot.measure_m for foot in feet if not beyond(foot)}


class _Onward:
    """Moves over the network, of a length up to a limit."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.known: dict[int, tuple[float, list[tuple[int, float, tuple[int, ...]]]]] = {}

    def moves(
        self, start: int, here: dict[int, float], there: dict[int, float], limit_m: float
    ) -> Iterator[Transition]:
        """From an oriented element at one step to those near the next, forward or back."""
        element = start // 2
        along_m = self.network.track.along_m
        if element in there and abs(there[element] - here[element]) <= limit_m:
            yield Transition(start, start)
        for back in (0, 1):
            left_m = self.network.length_m(start) - along_m(start ^ back, here[element])
            for to, gap_m, between in self._from(start ^ back, limit_m - left_m) if left_m <= limit_m else ():
                if to // 2 in there and left_m + gap_m + along_m(to, there[to // 2]) <= limit_m:
                    yield Transition(start, to ^ back, tuple(oriented ^ back for oriented in between), bool(back))

    def _from(self, side: int, limit_m: float) -> list[tuple[int, float, tuple[int, ...]]]:
        """What can be entered beyond the end of an oriented element, how far beyond, and over which elements."""
        searched_m, entered = self.known.get(side, (-1.0, []))
        if searched_m < limit_m:
            searched_m = max(limit_m, MIN_REACH_M)
            entered = []
            open_ways = [(side, 0.0, tuple[int, ...]())]
            while open_ways:
                last, gone_m, between = open_ways.pop()
                for edge in self.network.successors[last]:
                    if edge.forward and gone_m + edge.gap_m <= searched_m:
                        entered.append((edge.to, gone_m + edge.gap_m, between))
                        length_m = self.network.length_m(edge.to)
                        open_ways.append((edge.to, gone_m + edge.gap_m + length_m, (*between, edge.to)))
            self.known[side] = searched_m, entered
        return entered


def _failed(
    nodes: Sequence[Node], near: Near, rows: Ints, sigma_m: Floats, steps: Ints, config: Configuration
) -> set[Node]:
    """Visits of pieces that lie farther from the samples than k roots, by the median; without samples none does.

    The root is that of the sample and of the survey, of all elements compared the one that is known worst.
    """
    survey_m = np.zeros(rows.size)
    for node in nodes:
        pairs = near.of(node.oriented // 2, int(rows[steps[node.first]]), int(rows[steps[node.last]]))
        row = near.sample[pairs] - rows[0]
        survey_m[row] = np.maximum(survey_m[row], near.survey_sigma_m[pairs])
    root_m = config.hazards.evidence_factor * np.hypot(sigma_m, survey_m)
    failed: set[Node] = set()
    for piece in pieces_of(nodes):
        sampled = [node for node in piece if node.sampled]
        if not sampled:
            continue
        begin = int(steps[min(node.first for node in sampled)])
        end = int(steps[max(node.last for node in sampled)])
        distance_m = np.full(end - begin + 1, np.inf)
        for element in {node.oriented // 2 for node in piece}:
            pairs = near.of(element, int(rows[begin]), int(rows[end]))
            row = near.sample[pairs] - rows[begin]
            distance_m[row] = np.minimum(distance_m[row], near.distance_m[pairs])
        if np.median(distance_m / root_m[begin : end + 1]) > 1.0:
            failed |= set(piece)
    return failed


def _path(
    stays: Sequence[ElementStay], near: Near, rows: Ints, steps: Ints, network: Network, numbers: dict[str, int]
) -> ReferencePath:
    """A way with coordinates: each sample on the nearest of the elements that the way visits about then."""
    begin = int(steps[0])
    count = int(steps[-1] - steps[0]) + 1
    nearest_m = np.full(count, np.inf)
    at_m = np.full(count, np.nan)
    leg = np.full(count, -1)
    legs, placed = _legs(stays, network)
    for stay, (number, entry_m) in zip(stays, placed, strict=True):
        low = max(stay.first - 1, 0)
        high = min(stay.last + 1, steps.size - 1)
        pairs = near.of(stay.oriented // 2, int(rows[steps[low]]), int(rows[steps[high]]))
        sample = near.sample[pairs] - rows[begin]
        nearer = near.distance_m[pairs] < nearest_m[sample]
        sample = sample[nearer]
        pair = np.arange(pairs.start, pairs.stop)[nearer]
        measure_m = near.measure_m[pair]
        element = stay.oriented // 2
        along_m = measure_m - network.track.begin_m[element]
        against_m = network.track.end_m[element] - measure_m
        nearest_m[sample] = near.distance_m[pair]
        leg[sample] = number
        at_m[sample] = entry_m + (against_m if stay.oriented % 2 else along_m)
    on_way = np.flatnonzero(leg >= 0)
    samples = np.arange(count)
    leg = leg[on_way[np.maximum(np.searchsorted(on_way, samples, side="right") - 1, 0)]]
    routes = tuple(chain.route(network, numbers) for chain in legs)
    return ReferencePath(leg, np.interp(samples, on_way, at_m[on_way]), routes)


def _legs(stays: Sequence[ElementStay], network: Network) -> tuple[list[Chain], list[tuple[int, float]]]:
    """The way as chains of one coordinate, and of each visit its chain and where it is entered [m].

    A new chain begins where the train, having turned, takes another branch than that which it came from.
    """
    chains = [Chain((stays[0].oriented,), (0.0,))]
    placed = [(0, 0.0)]
    here = 0
    for stay in stays[1:]:
        chain = chains[-1]
        last = chains[-1].oriented[here]
        onward = here + (-1 if stay.back else 1)
        if 0 <= onward < len(chain.oriented) and chain.oriented[onward] == stay.oriented:
            here = onward
        elif stay.back:
            entry_m = chain.entry_m[here] - _gap_m(network, stay.oriented, last) - network.length_m(stay.oriented)
            grown = Chain((stay.oriented, *chain.oriented[here:]), (entry_m, *chain.entry_m[here:]))
            # At its first element the chain itself grows backwards; further on another branch begins.
            chains = [*chains[: None if here else -1], grown]
            here = 0
        else:
            entry_m = chain.entry_m[here] + network.length_m(last) + _gap_m(network, last, stay.oriented)
            grown = Chain((*chain.oriented[:onward], stay.oriented), (*chain.entry_m[:onward], entry_m))
            chains = [*chains[: None if onward < len(chain.oriented) else -1], grown]
            here = onward
        placed.append((len(chains) - 1, chains[-1].entry_m[here]))
    return chains, placed


def _gap_m(network: Network, from_oriented: int, to_oriented: int) -> float:
    """Way between the ends of two linked net elements [m]."""
    return next(edge.gap_m for edge in network.successors[from_oriented] if edge.to == to_oriented)
