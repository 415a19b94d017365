"""The faults that can be injected, and what each does to positions and odometer.

Sizes are signed: an along-track fault is positive ahead of the train, a cross-track fault to its left.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Self

import numpy as np
import polars as pl
from pydantic import Field, model_validator

from schemas.arrays import Bools, Floats
from schemas.config import NonNegative, Number, Positive, Settings
from schemas.errors import ConfigError
from schemas.frozen import frozen
from schemas.inputs import Faults

NS_PER_S = 1_000_000_000


class FaultKind(StrEnum):
    """Kinds of faults that can be injected."""

    STEP = "step"
    BIAS = "bias"
    RAMP = "ramp"
    NOISE = "noise"
    PROFILE = "profile"
    OUTAGE = "outage"
    LATENCY = "latency"
    SLIP = "slip"
    SLIDE = "slide"
    SCALE = "scale"


_NEEDS = {
    FaultKind.STEP: "size_m",
    FaultKind.BIAS: "size_m",
    FaultKind.RAMP: "rate_mps",
    FaultKind.NOISE: "sigma_m",
    FaultKind.PROFILE: "profile",
    FaultKind.OUTAGE: None,
    FaultKind.LATENCY: "latency_s",
    FaultKind.SLIP: "rate_mps",
    FaultKind.SLIDE: "rate_mps",
    FaultKind.SCALE: "scale",
}
# Beyond this no fault of a train is meant, and positions are numbers no more [m, s, m/s].
_LARGEST = 1e7
_Amount = Annotated[Positive, Field(le=_LARGEST)]
_Signed = Annotated[Number, Field(ge=-_LARGEST, le=_LARGEST)]
_QUANTITIES = ("size_m", "rate_mps", "sigma_m", "latency_s", "scale", "profile")
_ON_ODOMETER = (FaultKind.SLIP, FaultKind.SLIDE, FaultKind.SCALE)
_GROUPS = ("satellites", "gps", "galileo")
_TARGET = r"^(along|cross|up|east|north|position|odometer|satellites|gps|galileo|[A-Z][0-9]{2})$"


class FaultSpec(Settings):
    """One fault, from `start_s` after the first epoch of the run on; without `duration_s` to the end of the run.

    `target`: `along`, `cross`, `up`, `east`, `north` displace the position (of ranges too, all in accord, as a
    spoofer does), `position` serves outage and latency, `odometer` slip, slide, scale and outage; a satellite
    (`G08`), a constellation (`gps`, `galileo`) or all `satellites` are hit in their ranges, those of groups only
    below `below_deg` of elevation and between two azimuths, clockwise, where these are given.
    A ramp grows by `rate_mps` for its duration and then stays, unless it `returns`. A profile is a CSV file with
    `t_s` (seconds after the first epoch, growing) and `size_m`: zero before its first row, a straight line from row to
    row, and its last size from there on.
    Slip adds `rate_mps` to the odometer's speed, slide takes it off (wheels never turn backwards);
    `scale` multiplies the odometer's increments. `solution` limits the fault to one solution.
    """

    kind: FaultKind
    target: Annotated[str, Field(pattern=_TARGET)] = ""
    start_s: NonNegative | None = None
    duration_s: _Amount | None = None
    size_m: _Signed | None = None
    rate_mps: _Signed | None = None
    sigma_m: _Amount | None = None
    latency_s: _Amount | None = None
    scale: _Amount | None = None
    profile: str | None = None
    returns: bool = False
    solution: str | None = None
    below_deg: Annotated[float, Field(gt=0, le=90)] | None = None
    azimuth_deg: tuple[float, float] | None = None

    @model_validator(mode="before")
    @classmethod
    def _usual_target(cls, data: object) -> object:
        """A fault without target has the usual one of its kind."""
        if isinstance(data, dict) and "target" not in data:
            return {**data, "target": _usual_target_of(str(data.get("kind")))}
        return data

    @model_validator(mode="after")
    def _says_how_much(self) -> Self:
        """A fault has the one quantity that its kind needs."""
        needed = _NEEDS[self.kind]
        given = [name for name in _QUANTITIES if getattr(self, name) is not None]
        if given != ([needed] if needed else []):
            found = ", ".join(given) or "none"
            raise ValueError(f"a fault of kind {self.kind.value} needs {needed or 'no quantity'}; found {found}")
        allowed = _allowed_targets(self.kind)
        if self.target not in allowed and not (self.hits_ranges and "satellite" in allowed):
            raise ValueError(f"a fault of kind {self.kind.value} needs target {' or '.join(allowed)}")
        if (self.below_deg is not None or self.azimuth_deg is not None) and self.target not in _GROUPS:
            raise ValueError(f"below_deg and azimuth_deg are only for target {' or '.join(_GROUPS)}")
        return self

    @property
    def hits_ranges(self) -> bool:
        """It is a fault of ranges: of a satellite, or of a group of them."""
        return self.target in _GROUPS or self.target[:1].isupper()

    @property
    def hits_odometer(self) -> bool:
        """It is a fault of the odometer."""
        return self.target == "odometer"

    def begins_s(self) -> float:
        """When it begins [s]."""
        return self.start_s or 0.0


class PlacedFault(FaultSpec):
    """A fault of a scenario: it may begin where the train first reaches chainage `at_m`, and end at `until_m`."""

    at_m: NonNegative | None = None
    until_m: NonNegative | None = None

    @model_validator(mode="after")
    def _begins_and_ends_once(self) -> Self:
        """A fault has one begin, and at most one end."""
        if (self.at_m is None) == (self.start_s is None):
            raise ValueError("a fault needs either start_s or at_m")
        if self.until_m is not None and self.duration_s is not None:
            raise ValueError("a fault may have duration_s or until_m, not both")
        return self


@frozen
class PositionEffect:
    """What faults do to the positions of one solution, per epoch."""

    along_m: Floats
    cross_m: Floats
    up_m: Floats
    east_m: Floats
    north_m: Floats
    latency_s: Floats
    lost: Bools


def position_effect(faults: Sequence[FaultSpec], t_s: Floats, rng: np.random.Generator) -> PositionEffect:
    """Sum the position faults over epochs `t_s` (seconds after the first epoch)."""
    offsets = {axis: np.zeros(t_s.size) for axis in ("along", "cross", "up", "east", "north")}
    latency = np.zeros(t_s.size)
    lost = np.zeros(t_s.size, dtype=np.bool_)
    for fault in faults:
        if fault.target in offsets:
            offsets[fault.target] += fault_offset_m(fault, t_s, rng)
        elif fault.target == "position" and fault.kind is FaultKind.LATENCY:
            latency += np.where(is_active(fault, t_s), fault.latency_s or 0.0, 0.0)
        elif fault.target == "position":
            lost |= is_active(fault, t_s)
    return PositionEffect(**{f"{axis}_m": value for axis, value in offsets.items()}, latency_s=latency, lost=lost)


def fault_offset_m(fault: FaultSpec, t_s: Floats, rng: np.random.Generator) -> Floats:
    """A step, bias, ramp or noise burst over time [m]."""
    now = is_active(fault, t_s)
    if fault.kind is FaultKind.RAMP:
        limit = np.inf if fault.duration_s is None else fault.duration_s
        grown = (fault.rate_mps or 0.0) * np.clip(t_s - fault.begins_s(), 0.0, limit)
        return np.where(now, grown, 0.0) if fault.returns else grown
    if fault.kind is FaultKind.PROFILE:
        at_s, size = read_profile(fault.profile or "")
        return np.interp(t_s, at_s, size, left=0.0)
    if fault.kind is FaultKind.NOISE:
        return np.where(now, (fault.sigma_m or 0.0) * rng.standard_normal(t_s.size), 0.0)
    return np.where(now, fault.size_m or 0.0, 0.0)


def read_profile(path: str) -> tuple[Floats, Floats]:
    """Times [s] and sizes [m] of a profile; raises `ConfigError` where the file is none."""
    expected = "CSV with columns t_s (growing) and size_m, numbers up to 1e7 in each row"
    try:
        table = pl.read_csv(path, columns=["t_s", "size_m"], schema_overrides={"t_s": pl.Float64, "size_m": pl.Float64})
    except (OSError, pl.exceptions.PolarsError) as error:
        raise ConfigError(
            "cannot be read as a profile", place=path, found=str(error).partition("\n")[0], expected=expected
        ) from None
    values = table.to_numpy()
    if not values.size or not (np.abs(values) <= _LARGEST).all() or (np.diff(values[:, 0]) <= 0.0).any():
        raise ConfigError("is no profile", place=path, expected=expected)
    return values[:, 0], values[:, 1]


def is_active(fault: FaultSpec, t_s: Floats) -> Bools:
    """Whether a fault is active, from its start on, its end excluded."""
    t_ns = np.round(t_s * NS_PER_S)
    begin_ns = round(fault.begins_s() * NS_PER_S)
    end_ns = np.inf if fault.duration_s is None else begin_ns + round(fault.duration_s * NS_PER_S)
    now: Bools = (t_ns >= begin_ns) & (t_ns < end_ns)
    return now


def odometer_increments(faults: Sequence[FaultSpec], t_s: Floats, increments_m: Floats) -> Floats:
    """Odometer increments under slip, slide and scale faults; increment k ends at `t_s[k]`.

    An increment changes with the share of its time that lies within the fault.
    """
    begins_s = np.concatenate([t_s[:1], t_s[:-1]])
    step_s = t_s - begins_s
    result = increments_m.copy()
    for fault in faults:
        if not fault.hits_odometer or fault.kind not in _ON_ODOMETER:
            continue
        end_s = np.inf if fault.duration_s is None else fault.begins_s() + fault.duration_s
        within_s = np.maximum(np.minimum(t_s, end_s) - np.maximum(begins_s, fault.begins_s()), 0.0)
        share = np.divide(within_s, step_s, out=np.zeros_like(step_s), where=step_s > 0.0)
        result = result * (1.0 - share) + _faulty_movement(fault, result * share, within_s)
    return result


def odometer_speeds(faults: Sequence[FaultSpec], t_s: Floats, speed_mps: Floats) -> Floats:
    """Odometer speeds under slip, slide and scale faults."""
    result = speed_mps.copy()
    for fault in faults:
        if fault.hits_odometer and fault.kind in _ON_ODOMETER:
            result = np.where(is_active(fault, t_s), _faulty_movement(fault, result, np.ones(t_s.size)), result)
    return result


def _faulty_movement(fault: FaultSpec, moved: Floats, time_s: Floats) -> Floats:
    """What the odometer counts where it should count `moved` within these times."""
    sense = np.where(moved < 0.0, -1.0, 1.0)
    change = (fault.rate_mps or 0.0) * time_s
    if fault.kind is FaultKind.SCALE:
        return moved * (fault.scale or 1.0)
    if fault.kind is FaultKind.SLIP:
        return moved + sense * change
    return sense * np.maximum(np.abs(moved) - change, 0.0)


def faults_table(faults: Sequence[FaultSpec], first_ns: int, last_ns: int) -> pl.DataFrame:
    """The `faults` stream: what was injected, when, how much (`size` in the unit of the kind, `rate` per second).

    A ramp that stays, like a fault without end, lasts to the end of the run.
    """
    rows = []
    for fault in faults:
        begin = first_ns + round(fault.begins_s() * NS_PER_S)
        stays = fault.duration_s is None or (fault.kind is FaultKind.RAMP and not fault.returns)
        end = last_ns if stays else min(begin + round((fault.duration_s or 0.0) * NS_PER_S), last_ns)
        size = _final_size(fault, (last_ns - begin) / NS_PER_S)
        rows.append((begin, end, fault.kind.value, fault.target, size, fault.rate_mps))
    rows.sort(key=lambda row: (row[0], row[3], row[2]))
    table = pl.DataFrame(rows, schema=_FAULTS, orient="row")
    instants = [pl.col(name).cast(pl.Datetime("ns", "UTC")) for name in ("t_start", "t_end")]
    return Faults.validate(table.with_columns(instants), cast=True)


_FAULTS = {
    "t_start": pl.Int64,
    "t_end": pl.Int64,
    "kind": pl.String,
    "target": pl.String,
    "size": pl.Float64,
    "rate": pl.Float64,
}


def _final_size(fault: FaultSpec, to_end_s: float) -> float | None:
    """The quantity of the kind; of a ramp, slip or slide what it has grown to at its end [m]."""
    if fault.rate_mps is not None:
        return fault.rate_mps * (to_end_s if fault.duration_s is None else min(fault.duration_s, to_end_s))
    if fault.kind is FaultKind.PROFILE:
        _, sizes = read_profile(fault.profile or "")
        return float(sizes[np.argmax(np.abs(sizes))])
    needed = _NEEDS[fault.kind]
    value: float | None = getattr(fault, needed) if needed else None
    return value


def _usual_target_of(kind: str) -> str:
    """What a kind of fault usually acts on."""
    if kind in (FaultKind.OUTAGE, FaultKind.LATENCY):
        return "position"
    return "odometer" if kind in _ON_ODOMETER else "along"


def _allowed_targets(kind: FaultKind) -> tuple[str, ...]:
    """What a kind of fault may act on."""
    if kind in _ON_ODOMETER:
        return ("odometer",)
    if kind is FaultKind.OUTAGE:
        return ("position", "odometer", "satellite")
    if kind is FaultKind.LATENCY:
        return ("position",)
    return ("along", "cross", "up", "east", "north", "satellite")


def in_sector(fault: FaultSpec, svs: Sequence[str], azimuth_deg: Floats, elevation_deg: Floats) -> Bools:
    """Which satellites a fault of ranges hits, shape of the angles (epochs, satellites)."""
    names = {"gps": "G", "galileo": "E", "satellites": ""}
    prefix = names.get(fault.target, fault.target)
    hit: Bools = np.broadcast_to([sv.startswith(prefix) for sv in svs], azimuth_deg.shape)
    if fault.below_deg is not None:
        hit = hit & (elevation_deg < fault.below_deg)
    if fault.azimuth_deg is not None:
        begin, end = fault.azimuth_deg
        hit = hit & ((azimuth_deg - begin) % 360.0 <= (end - begin) % 360.0)
    return hit
