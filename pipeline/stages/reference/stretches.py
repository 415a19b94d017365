"""The tracks that a reference may have run along: a set by distance, without a favourite (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import dist

import numpy as np
import polars as pl

from pipeline.stages.reference.moves import Moves
from pipeline.stages.reference.near import Foot, Near, near_elements
from pipeline.stages.reference.open_ends import off_the_survey
from pipeline.stages.reference.visits import ElementStay, Node, Transition, nodes_of, pieces_of, ways_over
from pipeline.stages.track.chain import Chain
from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.network import Network
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
    """One way that the samples of a stretch may have taken: per sample its leg and the coordinate on it [m].

    `aside_m`: distance of the sample from the track; `root_m`: sigma of that, of sample and survey together.
    """

    leg: Ints
    at_m: Floats
    legs: tuple[RoutePath, ...]
    aside_m: Floats
    root_m: Floats

    def part(self, rows: slice) -> ReferencePath:
        """Of some samples."""
        arrays = {name: getattr(self, name)[rows] for name in ("leg", "at_m", "aside_m", "root_m")}
        return replace(self, **arrays)


@dataclass(frozen=True)
class ReferenceStretch:
    """Reference samples from gap to gap, and every way that they may have taken: the train was on one of them."""

    t_ns: Ints
    sigma_m: Floats
    paths: tuple[ReferencePath, ...]


def reference_stretches(
    reference: pl.DataFrame | None, network: Network, numbers: dict[str, int], config: Configuration
) -> tuple[list[ReferenceStretch], list[tuple[int, int]]]:
    """Stretches of the reference with their ways, and the times at which samples exist but lie on no track [ns].

    `network`: with elements that turn round in pieces; `numbers`: net elements as the caller counts them. An element is
    in the set if a navigable way through the whole stretch runs over it, whose median distance from the samples is
    within k roots on each piece between places where ways part.
    """
    if reference is None or reference.is_empty():
        return [], []
    hazards = config.hazards
    t_ns = times_ns(reference)
    sigma_m = reference["sigma_m"].fill_null(hazards.reference_sigma_m).to_numpy()
    points = points_of(floats(reference, "latitude_deg"), floats(reference, "longitude_deg"))
    # A sample beyond k_T roots of every track is no sample of the track.
    # A track whose samples lie a little farther at some steps is still asked for: its median decides.
    near = near_elements(points, sigma_m, network, 2.0 * config.align.sure_sigmas, hazards.survey_sigma_m)
    placed = np.flatnonzero(
        near.placed(config.align.sure_sigmas, sigma_m) & ~off_the_survey(points, sigma_m, near, network, hazards)
    )
    search = _Search(points, sigma_m, near, network, numbers, config)
    stretches: list[ReferenceStretch] = []
    covered = np.zeros(t_ns.size, dtype=np.bool_)
    for rows in _between_gaps(t_ns, placed, hazards.reference_gap_s):
        part = search.passable(rows)
        paths = search.paths(part)
        if paths:
            inside = slice(part.begin, part.end + 1)
            stretches.append(ReferenceStretch(t_ns[inside], sigma_m[inside], paths))
            covered[inside] = True
    return stretches, _silent_spans(t_ns, covered, hazards.reference_gap_s)


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
        if spans and begin_ns <= spans[-1][1]:
            begin_ns = spans.pop()[0]
        spans.append((begin_ns, min(after_ns, at_ns + gap_ns)))
    return spans


@dataclass(frozen=True)
class _Part:
    """Samples some metres apart (`steps`, by their numbers) with a way through: oriented elements at the first, and the
    moves to each next one.
    """

    steps: Ints
    starts: set[int]
    layers: list[list[Transition]]

    @property
    def begin(self) -> int:
        return int(self.steps[0])

    @property
    def end(self) -> int:
        return int(self.steps[-1])

    @cached_property
    def nodes(self) -> list[Node]:
        return nodes_of(self.starts, self.layers)


@dataclass(frozen=True)
class _Search:
    """The samples of a run, and where they may lie on the network."""

    points: Points
    sigma_m: Floats
    near: Near
    network: Network
    numbers: dict[str, int]
    config: Configuration

    def passable(self, rows: Ints) -> _Part:
        """The longest part of samples without a gap among them that a train can have run.

        Where no move leads on, the reference leapt to another track: of the other parts nobody knows.
        """
        return max(self._parts(self._steps(rows)), key=lambda part: len(part.layers))

    def _steps(self, rows: Ints) -> Ints:
        """Samples some metres apart, those where the train turned, the first and the last."""
        places = self.points.surface[rows].tolist()
        steps = [0]
        far = 0
        far_m = 0.0
        for number, apart_m in enumerate(np.maximum(_STEP_M, 6.0 * self.sigma_m[rows]).tolist()):
            away_m = dist(places[number], places[steps[-1]])
            turned = far_m - away_m > 0.5 * apart_m
            if turned or away_m >= apart_m:
                steps.append(far if turned else number)
                far = number
                far_m = dist(places[number], places[steps[-1]])
            elif away_m > far_m:
                far = number
                far_m = away_m
        if steps[-1] != rows.size - 1:
            steps.append(rows.size - 1)
        return rows[steps]

    def _parts(self, steps: Ints) -> Iterator[_Part]:
        """The parts of the steps; a new one begins where no move leads on."""
        places = [self._inside(feet) for feet in self.near.feet(steps)]
        apart_m = np.linalg.norm(np.diff(self.points.surface[steps], axis=0), axis=1)
        noise_m = np.maximum(_STEP_M, 6.0 * self.sigma_m[steps[1:]])
        moves = Moves(self.network)
        first = 0
        layers: list[list[Transition]] = []
        alive = starts = {2 * element for element in places[0]}
        for step, limit_m in enumerate(np.minimum(_CURVED * apart_m + noise_m, _FARTHEST_M).tolist()):
            here = places[step]
            there = places[step + 1]
            onward = [move for start in sorted(alive) for move in moves.onward(start, here, there, limit_m)]
            if onward:
                layers.append(onward)
                alive = {move.to for move in onward}
            else:
                yield _Part(steps[first : step + 1], starts, layers)
                first = step + 1
                layers = []
                alive = starts = {2 * element for element in there}
        yield _Part(steps[first:], starts, layers)

    def _inside(self, feet: Sequence[Foot]) -> dict[int, float]:
        """Net elements of one sample and its measure on each, without those past whose end it is nearer to the next."""
        distances = {foot.element: foot.distance_m for foot in feet}

        def beyond(foot: Foot) -> bool:
            following = () if foot.end is None else self.network.successors[2 * foot.element + 1 - foot.end]
            return any(distances.get(edge.to // 2, np.inf) < foot.distance_m for edge in following)

        return {foot.element: foot.measure_m for foot in feet if not beyond(foot)}

    def paths(self, part: _Part) -> tuple[ReferencePath, ...]:
        """All ways through a part that do not fail; none where they are more than `routes_limit`."""
        last = len(part.layers)
        ways = ways_over(part.nodes, last, self._failed(part), self.config.hazards.routes_limit)
        return tuple(self._path(stays, part) for stays in ways)

    def _failed(self, part: _Part) -> set[Node]:
        """Visits of pieces that lie farther from the samples than k roots, by the median; without samples none does.

        The root is that of the sample and of the survey, of all elements compared the one that is known worst.
        """
        near = self.near
        survey_m = np.zeros(part.end - part.begin + 1)
        for node in part.nodes:
            pairs = near.of(node.oriented // 2, int(part.steps[node.first]), int(part.steps[node.last]))
            row = near.sample[pairs] - part.begin
            survey_m[row] = np.maximum(survey_m[row], near.survey_sigma_m[pairs])
        sigma_m = self.sigma_m[part.begin : part.end + 1]
        root_m = self.config.hazards.evidence_factor * np.hypot(sigma_m, survey_m)
        failed: set[Node] = set()
        for piece in pieces_of(part.nodes):
            sampled = [node for node in piece if node.sampled]
            if not sampled:
                continue
            begin = int(part.steps[min(node.first for node in sampled)])
            end = int(part.steps[max(node.last for node in sampled)])
            distance_m = np.full(end - begin + 1, np.inf)
            for element in {node.oriented // 2 for node in piece}:
                pairs = near.of(element, begin, end)
                row = near.sample[pairs] - begin
                distance_m[row] = np.minimum(distance_m[row], near.distance_m[pairs])
            if np.median(distance_m / root_m[begin - part.begin : end - part.begin + 1]) > 1.0:
                failed |= set(piece)
        return failed

    def _path(self, stays: Sequence[ElementStay], part: _Part) -> ReferencePath:
        """A way with coordinates: each sample on the nearest of the elements that the way visits about then."""
        near = self.near
        track = self.network.track
        count = part.end - part.begin + 1
        nearest_m = np.full(count, np.inf)
        at_m = np.full(count, np.nan)
        leg = np.full(count, -1)
        survey_m = np.zeros(count)
        legs, placed = _legs(stays, self.network)
        for stay, (number, entry_m) in zip(stays, placed, strict=True):
            element = stay.oriented // 2
            low = part.steps[max(stay.first - 1, 0)]
            high = part.steps[min(stay.last + 1, part.steps.size - 1)]
            pairs = near.of(element, int(low), int(high))
            sample = near.sample[pairs] - part.begin
            nearer = near.distance_m[pairs] < nearest_m[sample]
            sample = sample[nearer]
            measure_m = near.measure_m[pairs][nearer]
            against = stay.oriented % 2
            along_m = track.end_m[element] - measure_m if against else measure_m - track.begin_m[element]
            nearest_m[sample] = near.distance_m[pairs][nearer]
            leg[sample] = number
            at_m[sample] = entry_m + along_m
            survey_m[sample] = near.survey_sigma_m[pairs][nearer]
        on_way = np.flatnonzero(leg >= 0)
        samples = np.arange(count)
        leg = leg[on_way[np.maximum(np.searchsorted(on_way, samples, side="right") - 1, 0)]]
        routes = tuple(chain.route(self.network, self.numbers) for chain in legs)
        root_m = np.hypot(self.sigma_m[part.begin : part.end + 1], survey_m)
        return ReferencePath(leg, np.interp(samples, on_way, at_m[on_way]), routes, nearest_m, root_m)


def _legs(stays: Sequence[ElementStay], network: Network) -> tuple[list[Chain], list[tuple[int, float]]]:
    """The way as chains of one coordinate, and of each visit its chain and where it is entered [m].

    A new chain begins where the train, having turned, takes another branch than that which it came from.
    """
    chains = [Chain((stays[0].oriented,), (0.0,))]
    placed = [(0, 0.0)]
    here = 0
    for stay in stays[1:]:
        chain = chains[-1]
        last = chain.oriented[here]
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
