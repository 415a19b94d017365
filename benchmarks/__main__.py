"""Run the benchmarks and print their figures beside the targets; exit status 1 where one is missed."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import polars as pl

from benchmarks.results import Figure
from pipeline.show.terminal import show_table, to_json

MODULES = {
    "speed": ("short", "start", "sites", "end_to_end", "ingest", "matching"),
    "growth": ("rows", "campaign", "compact", "interruptions"),
    "truth": (
        *("tracks", "topologies", "calibration", "odometer", "follows", "witnesses", "relink", "plausibility", "line"),
        *("undetected", "recorded", "experiment"),
    ),
}
"""By folder; others there are run for themselves (`python -m benchmarks.truth.clock`)."""
NAMES = tuple(f"{folder}.{name}" for folder, names in MODULES.items() for name in names)


def main() -> int:
    """Command line: names of benchmarks, all by default."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join([*MODULES, *NAMES]))
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="where trials and figures go")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    held: list[tuple[str, Figure]] = []
    for name in _asked(given.names):
        figures: list[Figure] = importlib.import_module(f"benchmarks.{name}").measure(given.out / name)
        table = _table(figures)
        show_table(table, name)
        (given.out / f"{name}.json").write_text(to_json(table) + "\n")
        held += [(name, figure) for figure in figures if figure.met is not None]
    print("\n".join(_summary(held)))
    missed = sum(figure.met is False for _, figure in held)
    print(f"{missed} of {len(held)} targets missed")
    return 1 if missed else 0


def _asked(names: list[str]) -> list[str]:
    """Those of a folder, single ones, or all."""
    return [name for name in NAMES if not names or name in names or name.split(".")[0] in names]


def _summary(held: list[tuple[str, Figure]]) -> list[str]:
    """The figures that have a target as a Markdown table, as a page can show it."""
    lines = ["| benchmark | figure | measured | target | |", "|---|---|---|---|---|"]
    for name, figure in held:
        target = f"{'at most' if figure.better == 'below' else 'at least'} {figure.target:g} {figure.unit}"
        measured = f"{figure.value:.3g} {figure.unit}"
        lines.append(f"| {name} | {figure.name} | {measured} | {target} | {'' if figure.met else 'missed'} |")
    return lines


def _table(figures: list[Figure]) -> pl.DataFrame:
    rows = [(f.name, f.value, f.unit, f.better if f.target is not None else None, f.target, f.met) for f in figures]
    schema = {"figure": pl.String, "value": pl.Float64, "unit": pl.String, "target": pl.String, "limit": pl.Float64}
    return pl.DataFrame(rows, schema={**schema, "met": pl.Boolean}, orient="row")


if __name__ == "__main__":
    sys.exit(main())
