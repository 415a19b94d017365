"""Where a movement of equal size has led positions back that had left every path (TRACKS 10).

The nearest track would not do: a fault across the tracks, or a siding that the survey lacks, leads beside another one.
So the path refuted last is carried on, and the positions have to have moved back to where they lay beside it, by more
than noise and survey explain, and to stay there.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.paths.candidates import Candidates
from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.paths.path_tests import PathTests
from pipeline.stages.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen

# Numerics: lines over the switches passed on the way that are looked at; on more of them no way back is seen.
_LINES = 24


@frozen
class Left:
    """A path that was refuted: its last oriented element, at which step, its mean residual before the movement [m] and
    the survey's sigma there [m].
    """

    oriented: int
    died: int
    before_m: float
    survey_m: float


@frozen
class WayBack:
    """The steps of a run, and where they may lie on the network."""

    steps: PathSteps
    network: Network
    candidates: Candidates
    tests: PathTests
    config: MatchingConfig

    def after(self, left: Left) -> int:
        """The first step by which a movement has led back, the number of steps where none has."""
        window = max(1, round(self.config.paths_level_s / float(self.steps.period_s[left.died])))
        if len(self.steps) - left.died < window:
            return len(self.steps)
        behind, ahead = (self._without_choice(side) for side in (left.oriented ^ 1, left.oriented))
        straight_m = self._windows_m({*ahead, *_turned(behind)}, left, window)
        back = [*self._on_one_line(straight_m, left).tolist(), *self._over_switches(left, window)]
        return int(left.died + min(back) + window) if back else len(self.steps)

    def _on_one_line(self, windows_m: Floats, left: Left) -> Ints:
        """Windows by which the positions have moved back on a line without a choice."""
        means_m = windows_m.mean(axis=1)
        farthest_m = np.fmax(np.fmax.accumulate(means_m) - means_m, means_m - np.fmin.accumulate(means_m))
        # Out of reach for a whole window it was farther away than any measured offset.
        farthest_m[np.logical_or.accumulate(np.isnan(windows_m).all(axis=1))] = np.inf
        stays = self._stays(means_m, left, windows_m.shape[1])
        return np.flatnonzero(stays & (farthest_m > self._moved_m(left, means_m.size)))

    def _over_switches(self, left: Left, window: int) -> Iterator[int]:
        """Windows by which they have moved back on a line beyond a switch.

        Behind it a branch moves aside as well as positions do: what counts is a movement beside all tracks within
        reach at once, which keep their distances from one another meanwhile.
        """
        lines = self._lines(left)
        if len(lines) < 2:
            return
        means_m = np.array([self._windows_m(line, left, window).mean(axis=1) for line in lines])
        moved_m = self._moved_m(left, means_m.shape[1])
        root_m = self._root_m(left, means_m.shape[1])
        for own_m in means_m:
            stays = self._stays(own_m, left, window)
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

    def _stays(self, means_m: Floats, left: Left, window: int) -> Bools:
        """It lies where it lay before for as long again: what only passes on its way to somewhere else does not."""
        near = np.abs(means_m) <= self.config.paths_back_sigmas * self._root_m(left, means_m.size)
        stays: Bools = np.convolve(near, np.ones(window + 1))[: near.size] > window
        return stays

    def _root_m(self, left: Left, size: int) -> Floats:
        return np.hypot(self.steps.sigma_m[-size:], left.survey_m)

    def _moved_m(self, left: Left, size: int) -> Floats:
        return self.tests.moved_m(self.steps.sigma_m[-size:], np.full(size, left.survey_m))

    def _windows_m(self, line: set[int], left: Left, window: int) -> Floats:
        """Windows of the offset from a line less that before the movement, by the step that each begins with.

        NaN where the line is not within reach.
        """
        count = len(self.steps)
        nearest_m = np.full(count, np.inf)
        beside_m = np.full(count, np.nan)
        for one in line:
            rows = self.candidates.of(one // 2, left.died, count)
            rows = rows[self.candidates.beyond_m[rows] <= self.config.paths_end_m]
            rows = rows[self.candidates.distance_m[rows] < nearest_m[self.candidates.step[rows]]]
            step = self.candidates.step[rows]
            nearest_m[step] = self.candidates.distance_m[rows]
            beside_m[step] = self.candidates.offset_m[rows] * (1.0 - 2.0 * (one % 2))
        return np.asarray(sliding_window_view(beside_m[left.died :], window) - left.before_m)

    def _lines(self, left: Left) -> list[set[int]]:
        """The line with every choice at the switches ahead, and with every one behind; none beyond what is near."""
        behind, ahead = (self._without_choice(side) for side in (left.oriented ^ 1, left.oriented))
        onward = [{*line, *_turned(behind)} for line in self._choices(left.oriented, left.died)]
        return onward + [{*ahead, *_turned(line)} for line in self._choices(left.oriented ^ 1, left.died)]

    def _choices(self, oriented: int, died: int) -> list[list[int]]:
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

    def _without_choice(self, oriented: int) -> list[int]:
        """An oriented element and those after it, up to the first switch that leaves a choice, or an open end."""
        line = [oriented]
        while len(onward := self.network.successors[line[-1]]) == 1 and onward[0].to not in line:
            line.append(onward[0].to)
        return line


def _turned(line: list[int]) -> list[int]:
    return [one ^ 1 for one in line]
