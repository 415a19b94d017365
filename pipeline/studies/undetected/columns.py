"""The largest unnoticed error of a solution as columns of epochs and passages, and what a run comes to."""

from __future__ import annotations

from functools import lru_cache

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.monitored import MonitoredSolution
from pipeline.studies.undetected.error import largest_errors
from pipeline.studies.undetected.figures import Spacing, undetected_figures
from pipeline.studies.undetected.in_use import Returns, in_use_errors
from pipeline.studies.undetected.position_tests import range_bounds, with_bounds, with_channel
from pipeline.studies.undetected.spacing import largest_spacing
from pipeline.studies.undetected.watched import (
    NO_ROW,
    FaultWindow,
    Watched,
    fixes_ns,
    watch_rows,
    windows_between_fixes,
)
from schemas.arrays import Bools, Floats, Ints, flags, floats, ints
from schemas.config import Configuration, UndetectedConfig
from schemas.conform import dtypes
from schemas.enums import BaliseKind
from schemas.frozen import frozen
from schemas.monitors import SCALES
from schemas.tables import Epochs, Passages

_OF_EPOCHS = ("undetected_{}_m", "undetected_{}_in_use_m")
_OF_RANGE = "undetected_range_{}_m"
_SIDES = ("ahead", "behind")


@frozen
class Undetected:
    """`epochs`: columns row for row with the epochs; `passages`: the same with the passages; `spacing` of the run."""

    epochs: pl.DataFrame
    passages: pl.DataFrame
    spacing: Spacing | None = None

    def figures(self, epochs: JudgedEpochs, config: Configuration) -> dict[str, object]:
        """Columns of the `runs` row; none where nothing was computed."""
        if self.spacing is None:
            return {}
        return undetected_figures(epochs, self.epochs, self.spacing, config.hazards.limits.failure_m)


def largest_unnoticed(monitored: MonitoredSolution) -> Undetected:
    """The largest error that no monitor would have noticed at each epoch and passage.

    Never smaller than what any fault of the definition reaches.

    Args:
        monitored: one solution with its monitors and detected balises.

    Returns:
        Columns for its epochs and passages [m], null where `undetected.compute` is not set, and the spacing of balises.

    Source:
        DOMAIN section 5.6; docs/undetected.md.
    """
    config = monitored.prepared.config
    nothing = _null_columns(Passages, monitored.lds.passages.height)
    if not config.undetected.compute:
        return Undetected(_null_columns(Epochs, monitored.solution.epochs.height), nothing)
    epochs = monitored.solution.epochs.table
    rows = watched_rows(monitored)
    parts = fault_windows(monitored, rows)
    errors = _errors_both_directions(rows, parts, config.undetected)
    spacing, before_m = largest_spacing(rows, _driven_to_rows_m(rows, epochs), config)
    direction = ints(epochs["direction"], unknown=1)[rows.epoch]
    sizes_m = (errors.error_m, _in_use_m(monitored, rows, parts, errors), _range_m(monitored, rows, parts))
    columns = {
        name.format(side): values
        for name, error_m in zip((*_OF_EPOCHS, _OF_RANGE), sizes_m, strict=True)
        for side, values in zip(_SIDES, np.where(direction > 0, error_m, error_m[::-1]), strict=True)
    }
    at_rows = pl.DataFrame(columns | {"physical_before_m": before_m}).fill_nan(None)
    at_epochs = np.full(epochs.height, NO_ROW)
    at_epochs[rows.epoch] = np.arange(rows.count)
    at = rows_of_passages(monitored, rows)
    of_passages = _gather_columns(at_rows, at).with_columns(_bounding_columns(monitored, errors, at))
    return Undetected(
        _gather_columns(at_rows, at_epochs).select(name.format(side) for name in _OF_EPOCHS for side in _SIDES),
        of_passages.select(nothing.columns),
        spacing,
    )


def _null_columns(table: type[dy.Schema], rows: int) -> pl.DataFrame:
    """The columns of a table that are computed here, null in every row."""
    return pl.DataFrame([null.new_from_index(0, rows) for null in _nulls(table)])


@lru_cache(maxsize=8)
def _nulls(table: type[dy.Schema]) -> list[pl.Series]:
    """One null of each column that is computed here."""
    kinds = {name: kind for name, kind in dtypes(table).items() if name.startswith(("undetected_", "physical_"))}
    return [pl.Series(name, [None], dtype=kind) for name, kind in kinds.items()]


def _gather_columns(at_rows: pl.DataFrame, at: Ints) -> pl.DataFrame:
    """The columns of rows at these places, null at `NO_ROW`."""
    place = pl.DataFrame({"at": at}).select(pl.when(pl.col("at") != NO_ROW).then("at")).to_series()
    return at_rows.select(pl.all().gather(place))


def watched_rows(monitored: MonitoredSolution) -> Watched:
    """What the monitors watched, the comparison with another solution where the fault is in one alone."""
    prepared = monitored.prepared
    config = prepared.config
    epochs = monitored.solution.epochs.table
    rows = watch_rows(epochs, monitored.bank.along(), monitored.lds.held, prepared.vehicle, config)
    if config.undetected.solutions_at_fault == "all":
        return rows
    return with_channel(rows, epochs, monitored.singles["channel"], monitored.other, config.lds)


def fault_windows(monitored: MonitoredSolution, rows: Watched) -> list[FaultWindow]:
    """Windows from each independent fix to the next."""
    prepared = monitored.prepared
    fixes = fixes_ns(
        prepared.run, monitored.lds.crossings, prepared.config.lds.starts_of_mission, prepared.config.undetected
    )
    return windows_between_fixes(rows, monitored.solution.epochs.t_ns, fixes)


@frozen
class _BothDirections:
    """Errors along growing path and against it at each row [m] (2, rows), NaN at the first row.

    `since_ns`: when they began at the earliest, else -1. `paid_m`, `outright`: what holds the larger (`error.Errors`).
    """

    error_m: Floats
    since_ns: Ints
    paid_m: Floats
    outright: Bools


def _errors_both_directions(rows: Watched, parts: list[FaultWindow], config: UndetectedConfig) -> _BothDirections:
    """The largest errors in both directions, window by window."""
    error = np.full((2, rows.count), np.nan)
    since_ns = np.full(rows.count, -1)
    paid = np.zeros((rows.count, 1 + rows.weight.shape[1]))
    outright = np.zeros(rows.count, dtype=np.bool_)
    for window in parts:
        grown = rows.after_fix(window.start, window.end, window.since_s)
        ahead, behind = (largest_errors(travel, config) for travel in (grown, grown.in_other_direction()))
        part = slice(window.start + 1, window.end + 1)
        worse = ahead.most_m >= behind.most_m
        error[:, part] = (ahead.most_m, behind.most_m)
        since_ns[part] = window.since_ns
        paid[part] = np.where(worse[:, None], ahead.paid_m, behind.paid_m)
        outright[part] = np.where(worse, ahead.outright, behind.outright)
    return _BothDirections(error, since_ns, paid, outright)


def _in_use_m(monitored: MonitoredSolution, rows: Watched, parts: list[FaultWindow], errors: _BothDirections) -> Floats:
    """The largest error while the position is in use, alarms or not, shape (2, rows)."""
    config = monitored.prepared.config
    vehicle = monitored.prepared.vehicle
    epochs = monitored.solution.epochs.table
    returns = None
    # No negated position returns between fixes without a re-link, or a vehicle file to compare with.
    if config.lds.relink and vehicle.odometer_scale is not None and vehicle.odometer_scale_sigma is not None:
        returns = Returns.of_epochs(rows, epochs, vehicle.odometer_scale_sigma)
    return in_use_errors(rows, parts, errors.error_m, flags(epochs, "tvb")[rows.epoch], returns, config)


def _range_m(monitored: MonitoredSolution, rows: Watched, parts: list[FaultWindow]) -> Floats:
    """Error by the worst range at fault [m]; NaN without ranges."""
    satellites = monitored.prepared.ranges(monitored.solution.name)
    if satellites is None:
        return np.full((2, rows.count), np.nan)
    low_m, high_m = range_bounds(monitored.aligned, satellites, monitored.prepared.config)
    return _errors_both_directions(
        with_bounds(rows, low_m[rows.epoch], high_m[rows.epoch]), parts, monitored.prepared.config.undetected
    ).error_m


def _driven_to_rows_m(rows: Watched, epochs: pl.DataFrame) -> Floats:
    """Distance driven up to each row by the odometer, turns included."""
    odometer_m = floats(epochs, "odometer_m")[rows.epoch]
    driven_m: Floats = np.cumsum(np.abs(np.diff(odometer_m, prepend=odometer_m[:1])))
    return driven_m


def rows_of_passages(monitored: MonitoredSolution, rows: Watched) -> Ints:
    """The row that each passage looks at, `NO_ROW` where there is none.

    Of a virtual balise the epoch that offered it. Of a physical one the last row before its telegram, no longer before
    than a crossing may be seen over: that is how wrong the position can have become since the read before.
    """
    passages = monitored.lds.passages
    if not rows.count:
        return np.full(passages.height, NO_ROW)
    t_ns = monitored.solution.epochs.t_ns
    wanted = np.append(monitored.lds.crossings.epoch, -1)[ints(passages["crossing_id"])]
    row = np.searchsorted(rows.epoch, wanted).clip(max=rows.count - 1)
    offered = np.where((wanted >= 0) & (rows.epoch[row] == wanted), row, NO_ROW)
    read_ns = ints(passages["t_offered"].dt.timestamp("ns"))
    stamps = t_ns[rows.epoch]
    before = np.searchsorted(stamps, read_ns, side="right") - 1
    longest_ns = crossing_gaps_ns(t_ns, monitored.prepared.config.lds)[rows.epoch]
    near = (before >= 0) & (read_ns - stamps[before.clip(0)] <= longest_ns[before.clip(0)])
    physical = (passages["kind"].cast(pl.String) == BaliseKind.PHYSICAL.value).to_numpy()
    return np.where(physical, np.where(near, before, NO_ROW), offered)


def _bounding_columns(monitored: MonitoredSolution, errors: _BothDirections, at: Ints) -> list[pl.Series]:
    """`undetected_since, undetected_monitors` of passages at these rows; null where no error is known."""
    known = (at != NO_ROW) & (np.append(errors.since_ns, -1)[at] >= 0)
    rows = [int(row) if yes else None for row, yes in zip(at, known, strict=True)]
    names = _bounding_names(monitored)
    share = monitored.prepared.config.undetected.holding_share
    since = [None if row is None else int(errors.since_ns[row]) for row in rows]
    monitors = [None if row is None else _monitors_at_row(errors, row, names, share) for row in rows]
    return [
        pl.Series("undetected_since", since, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC")),
        pl.Series("undetected_monitors", monitors, dtype=pl.List(pl.String)),
    ]


def _bounding_names(monitored: MonitoredSolution) -> list[str]:
    """The monitors along the track in use (raw stands for the largest rate of a fault too), and who holds outright."""
    enabled = monitored.bank.along().enabled
    along = [f"along_{name}" for index, name in enumerate(SCALES) if enabled[index] or index == 0]
    return [*along, "channel" if monitored.prepared.config.undetected.solutions_at_fault == "one" else "link_distance"]


def _monitors_at_row(errors: _BothDirections, row: int, names: list[str], least: float) -> list[str]:
    """Monitors that hold the larger error at a row, first what holds most of it; none where the bank was blind."""
    if errors.outright[row]:
        return [names[-1]]
    paid = errors.paid_m[row]
    order = np.argsort(-paid, kind="stable")
    return [names[which] for which in order.tolist() if paid[which] > least * paid.sum()]
