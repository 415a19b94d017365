"""What a monitor says of each epoch: value, threshold, state and reason, for every monitor in the same way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Floats, Ints, Rows, floats, ints
from schemas.config import LdsConfig
from schemas.enums import MonitorState, NotEvaluated
from schemas.frozen import frozen
from schemas.monitors import MONITORS
from schemas.stages import NO_REASON, REASONS, AlignedEpochs, LdsEpochs, reason_words

# Reasons that several monitors give.
DISABLED = NotEvaluated.DISABLED
NO_ODOMETER = NotEvaluated.NO_ODOMETER
NO_POSITION = NotEvaluated.NO_POSITION
NO_SIGMA = NotEvaluated.NO_SIGMA
NO_VALUE = NotEvaluated.NO_VALUE

States = npt.NDArray[np.int8]
"""Numbers of states in `STATES`."""
STATES = [state.value for state in MonitorState]
PASS, FAIL, NOT_EVALUATED = (
    STATES.index(state) for state in (MonitorState.PASS, MonitorState.FAIL, MonitorState.NOT_EVALUATED)
)
NUMBER = {reason: number for number, reason in enumerate(REASONS)}
"""Of each reason in `schemas.stages.REASONS`."""
_NUMBERS = {reason.value: number for reason, number in NUMBER.items()}
# Made once: a replay asks for them at every monitor, and an enumeration takes longer to make than to index.
_STATE_WORDS = pl.Series(STATES, dtype=pl.Enum(STATES))


@frozen
class Verdicts:
    """What one monitor says of each epoch; arrays of shape (epochs,)."""

    value: Floats
    """What is tested, in the unit of the monitor; NaN where it is not evaluated."""
    threshold: Floats
    """Beyond it the monitor fails; NaN where it is not evaluated."""
    state: States
    """By number in `STATES`."""
    reason: Ints
    """Why it is not evaluated, by number in `REASONS`; `NO_REASON` where it is."""

    @property
    def fails(self) -> Bools:
        """Epochs at which the monitor fails."""
        return np.asarray(self.state == FAIL)

    def without_passes(self, reason: NotEvaluated) -> Verdicts:
        """Verdicts of a monitor that can find a fault, but not say that there is none."""
        void = self.state == PASS
        return Verdicts(
            value=np.where(void, np.nan, self.value),
            threshold=np.where(void, np.nan, self.threshold),
            state=np.where(void, NOT_EVALUATED, self.state).astype(np.int8),
            reason=np.where(void, NUMBER[reason], self.reason),
        )

    @property
    def evaluated(self) -> Bools:
        """Epochs at which the monitor passes or fails, shape (epochs,)."""
        return np.asarray(self.state != NOT_EVALUATED)

    def at(self, rows: Rows) -> Verdicts:
        """The verdicts of some epochs, by their numbers or a mask."""
        return Verdicts(self.value[rows], self.threshold[rows], self.state[rows], self.reason[rows])

    @classmethod
    def of_table(cls, table: pl.DataFrame, name: str) -> Verdicts:
        """Verdicts by the columns of the `epochs` table; what the table lacks of them is not known."""
        nothing = np.full(table.height, np.nan)
        value, threshold = (
            floats(table, column) if column in table.columns else nothing
            for column in (f"{name}_value", f"{name}_threshold")
        )
        state = ints(table[f"{name}_state"].cast(_STATE_WORDS.dtype).to_physical(), NOT_EVALUATED).astype(np.int8)
        reason = np.full(table.height, NO_REASON)
        if f"{name}_reason" in table.columns:
            reason = ints(table[f"{name}_reason"].replace_strict(_NUMBERS, default=None, return_dtype=pl.Int64))
        return cls(value, threshold, state, reason)

    def columns(self, name: str) -> list[pl.Series]:
        """Columns of `epochs` for the monitor of this name; null where it is not evaluated."""
        return [
            pl.Series(f"{name}_value", self.value, nan_to_null=True),
            pl.Series(f"{name}_threshold", self.threshold, nan_to_null=True),
            _STATE_WORDS[pl.Series(self.state.astype(np.uint32))].alias(f"{name}_state"),
            reason_words(self.reason).alias(f"{name}_reason"),
        ]


def states_of(value: Floats, threshold: Floats, evaluated: Bools) -> States:
    """The state by number of each epoch: beyond its threshold a monitor fails.

    What is evaluated and cannot be compared is no pass.
    """
    failing = ~(np.abs(value) <= threshold)
    return np.where(evaluated, np.where(failing, FAIL, PASS), NOT_EVALUATED).astype(np.int8)


def verdicts(value: Floats, threshold: Floats, reasons: Ints, state: States | None = None) -> Verdicts:
    """The verdicts of a monitor.

    What has no reason and yet no value or threshold is not evaluated either: absence is never health.

    Args:
        value: what is tested, in the unit of the monitor, shape (n,).
        threshold: beyond it the monitor fails, shape (n,).
        reasons: why it is not evaluated, by number, `NO_REASON` where it is (`first_reason`), shape (n,).
        state: states by number, where the monitor gives them already, shape (n,).

    Returns:
        Verdicts of n rows, NaN where not evaluated.
    """
    unexplained = reasons == NO_REASON
    if state is None:
        known = np.isfinite(value) & np.isfinite(threshold)
        state = states_of(value, threshold, known & unexplained)
    unknown = state == NOT_EVALUATED
    return Verdicts(
        value=np.where(unknown, np.nan, value),
        threshold=np.where(unknown, np.nan, threshold),
        state=state,
        reason=np.where(unknown, np.where(unexplained, NUMBER[NO_VALUE], reasons), NO_REASON),
    )


def no_verdicts(epochs: int, reason: NotEvaluated) -> Verdicts:
    """Verdicts of a monitor that has nothing to look at in the whole run."""
    nothing = np.full(epochs, np.nan)
    return verdicts(nothing, nothing, np.full(epochs, NUMBER[reason]))


def first_reason(*reasons: tuple[Bools, NotEvaluated | Ints]) -> Ints:
    """The first reason whose mask holds at each epoch, or `NO_REASON`; a reason may be given per epoch."""
    first = np.full(reasons[0][0].shape, NO_REASON)
    for mask, reason in reversed(reasons):
        number = NUMBER[reason] if isinstance(reason, NotEvaluated) else reason
        first = np.where(mask if isinstance(reason, NotEvaluated) else mask & (reason != NO_REASON), number, first)
    return first


def fill_reasons(reasons: Ints, others: Ints | NotEvaluated) -> Ints:
    """The reasons by number, and those of `others` where there is none, shape (epochs,)."""
    return np.where(reasons != NO_REASON, reasons, NUMBER[others] if isinstance(others, NotEvaluated) else others)


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
        """First fail in `begin <= t < end`: instant [ns] and monitor; None without one."""
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
        """Start [ns] of the first alarm that began in `begin <= t < end`; None without one."""
        return next((alarm.start_ns for alarm in self.alarms if begin_ns <= alarm.start_ns < end_ns), None)


def failure_log(t_ns: Ints, negated: Bools, monitors: Mapping[str, Verdicts], recovery_s: float) -> FailureLog:
    """Fails and alarms of one solution.

    Args:
        t_ns: stamps of its epochs in order [ns], shape (epochs,).
        negated: where the LDS negated the position, shape (epochs,).
        monitors: verdicts by the name of the monitor; those that are not given were not evaluated.
        recovery_s: fails no farther apart are one alarm [s].

    Returns:
        Failing epochs with their first monitor, and the alarms.
    """
    names = [name for name in MONITORS if name in monitors]
    failed = np.array([monitors[name].fails for name in names], dtype=np.bool_).reshape(len(names), t_ns.size)
    rows = np.flatnonzero(failed.any(axis=0))
    breaks = np.flatnonzero(np.diff(t_ns[rows]) >= recovery_s * NS_PER_S) + 1
    parts = [part for part in np.split(rows, breaks) if part.size]
    return FailureLog(
        t_ns=t_ns,
        negated=negated,
        failing=rows,
        first_monitor=tuple(names[first] for first in failed[:, rows].argmax(axis=0).tolist()) if names else (),
        alarms=tuple(_alarm_episode(t_ns, part, failed[:, part], names, monitors) for part in parts),
    )


def _alarm_episode(
    t_ns: Ints, rows: Ints, failed: Bools, monitors: list[str], verdicts_of: Mapping[str, Verdicts]
) -> AlarmEpisode:
    """One alarm of the failing epochs `rows`; `failed`: of each monitor at which of them."""
    first = int(rows[0])
    last = int(rows[-1])
    # By their first fail; those of one epoch in the order of the contract.
    failing = sorted(np.flatnonzero(failed.any(axis=1)).tolist(), key=lambda monitor: failed[monitor].argmax())
    names = tuple(monitors[monitor] for monitor in failing)
    peak = max((_peak_ratio(verdicts_of[name], slice(first, last + 1)) for name in names), default=0.0)
    return AlarmEpisode(first, last, int(t_ns[first]), int(t_ns[last]), names, peak)


def _peak_ratio(monitor: Verdicts, part: slice) -> float:
    """Largest |value| / threshold where the monitor fails; 0 where neither is recorded."""
    threshold = monitor.threshold[part]
    failing = monitor.fails[part] & (threshold > 0.0)
    ratios = np.abs(monitor.value[part][failing]) / threshold[failing]
    return float(ratios[~np.isnan(ratios)].max(initial=0.0))


@frozen
class MonitoredEpochs(AlignedEpochs, LdsEpochs):
    """`AlignedEpochs` and `LdsEpochs` with the verdicts of all monitors, by name."""

    verdicts: Mapping[str, Verdicts]

    def series(self) -> list[pl.Series]:
        """All columns, for studies that read tables."""
        monitors = [column for name, one in self.verdicts.items() for column in one.columns(name)]
        return [*super().series(), pl.Series("withheld", self.withheld), *monitors]

    def where(self, rows: Ints) -> Self:
        """The monitored epochs with these numbers."""
        if rows.size == self.height:
            return self
        parts = {one.name: _column_at_rows(getattr(self, one.name), rows) for one in fields(self)}
        return type(self)(**parts | {"verdicts": {name: one.at(rows) for name, one in self.verdicts.items()}})

    def trusted(self, config: LdsConfig) -> Bools:
        """Epochs whose position is valid, confident and unambiguous (CONTRACT section 3, `mtbf_h`)."""
        return np.asarray(self.usable & self.confident(config.ci_limit_m) & self.unambiguous)

    def confident(self, limit_m: float) -> Bools:
        """The confidence interval along the track is within its limit [m]."""
        return np.asarray(self.confidence_m <= limit_m)


def _column_at_rows(values: Any, rows: Ints) -> Any:
    """Some of the epochs of one column; what is not by epoch stays whole."""
    if isinstance(values, np.ndarray):
        return values[rows]
    return values.at(rows) if hasattr(values, "at") else values
