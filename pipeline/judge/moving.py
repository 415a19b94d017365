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
    noise_m: Floats,
    odometer_moves: Bools,
    known: Bools,
    stood: list[tuple[int, int]],
    deadband_mps: float,
    window_s: float,
) -> tuple[Bools, Bools]:
    """Per epoch whether the train moved to the next one, and whether that is known: by reference or odometer.

    `train_m`: its place by the reference, NaN elsewhere, known to `noise_m`: over `window_s` it moved where it came
    farther than the dead band and that noise allow. It also tells where the odometer stands or is silent.
    """
    ahead = np.searchsorted(t_ns, t_ns + round(window_s * NS_PER_S)).clip(0, t_ns.size - 1)
    with np.errstate(invalid="ignore"):
        came_m = np.abs(train_m[ahead] - train_m)
        by_reference = came_m > deadband_mps * (t_ns[ahead] - t_ns) / NS_PER_S + noise_m + noise_m[ahead]
    told = np.isfinite(came_m)
    moves, sure = by_reference | (odometer_moves & known), told | known
    for begin_ns, end_ns in stood:
        sure &= told | (t_ns < begin_ns) | (t_ns >= end_ns)
    return _held(moves[:-1], t_ns.size), _held(sure[:-1], t_ns.size)


def _held(steps: Bools, size: int) -> Bools:
    """Nothing follows upon the last epoch, which stays as it was before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]
