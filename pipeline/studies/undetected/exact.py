"""The largest error and its profile as a linear program over a whole window, solved exactly (HiGHS).

Unknowns of each row: y (what the bank would have observed), the averages, the fault. Thresholds are bounds, recursions
are equations, and every quantity is counted in its own bound, so that tolerances are shares of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.studies.undetected.watched import Watched
from schemas.arrays import Floats, Ints
from schemas.errors import BaliseError
from schemas.frozen import frozen

if TYPE_CHECKING:
    from scipy import sparse

_TOLERANCE = 1e-9
# A profile keeps by this share within its thresholds, so that rounding does not carry it over them; a bound that is so
# near is reached.
MARGIN = 1e-6


@frozen
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

    program = _linear_program(window, margin)
    goal = np.zeros(program.low.size)
    goal[program.fault[-1]] = -1.0
    solution = linprog(
        goal,
        A_eq=program.equations,
        b_eq=program.right,
        A_ub=program.relinks,
        b_ub=program.relink_bounds,
        bounds=np.column_stack([program.low, program.high]),
        method="highs-ds",
        options={"primal_feasibility_tolerance": _TOLERANCE, "dual_feasibility_tolerance": _TOLERANCE},
    )
    if solution.status != 0:
        raise BaliseError("the linear program of the largest error has no solution", found=str(solution.message))
    fault = np.concatenate([[0.0], solution.x[program.fault]])
    return Optimum(float(fault[-1]), fault, _binding_bounds(window, program, solution.x))


class _Program(NamedTuple):
    """The linear program of one window; unknowns stand row by row: y, averages, fault, unobserved growth.

    `fault`: the places of the fault; `relinks`: fault at a re-link minus fault at its anchor, with both signs.
    """

    equations: sparse.csr_matrix
    right: Floats
    relinks: sparse.csr_matrix | None
    relink_bounds: Floats | None
    low: Floats
    high: Floats
    fault: Ints


def _linear_program(window: Watched, margin: float) -> _Program:
    """The linear program of one window.

    Equations: A_i - (1-w) A_(i-1) - w y_i = 0 for each average, and f_i - f_(i-1) - gain (y_i - u_i) - unobserved_i =
    0.
    """
    from scipy import sparse

    count = window.count - 1
    averages = window.weight.shape[1]
    observed = ~window.fresh[1:]
    unit = sparse.identity(count)
    scale = np.maximum(np.maximum(np.abs(window.most_mps), np.abs(window.least_mps)), 1e-9)[1:]
    limits = np.where(np.isfinite(window.threshold_mps), window.threshold_mps, 1e6) * (1.0 - margin)
    # Blocks of the matrix: an equation each, over y, each average, the fault and the unobserved growth.
    blocks: list[list[sparse.spmatrix | None]] = []
    right: list[Floats] = []
    for average in range(averages):
        limit = limits[:, average]
        weight = np.where(observed, window.weight[1:, average], 0.0)
        keep = np.where(observed, 1.0 - window.weight[1:, average], 0.0)
        carried = sparse.diags(keep[1:] * limit[1:-1] / limit[2:], -1, shape=(count, count))
        row: list[sparse.spmatrix | None] = [None] * (averages + 3)
        row[0] = sparse.diags(-weight * scale / limit[1:])
        row[1 + average] = unit - carried
        blocks.append(row)
        begin = np.zeros(count)
        begin[0] = keep[0] * window.average_mps[0, average] / limit[1]
        right.append(begin)
    gain_s = np.where(observed, -window.gain_s[1:], 0.0)
    grown = unit - sparse.diags(np.ones(count - 1), -1, shape=(count, count))
    blocks.append([sparse.diags(gain_s * scale), *[None] * averages, grown, -unit])
    right.append(gain_s * window.rate_mps[1:])
    order = np.arange((averages + 3) * count).reshape(-1, count).T.ravel()
    relinks, relink_bounds = _relink_rows(window, averages + 1)
    inside = 1.0 - margin
    most = (window.learned_m + np.where(window.fresh, window.fastest_m, 0.0))[1:]
    ones = [np.ones(count)] * averages
    low, high = (
        np.array(
            [
                np.where(observed, inside * raw_mps[1:] / scale, 0.0),
                *(side * unit for unit in ones),
                fault_m[1:],
                grown_m,
            ]
        )
        for side, raw_mps, fault_m, grown_m in (
            (-1.0, window.least_mps, window.low_m, -most),
            (1.0, window.most_mps, window.high_m, most),
        )
    )
    return _Program(
        equations=sparse.bmat(blocks, format="csc")[:, order].tocsr(),
        right=np.concatenate(right),
        relinks=None if relinks is None else relinks[:, order].tocsr(),
        relink_bounds=relink_bounds,
        low=low.T.ravel(),
        high=high.T.ravel(),
        fault=np.arange(count) * (averages + 3) + averages + 1,
    )


def _relink_rows(window: Watched, before: int) -> tuple[sparse.csc_matrix | None, Floats | None]:
    """Fault at a re-link minus fault at its anchor within the recorded bounds; before the window it is zero.

    `before`: how many unknowns of each row stand before the fault; one stands after it.
    """
    from scipy import sparse

    rows = np.flatnonzero(np.isfinite(window.held_high_m))
    rows = rows[rows > 0]
    if not rows.size:
        return None, None
    # The first row, at which there is no fault yet, has no unknown.
    faults = sparse.identity(window.count, format="csr")[:, 1:]
    difference = faults[rows] - faults[np.maximum(window.anchor[rows], 0)]
    empty = [sparse.csr_matrix((rows.size, parts * (window.count - 1))) for parts in (before, 1)]
    difference = sparse.hstack([empty[0], difference, empty[1]])
    return (
        sparse.vstack([difference, -difference], format="csc"),
        np.concatenate([window.held_high_m[rows], -window.held_low_m[rows]]),
    )


def _binding_bounds(window: Watched, program: _Program, solution: Floats) -> tuple[int, ...]:
    """Which bounds the profile reaches, by how many rows do."""
    low = program.low
    high = program.high
    averages = window.weight.shape[1]
    margin = MARGIN * np.maximum(1.0, np.abs(np.where(np.isfinite(low) & np.isfinite(high), high, 1.0)))
    reached = ((solution >= high - margin) | (solution <= low + margin)).reshape(window.count - 1, -1)
    counts = {which: int((reached[:, which] & ~window.fresh[1:]).sum()) for which in range(averages + 1)}
    counts[-1] = int(reached[:, averages + 1].sum())
    return tuple(sorted((which for which, rows in counts.items() if rows), key=lambda which: -counts[which]))
