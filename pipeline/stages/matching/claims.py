"""What the set of paths lets a train claim at each epoch, and what hindsight lets it (DOMAIN section 2).

A claim is a confidence, no probability: 0.99 where one track is left of the set, 1 where no other was within reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.paths.path_set import Node, PathSet, unbranched_groups
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints, spans_of
from schemas.config import MatchingConfig
from schemas.stages import ONE_TRACK_LEFT

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


@dataclass(frozen=True)
class Possible:
    """Per step of a second the net elements that no position refutes in hindsight, and the confidence in each.

    `epoch[k]` is the first row of step k; `first[k] : first[k + 1]` are its elements, as numbers of the path's track.
    """

    epoch: Ints
    first: Ints
    element: Ints
    confidence: Floats


@dataclass(frozen=True)
class Claims:
    """Per epoch the confidence in its track: `live`, by what came before, and in `hindsight`; NaN while off.

    `rival`: the element that is hardest to tell from it, -1 where none is left; `possible`: all of them.
    """

    live: Floats
    hindsight: Floats
    rival: Ints
    possible: Possible


@dataclass(frozen=True)
class _Left:
    """Per step what is left of a set: line (-1: none, -2: several), largest p of each line, way to a branch."""

    group: Ints
    rivals: list[dict[int, float]]
    branch_m: Floats


def claims(found: PathSet, t_s: Floats, element: Ints, sigma_m: Floats, config: MatchingConfig) -> Claims:
    """`t_s`: times of the epochs; `element`: net element of the path shown, -1 for none; `sigma_m`: along the track.

    Live an epoch uses the steps that ended before it, and of their rejections those of `paths_delay_s` ago. The set is
    carried to the epoch over every relation that the train may have reached since, confidence interval included.
    """
    steps = found.steps
    count = len(steps)
    if not count:
        nothing = np.full(t_s.size, np.nan)
        none = np.zeros(0, dtype=np.int64)
        return Claims(nothing, nothing, np.full(t_s.size, -1), Possible(none, np.zeros(1, np.int64), none, none * 1.0))
    before = np.searchsorted(steps.end_s, t_s, side="right") - 1
    about = np.clip(np.searchsorted(steps.end_s, t_s, side="left"), 0, count - 1)
    speed_mps = steps.way_m / np.maximum(np.diff(steps.end_s, prepend=steps.begin_s[0]), 1e-3)
    since_s = np.where(before >= 0, t_s - steps.end_s[np.maximum(before, 0)], 0.0)
    carried_m = 1.2 * speed_mps[np.maximum(before, 0)] * since_s + config.paths_border_sigmas * np.nan_to_num(sigma_m)
    group = np.where(element >= 0, found.groups[np.maximum(element, 0)], -1)
    alone = _alone(found)
    living = list(found.living(config.paths_delay_s))
    live = _left(found, living)
    gate = _confidence(live, np.maximum(before, 0), group, carried_m, alone)
    gate[(before < 0) | (before >= found.overflow)] = 0.0
    to_the_end = list(found.to_the_end())
    later = _hindsight(_left(found, to_the_end), about, group, alone)
    rival = _rivals(found, living, to_the_end, group, np.maximum(before, 0), about)
    epoch = np.minimum(np.searchsorted(t_s, steps.begin_s), t_s.size - 1)
    return Claims(gate, later, rival, _possible(found, to_the_end, epoch))


def best_elements(found: PathSet) -> Ints:
    """Per step the net element of the path with the least squared residuals among those that live to the end.

    -1 where no path lives so long: then the positions refute every path of the survey.
    """
    count = len(found.steps)
    elements = np.full(count, -1, dtype=np.int64)
    last = [node for node in found.nodes if node.rejected >= count and node.end >= count]
    if not last:
        return elements
    at: Node | None = min(last, key=lambda node: (float(np.nansum(node.residual_m**2)), node.oriented))
    while at is not None:
        elements[at.begin : at.end] = np.where(elements[at.begin : at.end] < 0, at.element, elements[at.begin : at.end])
        at = at.parent
    return elements


def doubtful_stretches(claimed: Claims, t_ns: Ints, element: Ints, read: Bools, network: Network) -> pl.DataFrame:
    """Stretches where the path is doubtful at the time, or in hindsight; `read`: epochs at which a balise was read."""
    least = np.fmin(np.nan_to_num(claimed.live), np.nan_to_num(claimed.hindsight))
    ids = network.track.ids
    groups = unbranched_groups(network)
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


def _rivals(
    found: PathSet, living: list[list[Node]], to_the_end: list[list[Node]], group: Ints, before: Ints, about: Ints
) -> Ints:
    """Per epoch the element off its line with the largest p, of what is left live or in hindsight; -1 for none."""
    rival = np.full(group.size, -1, dtype=np.int64)
    for row, (line, live, later) in enumerate(zip(group.tolist(), before.tolist(), about.tolist(), strict=True)):
        nodes = [node for node in (*living[live], *to_the_end[later]) if found.groups[node.element] != line]
        if nodes:
            rival[row] = max(nodes, key=lambda node: node.p).element
    return rival


def _possible(found: PathSet, sets: list[list[Node]], epoch: Ints) -> Possible:
    elements: list[int] = []
    confidences: list[float] = []
    first = [0]
    for nodes in sets:
        lines = {int(found.groups[node.element]) for node in nodes}
        for element in sorted({node.element for node in nodes}):
            elements.append(element)
            confidences.append(ONE_TRACK_LEFT if len(lines) == 1 else MOST_IN_DOUBT / len(lines))
        first.append(len(elements))
    return Possible(epoch, np.array(first), np.array(elements, dtype=np.int64), np.array(confidences))


def _left(found: PathSet, sets: list[list[Node]]) -> _Left:
    """What the sets come to, step by step."""
    beyond_m = branches_beyond_m(found.network)
    group = np.full(len(sets), -1, dtype=np.int64)
    branch_m = np.full(len(sets), np.inf)
    rivals: list[dict[int, float]] = []
    for step, nodes in enumerate(sets):
        here: dict[int, float] = {}
        for node in nodes:
            line = int(found.groups[node.element])
            here[line] = max(here.get(line, 0.0), min(node.p, 1.0))
            row = step - node.begin
            if 0 <= row < len(node.left_m):
                ends_m = node.left_m[row] + beyond_m[[2 * node.element + 1, 2 * node.element]]
                branch_m[step] = min(branch_m[step], float(ends_m.min()))
        rivals.append(here)
        group[step] = -1 if not here else next(iter(here)) if len(here) == 1 else -2
    return _Left(group, rivals, branch_m)


def _confidence(left: _Left, step: Ints, group: Ints, carried_m: Floats, alone: Floats) -> Floats:
    """Of each epoch in its line, with the step that speaks for it."""
    one = (left.group[step] == group) & (group >= 0) & (carried_m < left.branch_m[step])
    confidence = np.where(one, np.where(alone[step] > 0, ALONE, ONE_TRACK_LEFT), np.nan)
    for row in np.flatnonzero(~one & (left.group[step] != -1)).tolist():
        others = [p for line, p in left.rivals[int(step[row])].items() if line != group[row]]
        # Near a branch the rivals are those behind it: nothing is known of them yet.
        confidence[row] = min(MOST_IN_DOUBT, 1.0 - max(others, default=0.5))
    return confidence


def _hindsight(left: _Left, step: Ints, group: Ints, alone: Floats) -> Floats:
    """By paths that live to the end; where one goes over from a line to the next, positions say when."""
    confidence = _confidence(left, step, group, np.zeros(step.size), alone)
    beside = [np.clip(step + by, 0, left.group.size - 1) for by in (-1, 0, 1)]
    one = np.logical_and.reduce([left.group[row] >= 0 for row in beside])
    one &= np.logical_or.reduce([left.group[row] == group for row in beside])
    return np.where(one & (confidence < ONE_TRACK_LEFT), ONE_TRACK_LEFT, confidence)


def _alone(found: PathSet) -> Floats:
    """Steps at which one line alone is within reach."""
    lines = found.groups[found.candidates.element]
    pairs = np.unique(np.column_stack([found.candidates.step, lines]), axis=0)
    return (np.bincount(pairs[:, 0], minlength=len(found.steps)) == 1).astype(np.float64)


def branches_beyond_m(network: Network) -> Floats:
    """Per oriented element the way beyond its exit to the next branch of tracks [m], infinite to an open end."""
    beyond = np.full(2 * network.count, np.nan)
    for start in range(2 * network.count):
        chain: list[int] = []
        oriented = start
        while np.isnan(beyond[oriented]) and oriented not in chain:
            chain.append(oriented)
            onward = network.successors[oriented]
            if len(onward) != 1 or len(network.successors[onward[0].to ^ 1]) != 1:
                beyond[oriented] = 0.0 if len(onward) else np.inf
                break
            oriented = onward[0].to
        if np.isnan(beyond[oriented]):
            beyond[oriented] = np.inf  # a ring without a branch
        for at, ahead in zip(chain[-2::-1], chain[:0:-1], strict=True):
            if np.isnan(beyond[at]):
                beyond[at] = network.length_m(ahead) + beyond[ahead]
        if chain and np.isnan(beyond[chain[-1]]):
            beyond[chain[-1]] = network.length_m(oriented) + beyond[oriented]
    return beyond
