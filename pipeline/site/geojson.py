"""RailTopoModel networks as GeoJSON: net elements are LineStrings, net relations join their ends.

Read as ERA RINF exports and measurement-train networks write it: an element carries `id` or `netelement_id`, and
`sigma_m` where its survey states one; a relation carries `netelementA`, `positionOnA`, `netelementB`, `positionOnB`
and `navigability`, or in the words of the ERA vocabulary `elementA`, `isOnOriginOfElementA` and so on. Case and
underscores of property names do not matter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from pipeline.site.tables import EPSG_WGS84, RawTable
from schemas.enums import Navigability

_ID_KEYS = ("netelementid", "id", "elementid", "name")
_LENGTH_KEYS = ("lengthm", "length")
_A_KEYS, _B_KEYS = ("netelementa", "elementa"), ("netelementb", "elementb")
_POSITIONS_A = (("positionona", "positiona"), "isonoriginofelementa")
_POSITIONS_B = (("positiononb", "positionb"), "isonoriginofelementb")


@dataclass
class Network:
    """What one GeoJSON file holds; `declared_length_m` where elements state their length."""

    track: RawTable
    links: RawTable | None
    declared_length_m: dict[str, float] = field(default_factory=dict)
    ignored: int = 0


def read_network(file: str, data: bytes, breaches: list[str]) -> Network | None:
    """Net elements and net relations of a FeatureCollection, or breaches."""
    try:
        document = json.loads(data)
        features, epsg = list(document["features"]), _epsg(document)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        breaches.append(f"{file}: is not a GeoJSON FeatureCollection ({error})")
        return None
    points: dict[str, list[Any]] = {name: [] for name in _TRACK_COLUMNS}
    relations: dict[str, list[Any]] = {name: [] for name in _LINK_COLUMNS}
    lengths: dict[str, float] = {}
    ignored = 0
    for number, feature in enumerate(features):
        place = f"{file}: feature {number}"
        geometry = _part(feature, "geometry")
        keys = _plain_keys(feature)
        if geometry is None or keys is None:
            breaches.append(f"{place}: not a feature with properties and a geometry")
        elif any(key in keys for key in _A_KEYS):
            _add_relation(place, keys, relations, breaches)
        elif geometry.get("type") in ("LineString", "MultiLineString"):
            _add_element(place, geometry, keys, points, lengths, breaches)
        else:
            ignored += 1
    track = RawTable(file, pl.DataFrame(points, schema=_TRACK_COLUMNS), epsg)
    links = RawTable(file, pl.DataFrame(relations, schema=_LINK_COLUMNS)) if relations["netelement_a"] else None
    return Network(track, links, lengths, ignored)


def _part(feature: Any, name: str) -> Mapping[str, Any] | None:
    """The geometry or properties of a feature, empty where it has none; none where that is no object."""
    found = (feature.get(name) or {}) if isinstance(feature, Mapping) else None
    return found if isinstance(found, Mapping) else None


_TRACK_COLUMNS = {
    "netelement_id": pl.String,
    "latitude_deg": pl.Float64,
    "longitude_deg": pl.Float64,
    "height_m": pl.Float64,
    "sigma_m": pl.Float64,
}
_LINK_COLUMNS = {
    "netelement_a": pl.String,
    "position_a": pl.Int64,
    "netelement_b": pl.String,
    "position_b": pl.Int64,
    "navigability": pl.String,
}


def _plain_keys(feature: Any) -> dict[str, Any] | None:
    """Properties by lower-case name without underscores; the feature's own `id` where they have none."""
    properties = _part(feature, "properties")
    if properties is None:
        return None
    keys = {re.sub(r"[_\-\s]", "", str(key)).lower(): value for key, value in properties.items()}
    if feature.get("id") is not None:
        keys.setdefault("id", feature["id"])
    return keys


def _first(keys: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((keys[name] for name in names if keys.get(name) is not None), None)


def _add_element(
    place: str,
    geometry: Mapping[str, Any],
    keys: Mapping[str, Any],
    points: dict[str, list[Any]],
    lengths: dict[str, float],
    breaches: list[str],
) -> None:
    name = _first(keys, _ID_KEYS)
    if name is None:
        breaches.append(f"{place}: a LineString without property id or netelement_id")
        return
    try:
        triples = [_triple(point) for point in _axis(geometry)]
        sigma_m, declared = _metres(keys.get("sigmam")), _first(keys, _LENGTH_KEYS)
        declared_m = _metres(declared) if isinstance(declared, int | float) else None
    except (TypeError, ValueError, LookupError, OverflowError) as error:
        breaches.append(f"{place} ({str(name)[:80]}): {error}")
        return
    if str(name) in lengths:
        breaches.append(f"{place}: net element {name} occurs twice in the file")
        return
    lengths[str(name)] = float("nan") if declared_m is None else declared_m
    points["netelement_id"] += [str(name)] * len(triples)
    points["sigma_m"] += [sigma_m] * len(triples)
    for column, part in (("longitude_deg", 0), ("latitude_deg", 1), ("height_m", 2)):
        points[column] += [triple[part] for triple in triples]


def _axis(geometry: Mapping[str, Any]) -> list[Any]:
    """The points of a line."""
    coordinates = geometry.get("coordinates") or []
    if not isinstance(coordinates, list):
        raise ValueError("coordinates are not a list of points")
    if geometry["type"] == "MultiLineString":
        if len(coordinates) != 1:
            raise ValueError(f"MultiLineString of {len(coordinates)} parts; a net element is one line")
        return list(coordinates[0])
    return coordinates


def _triple(point: Any) -> tuple[float, float, float | None]:
    """Longitude, latitude and height."""
    try:
        return float(point[0]), float(point[1]), float(point[2]) if len(point) > 2 else None
    except (TypeError, ValueError, LookupError, OverflowError):
        raise ValueError("coordinates are not numbers [longitude, latitude(, height)]") from None


def _shown(value: Any) -> str:
    """The value, shortened (Python does not even write integers of 4,300 digits)."""
    return "a very large integer" if isinstance(value, int) and value.bit_length() > 1024 else repr(value)[:80]


def _metres(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 2**1023:
        raise ValueError(f"{_shown(value)}; expected a number of metres")
    return float(value)


def _add_relation(place: str, keys: Mapping[str, Any], relations: dict[str, list[Any]], breaches: list[str]) -> None:
    ends = [_first(keys, _A_KEYS), _first(keys, _B_KEYS)]
    positions = [_position(keys, names, origin) for names, origin in (_POSITIONS_A, _POSITIONS_B)]
    # Vocabularies give the word as the last part of an address.
    word = re.split("[/#]", str(keys.get("navigability")).strip().lower())[-1]
    known = {member.value.lower(): member.value for member in Navigability}
    if word not in known:
        breaches.append(f"{place}: navigability {word!r}; expected one of {', '.join(Navigability)}")
    elif None in positions:
        found = [_first(keys, names) for names, _ in (_POSITIONS_A, _POSITIONS_B)]
        breaches.append(f"{place}: positionOnA {found[0]!r}, positionOnB {found[1]!r}; expected 0 or 1")
    elif None in ends:
        breaches.append(f"{place}: netelementA {ends[0]!r}, netelementB {ends[1]!r}; a relation joins two elements")
    else:
        row = (str(ends[0]), positions[0], str(ends[1]), positions[1], known[word])
        for column, value in zip(_LINK_COLUMNS, row, strict=True):
            relations[column].append(value)


def _position(keys: Mapping[str, Any], names: tuple[str, ...], origin: str) -> int | None:
    """End 0 or 1 of an element, or whether it is its origin (ERA vocabulary); none where neither is said."""
    said, at_origin = _first(keys, names), keys.get(origin)
    if said is None and isinstance(at_origin, bool):
        return 0 if at_origin else 1
    return {"0": 0, "1": 1, "0.0": 0, "1.0": 1}.get(str(said))


def _epsg(document: Mapping[str, Any]) -> int:
    """EPSG code of the `crs` member (GeoJSON 2008), WGS 84 without one (RFC 7946)."""
    crs = document.get("crs")
    if crs is None:
        return int(document.get("epsg") or EPSG_WGS84)
    properties = crs.get("properties") if isinstance(crs, Mapping) else {"name": crs}
    named = properties if isinstance(properties, Mapping) else {}
    name = str(named.get("name", named.get("code", "")))
    if name.upper().endswith("CRS84"):
        return EPSG_WGS84
    code = re.search(r"(\d+)$", name)
    if code is None:
        raise ValueError(f"crs {name!r}: expected a name such as urn:ogc:def:crs:EPSG::31370")
    return int(code.group(1))
