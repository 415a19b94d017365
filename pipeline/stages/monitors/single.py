"""Monitors that look at one epoch, or the second before it, without memory: Doppler, ranges, channel comparison.

Each yields `Verdicts`, row for row with the epochs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns
from pipeline.stages.epochs.verdicts import NO_POSITION, Verdicts, first_reason, no_verdicts, verdicts
from pipeline.stages.monitors.bank import FIRST_EPOCH
from pipeline.stages.monitors.pseudorange import pseudorange_monitor
from schemas.arrays import Floats, floats, times_ns, truths
from schemas.config import Configuration, LdsConfig
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.stages import NO_REASON, AlignedEpochs

NO_VELOCITY = NotEvaluated.NO_VELOCITY
NO_OTHER_SOLUTION = NotEvaluated.NO_OTHER_SOLUTION


def doppler_monitor(epochs: AlignedEpochs, config: Configuration) -> Verdicts:
    """GNSS velocity along track against odometer speed, both over the second before.

    Separates an odometer fault (slip, slide, radar on wet ground) from one of GNSS positions.

    Args:
        epochs: aligned epochs of one solution, arrays of shape (n,).
        config: the configuration; used are `monitors`, `align.speed_window_s` and `scatter_limit_m`.

    Returns:
        Verdicts of n rows; value and threshold [m/s].

    Source:
        DOMAIN section 3; ours.
    """
    t_s = (epochs.t_ns - epochs.t_ns[0]) * 1e-9
    velocity_mps = epochs.velocity_along_mps
    without = epochs.odometer_reason
    # The sigma of rows is cut off there: with coarser ones a threshold would not hold.
    coarse = epochs.odometer_rows_m >= config.scatter_limit_m
    usable = np.isfinite(velocity_mps) & (without == NO_REASON) & epochs.fix_valid & ~coarse
    first, span_s = _window(t_s, usable, epochs.odometer_doubt_m, config)
    doppler_m = np.concatenate([[0.0], np.cumsum(_trapezoids_m(t_s, np.where(usable, velocity_mps, np.nan)))])[:-1]
    odometer_m = epochs.odometer_m
    value_mps = (doppler_m - doppler_m[first]) / span_s - (odometer_m - odometer_m[first]) / span_s
    sigma_mps = _doppler_sigma(epochs, span_s, velocity_mps - velocity_mps[first], config)
    reasons = first_reason(
        (~np.isfinite(velocity_mps), NO_VELOCITY),
        (without != NO_REASON, without),
        (~epochs.fix_valid, NO_POSITION),
        (coarse, NotEvaluated.NOISE_TOO_LARGE),
        (~np.isfinite(span_s), FIRST_EPOCH),
    )
    return verdicts(value_mps, config.monitors.threshold_factor * sigma_mps, reasons)


def _doppler_sigma(epochs: AlignedEpochs, span_s: Floats, change_mps: Floats, config: Configuration) -> Floats:
    """Sigma of Doppler minus odometer speed over `span_s`, in which the velocity changed by `change_mps` [m/s]."""
    speed_mps = np.abs(epochs.speed_mps)
    # At a change of speed dv a late stamp of T compares other moments: dv T / span.
    late_s = epochs.latency_sigma_s + np.abs(epochs.latency_s)
    variance = (
        config.monitors.doppler_sigma_mps**2
        + epochs.odometer_white_m2_per_s / span_s
        + 2.0 * (epochs.odometer_rows_m / span_s) ** 2  # one row at each end
        + (epochs.scale_sigma * speed_mps) ** 2
        + (late_s * np.abs(change_mps) / span_s) ** 2
    )
    return np.sqrt(variance)


def channel_monitor(epochs: pl.DataFrame, channel: pl.DataFrame, config: Configuration) -> Verdicts:
    """Path positions of two solutions at the same time against each other.

    The last position of the other since the epoch before counts (`paired`). Errors common to both make the threshold
    larger than needed.

    Args:
        epochs: `t, path_m, sigma_along_m, fix_valid, on_track` of this solution, n rows.
        channel: the same of the other solution, on the same path.
        config: the configuration; used are `monitors.threshold_factor` and `lds`.

    Returns:
        Verdicts of n rows; value and threshold [m].

    Source:
        LOC Fig. 3; DOMAIN section 3.
    """
    usable = channel.filter("fix_valid", "on_track")
    own_m = pl.when(pl.col("fix_valid") & pl.col("on_track")).then("path_m")
    pairs = paired(epochs.select("t", path_m=own_m), usable, config.lds)
    other = usable.select(pl.col("path_m", "sigma_along_m").gather(pairs["row_other"]))
    value = floats(pairs, "path_m") - floats(other, "path_m")
    both_m = np.hypot(floats(epochs, "sigma_along_m"), floats(other, "sigma_along_m"))
    placed = truths(epochs["fix_valid"] & epochs["on_track"] & epochs["sigma_along_m"].is_not_null())
    unknown = truths(other["path_m"].is_null() | other["sigma_along_m"].is_null())
    reasons = first_reason((~placed, NO_POSITION), (unknown, NotEvaluated.NO_OTHER_EPOCH))
    return verdicts(value, config.monitors.threshold_factor * both_m, reasons)


def _window(
    t_s: Floats, usable: npt.NDArray[np.bool_], doubt_m: Floats, config: Configuration
) -> tuple[npt.NDArray[np.int64], Floats]:
    """Epoch `speed_window_s` before or earlier, and the time since; NaN unless all between is usable and connected."""
    least_s = config.align.speed_window_s * (1.0 - 1e-6)
    first = np.maximum(np.searchsorted(t_s, t_s - least_s, side="right") - 1, 0)
    # No unusable epoch lies in a window where the running count of them is the same at both ends.
    bad = np.concatenate([[0], np.cumsum(~usable)])
    clean = bad[np.arange(t_s.size) + 1] == bad[first]
    span = t_s - t_s[first]
    connected = clean & (span >= least_s) & (span <= config.monitors.doppler_gap_s)
    connected &= doubt_m == doubt_m[first]
    return first, np.where(connected, span, np.nan)


def _trapezoids_m(t_s: Floats, velocity: Floats) -> Floats:
    """Distances by trapezoids of the speeds [m], zero where a velocity is missing."""
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t_s)
    return np.concatenate([np.nan_to_num(steps), [0.0]])


_PLACE = ("netelement_id", "measure_m", "path_m")


def on_path_of(epochs: pl.DataFrame, channel: pl.DataFrame, lds: LdsConfig) -> pl.DataFrame:
    """The rows of `channel` with `path_m` as it counts on the path of `epochs`; null where nothing joins the paths.

    Each solution has its own matched path, which may begin elsewhere or in the other direction. On a net element that
    both are on at one time the measure says how far apart they are; elsewhere the paths stand to each other as they did
    before, at the beginning in no known way.
    """
    gaps = pl.Series("valid_ns", crossing_gaps_ns(times_ns(epochs), lds))
    mine = _with_sense(epochs).with_columns(gaps, at_ns=pl.col("t_ns"))
    theirs = _with_sense(channel).with_row_index("row")
    pairs = theirs.join_asof(mine, on="t_ns", strategy="backward", suffix="_mine")
    together = (
        (pl.col("t_ns") - pl.col("at_ns") <= pl.col("valid_ns"))
        & (pl.col("netelement_id") == pl.col("netelement_id_mine"))
        & (pl.col("sense") * pl.col("sense_mine") != 0)
    )
    turned = pl.col("sense") * pl.col("sense_mine")
    here_m = pl.col("path_m_mine") + pl.col("sense_mine") * (pl.col("measure_m") - pl.col("measure_m_mine"))
    placed = (
        pairs.with_columns(together=together.fill_null(value=False), turned=turned, here_m=here_m)
        .with_columns(
            turned=pl.when("together").then("turned"),
            start_m=pl.when("together").then(pl.col("here_m") - pl.col("turned") * pl.col("path_m")),
        )
        .with_columns(pl.col("turned", "start_m").forward_fill())
        .select("row", path_m=pl.col("start_m") + pl.col("turned") * pl.col("path_m"))
    )
    return channel.with_columns(placed.sort("row")["path_m"])


def paired(epochs: pl.DataFrame, channel: pl.DataFrame, lds: LdsConfig) -> pl.DataFrame:
    """The last row of `channel` since the epoch before, `row_other`, and this solution's `path_m` then, per epoch.

    That is the epoch's own, or between this epoch and the one before, if a movement is interpolated over that; else
    null.
    """
    stamps = channel.select(t_other=_stamp()).with_row_index("row_other")
    mine = epochs.select("path_m", t_ns=_stamp(), gap_ns=pl.Series(crossing_gaps_ns(times_ns(epochs), lds)))
    since = pl.col("t_ns") - pl.col("t_ns").shift(1)
    early = pl.col("t_ns") - pl.col("t_other")
    between = (early < since) & (since <= pl.col("gap_ns"))
    moved_m = (pl.col("path_m") - pl.col("path_m").shift(1)) * (early / since)
    return (
        mine.join_asof(stamps, left_on="t_ns", right_on="t_other", strategy="backward")
        .with_columns(path_m=pl.when(early == 0).then("path_m").when(between).then(pl.col("path_m") - moved_m))
        .select("path_m", row_other=pl.when(pl.col("path_m").is_not_null()).then("row_other"))
    )


def _stamp() -> pl.Expr:
    """Times as whole nanoseconds."""
    return pl.col("t").to_physical()


def _with_sense(epochs: pl.DataFrame) -> pl.DataFrame:
    """Places with `sense`: +1 where the path runs with the measure, -1 against it; 0 where a visit has not shown it."""
    path, measure = (pl.col(name).diff().over("visit") for name in ("path_m", "measure_m"))
    placed = epochs.select(*_PLACE, t_ns=_stamp(), visit=pl.col("netelement_id").rle_id())
    # Steps along path and measure have equal signs where both grow or both fall.
    moved = (path * measure).fill_null(0.0).cum_sum().over("visit")
    return placed.select("t_ns", *_PLACE, sense=moved.sign().cast(pl.Int8))


@frozen
class MonitorInput:
    """What monitors without memory may look at; `other` on this solution's path, `absent`: why there is none."""

    epochs: AlignedEpochs
    satellites: pl.DataFrame | None
    other: pl.DataFrame | None
    absent: NotEvaluated
    config: Configuration


WITHOUT_MEMORY: Mapping[str, Callable[[MonitorInput], Verdicts]] = {
    "along_doppler": lambda given: doppler_monitor(given.epochs, given.config),
    "channel": lambda given: (
        no_verdicts(given.epochs.height, given.absent)
        if given.other is None
        else channel_monitor(given.epochs.table, given.other, given.config)
    ),
    "pseudorange": lambda given: pseudorange_monitor(given.epochs, given.satellites, given.config),
}
"""Monitors by the name that `schemas.tables.ALL_MONITORS` gives them."""
