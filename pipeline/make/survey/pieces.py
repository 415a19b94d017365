"""Pieces of line as a survey holds them, before anything is cut or joined."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.stages.track.geodesy import earth_centred_m, points_of
from pipeline.storage.noted import note
from schemas.arrays import Floats, Ints
from schemas.config import SurveyConfig
from schemas.errors import SiteError
from schemas.frozen import frozen
from schemas.run import Finding


def refuse_large(size: int, place: str, config: SurveyConfig) -> None:
    """A survey of more bytes than the configuration lets pass."""
    if size > config.size_limit_mb * 1e6:
        raise SiteError(
            "is too large",
            place=place,
            expected=f"at most {config.size_limit_mb:g} MB",
            remedy="Cut it to the line, or write a larger `size_limit_mb` under [survey] in the configuration file.",
        )


def content_of_survey(path: Path, config: SurveyConfig) -> bytes:
    """The file, unless it is too large to be one."""
    note(path)
    try:
        if not path.is_file():
            raise SiteError("is no regular file", place=str(path))
        refuse_large(path.stat().st_size, str(path), config)
        return path.read_bytes()
    except OSError as error:
        raise SiteError(f"cannot be read: {error.strerror}", place=str(path)) from None


@frozen
class LinePiece:
    """Points in order along one line: degrees, metres, kilometres of the line; NaN where not known.

    `name` is the source's own id. `recorded`: by a vehicle that stood, came back or passed twice. `whole`: a net
    element of a network with relations, which ends where these say.
    """

    name: str
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    line_km: Floats
    sigma_m: Floats
    recorded: bool = False
    whole: bool = False

    def with_sigma(self, sigma_m: float) -> LinePiece:
        """The piece with this standard deviation [m] at points that state none."""
        return replace(self, sigma_m=np.where(np.isnan(self.sigma_m), sigma_m, self.sigma_m))

    def __len__(self) -> int:
        return len(self.latitude_deg)

    @property
    def surface(self) -> Floats:
        """The points at height zero, earth-centred [m]."""
        return points_of(self.latitude_deg, self.longitude_deg).surface

    @property
    def positions_3d(self) -> Floats:
        """The points at their heights, at height zero where one of them has none, earth-centred [m]."""
        height = np.zeros(len(self)) if np.isnan(self.height_m).any() else self.height_m
        return earth_centred_m(self.latitude_deg, self.longitude_deg, height)

    def place_words(self, row: int) -> str:
        """A point in words."""
        return f"{self.latitude_deg[row]:.6f}, {self.longitude_deg[row]:.6f}"

    def take(self, rows: Ints | list[int]) -> LinePiece:
        """Some of the points."""
        return replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS})

    def followed_by(self, other: LinePiece) -> LinePiece:
        """Its points and those of another."""
        both: dict[str, Any] = {name: np.append(getattr(self, name), getattr(other, name)) for name in COLUMNS}
        return replace(self, **both)


Relation = tuple[str, int, str, int, str]
COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "line_km", "sigma_m")


@dataclass
class Survey:
    """What the files hold; places are latitude and longitude: `crossings_deg` where tracks cross without a switch,
    `switches_deg` where the survey names one. `relations`: rows of `Links`, as given; `declared_m`: lengths of net
    elements as declared.
    """

    pieces: list[LinePiece] = field(default_factory=list)
    relations: list[Relation] = field(default_factory=list)
    declared_m: dict[str, float] = field(default_factory=dict)
    crossings_deg: list[tuple[float, float]] = field(default_factory=list)
    switches_deg: list[tuple[float, float]] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, other: Survey) -> None:
        """Take over what another source holds."""
        self.pieces += other.pieces
        self.relations += other.relations
        self.declared_m |= other.declared_m
        self.crossings_deg += other.crossings_deg
        self.switches_deg += other.switches_deg
        self.findings += other.findings

    def report(self, severity: str, place: str, message: str, remedy: str = "") -> None:
        """Note a finding."""
        self.findings.append(Finding(severity, place, message, remedy))  # type: ignore[arg-type]


def piece_of(
    place: str,
    name: str,
    columns: Mapping[str, Iterable[float | None]],
    recorded: bool = False,
    whole: bool = False,
) -> LinePiece:
    """A piece whose positions are places on earth, without points that repeat the one before.

    Raises `SiteError` where a position is none.
    """
    known = {key: np.array(list(values), dtype=np.float64) for key, values in columns.items()}
    count = len(known["latitude_deg"])
    arrays = {key: known.get(key, np.full(count, np.nan)) for key in COLUMNS}
    latitude = arrays["latitude_deg"]
    longitude = arrays["longitude_deg"]
    height = arrays["height_m"]
    unknown = (latitude == 0) & (longitude == 0)
    wrong = ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)) | (height < -1_000) | (height > 10_000) | unknown
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise SiteError(
            f"point {row + 1} of {name} is no place on earth",
            place=place,
            found=f"latitude {latitude[row]:g}, longitude {longitude[row]:g}, height {height[row]:g}",
            expected="degrees of WGS 84, or x and y with their EPSG code",
            remedy="Look whether latitude and longitude are exchanged, or 0, 0 stands for a place that is not known.",
        )
    moved = np.append(True, (np.diff(latitude) != 0) | (np.diff(longitude) != 0)) if count else np.zeros(0, bool)
    return LinePiece(name, **arrays, recorded=recorded, whole=whole).take(np.flatnonzero(moved))


def with_own_names(pieces: list[LinePiece]) -> list[LinePiece]:
    """Pieces with each name once: the second of a name gets `#2`, in the order of the files."""
    used: set[str] = set()
    named = []
    for piece in pieces:
        name = piece.name
        number = 1
        while name in used:
            number += 1
            name = f"{piece.name}#{number}"
        used.add(name)
        named.append(replace(piece, name=name))
    return named


def kilometre_spans(line_km: Floats, distance_m: Floats, config: SurveyConfig) -> tuple[Ints, Floats, np.ndarray]:
    """Points with a kilometre; how far [m] the kilometres stray from the distance to the next of them; where they
    jump.
    """
    known = np.flatnonzero(np.isfinite(line_km))
    by_km = np.diff(line_km[known]) * 1000.0
    by_distance = np.diff(distance_m[known])
    sign = 1.0 if by_km.sum() >= 0 else -1.0
    off_m = np.abs(sign * by_km - by_distance)
    return known, off_m, off_m > np.maximum(config.kilometre_m, config.kilometre_share * by_distance)


def measures_at(line_km: Floats, measure_m: Floats, km: float, config: SurveyConfig) -> list[float]:
    """All measures at which an element has a line kilometre; a kilometre within a jump is nowhere."""
    known, _, jumps = kilometre_spans(line_km, measure_m, config)
    measures = []
    for low, high in zip(known[:-1][~jumps].tolist(), known[1:][~jumps].tolist(), strict=True):
        a = line_km[low]
        b = line_km[high]
        if min(a, b) <= km <= max(a, b) and a != b:
            measures.append(float(measure_m[low] + (km - a) / (b - a) * (measure_m[high] - measure_m[low])))
    # A kilometre at a point ends one span and begins the next.
    return [measure for row, measure in enumerate(measures) if row == 0 or measure - measures[row - 1] > 1e-6]
