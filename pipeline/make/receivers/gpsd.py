"""Logs of gpsd in JSON (`gpspipe -w`): TPV for position and velocity, SKY for satellites; one object a line.

gpsd_json(5). Times are UTC. Its error estimates (`epx`, `eph`) are of a certainty that it does not state: not read.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.make.receivers.epochs import Gathered, satellite_name, velocity_columns
from pipeline.make.receivers.rivals import distance_m, twin_distance_m, two_receivers_error
from schemas.arrays import NS_PER_S
from schemas.enums import Fix
from schemas.run import Stream

_OBJECT = re.compile(rb'(?m)^\s*\{\s*"class"\s*:\s*"(?:TPV|SKY|VERSION|DEVICES?|WATCH|GST|PPS|TOFF)"')
HEAD = 1024 * 1024
# `status` of gpsd_json(5); what it does not tell is a fix of its own.
_STATUS = {
    2: Fix.DIFFERENTIAL, 3: Fix.RTK_FIXED, 4: Fix.RTK_FLOAT, 5: Fix.ESTIMATED, 6: Fix.AUTONOMOUS, 7: Fix.NONE,
    8: Fix.ESTIMATED,
}  # fmt: skip
_SYSTEMS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}
# Numbers of satellites where no system is named: first, last, letter, and the number of the first.
_PRNS = ((1, 32, "G", 1), (33, 64, "S", 120), (65, 96, "R", 1), (120, 158, "S", 120), (193, 202, "J", 1),
         (301, 336, "E", 1), (401, 463, "C", 1))  # fmt: skip


def is_gpsd(content: bytes) -> bool:
    """Whether a log holds objects of gpsd near its begin."""
    return _OBJECT.search(content[:HEAD]) is not None


def read_gpsd(
    content: bytes, log: Path, solution: str | None = None
) -> tuple[dict[Stream, pl.DataFrame], dict[str, int]]:
    """Streams, and what could not be used. `solution`: the device that is meant, where the log holds several."""
    gathered = Gathered()
    devices: Counter[str] = Counter()
    reports = list(_used_objects(content, gathered))
    for report in reports:
        if report["class"] == "TPV" and _has_fix(report):
            devices[_device_name(report)] += 1
    chosen = next((name for name in devices if solution in (name, name.rsplit("/", 1)[-1])), None)
    if len(devices) > 1 and chosen is None:
        raise two_receivers_error(str(log), frozenset(devices), _device_distance_m(reports), "device")
    for report in reports:
        if len(devices) < 2 or _device_name(report) == chosen:
            _DECODERS[report["class"]](gathered, report)
    if (apart_m := twin_distance_m(gathered)) is not None:
        raise two_receivers_error(str(log), frozenset(), apart_m)
    epochs = gathered.settle_epochs()
    return epochs.streams(), gathered.dropped


def count_objects(content: bytes) -> dict[tuple[str, bool], int]:
    """How many objects of each class there are, and whether it is read."""
    names = re.findall(rb'(?m)^\s*\{\s*"class"\s*:\s*"(\w+)"', content)
    return dict(Counter((f"gpsd {name.decode()}", name.decode() in _DECODERS) for name in names))


def _used_objects(content: bytes, gathered: Gathered) -> Iterator[dict[str, Any]]:
    """TPV and SKY; others are of no interest, what is no whole object is counted."""
    for line in content.splitlines():
        text = line.strip().rstrip(b",")
        if not text.startswith(b"{"):
            continue
        try:
            found = json.loads(text)
        except ValueError:  # also of bytes that are no text
            gathered.count_dropped("damaged message")
            continue
        except RecursionError:
            gathered.count_dropped("damaged message")
            continue
        if isinstance(found, dict) and found.get("class") in ("TPV", "SKY"):
            yield found


def _device_name(found: dict[str, Any]) -> str:
    """Name of the receiver that a report is of."""
    return str(found.get("device", ""))


def _has_fix(found: dict[str, Any]) -> bool:
    """Whether a report has a position."""
    return _number(found, "mode", 0.0) >= 2 and _number(found, "lat") is not None and _number(found, "lon") is not None


def _number(found: dict[str, Any], name: str, other: Any = None) -> Any:
    """A finite number, `other` where there is none."""
    value = found.get(name)
    known = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if known and isinstance(value, int | float) else other


def _device_distance_m(reports: list[dict[str, Any]]) -> float:
    """How far apart devices tell to be at one time [m]; 0 where they never tell of the same."""
    places: dict[int, tuple[str, tuple[float, float]]] = {}
    widest_m = 0.0
    for found in reports:
        t_ns = _time_ns(found)
        if t_ns is None or found["class"] != "TPV" or not _has_fix(found):
            continue
        place = (float(found["lat"]), float(found["lon"]))
        device, other = places.setdefault(t_ns, (_device_name(found), place))
        if device != _device_name(found):
            widest_m = max(widest_m, distance_m(place, other))
    return widest_m


def _time_ns(found: dict[str, Any]) -> int | None:
    """UTC [ns since 1970]: ISO 8601, in old logs seconds."""
    value = found.get("time")
    if (seconds := _number(found, "time")) is not None:
        whole_ns: int = round(seconds * NS_PER_S)
        return whole_ns
    if not isinstance(value, str):
        return None
    whole, _, rest = value.removesuffix("Z").partition(".")
    try:
        moment = datetime.fromisoformat(whole + "+00:00")
    except ValueError:
        return None
    if not value.endswith("Z") or (rest and not rest.isdigit()):
        return None
    return int(moment.timestamp()) * NS_PER_S + int(rest[:9].ljust(9, "0") or 0)


def _put_position(gathered: Gathered, found: dict[str, Any]) -> None:
    """Put down the position of a report."""
    t_ns = _time_ns(found)
    if t_ns is None:
        gathered.count_dropped("time not valid")
        return
    fix = _fix_kind(found)
    place = b"" if fix is Fix.NONE else f"{found['lat']} {found['lon']}".encode()
    epoch = gathered.epoch_at(t_ns, "TPV", place)
    epoch.t_ns = t_ns
    epoch.gnss["fix"] = fix.value
    if fix is Fix.NONE:
        return
    epoch.gnss |= {"latitude_deg": float(found["lat"]), "longitude_deg": float(found["lon"])}
    if (height_m := _height_m(found)) is not None:
        epoch.gnss["height_m"] = height_m
    epoch.gnss |= _velocity(found)


def _fix_kind(found: dict[str, Any]) -> Fix:
    """Kind of fix of a report."""
    if not _has_fix(found):
        return Fix.NONE
    return _STATUS.get(int(_number(found, "status", 0.0)), Fix.AUTONOMOUS)


def _height_m(found: dict[str, Any]) -> float | None:
    """Height over the ellipsoid [m]; `alt` of old logs is over the geoid or the ellipsoid, which nobody says."""
    if _number(found, "mode", 0.0) < 3:
        return None
    if (height_m := _number(found, "altHAE")) is not None:
        return float(height_m)
    above_m, separation_m = _number(found, "altMSL"), _number(found, "geoidSep")
    return None if above_m is None or separation_m is None else float(above_m + separation_m)


def _velocity(found: dict[str, Any]) -> dict[str, float]:
    """Velocity by axes where reported, else by speed [m/s] and course [deg from true north]."""
    axes = [_number(found, name) for name in ("velE", "velN", "velD")]
    if None not in axes:
        return velocity_columns(axes[0], axes[1], -axes[2])
    speed, course = _number(found, "speed"), _number(found, "track")
    if speed is None or course is None:
        return {}
    angle = math.radians(course)
    climb = _number(found, "climb")
    plane = {"vel_e_mps": speed * math.sin(angle), "vel_n_mps": speed * math.cos(angle)}
    return plane | ({"vel_u_mps": climb} if climb is not None else {})


def _put_satellites(gathered: Gathered, found: dict[str, Any]) -> None:
    """Satellites of an epoch; a list without a time is of none."""
    t_ns = _time_ns(found)
    listed = found.get("satellites")
    if t_ns is None or not isinstance(listed, list):
        gathered.count_dropped("satellites without a time")
        return
    epoch = gathered.epoch_at(t_ns)
    rows = [row for entry in listed if isinstance(entry, dict) and (row := _satellite(entry)) is not None]
    epoch.satellites = list({row["sv"]: row for row in rows}.values())
    epoch.gnss["satellites"] = sum(row["used"] for row in epoch.satellites)


def _satellite(entry: dict[str, Any]) -> dict[str, Any] | None:
    """One satellite of a report, if it is complete."""
    name = _satellite_name(entry)
    azimuth_deg, elevation_deg = _number(entry, "az"), _number(entry, "el")
    if name is None or azimuth_deg is None or elevation_deg is None or not abs(elevation_deg) <= 90.0:
        return None
    used = entry.get("used") is True
    return {
        "sv": name,
        "azimuth_deg": azimuth_deg,
        "elevation_deg": elevation_deg,
        "residual_m": _number(entry, "prRes") if used else None,
        "used": used,
    }


def _satellite_name(entry: dict[str, Any]) -> str | None:
    """Name of a satellite, by its system or its PRN."""
    system, number, prn = (_number(entry, name) for name in ("gnssid", "svid", "PRN"))
    if system is not None and number is not None and int(system) in _SYSTEMS and 0 < number < 256:
        return satellite_name(_SYSTEMS[int(system)], int(number))
    known = ((letter, int(prn) - low + first) for low, high, letter, first in _PRNS if prn and low <= prn <= high)
    return next((satellite_name(*satellite) for satellite in known), None)


_DECODERS = {"TPV": _put_position, "SKY": _put_satellites}
