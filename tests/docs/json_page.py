"""`docs/json.md` as data: the fields of each command's answer."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from schemas.dictionary import groups
from tests.docs.blocks import ROOT

PAGE = ROOT / "docs" / "json.md"
SECTIONS = dict(re.findall(r"^## `([^`]+)`\n(.*?)(?=^## |\Z)", PAGE.read_text(encoding="utf-8"), re.M | re.S))
COLUMNS = {name: set(schema.columns()) for tables in groups().values() for name, schema in tables.items()}


def fields(section: str) -> dict[str, str]:
    """Meaning of each field of a section, by its place: `runs[].run_id`. `Each:` and `In it:` list what is inside."""
    found: dict[str, str] = {}
    for place, meaning in re.findall(r"^\| `([^`]+)` \| (.*) \|$", SECTIONS[section], re.MULTILINE):
        found[place] = meaning
        inner = re.search(r"(Each|In it): (.*)", meaning)
        if inner:
            listed = re.sub(r"\([^)]*\)|as in table `\w+`", "", inner[2])
            way = f"{place}[]" if inner[1] == "Each" else place
            found |= {f"{way}.{name}": "" for name in re.findall(r"`(\w+)`", listed)}
    return found


def places(value: Any, meanings: dict[str, str], place: str = "") -> Iterator[str]:
    """Places of all fields. Rows of a table of the dictionary are held against its columns."""
    meaning = meanings.get(place, "")
    if isinstance(value, list):
        rows = [row for row in value if isinstance(row, dict)]
        if table := re.search("ows of table `(.+?)`", meaning):
            assert {name for row in rows for name in row} <= COLUMNS[table[1]] | {"run_id"}
        else:
            yield from (name for row in rows for name in places(row, meanings, f"{place}[]"))
    elif isinstance(value, dict) and "by name" not in meaning:
        for name, item in value.items():
            inner = f"{place}.{name}" if place else name
            yield inner
            yield from places(item, meanings, inner)
