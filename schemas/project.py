"""The project file `balise.toml`: what a trial recorded, on which line, with which settings.

Tables are named after the command whose options they hold. Paths are relative to the file.
"""

from __future__ import annotations

import os
from collections import Counter
from datetime import date as day
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from schemas.config import (
    Configuration,
    NonNegative,
    Positive,
    Settings,
    StreamCorrection,
    StreamMapping,
    StreamMappings,
    load_settings,
    read_toml,
    settings_from,
)
from schemas.enums import TravelAlong
from schemas.errors import ConfigError
from schemas.run import RECORDED_STREAMS

FILE_NAME = "balise.toml"
NO_VEHICLE = "none"
_REMEDY = "docs/project.md explains every key."
# Of a file and of a path, on every common file system.
_LONGEST_NAME_BYTES = 255
_LONGEST_PATH_BYTES = 4000


def _possible(path: str) -> str:
    """A path that a file system can have. Raises `ValueError`."""
    if hidden := next((sign for sign in path if ord(sign) < 32 or ord(sign) == 127), None):
        raise ValueError(f"holds the character {hidden!r}, which no path here may have")
    if any(len(part.encode()) > _LONGEST_NAME_BYTES for part in path.split("/")):
        raise ValueError(f"holds a name longer than {_LONGEST_NAME_BYTES} bytes")
    if len(path.encode()) > _LONGEST_PATH_BYTES:
        raise ValueError(f"is longer than {_LONGEST_PATH_BYTES} bytes")
    return path


def _naming(path: str) -> str:
    """A path that names a run."""
    if Path(path).name in ("", ".."):
        raise ValueError("names no run")
    return path


PathText = Annotated[str, Field(min_length=1), AfterValidator(_possible)]
"""A path relative to the project file, or an address."""


class LogMapping(StreamMapping):
    """As in `[ingest]`, but of the log that it stands under: `topic` is needed for bags alone."""

    topic: str = ""


class LogEntry(StreamMappings[LogMapping]):
    """Logs of one recorder: `files` follow each other in time. `stream`: what their positions are for."""

    files: Annotated[tuple[PathText, ...], Field(min_length=1)]
    stream: Literal["gnss", "reference"] = "gnss"
    solution: str | None = None
    date: day | None = None

    def mappings(self) -> dict[str, tuple[StreamMapping, ...]]:
        """Mappings by stream, each with the topic that it is for: of tables the name of the file."""
        names = [Path(file).name for file in self.files]
        return {
            stream: tuple(
                StreamMapping(**{**given.model_dump(), "topic": topic})
                for given in getattr(self, stream)
                for topic in ([given.topic] if given.topic else names)
            )
            for stream in RECORDED_STREAMS
            if getattr(self, stream)
        }


class ConvertEntry(Settings):
    """One run of receivers' logs (`balise convert`); `correct` as `[[ingest.correct]]`, of this run alone."""

    to: Annotated[PathText, AfterValidator(_naming)]
    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1)]
    correct: tuple[StreamCorrection, ...] = ()

    @property
    def run_id(self) -> str:
        """The run id that the converted run has."""
        return Path(self.to).name.removesuffix(".mcap")


class TrackEntry(Settings):
    """A site made of surveys (`balise site`).

    `sigma_m`: standard deviation of its points across the track where they state none. `survey_complete`: it holds
    every track that the trains may have used, as under `[evidence]` of the configuration.
    """

    survey: Annotated[tuple[PathText, ...], Field(min_length=1)]
    balises: PathText | None = None
    direction: TravelAlong = TravelAlong.BOTH
    epsg: int | None = None
    join_m: NonNegative | None = None
    flat: bool = False
    id_field: str | None = None
    sigma_m: Positive | None = None
    survey_complete: bool = False


class CalibrateEntry(Settings):
    """A vehicle file measured on runs without fault (`balise calibrate`); it is used in place of `vehicle`.

    `monitors`: also the monitors' noise and sigmas, in place of those of the configuration.
    """

    runs: Annotated[tuple[PathText, ...], Field(min_length=1)]
    solution: str = "primary"
    monitors: bool = False


class ReplayEntry(Settings):
    """Options of `balise replay`; `runs`: those that need no conversion, beside the converted ones."""

    runs: tuple[PathText, ...] = ()
    route: PathText | None = None
    write_route: PathText | None = None
    undetected: bool = False
    calibrate: tuple[PathText, ...] = ()
    jobs: Annotated[int, Field(ge=0)] = 0
    scheduler: str | None = None
    time_limit_s: Annotated[float, Field(ge=0.1)] = 3600.0
    fail_on: Literal["unsafe", "unproven"] | None = None


class ClaimEntry(Settings):
    """Options of `balise claim`."""

    profile: PathText | None = None
    front_ahead_m: float | None = None


class LineEntry(Settings):
    """Options of `balise line`."""

    criteria: PathText | None = None
    points: PathText | None = None
    solution: str | None = None
    out: PathText | None = None


class Project(Settings):
    """The whole of a project file. `unread`: logs that could not be read when it was written; no run has them."""

    site: PathText = "site"
    out: PathText = "result"
    vehicle: PathText | None = None
    vehicles: dict[str, PathText] = Field(default={})
    config: PathText | None = None
    service_level: str | None = None
    unread: tuple[str, ...] = ()
    track: TrackEntry | None = None
    convert: tuple[ConvertEntry, ...] = ()
    calibrate: CalibrateEntry | None = None
    replay: ReplayEntry = ReplayEntry()
    claim: ClaimEntry = ClaimEntry()
    line: LineEntry = LineEntry()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """What is stated of a project fits together."""
        twice = [run for run, count in Counter(entry.run_id for entry in self.convert).items() if count > 1]
        if twice:
            raise ValueError(f"convert: {', '.join(twice)} stands there twice; results are stored by run id")
        if self.vehicles and (self.calibrate or self.replay.calibrate):
            raise ValueError("vehicles: runs of several vehicles cannot be calibrated together; make a project of each")
        return self


_OWN_KEYS = Project.model_fields.keys() - Configuration.model_fields.keys()


def is_project(data: dict[str, object]) -> bool:
    """Whether TOML is a project: it has keys that no configuration has (of tables of one name a project has none).

    Args:
        data: TOML as a mapping.

    Returns:
        Whether `balise run` can take it.
    """
    return isinstance(data.get("site"), str) or not data.keys().isdisjoint(_OWN_KEYS)


def load_project(file: Path) -> Project:
    """Read a project file.

    Args:
        file: `balise.toml`, or a file of another name.

    Returns:
        The project.

    Raises:
        ConfigError: the file cannot be read or breaches the model; an unknown key is named with the nearest known one.
    """
    return settings_from(read_toml(file), Project, str(file), _REMEDY)


def load_configuration(file: Path | None) -> Configuration:
    """A configuration file, or the configuration that a project file stands for.

    Args:
        file: a configuration or project file, or None for the defaults.

    Returns:
        The configuration.

    Raises:
        ConfigError: the file cannot be read or breaches its model.
    """
    if file is None or not is_project(data := read_toml(file)):
        return load_settings(file, Configuration)
    return configuration_of(settings_from(data, Project, str(file), _REMEDY), file)


def configuration_of(project: Project, file: Path) -> Configuration:
    """The configuration that a project at this file stands for.

    Args:
        project: a project.
        file: its file, to whose folder its paths are relative.

    Returns:
        The configuration, with survey and service level as the project has them.

    Raises:
        ConfigError: the configuration file that it names cannot be used.
    """
    # By name: the project's folder may not exist yet.
    named = None if project.config is None else Path(os.path.normpath(file.parent / project.config))
    config = load_settings(named, Configuration)
    if project.track is not None and project.track.survey_complete:
        complete = config.evidence.model_copy(update={"survey_complete": True})
        config = config.model_copy(update={"evidence": complete})
    return _with_service_level(config, project.service_level, file)


def _with_service_level(config: Configuration, level: str | None, file: Path) -> Configuration:
    """The configuration with the service level of the project; raises `ConfigError` for an unknown one."""
    if level is None:
        return config
    if level not in config.safety.service_levels:
        known = ", ".join(sorted(config.safety.service_levels))
        raise ConfigError("is no service level", place=f"{file}: service_level", found=repr(level), expected=known)
    return config.model_copy(update={"hazards": config.hazards.model_copy(update={"service_level": level})})
