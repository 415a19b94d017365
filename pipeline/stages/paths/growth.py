"""How a set of paths grows with the positions: branches that they do not reject, and those that they do."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.stages.paths.candidates import Candidates, SegmentSearch, candidates_of, search_about
from pipeline.stages.paths.path_set import Node, PathSet, RefutedPath, ResidualsBefore, ReturnSearch
from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.paths.path_tests import LOOKED_S, WINDOWS_S, PathTests, Stretch, Totals, Trail
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Numerics: means that are rounded stay below a limit where their terms do by so much.
_SURELY_ALIKE = 1.0 - 1e-9


def path_set(
    steps: PathSteps, network: Network, config: MatchingConfig, search: SegmentSearch | None = None
) -> PathSet:
    """Every path that begins near the first positions and goes on over navigable relations, until it is refuted.

    Args:
        steps: positions of a solution or of a reference, as `path_steps` makes them.
        network: with elements that turn round in pieces (`network_in_pieces`), as `Node.element` counts them.
        config: bias and level of these positions, in the section `matching` of the configuration.
        search: the places within reach, where many stretches share them; None: looked for here.

    Returns:
        The set, whose `living` gives the paths of each step by what was known then, `surviving_spans` in
        hindsight, both with the least p-value of each path, and `elements_by_step` the same by net element.
        Empty without a position near the network.

    Source:
        DOMAIN section 2, rules 1 to 7 (Neyman 1937).
    """
    search = search or search_about(steps.points.surface, network, config.reach_m)
    candidates = candidates_of(steps.points, network, search, config.reach_m)
    survey_m = network.survey_sigmas_m(config.survey_sigma_default_m, candidates.vertex)
    groups = network.line_of_element
    # Until another track has come near there is nothing to tell apart.
    lines = groups[candidates.element]
    others = candidates.step[lines != lines[:1]]
    alone = int(others[0]) if others.size else len(steps)
    tests = PathTests.of_run(steps, alone, config)
    return _Growth(steps, network, tests, candidates, survey_m, groups, config).grow_all()


@dataclass
class _Growth:
    """The paths of a run while they grow; those that begin first are followed first."""

    steps: PathSteps
    network: Network
    tests: PathTests
    candidates: Candidates
    survey_m: Floats
    groups: Ints
    config: MatchingConfig

    def __post_init__(self) -> None:
        self._gap = np.concatenate([[False], np.diff(self.steps.end_s) > self.config.paths_gap_s])
        self._queue: list[tuple[int, int, Node]] = []
        self._made: list[Node] = []
        self._begun_s: deque[float] = deque()
        self._by_element: dict[int, list[Node]] = {}
        self._unclaimed = np.zeros(len(self.steps), dtype=np.bool_)
        self._returned: list[int] = []

    def grow_all(self) -> PathSet:
        """Follow the hypothesis that begins first until none is left; begin anew where all are refuted.

        The set of all.
        """
        count = len(self.steps)
        overflow = count
        start = self._next_first_step(0)
        while start < count:
            first = len(self._made)
            self._begin_paths(start)
            while self._queue:
                _, _, node = heapq.heappop(self._queue)
                if self._exceeds_limit(node):
                    overflow = min(overflow, node.begin)
                    self._queue.clear()
                    break
                for child in self._follow_element(node):
                    self._enqueue(child)
            start = count if overflow < count else self._restart_step(self._made[first:])
        self._unclaimed[overflow:] = True
        return PathSet(
            tuple(self._made),
            self.steps,
            self.groups,
            self.network,
            self.candidates,
            self._unclaimed,
            tuple(self._returned),
            overflow,
            self.config.paths_anew_s,
        )

    def _exceeds_limit(self, node: Node) -> bool:
        """Whether more hypotheses have begun in the last ten minutes than are followed."""
        now_s = float(self.steps.end_s[node.begin])
        self._begun_s.append(now_s)
        while self._begun_s[0] < now_s - LOOKED_S:
            self._begun_s.popleft()
        return len(self._begun_s) > self.config.paths_limit

    def _restart_step(self, nodes: list[Node]) -> int:
        """The step at which the set begins anew once all are refuted: at once in the first minute, else the return.

        The number of steps where one of them lives to the end, or nothing leads back.
        """
        count = len(self.steps)
        if any(node.rejected >= count and node.end >= count for node in nodes):
            return count
        refuted = [node for node in nodes if node.rejected < count]
        if not refuted:
            return count
        last = max(refuted, key=lambda node: node.rejected)
        died = last.rejected
        if self.steps.end_s[died] - self.steps.begin_s[self._made[0].begin] <= self.config.paths_anew_s:
            begin = self._next_first_step(died + 1)
            since_s = self.steps.end_s - self.steps.end_s[min(begin, count - 1)]
            self._unclaimed |= (since_s >= 0.0) & (since_s < self.config.paths_anew_s)
            return begin
        self._returned.append(self._next_first_step(self._return_step(last, died)))
        return self._returned[-1]

    def _return_step(self, node: Node, died: int) -> int:
        """The first step after a rejection by which a movement has led back to the path refuted last
        (`ReturnSearch`).
        """
        steps = self.steps
        ends_s = steps.end_s[died] - self.config.paths_level_s * np.array([3.0, 1.0])
        first, last = np.searchsorted(steps.end_s, ends_s, side="right")
        residual_m = node.residuals_m(int(first), int(last))
        before = np.isfinite(residual_m) & steps.counted[first:last]
        if not before.any():
            return len(steps)
        left = RefutedPath(
            node.oriented, died, float(np.mean(residual_m[before])), float(np.median(node.along.survey_m))
        )
        return ReturnSearch(steps, self.network, self.candidates, self.tests, self.config).first_return(left)

    def _next_first_step(self, step: int) -> int:
        """The first step from this one on at which a path may begin, else the number of steps."""
        after = self._first_steps[np.searchsorted(self._first_steps, step) :]
        return int(after[0]) if after.size else len(self.steps)

    @cached_property
    def _may_begin_at(self) -> Bools:
        """Candidates that a path may begin with: as near as the test of the offset allows."""
        candidates = self.candidates
        limit_m = self.tests.offset_limit_m(self.steps.sigma_m[candidates.step], self.survey_m, self._track_spacing_m)
        near: Bools = (np.abs(candidates.offset_m) <= limit_m) & (
            self._are_on_element(np.arange(len(candidates.step))) | (candidates.beyond_m <= self.config.paths_end_m)
        )
        return near

    def _stretch_at(self, oriented: int, rows: Ints) -> Stretch:
        """The stretch of an oriented element at its candidates."""
        candidates = self.candidates
        turned = oriented % 2
        return Stretch(
            (1.0 - 2.0 * turned) * candidates.offset_m[rows],
            self.survey_m[rows],
            self._distances_aside_m[turned][rows],
            self._distances_aside_m[1 - turned][rows],
            candidates.heading_rad[rows] + np.pi * turned,
        )

    @cached_property
    def _track_spacing_m(self) -> Floats:
        """Distance from each candidate to the nearest track on the side of the position [m], 0 without one."""
        return np.where(self.candidates.offset_m > 0.0, *self._distances_aside_m)

    @cached_property
    def _distances_aside_m(self) -> tuple[Floats, Floats]:
        """Distance of the nearest other track to the left and right of each candidate, in its sense [m], 0 without one.

        The tracks of a step in the order in which they lie side by side, but for those that end before it.
        """
        candidates = self.candidates
        # Of tracks that run in the other direction the offset has the other sign.
        first = candidates.first[:-1][candidates.step]
        turned = np.cos(candidates.heading_rad - candidates.heading_rad[first]) < 0.0
        aside_m = np.where(turned, -candidates.offset_m, candidates.offset_m)
        rows = np.flatnonzero(candidates.past == 0)
        rows = rows[np.lexsort((aside_m[rows], candidates.step[rows]))]
        # Two that lie in one place are two all the same.
        apart_m = np.maximum(np.diff(aside_m[rows]), 1e-3) * (np.diff(candidates.step[rows]) == 0)
        sides_m = np.zeros((2, candidates.step.size))
        # The farther left a track lies, the smaller is the position's offset left of it.
        sides_m[0, rows[1:]], sides_m[1, rows[:-1]] = apart_m, apart_m
        return np.where(turned, sides_m[1], sides_m[0]), np.where(turned, sides_m[0], sides_m[1])

    @cached_property
    def _first_steps(self) -> Ints:
        """Steps at which a path may begin."""
        return np.unique(self.candidates.step[self._may_begin_at])

    def _begin_paths(self, step: int) -> None:
        """Queue a hypothesis on every element near a step."""
        rows = np.arange(int(self.candidates.first[step]), int(self.candidates.first[step + 1]))
        for row in rows[self._may_begin_at[rows]].tolist():
            self._enqueue(Node(2 * int(self.candidates.element[row]), step, stretch=step))

    def _enqueue(self, node: Node) -> None:
        """Queue a new hypothesis, unless it is like one on the same element: then that one stands for both."""
        same = self._by_element.setdefault(node.oriented, [])
        before = ResidualsBefore(node, self.steps)
        for other in same:
            covers = other.begin <= node.begin and (not other.followed or other.end > node.begin)
            if covers and other.rejected >= node.rejected and self._are_alike(other, before):
                # Their tests cannot differ by more than the bounds allow for (rule 8).
                other.p = max(other.p, node.p)
                later = other.p_by_step[1 + node.begin - other.begin :]
                np.maximum(later, node.p, out=later)
                if node.parent is not None:
                    other.also.append(node.parent)
                return
        same.append(node)
        self._made.append(node)
        heapq.heappush(self._queue, (node.begin, len(self._made), node))

    def _are_alike(self, one: Node, new: ResidualsBefore) -> bool:
        """Whether no test can tell two paths to one element apart by more than it allows for, whatever comes (rule 8).

        Their means agree over every window that a later test may still look at, and over their whole length.
        """
        other = new.node
        last, alike_m = other.begin, self.config.paths_alike_m
        first = int(new.window_begins[-1])
        one_m, other_m = one.residuals_m(first, last), new.residual_m
        if (np.isfinite(one_m) != np.isfinite(other_m)).any():
            return False
        apart_m = np.where(self.steps.counted[first:last], np.nan_to_num(one_m - other_m), 0.0)
        for window_s, begin in zip(WINDOWS_S, new.window_begins.tolist(), strict=True):
            part_m = apart_m[begin - first :]
            # No mean is larger than the largest difference: most pairs need none.
            doubtful = np.abs(part_m).max(initial=0.0) > _SURELY_ALIKE * alike_m
            if doubtful and self.tests.largest_window_mean_m(self.steps, part_m, last, window_s) > alike_m:
                return False
        own = self.tests.sum_steps(self.steps, one.begin, one.along.first_steps(last - one.begin))
        sums = one.before.residual_m + own.residual_m, other.before.residual_m
        return abs(sums[0] - sums[1]) <= alike_m * max(one.before.number + own.number, 1.0)

    def _follow_element(self, node: Node) -> list[Node]:
        """Follow a hypothesis along its element until it leaves it or is refuted for long.

        The hypotheses it goes on as.
        """
        candidates = self.candidates
        count = len(self.steps)
        rows = candidates.rows_of(node.element, node.begin, count)
        step = candidates.step[rows]
        # Steps without a pause or a candidate missing among them, and inside the element.
        run = np.arange(node.begin, node.begin + rows.size) == step
        run &= ~self._gap[np.minimum(step, count - 1)] | (step == node.begin)
        inside = self._are_on_element(rows)
        # Not yet on it, by the noise along the track or of an offset at a bend: it came in over that end.
        near = inside | (candidates.beyond_m[rows] <= self.config.paths_end_m)
        late = np.logical_and.accumulate(near) & ~np.logical_or.accumulate(inside)
        run &= inside | late
        stays = int(rows.size if run.all() else np.argmin(run))
        rows = rows[:stays]
        node.followed = True
        node.end = node.begin + stays
        if stays:
            node.along = self._stretch_at(node.oriented, rows)
            node.left_m = np.column_stack([candidates.along_m[rows], candidates.left_m[rows]])
            node.barred = min(node.barred, self._contradicted_step(node))
            node.rejected = min(node.rejected, node.barred)
            verdict = self.tests.test_trail(self.steps, self._trail_of(node))
            node.p_by_step = np.minimum(node.p, np.concatenate([np.ones(1), verdict.p]))
            node.p = float(node.p_by_step[-1])
            node.rejected = min(node.rejected, verdict.rejected)
        if node.rejected < count:
            # Refuted: live it counts for as long as that is not known yet.
            known = int(np.searchsorted(self.steps.end_s, self.steps.end_s[node.rejected] + self.config.paths_delay_s))
            node.end = min(node.end, known + 1)
            if node.end <= known and node.end < count:
                return self._next_hypotheses(node)
            return []
        return self._next_hypotheses(node) if node.end < count else []

    def _trail_of(self, node: Node) -> Trail:
        """The path of a hypothesis as far back as any test looks."""
        end_s = self.steps.end_s
        chain = node.chain_since(int(np.searchsorted(end_s, end_s[node.begin] - self.tests.longest_s)))
        along = Stretch.joined_parts([one.along for one in chain])
        return Trail(node.stretch, chain[0].begin, node.begin, along, node.before)

    def _contradicted_step(self, node: Node) -> int:
        """The first step of the node at which a balise was read on an element that the train cannot have come from."""
        for step in (node.begin + np.flatnonzero(self.steps.read_element[node.begin : node.end] >= 0)).tolist():
            # A read belongs to the step after it: in the meantime the train went on.
            limit_m = (1.0 + self.config.detour_share) * float(self.steps.distance_m[step]) + self.config.paths_end_m
            if not self._is_within_reach(node.element, int(self.steps.read_element[step]), limit_m):
                return int(step)
        return 2**62

    def _is_within_reach(self, one: int, other: int, limit_m: float) -> bool:
        """Whether two elements are the same, or no more than `limit_m` apart along the network."""
        reached = (
            self.network.within_reach(2 * one + side, limit_m).get(2 * other + to) for side in (0, 1) for to in (0, 1)
        )
        return one == other or any(reach is not None and reach.distance_m <= limit_m for reach in reached)

    def _are_on_element(self, rows: Ints) -> Bools:
        """Candidates that lie on their element; past an open end as far as the noise may lead."""
        candidates = self.candidates
        past = candidates.past[rows]
        linked = np.where(past < 0, candidates.linked_start[rows], candidates.linked_end[rows])
        sigma_m = np.hypot(self.steps.sigma_m[candidates.step[rows]], self.survey_m[rows])
        near = candidates.beyond_m[rows] <= self.config.paths_along_sigmas * sigma_m + self.config.paths_end_m
        inside: Bools = (past == 0) | (~linked & near)
        return inside

    def _next_hypotheses(self, node: Node) -> list[Node]:
        """The hypotheses that a path goes on as, at the first step that is not on its element any more."""
        step = node.end
        if step >= len(self.steps):
            return []
        candidates = self.candidates
        rows = np.arange(int(candidates.first[step]), int(candidates.first[step + 1]))
        inside = rows[self._are_on_element(rows) | (candidates.beyond_m[rows] <= self.config.paths_end_m)]
        limit_m = (1.0 + self.config.detour_share) * float(self.steps.distance_m[step]) + self.config.detour_m
        reached: dict[int, int] = {}
        for leaving in (node.oriented, node.oriented ^ 1):
            for to, reach in self.network.within_reach(leaving, limit_m).items():
                allowed = min(reach.barred_forward, reach.barred_backward) == 0
                if allowed and reach.distance_m <= limit_m:
                    reached.setdefault(to // 2, to if leaving == node.oriented else to ^ 1)
        children = [
            self._child_of(node, reached[int(candidates.element[row])], step)
            for row in inside.tolist()
            if int(candidates.element[row]) in reached and int(candidates.element[row]) != node.element
        ]
        own = [row for row in rows.tolist() if int(candidates.element[row]) == node.element]
        if own and (not children or self._are_on_element(np.array(own))[0]):
            # Between two elements, or over a pause on the same one: it stays.
            children.append(self._child_of(node, node.oriented, step))
        return self._without_idle_child(node, children, step)

    def _without_idle_child(self, node: Node, children: list[Node], step: int) -> list[Node]:
        """The next hypotheses; where the only one stays on the element past its end, the path itself waits there.

        It would be asked again at every step.
        """
        candidates = self.candidates
        if not children:
            node.rejected = min(node.rejected, step)
            return []
        if len(children) == 1 and children[0].oriented == node.oriented:
            rows = np.arange(int(candidates.first[step]), int(candidates.first[step + 1]))
            (row,) = rows[candidates.element[rows] == node.element][:1].tolist()
            sigma_m = float(np.hypot(self.steps.sigma_m[step], self.survey_m[row]))
            if candidates.beyond_m[row] > self.config.paths_along_sigmas * sigma_m + self.config.paths_end_m:
                node.rejected = min(node.rejected, step)
                return []
            child = children[0]
            if not self._are_on_element(np.array([row]))[0]:
                own = self._stretch_at(node.oriented, np.array([row]))
                # It leaves the bias where it was.
                own = own._replace(
                    heading_rad=node.along.heading_rad[-1:] if node.along.heading_rad.size else np.zeros(1)
                )
                node.along = Stretch.joined_parts([node.along, own])
                node.p_by_step = np.append(node.p_by_step, node.p)
                node.left_m = np.vstack([node.left_m, [candidates.along_m[row], candidates.left_m[row]]])
                node.end = step + 1
                child = self._child_of(node, node.oriented, step + 1)
                return [child] if child.begin < len(self.steps) else []
        return children

    def _child_of(self, node: Node, oriented: int, step: int) -> Node:
        """The hypothesis on the next element from a step on, with the sums of its whole path before it."""
        own = self.tests.sum_steps(self.steps, node.begin, node.along)
        before = Totals(*(one + other for one, other in zip(node.before, own, strict=True)))
        child = Node(oriented, step, node.stretch, node, before, node.p)
        child.rejected, child.barred = node.rejected, node.barred
        return child
