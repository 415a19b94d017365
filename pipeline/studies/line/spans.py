"""Where the train was from each epoch to the next, by the evidence, and what became of the position there."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import polars as pl

from pipeline.results.places import train_path_m
from pipeline.stages.epochs.clock import confident, crossing_gaps_ns, holds_at_rows, unambiguous, usable
from schemas.arrays import Bools, Ints, flags, floats, times_ns
from schemas.config import Configuration


class SpanState(IntEnum):
    """What became of a position, best first: of several the last one counts."""

    RIGHT = 0
    AFTER_ALARM = 1
    NOT_COVERED = 2
    UNKNOWN = 3
    ALARM = 4
    CONFIDENCE = 5
    AMBIGUOUS = 6
    OUTAGE = 7
    WRONG = 8
    WRONG_TRACK = 9
    WRONG_IN_USE = 10


FIRST_LOSS = SpanState.ALARM
EPOCH_COLUMNS = (
    *("t", "solution", "netelement_id", "measure_m", "path_m", "error_low_m", "error_high_m", "direction"),
    *("true_netelement_ids", "true_measure_low_m", "true_measure_high_m"),
    *("judgement", "in_use", "on_track", "gate_probability", "confidence_m", "satellites"),
)


def states_of(epochs: pl.DataFrame, alarm_starts: pl.Series, config: Configuration) -> Ints:
    """`SpanState` per epoch of one solution. An alarm counts where it begins; what it blocks after that does not."""
    in_use = flags(epochs, "in_use")
    wrong = _have_judgement(epochs, "wrong")
    starts = epochs["t"].is_in(alarm_starts.implode()).to_numpy()
    conditions = [
        (wrong & in_use, SpanState.WRONG_IN_USE),
        (wrong & ~np.isfinite(floats(epochs, "error_low_m")), SpanState.WRONG_TRACK),
        (wrong, SpanState.WRONG),
        (~holds_at_rows(epochs, usable() & pl.col("confidence_m").is_not_null()), SpanState.OUTAGE),
        (~holds_at_rows(epochs, unambiguous()), SpanState.AMBIGUOUS),
        (~holds_at_rows(epochs, confident(config)), SpanState.CONFIDENCE),
        (starts, SpanState.ALARM),
        (~in_use, SpanState.AFTER_ALARM),
        (_have_judgement(epochs, "right"), SpanState.RIGHT),
    ]
    states = np.select(
        [condition for condition, _ in conditions], [int(state) for _, state in conditions], int(SpanState.UNKNOWN)
    )
    return states.astype(np.int64)


def _have_judgement(epochs: pl.DataFrame, judgement: str) -> Bools:
    """Which epochs have a judgement."""
    return (epochs["judgement"].cast(pl.String) == judgement).fill_null(value=False).to_numpy()


def spans_of(epochs: pl.DataFrame, states: Ints, stretches: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """One row per pair of epochs: `low_m, high_m` where the train may have been, `from_m, to_m` where it was most
    likely, `direction, state, t, elements` (net elements of the train there), `satellites` (the fewer of the two).

    Between two places that are known the worst counts of what lies between where that is a pure outage, or the
    evidence leaves only net elements between them (at a joint both of them): else it is unknown, for nobody knows on
    which piece it was. So is a place known less closely than the failure limit on both sides. What
    was wrong at an end of such a stretch, or of an outage, was wrong there and not along it: a row of its own.
    """
    low, high = train_path_m(epochs, stretches)
    placed = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    t_ns = times_ns(epochs)
    satellites = floats(epochs, "satellites")
    possible = epochs["true_netelement_ids"].to_list()
    here = placed[:-1]
    there = placed[1:]
    state = np.maximum(states[here], states[there])
    in_gap = (t_ns[there] - t_ns[here] > crossing_gaps_ns(t_ns, config.lds)[there]) & (there == here + 1)
    between = np.flatnonzero(there > here + 1)
    state[in_gap] = SpanState.OUTAGE
    for row in between:
        inner = slice(here[row] + 1, there[row])
        elements = _elements_between(
            stretches, min(low[here[row]], low[there[row]]), max(high[here[row]], high[there[row]])
        )
        state[row] = _inner_state(state[row], states[inner], possible[inner], elements)
    apart = in_gap | (there > here + 1)
    ends = np.unique(np.concatenate([here[apart], there[apart]]))
    ends = ends[states[ends] >= SpanState.WRONG]
    here, there, state = (np.concatenate(pair) for pair in ((here, ends), (there, ends), (state, states[ends])))
    wide = np.maximum((high - low)[here], (high - low)[there]) > config.hazards.limits.span_m
    state = np.where(wide & (state < SpanState.WRONG), int(SpanState.UNKNOWN), state)
    middle = 0.5 * (low + high)
    return pl.DataFrame(
        {
            "low_m": np.minimum(low[here], low[there]),
            "high_m": np.maximum(high[here], high[there]),
            "from_m": np.minimum(middle[here], middle[there]),
            "to_m": np.maximum(middle[here], middle[there]),
            "direction": epochs["direction"].gather(there),
            "state": state,
            "t": epochs["t"].gather(here),
            "elements": _possible_elements(possible, here, there),
            "satellites": pl.Series(np.fmin(satellites[here], satellites[there]), nan_to_null=True),
        }
    )


def _elements_between(stretches: pl.DataFrame, begin_m: float, end_m: float) -> set[str]:
    """Net elements that the path leads over between two path positions."""
    return set(stretches.filter((pl.col("last_m") >= begin_m) & (pl.col("first_m") <= end_m))["netelement_id"])


def _inner_state(ends: int, inner: Ints, possible: list[list[str] | None], elements: set[str]) -> int:
    """What is known of a stretch whose inner epochs have no known place; `ends`: the worse of its two ends."""
    if (inner == SpanState.OUTAGE).all():
        return int(SpanState.OUTAGE)
    if all(names and elements.issuperset(names) for names in possible):
        return int(max(ends, inner.max()))
    return int(SpanState.UNKNOWN)


def _possible_elements(possible: list[list[str] | None], here: Ints, there: Ints) -> pl.Series:
    """Net elements on which the train may have been from one epoch to the other."""
    pairs = zip(here.tolist(), there.tolist(), strict=True)
    names_of_spans = [
        sorted({name for names in possible[begin : end + 1] for name in names or ()}) for begin, end in pairs
    ]
    return pl.Series(names_of_spans, dtype=pl.List(pl.String))
