"""Between odometer rows far apart: distances on curves that a train can drive."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Floats, Ints
from schemas.config import AlignConfig


def filled_in(
    t_s: Floats, distance_m: Floats, speed_mps: Floats, rows: Ints, config: AlignConfig
) -> tuple[Floats, Floats, Ints]:
    """Samples of a distance with finer ones between the given rows and the next, on cubic curves.

    Returns times [s], distances [m] and the row that each sample belongs to. Slopes of the curves at the rows are the
    speeds where these make about the way between (a unit, a sign or a sensor may be wrong), else those of a curve
    through the distances that keeps its direction (PCHIP), and never so steep that the train would turn back.
    """
    from scipy.interpolate import PchipInterpolator  # hardly a log needs it, and it takes long to load

    smooth = PchipInterpolator(t_s, distance_m).derivative()(t_s)
    slopes = np.where(np.isfinite(speed_mps), speed_mps, smooth)
    span, way = t_s[rows + 1] - t_s[rows], distance_m[rows + 1] - distance_m[rows]
    # Whatever a train does that gathers speed or brakes no harder, the mean of two speeds is no farther from its way.
    true = np.abs(0.5 * (slopes[rows] + slopes[rows + 1]) * span - way) <= 0.25 * config.braking_mps2 * span**2
    low, high = np.minimum(0.0, 3.0 * way), np.maximum(0.0, 3.0 * way)
    start, end = (np.clip(np.where(true, slopes[at], smooth[at]) * span, low, high) for at in (rows, rows + 1))
    # A third of the span in which a straight line is near enough: within a ninth of that.
    fine = np.ceil(3.0 * span / config.straight_s).astype(np.int64)
    which = np.repeat(np.arange(rows.size), fine - 1)
    part = np.concatenate([np.arange(1, count) / count for count in fine.tolist()])
    rest = 1.0 - part
    curve = part**2 * (3.0 - 2.0 * part) * way[which] + part * rest * (rest * start[which] - part * end[which])
    at_s = np.concatenate([t_s, t_s[rows][which] + part * span[which]])
    order = np.argsort(at_s, kind="stable")
    source = np.concatenate([np.arange(t_s.size), rows[which]])[order]
    return at_s[order], np.concatenate([distance_m, distance_m[rows][which] + curve])[order], source
