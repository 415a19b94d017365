"""Seeded random trials through the whole replay: what was injected against what the tables say.

python -m benchmarks.random_trials --trials 500
"""

from __future__ import annotations

import argparse
import sys

from benchmarks.random_deviations import deviations
from datasets.random_trials import random_trial
from pipeline.one_run import replay


def main() -> int:
    """Print each trial that is not as expected; exit status 1 if there is one."""
    parser = argparse.ArgumentParser(prog="benchmarks.random_trials", description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    given = parser.parse_args()
    failures = 0
    for seed in range(given.first, given.first + given.trials):
        trial = random_trial(seed)
        wrong = deviations(trial, replay(trial.run, trial.site, trial.vehicle))
        if wrong:
            failures += 1
            print(f"seed {seed} ({trial.kind}): {'; '.join(wrong)}", flush=True)
    print(f"{given.trials} trials, {failures} not as expected")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
