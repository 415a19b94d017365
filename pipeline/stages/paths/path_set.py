"""The set of paths through the network that the positions do not reject (Neyman 1937: a confidence set, no posterior).

Every path goes on until its residuals across the track refute it; a track is claimed where one is left. If the tests
overbound, the true path is rejected in at most alpha per 600 s, in any network, however it is cut (DOMAIN section 2).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.paths.candidates import Candidates
from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.paths.path_tests import NO_STEPS, NO_STRETCH, WINDOWS_S, PathTests, Stretch, Totals
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen


@dataclass
class Node:
    """One hypothesis while it is on one net element, oriented as its path began.

    Covers the steps from `begin` on, before `end`; `rejected`: the step at which its residuals refuted it, a large
    number if none did; `along`, `left_m` (to both ends of the element): of its own steps; `before`: what its whole path
    comes to before `begin`; `p`: least p-value of its tests so far.
    `also`: hypotheses that came to it later, and have been one with it since.
    """

    oriented: int
    begin: int
    stretch: int
    parent: Node | None = None
    before: Totals = NO_STEPS
    p: float = 1.0
    end: int = 0
    rejected: int = 2**62
    barred: int = 2**62
    along: Stretch = NO_STRETCH
    left_m: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    p_by_step: Floats = field(default_factory=lambda: np.ones(1))
    followed: bool = False
    also: list[Node] = field(default_factory=list)

    @property
    def element(self) -> int:
        """The net element, whatever the orientation."""
        return self.oriented // 2

    @property
    def origins(self) -> list[Node]:
        """The hypotheses that it goes on from."""
        return [*([] if self.parent is None else [self.parent]), *self.also]

    def chain_since(self, step: int) -> list[Node]:
        """The hypotheses that its path went through, itself the last, as far back as a step."""
        chain = [self]
        while chain[-1].begin > step and chain[-1].parent is not None:
            chain.append(chain[-1].parent)
        return chain[::-1]

    def residuals_m(self, first: int, last: int) -> Floats:
        """Residuals of its path over the steps from `first` on, before `last` [m]; NaN before its beginning."""
        chain = self.chain_since(first)
        known = np.concatenate([node.along.residual_m for node in chain])
        whole_m = np.full(last - first, np.nan)
        begin = max(chain[0].begin, first)
        if begin >= last:
            return whole_m
        part = known[begin - chain[0].begin : last - chain[0].begin]
        whole_m[begin - first : begin - first + part.size] = part
        return whole_m


class ResidualsBefore:
    """What a new hypothesis is compared by: residuals of its path before it, from where each test may still look."""

    def __init__(self, node: Node, steps: PathSteps) -> None:
        self.node = node
        self._steps = steps

    @cached_property
    def window_begins(self) -> Ints:
        """First step of the longest look back of each window; shape (windows,)."""
        end_s = self._steps.end_s
        return np.asarray(np.searchsorted(end_s, end_s[self.node.begin] - 3.0 * np.array(WINDOWS_S)))

    @cached_property
    def residual_m(self) -> Floats:
        """Residuals over the longest window [m]."""
        return self.node.residuals_m(int(self.window_begins[-1]), self.node.begin)


class LifeSpan(NamedTuple):
    """The steps over which a hypothesis counts, from `begin` on, before `end`; `p`: least p-value by each of them."""

    node: Node
    begin: int
    end: int
    p: Floats


@frozen
class PathSet:
    """All path hypotheses of a run (`nodes`) and at which of the `steps` each began, ended and was refuted.

    `groups`: number of the line without a branch that each net element belongs to.

    `overflow`: step from which on there were more hypotheses than are followed; `unclaimed`: steps after it, and those
    of the first minute of a set that began anew though no movement had led back: its errors may be larger than stated;
    `returned`: steps at which it began anew after such a movement. `last_s`: where a stretch ends off the network,
    those refuted in its last seconds are equal.
    """

    nodes: tuple[Node, ...]
    steps: PathSteps
    groups: Ints
    network: Network
    candidates: Candidates
    unclaimed: Bools
    returned: tuple[int, ...]
    overflow: int
    last_s: float

    def living(self, delay_s: float) -> list[LifeSpan]:
        """Each hypothesis over the steps at which no test of steps up to `delay_s` later [s] had refuted it."""
        known = np.searchsorted(self.steps.end_s, self.steps.end_s - delay_s, side="right") - 1
        spans = []
        for node in self.nodes:
            end = min(node.end, node.barred, int(np.searchsorted(known, node.rejected)))
            if end > node.begin:
                tested = known[node.begin : end] + 1 - node.begin
                tested = np.minimum(np.maximum(tested, 0), node.p_by_step.size - 1)
                spans.append(LifeSpan(node, node.begin, end, node.p_by_step[tested]))
        return spans

    def survivors(self) -> list[Node]:
        """Hypotheses that live to the last step.

        Of a stretch that ends off the network, those refuted in its last minute.
        """
        count = len(self.steps)
        found: list[Node] = []
        for stretch in {node.stretch for node in self.nodes}:
            nodes = [node for node in self.nodes if node.stretch == stretch]
            alive = [node for node in nodes if node.rejected >= count and node.end >= count]
            refuted = [node for node in nodes if node.rejected < count]
            if not alive and refuted:
                latest_s = self.steps.end_s[max(node.rejected for node in refuted)]
                alive = [node for node in refuted if self.steps.end_s[node.rejected] >= latest_s - self.last_s]
            found += alive
        return found

    def surviving_spans(self) -> list[LifeSpan]:
        """The hypotheses that live to the end of their stretch, or through one that does, with its p-value there."""
        lives: dict[int, tuple[Node, float]] = {}
        waiting = [(node, min(node.p, 1.0)) for node in self.survivors()]
        while waiting:
            node, p = waiting.pop()
            if id(node) not in lives or lives[id(node)][1] < p:
                lives[id(node)] = node, p
                waiting += [(origin, p) for origin in node.origins]
        ends = [(node, min(node.end, node.rejected), p) for node, p in lives.values()]
        return [
            LifeSpan(node, node.begin, end, np.full(end - node.begin, p)) for node, end, p in ends if end > node.begin
        ]

    def elements_by_step(self, delay_s: float | None = None) -> list[dict[int, float]]:
        """Net elements of each step that no rejection rules out, with the largest p-value of a path over each.

        In hindsight, or by what was known `delay_s` before the end of each step. Empty: off the network.
        """
        found: list[dict[int, float]] = [{} for _ in range(len(self.steps))]
        for node, begin, end, p in self.surviving_spans() if delay_s is None else self.living(delay_s):
            for best, value in zip(found[begin:end], p.tolist(), strict=True):
                best[node.element] = max(best.get(node.element, 0.0), value)
        return found


# Numerics: lines over the switches passed meanwhile that are looked at; on more of them no return is found.
_LINES = 24


@frozen
class RefutedPath:
    """A path that was refuted: its last oriented element, and the step at which (`died`).

    `before_m`: mean residual before the movement [m]; `survey_m`: the survey's sigma there [m].
    """

    oriented: int
    died: int
    before_m: float
    survey_m: float


@frozen
class ReturnSearch:
    """The search for a return of positions that left the network: the steps of a run, and where they may lie."""

    steps: PathSteps
    network: Network
    candidates: Candidates
    tests: PathTests
    config: MatchingConfig

    def first_return(self, left: RefutedPath) -> int:
        """The first step by which a movement has led back to a refuted path, the number of steps where none has."""
        window = max(1, round(self.config.paths_level_s / float(self.steps.period_s[left.died])))
        if len(self.steps) - left.died < window:
            return len(self.steps)
        behind, ahead = (self._line_to_switch(side) for side in (left.oriented ^ 1, left.oriented))
        straight_m = self._windows_m({*ahead, *_reversed(behind)}, left, window)
        back = [*self._returns_on_line(straight_m, left).tolist(), *self._returns_over_switches(left, window)]
        return int(left.died + min(back) + window) if back else len(self.steps)

    def _returns_on_line(self, windows_m: Floats, left: RefutedPath) -> Ints:
        """Windows by which the positions have moved back on a line without a choice; `windows_m` as `_windows_m`."""
        means_m = windows_m.mean(axis=1)
        farthest_m = np.fmax(np.fmax.accumulate(means_m) - means_m, means_m - np.fmin.accumulate(means_m))
        # Out of reach for a whole window it was farther away than any measured offset.
        farthest_m[np.logical_or.accumulate(np.isnan(windows_m).all(axis=1))] = np.inf
        stays = self._stay_back(means_m, left, windows_m.shape[1])
        return np.flatnonzero(stays & (farthest_m > self._movement_limit_m(left, means_m.size)))

    def _returns_over_switches(self, left: RefutedPath, window: int) -> Iterator[int]:
        """Windows by which the positions have moved back on a line beyond a switch.

        Behind it a branch moves aside as well as positions do: what counts is a movement relative to all tracks within
        reach at once, which keep their distances from one another meanwhile.
        """
        lines = self._possible_lines(left)
        if len(lines) < 2:
            return
        means_m = np.array([self._windows_m(line, left, window).mean(axis=1) for line in lines])
        moved_m = self._movement_limit_m(left, means_m.shape[1])
        root_m = self._position_sigma_m(left, means_m.shape[1])
        for own_m in means_m:
            stays = self._stay_back(own_m, left, window)
            for at in np.flatnonzero(stays & ~np.concatenate([[False], stays[:-1]])).tolist():
                apart_m = means_m[:, : at + 1] - own_m[: at + 1]
                known = np.isfinite(apart_m)
                with np.errstate(invalid="ignore"):
                    kept = ~known[:, -1:] | (np.abs(apart_m - apart_m[:, -1:]) <= root_m[at])
                parallel = (kept & (known == known[:, -1:])).all(axis=0)
                begin = int(np.flatnonzero(np.append(True, ~parallel))[-1])
                part_m = own_m[begin : at + 1]
                if part_m.size and np.abs(part_m - own_m[at]).max() > moved_m[at]:
                    yield at
                    break

    def _stay_back(self, means_m: Floats, left: RefutedPath, window: int) -> Bools:
        """Windows that lie where the path lay, for as long again.

        What only passes on towards somewhere else does not.
        """
        near = np.abs(means_m) <= self.config.paths_back_sigmas * self._position_sigma_m(left, means_m.size)
        stays: Bools = np.convolve(near, np.ones(window + 1))[: near.size] > window
        return stays

    def _position_sigma_m(self, left: RefutedPath, size: int) -> Floats:
        """Sigma of position and survey together at the last `size` steps [m]."""
        return np.hypot(self.steps.sigma_m[-size:], left.survey_m)

    def _movement_limit_m(self, left: RefutedPath, size: int) -> Floats:
        """Limit beyond which two means a while apart differ on no path, at the last `size` steps [m]."""
        return self.tests.movement_limit_m(self.steps.sigma_m[-size:], np.full(size, left.survey_m))

    def _windows_m(self, line: set[int], left: RefutedPath, window: int) -> Floats:
        """Offsets from a line, less that before the movement, over `window` steps each; shape (windows, window) [m].

        NaN where the line is not within reach.
        """
        count = len(self.steps)
        nearest_m = np.full(count, np.inf)
        offset_m = np.full(count, np.nan)
        for one in line:
            rows = self.candidates.rows_of(one // 2, left.died, count)
            rows = rows[self.candidates.beyond_m[rows] <= self.config.paths_end_m]
            rows = rows[self.candidates.distance_m[rows] < nearest_m[self.candidates.step[rows]]]
            step = self.candidates.step[rows]
            nearest_m[step] = self.candidates.distance_m[rows]
            offset_m[step] = self.candidates.offset_m[rows] * (1.0 - 2.0 * (one % 2))
        return np.asarray(sliding_window_view(offset_m[left.died :], window) - left.before_m)

    def _possible_lines(self, left: RefutedPath) -> list[set[int]]:
        """The line with every choice at the switches ahead, and with every one behind; none beyond what is near."""
        behind, ahead = (self._line_to_switch(side) for side in (left.oriented ^ 1, left.oriented))
        onward = [{*line, *_reversed(behind)} for line in self._chains_onward(left.oriented, left.died)]
        return onward + [{*ahead, *_reversed(line)} for line in self._chains_onward(left.oriented ^ 1, left.died)]

    def _chains_onward(self, oriented: int, died: int) -> list[list[int]]:
        """Chains of net elements from one on, over elements near the steps since a path died."""
        near = set(np.unique(self.candidates.element[self.candidates.first[died] :]).tolist())
        lines: list[list[int]] = []
        waiting = [[oriented]]
        while waiting and len(lines) < _LINES:
            line = waiting.pop()
            onward = [edge.to for edge in self.network.successors[line[-1]] if edge.to // 2 in near]
            further = [[*line, to] for to in onward if to not in line]
            waiting += further
            if not further:
                lines.append(line)
        return lines

    def _line_to_switch(self, oriented: int) -> list[int]:
        """An oriented element and those after it, up to the first switch that leaves a choice, or an open end."""
        line = [oriented]
        while len(onward := self.network.successors[line[-1]]) == 1 and onward[0].to not in line:
            line.append(onward[0].to)
        return line


def _reversed(line: list[int]) -> list[int]:
    """The same chain, run in the opposite direction."""
    return [one ^ 1 for one in line]
