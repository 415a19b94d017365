"""A mapping to begin with, from the header of a CSV file: what names and units show, and what is left to decide."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from pipeline.read.ingest.csv_text import read_log_table, with_decimal_points
from pipeline.read.ingest.guesses import (
    COLUMNS,
    POSITION,
    WORDS,
    columns_in,
    first_fitting,
    known_zones,
    mapping_lines,
    one_line,
    unit_in,
    word_of,
    words_of_times,
    zone_in,
)
from pipeline.read.ingest.stamps import LEAST_DAY, MOST_DAY, day_is_unclear
from pipeline.read.ingest.wraps import wrap_of
from schemas.enums import Fix
from schemas.run import Stream

_EMPTY = """
# No name tells what is position, distance or speed. Write, for instance:
# [[ingest.odometer]]
# topic = {topic}
# time = "field:COLUMN"
# fields = {{ distance_m = "COLUMN" }}
"""

# One recorder's speed is mostly its receiver's: as odometer it would prove what it comes from (DOMAIN section 5.0).
_WITH_POSITIONS = (
    "# Beside positions: taken for the receiver's own, which is no odometer. Remove the # where it is a sensor's,\n"
    "# and say of which; where it is the receiver's, leave it out."
)

Words = Mapping[str, str]


def draft_mapping(path: Path) -> str:
    """Configuration text for `balise convert`, to be saved and checked; what nothing shows is a comment."""
    log = read_log_table(path, infer=True)
    table = with_decimal_points(log)
    pairs = zip(log.table.columns, log.units, strict=False)
    units = {name: unit for name, written in pairs if (unit := written.strip("[]()<> ").lower())}
    words = {name: word_of(name) for name in table.columns if name.strip()}
    time = _time_lines(table, words, units)
    parts = [part for stream in COLUMNS if (part := _stream_lines(stream, table, words, path.name, time, units))]
    parts += _read_lines(words, path.name, time)
    head = f"# Draft from the header of {path.name}: check each line, above all units and the scale of the times.\n"
    columns = f"# Columns: {', '.join(map(one_line, table.columns))}\n"
    columns += _unused_columns(table.columns, parts)
    return head + columns + ("\n".join(parts) if parts else _EMPTY.format(topic=json.dumps(path.name)))


def _unused_columns(columns: Sequence[str], parts: Sequence[str]) -> str:
    """The columns that no line of the draft uses, so that nothing is left out without a word."""
    active = [line for part in parts for line in part.splitlines() if line and not line.startswith("#")]
    texts = [text for line in active for text in re.findall(r'"((?:[^"\\]|\\.)*)"', line)]
    used = {name for text in texts for name in (text, *text.removeprefix("field:").split(" + "))}
    rest = [name for name in columns if json.dumps(name, ensure_ascii=False)[1:-1] not in used]
    return f"# Unused columns: {', '.join(map(one_line, rest))}\n" if rest else ""


def _stream_lines(
    stream: Stream, table: pl.DataFrame, words: Words, file: str, time: tuple[list[str], float | None], units: Words
) -> str:
    """Lines of the mapping of one stream, commented out where they are in doubt; empty where nothing fits."""
    numbers = {name: word for name, word in words.items() if table[name].dtype.is_numeric()}
    # Rows of several odometers must stay apart: one after the other they are no counter.
    sensor = first_fitting(words, WORDS["sensor"]) if stream == "odometer" else None
    kind = _fix_column(table, words) if stream == "gnss" else None
    texts = {column: name for column, name in (("sensor", sensor), ("fix", kind)) if name is not None}
    lines = mapping_lines(stream, file, numbers, *time, units, texts)
    lines += _wrap_lines(table, columns_in(stream, numbers)) if stream == "odometer" and lines and not sensor else []
    unfit = _unfit_lines(stream, table, {name: word for name, word in words.items() if name not in numbers})
    if stream == "odometer" and lines and set(columns_in("gnss", words)) >= POSITION:
        lines = [_WITH_POSITIONS, *(line if line.startswith("#") else f"# {line}" for line in lines)]
    return "\n".join(["", *lines, *unfit]) + "\n" if lines or unfit else ""


def _wrap_lines(table: pl.DataFrame, names: Words) -> list[str]:
    """The line that counts a distance on over the end of its counter."""
    if "distance_m" not in names:
        return []
    recorded = table[names["distance_m"]].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    wrap = wrap_of(recorded)
    if wrap is None:
        return []
    return [wrap.line if wrap.certain else f"# {wrap.line}  # if the counter begins anew there, and was not reset"]


def _fix_column(table: pl.DataFrame, words: Words) -> str | None:
    """The column of kinds of fix, where it holds this program's own words; codes of others need `fix_codes`."""
    name = first_fitting(words, WORDS["fix"])
    if name is None or table[name].dtype != pl.String:
        return None
    values = set(table[name].replace("", None).drop_nulls())
    return name if values and values <= {kind.value for kind in Fix} else None


def _read_lines(words: Words, file: str, time: tuple[list[str], float | None]) -> list[str]:
    """The mapping of balise reads; of a table that holds more, rows without a balise are no reads."""
    balise = first_fitting(words, WORDS["balise"])
    if balise is None:
        return []
    factors = [f"factors = {{ t = {time[1]:.10g} }}"] if time[1] else []
    fields = f"fields = {{ balise_id = {json.dumps(balise, ensure_ascii=False)} }}"
    lines = ["", "[[ingest.balise_reads]]", f"topic = {json.dumps(file, ensure_ascii=False)}", *time[0]]
    return ["\n".join([*lines, fields, *factors]) + "\n"]


def _unfit_lines(stream: Stream, table: pl.DataFrame, words: Words) -> list[str]:
    """What is left out though its name fits, since it holds texts."""
    lines = []
    for column, name in columns_in(stream, words).items():
        cells = table[name].cast(pl.String).replace("", None).drop_nulls()
        wrong = cells.filter(cells.cast(pl.Float64, strict=False).is_null())
        if len(wrong):
            reason = f"{one_line(name)!r} holds no number in {len(wrong)} rows, first {one_line(str(wrong[0]))!r}"
            lines.append(f"# {column}: left out, since {reason}")
    return lines


def _time_lines(table: pl.DataFrame, words: Words, units: Words) -> tuple[list[str], float | None]:
    """The lines on time, and the seconds per unit of the times where they are not seconds."""
    words = words_of_times(words)
    week = first_fitting(words, WORDS["week"])
    seconds = first_fitting(words, WORDS["seconds"])
    if week and seconds:
        milli = (unit_in(seconds) or units.get(seconds)) == "ms" or words[seconds] == "itow"
        return [_time_field_line(week, seconds), 'time_epoch = "gps"'], 1e-3 if milli else None
    date = first_fitting(words, WORDS["date"])
    clock = first_fitting(words, WORDS["clock"])
    names = [date, clock] if date and clock else [first_fitting(words, WORDS["time"]) or date]
    if names[0] is None:
        return ['# time = "field:COLUMN"  # no name shows which column is the time'], None
    written = [name for name in names if name]
    zones = [zone for name in written for part in (name, f"({units.get(name, '')})") if (zone := zone_in(part)[0])]
    if zones and (lines := _zone_lines(zones[0], written, table)):
        return lines, None
    if any("gpsepoch" in words[name] for name in written):
        return [_time_field_line(*written), 'time_epoch = "gps"', 'time_scale = "gps"'], _gps_unit_s(words[written[0]])
    epoch, scale = _epoch_lines(table[written[0]])
    gps = ['# time_scale = "gps"  # if these times are 18 s ahead of UTC'] if "gps" in words[written[-1]] else []
    return [_time_field_line(*written), *epoch, *_day_order_lines(table[written[0]]), *gps], scale


def _zone_lines(zone: str, names: Sequence[str], table: pl.DataFrame) -> list[str]:
    """The lines on times of a zone: with it where it is known for certain, else commented out."""
    known = zone if zone in known_zones() else None
    if offset := re.fullmatch(r"UTC([+-])0?([0-9]{1,2})(?::?00)?", zone):
        # The sign of these names is turned round: Etc/GMT-2 is ahead of UTC.
        known = f"Etc/GMT{'-' if offset[1] == '+' else '+'}{int(offset[2])}"
    if known in known_zones() and all(table[name].dtype == pl.String for name in names):
        return [_time_field_line(*names), f"time_zone = {json.dumps(known)}  # as the name says: {one_line(zone)}"]
    reason = f"# in {one_line(zone)!r}, which is not UTC as far as is known here"
    return [
        f"# {_time_field_line(*names)}  {reason}: add time_zone, as Europe/Berlin, or take these words away for UTC"
    ]


def _gps_unit_s(word: str) -> float | None:
    """Seconds per unit of what counts from 1980-01-06, as the name says."""
    return next((unit for name, unit in (("milli", 1e-3), ("ms", 1e-3), ("nano", 1e-9)) if word.startswith(name)), 1.0)


def _time_field_line(*names: str) -> str:
    """The line that names the columns of the time."""
    return f"time = {json.dumps('field:' + ' + '.join(names), ensure_ascii=False)}"


def _day_order_lines(column: pl.Series) -> list[str]:
    """The choice between day and month, where all dates fit both."""
    if column.dtype != pl.String:
        return []
    parts = column.str.extract_groups(r"^([0-9]{1,2})[-/.]([0-9]{1,2})[-/.][0-9]").struct.unnest().cast(pl.Int64)
    day_or_month = parts.to_series(0)
    if not day_is_unclear(day_or_month, parts.to_series(1)):
        return []
    return ['# date_order = "day_first"  # or "month_first": all dates of the file fit both, so you must say it']


def _epoch_lines(column: pl.Series) -> tuple[list[str], float | None]:
    """What numbers may count, by their size: a line, and the seconds per unit."""
    if not column.dtype.is_numeric() or column.drop_nulls().is_empty():
        return [], None
    least = float(column.min())  # type: ignore[arg-type]
    most = float(column.max())  # type: ignore[arg-type]
    if least >= LEAST_DAY and most <= MOST_DAY:
        return ['time_epoch = "excel"  # days since 1899-12-30'], None
    sizes = {1e-3: 1e12, 1e-6: 1e15}
    return [], next((unit for unit, size in sizes.items() if 0.5 * size < least and most < 4 * size), None)
