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
import polars.selectors as cs
import pyproj
from dataframely import Schema

from pipeline.geodesy import distances_m, points_of
from pipeline.ingest.breaches import Breach, refuse
from pipeline.ingest.conform import conform, rows_text
from pipeline.ingest.csv_text import read_log_table
from pipeline.ingest.novatel import FIX_BY_WORD
from pipeline.ingest.site import read_site
from pipeline.receivers import Converted
from pipeline.receivers.csv import CUT_ROW
from schemas.enums import BaliseKind, Fix, Reaction
from schemas.errors import InputError
from schemas.inputs import Balises, Links, Track
from schemas.run import RunLog, Site, Stream

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

_FEWEST_POSES = 2

_INFRABEL_COLUMNS = ("timestamp", "latitude", "longitude", "solution_status", "position_type")
# A time cut off before its seconds is another time.
_TO_THE_SECOND = r"^(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?)$"


def known_recording(path: Path) -> Converted | None:
    """A segment of comma2k19 (a folder) or a log of the Infrabel train (a CSV with its columns); none if neither."""
    if (path / "processed_log").is_dir():
        return Converted(comma2k19_run(path)[0], {})
    if path.suffix.lower() != ".csv" or not path.is_file():
        return None
    with path.open("rb") as stream:
        head = stream.readline()
    return infrabel_recording(path) if all(name.encode() in head for name in _INFRABEL_COLUMNS) else None


def comma2k19_run(segment: Path, balises_at_m: Sequence[float] = ()) -> tuple[RunLog, Site]:
    """A segment of comma2k19: u-blox fixes, the mean of four wheel speeds, and the pose as reference and as track.

    Stamps are the device's clock for all streams (so the latency of the fixes shows), moved to UTC by the one
    offset that the pose gives. The pose was fused with the same satellites: a track, no independent truth.
    NaN is not known; a segment without wheel speeds has no odometer.
    Virtual balises may be put at measures along the track.
    """
    pose_s, places = _poses(segment)
    offset_s = _utc_offset_s(segment)
    gnss = _comma_gnss(segment, offset_s)
    reference = pl.DataFrame({"t": _stamps(pose_s + offset_s), **places}).with_columns(sigma_m=_POSE_SIGMA_M)
    name = segment.resolve().name
    site = _comma_site(places, balises_at_m)
    run = RunLog(
        name,
        _conformed(gnss, "gnss", segment),
        odometer=_comma_odometer(segment, offset_s),
        reference=_conformed(reference, "reference", segment),
    )
    return run, site


def infrabel_run(log: Path) -> RunLog:
    """A log of the Infrabel measurement train: see `infrabel_recording`."""
    return infrabel_recording(log).run


def infrabel_recording(log: Path) -> Converted:
    """A log of the Infrabel measurement train: positions with the receiver's own type, nothing else.

    Its naive local times are taken as UTC, and NovAtel's position types (each with any number behind) as kinds of fix;
    without a computed solution, or without a type, there is none. Half a row at the end is left out.
    """
    try:
        table, cut = read_log_table(log.read_bytes(), infer=False)
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        raise InputError(f"is no CSV file: {str(error).splitlines()[0]}", place=str(log)) from None
    missing = set(_INFRABEL_COLUMNS) - set(table.columns)
    if missing:
        raise InputError("lacks columns of an Infrabel log", place=str(log), found=f"no {', '.join(sorted(missing))}")
    computed = pl.col("solution_status") == "SOL_COMPUTED"
    word = pl.col("position_type").replace("", None)
    kind = word.str.replace(r"\d+$", "").replace_strict(FIX_BY_WORD, default=None)
    fix = pl.when(computed & word.is_not_null()).then(kind).otherwise(pl.lit(Fix.NONE.value))
    unknown = table.filter(computed & word.is_not_null() & kind.is_null())["position_type"].unique().sort()
    if unknown.len():
        raise InputError(
            "a position type is not known",
            place=f"{log}: position_type",
            found=", ".join(unknown),
            expected=", ".join(FIX_BY_WORD),
        )
    time = pl.col("timestamp").str.extract(_TO_THE_SECOND)
    gnss = table.select(
        t=time.str.to_datetime(time_unit="ns", strict=False).dt.replace_time_zone("UTC"),
        latitude_deg=pl.col("latitude").cast(pl.Float64, strict=False),
        longitude_deg=pl.col("longitude").cast(pl.Float64, strict=False),
        fix=fix,
    )
    _refuse_unreadable(table.select("timestamp", "latitude", "longitude"), gnss.select(pl.nth(0, 1, 2)), log)
    return Converted(RunLog(log.stem, _conformed(gnss, "gnss", log)), {CUT_ROW: cut} if cut else {})


def _refuse_unreadable(texts: pl.DataFrame, values: pl.DataFrame, log: Path) -> None:
    for text, value in zip(texts, values, strict=True):
        wrong = value.is_null() & text.is_not_null() & (text != "")
        if wrong.any():
            found = f"{text.filter(wrong)[0]!r} in {rows_text(wrong)}"
            raise InputError("cannot be read", place=f"{log}: column {text.name}", found=found)


def _conformed(frame: pl.DataFrame, stream: Stream, place: Path) -> pl.DataFrame:
    """The stream as the contract has it; NaN is not known."""
    breaches: list[Breach] = []
    found = conform(frame.with_columns(cs.float().fill_nan(None)), stream, str(place), breaches)
    refuse(breaches)
    return found


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
    """A table of the contract: scalars are repeated, columns that are not given are null."""
    rows = max(len(value) for value in columns.values() if isinstance(value, pl.Series | np.ndarray | list))
    full = {
        name: value if isinstance(value, pl.Series | np.ndarray | list) else [value] * rows
        for name, value in {**dict.fromkeys(schema.column_names()), **columns}.items()
    }
    table = pl.DataFrame(full, strict=False)
    return schema.validate(table.select(schema.column_names()), cast=True)


def _log(segment: Path, name: str, columns: int) -> tuple[Floats, Floats]:
    """Times and values of as many columns, without rows of no time."""
    folder = segment / "processed_log" / name
    t_s, value = _array(folder / "t", 1), _array(folder / "value", 2)
    if len(value) != len(t_s) or value.shape[1] < columns:
        raise InputError(
            "is not as comma2k19 has it",
            place=str(folder),
            found=f"t of shape {t_s.shape}, value of shape {value.shape}",
            expected=f"one time per row of {columns} values",
        )
    timed = np.isfinite(t_s)
    return t_s[timed], value[timed]


def _array(path: Path, dimensions: int) -> Floats:
    try:
        values: Floats = np.load(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {error}", place=str(path), expected="a comma2k19 segment") from None
    if values.ndim != dimensions or values.dtype.kind not in "iuf":
        found, expected = f"{values.dtype} of shape {values.shape}", f"numbers in {dimensions} dimensions"
        raise InputError("is not as comma2k19 has it", place=str(path), found=found, expected=expected)
    return values.astype(np.float64, copy=False)


def _poses(segment: Path) -> tuple[Floats, dict[str, Floats]]:
    """Times on the device's clock, and positions in WGS 84, of the poses that are known."""
    folder = segment / "global_pose"
    times_s, places_m = _array(folder / "frame_times", 1), _array(folder / "frame_positions", 2)
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
    gps, boot_s = _array(folder / "frame_gps_times", 2), _array(folder / "frame_times", 1)
    if gps.shape[1] != 2:  # week and second
        found = f"shape {gps.shape}"
        raise InputError("is not as comma2k19 has it", place=str(folder / "frame_gps_times"), found=found)
    count = min(len(gps), len(boot_s))
    known = np.flatnonzero(np.isfinite(gps[:count]).all(axis=-1) & np.isfinite(boot_s[:count]))
    if not len(known):
        raise InputError("holds no GPS time", place=str(folder / "frame_gps_times"), expected="week and second")
    week, second = gps[known[0]]
    return float(_GPS_EPOCH_S + week * _WEEK_S + second - _LEAP_S) - float(boot_s[known[0]])


def _stamps(seconds: Floats) -> pl.Series:
    """Unix seconds as instants, to the microsecond (all that a double holds)."""
    return pl.Series(np.round(seconds * 1e6).astype(np.int64) * 1000).cast(pl.Datetime("ns", "UTC"))


def _comma_gnss(segment: Path, offset_s: float) -> pl.DataFrame:
    """`value`: latitude, longitude, speed, UTC, altitude, bearing."""
    t_s, value = _log(segment, "GNSS/live_gnss_ublox", columns=6)
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


def _comma_odometer(segment: Path, offset_s: float) -> pl.DataFrame | None:
    """The mean of the wheels that are known; none where there are no wheel speeds."""
    if not (segment / "processed_log" / "CAN" / "wheel_speed").is_dir():
        return None
    t_s, wheels_mps = _log(segment, "CAN/wheel_speed", columns=1)
    known = np.isfinite(wheels_mps).any(axis=1)
    if not known.any():
        return None
    speed = np.nanmean(wheels_mps[known], axis=1)
    return _conformed(pl.DataFrame({"t": _stamps(t_s[known] + offset_s), "speed_mps": speed}), "odometer", segment)


def _comma_site(places: dict[str, Floats], balises_at_m: Sequence[float]) -> Site:
    """Poses at least 5 m apart, joined to one net element."""
    kept = _poses_apart(places)
    track = {name: values[kept] for name, values in places.items()}
    measure = np.concatenate(
        ([0.0], np.cumsum(distances_m(track["latitude_deg"], track["longitude_deg"], track["height_m"])))
    )
    table = _contract(Track, netelement_id=_COMMA_ELEMENT, measure_m=measure, **track, sigma_m=_POSE_SIGMA_M)
    balises = [(_COMMA_ELEMENT, at_m) for at_m in balises_at_m]
    return Site(table, Links.create_empty(), virtual_balises(balises) if balises else None)


def _poses_apart(places: dict[str, Floats]) -> list[int]:
    """Each pose that lies a step from the one kept before: one that wanders at standstill adds nothing."""
    surface = points_of(places["latitude_deg"], places["longitude_deg"]).surface
    kept = [0]
    for row in range(1, len(surface)):
        if np.linalg.norm(surface[row] - surface[kept[-1]]) >= _TRACK_STEP_M:
            kept.append(row)
    return kept if len(kept) > 1 else [0, len(surface) - 1]
