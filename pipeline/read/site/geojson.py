"""RailTopoModel networks as GeoJSON: net elements are LineStrings, net relations join their ends.

Read as ERA RINF exports and measurement-train networks write it: an element carries `id` or `netelement_id`, and
`sigma_m` where its survey states one; a relation carries `netelementA`, `positionOnA`, `netelementB`, `positionOnB`
and `navigability`, or in the words of the ERA vocabulary `elementA`, `isOnOriginOfElementA` and so on, of railML
`elementA = {"ref": ...}`. Case, underscores and prefixes (`era:`) of property names do not matter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from pipeline.read.site.tables import EPSG_WGS84, RawTable
from schemas.enums import Navigability

_MALFORMED = (KeyError, TypeError, ValueError, LookupError, OverflowError, RecursionError)
_ID_KEYS = ("netelementid", "id", "elementid", "name")
_LENGTH_KEYS = ("lengthm", "length")
_A_KEYS, _B_KEYS = (
    tuple(
        name.format(side) for name in ("netelement{}", "element{}", "netelement{}id", "element{}id", "netelementid{}")
    )
    for side in "ab"
)
_START = ("0", "0.0", "start", "begin", "origin")
_END = ("1", "1.0", "end")
_POSITIONS_A = (("positionona", "positiona"), "isonoriginofelementa")
_POSITIONS_B = (("positiononb", "positionb"), "isonoriginofelementb")


_TRACK_COLUMNS = {
    "netelement_id": pl.String,
    **dict.fromkeys(("longitude_deg", "latitude_deg", "height_m", "sigma_m"), pl.Float64),
}
_LINK_COLUMNS = {
    "netelement_a": pl.String,
    "position_a": pl.Int64,
    "netelement_b": pl.String,
    "position_b": pl.Int64,
    "navigability": pl.String,
}


AXES_IN_DOUBT = (
    "the coordinate system that it names has the latitude first; read all the same as GeoJSON has them, longitude first"
)
AXES_REMEDY = "Look at a map whether the track lies where it is, and exchange the axes if not; name no crs."


@dataclass
class GeoJsonNetwork:
    """What one GeoJSON file holds; `declared_length_m` where elements state their length, `latitude_first`: its crs."""

    track: RawTable
    links: RawTable | None
    declared_length_m: dict[str, float]
    ignored: int
    latitude_first: bool = False


def read_network(file: str, data: bytes, breaches: list[str]) -> GeoJsonNetwork | None:
    """Net elements and net relations of a FeatureCollection, or breaches."""
    try:
        document = json.loads(data)
        features = list(document["features"])
        epsg = _epsg_of(document)
    except _MALFORMED as error:
        breaches.append(f"{file}: is not a GeoJSON FeatureCollection ({error})")
        return None
    network = _network_of_features(file, features, epsg, breaches)
    network.latitude_first = latitude_first(document)
    return network


def latitude_first(document: Mapping[str, Any]) -> bool:
    """Whether a document names WGS 84 by an address of EPSG, with the latitude first; GeoJSON has longitude first."""
    return bool(re.search(r"urn:.*EPSG.*4326|/EPSG/.*4326", json.dumps(document.get("crs")), re.IGNORECASE))


def has_relations(features: Iterable[Any]) -> bool:
    """Whether net relations come with the lines: a network that says where trains can run. Raises `ValueError`."""
    return any(_is_relation(_normalised_keys(None, properties_and_geometry(feature)[0])) for feature in features)


def _is_relation(keys: Mapping[str, Any]) -> bool:
    """Whether a feature links net elements."""
    return any(key in keys for key in (*_A_KEYS, *_B_KEYS))


def _network_of_features(file: str, features: list[Any], epsg: int, breaches: list[str]) -> GeoJsonNetwork:
    """Net elements and links of features."""
    points: list[tuple[Any, ...]] = []
    relations: list[tuple[Any, ...]] = []
    lengths: dict[str, float] = {}
    ignored = 0
    for number, feature in enumerate(features):
        try:
            properties, geometry = properties_and_geometry(feature)
            keys = _normalised_keys(feature.get("id"), properties)
            if _is_relation(keys):
                relations.append(_relation_row(keys))
            elif geometry.get("type") in ("LineString", "MultiLineString"):
                points += _element_points(geometry, keys, lengths)
            else:
                ignored += 1
        except _MALFORMED as error:
            breaches.append(f"{file}: feature {number}: {error}")
    track = RawTable(file, pl.DataFrame(points, schema=_TRACK_COLUMNS, orient="row"), epsg)
    links = RawTable(file, pl.DataFrame(relations, schema=_LINK_COLUMNS, orient="row")) if relations else None
    return GeoJsonNetwork(track, links, lengths, ignored)


def properties_and_geometry(feature: Any) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Properties and geometry of a feature, empty where it has none. Raises `ValueError`."""
    names = ("properties", "geometry")
    members = [(feature.get(name) or {}) if isinstance(feature, Mapping) else None for name in names]
    if not all(isinstance(part, Mapping) for part in members):
        raise ValueError("a feature is no object with properties and a geometry")
    return members[0], members[1]  # type: ignore[return-value]


def coordinates_of(point: Any) -> tuple[float, float, float | None]:
    """Longitude, latitude and height (none where there is none). Raises `ValueError`."""
    try:
        longitude, latitude, *height = point
        height_m = number_of(height[0]) if height and height[0] is not None else None
        return number_of(longitude), number_of(latitude), height_m
    except _MALFORMED:
        raise ValueError("coordinates are not numbers [longitude, latitude(, height)]") from None


def number_of(value: Any) -> float:
    """A coordinate, as a number or text; `1_0` and digits of other scripts are typing errors. Raises `ValueError`."""
    if isinstance(value, str) and ("_" in value or not value.isascii()):
        raise ValueError(value)
    return float(value)


def _normalised_keys(own_id: Any, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Properties by lower-case name without underscores; the feature's own `id` where they have none."""
    keys = {re.sub(r"^\w+:|[_\-\s]", "", str(key)).lower(): value for key, value in properties.items()}
    return keys if own_id is None else {"id": own_id, **keys}


def _first_value(keys: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """The first of several keys that a feature has."""
    return next((keys[name] for name in names if keys.get(name) is not None), None)


def _element_points(
    geometry: Mapping[str, Any], keys: Mapping[str, Any], lengths: dict[str, float]
) -> list[tuple[Any, ...]]:
    """The points of a net element; its declared length goes into `lengths`, NaN where it states none."""
    name = _first_value(keys, _ID_KEYS)
    if name is None:
        raise ValueError("a LineString without property id or netelement_id")
    if str(name) in lengths:
        raise ValueError(f"net element {name} occurs twice in the file")
    lines = [geometry.get("coordinates") or []]
    if geometry["type"] == "MultiLineString":
        lines = lines[0]
        if len(lines) != 1:
            raise ValueError(f"{name}: MultiLineString of {len(lines)} parts; a net element is one line")
    if not isinstance(lines[0], list):
        raise ValueError(f"{name}: coordinates are not a list of points")
    declared = _first_value(keys, _LENGTH_KEYS)
    declared_m = _metres_or_none(declared) if isinstance(declared, int | float) else None
    sigma_m = _metres_or_none(keys.get("sigmam"))
    points = [(str(name), *coordinates_of(point), sigma_m) for point in lines[0]]
    lengths[str(name)] = float("nan") if declared_m is None else declared_m
    return points


def _metres_or_none(value: Any) -> float | None:
    """A number of metres, if it is one."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 2**1023:
        # Python does not even write integers of 4,300 digits.
        large = isinstance(value, int) and value.bit_length() > 1024
        raise ValueError(f"{'a very large integer' if large else repr(value)[:80]}; expected a number of metres")
    return float(value)


def _relation_row(keys: Mapping[str, Any]) -> tuple[Any, ...]:
    """A link of two net elements."""
    ends = [_referred_id(_first_value(keys, names)) for names in (_A_KEYS, _B_KEYS)]
    positions = [_end_position(keys, names, origin) for names, origin in (_POSITIONS_A, _POSITIONS_B)]
    # Vocabularies give the word as the last part of an address.
    written = keys.get("navigability")
    word = "" if written is None else re.split("[/#]", str(written).strip().lower())[-1]
    known = {member.value.lower(): member.value for member in Navigability}
    if word not in known:
        raise ValueError(f"navigability {word or written!r}; expected one of {', '.join(Navigability)}")
    if None in positions:
        on_a, on_b = (_first_value(keys, names) for names, _ in (_POSITIONS_A, _POSITIONS_B))
        raise ValueError(f"positionOnA {on_a!r}, positionOnB {on_b!r}; expected 0 or 1 (start or end)")
    if None in ends:
        raise ValueError(f"netelementA {ends[0]!r}, netelementB {ends[1]!r}; a relation joins two elements")
    return str(ends[0]), positions[0], str(ends[1]), positions[1], known[word]


def _end_position(keys: Mapping[str, Any], names: tuple[str, ...], origin: str) -> int | None:
    """End 0 or 1 of an element, or whether it is its origin (ERA vocabulary); none where neither is said."""
    written = _first_value(keys, names)
    at_origin = keys.get(origin)
    if written is None and isinstance(at_origin, bool):
        return 0 if at_origin else 1
    word = str(written).strip().lower()
    return 0 if word in _START else 1 if word in _END else None


def _referred_id(element: Any) -> Any:
    """The identity of an element that a relation names, itself or by reference."""
    if isinstance(element, Mapping):
        element = _first_value(_normalised_keys(None, element), ("ref", *_ID_KEYS))
    return element


def _epsg_of(document: Mapping[str, Any]) -> int:
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
