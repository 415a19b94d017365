"""Lines of GeoJSON: net elements with their relations; of OpenStreetMap the railways that trains run on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.make.survey.pieces import Survey, piece_of
from pipeline.read.site.geojson import (
    AXES_IN_DOUBT,
    AXES_REMEDY,
    coordinates_of,
    has_relations,
    latitude_first,
    properties_and_geometry,
    read_network,
)
from pipeline.read.site.read import to_wgs84
from schemas.config import SiteConfig
from schemas.errors import SiteError, listed

# https://wiki.openstreetmap.org/wiki/Key:railway: what a train can run on today.
_IN_USE = ("rail", "light_rail", "subway", "tram", "narrow_gauge", "preserved", "funicular", "monorail", "miniature")
_TRAM = "tram"
_CROSSINGS = ("railway_crossing", "tram_crossing_railway")
_IDS = ("@id", "id", "netelement_id", "osm_id", "full_id", "name")


Feature = tuple[dict[str, Any], Mapping[str, Any]]
"""Tags and GeoJSON geometry."""


def read_geojson(place: str, stem: str, data: bytes, config: SiteConfig, id_field: str | None = None) -> Survey:
    """Read each LineString as a piece named by its own id; of features with `railway` only those in use.

    A network that gives net relations (RailTopoModel, ERA RINF) is taken as it is, Overpass JSON like GeoJSON.
    `id_field`: property that names the lines. Raises `SiteError`.
    """
    try:
        document = json.loads(data)
        if "features" not in document and "elements" in document:
            return survey_of_features(place, stem, list(_overpass_features(place, document["elements"])), id_field)
        items = document["features"]
        if has_relations(items):
            return _network_survey(place, data, config)
        features = [_tags_and_geometry(item) for item in items]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        message = f"is not a GeoJSON FeatureCollection ({type(error).__name__}: {error})"
        raise SiteError(message, place=place, remedy="Overpass exports GeoJSON under Export.") from None
    survey = survey_of_features(place, stem, features, id_field)
    if latitude_first(document):
        survey.report("warning", f"{place}: crs", AXES_IN_DOUBT, AXES_REMEDY)
    return survey


def _overpass_features(place: str, elements: list[Any]) -> Iterator[Feature]:
    """Ways and tagged nodes of Overpass JSON; places of a way stand in its `geometry` (`out geom`) or in its nodes."""
    nodes = {item["id"]: [item["lon"], item["lat"]] for item in elements if item["type"] == "node"}
    for item in elements:
        tags = dict(item.get("tags") or {}) | {"@id": f"{item['type']}/{item['id']}"}
        if item["type"] == "node" and item.get("tags"):
            yield tags, {"type": "Point", "coordinates": nodes[item["id"]]}
        elif item["type"] == "way":
            if "geometry" in item:
                line = [[point["lon"], point["lat"]] for point in item["geometry"] if point is not None]
            elif all(node in nodes for node in item.get("nodes", ())):
                line = [nodes[node] for node in item.get("nodes", ())]
            else:
                remedy = "Ask Overpass for `out geom;`, or for `out body; >; out skel;`."
                raise SiteError("has ways without the places of their nodes", place=place, remedy=remedy)
            yield tags, {"type": "LineString", "coordinates": line}


def survey_of_features(place: str, stem: str, features: list[Feature], id_field: str | None = None) -> Survey:
    """A piece of each line, but railways that no train runs on; named by `id_field`, if any. Raises `SiteError`."""
    _require_field(place, features, id_field)
    ids = _IDS if id_field is None else (id_field,)
    survey = Survey()
    kinds = {_railway_kind(tags) for tags, geometry in features if next(_lines_of_geometry(geometry), None) is not None}
    railways = any(tags.get("railway") is not None for tags, _ in features)
    used = set(_IN_USE) - ({_TRAM} if "rail" in kinds else set())
    left_out: Counter[str] = Counter()
    for number, (tags, geometry) in enumerate(features):
        kind = _railway_kind(tags) if railways else "line"
        lines = list(_lines_of_geometry(geometry))
        if geometry.get("type") == "Point" and kind in (*_CROSSINGS, "switch"):
            longitude, latitude, _ = _coordinates(f"{place}: feature {number}", geometry.get("coordinates"))
            (survey.switches_deg if kind == "switch" else survey.crossings_deg).append((latitude, longitude))
        elif lines and (not railways or kind in used):
            name = next((str(tags[key]).strip() for key in ids if tags.get(key) not in (None, "")), stem)
            survey.pieces += [_line_piece(f"{place}: feature {number}", name, line) for line in lines]
        elif lines:
            left_out[kind] += 1
    for kind, count in sorted(left_out.items()):
        reason = "the railway beside them is another network" if kind == _TRAM else "no train runs there"
        remedy = "Where trains use them, give them as a file of their own." if kind == _TRAM else ""
        survey.report("note", place, f"{count} lines with railway={kind} are left out: {reason}", remedy)
    return survey


def _network_survey(place: str, data: bytes, config: SiteConfig) -> Survey:
    """Net elements whole, with the relations that the network gives between their ends."""
    breaches: list[str] = []
    network = read_network(place, data, breaches)
    if network is None or breaches:
        raise SiteError(listed(breaches), remedy="Correct these features of the network.")
    points = to_wgs84(network.track, network.track.frame, config, breaches)
    if breaches:
        raise SiteError(listed(breaches))
    survey = Survey(declared_m=network.declared_length_m)
    for (name,), part in points.group_by("netelement_id", maintain_order=True):
        survey.pieces.append(piece_of(place, str(name), part.drop("netelement_id").to_dict(), whole=True))
    if network.links is not None:
        survey.relations += network.links.frame.rows()
    if network.latitude_first:
        survey.report("warning", f"{place}: crs", AXES_IN_DOUBT, AXES_REMEDY)
    if network.ignored:
        text = f"{network.ignored} features are not used: they are neither net element nor relation"
        survey.report("note", place, text)
    return survey


def _require_field(place: str, features: list[Feature], id_field: str | None) -> None:
    """Refuse an attribute for names that no feature has."""
    if id_field is None or any(id_field in tags for tags, _ in features):
        return
    known = sorted({key for tags, _ in features for key in tags})
    raise SiteError("has no such attribute", place=f"{place}: --id {id_field}", expected=f"one of {', '.join(known)}")


def _railway_kind(tags: Mapping[str, Any]) -> str:
    """The value of `railway`; a railway out of use may have a tag of its own for that."""
    return next((key for key in ("disused", "abandoned") if tags.get(key) == "yes"), str(tags.get("railway")))


def _tags_and_geometry(item: Any) -> Feature:
    """Tags and geometry; some programs put tags into a property of their own."""
    properties, geometry = properties_and_geometry(item)
    nested = properties.get("tags")
    tags = dict(properties) | (dict(nested) if isinstance(nested, Mapping) else {})
    if item.get("id") not in (None, ""):
        tags["@id"] = item["id"]
    return tags, geometry


def _lines_of_geometry(geometry: Mapping[str, Any]) -> Iterator[Any]:
    """Lines of a geometry."""
    coordinates = geometry.get("coordinates")
    if geometry.get("type") == "LineString":
        yield coordinates
    elif geometry.get("type") == "MultiLineString" and isinstance(coordinates, list):
        yield from coordinates


def _line_piece(place: str, name: str, line: Any) -> Any:
    """A piece of track from the coordinates of a line."""
    if not isinstance(line, list):
        raise SiteError("coordinates are no list", place=place)
    triples = [_coordinates(place, point) for point in line]
    longitude, latitude, height = zip(*triples, strict=True) if triples else ((), (), ())
    return piece_of(place, name, {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height})


def _coordinates(place: str, point: Any) -> tuple[float, float, float | None]:
    """Longitude, latitude and height of a point."""
    try:
        return coordinates_of(point)
    except ValueError:
        raise SiteError(
            "a coordinate cannot be read", place=place, found=repr(point)[:60], expected="[longitude, latitude]"
        ) from None
