"""What names and units of recorded fields tell of a stream: the start of a mapping, to be checked."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from schemas.run import Stream

_POSITION = {"latitude_deg", "longitude_deg"}
# Names by column of a stream, without their units; the first that fits.
NAMES: dict[Stream, dict[str, str]] = {
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
UNITS = {
    "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600,
    "knots": 1852 / 3600, "mm/s": 1e-3, "cm/s": 1e-2, "m": 1.0, "km": 1000.0, "mm": 1e-3, "cm": 1e-2, "ft": 0.3048,
    "mi": 1609.344,
}  # fmt: skip
_UNIT_NEEDED = ("distance_m", "speed_mps", "vel_e_mps", "vel_n_mps", "vel_u_mps", "height_m")


def one_line(text: str) -> str:
    return " ".join(text.split())


def word_of(name: str) -> str:
    """A name without unit, blanks and signs."""
    return re.sub(r"[^a-zäöüß0-9]", "", re.sub(r"[\[(<].*", "", name).lower())


def first(words: Mapping[str, str], pattern: str) -> str | None:
    """The first name whose word fits."""
    return next((name for name, word in words.items() if re.fullmatch(pattern, word)), None)


def columns_in(stream: Stream, words: Mapping[str, str]) -> dict[str, str]:
    """Stream column to recorded name."""
    return {column: name for column, pattern in NAMES[stream].items() if (name := first(words, pattern))}


def unit_in(name: str) -> str | None:
    """The unit in brackets, or at the end of a name."""
    told = re.search(r"[\[(<]\s*([^\])>]+?)\s*[\])>]", name) or re.search(
        r"_(kmh|kph|mps|mph|km|mm|cm|m|ms|s|ft|kn|knots)$", name.lower()
    )
    return told[1].lower() if told else None


def mapping_lines(
    stream: Stream,
    topic: str,
    words: Mapping[str, str],
    time: list[str],
    scale: float | None,
    units: Mapping[str, str],
    texts: Mapping[str, str] | None = None,
) -> list[str]:
    """The lines of `[[ingest.STREAM]]`, none where the names do not tell of this stream.

    `time`: its lines, `scale`: seconds per unit of the times; `units`: those told beside the names;
    `texts`: columns that hold no numbers.
    """
    found = columns_in(stream, words)
    if not found or (stream == "gnss" and not set(found) >= _POSITION):
        return []
    factors = {"t": scale} if scale else {}
    remarks: list[str] = []
    for column in sorted(set(_UNIT_NEEDED) & set(found)):
        unit = unit_in(found[column]) or units.get(found[column])
        if unit not in UNITS:
            told = "is not told" if unit is None else f"{one_line(unit)!r} is not known"
            remarks.append(f"# {column}: the unit {told}; another one than of the name needs a factor")
        elif UNITS[unit] != 1.0:
            factors[column] = UNITS[unit]
    if stream == "gnss" and "height_m" not in found:
        remarks.append("# height_m: only a height over the ellipsoid; one over the sea is another 20 to 60 m in Europe")
    fields = {**(texts or {}), **found}
    pairs = ", ".join(f"{column} = {json.dumps(name, ensure_ascii=False)}" for column, name in fields.items())
    listed = ", ".join(f"{column} = {factor:.10g}" for column, factor in factors.items())
    lines = [f"[[ingest.{stream}]]", f"topic = {json.dumps(topic, ensure_ascii=False)}", *time]
    return [*lines, f"fields = {{ {pairs} }}", *([f"factors = {{ {listed} }}"] if listed else []), *remarks]
