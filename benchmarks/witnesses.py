"""Worlds whose witnesses are crooked, against their truth: danger called health, and what healthy worlds are called.

`python -m benchmarks.witnesses [SEEDS] [FAMILY...]`; per family: worlds with danger, verdicts, and worlds in which less
evidence made something `right` or `safe`, with their seeds.
"""

from __future__ import annotations

import sys
from collections import Counter

from pipeline.one_run import replay
from schemas.run import RunTables
from tests.replay.crooked import FAMILIES, WEAKER, World, danger_of, reasons_of, verdict_of, world_of
from tests.replay.weaker import better_by_less

SEEDS = 8


def main() -> int:
    """Print a line per family; exit status 1 where danger was called health."""
    given = sys.argv[1:]
    seeds = int(given[0]) if given else SEEDS
    worst = 0
    for family in given[1:] or list(FAMILIES):
        verdicts: Counter[str] = Counter()
        dangers: list[str] = []
        better: list[str] = []
        for seed in range(seeds):
            world = world_of(family, seed)
            tables = _replayed(world)
            verdicts[verdict_of(tables)] += 1
            danger = danger_of(world, tables)
            if danger.any:
                dangers.append(f"{seed}: {danger} {verdict_of(tables)} {reasons_of(tables)}")
            for name, weaken in WEAKER.items():
                less = _replayed(weaken(world_of(family, seed)))
                better += [f"{seed} {name}: {text}" for text in better_by_less(tables, less)]
        print(
            f"{family}: {len(dangers)} of {seeds} dangerous; {dict(verdicts)}; {len(better)} better by less", flush=True
        )
        for line in dangers + better:
            print("   ", line, flush=True)
        worst += len(dangers)
    return int(worst > 0)


def _replayed(world: World) -> RunTables:
    return replay(world.run(), world.site(), world.vehicle, world.config())


if __name__ == "__main__":
    sys.exit(main())
