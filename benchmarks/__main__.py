"""Run the benchmarks and print their figures beside the targets; exit status 1 where one is missed."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import polars as pl

from benchmarks.results import Figure
from pipeline.show.terminal import show_table, to_json

MODULES = (
    "start",
    "end_to_end",
    "ingest",
    "matching",
    "calibration",
    "topologies",
    "campaign",
    "interruptions",
    "experiment",
    "relink",
    "growth",
    "plausibility",
    "line",
    "undetected",
    "recorded",
)


def main() -> int:
    """Command line: names of benchmarks, all by default."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MODULES))
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="where trials and figures go")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    missed = 0
    for name in given.names or MODULES:
        figures: list[Figure] = importlib.import_module(f"benchmarks.{name}").measure(given.out / name)
        table = _table(figures)
        show_table(table, name)
        (given.out / f"{name}.json").write_text(to_json(table) + "\n")
        missed += sum(figure.met is False for figure in figures)
    print(f"{missed} targets missed")
    return 1 if missed else 0


def _table(figures: list[Figure]) -> pl.DataFrame:
    rows = [(f.name, f.value, f.unit, f.better if f.target is not None else None, f.target, f.met) for f in figures]
    schema = {"figure": pl.String, "value": pl.Float64, "unit": pl.String, "target": pl.String, "limit": pl.Float64}
    return pl.DataFrame(rows, schema={**schema, "met": pl.Boolean}, orient="row")


if __name__ == "__main__":
    sys.exit(main())
