"""The tracks that a reference may have run along: a set without a favourite (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.paths.candidates import Candidates, SegmentSearch, candidates_of, search_about, segments_of
from pipeline.stages.paths.growth import path_set
from pipeline.stages.paths.path_steps import path_steps
from pipeline.stages.reference.routes import ElementStay, unrefuted_routes
from pipeline.stages.track.geodesy import Points, place_distances_m, points_of
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import Chain, RoutePath, move_along
from pipeline.stages.track.segments import box_about
from pipeline.stages.track.survey import end_places
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.frozen import frozen


@frozen
class ReferencePath:
    """One route that the samples of a stretch may have taken: per sample its leg and the coordinate on it [m].

    `aside_m`: distance of the sample from the track; `root_m`: sigma of that, of sample and survey together.
    """

    leg: Ints
    at_m: Floats
    legs: tuple[RoutePath, ...]
    aside_m: Floats
    root_m: Floats

    def some_rows(self, rows: slice) -> ReferencePath:
        """The same path, of some samples only."""
        arrays = {name: getattr(self, name)[rows] for name in ("leg", "at_m", "aside_m", "root_m")}
        return replace(self, **arrays)


@frozen
class ReferenceStretch:
    """Reference samples from gap to gap, and every route that they may have taken: the train was on one of them."""

    t_ns: Ints
    sigma_m: Floats
    paths: tuple[ReferencePath, ...]


def reference_stretches(
    reference: pl.DataFrame | None, network: Network, numbers: dict[str, int], config: Configuration
) -> tuple[list[ReferenceStretch], list[tuple[int, int]]]:
    """Stretches of the reference with every route that it may have taken.

    An element is in the set if a navigable route through the whole stretch runs over it that the samples do not refute:
    the set of `paths` with the reference's own sigma and level, and no bias.

    Args:
        reference: the stream `reference` in order of time, or None.
        network: with elements that turn round in pieces (`network_in_pieces`).
        numbers: net elements by name, as the caller counts them.
        config: the configuration; used are `hazards` (sigmas, gap), `matching` and `align`.

    Returns:
        The stretches, and the spans (begin, end) at which samples exist but lie on no track [ns].

    Source:
        DOMAIN section 5.1.
    """
    if reference is None or reference.is_empty():
        return [], []
    hazards = config.hazards
    samples = reference_samples(reference, network, config)
    # A sample beyond k_T roots of every track is no sample of the track.
    placed = samples.near_track(config.align.sure_sigmas)
    near = placed & ~may_have_left(samples, placed, config) & ~may_be_off_survey(samples, network, hazards)
    search = _RouteSearch(samples, network.unsearched(), numbers, config)
    stretches: list[ReferenceStretch] = []
    covered = np.zeros(samples.t_ns.size, dtype=np.bool_)
    for rows in _split_at_gaps(samples.t_ns, np.flatnonzero(near), hazards.reference_gap_s):
        rows, paths = search.find_paths(rows)
        if paths:
            part = slice(int(rows[0]), int(rows[-1]) + 1)
            stretches.append(ReferenceStretch(samples.t_ns[part], samples.sigma_m[part], paths))
            covered[part] = True
    return stretches, _spans_off_track(samples.t_ns, covered, hazards.reference_gap_s)


def _split_at_gaps(t_ns: Ints, rows: Ints, gap_s: float) -> list[Ints]:
    """Samples without a pause or a lost sample among them."""
    if rows.size == 0:
        return []
    broken = (np.diff(t_ns[rows]) > gap_s * NS_PER_S) | (np.diff(rows) > 1)
    return np.split(rows, np.flatnonzero(broken) + 1)


def _spans_off_track(t_ns: Ints, covered: Bools, gap_s: float) -> list[tuple[int, int]]:
    """Times next to samples that lie on no track, up to the next one that does: nobody knows where the train was."""
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


@frozen
class _RouteSearch:
    """The samples of a run, and where they may lie on the network."""

    samples: ReferenceSamples
    network: Network
    numbers: dict[str, int]
    config: Configuration

    def find_paths(self, rows: Ints) -> tuple[Ints, tuple[ReferencePath, ...]]:
        """Samples of `rows`, a stretch without a gap, that routes run through, and all these routes.

        No routes where they are more than `routes_limit`, or all are refuted; where a movement led back from aside,
        those through the samples after it.
        """
        hazards = self.config.hazards
        law = self.config.matching.model_copy(
            update={
                "cross_bias_sigma_m": 0.0,
                "paths_alpha": hazards.reference_alpha,
                "survey_sigma_default_m": hazards.survey_sigma_m,
            }
        )
        samples = self.samples
        steps = path_steps(samples.t_ns[rows], samples.points.take(rows), samples.sigma_m[rows])
        found = path_set(steps, self.network, law, samples.search)
        begins = rows[0] + np.searchsorted(samples.t_ns[rows], steps.begin_ns)
        ends = np.append(begins[1:], rows[-1] + 1)
        first, routes = unrefuted_routes(found, law, hazards.routes_limit)
        begins, ends = begins[first:], ends[first:]
        return rows[int(begins[0] - rows[0]) :], tuple(self._path_on_route(stays, begins, ends) for stays in routes)

    def _path_on_route(self, stays: Sequence[ElementStay], begins: Ints, ends: Ints) -> ReferencePath:
        """A route with coordinates: each sample on the nearest of the elements that it visits about then.

        `begins`, `ends`: of each step the first sample, and that after its last.
        """
        samples = self.samples
        near = samples.near
        begin = int(begins[0])
        count = int(ends[-1]) - begin
        nearest_m = np.full(count, np.inf)
        at_m = np.full(count, np.nan)
        leg = np.full(count, -1)
        survey_m = np.zeros(count)
        legs, placed = _chains_of_route(stays, self.network)
        for stay, (number, entry_m) in zip(stays, placed, strict=True):
            low = int(begins[max(stay.first - 1, 0)])
            high = int(ends[min(stay.last + 1, ends.size - 1)])
            rows = near.rows_of(stay.oriented // 2, low, high)
            sample = near.step[rows] - begin
            nearer = near.distance_m[rows] < nearest_m[sample]
            sample, rows = sample[nearer], rows[nearer]
            nearest_m[sample] = near.distance_m[rows]
            leg[sample] = number
            at_m[sample] = entry_m + (near.left_m[rows] if stay.oriented % 2 else near.along_m[rows])
            survey_m[sample] = samples.survey_m[rows]
        on_route = np.flatnonzero(leg >= 0)
        every = np.arange(count)
        leg = leg[on_route[np.maximum(np.searchsorted(on_route, every, side="right") - 1, 0)]]
        routes = tuple(chain.as_route(self.network, self.numbers) for chain in legs)
        root_m = np.hypot(samples.sigma_m[begin : begin + count], survey_m)
        return ReferencePath(leg, np.interp(every, on_route, at_m[on_route]), routes, nearest_m, root_m)


def _chains_of_route(stays: Sequence[ElementStay], network: Network) -> tuple[list[Chain], list[tuple[int, float]]]:
    """The route as chains of one coordinate, and of each visit its chain and where it is entered [m]."""
    chains = [Chain((stays[0].oriented,), (0.0,))]
    placed = [(0, 0.0)]
    at = 0
    for stay in stays[1:]:
        at = move_along(chains, network, at, stay.oriented, -1 if stay.back else 1)
        placed.append((len(chains) - 1, chains[-1].entry_m[at - chains[-1].low]))
    return chains, placed


# Numerics: the train may have come along an element if half of so many samples before lie on it.
_SAMPLES = 50


def may_be_off_survey(samples: ReferenceSamples, network: Network, config: HazardConfig) -> Bools:
    """Samples behind an open end over which the train may have gone, where another track is near.

    Up to `open_end_m` from that end, or until the samples lie next to the element again.
    """
    count = samples.t_ns.size
    near = samples.near
    off = np.zeros(count, dtype=np.bool_)
    ends = end_places(network.track)
    possible = near.distance_m <= config.evidence_factor * samples.root_m
    tracks = np.bincount(near.step, minlength=count)
    for element, end in _open_ends(network, np.unique(near.element)):
        rows = near.rows_of(element, 0, count)
        sample = near.step[rows]
        behind = near.past[rows] == 2 * end - 1
        other_near = tracks > np.bincount(sample, minlength=tracks.size)
        for first, sense in _departures(sample, behind, possible[rows]):
            back = np.linalg.norm(samples.points.surface - ends[element, end], axis=1) > config.open_end_m
            back[sample[~behind]] = True
            # In the sense in which the train left, all samples until it may be back.
            onward = slice(first, None, sense)
            off[onward] |= ~np.logical_or.accumulate(back[onward]) & other_near[onward]
    return off


def _open_ends(network: Network, elements: Ints) -> Iterator[tuple[int, int]]:
    """Elements and which of their ends no relation leads on from."""
    linked = network.have_successors()[elements]
    for row, end in np.argwhere(~linked).tolist():
        yield int(elements[row]), int(end)


def _departures(sample: Ints, behind: Bools, possible: Bools) -> Iterator[tuple[int, int]]:
    """Samples at which the train leaves the element over its end, and in which sense of time (+1, -1)."""
    for number in np.flatnonzero(behind[1:] & ~behind[:-1]).tolist():
        if np.median(possible[max(number + 1 - _SAMPLES, 0) : number + 1]) >= 0.5:
            yield int(sample[number + 1]), 1
    for number in np.flatnonzero(behind[:-1] & ~behind[1:]).tolist():
        if np.median(possible[number + 1 : number + 1 + _SAMPLES]) >= 0.5:
            yield int(sample[number]), -1


def may_have_left(samples: ReferenceSamples, on_track: Bools, config: Configuration) -> Bools:
    """Samples on which the train may have left its track, or not reached it yet; they border on samples on no track.

    It left over a switch that the survey lacks, so from the last sample within `paths_back_sigmas` combined sigmas of a
    track on, and for no longer than `reference_leaves_m`: by then the longest switches have led aside. `on_track`:
    samples that lie on some track, by all that they may be off.
    """
    near = samples.near
    roots = np.full(samples.t_ns.size, np.inf)
    np.minimum.at(roots, near.step, near.distance_m / samples.root_m)
    aside = roots > config.matching.paths_back_sigmas
    gap = np.diff(samples.t_ns) > config.hazards.reference_gap_s * NS_PER_S
    distance_m = np.concatenate([[0.0], np.cumsum(place_distances_m(samples.points.surface))])
    unsure = np.zeros(on_track.size, dtype=np.bool_)
    for off, sense in [
        *((row + 1, -1) for row in np.flatnonzero(on_track[:-1] & ~on_track[1:] & ~gap).tolist()),
        *((row, 1) for row in np.flatnonzero(~on_track[:-1] & on_track[1:] & ~gap).tolist()),
    ]:
        row = off + sense
        while (
            0 <= row < on_track.size
            and on_track[row]
            and aside[row]
            and abs(distance_m[row] - distance_m[off]) <= config.hazards.reference_leaves_m
        ):
            unsure[row] = True
            row += sense
    return unsure


@frozen
class ReferenceSamples:
    """`sigma_m` of each; `near`: places by sample, `survey_m` the survey's sigma at each of these, `root_m` of both.

    `search`: where all that may be near the run is looked for.
    """

    t_ns: Ints
    points: Points
    sigma_m: Floats
    near: Candidates
    survey_m: Floats
    search: SegmentSearch

    @property
    def root_m(self) -> Floats:
        """Sigma of sample and survey together at each place near it [m]."""
        return np.hypot(self.sigma_m[self.near.step], self.survey_m)

    def near_track(self, factor: float) -> Bools:
        """Samples with an element within `factor` combined sigmas of sample and survey."""
        placed = np.zeros(self.t_ns.size, dtype=np.bool_)
        placed[self.near.step[self.near.distance_m <= factor * self.root_m]] = True
        return placed


def reference_samples(reference: pl.DataFrame, network: Network, config: Configuration) -> ReferenceSamples:
    """Samples of a reference stream with the places near them; these up to twice as far off as a sample may be."""
    hazards = config.hazards
    sigma_m = reference["sigma_m"].fill_null(hazards.reference_sigma_m).to_numpy()
    points = points_of(floats(reference, "latitude_deg"), floats(reference, "longitude_deg"))
    factor = 2.0 * config.align.sure_sigmas
    # Long chords are far off their curves: only those count that the run may be near.
    most_m = float(np.hypot(sigma_m, network.largest_survey_sigma_m(hazards.survey_sigma_m)).max())
    segments = segments_of(network.track)
    box = box_about(points.surface, factor * most_m)
    vertex = segments.vertex[box.segments_touching(segments.start, segments.end)]
    survey_m = network.survey_sigmas_m(hazards.survey_sigma_m, vertex).max(initial=hazards.survey_sigma_m)
    reach_m = factor * float(np.hypot(sigma_m, survey_m).max())
    search = search_about(points.surface, network, max(reach_m, config.matching.reach_m))
    near = candidates_of(points, network, search, reach_m)
    near_survey_m = network.survey_sigmas_m(hazards.survey_sigma_m, near.vertex)
    return ReferenceSamples(times_ns(reference), points, sigma_m, near, near_survey_m, search)
