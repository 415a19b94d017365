"""Segments of comma2k19 (a car with wheel sensors) as runs and sites.

The recordings stay where the caller has them; nothing of them is part of this project.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
import pyproj

from datasets.to_contract import conform_stream, table_of_contract, virtual_balises
from pipeline.read.ingest.timescale import GPS_EPOCH_NS, utc_from_gps
from pipeline.stages.track.geodesy import point_distances_m, points_of
from schemas.arrays import NS_PER_S, Floats
from schemas.enums import Fix, Origin
from schemas.errors import InputError
from schemas.inputs import Links, Track
from schemas.run import RunLog, Site

_WEEK_S = 604_800
# Distance between track points taken from poses, and the accuracy that the pose is credited with.
_TRACK_STEP_M = 5.0
_POSE_SIGMA_M = 0.5
_ELEMENT = "road"
_FEWEST_POSES = 2


def comma2k19_run(segment: Path, balises_at_m: Sequence[float] = ()) -> tuple[RunLog, Site]:
    """A segment of comma2k19: u-blox fixes, the mean of four wheel speeds, and the pose as reference and as track.

    Stamps are the device's clock for all streams (so the latency of the fixes shows), moved to UTC by the one
    offset that the pose gives. The pose was fused with the same satellites: a track, no independent truth.
    NaN is not known; a segment without wheel speeds has no odometer.
    Virtual balises may be put at measures along the track.
    """
    pose_s, places = _known_poses(segment)
    offset_s = _utc_offset_s(segment)
    gnss = _gnss_table(segment, offset_s)
    reference = pl.DataFrame({"t": _stamps(pose_s + offset_s), **places}).with_columns(sigma_m=_POSE_SIGMA_M)
    name = segment.resolve().name
    site = _site_of_poses(places, balises_at_m)
    run = RunLog(
        name,
        conform_stream(gnss, "gnss", segment),
        odometer=_odometer_table(segment, offset_s),
        reference=conform_stream(reference, "reference", segment),
    )
    return run, site


def _read_log(segment: Path, name: str, columns: int) -> tuple[Floats, Floats]:
    """Times and values of as many columns, without rows of no time."""
    folder = segment / "processed_log" / name
    t_s = _read_array(folder / "t", 1)
    value = _read_array(folder / "value", 2)
    if len(value) != len(t_s) or value.shape[1] < columns:
        raise InputError(
            "is not as comma2k19 has it",
            place=str(folder),
            found=f"t of shape {t_s.shape}, value of shape {value.shape}",
            expected=f"one time per row of {columns} values",
        )
    timed = np.isfinite(t_s)
    return t_s[timed], value[timed]


def _read_array(path: Path, dimensions: int) -> Floats:
    """An array of a segment, of so many dimensions."""
    try:
        values: Floats = np.load(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {error}", place=str(path), expected="a comma2k19 segment") from None
    if values.ndim != dimensions or values.dtype.kind not in "iuf":
        found = f"{values.dtype} of shape {values.shape}"
        expected = f"numbers in {dimensions} dimensions"
        raise InputError("is not as comma2k19 has it", place=str(path), found=found, expected=expected)
    return values.astype(np.float64, copy=False)


def _known_poses(segment: Path) -> tuple[Floats, dict[str, Floats]]:
    """Times on the device's clock, and positions in WGS 84, of the poses that are known."""
    folder = segment / "global_pose"
    times_s = _read_array(folder / "frame_times", 1)
    places_m = _read_array(folder / "frame_positions", 2)
    if places_m.shape[1] != 3 or len(times_s) != len(places_m):
        found = f"frame_times of shape {times_s.shape}, frame_positions of shape {places_m.shape}"
        raise InputError("is not as comma2k19 has it", place=str(folder), found=found)
    known = np.isfinite(times_s) & np.isfinite(places_m).all(axis=1)
    if known.sum() < _FEWEST_POSES:
        raise InputError("holds no poses", place=str(folder), expected="the track that was driven")
    to_wgs84 = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    x_m, y_m, z_m = places_m[known].T
    longitude, latitude, height = to_wgs84.transform(x_m, y_m, z_m)
    return times_s[known], {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}


def _utc_offset_s(segment: Path) -> float:
    """What is added to the device's clock: both are known for the first frame that has a GPS time."""
    folder = segment / "global_pose"
    gps = _read_array(folder / "frame_gps_times", 2)
    boot_s = _read_array(folder / "frame_times", 1)
    if gps.shape[1] != 2:  # week and second
        found = f"shape {gps.shape}"
        raise InputError("is not as comma2k19 has it", place=str(folder / "frame_gps_times"), found=found)
    count = min(len(gps), len(boot_s))
    known = np.flatnonzero(np.isfinite(gps[:count]).all(axis=-1) & np.isfinite(boot_s[:count]))
    if not len(known):
        raise InputError("holds no GPS time", place=str(folder / "frame_gps_times"), expected="week and second")
    week, second = gps[known[0]]
    gps_s = GPS_EPOCH_NS / NS_PER_S + week * _WEEK_S + second
    gps_ns = np.array([round(gps_s * NS_PER_S)])
    ahead_of_utc_s = int((gps_ns - utc_from_gps(gps_ns))[0]) / NS_PER_S
    return float(gps_s - ahead_of_utc_s) - float(boot_s[known[0]])


def _stamps(seconds: Floats) -> pl.Series:
    """Unix seconds as instants, to the microsecond (all that a double holds)."""
    return pl.Series(np.round(seconds * 1e6).astype(np.int64) * 1000).cast(pl.Datetime("ns", "UTC"))


def _gnss_table(segment: Path, offset_s: float) -> pl.DataFrame:
    """The stream `gnss`; rows of `value` are latitude, longitude, speed, UTC, altitude, bearing."""
    t_s, value = _read_log(segment, "GNSS/live_gnss_ublox", columns=6)
    bearing = np.radians(value[:, 5])
    known = np.isfinite(value[:, :2]).all(axis=1)
    return pl.DataFrame(
        {
            "t": _stamps(t_s + offset_s),
            "latitude_deg": value[:, 0],
            "longitude_deg": value[:, 1],
            "height_m": value[:, 4],
            "vel_e_mps": value[:, 2] * np.sin(bearing),
            "vel_n_mps": value[:, 2] * np.cos(bearing),
            "fix": np.where(known, Fix.AUTONOMOUS.value, Fix.NONE.value),
        }
    )


def _odometer_table(segment: Path, offset_s: float) -> pl.DataFrame | None:
    """The mean of the wheels that are known; none where there are no wheel speeds."""
    if not (segment / "processed_log" / "CAN" / "wheel_speed").is_dir():
        return None
    t_s, wheels_mps = _read_log(segment, "CAN/wheel_speed", columns=1)
    known = np.isfinite(wheels_mps).any(axis=1)
    if not known.any():
        return None
    speed = np.nanmean(wheels_mps[known], axis=1)
    frame = pl.DataFrame({"t": _stamps(t_s[known] + offset_s), "speed_mps": speed}).with_columns(
        origin=pl.lit(Origin.WHEEL.value, pl.Enum(Origin))
    )
    return conform_stream(frame, "odometer", segment)


def _site_of_poses(places: dict[str, Floats], balises_at_m: Sequence[float]) -> Site:
    """Poses at least 5 m apart, joined to one net element."""
    kept = _poses_apart(places)
    track = {name: values[kept] for name, values in places.items()}
    measure = np.concatenate(
        ([0.0], np.cumsum(point_distances_m(track["latitude_deg"], track["longitude_deg"], track["height_m"])))
    )
    table = table_of_contract(Track, netelement_id=_ELEMENT, measure_m=measure, **track, sigma_m=_POSE_SIGMA_M)
    balises = [(_ELEMENT, at_m) for at_m in balises_at_m]
    return Site(table, Links.create_empty(), virtual_balises(balises) if balises else None)


def _poses_apart(places: dict[str, Floats]) -> list[int]:
    """Poses a step from the one kept before: one that wanders at standstill adds nothing."""
    surface = points_of(places["latitude_deg"], places["longitude_deg"]).surface
    kept = [0]
    for row in range(1, len(surface)):
        if np.linalg.norm(surface[row] - surface[kept[-1]]) >= _TRACK_STEP_M:
            kept.append(row)
    return kept if len(kept) > 1 else [0, len(surface) - 1]
