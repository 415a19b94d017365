"""What lies in a folder: logs, surveys, sites, settings."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args

from pipeline.campaign.plan import is_run
from pipeline.make.receivers.bags import is_bag
from pipeline.make.receivers.gpsd import HEAD, is_gpsd
from pipeline.make.survey.map_files import MAP_SUFFIXES
from pipeline.read.ingest.csv_text import read_log_table
from pipeline.read.ingest.guesses import POSITION, WORDS, columns_in, first_fitting, word_of, words_of_times
from schemas.config import Configuration, Settings, Vehicle, read_toml, settings_from
from schemas.errors import BaliseError, UsageError
from schemas.project import FILE_NAME

_SITE_FILES = ("track.parquet", "track.csv", "track.geojson")
_LINES = (".gpx", ".kml", ".kmz", ".geojson", ".json", *MAP_SUFFIXES)
# Parts of a Shapefile, and what a desktop leaves behind.
_COMPANION_SUFFIXES = (".shx", ".dbf", ".prj", ".cpg", ".qix", ".ini", ".db", ".md", ".html", ".pdf")


Kind = Literal["logs", "surveys", "sites", "balises", "vehicles", "configs"]
Found = dict[Kind, list[Path]]
"""Paths by what they are for."""


def is_site(path: Path) -> bool:
    """Whether a path is a folder with a track."""
    return path.is_dir() and any((path / name).exists() for name in _SITE_FILES)


def is_one_log(path: Path) -> bool:
    """Whether a path is one log: a file, a run, a bag, or a public recording; not a folder of logs."""
    return path.is_file() or is_run(path) or is_bag(path) or (path / "processed_log").is_dir()


def is_prose(path: Path) -> bool:
    """Whether a path is a text without columns, as notes are."""
    try:
        return path.suffix.lower() == ".txt" and read_log_table(path, infer=True).table.width < 2
    except BaliseError:
        return False


def logs_below(folder: Path) -> list[Path]:
    """What may be a log in a folder and those below it."""
    return look_around(folder)["logs"]


def look_around(folder: Path) -> Found:
    """Sort what lies in a folder and those below it, by names and headers; results and hidden files are passed over."""
    found: Found = {kind: [] for kind in get_args(Kind)}
    for path in _walk_once(folder):
        if (kind := _kind_of(path)) is not None:
            found[kind].append(path)
    return found


def _walk_once(folder: Path) -> Iterator[Path]:
    """Regular files, and folders that are one thing, each once: by its own name rather than by that of a link."""
    visited = {os.path.realpath(folder)}
    links: list[Path] = []
    yield from _things_inside(folder, visited, links)
    while links:
        link = links.pop(0)
        if _note_if_new(link, visited):
            yield from _things_at(link, visited, links)


def _things_inside(folder: Path, visited: set[str], links: list[Path]) -> Iterator[Path]:
    """Files and things inside a folder that were not seen yet; links are put off."""
    for path in sorted(folder.iterdir()):
        if path.is_symlink():
            links.append(path)
        elif _note_if_new(path, visited):
            yield from _things_at(path, visited, links)


def _note_if_new(path: Path, visited: set[str]) -> bool:
    """Whether a path is seen for the first time, by its own name; it is then."""
    real = os.path.realpath(path)
    is_new = real not in visited
    visited.add(real)
    return is_new


def _things_at(path: Path, visited: set[str], links: list[Path]) -> Iterator[Path]:
    """The thing at a path, or those below it; nothing for results and hidden files."""
    if path.name.startswith(".") or path.name == FILE_NAME or (path / "manifest.json").is_file():
        return
    require_name(path)
    if path.is_dir() and not is_site(path) and not is_one_log(path):
        yield from _things_inside(path, visited, links)
    elif path.is_dir() or (path.is_file() and path.suffix.lower() not in _COMPANION_SUFFIXES):
        yield path


def require_name(path: Path) -> None:
    """Raise `UsageError` for a name that no text can hold."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        remedy = "Rename it: it could be named in no project file."
        raise UsageError("has a name that is not UTF-8", place=str(path), remedy=remedy) from None


def _kind_of(path: Path) -> Kind | None:
    """What a file or folder is by its name and header."""
    suffix = path.suffix.lower()
    if is_site(path):
        return "sites"
    if suffix == ".toml":
        return _kind_of_settings(path)
    if suffix in _LINES:
        return "logs" if suffix == ".json" and _holds_gpsd(path) else "surveys"
    return _kind_of_table(path) if suffix == ".csv" and path.is_file() else "logs"


def _holds_gpsd(path: Path) -> bool:
    """Whether a file is a log of gpsd, though its name ends like that of a map."""
    with path.open("rb") as stream:
        return is_gpsd(stream.read(HEAD))


def _kind_of_settings(path: Path) -> Kind | None:
    """Whether a TOML file is a vehicle file or a configuration: what it can be read as."""
    kinds: dict[Kind, type[Settings]] = {"vehicles": Vehicle, "configs": Configuration}
    for kind, settings in kinds.items():
        with contextlib.suppress(BaliseError):
            settings_from(read_toml(path), settings, str(path))
            return kind
    return None


def _kind_of_table(path: Path) -> Kind:
    """Whether a table is a log, or lists balises or points of a line: without a time it is no log."""
    try:
        table = read_log_table(path, infer=True).table
    except BaliseError:
        return "logs"
    words = {name: word_of(name) for name in table.columns if name.strip()}
    times = words_of_times(words)
    if any(first_fitting(times, WORDS[kind]) for kind in ("time", "date", "clock", "week")):
        return "logs"
    if first_fitting(words, WORDS["balise"]):
        return "balises"
    return "surveys" if set(columns_in("gnss", words)) >= POSITION else "logs"
