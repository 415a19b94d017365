"""Where the train was from each epoch to the next, by the evidence, and what became of the position there."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import polars as pl

from pipeline.epochs.clock import confident, crossing_gap_ns, met, unambiguous, usable
from schemas.arrays import Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration


class State(IntEnum):
    """What became of a position, best first: of several the last one counts."""

    RIGHT = 0
    AFTER_ALARM = 1
    UNSEEN = 2
    UNKNOWN = 3
    ALARM = 4
    CONFIDENCE = 5
    AMBIGUOUS = 6
    OUTAGE = 7
    WRONG = 8
    WRONG_TRACK = 9
    WRONG_IN_USE = 10


FIRST_LOSS = State.ALARM
EPOCH_COLUMNS = (
    *("t", "solution", "netelement_id", "measure_m", "path_m", "error_low_m", "error_high_m", "direction"),
    *("judgement", "in_use", "on_track", "gate_probability", "confidence_m", "satellites"),
)


def states_of(epochs: pl.DataFrame, alarm_starts: pl.Series, config: Configuration) -> Ints:
    """`State` per epoch of one solution. An alarm counts where it begins; what it blocks after that does not."""
    in_use, wrong = flags(epochs, "in_use"), _is(epochs, "wrong")
    starts = epochs["t"].is_in(alarm_starts.implode()).to_numpy()
    conditions = [
        (wrong & in_use, State.WRONG_IN_USE),
        (wrong & ~np.isfinite(floats(epochs, "error_low_m")), State.WRONG_TRACK),
        (wrong, State.WRONG),
        (~met(epochs, usable() & pl.col("confidence_m").is_not_null()), State.OUTAGE),
        (~met(epochs, unambiguous(config)), State.AMBIGUOUS),
        (~met(epochs, confident(config)), State.CONFIDENCE),
        (starts, State.ALARM),
        (~in_use, State.AFTER_ALARM),
        (_is(epochs, "right"), State.RIGHT),
    ]
    states = np.select([one for one, _ in conditions], [int(state) for _, state in conditions], int(State.UNKNOWN))
    return states.astype(np.int64)


def _is(epochs: pl.DataFrame, judgement: str) -> Bools:
    return (epochs["judgement"].cast(pl.String) == judgement).fill_null(value=False).to_numpy()


def true_path_m(epochs: pl.DataFrame) -> tuple[Floats, Floats]:
    """Least and largest path position of the train: position less the judged error; NaN where nobody knows."""
    columns = ("path_m", "error_low_m", "error_high_m", "direction")
    path, low, high, direction = (floats(epochs, name) for name in columns)
    one, other = path - direction * low, path - direction * high
    return np.minimum(one, other), np.maximum(one, other)


def spans_of(epochs: pl.DataFrame, states: Ints, config: Configuration) -> pl.DataFrame:
    """One row per pair of epochs: `low_m, high_m` where the train may have been, `from_m, to_m` where it was most
    likely, `direction, state, t, one, other` (net elements of the two positions), `satellites` (the fewer of the two).

    Between two places that are known nothing but a pure outage is told of what lies between: the rest is unknown, for
    nobody knows on which piece it was. So is a place known less closely than the failure limit on both sides. What
    was wrong at an end of such a way, or of an outage, was wrong there and not along it: a row of its own.
    """
    low, high = true_path_m(epochs)
    placed = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    t_ns, names, satellites = times_ns(epochs), epochs["netelement_id"], floats(epochs, "satellites")
    here, there = placed[:-1], placed[1:]
    state = np.maximum(states[here], states[there])
    silent = (t_ns[there] - t_ns[here] > crossing_gap_ns(t_ns, config.lds)) & (there == here + 1)
    between = np.flatnonzero(there > here + 1)
    state[silent] = State.OUTAGE
    state[between] = [_between(states[here[row] + 1 : there[row]]) for row in between]
    apart = silent | (there > here + 1)
    ends = np.unique(np.concatenate([here[apart], there[apart]]))
    ends = ends[states[ends] >= State.WRONG]
    here, there, state = (np.concatenate(pair) for pair in ((here, ends), (there, ends), (state, states[ends])))
    wide = np.maximum((high - low)[here], (high - low)[there]) > 2.0 * config.hazards.failure_limit_m
    state = np.where(wide & (state < State.WRONG), int(State.UNKNOWN), state)
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
            "one": names.gather(here),
            "other": names.gather(there),
            "satellites": pl.Series(np.fmin(satellites[here], satellites[there]), nan_to_null=True),
        }
    )


def _between(inner: Ints) -> int:
    """What is known of a way whose inner epochs have no known place."""
    return int(State.OUTAGE if (inner == State.OUTAGE).all() else State.UNKNOWN)
