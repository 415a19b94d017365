"""The largest unnoticed error as columns of epochs and passages, and what a run comes to."""

from __future__ import annotations

from dataclasses import dataclass

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gap_ns
from pipeline.stages.lds.relink import Held
from pipeline.stages.monitors.bank import AxisBank
from pipeline.studies.undetected.error import largest_errors
from pipeline.studies.undetected.figures import Spacing, undetected_figures
from pipeline.studies.undetected.in_use import Returns, in_use_errors
from pipeline.studies.undetected.position_tests import bounded, range_bounds, with_channel
from pipeline.studies.undetected.spacing import largest_spacing
from pipeline.studies.undetected.watched import FaultWindow, Watched, watched, windows
from schemas.arrays import Bools, Floats, Ints, floats, ints, times_ns
from schemas.config import Configuration, UndetectedConfig, Vehicle
from schemas.conform import dtypes
from schemas.enums import BaliseKind
from schemas.tables import SCALES, Epochs, Passages

EPOCH_COLUMNS = ("undetected_ahead_m", "undetected_behind_m")
IN_USE_COLUMNS = ("undetected_ahead_in_use_m", "undetected_behind_in_use_m")
RANGE_COLUMNS = ("undetected_range_ahead_m", "undetected_range_behind_m")


@dataclass(frozen=True)
class Diagnosis:
    """What watched one solution: aligned epochs with `negated`, the bank, re-links that held, other tests, the fixes.

    `channel`: the channel monitor; `other`: what it compared with; `satellites`: those of the solution; `fixes_ns`:
    instants of independent fixes.
    """

    epochs: pl.DataFrame
    bank: AxisBank
    held: tuple[Held, ...]
    channel: pl.DataFrame
    other: pl.DataFrame | None
    satellites: pl.DataFrame | None
    fixes_ns: Ints


@dataclass(frozen=True)
class Undetected:
    """`epochs`: columns row for row with the epochs; `passages`: the same with the passages; `spacing` of the run."""

    epochs: pl.DataFrame
    passages: pl.DataFrame
    spacing: Spacing | None = None

    def figures(self, epochs: pl.DataFrame, config: Configuration) -> dict[str, object]:
        """Columns of the `runs` row, over judged epochs; none where nothing was computed."""
        return undetected_figures(epochs, self.spacing, config.hazards.failure_limit_m)


@dataclass(frozen=True)
class _BothWays:
    """Errors along growing path and against it at each row [m] (2, rows), NaN at the first row.

    `since_ns`: when they began at the earliest, else -1. `paid_m`, `outright`: what holds the larger (`error.Errors`).
    """

    error_m: Floats
    since_ns: Ints
    paid_m: Floats
    outright: Bools


def _nothing(table: type[dy.Schema], rows: int) -> pl.DataFrame:
    kinds = {name: kind for name, kind in dtypes(table).items() if name.startswith(("undetected_", "physical_"))}
    return pl.DataFrame({name: [None] * rows for name in kinds}, schema=kinds)


def undetected_of(
    diagnosis: Diagnosis, passages: pl.DataFrame, crossings: pl.DataFrame, vehicle: Vehicle, config: Configuration
) -> Undetected:
    """The largest error that no monitor would have noticed at each epoch and passage; nulls where nobody asked.

    `passages`, `crossings`: of the LDS. Never smaller than what any fault of the definition reaches.
    """
    epochs = diagnosis.epochs
    if not config.undetected.compute:
        return Undetected(_nothing(Epochs, epochs.height), _nothing(Passages, passages.height))
    rows = rows_of(diagnosis, vehicle, config)
    t_ns = times_ns(epochs)
    parts = windows(rows, t_ns, diagnosis.fixes_ns)
    errors = _both(rows, parts, config.undetected)
    ranges = diagnosis.satellites
    of_range = None
    if ranges is not None:
        low_m, high_m = range_bounds(epochs, ranges, config)
        of_range = _both(bounded(rows, low_m[rows.epoch], high_m[rows.epoch]), parts, config.undetected)
    spacing, before_m = largest_spacing(rows, _way_m(rows, epochs), config)
    in_use = in_use_errors(rows, parts, errors.error_m, _returns(rows, epochs, vehicle, config), config)
    at = rows_of_passages(passages, crossings, rows, t_ns, config)
    facing = ints(epochs["direction"], unknown=1)
    names = _names(diagnosis.bank, config)
    least = config.undetected.holding_share
    before = np.where(at >= 0, np.append(before_m, np.nan)[at], np.nan)
    of_passages = _at_passages(at, rows, errors, in_use, of_range, facing, names, least)
    return Undetected(
        _at_epochs(rows, errors.error_m, in_use, facing),
        of_passages.with_columns(physical_before_m=pl.Series(before, nan_to_null=True)),
        spacing,
    )


def _returns(rows: Watched, epochs: pl.DataFrame, vehicle: Vehicle, config: Configuration) -> Returns | None:
    """None where no negated position returns between fixes: re-link off, or no vehicle file to compare with."""
    if not config.lds.relink or vehicle.odometer_scale is None or vehicle.odometer_scale_sigma is None:
        return None
    return Returns.of(rows, epochs, vehicle.odometer_scale_sigma)


def rows_of(diagnosis: Diagnosis, vehicle: Vehicle, config: Configuration) -> Watched:
    """What the monitors watched, the comparison with another solution where the fault is in one alone."""
    rows = watched(diagnosis.epochs, diagnosis.bank, diagnosis.held, vehicle, config)
    if config.undetected.solutions_at_fault == "all":
        return rows
    return with_channel(rows, diagnosis.epochs, diagnosis.channel, diagnosis.other, config.lds)


def _both(rows: Watched, parts: list[FaultWindow], config: UndetectedConfig) -> _BothWays:
    error = np.full((2, rows.rows), np.nan)
    since_ns = np.full(rows.rows, -1)
    paid = np.zeros((rows.rows, 1 + rows.weight.shape[1]))
    outright = np.zeros(rows.rows, dtype=np.bool_)
    for window in parts:
        seen = rows.since(window.start, window.end, window.since_s)
        ahead, behind = (largest_errors(travel, config) for travel in (seen, seen.mirrored()))
        part = slice(window.start + 1, window.end + 1)
        worse = ahead.most_m >= behind.most_m
        error[:, part] = (ahead.most_m, behind.most_m)
        since_ns[part] = window.since_ns
        paid[part] = np.where(worse[:, None], ahead.paid_m, behind.paid_m)
        outright[part] = np.where(worse, ahead.outright, behind.outright)
    return _BothWays(error, since_ns, paid, outright)


def _way_m(rows: Watched, epochs: pl.DataFrame) -> Floats:
    """Way driven up to each row by the odometer, turns included."""
    odometer_m = floats(epochs, "odometer_m")[rows.epoch]
    way: Floats = np.cumsum(np.abs(np.diff(odometer_m, prepend=odometer_m[:1])))
    return way


def _names(bank: AxisBank, config: Configuration) -> list[str]:
    """The monitors along the track in use (raw stands for the largest rate of a fault too), and who holds outright."""
    along = [f"along_{name}" for index, name in enumerate(SCALES) if bank.enabled[index] or index == 0]
    return [*along, "channel" if config.undetected.solutions_at_fault == "one" else "link_distance"]


def _at_epochs(rows: Watched, error_m: Floats, in_use_m: Floats, facing: Ints) -> pl.DataFrame:
    """Ahead and behind in the direction of travel, row for row with all epochs."""
    columns = np.full((4, facing.size), np.nan)
    columns[:2, rows.epoch] = _faced(error_m, facing[rows.epoch])
    columns[2:, rows.epoch] = _faced(in_use_m, facing[rows.epoch])
    names = (*EPOCH_COLUMNS, *IN_USE_COLUMNS)
    return pl.DataFrame(
        [pl.Series(name, values, nan_to_null=True) for name, values in zip(names, columns, strict=True)]
    )


def _faced(error_m: Floats, facing: Ints) -> Floats:
    """Ahead and behind, shape (2, rows), for these directions of travel along growing path."""
    return np.where(facing > 0, error_m, error_m[::-1])


def rows_of_passages(
    passages: pl.DataFrame, crossings: pl.DataFrame, rows: Watched, t_ns: Ints, config: Configuration
) -> Ints:
    """The row that each passage looks at, -1 where there is none.

    Of a virtual balise the epoch that offered it. Of a physical one the last row before its telegram, no longer before
    than a crossing may be seen over: that is how wrong the position can have become since the read before.
    """
    seen = passages.join(crossings.select("crossing_id", "epoch"), on="crossing_id", how="left", maintain_order="left")
    stamps = t_ns[rows.epoch]
    wanted = ints(seen["epoch"])
    row = np.searchsorted(rows.epoch, wanted).clip(max=max(rows.rows - 1, 0))
    offered = (wanted >= 0) & (rows.epoch[row] == wanted) if rows.rows else np.zeros(wanted.size, dtype=np.bool_)
    read_ns = ints(seen["t_offered"].dt.timestamp("ns"))
    before = np.searchsorted(stamps, read_ns, side="right") - 1
    near = offered
    if rows.rows:
        near = (before >= 0) & (read_ns - stamps[before.clip(0)] <= crossing_gap_ns(t_ns, config.lds))
    physical = (seen["kind"].cast(pl.String) == BaliseKind.PHYSICAL.value).to_numpy()
    return np.where(physical, np.where(near, before, -1), np.where(offered, row, -1))


def _at_passages(
    at: Ints,
    rows: Watched,
    errors: _BothWays,
    in_use_m: Floats,
    of_range: _BothWays | None,
    facing: Ints,
    names: list[str],
    least: float,
) -> pl.DataFrame:
    known = (at >= 0) & (errors.since_ns[at] >= 0) if rows.rows else np.zeros(at.size, dtype=np.bool_)
    at = np.where(known, at, 0)
    values = dict(zip(EPOCH_COLUMNS, _taken(errors.error_m, at, known, rows, facing), strict=True))
    values |= dict(zip(IN_USE_COLUMNS, _taken(in_use_m, at, known, rows, facing), strict=True))
    nothing = np.full((2, at.size), np.nan)
    ranges = nothing if of_range is None else _taken(of_range.error_m, at, known, rows, facing)
    values |= dict(zip(RANGE_COLUMNS, ranges, strict=True))
    since = [int(errors.since_ns[row]) if yes else None for row, yes in zip(at, known, strict=True)]
    holding = [
        _holding(errors, row, names, least) if yes else None for row, yes in zip(at.tolist(), known, strict=True)
    ]
    return pl.DataFrame([pl.Series(name, column, nan_to_null=True) for name, column in values.items()]).with_columns(
        undetected_since=pl.Series(since, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC")),
        undetected_monitors=pl.Series(holding, dtype=pl.List(pl.String)),
    )


def _taken(error_m: Floats, at: Ints, known: Bools, rows: Watched, facing: Ints) -> Floats:
    if not rows.rows:
        return np.full((2, at.size), np.nan)
    return np.where(known, _faced(error_m, facing[rows.epoch])[:, at], np.nan)


def _holding(errors: _BothWays, row: int, names: list[str], least: float) -> list[str]:
    """Monitors that hold the larger error at a row, first what holds most of it; none where the bank was blind."""
    if errors.outright[row]:
        return [names[-1]]
    paid = errors.paid_m[row]
    order = np.argsort(-paid, kind="stable")
    return [names[which] for which in order.tolist() if paid[which] > least * paid.sum()]
