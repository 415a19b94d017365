"""Rooms: each folder of `pipeline` says what comes in and out, and the page of the architecture names it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT

ROOMS = sorted(path.parent for path in (ROOT / "pipeline").rglob("__init__.py") if path.parent.name != "pipeline")
STAGES = ROOT / "pipeline" / "stages"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
# What judges imports nothing of what is judged (DOMAIN section 5).
MAY_IMPORT = {
    "paths": {"track"},
    "reference": {"paths", "track"},
    "evidence": {"odometry", "reference", "track"},
    "judge": {"epochs", "evidence", "odometry", "track"},
}


def imported_rooms(room: Path) -> set[str]:
    """Stages, and doors of `pipeline`, that any module of this room imports."""
    names: set[str] = set()
    for source in room.glob("*.py"):
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
    parts = [name.split(".") for name in names if name.startswith("pipeline.")]
    rooms = {name[2] if name[1] == "stages" and len(name) > 2 else name[1] for name in parts}
    return rooms - {room.name}


@pytest.mark.parametrize("room", ROOMS, ids=lambda path: path.name)
def test_a_room_says_what_comes_in_and_out(room: Path) -> None:
    text = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8"))) or ""
    assert re.search(r"^In: .*Out: ", text, re.MULTILINE | re.DOTALL)
    assert re.search(r"\b(Touches|Nothing that came)\b", text)
    assert re.search(rf"\b{room.name}\b", PAGE)


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_the_judge_imports_nothing_of_the_accused(room: str) -> None:
    assert imported_rooms(STAGES / room) <= MAY_IMPORT[room]


def test_imports_of_rooms_are_seen() -> None:
    assert {"matching", "lds", "evidence", "judge"} <= imported_rooms(STAGES)


def test_files_that_the_page_names_exist() -> None:
    named = set(re.findall(r"`((?:\w+/)*\w+\.py)`", PAGE))
    files = [path.relative_to(ROOT).as_posix() for path in ROOT.glob("*.py")]
    files += [
        path.relative_to(ROOT).as_posix()
        for layer in ("pipeline", "schemas", "datasets", "tests", "benchmarks")
        for path in (ROOT / layer).rglob("*.py")
    ]
    assert named
    assert {name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in files)} == set()


@pytest.mark.parametrize("package", sorted(path.parent.name for path in STAGES.glob("*/__init__.py")))
def test_a_package_says_what_each_of_its_modules_is_for(package: str) -> None:
    text = (STAGES / package / "__init__.py").read_text(encoding="utf-8").split('"""')[1]
    modules = {path.stem for path in (STAGES / package).glob("*.py")} - {"__init__", package}
    assert {module for module in modules if f"`{module}`" not in text} == set()
    named = {word.removesuffix(".py") for word in re.findall(r"`([a-z_]+\.py)`", text)}
    assert named <= modules | {package}
