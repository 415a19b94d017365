"""Public recordings as runs and sites: comma2k19 (a car with wheel sensors) and Infrabel (measurement trains).

The recordings stay where the caller has them; nothing of them is part of this project.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
import pyproj
from dataframely import Schema

from pipeline.geodesy import distances_m
from pipeline.ingest.site import read_site
from schemas.enums import BaliseKind, Fix, Reaction
from schemas.errors import InputError
from schemas.inputs import Balises, Gnss, Links, Odometer, Reference, Track
from schemas.run import RunLog, Site

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_NS_PER_S = 1_000_000_000
# 1980-01-06 as Unix time, a GPS week, and GPS minus UTC since 2017 [s] (IS-GPS-200, IERS Bulletin C 52).
_GPS_EPOCH_S = 315_964_800
_WEEK_S = 604_800
_LEAP_S = 18
# Distance between track points taken from poses, and the accuracy that the pose is credited with.
_TRACK_STEP_M = 5.0
_POSE_SIGMA_M = 0.5
_COMMA_ELEMENT = "road"

_INFRABEL_FIX = {
    "NARROW_INT": Fix.RTK_FIXED,
    "NARROW_FLOAT": Fix.RTK_FLOAT,
    "SINGLE": Fix.AUTONOMOUS,
    "PSRDIFF": Fix.DIFFERENTIAL,
    "PROPAGATED": Fix.ESTIMATED,
}


def comma2k19_run(segment: Path, balises_at_m: Sequence[float] = ()) -> tuple[RunLog, Site]:
    """A segment of comma2k19: u-blox fixes, the mean of four wheel speeds, and the pose as reference and as track.

    Stamps are the device's clock for all streams (so the latency of the fixes shows), moved to UTC by the one
    offset that the pose gives. The pose was fused with the same satellites: a track, no independent truth.
    Virtual balises may be put at measures along the track.
    """
    pose_s, places = _poses(segment)
    offset_s = _utc_offset_s(segment)
    gnss = _comma_gnss(*_log(segment, "GNSS/live_gnss_ublox"), offset_s)
    wheels_s, wheels = _log(segment, "CAN/wheel_speed")
    odometer = _contract(Odometer, t=_stamps(wheels_s + offset_s), speed_mps=wheels.mean(axis=1))
    reference = _contract(Reference, t=_stamps(pose_s + offset_s), **places, sigma_m=_POSE_SIGMA_M)
    name = segment.name or "comma2k19"
    site = _comma_site(places, balises_at_m)
    return RunLog(name, gnss, odometer=odometer, reference=reference), site


def infrabel_run(log: Path) -> RunLog:
    """A log of the Infrabel measurement train: positions with the receiver's own type, nothing else.

    Its naive local times are taken as UTC, and `NARROW_INT`, `NARROW_FLOAT`, `SINGLE`, `PSRDIFF` and `PROPAGATED`
    (each with any number behind) as kinds of fix; without a computed solution there is none.
    """
    table = pl.read_csv(log, infer_schema=False)
    missing = {"timestamp", "latitude", "longitude", "solution_status", "position_type"} - set(table.columns)
    if missing:
        raise InputError("lacks columns of an Infrabel log", place=str(log), found=f"no {', '.join(sorted(missing))}")
    computed = pl.col("solution_status") == "SOL_COMPUTED"
    kind = pl.col("position_type").str.replace(r"\d+$", "").replace_strict(_INFRABEL_FIX, default=None)
    fix = pl.when(computed).then(kind).otherwise(pl.lit(Fix.NONE.value))
    unknown = table.filter(computed & kind.is_null())["position_type"].unique().sort()
    if unknown.len():
        raise InputError(
            "a position type is not known",
            place=f"{log}: position_type",
            found=", ".join(unknown),
            expected=", ".join(_INFRABEL_FIX),
        )
    gnss = table.select(
        t=pl.col("timestamp").str.to_datetime("%Y-%m-%dT%H:%M:%S%.f", time_unit="ns").dt.replace_time_zone("UTC"),
        latitude_deg=pl.col("latitude").cast(pl.Float64),
        longitude_deg=pl.col("longitude").cast(pl.Float64),
        fix=fix,
    )
    return RunLog(log.stem, _contract(Gnss, **gnss.to_dict()))


def infrabel_site(network: Path, path: Path | None = None, balises: Sequence[tuple[str, float]] = ()) -> Site:
    """The railway network of the Infrabel runs, or of it only the net elements of a `path` file, in WGS 84.

    `balises` are (net element, measure) of virtual balises VB1, VB2, ... to put on it.
    """
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(network, Path(folder) / "track.geojson")
        site = read_site(Path(folder))
    track, links = site.track, site.links
    if path is not None:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        kept = [f["properties"]["netelement_id"] for f in features if "netelement_id" in f["properties"]]
        track = track.filter(pl.col("netelement_id").is_in(kept))
        links = links.filter(pl.col("netelement_a").is_in(kept) & pl.col("netelement_b").is_in(kept))
    return Site(track, links, virtual_balises(balises) if balises else None)


def virtual_balises(places: Sequence[tuple[str, float]]) -> pl.DataFrame:
    """Virtual balises VB1, VB2, ... at (net element, measure), with the default settings."""
    return _contract(
        Balises,
        balise_id=[f"VB{number}" for number in range(1, len(places) + 1)],
        netelement_id=[element for element, _ in places],
        measure_m=[float(measure) for _, measure in places],
        kind=BaliseKind.VIRTUAL.value,
        location_accuracy_m=12.0,
        linked=True,
        link_reaction=Reaction.SERVICE_BRAKE.value,
    )


def _contract(schema: type[Schema], **columns: object) -> pl.DataFrame:
    """A table of the contract: scalars are repeated, columns that are not given are null, solution is `primary`."""
    given = {"solution": "primary", **columns} if schema is Gnss else columns
    rows = max(len(value) for value in given.values() if isinstance(value, pl.Series | np.ndarray | list))
    full = {
        name: value if isinstance(value, pl.Series | np.ndarray | list) else [value] * rows
        for name, value in {**dict.fromkeys(schema.column_names()), **given}.items()
    }
    table = pl.DataFrame(full, strict=False)
    return schema.validate(table.select(schema.column_names()), cast=True)


def _log(segment: Path, name: str) -> tuple[Floats, Floats]:
    folder = segment / "processed_log" / name
    return _array(folder / "t"), _array(folder / "value")


def _array(path: Path) -> Floats:
    try:
        values: Floats = np.load(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {error}", place=str(path), expected="a comma2k19 segment") from None
    return values


def _poses(segment: Path) -> tuple[Floats, dict[str, Floats]]:
    """Times on the device's clock, and positions in WGS 84."""
    folder = segment / "global_pose"
    to_wgs84 = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    x_m, y_m, z_m = _array(folder / "frame_positions").T
    longitude, latitude, height = to_wgs84.transform(x_m, y_m, z_m)
    places = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    return _array(folder / "frame_times"), places


def _utc_offset_s(segment: Path) -> float:
    """What is added to the device's clock: both are known for the first frame."""
    week, second = _array(segment / "global_pose" / "frame_gps_times")[0]
    boot_s = float(_array(segment / "global_pose" / "frame_times")[0])
    return float(_GPS_EPOCH_S + week * _WEEK_S + second - _LEAP_S) - boot_s


def _stamps(seconds: Floats) -> pl.Series:
    """Unix seconds as instants, to the microsecond (all that a double holds)."""
    return pl.Series(np.round(seconds * 1e6).astype(np.int64) * 1000).cast(pl.Datetime("ns", "UTC"))


def _comma_gnss(t_s: Floats, value: Floats, offset_s: float) -> pl.DataFrame:
    """`value`: latitude, longitude, speed, UTC, altitude, bearing."""
    bearing = np.radians(value[:, 5])
    return _contract(
        Gnss,
        t=_stamps(t_s + offset_s),
        latitude_deg=value[:, 0],
        longitude_deg=value[:, 1],
        height_m=value[:, 4],
        vel_e_mps=value[:, 2] * np.sin(bearing),
        vel_n_mps=value[:, 2] * np.cos(bearing),
        fix=Fix.AUTONOMOUS.value,
    )


def _comma_site(places: dict[str, Floats], balises_at_m: Sequence[float]) -> Site:
    """Poses at least 5 m apart, joined to one net element."""
    along = np.concatenate(
        ([0.0], np.cumsum(distances_m(places["latitude_deg"], places["longitude_deg"], places["height_m"])))
    )
    cell = np.floor(along / _TRACK_STEP_M)
    kept = np.concatenate(([0], np.flatnonzero(np.diff(cell) > 0) + 1))
    track = {name: values[kept] for name, values in places.items()}
    measure = np.concatenate(
        ([0.0], np.cumsum(distances_m(track["latitude_deg"], track["longitude_deg"], track["height_m"])))
    )
    table = _contract(Track, netelement_id=_COMMA_ELEMENT, measure_m=measure, **track, sigma_m=_POSE_SIGMA_M)
    balises = [(_COMMA_ELEMENT, at_m) for at_m in balises_at_m]
    return Site(table, Links.create_empty(), virtual_balises(balises) if balises else None)
