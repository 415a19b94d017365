"""Random drives with their true way: a train that changes its speed by up to 1.2 m/s^2, and stands at times."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Floats


def drive(rng: np.random.Generator, duration_s: float = 600.0) -> tuple[Floats, Floats]:
    """Times [s] 10 ms apart, and the true way [m]."""
    knots = [(0.0, 0.0)]
    while knots[-1][0] < duration_s:
        at_s, speed = knots[-1]
        target = rng.choice([0.0, rng.uniform(3.0, 20.0), rng.uniform(10.0, 45.0), rng.uniform(30.0, 80.0)])
        there_s = at_s + abs(target - speed) / rng.uniform(0.2, 1.2) + 1e-3
        knots += [(there_s, target), (there_s + rng.uniform(5.0, 60.0), target)]
    fine = np.arange(0.0, duration_s, 0.01)
    speeds = np.interp(fine, *np.array(knots).T)
    return fine, np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * 0.01)])


def recorded(
    rng: np.random.Generator, kind: str, size: float, rate_hz: int, duration_s: float = 600.0
) -> tuple[Floats, Floats, Floats]:
    """Stamps [s], rows [m] and the true way at them, of a healthy counter."""
    fine, way = drive(rng, duration_s)
    t = np.arange(0.0, duration_s - 1.0, 1.0 / rate_hz)
    true = np.interp(t, fine, way)
    if kind == "counts":
        return t, np.floor(true / size) * size, true
    if kind == "noise":
        return t, true + rng.normal(0.0, size, t.size), true
    if kind == "jitter":
        stamps = np.maximum.accumulate(t + rng.normal(0.0, size, t.size)) + 1e-7 * np.arange(t.size)
        return stamps, true, true
    bunches = np.ceil(t / size) * size
    return bunches + 1e-3 * (np.arange(t.size) - np.searchsorted(bunches, bunches)), true, true
