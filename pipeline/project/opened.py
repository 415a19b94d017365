"""A project where it stands: its paths, its settings, and what other commands take from it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any

from pipeline.storage.address import is_url
from schemas.config import Configuration, Settings, Vehicle, load_settings, read_toml
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.project import FILE_NAME, NO_VEHICLE, Project, configuration_of, is_project, load_project
from schemas.words import say

MEASURED_VEHICLE = "vehicle_measured.toml"
MEASURED_CONFIG = "config_measured.toml"
RECORD = ".balise"


@frozen
class Opened:
    """A project and its file; places that it names are resolved from the working directory."""

    file: Path
    project: Project

    @property
    def folder(self) -> Path:
        """The folder that its paths are relative to."""
        return self.file.parent

    def place(self, named: str) -> str:
        """A path of the file, or an address. `..` is taken off by name, as `named_from` puts it there.

        `~` alone is the home of whoever calls; `~morning.csv` is a name like others.
        """
        if is_url(named):
            return named
        path = Path(named)
        return os.path.normpath(self.folder / (path.expanduser() if path.parts[:1] == ("~",) else path))

    def path(self, named: str | None) -> Path | None:
        """A path that the project names, from the working directory; None where it names none."""
        return None if named is None else Path(self.place(named))

    @property
    def words(self) -> dict[str, str]:
        """What sentences on a project name: its file, the option where it is not that of the working directory."""
        option = "" if self.file == Path(FILE_NAME) else f" --project {self.folder}"
        made = "made" if self.project.track is not None else "given"
        places = {"project": self.file, "site": self.project.site}
        return {
            "project": str(self.file),
            "of_project": option,
            "again": f"balise run{option}",
            "how_sigma": say("survey_of_project", f"sigma_of_{made}", **places),
            "how_complete": say("survey_of_project", f"complete_of_{made}", **places),
        }

    @property
    def config_file(self) -> Path | None:
        """What stands for `--config`: the project itself where it changes the configuration."""
        if self.project.calibrate is not None and self.project.calibrate.monitors:
            return self.folder / RECORD / MEASURED_CONFIG
        changed = self.project.service_level or (self.project.track and self.project.track.survey_complete)
        return self.file if changed else self.path(self.project.config)

    @property
    def vehicle_file(self) -> Path | None:
        """The vehicle file of runs that name no other; measured ones are made by `run`."""
        if self.project.calibrate is not None:
            return self.folder / RECORD / MEASURED_VEHICLE
        return self.path(self.project.vehicle)

    def vehicle_of(self, run_id: str) -> Path | None:
        """The vehicle file of one run: the first pattern of `[vehicles]` that fits, else that of all."""
        named = next((file for pattern, file in self.project.vehicles.items() if fnmatchcase(run_id, pattern)), None)
        if named == NO_VEHICLE:
            return None
        return self.vehicle_file if named is None else self.path(named)

    def given_config(self) -> Configuration:
        """The configuration as written, before anything is measured."""
        return configuration_of(self.project, self.file)

    def given_vehicle(self) -> Vehicle:
        """The vehicle file of the project, or what nothing is known of."""
        return load_settings(self.path(self.project.vehicle), Vehicle)

    def runs(self) -> list[str]:
        """Paths of all runs: the converted ones, and patterns of those that need no conversion."""
        return [
            *map(self.place, (entry.to for entry in self.project.convert)),
            *map(self.place, self.project.replay.runs),
        ]


def open_project(named: Path | None) -> Opened:
    """The project of a folder or file. Raises `UsageError` where there is none, `ConfigError` for a wrong key."""
    file = named or Path()
    file = file / FILE_NAME if file.is_dir() else file
    if not file.is_file():
        remedy = "`balise trial RAW... --track LINE --balises B --to FOLDER` or `balise init FOLDER` writes one."
        raise UsageError("there is no project", place=str(file), expected=f"a file {FILE_NAME}", remedy=remedy)
    return Opened(file, load_project(file))


def project_here(named: Path | None) -> Opened | None:
    """The project that was named, or that of the working directory, if any."""
    file = Path(FILE_NAME)
    if named is not None or (file.is_file() and is_project(read_toml(file))):
        return open_project(named)
    return None


def values_for(command: str, opened: Opened) -> dict[str, Any]:
    """What a command takes where its own options are not given, by the names of its parameters."""
    project = opened.project
    out = opened.place(project.out)
    site = opened.place(project.site)
    settings = {"vehicle": opened.vehicle_file, "config": opened.config_file}
    replay = _options_of(opened, project.replay, "route", "write_route")
    replay["runs"] = opened.runs()
    replay["calibrate"] = [one if one == "auto" else opened.place(one) for one in project.replay.calibrate]
    replay["time_limit"] = replay.pop("time_limit_s", None)
    line = _options_of(opened, project.line, "criteria", "points", "out")
    claim = _options_of(
        opened, project.claim, *(["profile"] if (project.claim.profile or "").endswith(".toml") else [])
    )
    values: dict[str, dict[str, Any]] = {
        "inspect": {"path": out if Path(out).exists() else site, "site": site, **settings},
        "replay": {"site": site, "out": out, **settings, **replay},
        "report": {"out": out, "site": site},
        "sql": {"out": out},
        "export": {"out": out, "site": site, "config": opened.config_file},
        "verify": {"out": out, "site": site, "route": replay.get("route"), **settings},
        "safety": {"out": out, "site": site, "vehicle": opened.vehicle_file},
        "line": {**line, "out": out, "site": site, "to": line.get("out")},
        "claim": {"out": out, "site": site, "profile": claim.get("profile"), "front_ahead": claim.get("front_ahead_m")},
    }
    return {name: value for name, value in values.get(command, {}).items() if value not in (None, [], False)}


def _options_of(opened: Opened, entry: Settings, *paths: str) -> dict[str, Any]:
    """What a table of the project sets; `paths`: what of it are places."""
    given = entry.model_dump(exclude_unset=True)
    return given | {name: opened.path(given[name]) for name in paths if name in given}


def taken_from_project(
    named: str | None, command: str, missing: Sequence[str | None], say: Callable[[str], None] | None
) -> dict[str, Any]:
    """What a command takes from the project for parameters that are missing, said in one line."""
    opened = project_here(None if named is None else Path(named))
    if opened is None:
        return {}
    values = values_for(command, opened)
    _require_measured(opened, values)
    taken = {name: value for name, value in values.items() if name in missing}
    if taken and say is not None:
        taken_words = ", ".join(f"{name} {_shown(value)}" for name, value in taken.items())
        say(f"balise: from {opened.file}: {taken_words}")
    return values


def _require_measured(opened: Opened, values: dict[str, Any]) -> None:
    """What a calibration has not measured yet cannot be used."""
    measured = opened.folder / RECORD
    absent = [value for value in values.values() if isinstance(value, Path) and value.parent == measured]
    if any(not value.exists() for value in absent):
        raise UsageError("is not calibrated yet", place=str(opened.file), remedy="`balise run` does it.")


def _shown(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def named_from(path: PurePath, folder: PurePath) -> str:
    """A path as a project in this folder names it, both absolute.

    Relative for what lies beside or below the folder, so that both can be moved together; else absolute. Slashes go
    forward, so that the file is read on any system.
    """
    if path.is_relative_to(folder):
        return path.relative_to(folder).as_posix()
    if path.is_relative_to(folder.parent) and folder.parent != folder.parent.parent:
        return f"../{path.relative_to(folder.parent).as_posix()}"
    return path.as_posix()
