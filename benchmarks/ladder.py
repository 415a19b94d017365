"""The evidence ladder over many random worlds: what a judgement says against a truth that the judge cannot know.

python -m benchmarks.ladder --seeds 500 [--crooked]
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from tests.stages.judge.crooked_worlds import crooked_journey
from tests.stages.judge.findings import findings, rungs_of
from tests.stages.judge.random_worlds import random_journey


def main() -> int:
    """Print each breach of DOMAIN section 5; exit status 1 if there is one."""
    parser = argparse.ArgumentParser(prog="benchmarks.ladder", description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--crooked", action="store_true", help="counters reset, clocks off, disputes, two odometers")
    given = parser.parse_args()
    failed, verdicts = 0, Counter[str]()
    for seed in range(given.first, given.first + given.seeds):
        journey = crooked_journey(seed) if given.crooked else random_journey(seed)
        rungs = rungs_of(journey)
        verdicts.update(f"{name} {rung.row['verdict']}" for name, rung in rungs.items())
        found = findings(journey, rungs, given.crooked)
        failed += bool(found)
        for text in found:
            print(text, flush=True)
    print(f"{given.seeds} seeds, {failed} with findings; verdicts: {dict(sorted(verdicts.items()))}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
