"""Lines of GPX and KML.

Read by expat in one go, which takes time linear in the file's size. A document type is refused before anything in
it is read: entities, the way to make a small file huge or to read other files, can then not be declared.
"""

from __future__ import annotations

import io
import zipfile
from xml.parsers import expat

from pipeline.make.survey.pieces import Survey, piece_of, refuse_large
from pipeline.read.site.geojson import number_of
from pipeline.storage.budget import UNPACKING
from schemas.config import SurveyConfig
from schemas.errors import SiteError

_ENDS_OF_LINE = ("trkseg", "rte", "LineString", "Track")
_CLAMPED = "clampToGround"


def read_xml(place: str, stem: str, data: bytes) -> Survey:
    """Tracks and routes of GPX; LineStrings and `gx:Track`s of KML, named by the placemark's id, else its name.

    Heights of KML count only where its altitude mode is `absolute`. Points with a time were recorded by a vehicle.
    Raises `SiteError`.
    """
    reader = _XmlLines(place, stem)
    try:
        reader.parser.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:
        # An encoding that expat does not know is a ValueError or a LookupError.
        raise SiteError(f"is not well-formed XML ({error})", place=place, expected="GPX or KML") from None
    if reader.root not in ("gpx", "kml"):
        raise SiteError("is neither GPX nor KML", place=place, found=f"<{reader.root}>")
    return reader.survey


def read_kmz(place: str, stem: str, data: bytes, config: SurveyConfig) -> Survey:
    """The first KML of a KMZ, which is a zip file."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            name = next((name for name in packed.namelist() if name.lower().endswith(".kml")), None)
            if name is None:
                raise SiteError("holds no KML", place=place, expected="a KMZ with doc.kml")
            with packed.open(name) as file:
                content = file.read(int(config.size_limit_mb * 1e6) + 1)
    except UNPACKING as error:
        raise SiteError(f"cannot be unpacked ({error})", place=place, expected="a KMZ, which is a zip file") from None
    refuse_large(len(content), f"{place}: {name}", config)
    return read_xml(f"{place}: {name}", stem, content)


class _XmlLines:
    """What expat meets, gathered to pieces of line."""

    def __init__(self, place: str, stem: str) -> None:
        self.place = place
        self.stem = stem
        self.survey = Survey()
        self.root = ""
        self.path: list[str] = []
        self.text: list[str] = []
        self.name = ""
        self.mode = self.mode_of_all = _CLAMPED
        self.recorded = False
        self.points: list[list[float | None]] = []
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self.text.append
        self.parser.StartDoctypeDeclHandler = self._refuse

    def _refuse(self, *_: object) -> None:
        """Refuse a document type: it may define entities without end."""
        raise SiteError(
            "declares a document type, which no GPX and no KML needs",
            place=f"{self.place}: line {self.parser.CurrentLineNumber}",
            remedy="Export it anew.",
        )

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        """Take note of the begin of an element."""
        local = tag.rpartition(" ")[2]
        self.root = self.root or local
        self.path.append(local)
        self.text.clear()
        if local in ("trk", "rte", "Placemark"):
            self.name = attributes.get("id", "")
        if local in _ENDS_OF_LINE:
            self.points = []
            # Tracks of a gx:MultiTrack have its altitude mode.
            self.mode = self.mode_of_all if "MultiTrack" in self.path else _CLAMPED
            self.recorded = False
        if local == "MultiTrack":
            self.mode_of_all = _CLAMPED
        if local in ("trkpt", "rtept"):
            self.points.append([self._number(attributes.get(key)) for key in ("lat", "lon")] + [None])

    def _end(self, tag: str) -> None:
        """Take what an element holds at its end."""
        local = self.path.pop()
        text = "".join(self.text).strip()
        self.text.clear()
        match local:
            case "name" if self.path and self.path[-1] in ("trk", "rte", "Placemark"):
                self.name = self.name or text
            case "ele" if self.points:
                self.points[-1][2] = self._number(text)
            case "time" | "when":
                self.recorded = True
            case "altitudeMode":
                self.mode = text
                if self.path and self.path[-1] == "MultiTrack":
                    self.mode_of_all = text
            case "coord":
                self._add_triple(text.split())
            case "coordinates" if self.path and self.path[-1] == "LineString":
                for triple in text.split():
                    self._add_triple(triple.split(","))
            case _ if local in _ENDS_OF_LINE:
                self._close()

    def _add_triple(self, parts: list[str]) -> None:
        """Longitude, latitude and, perhaps, height, as KML writes them."""
        if len(parts) < 2:
            self.points.append([None, None, None])  # no place: refused with its line
            return
        longitude, latitude, *height = [self._number(part) for part in parts[:3]]
        self.points.append([latitude, longitude, height[0] if height else None])

    def _number(self, text: str | None) -> float:
        """A number, or a refusal that names its line."""
        try:
            return number_of(text or "")
        except ValueError:
            where = f"{self.place}: line {self.parser.CurrentLineNumber}"
            raise SiteError("a coordinate cannot be read", place=where, found=repr(text)) from None

    def _close(self) -> None:
        """Close a piece of track."""
        latitude, longitude, height = zip(*self.points, strict=True) if self.points else ((), (), ())
        if self.root == "kml" and self.mode != "absolute":
            height = (None,) * len(latitude)
        columns = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
        self.survey.pieces.append(piece_of(self.place, self.name or self.stem, columns, self.recorded))
        self.points = []
