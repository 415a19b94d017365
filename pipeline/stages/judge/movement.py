"""Did the train move, and which way: by the odometer and the evidence, never by the positions (DOMAIN 5.2, 5.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.evidence.evidence import KINDS, within_spans
from pipeline.stages.judge.judgement import Judgements
from pipeline.stages.odometry import Odometry
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of
from schemas.config import Configuration, HazardConfig
from schemas.enums import Evidence

Span = tuple[int, int]


@dataclass(frozen=True)
class Counted:
    """What the odometer says of each epoch, up to the next one: that the train moved, and that it counted there.

    `stood`: times in which it stood while positions left their place by more than the failure limit [ns]. Whether the
    train moved there nobody knows by the odometer.
    """

    moves: Bools
    heard: Bools
    stood: list[Span]


def counted_of(odometry: Odometry | None, at_ns: Ints, path_m: Floats, limit_m: float) -> Counted:
    if odometry is None:
        nothing = np.zeros(at_ns.size, dtype=np.bool_)
        return Counted(nothing, nothing, [])
    moves = _to_the_next(odometry.moved(at_ns), at_ns.size)
    heard = _to_the_next(np.isfinite(odometry.between(at_ns[:-1], at_ns[1:]).distance_m), at_ns.size)
    stood = []
    for first, last in spans_of(heard & ~moves):
        rows = slice(first, min(last + 2, at_ns.size))
        places = path_m[rows][np.isfinite(path_m[rows])]
        if places.size and float(np.abs(places - places[0]).max()) > limit_m:
            stood.append((int(at_ns[rows][0]), int(at_ns[rows][-1])))
    return Counted(moves, heard, stood)


def travel_direction(
    direction: Ints, along: Judgements, at_ns: Ints, path_m: Floats, has_odometer: bool, config: HazardConfig
) -> Ints:
    """Direction of travel along growing path, 1 or -1, at each epoch.

    `direction`: as the train took it; `along`: errors along growing path. Without an odometer it is that of the train's
    own place, where the evidence gives it: a position that jumps back does not turn the train. With one it is the
    odometer's, but for an odometer that counts up while the train reverses, where the reference shows it.
    """
    train_m = path_m - along.known_m(config.known_error_m)
    came_m, noise_m, _ = _came(at_ns, train_m, along.half_m, config.turn_s)
    with np.errstate(invalid="ignore"):
        sure = np.abs(came_m) > noise_m
    by_reference = along.kind == KINDS.index(Evidence.REFERENCE)
    if has_odometer:
        # Not over a turn: the odometer knows best when that was.
        turned, _, _ = _came(at_ns, direction.astype(np.float64), along.half_m, config.turn_s)
        sure &= by_reference & (turned == 0.0)
    rows = np.flatnonzero(sure)
    if rows.size == 0:
        return direction
    last = rows[np.maximum(np.searchsorted(rows, np.arange(at_ns.size), side="right") - 1, 0)]
    sense = np.sign(came_m[last]).astype(np.int64)
    if not has_odometer:
        return sense
    # Whether the odometer had the sense of the reference then, and so has it or not until the next time.
    agrees = sense * direction[last]
    return direction * np.where(by_reference, agrees, 1)


def moving(
    at_ns: Ints, by_reference_m: Floats, half_m: Floats, counted: Counted, config: Configuration
) -> tuple[Bools, Bools]:
    """Per epoch whether the train moved to the next one, and whether that is known: by reference or odometer.

    By the reference it moved where it came farther over a second than the dead band and the noise of both places
    allow. It is also heard where the odometer stands or is silent.
    """
    came_m, noise_m, elapsed_s = _came(at_ns, by_reference_m, half_m, config.align.speed_window_s)
    with np.errstate(invalid="ignore"):
        by_reference = np.abs(came_m) > config.matching.deadband_mps * elapsed_s + noise_m
    moved = by_reference | (counted.moves & counted.heard)
    sure = np.isfinite(came_m) | (counted.heard & ~within_spans(at_ns, counted.stood))
    return _to_the_next(moved[:-1], moved.size), _to_the_next(sure[:-1], sure.size)


def _came(at_ns: Ints, place_m: Floats, half_m: Floats, window_s: float) -> tuple[Floats, Floats, Floats]:
    """How far from each epoch to the one `window_s` later [m], what both places may be off by [m], and the time."""
    ahead = np.searchsorted(at_ns, at_ns + round(window_s * NS_PER_S)).clip(0, at_ns.size - 1)
    return place_m[ahead] - place_m, half_m + half_m[ahead], (at_ns[ahead] - at_ns) / NS_PER_S


def _to_the_next(steps: Bools, size: int) -> Bools:
    """What holds from each epoch to the next; nothing follows upon the last one, which stays as it was before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]
