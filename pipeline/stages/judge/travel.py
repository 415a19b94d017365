"""Did the train move, which way, does its odometer count wrong: by odometer and evidence, never by the positions.

What an odometer says of motion and continuity is asked of `Odometry` (`moved`, `steps_m`). Here stands what a reference
says of the same, and the odometer as the LDS used it held against the evidence.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.evidence.evidence import Span
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.judgement import REFERENCE, Judgements
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, spans_of, times_ns
from schemas.config import Configuration, HazardConfig, LdsConfig
from schemas.frozen import frozen


@frozen
class OdometerSteps:
    """From each epoch to the next: `counts`, the odometer has no gap there; `moves`, it shows movement.

    `stood`: times [ns] in which it shows none while positions leave their place by more than the failure limit.
    """

    moves: Bools
    counts: Bools
    stood: tuple[Span, ...] = ()


def odometer_steps(case: Case) -> OdometerSteps:
    """What the odometer says of the steps between the epochs; without one, or of unknown origin, nothing of motion."""
    at_ns = case.instants_of_epochs()
    odometry = case.odometry
    # One that may be made of the positions tells no motion (DOMAIN section 5.0).
    if odometry is None or not odometry.independent:
        return OdometerSteps(*np.zeros((2, at_ns.size), dtype=np.bool_))
    moves = _to_the_next(odometry.moved(at_ns), at_ns.size)
    counts = _to_the_next(np.isfinite(odometry.steps_m(at_ns)), at_ns.size)
    path_m = floats(case.solution.epochs, "path_m")
    stood: list[Span] = []
    for first, last in spans_of(counts & ~moves):
        rows = slice(first, min(last + 2, at_ns.size))
        places_m = path_m[rows][np.isfinite(path_m[rows])]
        if np.abs(places_m - places_m[:1]).max(initial=0.0) > case.config.hazards.limits.stand_m:
            stood.append((int(at_ns[rows][0]), int(at_ns[rows][-1])))
    return OdometerSteps(moves, counts, tuple(stood))


def travel_direction(
    direction: Ints, along: Judgements, at_ns: Ints, path_m: Floats, has_odometer: bool, config: HazardConfig
) -> Ints:
    """Direction of travel along growing path, 1 or -1, per epoch; `direction`: as the LDS knew it.

    Without an odometer the evidence decides, as a position that jumps back does not turn the train. With one the
    odometer does, unless the reference shows that it counts up in reverse.
    """
    train_m = path_m - along.known_m(config.known_error_m)
    moved_m, noise_m, _ = _moved_m(at_ns, train_m, along.half_m, config.turn_s)
    sure = np.abs(moved_m) > noise_m
    by_reference = along.kind == REFERENCE
    if has_odometer:
        # Not over a turn: the odometer knows best when that was.
        turned_by, _, _ = _moved_m(at_ns, direction.astype(np.float64), along.half_m, config.turn_s)
        sure &= by_reference & (turned_by == 0.0)
    rows = np.flatnonzero(sure)
    if rows.size == 0:
        return direction
    last = rows[np.maximum(np.searchsorted(rows, np.arange(at_ns.size), side="right") - 1, 0)]
    sense = np.sign(moved_m[last]).astype(np.int64)
    if not has_odometer:
        return sense
    # Until the reference says otherwise, the odometer agrees with it, or contradicts it, as at the last sure epoch.
    return direction * np.where(by_reference, sense * direction[last], 1)


def moving(
    at_ns: Ints, reference_m: Floats, half_m: Floats, steps: OdometerSteps, stood: Bools, config: Configuration
) -> pl.Series:
    """Per epoch whether the train moves to the next one, null where neither reference nor odometer knows.

    By the reference (`reference_m` +- `half_m`) it does where its way over a second exceeds dead band and noise.
    """
    moved_m, noise_m, elapsed_s = _moved_m(at_ns, reference_m, half_m, config.align.speed_window_s)
    by_reference = np.abs(moved_m) > config.matching.deadband_mps * elapsed_s + noise_m
    moves = by_reference | (steps.moves & steps.counts)
    sure = np.isfinite(moved_m) | (steps.counts & ~stood)
    frame = pl.DataFrame({"moving": _to_the_next(moves[:-1], at_ns.size), "sure": _to_the_next(sure[:-1], at_ns.size)})
    return frame.select(pl.when("sure").then("moving")).to_series()


def _moved_m(at_ns: Ints, place_m: Floats, half_m: Floats, window_s: float) -> tuple[Floats, Floats, Floats]:
    """From each epoch to the one `window_s` later: the way [m], the half intervals of both places [m], the time [s]."""
    ahead = np.searchsorted(at_ns, at_ns + round(window_s * NS_PER_S)).clip(0, at_ns.size - 1)
    return place_m[ahead] - place_m, half_m + half_m[ahead], (at_ns[ahead] - at_ns) / NS_PER_S


def _to_the_next(steps: Bools, size: int) -> Bools:
    """Steps as a column of epochs: each epoch has that of the step after it, the last epoch that of the step before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]


def beyond_confidence(
    t_ns: Ints, odometer_m: Floats, train_m: Floats, half_m: Floats, accepted_ns: Ints, lds: LdsConfig
) -> Bools:
    """The distance counted since the last accepted VB is wrong by more than 5 m + 5 % (SUBSET-041 5.3.1.1).

    `train_m` +- `half_m`: path position of the train, NaN where not known; the error counts where it exceeds the
    allowance and the half intervals of both places.
    """
    beyond = np.zeros(t_ns.size, dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(odometer_m) & np.isfinite(train_m))
    last = np.searchsorted(accepted_ns, t_ns[rows], side="right") - 1
    rows = rows[last >= 0]
    if rows.size == 0:
        return beyond
    since_ns = (t_ns[rows] - t_ns[rows[0]]).astype(np.float64)
    accepted = (accepted_ns[last[last >= 0]] - t_ns[rows[0]]).astype(np.float64)
    odometer_then_m, train_then_m, half_then_m = (
        np.interp(accepted, since_ns, values[rows]) for values in (odometer_m, train_m, half_m)
    )
    counted_m = odometer_m[rows] - odometer_then_m
    driven_m = train_m[rows] - train_then_m
    allowed_m = lds.odometer_fixed_m + lds.odometer_share * np.abs(counted_m) + half_m[rows] + half_then_m
    beyond[rows] = np.abs(counted_m - driven_m) > allowed_m
    return beyond


def speed_at(epochs: pl.DataFrame, t_ns: Ints) -> Floats:
    """Speed [m/s] as the epochs around each instant show it, the train's own; NaN where no epoch knows it."""
    known = epochs.filter(pl.col("speed_mps").is_not_null())
    if known.is_empty():
        return np.full(t_ns.size, np.nan)
    begin_ns = times_ns(epochs)[0]
    at_s, stamps_s = ((values - begin_ns) / NS_PER_S for values in (t_ns, times_ns(known)))
    return np.asarray(np.interp(at_s, stamps_s, np.abs(floats(known, "speed_mps"))))
