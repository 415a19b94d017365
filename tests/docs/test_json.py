"""`docs/json.md`: every command answers in JSON, with the fields that the page lists."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

import cli
from datasets.trial import write_run_as
from pipeline.read.ingest import read_run
from pipeline.results.software import software_digest
from schemas.config import IngestConfig
from schemas.tables import TABLES
from tests.docs.blocks import ROOT, Block, blocks
from tests.docs.json_page import PAGE, SECTIONS, fields, places
from tests.docs.test_commands import write_files_of

ARRAYS = {"sql"}
# The demo takes long; `tests/datasets/test_demo.py` holds its fields.
SLOW = {"demo"}
# What the recordings at hand do not show.
NOT_IN_EXAMPLES = {
    "init": {"corrections[]." + name for name in ("run_id", "found", "toml", "accepted")},
    "trial": {"corrections[]." + name for name in ("run_id", "found", "toml", "accepted")},
    "inspect": {
        *("Problems", "Problems[].problem", "Lines that mend it", "Lines that mend it[].toml"),
        *("Noted or not used", "Noted or not used[].reason", "Noted or not used[].count"),
    },
    "diff": {"runs[].hazards[].differences[]." + name for name in ("table", "kind", "column", "message", "rows")},
}


def test_every_command_has_the_option_and_its_section() -> None:
    known = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    without = [name for name, command in known.items() if "--json" not in _options(command)]
    assert without == []
    assert {head.split()[0] for head in SECTIONS} == set(known)
    assert {block.heading.strip("`") for block in _examples()} == set(SECTIONS)


def _options(command: Any) -> set[str]:
    return {option for parameter in command.params for option in parameter.opts}


def _examples() -> Iterator[Block]:
    return (block for block in blocks(PAGE) if block.text.startswith("balise "))


@pytest.mark.parametrize("section", sorted(set(SECTIONS) - SLOW))
def test_answers_have_the_fields_of_the_page(section: str, workplace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    _prepare(workplace)
    documented = fields(section)
    always = {place for place, meaning in documented.items() if "." not in place and not meaning.startswith("only ")}
    answered: set[str] = set()
    for block in _examples():
        for line in block.text.splitlines() if block.heading == f"`{section}`" else ():
            found = _answer(line, capfd)
            assert isinstance(found, list) is (section in ARRAYS)
            there = set() if section in ARRAYS else set(places(found, documented))
            assert always <= there
            answered |= there
    assert answered == set(documented) - NOT_IN_EXAMPLES.get(section, set())


def _prepare(folder: Path) -> None:
    """What the examples name beside the workplace: files of the pages, a run as MCAP, a result that was changed."""
    for page in (PAGE, ROOT / "docs" / "scenarios.md"):
        write_files_of(page, folder)
    shutil.copytree(folder / "OUT_A", folder / "OUT_C")
    for table in TABLES:
        one, other = (folder / "OUT_C" / table / f"run_id={name}" for name in ("evening", "jump_two"))
        shutil.rmtree(other)
        shutil.copytree(one, other)
    write_run_as(read_run(folder / "RUN", IngestConfig()), folder / "monday.mcap")


def _answer(line: str, capfd: pytest.CaptureFixture[str]) -> Any:
    # A user's command is a process of its own, which knows the program as it is now.
    software_digest.cache_clear()
    status = cli._run_guarded(shlex.split(line)[1:], debug=False)
    said = capfd.readouterr()
    assert status in (0, 1), f"{line}\n{said.err}"
    return json.loads(said.out)
