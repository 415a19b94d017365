"""A site folder to its tables in WGS 84: track, links, balises, route, and what is remarkable in them."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pipeline.read.site.checks import check_site, drop_repeated_points, drop_scattered_points
from pipeline.read.site.geojson import AXES_IN_DOUBT, AXES_REMEDY, GeoJsonNetwork, read_network
from pipeline.read.site.route import route_table
from pipeline.read.site.tables import EPSG_WGS84, RawTable, load_table, typed_table
from pipeline.stages.track.network import surveyed_track
from pipeline.stages.track.survey import SurveyedTrack, sort_by_element, track_of
from pipeline.storage.address import is_geojson, join, shown
from pipeline.storage.files import is_dir, list_dir, read_bytes
from pipeline.storage.parquet import without_checksums
from schemas.config import SiteConfig
from schemas.conform import conform
from schemas.errors import InputError, SiteError, listed
from schemas.inputs import Balises, Links, Route, Track
from schemas.run import Finding, Site

_NAMES = ("track", "links", "balises", "route")
_SUFFIXES = {"track": (".parquet", ".csv", ".geojson"), "links": (".parquet", ".csv")}
_TABLES = (".parquet", ".csv")
# GeoJSON and PROJ know these as longitude and latitude on (nearly) the ellipsoid of WGS 84.
_SAME_AS_WGS84 = (EPSG_WGS84, 4979)
_DEFAULTS = SiteConfig()


def read_site(path: Path | str, config: SiteConfig = _DEFAULTS) -> Site:
    """Read the site of a folder or of one GeoJSON file with track and links, positions in WGS 84.

    `track` is Parquet, CSV or RailTopoModel GeoJSON; each file may name its EPSG code: Parquet in its key-value
    metadata (`epsg`), CSV in a comment line (`# epsg: 31370`), both in a column `epsg`, GeoJSON in its `crs` member. In
    a projected system `longitude_deg` holds the easting and `latitude_deg` the northing, or the columns are named `x_m`
    and `y_m`. Heights are taken as they are (ellipsoidal). `measure_m` empty for a whole element: its geometric length.
    A route's `direction` is AB, growing or forward (from the element's start to its end), or BA, falling or reverse.

    Args:
        path: the folder, or the GeoJSON file; local or `s3://`-style.
        config: the section `site` of the configuration: limits of its checks [m].

    Returns:
        Track, links, balises and route; what is merely remarkable is in `Site.findings`.

    Raises:
        SiteError: the site breaches the contract; all breaches at once.

    Source:
        CONTRACT section 2.
    """
    files = _site_files(path)
    breaches: list[str] = []
    survey, network, notes = _read_track(files, config, breaches)
    links = _read_links(files, network, breaches)
    raw = _load_file(files, "balises", breaches)
    balises = None if raw is None else typed_table(raw, "balises", breaches)
    name = next((name for name in files if name.startswith("route.")), None)
    route = None if name is None else route_table(name, files[name], breaches)
    route = None if route is None else route.drop("leg")  # that of every run over this site, in one piece
    if breaches or survey is None or links is None:
        raise _site_error(path, breaches)
    table, track = survey
    lengths = network.declared_length_m if network else {}
    unchecked = [name for name, data in files.items() if name.endswith(".parquet") and without_checksums(data)]
    notes += [Finding("note", name, "has no page checksums: damage to it may not be seen") for name in unchecked]
    if _is_unrelated(track.ids, links, files):
        notes.append(Finding("warning", "links", _UNRELATED, _MAKE_A_SITE))
    found = check_site(track, links, balises, route, lengths, config)
    if found.breaches:
        raise _site_error(path, found.breaches)
    site = Site(
        track=conform(table, Track),
        links=conform(found.links, Links),
        balises=None if balises is None else conform(balises, Balises),
        route=None if route is None else conform(route, Route),
        findings=tuple(notes + found.findings),
        digest=_digest(files),
        files=tuple((name, len(data), hashlib.sha256(data).hexdigest()) for name, data in sorted(files.items())),
    )
    surveyed_track.keep(site, track)
    return site


def refuse_unrelated(site: Site, place: Path | str) -> None:
    """A replay on lines that nothing joins finds the train on none of them for long. Raises `SiteError`."""
    names = [name for name, _, _ in site.files]
    if _is_unrelated(surveyed_track(site).ids, site.links, names):
        raise SiteError(_UNRELATED, place=shown(place), remedy=_MAKE_A_SITE)


_UNRELATED = "the GeoJSON has lines but no net relations: no train gets from one of them to another"
_MAKE_A_SITE = "Make a site of it: `balise site FILE --out SITE` joins lines where they meet."


def _is_unrelated(elements: Sequence[str], links: pl.DataFrame, files: Collection[str]) -> bool:
    """Several lines of GeoJSON that say nothing of how they meet; tables of a site say it by an empty one too."""
    only_lines = not any(name.startswith("links.") for name in files) and "track.geojson" in files
    return only_lines and links.is_empty() and len(elements) > 1


def _site_files(folder: Path | str) -> dict[str, bytes]:
    """The site's files by name; of each table there is at most one. A GeoJSON file is a site's only one."""
    names = [table + suffix for table in _NAMES for suffix in _SUFFIXES.get(table, _TABLES)]
    try:
        if is_geojson(folder) and not is_dir(folder):
            return {"track.geojson": read_bytes(folder)}
        if not is_dir(folder):
            raise SiteError("is not a folder", place=shown(folder), remedy="A site is a folder that holds a track.")
        present = [name for name in list_dir(folder) if name in names]
        for table in _NAMES:
            same = [name for name in present if name.startswith(f"{table}.")]
            if len(same) > 1:
                raise SiteError(f"{' and '.join(same)}: only one may be there", place=shown(folder))
        if not any(name.startswith("track.") for name in present):
            expected = "track.parquet, track.csv or track.geojson"
            raise SiteError("has no track", place=shown(folder), expected=expected)
        return {name: read_bytes(join(folder, name)) for name in present}
    except InputError as error:
        raise SiteError(error.message, place=error.place, expected=error.expected, remedy=error.remedy) from None


def _digest(files: dict[str, bytes]) -> str:
    """SHA-256 over names and contents."""
    parts = [f"{name} {hashlib.sha256(data).hexdigest()}\n" for name, data in sorted(files.items())]
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def _site_error(path: Path | str, breaches: list[str]) -> SiteError:
    """The error for a site with all that is wrong with it."""
    remedy = "Correct what is named; `balise dictionary` lists the columns of a site."
    remedy = f"Correct what is named. {_MAKE_A_SITE}" if is_geojson(path) else remedy
    return SiteError(listed(breaches), place=shown(path), remedy=remedy)


def _load_file(files: dict[str, bytes], table: str, breaches: list[str]) -> RawTable | None:
    """A table of a site, if there is a file of it."""
    name = next((name for name in files if name.startswith(f"{table}.")), None)
    return None if name is None else load_table(name, files[name], breaches)


def _read_track(
    files: dict[str, bytes], config: SiteConfig, breaches: list[str]
) -> tuple[tuple[pl.DataFrame, SurveyedTrack] | None, GeoJsonNetwork | None, list[Finding]]:
    """The track as a table and as arrays, the rest of a GeoJSON file, findings."""
    network: GeoJsonNetwork | None = None
    if "track.geojson" in files:
        network = read_network("track.geojson", files["track.geojson"], breaches)
        raw = network.track if network else None
    else:
        raw = _load_file(files, "track", breaches)
    frame = typed_table(_named_by_contract(raw), "track", breaches) if raw is not None else None
    if raw is None or frame is None:
        return None, network, []
    if frame.is_empty():
        breaches.append(f"{raw.file}: has no points of net elements")
        return None, network, []
    frame = sort_by_element(to_wgs84(raw, frame, config, breaches))
    frame, notes = drop_repeated_points(raw.file, frame, breaches)
    frame, scattered = drop_scattered_points(raw.file, frame)
    notes += scattered
    if network and network.latitude_first:
        notes.append(Finding("warning", f"{raw.file}: crs", AXES_IN_DOUBT, AXES_REMEDY))
    if network and network.ignored:
        text = f"{network.ignored} features are not used: they are neither net element nor relation"
        notes.append(Finding("note", raw.file, text))
    return (None if breaches else _with_measures(raw.file, frame, breaches)), network, notes


def _read_links(files: dict[str, bytes], network: GeoJsonNetwork | None, breaches: list[str]) -> pl.DataFrame | None:
    """Links from their own table, else from the GeoJSON; a site of one element needs none."""
    raw = _load_file(files, "links", breaches)
    if raw is None and network is not None:
        raw = network.links
    if raw is None:
        return Links.create_empty()
    return typed_table(raw, "links", breaches)


def _named_by_contract(raw: RawTable) -> RawTable:
    """Plane coordinates `x_m`, `y_m` under the names of the contract; `to_wgs84` makes degrees of them later."""
    names = {"x_m": "longitude_deg", "y_m": "latitude_deg"}
    given = {old: new for old, new in names.items() if old in raw.frame.columns}
    if any(new in raw.frame.columns for new in given.values()):
        return raw
    return RawTable(raw.file, raw.frame.rename(given), raw.epsg)


def to_wgs84(raw: RawTable, frame: pl.DataFrame, config: SiteConfig, breaches: list[str]) -> pl.DataFrame:
    """Positions in WGS 84, checked for range."""
    if raw.epsg not in _SAME_AS_WGS84:
        frame = _transform_to_degrees(raw, frame, config, breaches)
    outside = (frame["latitude_deg"].abs() > 90) | (frame["longitude_deg"].abs() > 180)
    if outside.any():
        row = frame.filter(outside).row(0, named=True)
        breaches.append(
            f"{raw.file}: latitude {row['latitude_deg']:g}, longitude {row['longitude_deg']:g} in EPSG:{raw.epsg} "
            "is not a place on earth; latitude and longitude may be swapped, or the file does not name its EPSG code "
            "(a column or Parquet metadata `epsg`, a first line `# epsg: 31370` of CSV, `crs` of GeoJSON)"
        )
    return frame


def _transform_to_degrees(raw: RawTable, frame: pl.DataFrame, config: SiteConfig, breaches: list[str]) -> pl.DataFrame:
    """A table with coordinates in degrees, of projected ones."""
    import pyproj

    try:
        turn = pyproj.Transformer.from_crs(raw.epsg, EPSG_WGS84, always_xy=True)
        x = frame["longitude_deg"].to_numpy()
        y = frame["latitude_deg"].to_numpy()
        longitude, latitude = turn.transform(x, y, errcheck=True)
    except pyproj.exceptions.ProjError as error:
        breaches.append(f"{raw.file}: EPSG:{raw.epsg}: {str(error).splitlines()[0]}")
        return frame
    if not np.isfinite(longitude).all():
        breaches.append(f"{raw.file}: some positions are outside the area of this coordinate system")
        return frame
    beyond_deg = _beyond_deg(pyproj.CRS(raw.epsg).area_of_use, float(np.median(longitude)), float(np.median(latitude)))
    if beyond_deg > config.beyond_area_deg:
        text = f"the positions lie far outside the area for which EPSG:{raw.epsg} is made"
        breaches.append(f"{raw.file}: {text}; easting and northing may be exchanged, or the code be another")
        return frame
    return frame.with_columns(
        pl.Series("latitude_deg", np.asarray(latitude)), pl.Series("longitude_deg", np.asarray(longitude))
    )


def _beyond_deg(area: Any, longitude_deg: float, latitude_deg: float) -> float:
    """How far a place is outside a system's area; 0 where the area is not known."""
    if area is None or area.west > area.east:
        return 0.0
    along = max(area.west - longitude_deg, longitude_deg - area.east)
    return float(max(along, area.south - latitude_deg, latitude_deg - area.north, 0.0))


def _with_measures(file: str, frame: pl.DataFrame, breaches: list[str]) -> tuple[pl.DataFrame, SurveyedTrack]:
    """Declared measures where an element has them at every point, geometric where at none."""
    track = track_of(frame)
    start = track.first[:-1]
    points = np.diff(track.first)
    unknown = np.isnan(track.measure_m)
    missing = np.add.reduceat(unknown.astype(np.int64), start)
    falls = np.diff(track.measure_m, prepend=np.nan) <= 0.0
    falls[start] = False
    falling = np.logical_or.reduceat(falls, start)
    for element in np.flatnonzero(((missing > 0) & (missing < points)) | (falling & (missing == 0))).tolist():
        name = track.ids[element]
        if missing[element]:
            breaches.append(f"{file}: column measure_m: element {name} has a measure at some points only")
        else:
            at = int(np.argmax(falls[track.vertex_range(element)]))
            measure_m = track.measure_m[start[element] + at]
            text = f"element {name} does not increase at point {at} ({measure_m:g} m)"
            breaches.append(f"{file}: column measure_m: {text}")
    measured = track.with_measures(np.where(np.repeat(missing > 0, points), track.geometric_m, track.measure_m))
    return frame.with_columns(measure_m=pl.Series(measured.measure_m)), measured
