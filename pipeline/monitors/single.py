"""Monitors that look at one epoch, or at the second before it, without memory: Doppler and channel comparison.

Each yields a frame `value, threshold, state, reason`, row for row with the epochs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.monitors.channels import paired
from pipeline.monitors.series import FIRST_EPOCH, NO_POSITION
from schemas.arrays import Floats, floats, times_ns
from schemas.config import Configuration
from schemas.enums import MonitorState

NO_VELOCITY = "no GNSS velocity"
NO_VALUE = "nothing to compute it from"
NO_RANGES = "no satellites stream"
NO_OTHER_SOLUTION = "no other solution configured to compare with"
NO_OTHER_EPOCH = "the other solution has no position at this epoch"
_STATES = pl.Enum([state.value for state in MonitorState])


def judged(value: Floats, threshold: Floats, reasons: pl.Series) -> pl.DataFrame:
    """States of a monitor: where a reason stands it is not evaluated, else |value| against the threshold.

    What has no reason and yet no value or threshold is not evaluated either: absence is never health.
    """
    frame = pl.DataFrame(
        {
            "value": pl.Series(value, nan_to_null=True),
            "threshold": pl.Series(threshold, nan_to_null=True),
            "reason": reasons.cast(pl.String),
        }
    )
    unknown = pl.col("value").is_null() | pl.col("threshold").is_null()
    frame = frame.with_columns(reason=pl.coalesce("reason", pl.when(unknown).then(pl.lit(NO_VALUE))))
    evaluated = pl.col("reason").is_null()
    state = (
        pl.when(~evaluated)
        .then(pl.lit(MonitorState.NOT_EVALUATED.value))
        .when(pl.col("value").abs() > pl.col("threshold"))
        .then(pl.lit(MonitorState.FAIL.value))
        .otherwise(pl.lit(MonitorState.PASS.value))
    )
    return frame.select(
        pl.when(evaluated).then(pl.col("value")).alias("value"),
        pl.when(evaluated).then(pl.col("threshold")).alias("threshold"),
        state.cast(_STATES).alias("state"),
        "reason",
    )


def blind_monitor(epochs: int, reason: str) -> pl.DataFrame:
    """A monitor that has nothing to look at in the whole run."""
    nothing = np.full(epochs, np.nan)
    return judged(nothing, nothing, pl.Series([reason] * epochs, dtype=pl.String))


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
    reasons = pl.select(
        pl.when(pl.Series(usable & np.isfinite(span)))
        .then(pl.lit(None, pl.String))
        .when(pl.Series(~np.isfinite(velocity)))
        .then(pl.lit(NO_VELOCITY))
        .when(epochs["odometer_reason"].is_not_null())
        .then(epochs["odometer_reason"])
        .when(~epochs["fix_valid"])
        .then(pl.lit(NO_POSITION))
        .otherwise(pl.lit(FIRST_EPOCH))
    ).to_series()
    return judged(by_doppler - by_odometer, config.monitors.threshold_factor * np.sqrt(variance), reasons)


def channel_monitor(
    epochs: pl.DataFrame, other: pl.DataFrame | None, config: Configuration, absent: str = NO_OTHER_SOLUTION
) -> pl.DataFrame:
    """Path positions of two solutions at the same time against each other [m] (LOC Fig. 3).

    `other`: `t, path_m, sigma_along_m, fix_valid, on_track` of the other solution, on the same path; at an epoch its
    last position since the epoch before counts, against this solution's at that time (`paired`). Errors that both share
    (troposphere) make the threshold larger than it need be. `absent`: the reason where there is none.
    """
    if other is None:
        return blind_monitor(epochs.height, absent)
    usable = other.filter("fix_valid", "on_track")
    placed = pl.when(pl.col("fix_valid") & pl.col("on_track")).then("path_m")
    pairs = paired(epochs.select("t", path_m=placed), usable)
    met = usable.select(pl.col("path_m", "sigma_along_m").gather(pairs["row_other"]))
    value = floats(pairs, "path_m") - floats(met, "path_m")
    both_m = np.hypot(floats(epochs, "sigma_along_m"), floats(met, "sigma_along_m"))
    reasons = epochs.select(
        pl.when(~pl.col("fix_valid") | ~pl.col("on_track") | pl.col("sigma_along_m").is_null())
        .then(pl.lit(NO_POSITION))
        .when(met["path_m"].is_null() | met["sigma_along_m"].is_null())
        .then(pl.lit(NO_OTHER_EPOCH))
    ).to_series()
    return judged(value, config.monitors.threshold_factor * both_m, reasons)


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
