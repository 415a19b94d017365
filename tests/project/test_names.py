"""Names and kinds of files that no log should have, and folders whose links lead back: an answer, and soon."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import cli
from tests.project.test_run import nmea

_LINE = '{"type": "LineString", "coordinates": [[14.0, 50.0], [14.0, 50.1]]}'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    feature = f'{{"type": "Feature", "properties": {{}}, "geometry": {_LINE}}}'
    (tmp_path / "line.geojson").write_text(f'{{"features": [{feature}]}}')
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/good.nmea").write_text(nmea(60))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def trial(*logs: str, options: tuple[str, ...] = ()) -> int:
    """The command, or a failed test where it does not end: a pipe that nobody writes to never ends by itself."""
    arguments = ["trial", *logs, "--track", "line.geojson", "--balises", "every", "1000", *options, "--to", "p"]
    ended: list[int] = []
    thread = threading.Thread(target=lambda: ended.append(cli._run_guarded(arguments, debug=False)), daemon=True)
    thread.start()
    thread.join(60.0)
    assert ended, "it does not end"
    return ended[0]


@pytest.mark.parametrize(
    "name", ["~morning.nmea", "-x.nmea", "[1].nmea", "a\nb.nmea", "$HOME {x} 'y' \"z\".nmea", "ü.nmea"]
)
def test_logs_of_odd_names_are_replayed(folder: Path, name: str) -> None:
    (folder / "logs/good.nmea").rename(folder / "logs" / name)
    status = trial("logs")
    if "\n" in name:
        assert status == cli.USAGE
        return
    assert status == cli.OK
    assert cli._run_guarded(["run", "--project", "p", "-q"], debug=False) in (cli.OK, cli.RUNS_NOT_OK)
    assert (folder / "p/result/manifest.json").exists()


def test_a_name_that_no_text_can_hold(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "logs/good.nmea").rename(folder / "logs" / os.fsdecode(b"\xff.nmea"))
    assert trial("logs") == cli.USAGE
    assert r"logs/\udcff.nmea: has a name that is not UTF-8" in capsys.readouterr().err


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


@pytest.mark.parametrize("suffix", [".ubx", ".toml", ".csv", ".geojson", ".mcap"])
@pytest.mark.parametrize("make", [make_fifo, link_to_zero, link_to_itself])
def test_what_is_no_regular_file(
    folder: Path, capsys: pytest.CaptureFixture[str], suffix: str, make: Callable[[Path], None]
) -> None:
    odd = f"logs/x{suffix}"
    make(folder / odd)
    assert trial("logs") == cli.OK
    assert "good.nmea" in (folder / "p/balise.toml").read_text()
    assert odd not in (folder / "p/balise.toml").read_text()
    (folder / "p/balise.toml").unlink()
    capsys.readouterr()
    for options in ((odd,), ("logs/good.nmea", "--vehicle", odd), ("logs/good.nmea", "--reference", odd)):
        logs = [one for one in options if not one.startswith("--")][:1]
        assert trial(*logs, options=options[1:]) in (cli.USAGE, cli.RUNS_NOT_OK)
        said = capsys.readouterr().err
        assert said.startswith("balise: ")
        assert f"{odd}: " in said
        assert "defect" not in said


def test_links_that_lead_back_show_each_log_once(folder: Path) -> None:
    (folder / "logs/a").mkdir()
    (folder / "logs/good.nmea").rename(folder / "logs/a/good.nmea")
    (folder / "logs/a/back").symlink_to("..")
    (folder / "logs/again").symlink_to("a")
    (folder / "logs/a/other").symlink_to("../again")
    (folder / "logs/first.nmea").symlink_to("a/good.nmea")
    assert trial("logs") == cli.OK
    text = (folder / "p/balise.toml").read_text().partition("All other keys")[0]
    assert text.count("[[convert]]") == 1
    assert text.count('"../logs/a/good.nmea"') == 1
    assert "first" not in text


@pytest.mark.parametrize(
    "text",
    ['to = "a\\u0000b"', f'to = "{"x" * 260}"', f'to = "{"x/" * 2100}x"', 'to = "/"', 'to = "x/.."'],
    ids=["nul", "long name", "long path", "root", "above"],
)
def test_places_that_no_file_system_has(folder: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (folder / "balise.toml").write_text(f'[[convert]]\n{text}\n[[convert.logs]]\nfiles = ["logs/good.nmea"]\n')
    assert cli._run_guarded(["run"], debug=False) == cli.USAGE
    assert "balise.toml: convert.0.to: " in capsys.readouterr().err
