"""Every command of the documentation runs as it is written, in a folder that holds what it names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer

import cli
from pipeline.results.software import software_digest
from pipeline.results.store import read_table
from tests.docs.blocks import PAGES, ROOT, blocks, commands, mentioned

# The same ride, converted from the receiver's log, and as it was written.
RIDES = ("morning", "evening")
# The exit status that the page announces for a command, where it is not 0.
ANNOUNCED = re.compile(r"# exit status (\d)")


def lines(page: Path) -> list[tuple[list[str], int]]:
    """Commands with their exit status."""
    texts = [line for block in blocks(page) if block.language in ("", "sh") for line in block.text.splitlines()]
    announced = [ANNOUNCED.search(line) for line in texts if re.match(r"(balise|make)\b", line)]
    return [
        (command, int(status[1]) if status else 0)
        for command, status in zip(commands(page), announced, strict=True)
        if command[0] == "balise"
    ]


FIELD = ROOT / "docs" / "field-engineer.md"
# The answers of `json.md` are held by a test of their own.
WITH_COMMANDS = [page for page in PAGES if lines(page) and page.name not in (FIELD.name, "json.md")]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.name)
def test_commands_run_as_written(page: Path, workplace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run_commands(page, workplace, capfd)


def test_field_engineers_path_leads_to_a_sound_report(workplace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run_commands(FIELD, workplace, capfd)
    converted, recorded = (read_table("RESULT", "runs", run).collect().row(0, named=True) for run in RIDES)
    assert converted["status"] == recorded["status"] == "ok"
    assert converted["alarms"] == recorded["alarms"] == 0
    assert converted["balises_accepted"] == recorded["balises_accepted"] > 0
    assert read_table("RESULT_FAULTY", "alarms").collect().height > 0
    assert "morning" in (workplace / "RESULT/report/index.html").read_text(encoding="utf-8")
    assert {"morning.mcap", "morning.geojson"} <= {path.name for path in workplace.iterdir()}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_the_text_exist(page: Path) -> None:
    known = typer.main.get_command(cli.app)
    assert mentioned(page) <= set(known.commands)  # type: ignore[attr-defined]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_targets_of_make_exist(page: Path) -> None:
    known = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {command[1] for command in commands(page) if command[0] == "make"} <= known


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]*)(#[^)]*)?\)", page.read_text(encoding="utf-8")):
        file = (page.parent / target[0]).resolve() if target[0] else page
        assert file.exists(), target
        if target[1] and file.suffix == ".md":
            assert target[1].lstrip("#") in anchors(file), target


def test_every_command_is_in_some_guide() -> None:
    known = typer.main.get_command(cli.app)
    described = {command[0][1] for page in PAGES for command in lines(page)} | {
        n for page in PAGES for n in mentioned(page)
    }
    assert set(known.commands) <= described  # type: ignore[attr-defined]


def run_commands(page: Path, workplace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_files_of(page, workplace)
    for arguments, status in lines(page):
        # A user's command is a process of its own, which knows the program as it is now.
        software_digest.cache_clear()
        found = cli._run_guarded(arguments[1:], debug=False)
        said = capfd.readouterr()
        assert found == status, f"{' '.join(arguments)}\n{said.out}\n{said.err}"
        assert "Traceback" not in said.err


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def write_files_of(page: Path, folder: Path) -> None:
    """Files that the page has its reader write: TOML blocks whose line before names the file."""
    for block in blocks(page):
        name = re.search(r"`(\w+\.toml)`", block.before)
        if block.language == "toml" and name:
            (folder / name[1]).write_text(block.text, encoding="utf-8")
