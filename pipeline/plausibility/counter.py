"""Direction of the counter: its speed against its distance, and what it does where the train reverses."""

from __future__ import annotations

import numpy as np

from pipeline.plausibility.check import Check, State, correction, fits, not_checked
from pipeline.plausibility.pairs import PairFit
from pipeline.plausibility.records import Places, Record
from pipeline.plausibility.robust import LEAST
from schemas.arrays import runs_of

_SIGNS = "sign of the odometer's speed against its distance"
_TURNS = "direction of the counter where the train reverses"


def sign_check(counters: dict[str, Record]) -> list[Check]:
    """Speed and distance of one odometer; none where it has not both."""
    if len(counters) < 2:
        return []
    begin_s, end_s = max(one.t_s[0] for one in counters.values()), min(one.t_s[-1] for one in counters.values())
    starts = np.linspace(begin_s, max(end_s - 10.0, begin_s), 300)
    gained = np.array([counters[name].gained(starts, starts + 10.0) for name in ("distance", "speed")])
    # By the median of what moves: a counter that is reset seems to run far, once.
    moves = np.all(np.nan_to_num(gained) != 0.0, axis=0)
    least = 0.2 * np.median(np.abs(gained[:, moves]), axis=1, keepdims=True) if moves.any() else 0.0
    moves &= np.all(np.abs(gained) > least, axis=0)
    if moves.sum() < LEAST:
        return [not_checked(_SIGNS, "hardly any movement with both")]
    falls, back = gained[:, moves] < 0
    against = float(np.mean(falls != back))
    if against > 0.9:
        # A train that runs backwards all the way is rarer than a counter of the wrong sign.
        name, does = ("distance", "falls") if falls.mean() > 0.5 else ("speed", "grows")
        lines = correction("odometer", {"distance_m" if name == "distance" else "speed_mps": -1.0})
        found, cause = f"the distance {does} at the opposite speed", f"the {name} counts backwards"
        return [Check(_SIGNS, State.IMPOSSIBLE, found, cause, lines)]
    if against > 0.1 and not back.any() and not falls.all():
        return [Check(_SIGNS, State.MISFIT, "the speed has no sign", "it stays positive where the distance falls")]
    return [fits(_SIGNS, "the same")]


def turn_check(gnss: Places, counter: Record, pair: PairFit) -> Check:
    """Whether the counter turns where the train does; stands beside a jump of the position tell nothing."""
    config, lag_s = gnss.config, pair.lag_s
    grid = np.arange(gnss.t_s[0], gnss.t_s[-1], 1.0)
    firsts, lasts = (grid[rows] for rows in runs_of(gnss.speed(grid) < config.moving_mps))
    sides = (firsts - config.heading_s, firsts), (lasts, lasts + config.heading_s)
    moved = np.stack([gnss.gained(*side) for side in sides])
    sizes = np.linalg.norm(moved, axis=2)
    gained = np.stack([counter.gained(begin + lag_s, end + lag_s) / pair.factor for begin, end in sides])
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", *moved) / sizes.prod(axis=0)
        told = np.isfinite(cosine) & (sizes.min(axis=0) > 2.0 * config.moving_mps * config.heading_s)
        told &= np.all(np.abs(np.abs(gained) - sizes) < config.heading_way * sizes, axis=0)
        reversal, onward = told & (cosine < -config.heading_cosine), told & (cosine > config.heading_cosine)
        turns = gained.prod(axis=0) < 0
    never, wrongly = int((reversal & ~turns).sum()), int((onward & turns).sum())
    if never and never == reversal.sum():
        found = f"the train reverses {never} times, the counter never does"
        advice = "Let the recorder write the distance falling, and the speed negative, while the train reverses."
        return Check(_TURNS, State.MISFIT, found, "a counter without sign", advice=advice)
    if wrongly and wrongly > 0.5 * onward.sum():
        found = f"the counter turns {wrongly} times where the train goes on"
        return Check(_TURNS, State.MISFIT, found, "the sign follows something else than the movement")
    if not (reversal | onward).any():
        return not_checked(_TURNS, "the train does not stop on the way")
    return fits(_TURNS, f"{reversal.sum()} reversals, {onward.sum()} stops")
