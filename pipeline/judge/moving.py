"""When the train moved, and when the odometer may have stood although it did (DOMAIN section 5.5)."""

from __future__ import annotations

import numpy as np

from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of


def stood_spans(
    t_ns: Ints, path_m: Floats, odometer_moves: Bools, known: Bools, limit_m: float
) -> list[tuple[int, int]]:
    """Times in which the odometer stood while positions left their place by more than the limit [ns].

    `odometer_moves`: per epoch, up to the next one; `known`: where it says anything. Whether the train moved there
    nobody knows by the odometer.
    """
    found = []
    for first, last in spans_of(known & ~odometer_moves):
        rows = slice(first, min(last + 2, t_ns.size))
        places = path_m[rows][np.isfinite(path_m[rows])]
        if places.size and float(np.abs(places - places[0]).max()) > limit_m:
            found.append((int(t_ns[rows][0]), int(t_ns[rows][-1])))
    return found


def moving_by_evidence(
    t_ns: Ints,
    train_m: Floats,
    odometer_moves: Bools,
    known: Bools,
    stood: list[tuple[int, int]],
    deadband_mps: float,
) -> tuple[Bools, Bools]:
    """Per epoch whether the train moved to the next one, and whether that is known.

    `train_m`: its place by the reference, NaN elsewhere: it comes before the odometer.
    """
    step_s = np.diff(t_ns) / NS_PER_S
    with np.errstate(invalid="ignore", divide="ignore"):
        by_reference = np.abs(np.diff(train_m)) / step_s
    told = np.isfinite(by_reference)
    moves = np.where(told, by_reference > deadband_mps, odometer_moves[:-1])
    sure = told | known[:-1]
    for begin_ns, end_ns in stood:
        sure &= told | (t_ns[:-1] < begin_ns) | (t_ns[:-1] >= end_ns)
    return _held(moves, t_ns.size), _held(sure, t_ns.size)


def _held(steps: Bools, size: int) -> Bools:
    """Nothing follows upon the last epoch, which stays as it was before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]
