"""Monitors that look at one epoch, or at the second before it, without memory: Doppler and channel comparison.

Each yields a frame `value, threshold, state, reason`, row for row with the epochs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.epochs.verdicts import NO_POSITION, first_reason, no_verdicts, verdicts
from pipeline.monitors.channels import paired
from pipeline.monitors.series import FIRST_EPOCH
from schemas.arrays import Floats, floats, times_ns
from schemas.config import Configuration

NO_VELOCITY = "no GNSS velocity"
NO_OTHER_SOLUTION = "no other solution configured to compare with"
NO_OTHER_EPOCH = "the other solution has no position at this epoch"


def doppler_monitor(epochs: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """GNSS velocity along track against odometer speed, both over the second before [m/s].

    Tells an odometer fault (slip, slide, radar on wet ground) from a fault of GNSS positions (DOMAIN section 3).
    """
    t_ns = times_ns(epochs)
    t_s = (t_ns - t_ns[0]) * 1e-9
    velocity = floats(epochs, "velocity_along_mps")
    usable = np.isfinite(velocity) & epochs["odometer_reason"].is_null().to_numpy() & epochs["fix_valid"].to_numpy()
    first, span = _window(t_s, usable, epochs["odometer_segment"].to_numpy(), config)
    total = np.concatenate([[0.0], np.cumsum(_way(t_s, np.where(usable, velocity, np.nan)))])[:-1]
    by_doppler = (total - total[first]) / span
    odometer = floats(epochs, "odometer_m")
    by_odometer = (odometer - odometer[first]) / span
    speed = np.abs(floats(epochs, "speed_mps"))
    change = np.abs(velocity - velocity[first])
    variance = (
        config.monitors.doppler_sigma_mps**2
        + floats(epochs, "odometer_white_m2_per_s") / span
        + 2.0 * (floats(epochs, "odometer_rows_m") / span) ** 2
        + (floats(epochs, "scale_sigma") * speed) ** 2
        + ((floats(epochs, "latency_sigma_s") + np.abs(floats(epochs, "latency_s"))) * change / span) ** 2
    )
    unknown = epochs["odometer_reason"]
    reasons = first_reason(
        (~np.isfinite(velocity), NO_VELOCITY),
        (unknown.is_not_null(), unknown),
        (~epochs["fix_valid"], NO_POSITION),
        (~np.isfinite(span), FIRST_EPOCH),
    )
    return verdicts(by_doppler - by_odometer, config.monitors.threshold_factor * np.sqrt(variance), reasons)


def channel_monitor(
    epochs: pl.DataFrame, other: pl.DataFrame | None, config: Configuration, absent: str = NO_OTHER_SOLUTION
) -> pl.DataFrame:
    """Path positions of two solutions at the same time against each other [m] (LOC Fig. 3).

    `other`: `t, path_m, sigma_along_m, fix_valid, on_track` of the other solution, on the same path; at an epoch its
    last position since the epoch before counts, against this solution's at that time (`paired`). Errors that both share
    (troposphere) make the threshold larger than it need be. `absent`: the reason where there is none.
    """
    if other is None:
        return no_verdicts(epochs.height, absent)
    usable = other.filter("fix_valid", "on_track")
    own_m = pl.when(pl.col("fix_valid") & pl.col("on_track")).then("path_m")
    pairs = paired(epochs.select("t", path_m=own_m), usable, config.lds)
    met = usable.select(pl.col("path_m", "sigma_along_m").gather(pairs["row_other"]))
    value = floats(pairs, "path_m") - floats(met, "path_m")
    both_m = np.hypot(floats(epochs, "sigma_along_m"), floats(met, "sigma_along_m"))
    placed = epochs["fix_valid"] & epochs["on_track"] & epochs["sigma_along_m"].is_not_null()
    reasons = first_reason(
        (~placed, NO_POSITION), (met["path_m"].is_null() | met["sigma_along_m"].is_null(), NO_OTHER_EPOCH)
    )
    return verdicts(value, config.monitors.threshold_factor * both_m, reasons)


def _window(
    t_s: Floats, usable: npt.NDArray[np.bool_], segment: npt.NDArray[np.int64], config: Configuration
) -> tuple[npt.NDArray[np.int64], Floats]:
    """Epoch `speed_window_s` before or earlier, and the time since; NaN unless all between are usable and connected."""
    least_s = config.align.speed_window_s * (1.0 - 1e-6)
    first = np.maximum(np.searchsorted(t_s, t_s - least_s, side="right") - 1, 0)
    bad = np.concatenate([[0], np.cumsum(~usable)])
    clean = bad[np.arange(t_s.size) + 1] == bad[first]
    span = t_s - t_s[first]
    connected = clean & (span >= least_s) & (span <= config.monitors.doppler_gap_s)
    connected &= segment == segment[first]
    return first, np.where(connected, span, np.nan)


def _way(t_s: Floats, velocity: Floats) -> Floats:
    """Way of each step by trapezoids [m], zero where a velocity is missing; as many as epochs."""
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t_s)
    return np.concatenate([np.nan_to_num(steps), [0.0]])
