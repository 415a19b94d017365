"""What names and units of recorded fields show of a stream: the start of a mapping, to be checked."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any
from zoneinfo import available_timezones

from schemas.run import Stream

_FILE: dict[str, Any] = tomllib.loads((files("pipeline.read.ingest") / "guesses.toml").read_text(encoding="utf-8"))
COLUMNS: Mapping[Stream, Mapping[str, str]] = _FILE["columns"]
SURVEY: Mapping[str, str] = _FILE["survey"] | {
    name: COLUMNS["gnss"][name] for name in ("latitude_deg", "longitude_deg")
}
BALISE_LIST: Mapping[str, list[str]] = _FILE["balise_list"]
BALISE_KINDS: Mapping[str, str] = _FILE["balise_kinds"]
WORDS: Mapping[str, str] = _FILE["words"]
ZONES: Mapping[str, str] = _FILE["zones"]
UNITS: Mapping[str, float] = _FILE["units"]
POSITION = {"latitude_deg", "longitude_deg"}
_UNIT_NEEDED = ("distance_m", "speed_mps", "vel_e_mps", "vel_n_mps", "vel_u_mps", "height_m")
ORIGIN = (
    '# origin = "wheel"  # or radar, inertial, gnss, fused: where it comes from; while nobody says, it proves nothing'
)
_GEOID = "# height_m: only a height over the ellipsoid; one over the sea is another 20 to 60 m in Europe"


def one_line(text: str) -> str:
    """The text with every run of white space as one space."""
    return " ".join(text.split())


def word_of(name: str) -> str:
    """A name without unit, blanks and signs."""
    return re.sub(r"[^a-zäöüßàâçéèêëîïôûùąćęłńóśźż0-9]", "", re.sub(r"[\[(<].*", "", name).lower())


@cache
def known_zones() -> frozenset[str]:
    """The names of time zones that this computer knows."""
    return frozenset(available_timezones())


def zone_in(name: str) -> tuple[str | None, str]:
    """The zone that the name of a time tells, None for UTC and none, and the name without it.

    A zone is given by its name (`Europe/Berlin`), by an offset (`UTC+2`), by letters (`CEST`) or by a word (`local`).
    """
    places = set(re.findall(r"[A-Z][A-Za-z]+/[A-Z][A-Za-z_]+", name)) & known_zones()
    if place := next(iter(sorted(places)), None):
        return place, name.replace(place, "")
    if offset := re.search(r"(?:(?:utc|gmt)\s*|[\[(<]\s*)([+-]\s*[0-9]{1,2}(?::?[0-9]{2})?)", name, re.IGNORECASE):
        hours = re.sub(r"\s", "", offset[1])
        return (None if re.fullmatch(r"[+-][0:]+", hours) else f"UTC{hours}"), name.replace(offset[0], "")
    apart = re.sub(r"(?<=[a-ząćęłńóśźż])(?=[A-Z])", " ", name)
    words = re.findall(r"[^\W_]+", re.sub(r"(?i)(?<=local|lokal)(?=time|zeit)|(?<=orts)(?=zeit)", " ", apart))
    declared = [word for word in words if re.fullmatch(ZONES["local"] + "|orts", word.lower())]
    bracket = re.search(r"[\[(<]\s*([^\])>]*?)\s*[\])>]", name)
    if not declared and bracket and not all(re.fullmatch(ZONES["utc"], word) for word in _split_words(bracket[1])):
        return bracket[1], name.replace(bracket[0], "")
    return " ".join(declared) or None, " ".join(word for word in words if word not in declared) if declared else name


def words_of_times(names: Iterable[str]) -> dict[str, str]:
    """The words of names as `word_of`, without the zones that they tell: a name that tells nothing else is a time."""
    return {name: word_of(rest) or "zeit" * bool(zone) for name in names for zone, rest in (zone_in(name),)}


def _split_words(text: str) -> list[str]:
    """Words of a text in small letters."""
    return re.findall(r"[^\W_]+", text.lower())


def first_fitting(words: Mapping[str, str], pattern: str) -> str | None:
    """The first name whose word fits."""
    return next((name for name, word in words.items() if re.fullmatch(pattern, word)), None)


def columns_in(stream: Stream, words: Mapping[str, str]) -> dict[str, str]:
    """Stream column to recorded name."""
    return {column: name for column, pattern in COLUMNS[stream].items() if (name := first_fitting(words, pattern))}


def unit_in(name: str) -> str | None:
    """The unit in brackets, or at the end of a name."""
    patterns = (r"[\[(<]\s*([^\])>]+?)\s*[\])>]", r"[\s_](km/h|m/s|kmh|kph|mps|mph|km|mm|cm|m|ms|s|ft|kn|knots)$")
    written = re.sub(r"(?<=[a-z])(Kmh|Kph|Mps|Mph|Knots)$", r"_\1", name)
    found = next((match[1] for pattern in patterns if (match := re.search(pattern, written.lower()))), None)
    # A column that is called by its unit alone: kilometres.
    return "km" if found is None and word_of(name) == "km" else found


def mapping_lines(
    stream: Stream,
    topic: str,
    words: Mapping[str, str],
    time: list[str],
    scale: float | None,
    units: Mapping[str, str],
    texts: Mapping[str, str] | None = None,
) -> list[str]:
    """The lines of `[[ingest.STREAM]]`, none where the names do not show this stream.

    `time`: its lines, `scale`: seconds per unit of the times; `units`: those beside the names; `texts`: columns that
    hold no numbers.
    """
    names = columns_in(stream, words)
    if not names or (stream == "gnss" and not set(names) >= POSITION):
        return []
    factors = {"t": scale} if scale else {}
    remarks: list[str] = []
    for column in sorted(set(_UNIT_NEEDED) & set(names)):
        unit = unit_in(names[column]) or units.get(names[column]) or ""
        if unit not in UNITS:
            reason = f"{one_line(unit)!r} is not known" if unit else "is not given"
            remarks.append(f"# {column}: the unit {reason}; another one than of the name needs a factor")
        elif UNITS[unit] != 1.0:
            factors[column] = UNITS[unit]
    if stream == "gnss" and "height_m" not in names:
        remarks.append(_GEOID)
    fields = {**(texts or {}), **names}
    pairs = ", ".join(f"{column} = {json.dumps(name, ensure_ascii=False)}" for column, name in fields.items())
    listed = ", ".join(f"{column} = {factor:.10g}" for column, factor in factors.items())
    if stream == "odometer":
        remarks.append(ORIGIN)
    lines = [f"[[ingest.{stream}]]", f"topic = {json.dumps(topic, ensure_ascii=False)}", *time]
    return [*lines, f"fields = {{ {pairs} }}", *([f"factors = {{ {listed} }}"] if listed else []), *remarks]
