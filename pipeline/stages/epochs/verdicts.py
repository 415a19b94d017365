"""What a monitor says of each epoch: value, threshold, state and reason, for every monitor in the same way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, ints, times_ns, truths
from schemas.enums import MonitorState, NotEvaluated
from schemas.frozen import frozen
from schemas.stages import NO_REASON, REASONS, reason_words
from schemas.tables import MONITORS

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

    def columns(self, name: str) -> list[pl.Series]:
        """Columns of `epochs` for the monitor of this name; null where it is not evaluated."""
        return [
            pl.Series(f"{name}_value", self.value, nan_to_null=True),
            pl.Series(f"{name}_threshold", self.threshold, nan_to_null=True),
            _STATE_WORDS[pl.Series(self.state.astype(np.uint32))].alias(f"{name}_state"),
            reason_words(self.reason).alias(f"{name}_reason"),
        ]


def states_of(value: Floats, threshold: Floats, evaluated: Bools) -> States:
    """Beyond its threshold a monitor fails; what is evaluated and cannot be compared is no pass."""
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


def otherwise(reasons: Ints, others: Ints | NotEvaluated) -> Ints:
    """The reasons, and where there are none the others."""
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
    """Fails and alarms of one solution.

    Args:
        epochs: its epochs in order, with `t`, `negated` and the columns of the monitors; monitors that the frame does
            not hold were not evaluated.
        recovery_s: fails no farther apart are one alarm [s].

    Returns:
        Failing epochs with their first monitor, and the alarms.
    """
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
    """Whether a monitor fails at each epoch."""
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
