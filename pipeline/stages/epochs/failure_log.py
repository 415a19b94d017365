"""The failure log: which monitor failed first at each epoch, and the alarm episodes that the fails make up."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import FAIL
from schemas.arrays import NS_PER_S, Bools, Ints, flags, ints, times_ns, truths
from schemas.enums import MonitorState
from schemas.frozen import frozen
from schemas.tables import MONITORS


@frozen
class AlarmEpisode:
    """Fails less than the recovery time apart: first and last failing epoch, monitors in order of failing."""

    first: int
    last: int
    start_ns: int
    end_ns: int
    monitors: tuple[str, ...]
    peak_ratio: float


@frozen
class FailureLog:
    """All epochs' times and where they are negated, the failing epochs with their first monitor, and the alarms."""

    t_ns: Ints
    negated: Bools
    failing: Ints
    first_monitor: tuple[str, ...]
    alarms: tuple[AlarmEpisode, ...]

    def first_in(self, begin_ns: int, end_ns: int) -> tuple[int, str] | None:
        """First fail in `begin <= t < end`: time and monitor."""
        stamps = self.t_ns[self.failing]
        index = int(np.searchsorted(stamps, begin_ns))
        if index == stamps.size or stamps[index] >= end_ns:
            return None
        return int(stamps[index]), self.first_monitor[index]

    def standing_at(self, instant_ns: int) -> str | None:
        """First monitor of the alarm that stands just before the instant, by its fails or by negation."""
        begun = [alarm for alarm in self.alarms if alarm.start_ns < instant_ns]
        before = int(np.searchsorted(self.t_ns, instant_ns)) - 1
        stands = begun and (instant_ns <= begun[-1].end_ns or (before >= 0 and self.negated[before]))
        return begun[-1].monitors[0] if stands else None

    def start_within(self, begin_ns: int, end_ns: int) -> int | None:
        """Start of the first alarm that came in `begin <= t < end`."""
        return next((alarm.start_ns for alarm in self.alarms if begin_ns <= alarm.start_ns < end_ns), None)


def failure_log(epochs: pl.DataFrame, recovery_s: float) -> FailureLog:
    """Of one solution's epochs, with `negated`; monitors that the frame does not hold were not evaluated."""
    t_ns = times_ns(epochs)
    monitors = [name for name in MONITORS if f"{name}_state" in epochs.columns]
    columns = [_fails(epochs[f"{name}_state"]) for name in monitors]
    failed = np.column_stack(columns) if columns else np.zeros((t_ns.size, 0), np.bool_)
    rows = np.flatnonzero(failed.any(axis=1))
    breaks = np.flatnonzero(np.diff(t_ns[rows]) >= recovery_s * NS_PER_S) + 1
    parts = [part for part in np.split(rows, breaks) if part.size]
    return FailureLog(
        t_ns=t_ns,
        negated=flags(epochs, "negated"),
        failing=rows,
        first_monitor=tuple(monitors[failed[row].argmax()] for row in rows.tolist()),
        alarms=tuple(_alarm(epochs, t_ns, part, failed[part], monitors) for part in parts),
    )


def _fails(state: pl.Series) -> Bools:
    """Where a monitor fails."""
    if isinstance(state.dtype, pl.Enum):
        # By number, several times faster than by word: a replay asks for each of its monitors.
        return np.asarray(ints(state.to_physical()) == FAIL)
    return truths(state == MonitorState.FAIL.value)


def _alarm(epochs: pl.DataFrame, t_ns: Ints, rows: Ints, failed: Bools, monitors: list[str]) -> AlarmEpisode:
    """One alarm of the failing epochs `rows`; `failed`: at each which monitors."""
    first = int(rows[0])
    last = int(rows[-1])
    # By their first fail; those of one epoch in the order of the contract.
    columns = sorted(np.flatnonzero(failed.any(axis=0)).tolist(), key=lambda column: failed[:, column].argmax())
    names = tuple(monitors[column] for column in columns)
    peak = _peak(epochs[first : last + 1], names)
    return AlarmEpisode(first, last, int(t_ns[first]), int(t_ns[last]), names, peak)


def _peak(epochs: pl.DataFrame, monitors: tuple[str, ...]) -> float:
    """Largest |value| / threshold where one of the monitors fails; 0 where neither is recorded."""
    failing = {
        name: (pl.col(f"{name}_state") == MonitorState.FAIL.value) & (pl.col(f"{name}_threshold") > 0)
        for name in monitors
    }
    ratios = epochs.select(
        (pl.col(f"{name}_value").abs() / pl.col(f"{name}_threshold")).filter(condition).max().alias(name)
        for name, condition in failing.items()
    )
    return max((float(ratio) for ratio in ratios.row(0) if ratio is not None), default=0.0)
