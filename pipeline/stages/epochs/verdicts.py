"""What a monitor says of each epoch: value, threshold, state and reason, for every monitor in the same way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.arrays import Bools, Floats
from schemas.enums import MonitorState, NotEvaluated

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
# Made once: a replay asks for them at every monitor, and an enumeration takes longer to make than to index.
_STATE_WORDS = pl.Series(STATES, dtype=pl.Enum(STATES))
_NO_REASON = pl.Series([None], dtype=pl.String)


def states_of(value: Floats, threshold: Floats, evaluated: Bools) -> States:
    """Beyond its threshold a monitor fails; what is evaluated and cannot be compared is no pass."""
    failing = ~(np.abs(value) <= threshold)
    return np.where(evaluated, np.where(failing, FAIL, PASS), NOT_EVALUATED).astype(np.int8)


def verdicts(value: Floats, threshold: Floats, reasons: pl.Series, state: States | None = None) -> pl.DataFrame:
    """`value, threshold, state, reason` per epoch; `reasons`: why a monitor is not evaluated, null where it is.

    `state` where the monitor gives it already. Else what has no reason and yet no value or threshold is not
    evaluated either: absence is never health.
    """
    unexplained = reasons.is_null().to_numpy()
    if state is None:
        known = np.isfinite(value) & np.isfinite(threshold)
        state = states_of(value, threshold, known & unexplained)
    unknown = state == NOT_EVALUATED
    words = reasons.cast(pl.String)
    if (unknown & unexplained).any():
        words = words.fill_null(NO_VALUE)
    return pl.DataFrame(
        {
            "value": pl.Series(np.where(unknown, np.nan, value), nan_to_null=True),
            "threshold": pl.Series(np.where(unknown, np.nan, threshold), nan_to_null=True),
            "state": _STATE_WORDS[state.astype(np.uint32)],
            "reason": words.zip_with(pl.Series(unknown), _NO_REASON),
        }
    )


def without_passes(name: str, frame: pl.DataFrame, reason: str) -> list[pl.Series]:
    """The columns of a monitor that can find a fault, but not say that there is none."""
    state = pl.col(f"{name}_state")
    void = (state == STATES[PASS]).fill_null(False)
    kept = [pl.when(~void).then(f"{name}_{part}").alias(f"{name}_{part}") for part in ("value", "threshold")]
    unknown = pl.lit(STATES[NOT_EVALUATED], dtype=frame.schema[f"{name}_state"])
    return frame.select(
        *kept,
        pl.when(void).then(unknown).otherwise(state).alias(f"{name}_state"),
        pl.when(void).then(pl.lit(reason)).otherwise(f"{name}_reason").alias(f"{name}_reason"),
    ).get_columns()


def no_verdicts(epochs: int, reason: str) -> pl.DataFrame:
    """Of a monitor that has nothing to look at in the whole run."""
    nothing = np.full(epochs, np.nan)
    return verdicts(nothing, nothing, pl.Series([reason], dtype=pl.String).new_from_index(0, epochs))


def of_monitor(name: str, frame: pl.DataFrame) -> list[pl.Series]:
    """The same under the names that they have among the columns of the epochs."""
    return [column.alias(f"{name}_{column.name}") for column in frame]


def first_reason(*reasons: tuple[Bools | pl.Series, str | pl.Series]) -> pl.Series:
    """Per epoch the first reason whose mask holds, null where none does; a reason may be a column itself."""
    applying = [
        pl.when(pl.Series(mask)).then(pl.lit(reason, pl.String) if isinstance(reason, str) else reason)
        for mask, reason in reasons
    ]
    return pl.select(pl.coalesce(applying).cast(pl.String).alias("reason")).to_series()
