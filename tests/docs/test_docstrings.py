"""What users and maintainers call says what it takes, gives and refuses, in one form: Args, Returns, Raises, Source."""

from __future__ import annotations

import builtins
import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import schemas.errors
from pipeline.stages.alignment.align import align
from pipeline.stages.alignment.learning import learn
from pipeline.stages.epochs.verdicts import failure_log, verdicts
from pipeline.stages.judge.episodes import alarms_table, find_episodes
from pipeline.stages.judge.epochs import judged_epochs, judged_offers, time_in_use
from pipeline.stages.judge.failures import find_failures
from pipeline.stages.judge.hazards import hazard_rows, hazards_table
from pipeline.stages.judge.judge import judge, passages_table
from pipeline.stages.judge.judgement import judge_positions
from pipeline.stages.judge.train_crossings import crossings_of
from pipeline.stages.matching.match import find_path
from pipeline.stages.monitored import monitor_solution
from pipeline.stages.monitors import pseudorange, single
from pipeline.stages.monitors.axes import axes_of
from pipeline.stages.monitors.axis import along_series, run_axis
from pipeline.stages.paths.growth import path_set
from pipeline.stages.paths.path_steps import path_steps
from pipeline.stages.prepare import prepare
from pipeline.stages.run_row.lost_time import lost_columns, lost_time
from pipeline.stages.run_row.run_figures import level_rows, reasons_of, verdict_of
from pipeline.stages.run_row.summary import summarise
from tests.docs.blocks import ROOT

Function = Callable[..., Any]
SECTIONS = ("Args", "Returns", "Raises", "Source")
MONITORS = tuple(
    function
    for module in (single, pseudorange)
    for name, function in vars(module).items()
    if name.endswith("_monitor") and function.__module__ == module.__name__
)
ENTRIES = (
    align,
    learn,
    failure_log,
    verdicts,
    find_path,
    along_series,
    run_axis,
    axes_of,
    path_set,
    path_steps,
    prepare,
    monitor_solution,
    judge,
    judged_epochs,
    judged_offers,
    time_in_use,
    judge_positions,
    find_failures,
    find_episodes,
    alarms_table,
    hazard_rows,
    hazards_table,
    crossings_of,
    passages_table,
    lost_columns,
    lost_time,
    reasons_of,
    verdict_of,
    level_rows,
    summarise,
)
PACKAGES = sorted(".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "pipeline").rglob("__init__.py"))
# Every module of the schemas is for everyone; of the pipeline what its packages export.
SCHEMAS = sorted(f"schemas.{path.stem}" for path in (ROOT / "schemas").glob("*.py") if not path.stem.startswith("_"))


def exported() -> Iterator[Function]:
    for name in PACKAGES:
        package = importlib.import_module(name)
        yield from (getattr(package, item) for item in getattr(package, "__all__", ()))
    for name in SCHEMAS:
        module = importlib.import_module(name)
        items = vars(module).items()
        yield from (item for key, item in items if key[0] != "_" and getattr(item, "__module__", "") == name)


def with_parameters(functions: Iterator[Function]) -> dict[str, Function]:
    named = {f"{item.__module__}.{item.__name__}": item for item in functions if inspect.isfunction(item)}
    return {name: item for name, item in sorted(named.items()) if inspect.signature(item).parameters}


FUNCTIONS = with_parameters(iter((*exported(), *ENTRIES, *MONITORS)))


def sections(function: Function) -> dict[str, list[str]]:
    """Lines of each section of a docstring; those of an entry's later lines stand further in."""
    found: dict[str, list[str]] = {}
    current: list[str] | None = None
    for line in (inspect.getdoc(function) or "").splitlines():
        if (title := re.fullmatch(r"([A-Z][a-z]+):", line)) is not None:
            current = found.setdefault(title[1], [])
        elif current is not None and line.startswith("    "):
            current.append(line[4:])
    return found


def entries(lines: list[str]) -> list[str]:
    return [name[1] for line in lines if (name := re.match(r"(\w+): \S", line)) is not None]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_parameter_is_described(name: str) -> None:
    function = FUNCTIONS[name]
    assert entries(sections(function).get("Args", [])) == list(inspect.signature(function).parameters)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_returned_and_raised_is_described(name: str) -> None:
    function = FUNCTIONS[name]
    found = sections(function)
    assert [title for title in found if title in SECTIONS] == [title for title in SECTIONS if title in found]
    assert bool(found.get("Returns")) == (inspect.signature(function).return_annotation not in ("None", None))
    # Errors that stand there exist; one that a campaign is interrupted by is no error of the input.
    known = {*vars(schemas.errors), *vars(builtins), "Interrupted", "SweptError"}
    assert set(entries(found.get("Raises", []))) <= known


def test_all_monitors_without_memory_are_asked() -> None:
    assert len(MONITORS) == len(single.WITHOUT_MEMORY)


def test_a_parameter_that_is_not_described_is_found() -> None:
    def one(first: int, second: int) -> int:
        """Add.

        Args:
            first: a number.
        """
        return first + second

    assert entries(sections(one)["Args"]) == ["first"]
    assert len(FUNCTIONS) > 120
