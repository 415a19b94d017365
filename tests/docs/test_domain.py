"""The sections of the domain that the code cites exist on the page that the code calls DOMAIN."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path

import pytest

from schemas.enums import (
    Evidence,
    FailureMode,
    Fix,
    Hazard,
    Judgement,
    LdsMode,
    LdsState,
    LinkingError,
    MonitorState,
    Navigability,
    Origin,
    PassageStatus,
    Reaction,
    RunStatus,
    RunVerdict,
    Suspect,
    Timing,
)
from tests.docs.blocks import ROOT

DOMAIN = (ROOT / "docs" / "domain.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^#+ (\d(?:\.\d)?)\.? ", DOMAIN, re.MULTILINE)
CONTRACT = re.findall(r"^## CONTRACT section (\d): ", DOMAIN, re.MULTILINE)
TERMS = re.findall(r"^\| 1\.(\d+) \| ([^|]+): ([^|]+) \| ([^|]+) \|$", DOMAIN, re.MULTILINE)
SOURCES = sorted(
    path
    for layer in ("pipeline", "schemas", "datasets", "benchmarks")
    for path in (ROOT / layer).rglob("*")
    if path.suffix in (".py", ".toml", ".html")
)
PAGES = sorted((ROOT / "docs").glob("*.md"))
# Enumerations whose values a reader of tables meets, and that the page defines.
DEFINED = (
    *(Hazard, Judgement, RunVerdict, RunStatus, LdsMode, LdsState, MonitorState, FailureMode, Timing, LinkingError),
    *(Evidence, Fix, Origin, Navigability, Reaction, PassageStatus, Suspect),
)
CITED = re.compile(r"DOMAIN(?: sections?)? (\d(?:\.\d)?)((?:,? (?:and|to) \d(?:\.\d)?)*)")


def cited(text: str) -> set[str]:
    """Numbers of the sections that a text cites, those joined by `and` or `to` too."""
    joined = " ".join(text.split())
    return {number for found in CITED.findall(joined) for number in (found[0], *re.findall(r"\d(?:\.\d)?", found[1]))}


def test_citations_are_found() -> None:
    assert cited("(DOMAIN section 5.1)") == {"5.1"}
    assert cited("DOMAIN sections 5.3 and 6; DOMAIN 5.2 to\n    5.4") == {"5.3", "6", "5.2", "5.4"}
    assert cited("the domain of a function") == set()


def test_the_page_has_the_sections_of_the_judge() -> None:
    assert {"1", "2", "3", "4", "5", "5.1", "5.2", "5.3", "5.4", "5.5", "6", "7"} <= set(SECTIONS)


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: Path(path).relative_to(ROOT).as_posix())
def test_cited_sections_exist(source: Path) -> None:
    assert cited(source.read_text(encoding="utf-8")) <= set(SECTIONS)


def cited_contract(text: str) -> set[str]:
    """Numbers of the sections of the contract that a text cites."""
    found = re.findall(r"CONTRACT(?: sections?)? (\d)(?: and (\d))?", " ".join(text.split()))
    return {number for numbers in found for number in numbers if number}


def test_citations_of_the_contract_are_found() -> None:
    assert cited_contract("CONTRACT section 1); CONTRACT sections 2 and\n  3, `outages`; CONTRACT 4") == set("1234")


@pytest.mark.parametrize("source", [*SOURCES, *PAGES], ids=lambda path: Path(path).relative_to(ROOT).as_posix())
def test_cited_sections_of_the_contract_exist(source: Path) -> None:
    assert cited_contract(source.read_text(encoding="utf-8")) <= set(CONTRACT)


def test_terms_are_numbered_once_each_with_its_source() -> None:
    assert len(TERMS) > 80
    assert len(TERMS) == len(re.findall(r"^\| 1\.", DOMAIN, re.MULTILINE))
    assert [int(number) for number, *_ in TERMS] == list(range(1, len(TERMS) + 1))
    names = [name for _, term, _, _ in TERMS for name in term.split(", ")]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("values", DEFINED, ids=lambda enum: enum.__name__)
def test_values_of_tables_are_explained(values: type[StrEnum]) -> None:
    text = DOMAIN.lower().replace("_", " ")
    names = {value: value.lower().replace("_", " ").removeprefix("rejected ") for value in values}
    assert [value for value, name in names.items() if not re.search(rf"\b{name}\b", text)] == []
