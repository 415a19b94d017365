"""Which net elements lie near which samples, and where on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.network import Network
from pipeline.stages.track.segments import SAMPLE_SPACING_M, Polyline, box_about, on_segments
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Bools, Floats, Ints

# Numerics: so near an end a foot lies at it [m].
AT_END_M = 1e-6


@dataclass(frozen=True)
class Foot:
    """The nearest place of one sample on one net element; `end`: 0 or 1 where it is that end of it, else None."""

    element: int
    distance_m: float
    measure_m: float
    end: int | None


@dataclass(frozen=True)
class Near:
    """Pairs of sample and net element, by element and within it in order of samples: nearest places within reach."""

    sample: Ints
    element: Ints
    distance_m: Floats
    measure_m: Floats
    survey_sigma_m: Floats
    first: Ints
    any_near: Bools
    track: SurveyedTrack

    def placed(self, factor: float, sigma_m: Floats) -> Bools:
        """Samples with an element within `factor` roots."""
        close = self.distance_m <= factor * np.hypot(sigma_m[self.sample], self.survey_sigma_m)
        placed = np.zeros(self.any_near.size, dtype=np.bool_)
        placed[self.sample[close]] = True
        return placed

    def of(self, element: int, begin: int, end: int) -> slice:
        """The pairs of an element with samples from `begin` to `end`."""
        of_element = slice(int(self.first[element]), int(self.first[element + 1]))
        low, high = np.searchsorted(self.sample[of_element], [begin, end + 1]).tolist()
        return slice(of_element.start + low, of_element.start + high)

    def feet(self, samples: Ints) -> list[list[Foot]]:
        """All feet of some samples, in their order."""
        position = np.full(self.any_near.size, -1)
        position[samples] = np.arange(samples.size)
        feet: list[list[Foot]] = [[] for _ in range(samples.size)]
        for pair in np.flatnonzero(position[self.sample] >= 0).tolist():
            element = int(self.element[pair])
            measure_m = float(self.measure_m[pair])
            ends = (abs(measure_m - self.track.begin_m[element]), abs(measure_m - self.track.end_m[element]))
            end = int(np.argmin(ends)) if min(ends) < AT_END_M else None
            foot = Foot(element, float(self.distance_m[pair]), measure_m, end)
            feet[position[self.sample[pair]]].append(foot)
        return feet


def near_elements(points: Points, sigma_m: Floats, network: Network, factor: float, unstated_m: float) -> Near:
    """Each net element with each sample nearer than `factor` x sqrt(sample sigma^2 + survey sigma^2).

    `unstated_m`: the survey's sigma where it states none.
    """
    track = network.track
    element_of = np.repeat(np.arange(len(track.ids)), np.diff(track.first))
    surface = track.surface
    starts = np.flatnonzero(element_of[1:] == element_of[:-1])
    if len(points):
        # Chords are looked at only where the run may be near, however far aside they might lie.
        most_m = float(np.hypot(sigma_m, network.most_survey_sigma_m(unstated_m)).max())
        box = box_about(points.surface, factor * most_m)
        starts = starts[box.touched_by(surface[starts], surface[starts + 1])]
    survey_sigma_m = network.survey_sigmas_m(unstated_m, starts)
    reach_m = factor * np.hypot(sigma_m, survey_sigma_m.max(initial=0.0))
    line = Polyline(surface[starts], surface[starts + 1])
    sample, segment = _candidates(points, line, reach_m)
    feet = on_segments(points.take(sample), line, segment)
    fraction = np.clip(feet.fraction, 0.0, 1.0)
    low_m = track.measure_m[starts[segment]]
    high_m = track.measure_m[starts[segment] + 1]
    within = feet.distance_m <= factor * np.hypot(sigma_m[sample], survey_sigma_m[segment])
    element = element_of[starts[segment]]
    order = np.lexsort((feet.distance_m, sample, element))
    order = order[within[order]]
    # Several segments of an element lie near a sample; in this order the first of each pair is the nearest.
    nearest = np.ones(order.size, dtype=np.bool_)
    nearest[1:] = (np.diff(element[order]) != 0) | (np.diff(sample[order]) != 0)
    pairs = order[nearest]
    any_near = np.zeros(len(points), dtype=np.bool_)
    any_near[sample[pairs]] = True
    return Near(
        sample=sample[pairs],
        element=element[pairs],
        distance_m=feet.distance_m[pairs],
        measure_m=(low_m + fraction * (high_m - low_m))[pairs],
        survey_sigma_m=survey_sigma_m[segment][pairs],
        first=np.searchsorted(element[pairs], np.arange(len(track.ids) + 1)),
        any_near=any_near,
        track=track,
    )


def _candidates(points: Points, line: Polyline, reach_m: Floats) -> tuple[Ints, Ints]:
    """Pairs of sample and segment that may be within reach: each once."""
    if len(points) == 0 or len(line) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    tree, segment_of = line.samples
    hits = tree.query_ball_point(points.surface, reach_m + 0.5 * SAMPLE_SPACING_M)
    sample = np.repeat(np.arange(len(points)), [len(hit) for hit in hits])
    segment = segment_of[np.concatenate([np.asarray(hit, dtype=np.int64) for hit in hits])]
    pairs = np.unique(sample * len(line) + segment)
    return pairs // len(line), pairs % len(line)
