"""What a synthetic trial consists of: the scenario file (TOML), every key with its default in this place."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from datasets.expectation import ExpectedRun
from datasets.faults import PlacedFault
from datasets.motion import MotionSpec
from datasets.range_errors import RangeErrorSpec
from schemas.config import (
    NonNegative,
    Positive,
    Settings,
    Vehicle,
    read_toml,
    settings_from,
)
from schemas.enums import BaliseDirection, BaliseKind, Fix, Origin, Reaction

Constellation = Literal["gps", "galileo"]
LogKind = Literal["parquet", "json", "protobuf", "cdr"]
Identity = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]


class SectionSpec(Settings):
    """A piece of constant curve and grade; `radius_m` > 0 turns left, absent is straight; `grade` is rise over run."""

    length_m: Positive
    radius_m: float | None = None
    grade: Annotated[float, Field(gt=-0.2, lt=0.2)] = 0.0

    @field_validator("radius_m")
    @classmethod
    def _require_wide_curve(cls, value: float | None) -> float | None:
        """A curve is no narrower than a main line's."""
        if value is not None and abs(value) < 100.0:
            raise ValueError("a radius under 100 m is too small for a main line")
        return value


class ElementSpec(Settings):
    """A net element; `reversed` elements are surveyed against growing chainage."""

    id: Identity
    length_m: Positive
    reversed: bool = False


class ParallelSpec(Settings):
    """A second track parallel to the line, `left_m` to its left (negative: right), linked to nothing."""

    id: Identity
    from_m: NonNegative
    to_m: Positive
    left_m: float


class BaliseSpec(Settings):
    """A balise at a chainage of the line."""

    id: Identity
    at_m: NonNegative
    kind: BaliseKind = BaliseKind.VIRTUAL
    location_accuracy_m: Annotated[float, Field(ge=0, le=63)] = 12.0
    linked: bool = True
    link_reaction: Reaction = Reaction.SERVICE_BRAKE
    direction: BaliseDirection = BaliseDirection.BOTH


class SurveySpec(Settings):
    """How the track was surveyed: `sigma_m` is what the survey states, noise and bias are its true errors."""

    spacing_m: Positive = 10.0
    sigma_m: NonNegative | None = 0.1
    noise_sigma_m: NonNegative = 0.0
    noise_length_m: Positive = 500.0
    bias_east_m: float = 0.0
    bias_north_m: float = 0.0
    bias_up_m: float = 0.0
    flat: bool = False


class LineSpec(Settings):
    """The line from its start on; `sections` repeat until all `elements` are laid."""

    latitude_deg: Annotated[float, Field(gt=-80, lt=80)] = 50.0
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 14.0
    height_m: float = 250.0
    heading_deg: float = 40.0
    transition_m: Positive = 80.0
    sections: Annotated[tuple[SectionSpec, ...], Field(min_length=1)]
    elements: Annotated[tuple[ElementSpec, ...], Field(min_length=1)]
    parallels: tuple[ParallelSpec, ...] = ()
    balises: tuple[BaliseSpec, ...] = ()
    survey: SurveySpec = SurveySpec()


def _gps_alone() -> Mapping[str, tuple[Constellation, ...]]:
    """One solution of GPS alone."""
    return {"primary": ("gps",)}


class SkySpec(Settings):
    """A receiver whose errors come from satellite geometry: each solution uses the constellations it names."""

    solutions: Annotated[Mapping[Identity, tuple[Constellation, ...]], Field(min_length=1)] = Field(
        default_factory=_gps_alone
    )
    mask_deg: Annotated[float, Field(ge=0, lt=90)] = 5.0
    ranges: RangeErrorSpec = RangeErrorSpec()
    protection: Literal["pa", "npa"] = "npa"
    record_ranges: bool = True


class GnssSpec(Settings):
    """A receiver with Gauss-Markov position errors (DIAG Table 1) of the given standard deviations.

    With `sky` they come from satellite geometry, and the sigmas and `satellites` here do not count.
    `reported_factor` is the receiver's stated sigma over the true one. `keep_lost` keeps epochs without
    position as rows of fix `none`, otherwise they have no row.
    """

    rate_hz: Positive = 10.0
    sigma_east_m: Positive = 1.0
    sigma_north_m: Positive = 1.0
    sigma_up_m: Positive = 1.5
    bias_east_m: float = 0.0
    bias_north_m: float = 0.0
    bias_up_m: float = 0.0
    fix: Fix = Fix.SBAS
    satellites: Annotated[int, Field(ge=0)] | None = 11
    latency_s: NonNegative = 0.0
    covariance: bool = True
    reported_factor: Positive = 1.0
    velocity: bool = True
    velocity_sigma_mps: NonNegative = 0.03
    protection_levels: bool = True
    keep_lost: bool = False
    sky: SkySpec | None = None


class OdometerSpec(Settings):
    """Wheel sensor: white noise on increments of 0.05 m per root second (DIAG Table 1), none at standstill.

    `scale` is true distance over odometer distance; `polarity` -1 counts down when running ahead; `origin`: what the
    stream declares.
    """

    rate_hz: Annotated[float, Field(ge=1, le=200)] = 50.0
    noise_m_per_root_s: NonNegative = 0.05
    scale: Positive = 1.0
    polarity: Literal[-1, 1] = 1
    speed: bool = True
    distance: bool = True
    speed_sigma_mps: NonNegative = 0.02
    origin: Origin = Origin.WHEEL


class ReferenceSpec(Settings):
    """The true position of the GNSS antenna, with the small noise of a reference instrument."""

    rate_hz: Positive = 10.0
    sigma_m: NonNegative = 0.02


class RunSpec(Settings):
    """One journey. `false` for odometer or reference leaves the stream out; `vehicle` gives the replay the file."""

    id: Identity
    title: str = ""
    log: LogKind = "parquet"
    vehicle: bool = True
    motion: MotionSpec
    gnss: GnssSpec = GnssSpec()
    odometer: OdometerSpec | Literal[False] = OdometerSpec()
    reference: ReferenceSpec | Literal[False] = ReferenceSpec()
    faults: tuple[PlacedFault, ...] = ()
    expected: ExpectedRun | None = None


class Scenario(Settings):
    """A whole trial. `gnss`, `odometer` and `reference` hold for every run that does not say otherwise."""

    name: Identity
    title: str = ""
    seed: Annotated[int, Field(ge=0)]
    start: datetime = datetime(2025, 3, 3, 6, 0, 0, tzinfo=UTC)
    line: LineSpec
    vehicle: Vehicle | None = None
    runs: Annotated[tuple[RunSpec, ...], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _apply_common(cls, data: object) -> object:
        """Runs with what is common to all."""
        if not isinstance(data, Mapping) or not isinstance(data.get("runs"), list):
            return data
        common = {name: data[name] for name in _COMMON if name in data}
        rest = {key: value for key, value in data.items() if key not in _COMMON}
        return {**rest, "runs": [_with_defaults(run, common) for run in data["runs"]]}

    @model_validator(mode="after")
    def _require_unique_names(self) -> Self:
        """Names occur once, and the start has a time zone."""
        _require_unique("runs", [run.id for run in self.runs])
        _require_unique("line.balises", [balise.id for balise in self.line.balises])
        tracks = [element.id for element in self.line.elements] + [p.id for p in self.line.parallels]
        _require_unique("line.elements", tracks)
        if self.start.tzinfo is None:
            raise ValueError("start needs a time zone, for example 2025-03-03T06:00:00Z")
        return self


def load_scenario(path: Path) -> Scenario:
    """A scenario file; breaches of its contract are one `ConfigError`."""
    return settings_from(read_toml(path), Scenario, str(path), "docs/scenarios.md lists every key.")


def with_seed(scenario: Scenario, seed: int) -> Scenario:
    """The same trial with other random numbers."""
    return scenario.model_copy(update={"seed": seed})


_COMMON = ("gnss", "odometer", "reference")


def _with_defaults(run: object, common: Mapping[str, object]) -> object:
    """A run with what is common to all."""
    if not isinstance(run, Mapping):
        return run
    merged = dict(run)
    for name, defaults in common.items():
        own = run.get(name, {})
        if isinstance(own, Mapping) and isinstance(defaults, Mapping):
            merged[name] = {**defaults, **own}
        elif name not in run:
            merged[name] = defaults
    return merged


def _require_unique(place: str, names: list[str]) -> None:
    """Refuse names that occur twice."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{place}: names repeated: {', '.join(repeated)}")
