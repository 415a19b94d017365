"""Is the lag between two recorders as sure as it says? `python -m benchmarks.truth.clock [--draws N] [--seed S]`.

Journeys of constant speed, shuttles, freight and trams, a counter and another recorder of them that is 0.02 to 20 s
early or late. The drawing knows nothing of the estimator: noise of the other recorder is white and correlated over 20
to 100 s, the counter counts in steps of nothing to 2 m, walks, has a scale, and slips; stops may last longer than all
the rest. Of a lag that is reported the truth lies within 3 sigma in 95 of 100, and within 4 in all.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.results import Figure
from pipeline.stages.odometry.regression import ScaleLag
from pipeline.stages.odometry.scale_lag import CounterRows, scale_and_lag

TICK_S = 0.02
RATES_HZ = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
WAY_S, STEP_S = 10.0, 2.0


@dataclass(frozen=True)
class Drawn:
    """A journey as both saw it, and the truth."""

    family: str
    begin_s: np.ndarray
    end_s: np.ndarray
    travelled_m: np.ndarray
    counter: CounterRows
    lag_s: float
    scale: float


def constant(rng: np.random.Generator, length_s: float) -> list[tuple[float, float, float]]:
    """(speed to reach [m/s], acceleration [m/s2], time to hold it [s]): one speed, rarely left; some begin at it."""
    parts, passed = [], 0.0
    while passed < length_s:
        hold_s = float(rng.uniform(0.3, 1.2)) * length_s
        parts.append((float(rng.uniform(15.0, 60.0)), float(rng.uniform(0.1, 0.6)), hold_s))
        passed += hold_s + 100.0
    return parts


def shuttle(rng: np.random.Generator, length_s: float) -> list[tuple[float, float, float]]:
    """To and fro at the same speeds, with the same stands."""
    top, acceleration = float(rng.uniform(8.0, 25.0)), float(rng.uniform(0.3, 0.9))
    hold_s, stand_s = float(rng.uniform(30.0, 240.0)), float(rng.uniform(30.0, 300.0))
    parts, passed, sense = [], 0.0, 1.0
    while passed < length_s:
        parts += [(sense * top, acceleration, hold_s), (0.0, acceleration, stand_s)]
        passed, sense = passed + hold_s + stand_s + 2.0 * top / acceleration, -sense
    return parts


def freight(rng: np.random.Generator, length_s: float) -> list[tuple[float, float, float]]:
    """Slow changes of speed, long stands."""
    parts, passed = [], 0.0
    while passed < length_s:
        speed = 0.0 if rng.random() < 0.25 else float(rng.uniform(5.0, 28.0))
        hold_s = float(rng.uniform(60.0, 900.0))
        parts.append((speed, float(rng.uniform(0.03, 0.25)), hold_s))
        passed += hold_s
    return parts


def tram(rng: np.random.Generator, length_s: float) -> list[tuple[float, float, float]]:
    """Stops every few hundred metres."""
    parts, passed = [], 0.0
    stand_s = float(rng.uniform(10.0, 120.0))
    while passed < length_s:
        hold_s = float(rng.uniform(5.0, 60.0))
        parts += [(float(rng.uniform(6.0, 18.0)), 1.0, hold_s), (0.0, 1.2, float(rng.uniform(0.5, 1.5)) * stand_s)]
        passed += hold_s + stand_s
    return parts


FAMILIES = {"constant speed": constant, "shuttle": shuttle, "freight": freight, "tram": tram}


def draw(seed: int, family: str | None = None) -> Drawn:
    rng = np.random.default_rng([50, seed])
    family = family or list(FAMILIES)[seed % len(FAMILIES)]
    rate_hz = float(rng.choice(RATES_HZ))
    length_s = float(np.exp(rng.uniform(np.log(300.0), np.log(3600.0 if rate_hz <= 10.0 else 1200.0))))
    t_s, true_m, speed_mps = journey(rng, family, length_s)
    lag_s = float(np.exp(rng.uniform(np.log(0.02), np.log(20.0)))) * float(rng.choice([-1.0, 1.0]))
    scale = float(rng.uniform(0.97, 1.03))
    counter = counted(rng, t_s, true_m, speed_mps, scale, float(rng.choice(RATES_HZ)))
    # The other recorder: where the train was, and what it wrote of that.
    at_s = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz) + float(rng.uniform(0.0, 1.0 / rate_hz))
    place_m = np.interp(at_s, t_s, true_m) + noise(rng, at_s)
    stamp_s = at_s + lag_s
    begin_s = np.arange(stamp_s[0], stamp_s[-1] - WAY_S, max(STEP_S, 1.0 / rate_hz))
    begin = np.unique(np.searchsorted(stamp_s, begin_s))
    end = np.minimum(np.searchsorted(stamp_s, stamp_s[begin] + WAY_S), stamp_s.size - 1)
    return Drawn(family, stamp_s[begin], stamp_s[end], place_m[end] - place_m[begin], counter, lag_s, scale)


def journey(rng: np.random.Generator, family: str, length_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    knots, speeds = [0.0], [0.0]
    parts = FAMILIES[family](rng, length_s)
    if rng.random() < 0.5:
        speeds = [parts[0][0]]
    else:
        knots, speeds = [0.0, float(rng.uniform(5.0, 200.0))], [0.0, 0.0]
    for speed, acceleration, hold_s in parts:
        knots += [knots[-1] + max(abs(speed - speeds[-1]) / acceleration, 0.1)]
        knots += [knots[-1] + hold_s]
        speeds += [speed, speed]
    t_s = np.arange(0.0, min(knots[-1], length_s), TICK_S)
    speed = np.interp(t_s, knots, speeds)
    # Drivers and slopes make it waver, some hardly at all.
    waver = float(np.exp(rng.uniform(np.log(0.003), np.log(0.6)))) * np.sin(t_s / float(rng.uniform(4.0, 60.0)))
    speed = np.where(np.abs(speed) > 1.0, speed + waver, speed)
    return t_s, np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) * TICK_S]), speed


def counted(
    rng: np.random.Generator, t_s: np.ndarray, true_m: np.ndarray, speed: np.ndarray, scale: float, rate_hz: float
) -> CounterRows:
    """Rows of a counter that walks, slips unnoticed, and counts in steps."""
    moving = np.abs(speed) > 0.05
    walk = np.cumsum(np.where(moving, rng.normal(size=t_s.size), 0.0)) * float(rng.uniform(0.0, 0.05)) * np.sqrt(TICK_S)
    slipped = np.zeros(t_s.size)
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 4))):
            size_m = float(rng.uniform(-8.0, 8.0))
            slipped += size_m * np.clip(
                (t_s - float(rng.uniform(0.0, t_s[-1]))) / float(rng.uniform(1.0, 5.0)), 0.0, 1.0
            )
    row_s = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz)
    distance_m = np.interp(row_s, t_s, true_m / scale + walk + slipped)
    step_m = float(rng.choice([0.0, 0.01, 0.05, 0.2, 0.5, 2.0]))
    if step_m:
        distance_m = np.floor(distance_m / step_m + float(rng.uniform(0.0, 1.0))) * step_m
    return CounterRows(row_s, distance_m, np.zeros(row_s.size), step_m / np.sqrt(12.0))


def noise(rng: np.random.Generator, t_s: np.ndarray) -> np.ndarray:
    """White, correlated over 20 to 100 s, and now and then a step, or a drift of up to 2 m/s [m]."""
    from scipy.signal import lfilter  # takes long to load

    keep = float(np.exp(-float(np.median(np.diff(t_s))) / float(rng.uniform(20.0, 100.0))))
    shocks = rng.normal(size=t_s.size)
    shocks[1:] *= np.sqrt(1.0 - keep**2)
    slow = float(np.exp(rng.uniform(np.log(0.02), np.log(4.0)))) * lfilter([1.0], [1.0, -keep], shocks)
    white = float(np.exp(rng.uniform(np.log(0.003), np.log(1.0)))) * rng.normal(size=t_s.size)
    begun_s, fault = float(rng.uniform(t_s[0], t_s[-1])), rng.random()
    if fault < 0.1:
        return np.asarray(slow + white + float(rng.uniform(-32.0, 32.0)) * (t_s > begun_s))
    if fault < 0.2:
        most_m, rate_mps = float(rng.uniform(-80.0, 80.0)), float(rng.uniform(0.15, 2.0))
        return np.asarray(slow + white + most_m * np.clip((t_s - begun_s) * rate_mps / abs(most_m), 0.0, 1.0))
    return np.asarray(slow + white)


def estimate(drawn: Drawn) -> ScaleLag:
    return scale_and_lag(drawn.begin_s, drawn.end_s, drawn.travelled_m, drawn.counter)


def figures(draws: int, seed: int) -> list[Figure]:
    rows = []
    for number in range(draws):
        drawn = draw(seed * 1_000_000 + number)
        found = estimate(drawn)
        off = abs(found.lag_s - drawn.lag_s) / found.lag_sigma_s if found.measured else np.nan
        rows.append((drawn.family, off, found.lag_sigma_s, abs(found.scale - drawn.scale) / found.scale_sigma))
    out = []
    for family in (*FAMILIES, ""):
        own = [row for row in rows if not family or row[0] == family]
        offs, sigma_s, scale = (np.array([row[k] for row in own]) for k in (1, 2, 3))
        shows_lag = np.isfinite(offs)
        about = f"{family or 'all'}, {len(own)} draws: "
        out += [
            Figure(f"{about}share with a lag measured", float(shows_lag.mean()), ""),
            Figure(
                f"{about}median sigma of these", float(np.median(sigma_s[shows_lag])) if shows_lag.any() else 0.0, "s"
            ),
            Figure(f"{about}share of these within 3 sigma", float((offs[shows_lag] <= 3.0).mean()), "", 0.95, "above"),
            Figure(f"{about}lags wrong by more than 4 sigma", float((offs[shows_lag] > 4.0).sum()), "", 0.0),
            Figure(f"{about}scales wrong by more than 4 sigma", float((scale > 4.0).sum()), "", 0.0),
        ]
    return out


def measure(out: Path) -> list[Figure]:
    """A quick sample; nothing is written."""
    return figures(400, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=400, help="10000 for the gate")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for figure in figures(options.draws, options.seed):
        verdict = {True: " met", False: " MISSED", None: ""}[figure.met]
        print(f"{figure.name:<70} {figure.value:9.4f} {figure.unit}{verdict}")


if __name__ == "__main__":
    main()
