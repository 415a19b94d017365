"""A profile: published requirements as a versioned file, so that newer requirements are data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from schemas.arrays import Floats
from schemas.config import NonNegative, Positive, Probability, Settings, read_toml, settings_from
from schemas.enums import AreaType
from schemas.errors import ConfigError
from schemas.near import did_you_mean

_FOLDER = Path(__file__).parent / "profiles"
KMH_PER_MPS = 3.6


class Method(Settings):
    """How events, speeds and trials are counted; no requirement."""

    event_gap_s: Positive
    speed_window_s: Positive
    area_reach_m: Positive
    independent: Literal["run", "day"] = "run"


class AreaLimits(Settings):
    """MAPO and MAPU each, and the accuracy of the estimated front end, in one type of area."""

    limit_m: Positive
    way_s: NonNegative
    limit_clause: str
    accuracy_m: Positive
    accuracy_share: Probability
    accuracy_clause: str

    def limits_m(self, track_speed_mps: Floats) -> Floats:
        """The limit at each track speed [m]; where that is not known (NaN) the smaller one."""
        return np.maximum(self.limit_m, np.nan_to_num(self.way_s * track_speed_mps, nan=0.0))


class SlowLimits(Settings):
    """Safe and precise operation below a speed."""

    below_kmh: Positive
    area_types: tuple[AreaType, ...]
    limit_m: Positive
    accuracy_m: Positive
    accuracy_share: Probability
    clause: str


class AfterBalise(Settings):
    """Accuracy of the estimate right after a balise."""

    below_kmh: Positive
    fixed_m: Positive
    offset_m: NonNegative
    per_mps_s: NonNegative
    to_kmh: Positive
    share: Probability
    clause: str

    def limit_m(self, speed_mps: Floats) -> Floats:
        """The limit [m] at a speed [m/s]; NaN above `to_kmh`, where nothing is demanded."""
        kmh = np.abs(speed_mps) * KMH_PER_MPS
        limit = np.where(kmh < self.below_kmh, self.fixed_m, self.offset_m + self.per_mps_s * np.abs(speed_mps))
        return np.where(kmh <= self.to_kmh, limit, np.nan)


class SafeSpeed(Settings):
    """MASO and MASU each."""

    low_kmh: Positive
    below_kmh: Positive
    high_kmh: Positive
    at_kmh: Positive
    clause: str

    def limit_kmh(self, speed_kmh: Floats) -> Floats:
        """The limit [km/h] at a speed [km/h]; NaN above `at_kmh`, where nothing is demanded."""
        speed = np.abs(speed_kmh)
        limit = np.interp(speed, [self.below_kmh, self.at_kmh], [self.low_kmh, self.high_kmh])
        return np.where(speed <= self.at_kmh, limit, np.nan)


class EstimatedSpeed(Settings):
    """Accuracy of the estimated speed."""

    fixed_kmh: Positive
    to_kmh: Positive
    above_share: Positive
    share: Probability
    clause: str

    def limit_kmh(self, speed_kmh: Floats) -> Floats:
        """The limit [km/h] at a speed [km/h]."""
        speed = np.abs(speed_kmh)
        return np.where(speed <= self.to_kmh, self.fixed_kmh, self.above_share * speed)


class Start(Settings):
    """Times from start of mission to the first output."""

    last_position_s: Positive
    cold_movement_s: Positive
    nothing_s: Positive
    clause: str


class ColdMovement(Settings):
    """Movement while switched off."""

    detected_h: Positive
    clause: str


class Availability(Settings):
    """Share of time with an output, and how long it may be missing."""

    share: Probability
    outside_s: Positive
    within_s: Positive
    clause: str


class DistanceLimits(Settings):
    """Distances that have to be covered without physical balises."""

    without_balise_m: Positive
    clause: str


class FailureRate(Settings):
    """A rate of failures per hour."""

    aim_per_h: Positive
    bound_per_h: Positive
    clause: str


class RequirementProfile(Settings):
    """All requirements; `sources` are the documents that the figures are quoted from."""

    name: str
    version: str
    sources: Annotated[tuple[str, ...], Field(min_length=1)]
    method: Method
    areas: dict[AreaType, AreaLimits]
    slow: SlowLimits
    after_balise: AfterBalise
    safe_speed: SafeSpeed
    speed: EstimatedSpeed
    start: Start
    cold_movement: ColdMovement
    availability: Availability
    way: DistanceLimits
    failure_rate: FailureRate


def known_profiles() -> list[str]:
    """Names of the profiles that come with the program."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def load_profile(name: str) -> RequirementProfile:
    """Load a profile of requirements.

    Args:
        name: name of a profile of the package, or path of a TOML file.

    Returns:
        The requirements.

    Raises:
        ConfigError: it is neither, or breaches the model.
    """
    file = _FOLDER / f"{name}.toml" if name in known_profiles() else Path(name)
    if not file.is_file():
        known = known_profiles()
        raise ConfigError(
            f"is no profile{did_you_mean(name, known)}", place=name, expected=f"{', '.join(known)}, or a TOML file"
        )
    return settings_from(read_toml(file), RequirementProfile, str(file), "`lu-2023.toml` of the package has every key.")
