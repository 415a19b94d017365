"""Where the train was from each epoch to the next, by the evidence, and what became of the position there."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import polars as pl

from pipeline.epochs.timeline import linking_gap_s, nominal_period_s
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration


class State(IntEnum):
    """What became of a position, best first: of several the last one counts."""

    RIGHT = 0
    AFTER_ALARM = 1
    UNKNOWN = 2
    ALARM = 3
    CONFIDENCE = 4
    AMBIGUOUS = 5
    OUTAGE = 6
    WRONG = 7
    WRONG_TRACK = 8
    WRONG_IN_USE = 9


FIRST_LOSS = State.ALARM
EPOCH_COLUMNS = (
    *("t", "solution", "netelement_id", "measure_m", "path_m", "error_low_m", "error_high_m", "direction"),
    *("judgement", "in_use", "on_track", "gate_probability", "confidence_m"),
)


def states_of(epochs: pl.DataFrame, alarm_starts: pl.Series, config: Configuration) -> Ints:
    """`State` per epoch of one solution. An alarm counts where it begins; what it blocks after that does not."""
    in_use, wrong = flags(epochs, "in_use"), _is(epochs, "wrong")
    starts = epochs["t"].is_in(alarm_starts.implode()).to_numpy()
    conditions = [
        (wrong & in_use, State.WRONG_IN_USE),
        (wrong & ~np.isfinite(floats(epochs, "error_low_m")), State.WRONG_TRACK),
        (wrong, State.WRONG),
        (~(flags(epochs, "on_track") & np.isfinite(floats(epochs, "confidence_m"))), State.OUTAGE),
        (floats(epochs, "gate_probability") < config.matching.ambiguity_probability, State.AMBIGUOUS),
        (floats(epochs, "confidence_m") > config.lds.ci_limit_m, State.CONFIDENCE),
        (starts, State.ALARM),
        (~in_use, State.AFTER_ALARM),
        (_is(epochs, "right"), State.RIGHT),
    ]
    states = np.select([one for one, _ in conditions], [int(state) for _, state in conditions], int(State.UNKNOWN))
    return states.astype(np.int64)


def _is(epochs: pl.DataFrame, judgement: str) -> Bools:
    return (epochs["judgement"].cast(pl.String) == judgement).fill_null(value=False).to_numpy()


def directions_of(epochs: pl.DataFrame) -> Floats:
    """Direction of travel on growing path, kept through stops; NaN where it was never known."""
    travel = epochs["direction"].cast(pl.Float64)
    return floats(travel.replace(0.0, None).forward_fill().backward_fill().to_frame("d"), "d")


def true_path_m(epochs: pl.DataFrame, direction: Floats) -> tuple[Floats, Floats]:
    """Least and largest path position of the train: position less the judged error; NaN where nobody knows."""
    path, low, high = (floats(epochs, name) for name in ("path_m", "error_low_m", "error_high_m"))
    one, other = path - direction * low, path - direction * high
    return np.minimum(one, other), np.maximum(one, other)


def spans_of(epochs: pl.DataFrame, states: Ints, max_width_m: float) -> pl.DataFrame:
    """One row per pair of epochs: `low_m, high_m` where the train may have been, `from_m, to_m` where it was most
    likely, `direction, state, t, one, other` (net elements of the two positions).

    Between two places that are known nothing but a pure outage is told of what lies between: the rest is unknown, for
    nobody knows on which piece it was. So is a place known less closely than `max_width_m`.
    """
    direction = directions_of(epochs)
    low, high = true_path_m(epochs, direction)
    placed = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    t_ns, names = times_ns(epochs), epochs["netelement_id"]
    here, there = placed[:-1], placed[1:]
    state = np.maximum(states[here], states[there])
    outage = np.diff(t_ns)[here] > linking_gap_s(nominal_period_s(t_ns) or 0.0) * NS_PER_S if len(here) else here > 0
    state = np.where(outage & (there == here + 1), np.maximum(state, State.OUTAGE), state)
    between = np.flatnonzero(there > here + 1)
    state[between] = [_between(states[here[row] : there[row] + 1]) for row in between]
    wide = np.maximum((high - low)[here], (high - low)[there]) > max_width_m
    state = np.where(wide & (state < State.WRONG), int(State.UNKNOWN), state)
    middle = 0.5 * (low + high)
    return pl.DataFrame(
        {
            "low_m": np.minimum(low[here], low[there]),
            "high_m": np.maximum(high[here], high[there]),
            "from_m": np.minimum(middle[here], middle[there]),
            "to_m": np.maximum(middle[here], middle[there]),
            "direction": direction[there],
            "state": state,
            "t": epochs["t"].gather(here),
            "one": names.gather(here),
            "other": names.gather(there),
        }
    )


def _between(states: Ints) -> int:
    """What is known of a stretch whose inner epochs have no known place."""
    inner, ends = states[1:-1], max(int(states[0]), int(states[-1]))
    if (inner == State.OUTAGE).all():
        return max(State.OUTAGE, ends)
    return max(State.UNKNOWN, ends if ends >= State.WRONG else 0)
