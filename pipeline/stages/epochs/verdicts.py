"""What a monitor says of each epoch: value, threshold, state and reason, for every monitor in the same way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.arrays import Bools, Floats, Ints
from schemas.enums import MonitorState, NotEvaluated
from schemas.frozen import frozen
from schemas.stages import NO_REASON, REASONS, reason_words

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
        return np.asarray(self.state == FAIL)

    def without_passes(self, reason: NotEvaluated) -> Verdicts:
        """Of a monitor that can find a fault, but not say that there is none."""
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
    """The verdicts of a monitor; `reasons`: why it is not evaluated, `NO_REASON` where it is (`first_reason`).

    `state` where the monitor gives it already. Else what has no reason and yet no value or threshold is not
    evaluated either: absence is never health.
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
    """Of a monitor that has nothing to look at in the whole run."""
    nothing = np.full(epochs, np.nan)
    return verdicts(nothing, nothing, np.full(epochs, NUMBER[reason]))


def first_reason(*reasons: tuple[Bools, NotEvaluated | Ints]) -> Ints:
    """Per epoch the first reason whose mask holds, `NO_REASON` where none does; a reason may be given per epoch."""
    first = np.full(reasons[0][0].shape, NO_REASON)
    for mask, reason in reversed(reasons):
        number = NUMBER[reason] if isinstance(reason, NotEvaluated) else reason
        first = np.where(mask if isinstance(reason, NotEvaluated) else mask & (reason != NO_REASON), number, first)
    return first


def otherwise(reasons: Ints, others: Ints | NotEvaluated) -> Ints:
    """The reasons, and where there are none the others."""
    return np.where(reasons != NO_REASON, reasons, NUMBER[others] if isinstance(others, NotEvaluated) else others)
