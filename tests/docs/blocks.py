"""The code blocks of the documentation, as a reader would copy them."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "examples" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]


@dataclass(frozen=True)
class Block:
    """Text of a fenced or indented block; `language` is empty for indented ones; `before` is the line before it."""

    page: str
    line: int
    language: str
    text: str
    before: str
    heading: str


def blocks(page: Path) -> list[Block]:
    """All blocks of a page in order."""
    found: list[Block] = []
    heading, before, language = "", "", ""
    begin, lines, fenced = 0, [], False

    def close() -> None:
        text = "\n".join(lines).strip("\n")
        if text:
            found.append(Block(page.name, begin, language, text + "\n", before, heading))

    for number, line in enumerate([*page.read_text(encoding="utf-8").splitlines(), ""], start=1):
        if line.startswith("```"):
            if fenced or lines:
                close()
            fenced, lines, begin = not fenced, [], number + 1
            language = line.removeprefix("```").strip() if fenced else ""
        elif fenced:
            lines.append(line)
        elif line.startswith("    ") or (lines and not line.strip()):
            begin = begin if lines else number
            lines.append(line.removeprefix("    "))
        else:
            close()
            lines = []
            if line.strip():
                before = line.strip()
            if line.startswith("#"):
                heading = line.lstrip("# ").strip()
    close()
    return found


def commands(page: Path) -> list[list[str]]:
    """Every `balise ...` and `make ...` line of the blocks, as arguments; comments are left out."""
    lines = [line for block in blocks(page) if block.language in ("", "sh") for line in _joined(block.text)]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"(balise|make)\b", line)]


def mentioned(page: Path) -> set[str]:
    """Names of commands in running text: `balise NAME ...` between back quotes."""
    return set(re.findall(r"`balise ([a-z]+)", page.read_text(encoding="utf-8")))


def _joined(text: str) -> list[str]:
    return text.replace("\\\n", " ").splitlines()
