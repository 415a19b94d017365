"""The published experiment: whole grid, beside the time of drawing the normal numbers it needs, and rare events.

The noise of a run are 15 normals per second (four 3-D Gauss-Markov vectors, the odometer, the track across and in
height), drawn here from the experiment's own generator. The whole grid at the paper's size is measured on a tenth of
its repetitions.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.results import Figure, stopwatch
from datasets.experiment.bank import BankSpec, linear_bank
from datasets.experiment.catalogue import run_catalogue
from datasets.experiment.diagnostics import REPETITIONS, run_diagnostics
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.monte_carlo import BLOCK_EPOCHS, ExperimentPlan, bank_forms, failure_forms, first_passages
from datasets.experiment.range_system import RangePlan, range_system
from datasets.experiment.sampling import Probability, missed_detection_probability
from datasets.experiment.workers import random_generator
from pipeline.results.workers import map_in_processes

_NORMALS = 15
_CHUNK = 256
_JOBS = 2
_GOES = 5
_TENTH = REPETITIONS // 10
_RARE_RUNS = 20_000
# Ramps and epochs that banks miss about once in 1e9 (default skies, heading 0).
_MISSES: tuple[tuple[str, Constellation, BankSpec, float, int], ...] = (
    ("twelve monitors, 0.1 m/s", "gps", BankSpec(sensors="odometer_and_track"), 0.1, 332),
    (
        "twelve monitors, 0.03 m/s, two constellations",
        "gps_galileo",
        BankSpec(sensors="odometer_and_track"),
        0.03,
        3_220,
    ),
)
_RANGE_EPOCHS = 28


def measure(folder: Path) -> list[Figure]:
    """The figures of the experiment; nothing is written but the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = []
    for name, (drawing, grid) in zip(CONSTELLATIONS, map_in_processes(_one_chunk, CONSTELLATIONS, _JOBS), strict=True):
        figures += [
            Figure(f"{name}: normals of {_CHUNK} runs", drawing, "s"),
            Figure(f"{name}: grid of {_CHUNK} runs", grid, "s"),
            Figure(f"{name}: grid over normals", grid / drawing, "1", target=5.0),
        ]
    with stopwatch() as watch:
        run_diagnostics(_TENTH, jobs=_JOBS)
    figures.append(Figure("whole grid, 10 000 repetitions, from a tenth", 10.0 * watch.seconds, "s", target=900.0))
    figures += _rare_figures()
    with stopwatch() as watch:
        run_catalogue(1, jobs=_JOBS)
    figures.append(Figure("fault catalogue, one replay of each", watch.seconds, "s"))
    own, child = (resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    figures.append(Figure("memory of all processes", own + _JOBS * child, "MB", target=2000.0))
    return figures


def _rare_figures() -> list[Figure]:
    """Misses of about 1e-9: error and time of the estimates, hardest case included."""
    figures = []
    for name, constellation, spec, rate, epochs in _MISSES:
        bank = linear_bank(default_geometry(constellation), 0.0, spec)
        with stopwatch() as watch:
            rare = missed_detection_probability(bank, epochs, rate, _RARE_RUNS, jobs=_JOBS)
        figures += _rare(f"rare miss, {name}", rare, watch.seconds)
    system = range_system(RangePlan(default_geometry("gps_galileo"), period_s=10.0), 0.0)
    with stopwatch() as watch:
        rare = missed_detection_probability(system, _RANGE_EPOCHS, 0.1, _RARE_RUNS, jobs=_JOBS)
    return figures + _rare("rare miss, pseudorange", rare, watch.seconds)


def _rare(name: str, rare: Probability, seconds: float) -> list[Figure]:
    return [
        Figure(f"{name}: probability", rare.value, "1"),
        Figure(f"{name}: relative error", rare.relative_error, "1", target=0.2),
        Figure(f"{name}: time", seconds, "s", target=120.0),
    ]


def _one_chunk(constellation: Constellation) -> tuple[float, float]:
    """Seconds to draw the normals of a chunk of runs, and to answer the whole grid for as many."""
    plan = ExperimentPlan(default_geometry(constellation))
    banks, failures = bank_forms(plan), failure_forms(plan)
    numbers = np.empty((BLOCK_EPOCHS, _NORMALS, _CHUNK))
    rng = random_generator(1)

    def draw() -> None:
        for at in range(0, plan.span_s, BLOCK_EPOCHS):
            rng.standard_normal(out=numbers[: min(BLOCK_EPOCHS, plan.span_s - at)])

    return _cpu_s(draw), _cpu_s(lambda: first_passages(plan, banks, failures, _CHUNK, random_generator(2)))


def _cpu_s(work: Callable[[], object]) -> float:
    """Least processor time of several goes [s]: the ratio is one of work, not of who else uses the machine."""
    times = []
    for _ in range(_GOES):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


if __name__ == "__main__":
    begin = time.perf_counter()
    for figure in measure(Path()):
        print(f"{figure.name}: {figure.value:.4g} {figure.unit}")
    print(f"taken {time.perf_counter() - begin:.0f} s")
