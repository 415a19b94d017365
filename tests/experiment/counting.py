"""Rare events by plain counting, to hold the sampled probabilities against where counting can reach.

    python -m tests.experiment.counting

sets both side by side at 1e-3, 1e-4 and 1e-5: misses and alarms of the paper's banks (GPS, noise on increments) and of
the pseudorange monitor. Exit status 1 where the 95 % intervals of more than one comparison do not meet.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from datasets.experiment.bank import SENSORS, BankSpec, linear_bank
from datasets.experiment.geometry import default_geometry
from datasets.experiment.range_system import RangePlan, range_system
from datasets.experiment.sampling import (
    Probability,
    System,
    false_alarm_probability,
    first_below,
    missed_detection_probability,
    pool_estimates,
)
from datasets.experiment.workers import in_blocks, random_generator
from pipeline.stages.run_row.bounds import clopper_pearson
from schemas.arrays import Floats

_NORMAL_95 = 1.959963984540054
_ALARM_RUNS, _SEARCH_RUNS, _MOST_COUNTED, _EVENTS = 1_000, 500, 2_000_000, 40
_BLOCK = 250
_BANK_MPS, _RANGE_MPS, _ALARM_EPOCHS = 0.3, 0.05, 100


def counted_alarms(system: System, epochs: int, runs: int, seed: int) -> Probability:
    """Share of runs in which healthy monitors fail at least once."""
    passed = counted_misses(system, epochs, 0.0, runs, seed)
    share = 1.0 - passed.value
    error = passed.relative_error * passed.value / share if share > 0.0 else float("inf")
    return passed._replace(value=share, relative_error=error)


def counted_misses(system: System, epochs: int, rate_mps: float, runs: int, seed: int) -> Probability:
    """Share of runs in which no monitor fails at epochs 1 .. n of a range ramp."""
    ramp, passing = system.ramp(epochs, rate_mps), system.passing(epochs)

    def block(size: int, rng: np.random.Generator) -> Floats:
        state, alive = system.draw_start(size, rng), np.ones(size, dtype=np.bool_)
        for k in range(epochs):
            state = system.draw_next(state, rng)
            alive &= passing(k, system.values(state) + ramp[k][:, None])
            if not alive.any():
                break
        return alive.astype(np.float64)

    return _counted(block, runs, (seed, 34))


def _counted(block: Callable[[int, np.random.Generator], Floats], runs: int, key: tuple[int, int]) -> Probability:
    sizes = in_blocks(runs, _BLOCK)
    parts = [block(size, random_generator(*key, number)) for number, size in enumerate(sizes)]
    return pool_estimates(np.concatenate(parts), runs)


def agree(sampled: Probability, counted: Probability) -> bool:
    """Whether the interval of the estimate and the exact one of the count, both of 95 %, meet."""
    exact = clopper_pearson(round(counted.value * counted.runs), counted.runs)
    half = _NORMAL_95 * sampled.relative_error * sampled.value if sampled.value > 0.0 else 0.0
    low, high = exact.low or 0.0, 1.0 if exact.high is None else exact.high
    return sampled.value - half <= high and sampled.value + half >= low


def comparisons(target: float, most: int = _MOST_COUNTED) -> Iterator[tuple[str, Probability, Probability]]:
    """What was sampled, and counted, where a miss or alarm has about this probability."""
    sky, counted = default_geometry("gps"), min(int(_EVENTS / target), most)
    for spec in (BankSpec(sensors=sensors) for sensors in SENSORS):
        bank = linear_bank(sky, 0.0, spec)
        sampled = partial(missed_detection_probability, bank, rate_mps=_BANK_MPS)
        epochs = _epochs_until(sampled, target)
        yield f"miss, {spec.sensors}", sampled(epochs), counted_misses(bank, epochs, _BANK_MPS, counted, 1)
        tight = linear_bank(sky, 0.0, replace(spec, false_alarm_probability=target / 500))
        alarm = false_alarm_probability(tight, _ALARM_EPOCHS, _ALARM_RUNS)
        yield f"alarm, {spec.sensors}", alarm, counted_alarms(tight, _ALARM_EPOCHS, counted, 1)
    system = range_system(RangePlan(sky, period_s=10.0), 0.0)
    missed = partial(missed_detection_probability, system, rate_mps=_RANGE_MPS)
    epochs = _epochs_until(missed, target)
    yield "miss, pseudorange", missed(epochs), counted_misses(system, epochs, _RANGE_MPS, counted, 1)
    strict = range_system(RangePlan(sky, period_s=10.0, false_alarm_probability=target / 50), 0.0)
    alarm = false_alarm_probability(strict, _ALARM_EPOCHS, _ALARM_RUNS)
    yield "alarm, pseudorange", alarm, counted_alarms(strict, _ALARM_EPOCHS, counted, 2)


def _epochs_until(sampled: Callable[..., Probability], target: float) -> int:
    (epochs,) = first_below(lambda n: sampled(n, runs=_SEARCH_RUNS).value, (target,), 10_000)
    if epochs is None:
        raise ValueError(f"never below {target:g} within 10,000 epochs")
    return epochs


def main() -> int:
    """One line per comparison."""
    apart = 0
    for target in (1e-3, 1e-4, 1e-5):
        for what, sampled, counted in comparisons(target):
            agrees = agree(sampled, counted)
            apart += not agrees
            line = f"sampled {sampled.value:.3g} +- {sampled.relative_error:.0%}, counted {counted.value:.3g}"
            print(f"{target:g} {what}: {line} in {counted.runs}{'' if agrees else ', apart'}", flush=True)
    return 1 if apart > 1 else 0


if __name__ == "__main__":
    sys.exit(main())
