"""Where a train may have left the survey: behind an open end that goes on, or over a switch that the survey lacks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.stages.reference.samples import Samples
from pipeline.stages.track.geodesy import steps_m
from pipeline.stages.track.network import Network
from pipeline.stages.track.survey import end_places
from schemas.arrays import NS_PER_S, Bools, Ints
from schemas.config import Configuration, HazardConfig

# Numerics: the train may have come along an element if half of so many samples before lie on it.
_SAMPLES = 50


def off_the_survey(samples: Samples, network: Network, config: HazardConfig) -> Bools:
    """Samples behind an open end over which the train may have gone, where another track is near.

    Up to `open_end_m` from that end, or until the samples lie beside the element again.
    """
    count = samples.t_ns.size
    near = samples.near
    off = np.zeros(count, dtype=np.bool_)
    ends = end_places(network.track)
    possible = near.distance_m <= config.evidence_factor * samples.root_m
    tracks = np.bincount(near.step, minlength=count)
    for element, end in _open_ends(network, np.unique(near.element)):
        rows = near.of(element, 0, count)
        sample = near.step[rows]
        behind = near.past[rows] == 2 * end - 1
        other_near = tracks > np.bincount(sample, minlength=tracks.size)
        for first, sense in _left(sample, behind, possible[rows]):
            back = np.linalg.norm(samples.points.surface - ends[element, end], axis=1) > config.open_end_m
            back[sample[~behind]] = True
            # In the sense in which the train left, all samples until it may be back.
            onward = slice(first, None, sense)
            off[onward] |= ~np.logical_or.accumulate(back[onward]) & other_near[onward]
    return off


def _open_ends(network: Network, elements: Ints) -> Iterator[tuple[int, int]]:
    """Elements and which of their ends no relation leads on from."""
    linked = network.linked_ends()[elements]
    for row, end in np.argwhere(~linked).tolist():
        yield int(elements[row]), int(end)


def _left(sample: Ints, behind: Bools, possible: Bools) -> Iterator[tuple[int, int]]:
    """Samples at which the train leaves the element over its end, and in which sense of time (+1, -1)."""
    for number in np.flatnonzero(behind[1:] & ~behind[:-1]).tolist():
        if np.median(possible[max(number + 1 - _SAMPLES, 0) : number + 1]) >= 0.5:
            yield int(sample[number + 1]), 1
    for number in np.flatnonzero(behind[:-1] & ~behind[1:]).tolist():
        if np.median(possible[number + 1 : number + 1 + _SAMPLES]) >= 0.5:
            yield int(sample[number]), -1


def leaving(samples: Samples, on_track: Bools, config: Configuration) -> Bools:
    """Samples beside a track on which the train may not be any more, or not yet: they border on samples on no track.

    It left over a switch that the survey lacks, so from the last sample within `paths_back_sigmas` roots of a track on,
    and for no longer than `reference_leaves_m`: by then the longest switches have led aside. `on_track`: samples that
    lie on some track, by all that a root may be off.
    """
    near = samples.near
    roots = np.full(samples.t_ns.size, np.inf)
    np.minimum.at(roots, near.step, near.distance_m / samples.root_m)
    aside = roots > config.matching.paths_back_sigmas
    gap = np.diff(samples.t_ns) > config.hazards.reference_gap_s * NS_PER_S
    way_m = np.concatenate([[0.0], np.cumsum(steps_m(samples.points.surface))])
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
            and abs(way_m[row] - way_m[off]) <= config.hazards.reference_leaves_m
        ):
            unsure[row] = True
            row += sense
    return unsure
