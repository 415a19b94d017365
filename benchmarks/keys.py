"""Which numeric keys of the configuration reach a result: each is changed until some table or refusal differs.

python -m benchmarks.keys matching lds --trials 9
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator

import polars as pl

from datasets.random_trials import random_trial
from pipeline.one_run import replay
from schemas.config import Configuration, Settings, Vehicle
from schemas.errors import BaliseError
from schemas.run import RunLog, Site

Input = tuple[RunLog, Site, Vehicle | None, Configuration]
# Of the tables that say of themselves what they were made with.
_PROVENANCE = ("config_digest",)
_SECTIONS = ("ingest", "plausibility", "fix_sigma", "matching", "align", "monitors", "lds", "hazards", "safety")


def numeric_keys(settings: Settings) -> Iterator[tuple[str, float]]:
    """Keys of a section that hold a number, with their defaults."""
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield name, value


def other_values(value: float) -> Iterator[float]:
    """Values far from this one, and nearer ones, on both sides; some of them a key refuses."""
    for factor in (10.0, 0.1, 2.0, 0.5, 100.0, 0.001):
        yield type(value)(value * factor)
    yield from (0.999, 1e-6, 1.0, 0.0)


def changed(settings: Settings, key: str, value: float) -> Settings | None:
    """The section with another value; None where the key does not take it."""
    try:
        return type(settings).model_validate(settings.model_dump() | {key: value})
    except ValueError:
        return None


def outcome(case: Input, config: Configuration) -> list[pl.DataFrame] | str:
    """The tables of a replay, or its refusal."""
    run, site, vehicle, _ = case
    try:
        tables = replay(run, site, vehicle, config)
    except BaliseError as error:
        return str(error)
    frames = (tables.hazards, tables.passages, tables.alarms, tables.runs, tables.epochs)
    return [frame.drop(_PROVENANCE, strict=False) for frame in frames]


def same(one: list[pl.DataFrame] | str, other: list[pl.DataFrame] | str) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return all(a.schema == b.schema and a.equals(b, null_equal=True) for a, b in zip(one, other, strict=True))


def reaching(section: str, cases: Iterable[Input], tell: Callable[[str], object] = print) -> list[str]:
    """Keys of a section that change nothing in any of these replays; each that does is told with where."""
    cases = list(cases)
    before: dict[int, list[pl.DataFrame] | str] = {}
    idle = []
    for key, default in numeric_keys(getattr(Configuration(), section)):
        found = next(_effects(section, key, default, cases, before), None)
        tell(f"{section}.{key}: {found or 'changes nothing'}")
        idle += [] if found else [f"{section}.{key}"]
    return idle


def _effects(
    section: str, key: str, default: float, cases: list[Input], before: dict[int, list[pl.DataFrame] | str]
) -> Iterator[str]:
    for value in other_values(default):
        for number, case in enumerate(cases):
            own = getattr(case[3], section)
            if (other := changed(own, key, value)) is None:
                break
            if number not in before:
                before[number] = outcome(case, case[3])
            after = outcome(case, case[3].model_copy(update={section: other}))
            if not same(before[number], after):
                yield f"{value:g} changes replay {number}"


def main() -> int:
    """Print the keys that change nothing; exit status 1 if there are some."""
    parser = argparse.ArgumentParser(prog="benchmarks.keys", description=__doc__)
    parser.add_argument("sections", nargs="*", default=_SECTIONS)
    parser.add_argument("--trials", type=int, default=9, help="random trials to replay for each value")
    given = parser.parse_args()
    drawn = [random_trial(seed) for seed in range(given.trials)]
    cases = [(one.run, one.site, one.vehicle, Configuration()) for one in drawn]
    idle = [key for section in given.sections for key in reaching(section, cases)]
    print(f"{len(idle)} keys change nothing: {', '.join(idle)}")
    return 1 if idle else 0


if __name__ == "__main__":
    sys.exit(main())
