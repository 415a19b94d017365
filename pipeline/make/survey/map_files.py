"""Lines of GeoPackage, Shapefile and FlatGeobuf, read by GDAL (extra `maps`)."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.make.survey.geojson_lines import Feature, survey_of_features
from pipeline.make.survey.pieces import Survey, content_of_survey
from pipeline.storage.files import exists
from pipeline.storage.noted import scratch_folder
from schemas.config import SurveyConfig
from schemas.errors import SiteError

# First bytes of each format. GDAL picks its driver by content, and some of its drivers follow links in a file to other
# files or hosts: a file that only has the suffix must not reach them.
_BEGINNINGS = {".gpkg": b"SQLite format 3\0", ".shp": b"\x00\x00\x27\x0a", ".fgb": b"fgb"}
# Files beside it that decide what a map says, by what stands in place of its suffix or after it: index, attributes,
# coordinate system and code page of a shapefile; edits that are not yet in the database
# (https://sqlite.org/walformat.html).
_COMPANIONS = {".shp": (".shx", ".dbf", ".prj", ".cpg"), ".gpkg": ("-wal", "-journal"), ".fgb": ()}
MAP_SUFFIXES = tuple(_BEGINNINGS)
_POINT, _LINE_STRING, _MULTI_LINE_STRING = 1, 2, 5


def read_map(path: Path, data: bytes, config: SurveyConfig, id_field: str | None = None) -> Survey:
    """Read each line of each layer as a piece in WGS 84, named by `id_field` if given. Raises `SiteError`."""
    try:
        import pyogrio
    except ImportError:
        place = str(path)
        remedy = "Install the extra `maps`, or export the lines as GeoJSON."
        raise SiteError("cannot be read without the package pyogrio", place=place, remedy=remedy) from None
    if not data.startswith(_BEGINNINGS[path.suffix.lower()]):
        raise SiteError(f"is no {path.suffix} file", place=str(path), found=repr(data[:16]))
    try:
        with _copied_map(path, data, config) as copy:
            layers = [str(layer) for layer, _ in pyogrio.list_layers(copy.file)]
            _refuse_views(copy.file, layers)
            # Room is made for as many as the file declares; each takes some bytes of it.
            if sum(abs(pyogrio.read_info(copy.file, layer=layer)["features"]) for layer in layers) > copy.size_bytes:
                raise ValueError("it declares more features than it has bytes")
            features = [feature for layer in layers for feature in _layer_features(copy.file, layer)]
    except (ValueError, RuntimeError, OSError, struct.error, sqlite3.Error) as error:
        raise SiteError(f"cannot be read ({str(error).splitlines()[0]})", place=str(path)) from None
    return survey_of_features(str(path), path.stem, features, id_field)


class _Copy(NamedTuple):
    """A map with its companions where nobody else writes, and the size of them all."""

    file: Path
    size_bytes: int


@contextmanager
def _copied_map(path: Path, data: bytes, config: SurveyConfig) -> Iterator[_Copy]:
    """Copies alone are read: what GDAL opens beside a map is what was noted, and it leaves no file beside the map."""
    with scratch_folder() as folder:
        file = folder / f"map{path.suffix.lower()}"
        file.write_bytes(data)
        size_bytes = len(data)
        for ending in _COMPANIONS[file.suffix]:
            companions = [_companion(path, one) for one in (ending, ending.upper())]
            found = [one for one in companions if exists(one)]
            if found:
                size_bytes += _companion(file, ending).write_bytes(content_of_survey(found[0], config))
        yield _Copy(file, size_bytes)


def _companion(path: Path, ending: str) -> Path:
    """Another file of the same map, by its ending."""
    return path.with_suffix(ending) if ending.startswith(".") else path.with_name(path.name + ending)


def _refuse_views(path: Path, layers: list[str]) -> None:
    """Refuse a layer of a GeoPackage that is a query: it may never end; a survey is a table."""
    if path.suffix.lower() != ".gpkg":
        return
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        views = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'view'")}
    for layer in sorted(views & set(layers)):
        raise ValueError(f"its layer {layer} is a view; expected a table: export it as a file of its own")


def _layer_features(path: Path, layer: str) -> Iterator[Feature]:
    """Tags and geometry of the layer's features, as GeoJSON has them."""
    from pyogrio import raw

    meta, _, shapes, values = raw.read(path, layer=layer, datetime_as_string=True)
    names = [str(name) for name in meta["fields"]]
    for row, shape in enumerate(() if shapes is None else shapes):
        if shape is not None:
            tags = {name: _plain_value(column[row]) for name, column in zip(names, values, strict=True)}
            lines = [_line_in_degrees(line, meta["crs"]).tolist() for line in lines_of_wkb(memoryview(shape))]
            point = len(lines) == 1 and len(lines[0]) == 1
            kind, coordinates = ("Point", lines[0][0]) if point else ("MultiLineString", lines)
            yield tags, {"type": kind, "coordinates": coordinates}


def _plain_value(value: Any) -> Any:
    """A value without its type of numpy."""
    return value.item() if isinstance(value, np.generic) else value


def _line_in_degrees(line: npt.NDArray[np.float64], crs: str | None) -> npt.NDArray[np.float64]:
    """Longitude, latitude and, where the line has them, heights as they stand."""
    if crs is None:
        raise ValueError("no coordinate system is named; expected one, as in a .prj file")
    import pyproj

    to_degrees = pyproj.Transformer.from_crs(crs, 4326, always_xy=True)
    longitude, latitude = to_degrees.transform(line[:, 0], line[:, 1], errcheck=True)
    return np.column_stack([longitude, latitude, line[:, 2:3]])


def lines_of_wkb(shape: bytes | memoryview) -> list[npt.NDArray[np.float64]]:
    """The lines of a well-known binary geometry (OGC 06-103r4, 8.2): a Point is a line of one, areas have none."""
    order = "<" if shape[0] == 1 else ">"
    (code,) = struct.unpack_from(f"{order}I", shape, 1)
    # The height is named by a flag (extended WKB) or by the thousands (ISO).
    high = bool(code & 0x8000_0000) or code // 1000 % 10 in (1, 3)
    axes = 3 if high else 2
    kind = (code & 0x0FFF_FFFF) % 1000
    if kind == _POINT:
        return [np.frombuffer(shape, f"{order}f8", axes, offset=5).reshape(1, axes)]
    (count,) = struct.unpack_from(f"{order}I", shape, 5)
    if kind == _LINE_STRING:
        return [np.frombuffer(shape, f"{order}f8", count * axes, offset=9).reshape(-1, axes)]
    if kind != _MULTI_LINE_STRING:
        return []
    # Each of them is a LineString with a head of its own, 9 bytes.
    lines = []
    start = 9
    for _ in range(count):
        lines += lines_of_wkb(shape[start:])
        start += 9 + lines[-1].nbytes
    return lines
