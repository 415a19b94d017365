"""FailureLog of the monitors over the epochs, and the alarm episodes that they make up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Ints, flags, times_ns, truths
from schemas.enums import MonitorState
from schemas.tables import MONITORS


@dataclass(frozen=True)
class AlarmSpan:
    """FailureLog less than the recovery time apart: first and last failing epoch, monitors in order of failing."""

    first: int
    last: int
    start_ns: int
    end_ns: int
    monitors: tuple[str, ...]
    peak_ratio: float


@dataclass(frozen=True)
class FailureLog:
    """All epochs' times, the epochs in which a monitor fails, and the alarm episodes."""

    t_ns: Ints
    negated: Bools
    epochs: Ints
    first_monitor: tuple[str, ...]
    alarms: tuple[AlarmSpan, ...]

    def first_in(self, begin_ns: int, end_ns: int) -> tuple[int, str] | None:
        """First fail in `begin <= t < end`: time and monitor."""
        stamps = self.t_ns[self.epochs]
        index = int(np.searchsorted(stamps, begin_ns))
        if index == stamps.size or stamps[index] >= end_ns:
            return None
        return int(stamps[index]), self.first_monitor[index]

    def standing_at(self, instant_ns: int) -> str | None:
        """First monitor of the alarm that stands just before the instant, by its fails or by negation."""
        spanning = [a for a in self.alarms if a.start_ns < instant_ns <= a.end_ns]
        if spanning:
            return spanning[0].monitors[0]
        before = int(np.searchsorted(self.t_ns, instant_ns)) - 1
        earlier = [a for a in self.alarms if a.end_ns < instant_ns]
        if before >= 0 and self.negated[before] and earlier:
            return earlier[-1].monitors[0]
        return None

    def failed_in(self, first: int, last: int) -> tuple[str, ...]:
        """Monitors of all alarms that overlap the epochs `first..last`."""
        names = [name for a in self.alarms if a.first <= last and a.last >= first for name in a.monitors]
        return tuple(dict.fromkeys(names))

    def start_within(self, begin_ns: int, end_ns: int) -> int | None:
        """Start of the first alarm that came in `begin <= t < end`."""
        return next((a.start_ns for a in self.alarms if begin_ns <= a.start_ns < end_ns), None)


def failure_log_of(epochs: pl.DataFrame, recovery_s: float) -> FailureLog:
    """FailureLog of one solution's epochs; monitors that the frame does not hold were not evaluated."""
    t_ns = times_ns(epochs)
    monitors = [name for name in MONITORS if f"{name}_state" in epochs.columns]
    failing = {name: _failing(epochs, name) for name in monitors}
    any_fail = np.zeros(t_ns.size, dtype=np.bool_)
    for mask in failing.values():
        any_fail |= mask
    rows = np.flatnonzero(any_fail)
    matrix = np.column_stack([failing[name][rows] for name in monitors]) if monitors else np.zeros((0, 0), np.bool_)
    first = tuple(monitors[index] for index in matrix.argmax(axis=1).tolist()) if rows.size else ()
    spans = _spans(epochs, t_ns, rows, matrix, monitors, recovery_s)
    return FailureLog(t_ns, flags(epochs, "negated"), rows, first, spans)


def _failing(epochs: pl.DataFrame, monitor: str) -> Bools:
    return truths(epochs[f"{monitor}_state"] == MonitorState.FAIL.value)


def _spans(
    epochs: pl.DataFrame, t_ns: Ints, rows: Ints, matrix: Bools, monitors: list[str], recovery_s: float
) -> tuple[AlarmSpan, ...]:
    if rows.size == 0:
        return ()
    breaks = np.flatnonzero(np.diff(t_ns[rows]) >= recovery_s * NS_PER_S) + 1
    spans = []
    for part in np.split(np.arange(rows.size), breaks):
        first, last = int(rows[part[0]]), int(rows[part[-1]])
        names = _in_order(matrix[part], monitors)
        peak = _peak(epochs[first : last + 1], names)
        spans.append(AlarmSpan(first, last, int(t_ns[first]), int(t_ns[last]), names, peak))
    return tuple(spans)


def _in_order(matrix: Bools, monitors: list[str]) -> tuple[str, ...]:
    """Monitors that failed, by their first fail; those of one epoch in the order of the contract."""
    failed = np.flatnonzero(matrix.any(axis=0))
    by_time = sorted(failed.tolist(), key=lambda column: (int(matrix[:, column].argmax()), column))
    return tuple(monitors[column] for column in by_time)


def _peak(epochs: pl.DataFrame, monitors: tuple[str, ...]) -> float:
    """Largest |value| / threshold where one of the monitors fails; 0 where neither is recorded."""
    ratios = [
        epochs.select(
            (pl.col(f"{name}_value").abs() / pl.col(f"{name}_threshold"))
            .filter((pl.col(f"{name}_state") == MonitorState.FAIL.value) & (pl.col(f"{name}_threshold") > 0))
            .max()
        ).item()
        for name in monitors
    ]
    return max((float(ratio) for ratio in ratios if ratio is not None), default=0.0)
