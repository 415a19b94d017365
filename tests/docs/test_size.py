"""Pages stay readable: what is written by hand is short, and the changelog takes one screen a version."""

from __future__ import annotations

import re

import pytest

from tests.docs.blocks import PAGES, ROOT

GENERATED = ("dictionary.md", "configuration.md")
WRITTEN = [page for page in (*PAGES, ROOT / "CHANGELOG.md") if page.name not in GENERATED]
# A reader takes 200 words a minute, and less of tables.
WORDS, WORDS_OF_A_PAGE, LINES_OF_A_VERSION, WORDS_OF_CONTRIBUTING = 60_000, 9_000, 70, 700


def words(text: str) -> int:
    return len(text.split())


def test_documentation_is_short() -> None:
    assert 30_000 < sum(words(page.read_text(encoding="utf-8")) for page in WRITTEN) <= WORDS


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_is_read_in_one_sitting(page: object) -> None:
    assert words(page.read_text(encoding="utf-8")) <= WORDS_OF_A_PAGE  # type: ignore[attr-defined]


def test_how_to_contribute_is_one_page() -> None:
    assert words((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")) <= WORDS_OF_CONTRIBUTING


def test_changelog_has_one_screen_a_version() -> None:
    versions = re.split(r"^## (?=\d)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    assert [version.split()[0] for version in versions] == ["0.3.0", "0.1.0"]
    assert [version.split()[0] for version in versions if len(version.splitlines()) > LINES_OF_A_VERSION] == []
