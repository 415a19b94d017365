"""RTKLIB solutions (`.pos`): one row per epoch, what its columns are in the header.

Read are the forms of the RTKLIB manual 2.4.3, appendix B.1, in degrees or earth-fixed metres: GPST, UTC and JST as
calendar or week and seconds. Degrees with minutes and baselines are refused: RTKLIB writes the others on request.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pipeline.make.receivers.earth_fixed import east_north_up, geodetic
from pipeline.read.ingest.csv_text import CUT_ROW
from pipeline.read.ingest.parts import LogPart
from pipeline.read.ingest.stamps import counts_within, gps_ns_of_weeks, utc_of
from pipeline.read.numbers import numbers_of
from schemas.arrays import NS_PER_S, Floats
from schemas.enums import Fix
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.inputs import Gnss
from schemas.run import Stream

# RTKLIB manual, appendix B.1, "Q"; PPP is a service, as with other receivers.
_QUALITY = {
    0: Fix.NONE, 1: Fix.RTK_FIXED, 2: Fix.RTK_FLOAT, 3: Fix.SBAS, 4: Fix.DIFFERENTIAL, 5: Fix.AUTONOMOUS,
    6: Fix.DIFFERENTIAL, 7: Fix.ESTIMATED,
}  # fmt: skip
_AHEAD_NS = {"GPST": 0, "UTC": 0, "JST": 9 * 3600 * NS_PER_S}  # of UTC, GPS time beside its leap seconds
_TOGETHER = (
    ("latitude", "longitude", "height"), ("x-ecef", "y-ecef", "z-ecef"), ("vx", "vy", "vz"),
)  # fmt: skip
_DATE = re.compile(r"[0-9]{4}/[0-9]{1,2}/[0-9]{1,2}")
_GEOID = "height over the geoid: left empty, since the file has no separation"


@frozen
class _RtklibHeader:
    """What the header says: scale of the times, names of the columns without units, and the comments themselves."""

    scale: str
    columns: tuple[str, ...]
    comments: str

    @property
    def tokens(self) -> int:
        """Words in a row, of which time takes two."""
        return 2 + len(self.columns)


def is_solution(content: bytes) -> bool:
    """Whether a file begins as RTKLIB's solutions do."""
    head = content[:4096].lstrip(b"\xef\xbb\xbf \r\n")
    return head.startswith(b"%") and (b"RTKLIB" in head or re.search(rb"%\s+(GPST|UTC|JST)\b", head) is not None)


def read_solution(content: bytes, path: Path) -> tuple[dict[Stream, pl.DataFrame], dict[str, int]]:
    """`gnss` of a solution, and what was left out. Raises `InputError` for whatever the header does not explain."""
    lines = content.decode("utf-8", "replace").splitlines()
    layout = _read_header([line for line in lines if line.startswith("%")], path)
    rows, dropped = _split_rows(lines, layout, content.endswith((b"\n", b"\r")), path)
    if not rows:
        raise InputError("holds no epoch", place=str(path), expected="rows below the header")
    words = np.array(rows)
    frame = pl.DataFrame({"t": _parse_times(words, layout, path), "solution": "primary"})
    numbers = _parse_numbers(words, layout, path)
    columns = (
        _position_columns(numbers, layout, path)
        | _covariance_columns(numbers, layout, path)
        | _fix_columns(numbers, path)
    )
    if "geodetic" in layout.comments:
        columns["height_m"] = None
        dropped[_GEOID] = len(rows)
    known = {
        name: pl.Series(value, dtype=Gnss.columns()[name].dtype) for name, value in columns.items() if value is not None
    }
    fixes = frame.with_columns(**known)
    is_placed = pl.col("fix") != Fix.NONE.value
    kept = ("t", "solution", "fix", "satellites")
    return {"gnss": fixes.with_columns(pl.when(is_placed).then(pl.exclude(kept)))}, dropped


def parts_of_solution(content: bytes, path: Path) -> list[LogPart]:
    """The columns of a solution, and what they become."""
    lines = content.decode("utf-8", "replace").splitlines()
    layout = _read_header([line for line in lines if line.startswith("%")], path)
    rows = sum(bool(line.strip()) and not line.startswith("%") for line in lines)
    parts = [LogPart(path.name, "column", layout.scale, rows, "gnss t")]
    for name in layout.columns:
        used = _USES.get(name) or ("gnss covariance" if re.fullmatch("sd[xyzenu]+", name) else "")
        unplaced = name == "height" and "geodetic" in layout.comments
        parts.append(LogPart(path.name, "column", name, rows, "" if unplaced else used))
    return parts


_USES = {
    **dict.fromkeys(("latitude", "longitude", "height", "x-ecef", "y-ecef", "z-ecef"), "gnss position"),
    **dict.fromkeys(("vx", "vy", "vz", "ve", "vn", "vu"), "gnss velocity"),
    "Q": "gnss fix",
    "ns": "gnss satellites",
    "age": "gnss sbas_age_s",
}


def _read_header(comments: list[str], path: Path) -> _RtklibHeader:
    """Columns of a file of RTKLIB, of the line that names them."""
    headers = [re.split(r"[\s,;]+", line.lstrip("% ").strip()) for line in comments]
    headers = [words for words in headers if words[0] in _AHEAD_NS and {"Q", "ns"} <= set(words)]
    if not headers:
        raise InputError(
            "has no line that names its columns",
            place=str(path),
            expected="a line such as %  GPST  latitude(deg) longitude(deg) height(m) Q ns ...",
            remedy="Let RTKLIB write its header (out-outhead = on): without it the scale of the times is not known.",
        )
    scale, *units = headers[0]
    names = tuple(re.sub(r"\(.*\)$", "", word) for word in units)
    lacking = [name for group in _TOGETHER if {*group} & {*names} for name in group if name not in names]
    if lacking:
        message = f"has no column {', '.join(lacking)}"
        raise InputError(message, place=str(path), found=", ".join(names), remedy="Let RTKLIB write the file again.")
    if any(words != headers[0] for words in headers):
        forms = ", ".join(sorted({" ".join(words[:3]) for words in headers}))
        remedy = "Give the files that were joined one by one."
        raise InputError("holds solutions of several forms", place=str(path), found=forms, remedy=remedy)
    if any("(d'" in word for word in units):
        remedy = "Let RTKLIB write decimal degrees (out-degform = deg)."
        raise InputError("holds degrees with minutes and seconds", place=str(path), remedy=remedy)
    return _RtklibHeader(scale, names, "\n".join(comments))


def _split_rows(
    lines: list[str], layout: _RtklibHeader, ended: bool, path: Path
) -> tuple[list[list[str]], dict[str, int]]:
    """The words of each row; a last row without its end is left out."""
    rows: list[list[str]] = []
    for number, line in enumerate(lines, 1):
        if line.startswith("%") or not line.strip():
            continue
        words = re.split(r"[\s,;]+", line.strip().rstrip(",;"))
        if len(words) != layout.tokens:
            if number == len(lines) and not ended:
                return rows, {CUT_ROW: 1}
            raise InputError(
                "does not fit the header",
                place=f"{path}: line {number}",
                found=f"{len(words)} values",
                expected=f"{layout.tokens}: time, {', '.join(layout.columns)}",
                remedy="Take the line out, or let RTKLIB write the file again.",
            )
        rows.append(words)
    return rows, {}


def _parse_times(words: Any, layout: _RtklibHeader, path: Path) -> pl.Series:
    """UTC of the first two words of each row."""
    if _DATE.fullmatch(words[0, 0]):
        text = pl.Series(np.char.add(np.char.add(words[:, 0], "T"), words[:, 1]))
        date_us = text.str.to_datetime("%Y/%m/%dT%H:%M:%S%.f", time_unit="us", strict=False).to_physical()
        exact = text.str.to_datetime("%Y/%m/%dT%H:%M:%S%.f", time_unit="ns", strict=False).to_physical()
        t_ns = exact.set(counts_within(date_us, 1000).is_null(), None)
    else:
        week = pl.Series(words[:, 0]).cast(pl.Int64, strict=False)
        t_ns = gps_ns_of_weeks(week, pl.Series(words[:, 1]).cast(pl.Float64, strict=False))
    if t_ns.null_count():
        row = int(t_ns.is_null().arg_max() or 0)
        raise InputError(
            "is no time",
            place=f"{path}: row {row + 1} of the epochs",
            found=" ".join(words[row, :2]),
            expected=f"y/m/d h:m:s, or week and seconds, in {layout.scale}",
        )
    return utc_of(t_ns - _AHEAD_NS[layout.scale], "gps" if layout.scale == "GPST" else "utc")


def _parse_numbers(words: Any, layout: _RtklibHeader, path: Path) -> dict[str, Floats]:
    """The columns after date and time, by the names of the header."""
    rest = words[:, 2:]
    try:
        values = numbers_of(rest.ravel()).reshape(rest.shape)
    except ValueError as error:
        raise InputError(f"holds a value that is no number: {error}", place=str(path)) from None
    return dict(zip(layout.columns, values.T, strict=True))


def _position_columns(numbers: dict[str, Floats], layout: _RtklibHeader, path: Path) -> dict[str, Any]:
    """Place and, where given, velocity."""
    if "Tokyo" in layout.comments:
        raise InputError("is in the Tokyo datum", place=str(path), expected="WGS 84", remedy="Set out-datum = wgs84.")
    if "latitude" in numbers:
        names = ("latitude_deg", "longitude_deg", "height_m")
        place = {name: numbers[name.rpartition("_")[0]] for name in names}
    elif "x-ecef" in numbers:
        place = geodetic(*(numbers[f"{axis}-ecef"] for axis in "xyz"))
    else:
        raise InputError(
            "holds no places",
            place=str(path),
            found=", ".join(numbers),
            expected="latitude and longitude, or x/y/z-ecef",
            remedy="Let RTKLIB write latitude, longitude and height (out-solformat = llh).",
        )
    return place | _velocity_columns(numbers, place)


def _velocity_columns(numbers: dict[str, Floats], place: dict[str, Floats]) -> dict[str, Any]:
    """Velocities to the east, the north and up, however the file states them."""
    if "vx" in numbers:
        turn = east_north_up(place["latitude_deg"], place["longitude_deg"])
        local = np.einsum("ijn,jn->in", turn, np.array([numbers["vx"], numbers["vy"], numbers["vz"]]))
        return dict(zip(("vel_e_mps", "vel_n_mps", "vel_u_mps"), local, strict=True))
    return {f"vel_{axis}_mps": numbers[f"v{axis}"] for axis in "enu" if f"v{axis}" in numbers}


def _covariance_columns(numbers: dict[str, Floats], layout: _RtklibHeader, path: Path) -> dict[str, Any]:
    """Deviations, and of two axes the signed root of their covariance, as variances [m2]."""
    axes = "xyz" if "sdx" in numbers else "enu"
    matrix = np.zeros((3, 3, len(numbers["Q"])))
    for row, first in enumerate(axes):
        for column, second in enumerate(axes):
            names = (f"sd{first}",) if row == column else (f"sd{first}{second}", f"sd{second}{first}")
            name = next((name for name in names if name in numbers), None)
            if name is None:
                return {}
            matrix[row, column] = np.sign(numbers[name]) * numbers[name] ** 2
    if axes == "xyz":
        place = _position_columns(numbers, layout, path)
        turn = east_north_up(place["latitude_deg"], place["longitude_deg"])
        matrix = np.einsum("ijn,jkn,lkn->iln", turn, matrix, turn)
    upper = {f"cov_{a}{b}_m2": matrix[i, j] for i, a in enumerate("enu") for j, b in enumerate("enu") if i <= j}
    # No deviation at all is how RTKLIB writes that it has none.
    unknown = (matrix[0, 0] <= 0) & (matrix[1, 1] <= 0)
    return {name: pl.Series(values).set(pl.Series(unknown), None) for name, values in upper.items()}


def _fix_columns(numbers: dict[str, Floats], path: Path) -> dict[str, Any]:
    """Kind of fix by RTKLIB's quality."""
    strange = [code for code in np.unique(numbers["Q"]) if code not in _QUALITY]
    if strange:
        raise InputError(
            "holds a quality that RTKLIB does not know",
            place=f"{path}: column Q",
            found=", ".join(f"{code:g}" for code in strange),
            expected="0 to 7",
        )
    kinds = [_QUALITY[int(code)].value for code in numbers["Q"]]
    columns: dict[str, Any] = {"fix": kinds, "satellites": numbers["ns"].astype(np.int64)}
    if "age" in numbers:
        sbas = pl.Series(kinds) == Fix.SBAS.value
        columns["sbas_age_s"] = pl.Series(numbers["age"]).set(~sbas, None)
    return columns
