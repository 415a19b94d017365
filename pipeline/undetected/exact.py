"""The largest error and its profile as a linear program over a whole window, solved exactly (HiGHS).

Unknowns of each row: y (what the bank would have seen), the averages, the fault. Thresholds are bounds, recursions are
equations, and every quantity is counted in its own bound, so that tolerances are shares of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.undetected.watched import Watched
from schemas.arrays import Floats, Ints
from schemas.errors import BaliseError

if TYPE_CHECKING:
    from scipy import sparse

_TOLERANCE = 1e-9
# A profile keeps by this share within its thresholds, so that rounding does not carry it over them; a bound that is so
# near is reached.
MARGIN = 1e-6


@dataclass(frozen=True)
class Optimum:
    """The largest error at the last row of a window [m], the fault at each of its rows, and the monitors it reaches.

    `fault_m` (rows,): zero at the first. `binding`: raw (0), averages (1, 2, ...), -1 a test of the position itself;
    by how many rows reach them, most first.
    """

    error_m: float
    fault_m: Floats
    binding: tuple[int, ...]


def largest_profile(window: Watched, margin: float = 0.0) -> Optimum:
    """The profile with the largest error ahead at the last row of a fault that began after the first.

    `margin`: every threshold smaller by this share. Raises `BaliseError` where the solver finds none: no fault is a
    profile, so that is a defect.
    """
    from scipy.optimize import linprog  # only who asks for a profile solves the whole

    program = _Program(window, margin)
    goal = np.zeros(program.width)
    goal[program.fault(program.window.rows - 1)] = -1.0
    found = linprog(
        goal,
        A_eq=program.equations,
        b_eq=program.right,
        A_ub=program.relinks,
        b_ub=program.relink_bounds,
        bounds=np.column_stack([program.low, program.high]),
        method="highs-ds",
        options={"primal_feasibility_tolerance": _TOLERANCE, "dual_feasibility_tolerance": _TOLERANCE},
    )
    if found.status != 0:
        raise BaliseError("the linear program of the largest error has no solution", found=str(found.message))
    fault = np.concatenate([[0.0], found.x[program.fault(np.arange(1, program.window.rows))]])
    return Optimum(float(fault[-1]), fault, program.binding(found.x))


class _Program:
    """The linear program of one window; unknowns stand row by row: y, averages, fault, unseen growth."""

    def __init__(self, window: Watched, margin: float) -> None:
        self.window = window
        self._averages = window.weight.shape[1]
        self._per_row = self._averages + 3
        self.width = self._per_row * (window.rows - 1)
        self._scale = np.maximum(np.maximum(np.abs(window.most_mps), np.abs(window.least_mps)), 1e-9)
        self._limits = np.where(np.isfinite(window.threshold_mps), window.threshold_mps, 1e6) * (1.0 - margin)
        self._margin = margin
        self.low, self.high = self._bounds()
        self.equations, self.right = self._recursions()
        self.relinks, self.relink_bounds = self._relinks()

    def _at(self, row: Ints | int, which: int) -> Ints:
        place: Ints = (np.asarray(row) - 1) * self._per_row + which
        return place

    def fault(self, row: Ints | int) -> Ints:
        return self._at(row, self._averages + 1)

    def _bounds(self) -> tuple[Floats, Floats]:
        window, part = self.window, slice(1, None)
        most = window.learned_m + np.where(window.fresh, window.fastest_m, 0.0)
        inside = 1.0 - self._margin
        watched = (~window.fresh)[part]
        columns_low = [np.where(watched, inside * window.least_mps[part] / self._scale[part], 0.0)]
        columns_high = [np.where(watched, inside * window.most_mps[part] / self._scale[part], 0.0)]
        for _ in range(self._averages):
            columns_low.append(np.full(window.rows - 1, -1.0))
            columns_high.append(np.full(window.rows - 1, 1.0))
        columns_low += [window.low_m[part], -most[part]]
        columns_high += [window.high_m[part], most[part]]
        return np.column_stack(columns_low).ravel(), np.column_stack(columns_high).ravel()

    def _recursions(self) -> tuple[sparse.csr_matrix, Floats]:
        """A_i - (1-w) A_(i-1) - w y_i = 0 for each average, and f_i - f_(i-1) - way (y_i - u_i) - unseen_i = 0."""
        window, rows = self.window, np.arange(1, self.window.rows)
        seen = ~window.fresh[rows]
        entries, right = [], []
        count = rows.size
        for average in range(self._averages):
            here = average * count + np.arange(count)
            limit = self._limits[:, average]
            weight = np.where(seen, window.weight[rows, average], 0.0)
            keep = np.where(seen, 1.0 - window.weight[rows, average], 0.0)
            entries.append((here, self._at(rows, 1 + average), np.ones(count)))
            entries.append((here, self._at(rows, 0), -weight * self._scale[rows] / limit[rows]))
            carried = keep[1:] * limit[rows[:-1]] / limit[rows[1:]]
            entries.append((here[1:], self._at(rows[:-1], 1 + average), -carried))
            begin = np.zeros(count)
            begin[0] = keep[0] * window.average_mps[0, average] / limit[rows[0]]
            right.append(begin)
        here = self._averages * count + np.arange(count)
        entries.append((here, self.fault(rows), np.ones(count)))
        entries.append((here[1:], self.fault(rows[:-1]), -np.ones(count - 1)))
        entries.append((here, self._at(rows, 0), np.where(seen, -window.way_s[rows] * self._scale[rows], 0.0)))
        entries.append((here, self._at(rows, self._averages + 2), -np.ones(count)))
        right.append(np.where(seen, -window.way_s[rows] * window.rate_mps[rows], 0.0))
        return self._matrix(entries, (self._averages + 1) * count), np.concatenate(right)

    def _relinks(self) -> tuple[sparse.csr_matrix | None, Floats | None]:
        """Fault at a re-link minus fault at its anchor within the recorded bounds; before the window it is zero."""
        window = self.window
        rows = np.flatnonzero(np.isfinite(window.held_high_m))
        rows = rows[rows > 0]
        if not rows.size:
            return None, None
        anchored = np.flatnonzero(window.anchor[rows] > 0)
        here = np.arange(rows.size)
        entries = [(here, self.fault(rows), np.ones(rows.size))]
        entries.append((anchored, self.fault(window.anchor[rows][anchored]), -np.ones(anchored.size)))
        difference = self._matrix(entries, rows.size)
        bounds = np.concatenate([window.held_high_m[rows], -window.held_low_m[rows]])
        from scipy import sparse

        return sparse.vstack([difference, -difference]).tocsr(), bounds

    def _matrix(self, entries: list[tuple[Ints, Ints, Floats]], height: int) -> sparse.csr_matrix:
        from scipy import sparse

        row, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_matrix((value, (row, column)), shape=(height, self.width))

    def binding(self, solution: Floats) -> tuple[int, ...]:
        """Which bounds the profile reaches, by how many rows do."""
        inside = np.isfinite(self.low) & np.isfinite(self.high)
        margin = MARGIN * np.maximum(1.0, np.abs(np.where(inside, self.high, 1.0)))
        reached = (solution >= self.high - margin) | (solution <= self.low + margin)
        rows = reached.reshape(-1, self._per_row)
        watched = ~self.window.fresh[1:]
        counts = {which: int((rows[:, which] & watched).sum()) for which in range(self._averages + 1)}
        counts[-1] = int(rows[:, self._averages + 1].sum())
        return tuple(sorted((which for which, rows in counts.items() if rows), key=lambda which: -counts[which]))
