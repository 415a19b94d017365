"""A known fault added to a recorded run, so that detection is measured on real noise."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from datasets.faults import (
    NS_PER_S,
    FaultKind,
    FaultSpec,
    fault_offset_m,
    faults_table,
    is_active,
    odometer_increments,
    odometer_speeds,
)
from datasets.inject_ranges import inject_ranges
from datasets.line import RailPlaces, shift_places
from datasets.run_path import DrivenPath, displacement_m, driven_path
from datasets.trial import write_run_as
from pipeline.read.ingest import read_run
from schemas.arrays import Floats
from schemas.config import Configuration, Settings, read_toml, settings_from
from schemas.errors import ConfigError, InputError, UsageError
from schemas.run import RunLog, Site

_PLACE = ("latitude_deg", "longitude_deg", "height_m")
_LATE = (*_PLACE, "vel_e_mps", "vel_n_mps", "vel_u_mps")
# Positions further apart, in seconds and in periods of the log, are not joined by a straight line when a late position
# is read between them.
_JOINED = 1.5


class FaultFile(Settings):
    """A fault file: `[[faults]]` tables."""

    faults: tuple[FaultSpec, ...]


def load_faults(path: Path) -> tuple[FaultSpec, ...]:
    """The faults of a TOML file; breaches of its contract are one `ConfigError`."""
    found = settings_from(read_toml(path), FaultFile, str(path), "docs/scenarios.md lists every key.").faults
    if not found:
        raise ConfigError("holds no fault", place=str(path), expected="[[faults]] tables")
    return tuple(_with_profile_path(fault, path.parent) for fault in found)


def _with_profile_path(fault: FaultSpec, folder: Path) -> FaultSpec:
    """A profile is named relative to its fault file."""
    return fault if fault.profile is None else fault.model_copy(update={"profile": str(folder / fault.profile)})


def inject_into(address: str, config: Configuration, faults: Sequence[FaultSpec], site: Site | None, out: Path) -> None:
    """Write a recorded run with faults to another place. Raises `UsageError` where that is the recording itself."""
    if out.resolve() == Path(address).resolve():
        raise UsageError("is the recording itself", place=str(out), remedy="Name another place with --out.")
    run = read_run(address, config.ingest, with_digest=False)
    write_run_as(inject_all(run, faults, site), out)


def inject_all(run: RunLog, faults: Iterable[FaultSpec], site: Site | None = None) -> RunLog:
    """Add faults one after the other."""
    for fault in faults:
        run = inject(run, fault, site)
    return run


class Recording:
    """What a fault needs to know of the whole recorded run, also where it is added to a part of it."""

    def __init__(self, run: RunLog, site: Site | None = None) -> None:
        self._run = run
        self._site = site
        self._paths: dict[str, DrivenPath] = {}
        self.first_ns, self.last_ns = _span_ns(run)

    def path_of(self, solution: str) -> DrivenPath:
        """The path of this solution, found once."""
        if solution not in self._paths:
            self._paths[solution] = driven_path(self._run, solution, self._site)
        return self._paths[solution]


def inject(run: RunLog, fault: FaultSpec, site: Site | None = None, whole: Recording | None = None) -> RunLog:
    """The run with the fault added, and a `faults` stream that says so; `whole`: the recording that `run` is part of.

    Times count from the run's first GNSS epoch. Position faults keep the recorded noise: they are added to it.
    Along and across the track follow the site where one is given, else the run's own path. Range faults need
    the `satellites` stream. Recorded velocities stay as they are. Random noise depends on run and fault alone.
    """
    whole = whole or Recording(run, site)
    first_ns = whole.first_ns
    last_ns = whole.last_ns
    if fault.begins_s() * NS_PER_S > last_ns - first_ns:
        raise ConfigError(
            "begins after the end of the run", place=f"fault {fault.kind.value}", found=f"{fault.start_s} s"
        )
    if fault.solution is not None and fault.solution not in run.solutions():
        known = ", ".join(run.solutions())
        place = f"fault {fault.kind.value}"
        raise ConfigError("names a solution that the run does not have", place=place, expected=known)
    rng = np.random.default_rng(zlib.crc32(json.dumps([run.run_id, fault.model_dump(mode="json")]).encode()))
    if fault.hits_odometer:
        changed = run.with_streams(odometer=_odometer_with_fault(run, fault, first_ns))
    elif fault.hits_ranges:
        changed = inject_ranges(run, fault, first_ns, rng)
    else:
        changed = run.with_streams(gnss=_positions_with_fault(run, fault, whole, rng))
    faults = faults_table([fault], first_ns, last_ns)
    if run.faults is not None:
        faults = pl.concat([run.faults, faults]).sort("t_start", maintain_order=True)
    return changed.with_streams(faults=faults)


def _span_ns(run: RunLog) -> tuple[int, int]:
    """First and last time of a run [ns]."""
    if run.gnss.is_empty():
        raise InputError("holds no epoch", place=f"{run.run_id}: gnss")
    t_ns = run.gnss["t"].to_physical()
    return int(t_ns.min()), int(t_ns.max())  # type: ignore[arg-type]


def _seconds_since(frame: pl.DataFrame, first_ns: int) -> Floats:
    """Times of a stream since an instant [s]."""
    seconds: Floats = (frame["t"].to_physical().to_numpy() - first_ns) / NS_PER_S
    return seconds


def _positions_with_fault(run: RunLog, fault: FaultSpec, whole: Recording, rng: np.random.Generator) -> pl.DataFrame:
    """Positions of a run with a fault."""
    parts = []
    for solution in run.gnss["solution"].unique(maintain_order=True):
        part = run.gnss.with_row_index("row").filter(pl.col("solution") == solution)
        if fault.solution in (None, solution):
            part = _solution_with_fault(fault, part, solution, whole, rng)
        parts.append(part)
    return pl.concat(parts).sort("row").drop("row")


def _solution_with_fault(
    fault: FaultSpec, part: pl.DataFrame, solution: str, whole: Recording, rng: np.random.Generator
) -> pl.DataFrame:
    """Positions of one solution with a fault."""
    t_s = _seconds_since(part, whole.first_ns)
    if fault.kind is FaultKind.OUTAGE:
        return part.filter(pl.Series(~is_active(fault, t_s)))
    if fault.kind is FaultKind.LATENCY:
        return _delay_positions(part, fault, t_s)
    size = fault_offset_m(fault, t_s, rng)
    return _move_positions(part, _displacements_m(fault.target, solution, part, size, whole))


def _displacements_m(axis: str, solution: str, part: pl.DataFrame, size_m: Floats, whole: Recording) -> Floats:
    """Displacement east, north, up of each epoch [m]."""
    zeros = np.zeros(size_m.size)
    if axis in ("along", "cross"):
        t_ns = part["t"].to_physical().to_numpy()
        ahead, left = (size_m, zeros) if axis == "along" else (zeros, size_m)
        return displacement_m(whole.path_of(solution), t_ns, ahead, left)
    return np.column_stack([size_m if axis == name else zeros for name in ("east", "north", "up")])


def _move_positions(part: pl.DataFrame, vectors_m: Floats) -> pl.DataFrame:
    """Positions moved; a height that is not known stays so."""
    latitude, longitude, height = (part[name].to_numpy().astype(np.float64) for name in _PLACE)
    nothing = np.zeros(0)
    places = shift_places(RailPlaces(latitude, longitude, np.nan_to_num(height), nothing, nothing), *vectors_m.T)
    moved = (places.latitude_deg, places.longitude_deg, height + vectors_m[:, 2])
    return part.with_columns(
        pl.Series(name, values, nan_to_null=True) for name, values in zip(_PLACE, moved, strict=True)
    )


def _delay_positions(part: pl.DataFrame, fault: FaultSpec, t_s: Floats) -> pl.DataFrame:
    """Positions and velocities of `latency_s` ago under the stamps of now; where none is recorded the epoch is lost."""
    now = is_active(fault, t_s)
    known = part.filter(pl.col("latitude_deg").is_not_null()).sort("t", maintain_order=True)
    known_s = t_s[np.isin(part["row"].to_numpy(), known["row"].to_numpy())]
    known_s = np.sort(known_s, kind="stable")
    wanted = t_s - (fault.latency_s or 0.0)
    right = np.searchsorted(known_s, wanted, side="left").clip(1, max(known_s.size - 1, 1))
    joined_s = _JOINED * max(1.0, float(np.median(np.diff(known_s)))) if known_s.size > 1 else _JOINED
    lost = now & ((wanted < known_s[0]) | (known_s[right] - known_s[right - 1] > joined_s))
    columns = {
        name: np.where(
            now, np.interp(wanted, known_s, known[name].to_numpy().astype(np.float64)), part[name].to_numpy()
        )
        for name in _LATE
    }
    series = [pl.Series(name, values, nan_to_null=True) for name, values in columns.items()]
    return part.with_columns(series).filter(pl.Series(~lost))


def _odometer_with_fault(run: RunLog, fault: FaultSpec, first_ns: int) -> pl.DataFrame:
    """The odometer with the fault in each of its sensors; raises `InputError` without one."""
    if run.odometer is None:
        raise InputError("has no odometer for this fault", place=run.run_id, expected="an odometer stream")
    sensors = run.odometer.sort("t", maintain_order=True).partition_by("sensor", maintain_order=True)
    return pl.concat([_sensor_with_fault(sensor, fault, first_ns) for sensor in sensors])


def _sensor_with_fault(odometer: pl.DataFrame, fault: FaultSpec, first_ns: int) -> pl.DataFrame:
    """One sensor of the odometer with a fault."""
    t_s = _seconds_since(odometer, first_ns)
    if fault.kind is FaultKind.OUTAGE:
        return odometer.filter(pl.Series(~is_active(fault, t_s)))
    distance = odometer["distance_m"].to_numpy().copy()
    speed = odometer["speed_mps"].to_numpy().copy()
    rows = np.flatnonzero(np.isfinite(distance))
    if rows.size:
        steps = np.diff(distance[rows], prepend=distance[rows[0]])
        distance[rows] = distance[rows[0]] + np.cumsum(odometer_increments([fault], t_s[rows], steps))
    speed = odometer_speeds([fault], t_s, speed)
    return odometer.with_columns(
        distance_m=pl.Series(distance, nan_to_null=True), speed_mps=pl.Series(speed, nan_to_null=True)
    )
