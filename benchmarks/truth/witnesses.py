"""Worlds whose witnesses are crooked, against their truth: danger called health, and what healthy worlds are called.

`python -m benchmarks.truth.witnesses [SEEDS] [FAMILY...]` prints per family: replays with danger
(those in which a clock was assumed, and said to be, apart), verdicts, and worlds in which less evidence made something
`right` or `safe`.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.results import Figure
from pipeline.one_run import replay
from schemas.run import RunTables
from tests.replay.crooked import CLOCKS_DIFFER, FAMILIES, WEAKER, World, danger_of, reasons_of, verdict_of, world_of
from tests.replay.weaker import better_by_less

SEEDS = 4


@dataclass
class Tally:
    """What became of the worlds of one family: a line for each that is not as it should be."""

    dangers: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    better: list[str] = field(default_factory=list)
    verdicts: Counter[str] = field(default_factory=Counter)

    def weigh(self, name: str, world: World, tables: RunTables) -> None:
        danger = danger_of(world, tables)
        if danger.any:
            line = f"{name}: {danger} {verdict_of(tables)} {reasons_of(tables)}"
            (self.assumed if "clock_assumed" in reasons_of(tables) else self.dangers).append(line)


def tallied(family: str, seeds: int) -> Tally:
    """The worlds of a family, each replayed whole and with each loss of evidence."""
    tally = Tally()
    for seed in range(seeds):
        world = world_of(family, seed)
        whole = _replayed(world)
        tally.verdicts[verdict_of(whole)] += 1
        tally.weigh(str(seed), world, whole)
        for name, weaken in WEAKER.items():
            weaker = weaken(world_of(family, seed))
            less = _replayed(weaker)
            gained = better_by_less(whole, less, name, weaker.read_ns, family in CLOCKS_DIFFER)
            tally.better += [f"{seed} {name}: {text}" for text in gained]
            tally.weigh(f"{seed} {name}", weaker, less)
    return tally


def measure(out: Path | None = None, seeds: int = SEEDS) -> list[Figure]:
    """Over all families; `out` is not needed."""
    tallies = {family: tallied(family, seeds) for family in FAMILIES}
    worlds = seeds * len(FAMILIES)
    return [
        Figure("replays with danger called health", sum(len(tally.dangers) for tally in tallies.values()), "worlds", 0),
        Figure("gained by less evidence", sum(len(tally.better) for tally in tallies.values()), "replays", 0),
        Figure("honest worlds called unproven", tallies["honest"].verdicts["unproven"] / seeds, "1"),
        Figure("worlds", worlds, "worlds"),
    ]


def main() -> int:
    """Print a line per family; exit status 1 where danger was called health."""
    given = sys.argv[1:]
    seeds = int(given[0]) if given else SEEDS
    worst = 0
    for family in given[1:] or list(FAMILIES):
        tally = tallied(family, seeds)
        replays = seeds * (1 + len(WEAKER))
        counts = f"of {replays} replays {len(tally.dangers)} dangerous, {len(tally.assumed)} more by an assumed clock"
        print(f"{family}: {counts}; {dict(tally.verdicts)}; {len(tally.better)} better by less", flush=True)
        for line in tally.dangers + tally.assumed + tally.better:
            print("   ", line, flush=True)
        worst += len(tally.dangers)
    return int(worst > 0)


def _replayed(world: World) -> RunTables:
    return replay(world.run(), world.site(), world.vehicle, world.config())


if __name__ == "__main__":
    sys.exit(main())
