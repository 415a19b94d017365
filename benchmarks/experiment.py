"""How long the published experiment takes, beside the time of drawing the normal numbers it needs.

    python benchmarks/experiment.py [--repetitions N] [--jobs N] [--full]

Prints one line per figure. The noise of a run are 15 normals per second (four 3-D Gauss-Markov vectors, the odometer,
the track across and in height), from the same generator as the experiment's.
"""

from __future__ import annotations

import argparse
import os
import resource
import time

# Linear algebra in one thread: the experiment brings its own processes. Must precede the import of numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from datasets.experiment.diagnostics import run_diagnostics
from datasets.experiment.geometry import CONSTELLATIONS, default_geometry
from datasets.experiment.linear_bank import BankSpec, linear_bank
from datasets.experiment.passage import BLOCK_EPOCHS, first_passages
from datasets.experiment.plan import Plan, bank_forms, failure_forms
from datasets.experiment.rare import missed_detection_probability
from datasets.experiment.workers import generator

_NORMALS = 15
_CHUNK = 250


def normals_s(plan: Plan) -> float:
    """Seconds to draw the normals of `_CHUNK` runs."""
    rng, numbers = generator(1), np.empty((BLOCK_EPOCHS, _NORMALS, _CHUNK))
    begin = time.perf_counter()
    for _ in range(plan.span_s // BLOCK_EPOCHS):
        rng.standard_normal(out=numbers)
    rng.standard_normal(out=numbers[: plan.span_s % BLOCK_EPOCHS])
    return time.perf_counter() - begin


def grid_s(plan: Plan) -> float:
    """Seconds to answer the whole grid for `_CHUNK` runs."""
    banks, failures = bank_forms(plan), failure_forms(plan)
    begin = time.perf_counter()
    first_passages(plan, banks, failures, _CHUNK, generator(2))
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=1_000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--full", action="store_true", help="the paper's own size, 10 000 repetitions")
    arguments = parser.parse_args()
    plans = [Plan(default_geometry(name)) for name in CONSTELLATIONS]
    for plan in plans:
        # The least of three: other work on the machine only ever adds.
        drawing, whole = (min(measure(plan) for _ in range(3)) for measure in (normals_s, grid_s))
        print(f"experiment.{plan.geometry.constellation}.normals_s_per_250_runs {drawing:.3f}")
        print(f"experiment.{plan.geometry.constellation}.grid_s_per_250_runs {whole:.3f}")
        print(f"experiment.{plan.geometry.constellation}.grid_over_normals {whole / drawing:.2f}")
    repetitions = 10_000 if arguments.full else arguments.repetitions
    begin = time.perf_counter()
    run_diagnostics(repetitions, jobs=arguments.jobs)
    taken = time.perf_counter() - begin
    print(f"experiment.whole_grid_s {taken:.1f} repetitions={repetitions} jobs={arguments.jobs}")
    print(f"experiment.whole_grid_at_10000_s {taken * 10_000 / repetitions:.1f}")
    own, children = (
        resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    print(f"experiment.memory_mb {own + arguments.jobs * children:.0f}")
    begin = time.perf_counter()
    bank = linear_bank(default_geometry("gps"), 0.0, BankSpec(sensors="odometer_and_track"))
    rare = missed_detection_probability(bank, 330, 0.1, jobs=arguments.jobs)
    print(f"experiment.rare_s {time.perf_counter() - begin:.1f}")
    print(f"experiment.rare_probability {rare.value:.3g} relative_error={rare.relative_error:.3f}")


if __name__ == "__main__":
    main()
