"""A mapping to begin with, from the header of a CSV file: what names and units tell, and what is left to decide."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import polars as pl

from pipeline.ingest.csv_text import LogTable, read_log_table
from pipeline.receivers.csv import with_points
from pipeline.receivers.csv_times import LEAST_DAY, MOST_DAY, orders_of
from schemas.run import Stream

_POSITION = ("latitude_deg", "longitude_deg")
# Names by column of a stream, without their units; the first that fits.
_NAMES: dict[Stream, dict[str, str]] = {
    "gnss": {
        "latitude_deg": r"(gps|gnss)?(lat|latitude|breite|breitengrad|geobreite)(deg|wgs84)?",
        "longitude_deg": r"(gps|gnss)?(lon|long|lng|longitude|laenge|länge|längengrad)(deg|wgs84)?",
        "height_m": r"(ellipsoidal|ell|ellips|hae)(height|h|hgt|alt|altitude)?|(height|h|alt)(ell|ellipsoidal|hae)",
        "vel_e_mps": r"(ve|vel?e|east(vel|velocity|speed)|vel(ocity)?east)",
        "vel_n_mps": r"(vn|vel?n|north(vel|velocity|speed)|vel(ocity)?north)",
        "vel_u_mps": r"(vu|vel?u|up(vel|velocity|speed)|vel(ocity)?up)",
        "satellites": r"(ns|nsat|nsats|numsv|sats?|satellites|satelliten)(used|inuse)?",
    },
    "odometer": {
        "distance_m": r"(odo|odometer|distance|dist|weg|strecke|wegstrecke|mileage|km|chainage)(m|km)?",
        "speed_mps": r"(odo|train|wheel|vehicle)?(speed|velocity|v|geschwindigkeit|vitesse)(mps|kmh|kph|mph|kn|knots)?",
    },
}
_UNITS = {
    "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600,
    "knots": 1852 / 3600, "mm/s": 1e-3, "cm/s": 1e-2, "m": 1.0, "km": 1000.0, "mm": 1e-3, "cm": 1e-2, "ft": 0.3048,
    "mi": 1609.344,
}  # fmt: skip
_UNIT_NEEDED = ("distance_m", "speed_mps", "vel_e_mps", "vel_n_mps", "vel_u_mps", "height_m")
_TIMES = (
    r"(gps|utc|gnss)?(t|time|timestamp|datetime|zeit|zeitstempel|zeitpunkt|utc|datumzeit|datumuhrzeit|heure)"
    r"(utc|gps|s|ms|us|ns)?"
)
_DATES, _WEEKS = r"(gps|utc)?(date|datum|day|tag)(utc)?", r"(gps|gpst)?(week|wk|wn|weekno|weeknumber|woche)"
_SECONDS = r"(gps)?(tow|sow|itow|timeofweek|secondsofweek|secofweek|weekseconds|gpsseconds|gpstime|seconds)(s|ms)?"
_CLOCKS = r"(gps|utc)?(time|zeit|uhrzeit|timeofday|clock|heure)(utc)?"


def draft_mapping(path: Path) -> str:
    """Configuration text for `balise convert`, to be saved and checked; what nothing tells is a comment."""
    log = read_log_table(path, infer=True)
    table = with_points(log)
    time = _time_lines(table, _plain(table), log)
    parts = [part for stream in _NAMES for part in (_stream(stream, table, log, path.name, time),) if part]
    head = f"# Draft from the header of {path.name}: check each line, above all units and the scale of the times.\n"
    columns = f"# Columns: {', '.join(map(_one_line, table.columns))}\n"
    return head + columns + ("\n".join(parts) if parts else _EMPTY.format(topic=json.dumps(path.name)))


_EMPTY = """
# No name tells what is position, distance or speed. Write, for instance:
# [[ingest.odometer]]
# topic = {topic}
# time = "field:COLUMN"
# fields = {{ distance_m = "COLUMN" }}
"""


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _plain(table: pl.DataFrame) -> dict[str, str]:
    """Column to its name without unit, blanks and signs."""
    return {
        name: re.sub(r"[^a-zäöüß0-9]", "", re.sub(r"[\[(<].*", "", name).lower())
        for name in table.columns
        if name.strip()
    }


def _first(plain: Mapping[str, str], pattern: str) -> str | None:
    return next((name for name, word in plain.items() if re.fullmatch(pattern, word)), None)


def _unit(name: str, log: LogTable) -> str | None:
    """As the header has it in brackets or at its end, or the row of units."""
    told = re.search(r"[\[(<]\s*([^\])>]+?)\s*[\])>]", name) or re.search(
        r"_(kmh|kph|mps|mph|km|mm|cm|m|ms|s|ft|kn|knots)$", name.lower()
    )
    if told is not None:
        return told[1].lower()
    place = log.table.columns.index(name)
    unit = log.units[place].strip("[]()<> ").lower() if place < len(log.units) else ""
    return unit or None


def _stream(stream: Stream, table: pl.DataFrame, log: LogTable, file: str, time: list[str]) -> str:
    named = _plain(table)
    plain = {name: word for name, word in named.items() if table[name].dtype.is_numeric()}
    found = {column: name for column, pattern in _NAMES[stream].items() if (name := _first(plain, pattern))}
    unfit = _unfit(stream, table, {name: word for name, word in named.items() if name not in plain})
    if not found or (stream == "gnss" and not set(_POSITION) <= set(found)):
        return "".join(f"\n{line}" for line in unfit)
    factors, remarks = _factors(found, log)
    scales = [line for line in time if line.startswith("t = ")]
    pairs = ", ".join(f"{column} = {json.dumps(name, ensure_ascii=False)}" for column, name in found.items())
    lines = [f"[[ingest.{stream}]]", f"topic = {json.dumps(file, ensure_ascii=False)}"]
    lines += [line for line in time if not line.startswith("t = ")]
    lines += [f"fields = {{ {pairs} }}"]
    listed = [*scales, *(f"{column} = {factor:.10g}" for column, factor in factors.items())]
    lines += [f"factors = {{ {', '.join(listed)} }}"] if listed else []
    if stream == "gnss" and "height_m" not in found:
        remarks.append("# height_m: only a height over the ellipsoid; one over the sea is another 20 to 60 m in Europe")
    return "\n".join(["", *lines, *remarks, *unfit]) + "\n"


def _unfit(stream: Stream, table: pl.DataFrame, plain: Mapping[str, str]) -> list[str]:
    """What is left out though its name fits, since it holds texts."""
    found = {column: name for column, pattern in _NAMES[stream].items() if (name := _first(plain, pattern))}
    texts = {column: table[name].cast(pl.String).replace("", None).drop_nulls() for column, name in found.items()}
    wrong = {column: cells.filter(cells.cast(pl.Float64, strict=False).is_null()) for column, cells in texts.items()}
    return [
        f"# {column}: left out, since {_one_line(found[column])!r} holds no number in {len(cells)} rows, "
        f"first {_one_line(str(cells[0]))!r}"
        for column, cells in wrong.items()
        if len(cells)
    ]


def _factors(found: Mapping[str, str], log: LogTable) -> tuple[dict[str, float], list[str]]:
    factors: dict[str, float] = {}
    remarks: list[str] = []
    for column in set(_UNIT_NEEDED) & set(found):
        unit = _unit(found[column], log)
        if unit not in _UNITS:
            told = "is not told" if unit is None else f"{_one_line(unit)!r} is not known"
            remarks.append(f"# {column}: the unit {told}; another one than of the name needs a factor")
        elif _UNITS[unit] != 1.0:
            factors[column] = _UNITS[unit]
    return dict(sorted(factors.items())), sorted(remarks)


def _time_lines(table: pl.DataFrame, plain: Mapping[str, str], log: LogTable) -> list[str]:
    """The lines on time; `t = ` is for the factors."""
    week, seconds = _first(plain, _WEEKS), _first(plain, _SECONDS)
    if week and seconds:
        milli = _unit(seconds, log) == "ms" or plain[seconds] == "itow"
        return [_field(week, seconds), 'time_epoch = "gps"', *(["t = 0.001"] if milli else [])]
    date, clock = _first(plain, _DATES), _first(plain, _CLOCKS)
    if date and clock:
        return [_field(date, clock), *_epoch(table[date], log), *_order(table[date])]
    time = _first(plain, _TIMES) or date
    if time is None:
        return ['# time = "field:COLUMN"  # no name tells which column is the time']
    scale = ['# time_scale = "gps"  # if these times are 18 s ahead of UTC'] if "gps" in plain[time] else []
    return [_field(time), *_epoch(table[time], log), *_order(table[time]), *scale]


def _field(*names: str) -> str:
    return f"time = {json.dumps('field:' + ' + '.join(names), ensure_ascii=False)}"


def _order(column: pl.Series) -> list[str]:
    if column.dtype != pl.String or len(orders_of(column)) < 2:
        return []
    return ['# date_order = "day_first"  # or "month_first": all dates of the file fit both, so you must say it']


def _epoch(column: pl.Series, log: LogTable) -> list[str]:
    """What numbers may count, by their size."""
    if not column.dtype.is_numeric() or column.drop_nulls().is_empty():
        return []
    least, most = float(column.min()), float(column.max())  # type: ignore[arg-type]
    if least >= LEAST_DAY and most <= MOST_DAY:
        return ['time_epoch = "excel"  # days since 1899-12-30']
    for unit, size in ((1e-3, 1e12), (1e-6, 1e15)):
        if 0.5 * size < least and most < 4 * size:
            return [f"t = {unit:g}"]
    return []
