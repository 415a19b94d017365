"""Where a train may have left the survey: behind the open end of a net element that goes on unsurveyed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.stages.reference.near import AT_END_M, Near
from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.network import Network
from pipeline.stages.track.survey import end_places
from schemas.arrays import Bools, Floats, Ints
from schemas.config import HazardConfig

# Numerics: the train may have come along an element if half of so many samples before lie on it.
_SAMPLES = 50


def off_the_survey(points: Points, sigma_m: Floats, near: Near, network: Network, config: HazardConfig) -> Bools:
    """Samples behind an open end over which the train may have gone, where another track is near.

    Up to `open_end_m` from that end, or until the samples lie beside the element again.
    """
    off = np.zeros(len(points), dtype=np.bool_)
    ends = end_places(network.track)
    ends_m = network.track.begin_m, network.track.end_m
    possible = near.distance_m <= config.evidence_factor * np.hypot(sigma_m[near.sample], near.survey_sigma_m)
    tracks = np.bincount(near.sample, minlength=len(points))
    for element, end in np.argwhere(~network.linked_ends()).tolist():
        pairs = near.of(element, 0, len(points))
        sample = near.sample[pairs]
        behind = np.abs(near.measure_m[pairs] - ends_m[end][element]) < AT_END_M
        other_near = tracks > np.bincount(sample, minlength=tracks.size)
        for first, sense in _left(sample, behind, possible[pairs]):
            back = np.linalg.norm(points.surface - ends[element, end], axis=1) > config.open_end_m
            back[sample[~behind]] = True
            # In the sense in which the train left, all samples until it may be back.
            onward = slice(first, None, sense)
            off[onward] |= ~np.logical_or.accumulate(back[onward]) & other_near[onward]
    return off


def _left(sample: Ints, behind: Bools, possible: Bools) -> Iterator[tuple[int, int]]:
    """Samples at which the train leaves the element over its end, and in which sense of time (+1, -1)."""
    for number in np.flatnonzero(behind[1:] & ~behind[:-1]).tolist():
        if np.median(possible[max(number + 1 - _SAMPLES, 0) : number + 1]) >= 0.5:
            yield int(sample[number + 1]), 1
    for number in np.flatnonzero(behind[:-1] & ~behind[1:]).tolist():
        if np.median(possible[number + 1 : number + 1 + _SAMPLES]) >= 0.5:
            yield int(sample[number]), -1
