"""Where each step may have been on the network, and what it costs to say so."""

from __future__ import annotations

import numpy as np

from pipeline.stages.paths.candidates import Candidates, overtaken
from pipeline.stages.paths.path_set import PathSet
from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen


@frozen
class PathStates:
    """Oriented elements in order of step; `first[k] : first[k + 1]` are those of the step `step[k]` of the set.

    `place_m`: from the entry of the oriented element; `cost`: square of the residual over its sigma, limited;
    `refuted`: the whole run refutes every path over it then.
    """

    step: Ints
    first: Ints
    oriented: Ints
    place_m: Floats
    cost: Floats
    refuted: Bools


def path_states(found: PathSet, height_m: Floats, sigma_up_m: Floats, config: MatchingConfig) -> PathStates:
    """All places within reach, of steps with one at least.

    `height_m`, `sigma_up_m`: of each step over the survey's zero, NaN where unknown. All elements at a step are weighed
    by one sigma, else a coarse survey would win. Where the set knows where the train may have been, every other place
    costs as much as a position that no error explains.
    """
    steps, network = found.steps, found.network
    candidates = found.candidates.take(np.flatnonzero(~overtaken(found.candidates, network)), len(steps))
    kept = np.diff(candidates.first) > 0
    variance_m2 = (config.cross_bias_sigma_m**2 + steps.sigma_m**2)[candidates.step]
    most = config.outlier_sigmas**2
    cost = np.minimum(candidates.distance_m**2 / variance_m2, most)
    refuted = _refuted(found, candidates)
    cost = np.where(refuted, most, cost + _height_costs(candidates, height_m, sigma_up_m, config))
    candidates = candidates.renumbered(kept)
    both = np.column_stack([2 * candidates.element, 2 * candidates.element + 1])
    index = np.flatnonzero(network.usable[both].ravel())
    oriented = both.ravel()[index]
    row = index // 2
    backward = oriented % 2 == 1
    return PathStates(
        step=np.flatnonzero(kept),
        first=np.searchsorted(candidates.step[row], np.arange(int(kept.sum()) + 1)),
        oriented=oriented,
        place_m=np.where(backward, candidates.left_m[row], candidates.along_m[row]),
        cost=cost[row],
        refuted=refuted[row],
    )


def unbroken(states: PathStates, steps: PathSteps, config: MatchingConfig) -> Bools:
    """Steps that follow the one before at once, with the same states.

    But for one every `break_s` where there are several: a path may break off there.
    """
    count = np.diff(states.first)
    number = np.repeat(np.arange(len(count)), count)
    state = np.arange(len(states.oriented))
    # With equal counts, the same place in the step before is `count` states back.
    before = np.maximum(state - count[number], 0)
    equal = (states.oriented == states.oriented[before]) & (states.refuted == states.refuted[before])
    same = np.logical_and.reduceat(equal, states.first[:-1]) & (np.diff(count, prepend=0) == 0)
    at_once = np.diff(states.step, prepend=-2) == 1
    soon = np.diff(steps.end_s, prepend=-np.inf)[states.step] <= config.paths_gap_s
    spell = np.floor(steps.end_s[states.step] / config.break_s)
    return np.asarray(same & at_once & soon & ((count == 1) | (np.diff(spell, prepend=-1.0) == 0.0)))


def _refuted(found: PathSet, candidates: Candidates) -> Bools:
    """Candidates on an element that the whole run refutes; none where every path is refuted."""
    count = len(found.steps)
    elements = found.network.count
    lives = found.to_the_end()
    # Between two elements a step belongs to either.
    spans = [(node.element, max(begin - 1, 0), min(end + 1, count)) for node, begin, end, _ in lives]
    keys = [np.arange(begin, end) * elements + element for element, begin, end in spans]
    possible = np.unique(np.concatenate([*keys, np.zeros(0, dtype=np.int64)]))
    known = np.zeros(count, dtype=np.bool_)
    for _, begin, end, _ in lives:
        known[begin:end] = True
    step = candidates.step
    return np.asarray(known[step] & ~np.isin(step * elements + candidates.element, possible))


def _height_costs(candidates: Candidates, height_m: Floats, sigma_up_m: Floats, config: MatchingConfig) -> Floats:
    """Of the height over the track, where tracks lie over each other; none without heights.

    Tracks at one level differ by superelevation and errors of the survey, which say nothing of the train.
    """
    track_m = candidates.height_m
    if not np.isfinite(track_m).any():
        return np.zeros(track_m.size)
    begin = candidates.first[:-1][np.diff(candidates.first) > 0]
    of_step = np.repeat(np.arange(begin.size), np.diff(np.append(begin, track_m.size)))
    apart_m = (np.maximum.reduceat(track_m, begin) - np.minimum.reduceat(track_m, begin))[of_step]
    variance_m2 = sigma_up_m[candidates.step] ** 2 + config.height_bias_sigma_m**2
    square = (height_m[candidates.step] - track_m) ** 2 / variance_m2
    counts = (apart_m >= config.clearance_m) & np.isfinite(square)
    return np.where(counts, np.minimum(square, config.outlier_sigmas**2), 0.0)


def polarity_of_parts(network: Network, states: PathStates, counted_m: Floats) -> Ints:
    """Sign of the odometer against each oriented element: +1, -1, or 0 where unknown.

    `counted_m`: per step of the states the way since the step before, signed, NaN where unknown. The sign belongs to
    the installation and holds for the whole run, but the orientation of a connected part of the network is arbitrary:
    so one sign for each part, by the votes of all states that stay on one element for a step. Of the path shown, which
    looks back; the sign that the train counts with is `odometry.polarity`, by the first metres on that path.
    """
    count = len(network.successors)
    if not network.orientable:
        return np.zeros(count, dtype=np.int64)
    part = network.parts
    step = np.repeat(np.arange(len(states.first) - 1), np.diff(states.first))
    # Step and oriented element in one sorted number: the same element a step before is `count` less.
    keys = step * count + states.oriented
    before = np.minimum(np.searchsorted(keys, keys - count), len(keys) - 1)
    stayed = np.flatnonzero((keys[before] == keys - count) & np.isfinite(counted_m[step]))
    moved_m = states.place_m[stayed] - states.place_m[before[stayed]]
    votes = np.sign(moved_m) * counted_m[step[stayed]]
    return np.sign(np.bincount(part[states.oriented[stayed]], votes, part.max() + 1)).astype(np.int64)[part]
