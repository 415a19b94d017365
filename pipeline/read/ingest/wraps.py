"""Counters that begin anew when their digits or bits are used up: found, and counted on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, Ints, times_ns
from schemas.config import IngestConfig, WrapsConfig

# Bits and decimal digits of counters; tachographs and wheel sensors count in these.
_SIZES = (*(2**bits for bits in (8, 10, 12, 14, 15, 16, 20, 24, 31, 32)), *(10**digits for digits in range(3, 10)))
# What one count may be in the unit of a recorded value that is no whole number.
_COUNTS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
# So many of these are tried, the largest that fit.
_TRIED = 2
# Numerics: written values are whole counts to so much of one.
_WHOLE = 1e-6
# Numerics: rows before and behind one that show how long its step may be.
_AROUND = 10
# For drafts, which are checked by hand.
_USUAL = WrapsConfig()


class Wrap(NamedTuple):
    """A counter begins anew after `size` of the recorded unit, so often; `certain`: the steps go on over its end."""

    size: float
    times: int
    certain: bool

    @property
    def line(self) -> str:
        """The line of the mapping that says so."""
        return f"wrap = {self.size:.10g}"


def wrap_of(values: Floats, t_ns: Ints | None = None, config: WrapsConfig = _USUAL) -> Wrap | None:
    """Where a counter begins anew; None where it does not. `values`: as recorded, NaN where empty, at `t_ns`."""
    known = np.isfinite(values)
    recorded = values[known]
    steps = np.diff(recorded)
    if steps.size < _AROUND or not np.any(np.abs(steps) > 0.5 * np.ptp(recorded)):
        return None
    paused = np.zeros(steps.size, dtype=np.bool_) if t_ns is None else _are_pauses(t_ns[known], config)
    tried = (_wrap_by_count(count, recorded, paused, config) for count in _counts_of(recorded))
    found = [wrap for wrap in tried if wrap is not None]
    return next((wrap for wrap in found if wrap.certain), found[0] if found else None)


def _counts_of(recorded: Floats) -> list[float]:
    """What one count may be; whole numbers are counts themselves."""
    fitting = [count for count in _COUNTS if _are_whole(recorded / count)]
    return fitting[: 1 if 1.0 in fitting else _TRIED]


def _wrap_by_count(count: float, recorded: Floats, paused: Bools, config: WrapsConfig) -> Wrap | None:
    """Where a counter begins anew (`wrap_of`), if one count is so much of the recorded unit."""
    counts = recorded / count
    moves = np.diff(counts)
    usual = _usual_moves(moves)
    for size in _SIZES:
        over = np.abs(moves) >= config.named_share * size
        in_range = np.ptp(counts) < size and counts.min() >= -size // 2
        if not in_range or not over.any() or np.any(np.abs(moves[~over]) > 0.5 * size):
            continue
        rest = np.abs(np.abs(moves[over]) - size)
        limit = config.times_longer * usual[over] + 2.0
        if np.all(rest <= limit) and not paused[over].any():
            sure = size >= config.sure_size and bool(np.all(limit <= config.sure_share * size))
            return Wrap(size * count, int(over.sum()), certain=sure)
    return None


def _are_whole(counts: Floats) -> bool:
    """Whether all counts are whole numbers, but for rounding."""
    return counts.size > 0 and bool(
        np.all(np.abs(counts - np.round(counts)) <= _WHOLE * np.maximum(np.abs(counts), 1.0))
    )


def _usual_moves(moves: Floats) -> Floats:
    """The largest step near each, itself and those over the end left out."""
    near = np.where(np.abs(moves) > 0.5 * np.abs(moves).max(), 0.0, np.abs(moves))
    padded = np.pad(near, _AROUND)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1).max(axis=1))


def _are_pauses(t_ns: Ints, config: WrapsConfig) -> Bools:
    """Steps of time that are much longer than usual."""
    steps_ns = np.diff(t_ns)
    return np.asarray(steps_ns > config.pause_steps * np.median(steps_ns))


def unwrap(values: Floats, size: float) -> Floats:
    """The values of a counter that begins anew after `size`, each step the shorter way round; NaN stays."""
    known = np.flatnonzero(np.isfinite(values))
    recorded = values[known]
    turns = np.concatenate([[0.0], np.cumsum(-np.round(np.diff(recorded) / size))])
    whole = values.copy()
    whole[known] = recorded + size * turns[: known.size]
    return whole


class UnwrappedColumn(NamedTuple):
    """A column that counts on, and what was found of each of its counters."""

    column: pl.Series
    found: list[Wrap]


def with_whole_counts(
    column: pl.Series, t_ns: Ints | None, declared: float | None, sensors: pl.Series | None, config: WrapsConfig
) -> UnwrappedColumn:
    """A recorded counter over its ends: as `declared`, else where it is certain. `sensors`: by row."""
    values = column.cast(pl.Float64).to_numpy().copy()
    found: list[Wrap] = []
    for rows in _rows_by_sensor(sensors, values.size):
        wrap = wrap_of(values[rows], None if t_ns is None else t_ns[rows], config) if declared is None else None
        if declared is not None or (wrap is not None and wrap.certain):
            whole = unwrap(values[rows], declared or (wrap.size if wrap else 1.0))
            turned = int(np.sum(np.abs(np.diff(whole - values[rows])) > 0.0))
            found += [Wrap(declared, turned, certain=True)] if declared and turned else []
            values[rows] = whole
        found += [wrap] if wrap is not None else []
    return UnwrappedColumn(pl.Series(column.name, values).fill_nan(None), found)


def _rows_by_sensor(sensors: pl.Series | None, size: int) -> Iterable[Ints]:
    """Rows of each sensor; all rows without sensors."""
    if sensors is None:
        return [np.arange(size)]
    names = sensors.unique(maintain_order=True).to_list()
    return [np.flatnonzero((sensors == name).to_numpy()) for name in names if name is not None]


_IN_MAPPING = "`{}` in its mapping"
_IN_RUN = '`[[ingest.correct]] stream = "odometer", {}` in the configuration'


def whole_stream(odometer: pl.DataFrame, config: IngestConfig) -> tuple[pl.DataFrame, list[str]]:
    """The odometer of a run over the ends of its counters where that is certain, and what was found, for people.

    Left as it is where the configuration corrects that itself (`[[ingest.correct]] wrap`).
    """
    if odometer["distance_m"].null_count() == odometer.height:
        return odometer, []
    if any(made.stream == "odometer" and made.wrap for made in config.correct):
        return odometer, []
    t_ns = times_ns(odometer)
    whole, found = with_whole_counts(odometer["distance_m"], t_ns, None, odometer["sensor"], config.wraps)
    said = [f"{times} x {text}" for text, times in wrap_remarks(found, whole.name, _IN_RUN).items()]
    return odometer.with_columns(whole) if any(wrap.certain for wrap in found) else odometer, said


def wrap_remarks(found: Iterable[Wrap], column: str, how: str = _IN_MAPPING) -> dict[str, int]:
    """For people: what was found of a counter, and how often; `how` the line is written that counts on."""
    certain = f"(put right; {how} says so)"
    unsure = f"(kept: it may have been reset; {how} counts on)"
    said: Counter[str] = Counter()
    for wrap in found:
        what = (certain if wrap.certain else unsure).format(wrap.line)
        said[f"step of {column} over the end of its counter {what}"] += wrap.times
    return dict(said)
