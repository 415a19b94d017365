"""The references of configuration, vehicle, scenario and fault files name every key with its default, and no other."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from datasets.expectation import ExpectedHazard, ExpectedRun
from datasets.faults import FaultSpec, PlacedFault
from datasets.motion import MotionSpec, PhaseSpec
from datasets.range_errors import RangeErrorSpec
from datasets.scenario import (
    BaliseSpec,
    ElementSpec,
    GnssSpec,
    LineSpec,
    OdometerSpec,
    ParallelSpec,
    ReferenceSpec,
    RunSpec,
    Scenario,
    SectionSpec,
    SkySpec,
    SurveySpec,
)
from schemas.config import Configuration, StreamCorrection, StreamMapping, Vehicle
from schemas.config_base import Settings
from schemas.dictionary import settings_frame
from schemas.project import (
    CalibrateEntry,
    ClaimEntry,
    ConvertEntry,
    LineEntry,
    LogEntry,
    Project,
    ReplayEntry,
    TrackEntry,
    load_project,
)
from schemas.settings_page import Key, field_texts, keys, settings_markdown
from tests.docs.blocks import ROOT, blocks

Rows = dict[str, str]
CONFIGURATION = ROOT / "docs" / "configuration.md"
SCENARIOS = ROOT / "docs" / "scenarios.md"
PROJECT = ROOT / "docs" / "project.md"
DEFAULTS_IN_WORDS = {"start": "2025-03-03T06:00:00Z", "solutions": "primary: gps", "target": "by kind"}
# Keys that nothing reads yet.
IDLE: tuple[str, ...] = ()


def tables(page: Path) -> list[Rows]:
    """Every table `key | default | meaning`, with a source or without, of a page: key to default."""
    found: list[Rows] = []
    width = 0
    for line in page.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) in (3, 4) and "default" in cells[1] and cells[0].startswith("key"):
            found.append({})
            width = len(cells)
        elif not line.startswith("|"):
            width = 0
        elif line.startswith("| `") and len(cells) == width:
            assert cells[0].strip("`") not in found[-1]
            found[-1][cells[0].strip("`")] = cells[1]
    return found


def defaults(model: type[BaseModel], without: type[BaseModel] | None = None) -> Rows:
    known = without.model_fields if without else {}
    return {name: _default(name, item) for name, item in model.model_fields.items() if name not in known}


def _default(name: str, field: Any) -> str:
    if name in DEFAULTS_IN_WORDS:
        return DEFAULTS_IN_WORDS[name]
    if field.default is PydanticUndefined and field.default_factory is None:
        return "required"
    match field.get_default(call_default_factory=True):
        case None:
            return "not set"
        case BaseModel():
            return "all defaults"
        case "" | () | {}:
            return "none"
        case bool() as flag:
            return str(flag).lower()
        case value:
            return str(value)


MODELS = (
    *(Scenario, LineSpec, SectionSpec, ElementSpec, ParallelSpec, BaliseSpec, SurveySpec),
    *(RunSpec, MotionSpec, PhaseSpec, GnssSpec, SkySpec, RangeErrorSpec, OdometerSpec, ReferenceSpec, FaultSpec),
)


def test_scenario_keys_and_defaults() -> None:
    expected = [defaults(model) for model in MODELS]
    expected += [defaults(PlacedFault, FaultSpec), defaults(ExpectedRun), defaults(ExpectedHazard)]
    written = tables(SCENARIOS)
    assert len(written) == len(expected)
    for one, other in zip(written, expected, strict=True):
        assert one == other


def test_fault_kinds() -> None:
    from datasets.faults import _NEEDS, FaultKind, _usual_target_of

    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (\w+) \| [^|]+ \|$", SCENARIOS.read_text(), re.MULTILINE)
    kinds = {
        kind.value: (f"`{_NEEDS[kind]}`" if _NEEDS[kind] else "none", _usual_target_of(kind)) for kind in FaultKind
    }
    assert {kind: (needs, target) for kind, needs, target in rows} == kinds


def documented() -> list[Key]:
    """Every key of the configuration as the page shows it."""
    return [key for name, section in Configuration() for key in keys(type(section), f"{name}.")]


def test_page_of_the_configuration_is_up_to_date() -> None:
    """Else: `make configuration`."""
    assert CONFIGURATION.read_text(encoding="utf-8") == settings_markdown()


def test_page_has_every_key_and_default() -> None:
    shown = {key.name: key.default for key in documented()}
    values = {name: default for file, name, default in settings_frame().iter_rows() if file == "configuration"}
    assert list(shown) == list(values)
    assert {name for name in values if shown[name] in ("none", "not set")} == {
        name for name, default in values.items() if default in ("()", "not set")
    }
    numbers = {name: float(default) for name, default in values.items() if re.fullmatch(r"[\d.e+-]+", default)}
    assert len(numbers) > 200
    assert {name: float(shown[name]) for name in numbers} == numbers


def test_every_key_has_its_meaning_and_its_reason_or_source() -> None:
    assert [key.name for key in documented() if not (key.meaning and key.reason)] == []
    others = [
        key.name for model in (StreamMapping, StreamCorrection, Vehicle) for key in keys(model) if not key.meaning
    ]
    assert others == []


def test_a_unit_that_is_stated_is_that_of_the_name() -> None:
    """Keys whose text states a unit have it in their name, and no other one."""
    stated = {key.name: re.search(r" \[(m/s2|m/s|m|s|h|deg|1/h|MiB|MB)\]", key.meaning) for key in documented()}
    units = {key.name: key.unit.replace("²", "2").replace("°", "deg") for key in documented()}
    assert {name: found[1] for name, found in stated.items() if found and found[1] != units[name]} == {}


class Brakes(Settings):
    """Not of this project: made by hand for the test."""

    lag_s: float = 0.5
    """Time until the brakes grip [s], however
    hard.

    A guess | ours.
    """
    silent: bool = False
    # No text.


def test_texts_are_those_under_the_keys() -> None:
    assert field_texts(Brakes) == {"lag_s": ("Time until the brakes grip [s], however hard.", "A guess | ours.")}
    lag, silent = keys(Brakes, "brakes.")
    assert (lag.name, lag.default, lag.unit) == ("brakes.lag_s", "0.5", "s")
    assert (silent.default, silent.unit, silent.meaning, silent.reason) == ("false", "", "", "")


# Read by the name of the stream, of the fix, of the service level and of the axis.
BY_NAME = ("ingest.", "fix_sigma.", "safety.service_levels.", "monitors.noise_cross_m", "monitors.noise_up_m")
KEYS = [
    key.rsplit(".", 1)[1]
    for file, key, _ in settings_frame().iter_rows()
    if file == "configuration" and not key.startswith(BY_NAME)
]


@pytest.mark.parametrize(
    "key",
    [
        pytest.param(key, marks=pytest.mark.xfail(strict=True, reason="nothing reads this key yet"))
        if key in IDLE
        else key
        for key in KEYS
    ],
)
def test_a_key_that_is_described_is_read(key: str, sources: str) -> None:
    assert re.search(rf"\.{key}\b", sources)


@pytest.fixture(scope="module")
def sources() -> str:
    """The program without the texts under keys, which name other keys."""
    files = [*(ROOT / "schemas").glob("config*.py"), ROOT / "schemas" / "limits.py"]
    settings = [ast.parse(path.read_text(encoding="utf-8")) for path in sorted(files)]
    for tree in settings:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                node.body = [item for item in node.body if not isinstance(item, ast.Expr)] or [ast.Pass()]
    texts = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "pipeline").rglob("*.py"))]
    return "\n".join([*texts, *(ast.unparse(tree) for tree in settings)])


def test_project_keys_and_defaults() -> None:
    models = (Project, TrackEntry, ConvertEntry, LogEntry, CalibrateEntry, ReplayEntry, ClaimEntry, LineEntry)
    assert tables(PROJECT) == [defaults(model) for model in models]


def test_example_of_a_project_is_one(tmp_path: Path) -> None:
    examples = [block.text for block in blocks(PROJECT) if block.language == "toml"]
    assert examples
    for number, text in enumerate(examples):
        file = tmp_path / f"{number}.toml"
        file.write_text(text)
        load_project(file)
