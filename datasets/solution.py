"""The weighted least squares position of a receiver, linear in its range errors, and SBAS protection levels.

Satellites are so far away that a position error of metres leaves the lines of sight as they are: errors of
ranges become errors of position and residuals by one matrix per epoch (DO-229 appendix J).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

# DO-229 J.1: horizontal factor for precision approach and for non-precision approach, vertical factor.
K_H_PA = 6.0
K_H_NPA = 6.18
K_V = 5.33


@frozen
class PositionSolution:
    """Per epoch: error east, north, up [m], its covariance, residuals [m] (NaN: not in view), used, and solved."""

    error_m: Floats
    covariance_m2: Floats
    residual_m: Floats
    used: Bools
    solved: Bools


@frozen
class ProtectionLevels:
    """DO-229 J.1 [m]; horizontal for precision approach (PA) and for non-precision approach (NPA)."""

    hpl_pa_m: Floats
    hpl_npa_m: Floats
    vpl_m: Floats


def protection_levels(covariance_m2: Floats) -> ProtectionLevels:
    """Protection levels from the covariance D of east, north, up, shape (..., 3, 3), of the overbounded ranges.

    HPL = K_H d_major, d_major^2 = (d_E^2 + d_N^2)/2 + sqrt(((d_E^2 - d_N^2)/2)^2 + d_EN^2), VPL = K_V d_U.
    """
    east = covariance_m2[..., 0, 0]
    north = covariance_m2[..., 1, 1]
    mixed = covariance_m2[..., 0, 1]
    major = np.sqrt((east + north) / 2.0 + np.hypot((east - north) / 2.0, mixed))
    return ProtectionLevels(K_H_PA * major, K_H_NPA * major, K_V * np.sqrt(covariance_m2[..., 2, 2]))


def design_rows(svs: Sequence[str], azimuth_deg: Floats, elevation_deg: Floats) -> Floats:
    """G of DO-229 J.2.2: line of sight and one clock per constellation, shape (..., satellites, 3 + clocks)."""
    sight = line_of_sight_rows(azimuth_deg, elevation_deg)
    clocks = clock_columns(svs)
    return np.concatenate([sight, np.broadcast_to(clocks, (*sight.shape[:-1], clocks.shape[1]))], axis=-1)


def least_squares(design: Floats, sigma_m: Floats) -> tuple[Floats, Floats]:
    """D = (G'WG)^-1 and S = D G'W, which turns range errors into errors of position and clocks."""
    weighted = np.swapaxes(design, -1, -2) / np.square(sigma_m)[..., None, :]
    covariance = np.asarray(np.linalg.inv(weighted @ design), dtype=np.float64)
    gain: Floats = covariance @ weighted
    return covariance, gain


def solve_positions(
    svs: Sequence[str],
    azimuth_deg: Floats,
    elevation_deg: Floats,
    sigma_m: Floats,
    range_error_m: Floats,
    usable: Bools,
    visible: Bools,
) -> PositionSolution:
    """Positions of all epochs, arrays of shape (epochs, satellites).

    An epoch is solved when its usable satellites are at least as many as the unknowns; visible satellites that
    are not used get residuals too, where their constellation has a clock in the solution.
    """
    epochs = usable.shape[0]
    error = np.full((epochs, 3), np.nan)
    covariance = np.full((epochs, 3, 3), np.nan)
    residual = np.full(usable.shape, np.nan)
    solved = np.zeros(epochs, dtype=np.bool_)
    patterns, of_epoch = _satellite_patterns(usable, visible)
    for number, first in enumerate(patterns):
        taken = np.flatnonzero(usable[first])
        shown = np.flatnonzero(visible[first])
        names = [svs[int(i)] for i in taken]
        systems = {sv[:1] for sv in names}
        if taken.size < 3 + len(systems):
            continue
        rows = np.flatnonzero(of_epoch == number)
        used = np.ix_(rows, taken)
        design = design_rows(names, azimuth_deg[used], elevation_deg[used])
        variance, gain = least_squares(design, sigma_m[used])
        state = np.einsum("tij,tj->ti", gain, range_error_m[used])
        tracked = shown[[svs[int(i)][:1] in systems for i in shown]]
        cells = np.ix_(rows, tracked)
        all_rows = design_rows([svs[int(i)] for i in tracked], azimuth_deg[cells], elevation_deg[cells])
        residual[cells] = range_error_m[cells] - np.einsum("tij,tj->ti", all_rows, state)
        error[rows] = state[:, :3]
        covariance[rows] = variance[:, :3, :3]
        solved[rows] = True
    return PositionSolution(error, covariance, residual, usable & solved[:, None], solved)


def _satellite_patterns(usable: Bools, visible: Bools) -> tuple[Ints, Ints]:
    """Epochs that differ in which satellites they have: the first epoch of each kind, and the kind of every epoch."""
    packed = np.packbits(np.concatenate([usable, visible], axis=1), axis=1)
    # As bytes they are compared at once; as rows of an array it takes longer than all the positions.
    kinds = packed.view(f"S{packed.shape[1]}").ravel()
    _, firsts, of_epoch = np.unique(kinds, return_index=True, return_inverse=True)
    return firsts, of_epoch
