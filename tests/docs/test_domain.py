"""The sections of the domain that the code cites exist on the page that the code calls DOMAIN."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT

SECTIONS = re.findall(r"^#+ (\d(?:\.\d)?)\.? ", (ROOT / "docs" / "domain.md").read_text(encoding="utf-8"), re.MULTILINE)
SOURCES = sorted(
    path for layer in ("pipeline", "schemas", "datasets", "benchmarks") for path in (ROOT / layer).rglob("*.py")
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
