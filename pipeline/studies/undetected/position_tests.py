"""Bounds of the error itself, by monitors without memory: another solution, and the ranges.

A second solution that carries no fault shows it at once: the difference moves by it. A single range at fault shows in
the residuals: an error b of it moves the position by its gain in the receiver's least squares, and the monitor's
weighted sum of squares becomes SS + 2 c b + d b^2, with c and d of its own equations: below the threshold on an
interval of b.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import Verdicts
from pipeline.stages.monitors.pseudorange import Equations, equations_of, normal_of
from pipeline.stages.monitors.single import paired
from pipeline.studies.undetected.watched import Watched
from schemas.arrays import Floats, floats
from schemas.config import Configuration, LdsConfig
from schemas.stages import MatchedEpochs

# A range that the monitor does not see at all may be wrong by any amount.
_INVISIBLE = 1e-12


def with_channel(
    rows: Watched, epochs: pl.DataFrame, channel: Verdicts, second: pl.DataFrame | None, lds: LdsConfig
) -> Watched:
    """The rows with the bounds of the channel monitor, of a fault that the other solution has not.

    `channel`: of the channel monitor; `second`: the other solution as that took it. Where the other solution has its
    epochs between two of this one, the comparison is with the position in between.
    """
    if second is None:
        return rows
    value, threshold = channel.value[rows.epoch], channel.threshold[rows.epoch]
    before = _shares_before(epochs, second, lds)[rows.epoch]
    moving = before * rows.gain_s
    ahead_m = moving * np.maximum(rows.most_mps - rows.rate_mps, 0.0)
    behind_m = moving * np.maximum(rows.rate_mps - rows.least_mps, 0.0)
    # The position in between is bounded only where the bank saw the step to the epoch.
    observed = ~rows.fresh & (np.diff(rows.epoch, prepend=-1) == 1)
    known = np.isfinite(value) & np.isfinite(threshold) & (observed | (before == 0.0))
    return with_bounds(
        rows,
        np.where(known, -threshold - value - behind_m, -np.inf),
        np.where(known, threshold - value + ahead_m, np.inf),
    )


def with_bounds(rows: Watched, low_m: Floats, high_m: Floats) -> Watched:
    """The rows with the fault held within these bounds too."""
    return replace(rows, low_m=np.maximum(rows.low_m, low_m), high_m=np.minimum(rows.high_m, high_m))


def _shares_before(epochs: pl.DataFrame, second: pl.DataFrame, lds: LdsConfig) -> Floats:
    """How far before the epoch, as a share of the step to it, this solution was compared with the other."""
    placed = pl.when(pl.col("fix_valid") & pl.col("on_track") & pl.col("path_m").is_not_null())
    numbered = epochs.with_row_index("row").select("t", path_m=placed.then(pl.col("row").cast(pl.Float64)))
    pairs = paired(numbered, second.filter("fix_valid", "on_track"), lds)
    place = floats(pairs, "path_m")
    share: Floats = np.nan_to_num(np.arange(place.size) - place)
    return share


def range_bounds(epochs: MatchedEpochs, satellites: pl.DataFrame, config: Configuration) -> tuple[Floats, Floats]:
    """The fault along growing path [m] that the worst range may cause at each epoch: most behind, most ahead.

    Infinite where the monitor is not evaluated. The worst satellite of each epoch: no satellite may do more.
    """
    from scipy.special import chdtri  # most replays have no ranges

    low = np.full(epochs.height, -np.inf)
    high = np.full(epochs.height, np.inf)
    for part in equations_of(epochs, satellites, config):
        tested = part.freedom > 0
        threshold = np.full(part.epoch.size, np.inf)
        threshold[tested] = chdtri(part.freedom[tested], config.monitors.false_alarm_probability)
        low[part.epoch], high[part.epoch] = _worst_satellites_m(part, threshold)
    return low, high


def _worst_satellites_m(part: Equations, threshold: Floats) -> tuple[Floats, Floats]:
    """Least and largest fault [m] over the satellites of each epoch; threshold (epochs,), infinite where not tested."""
    left, linear, square = _residual_parabola(part)
    gain = _gain_along(part)
    room = np.maximum(threshold - left, 0.0)[:, None]
    visible = part.held & (square > _INVISIBLE * part.weight)
    safe = np.where(visible, square, 1.0)
    root = np.sqrt(linear**2 + safe * room)
    reach = np.where(part.held & ~visible, np.inf, 0.0)
    ends = [np.where(visible, (-linear + sign * root) / safe, sign * reach) for sign in (-1.0, 1.0)]
    # A range without any say in the position moves nothing, however wrong.
    moved = np.stack([np.where(np.abs(gain) > _INVISIBLE, gain * end, 0.0) for end in ends])
    low = moved.min(axis=(0, 2))
    high = moved.max(axis=(0, 2))
    untested = ~np.isfinite(threshold)
    return np.where(untested, -np.inf, low), np.where(untested, np.inf, high)


def _residual_parabola(part: Equations) -> tuple[Floats, Floats, Floats]:
    """SS, shape (epochs,), and c and d of each satellite, shape (epochs, satellites), as at the top of this file."""
    weighted = part.design * part.weight[..., None]
    normal = normal_of(part.design, part.weight, part.prior)
    inverse = np.linalg.inv(normal)
    right = np.einsum("eni,en->ei", weighted, part.residual_m)
    fitted = np.einsum("eni,eij,ej->en", part.design, inverse, right)
    # With b added to satellite n the sum of squares is SS + 2 c_n b + d_n b^2; N = A' W A + prior:
    linear = part.weight * (part.residual_m - fitted)
    # c_n = w_n (r_n - (A x)_n) above, d_n = w_n - w_n^2 (A N^-1 A')_nn.
    square = part.weight - np.einsum("eni,eij,enj->en", weighted, inverse, weighted)
    left = np.einsum("en,en->e", linear, part.residual_m)
    return left, linear, np.maximum(square, 0.0)


def _gain_along(part: Equations) -> Floats:
    """How far the position moves along the track per metre of error in each range, by weighted least squares."""
    design = np.concatenate([part.rows, part.clocks], axis=-1)
    absent = ~(part.clocks * part.held[..., None]).any(axis=1)
    prior = np.column_stack([np.zeros((part.epoch.size, 3)), absent.astype(np.float64)])
    inverse = np.linalg.inv(normal_of(design, part.weight, prior))
    gain: Floats = np.einsum("ea,eaj,enj->en", part.along, inverse[:, :3], design * part.weight[..., None])
    return gain
