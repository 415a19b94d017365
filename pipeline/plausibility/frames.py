"""Ways in which latitudes and longitudes are written wrongly, and the datums that surveys forget to name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.plausibility.robust import Shift
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig

_RADIAN_DEG = float(np.degrees(1.0))


@dataclass(frozen=True)
class Slip:
    """A way to write positions wrongly; `factors` and `exchanged` mend it, as `[[ingest.correct]]` can, but minutes."""

    cause: str
    factors: Mapping[str, float] = field(default_factory=dict)
    exchanged: bool = False
    minutes: bool = False

    def mended(self, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
        """Latitude and longitude [deg] without it."""
        first, second = (longitude_deg, latitude_deg) if self.exchanged else (latitude_deg, longitude_deg)
        first, second = first * self.factors.get("latitude_deg", 1.0), second * self.factors.get("longitude_deg", 1.0)
        return (_from_minutes(first), _from_minutes(second)) if self.minutes else (first, second)


def _from_minutes(value: Floats) -> Floats:
    """Degrees of `dd.mmmm`, minutes behind the point, as a recording of NMEA divided by 100 has them."""
    whole = np.trunc(value)
    return np.asarray(whole + (value - whole) * 100.0 / 60.0)


SLIPS = (
    Slip("latitude and longitude are exchanged", exchanged=True),
    Slip("longitude has the wrong sign", {"longitude_deg": -1.0}),
    Slip("latitude has the wrong sign", {"latitude_deg": -1.0}),
    Slip("latitude and longitude have the wrong sign", {"latitude_deg": -1.0, "longitude_deg": -1.0}),
    Slip("positions are in radians", {"latitude_deg": _RADIAN_DEG, "longitude_deg": _RADIAN_DEG}),
    Slip("positions are degrees and minutes (ddmm.mm of NMEA), written as decimal degrees", minutes=True),
)

# Geographic systems of national surveys, whose coordinates look like WGS 84 and lie 50 to 700 m from it.
DATUMS = {
    "DHDN (Germany)": 4314,
    "ED50 (Europe)": 4230,
    "Belge 1972": 4313,
    "Amersfoort (Netherlands)": 4289,
    "OSGB36 (Great Britain)": 4277,
    "TM65 (Ireland)": 4299,
    "CH1903 (Switzerland)": 4149,
    "CH1903+ (Switzerland)": 4150,
    "MGI (Austria)": 4312,
    "NTF (France)": 4275,
    "S-JTSK (Czechia, Slovakia)": 4156,
    "Monte Mario (Italy)": 4265,
    "Pulkovo 1942(58)": 4179,
    "Pulkovo 1942": 4284,
    "HD72 (Hungary)": 4237,
    "RT90 (Sweden)": 4124,
    "KKJ (Finland)": 4123,
    "Lisbon (Portugal)": 4207,
    "Datum 73 (Portugal)": 4274,
    "GGRS87 (Greece)": 4121,
    "NAD27 (North America)": 4267,
    "Tokyo (Japan)": 4301,
    "MGI 1901 (former Yugoslavia)": 3906,
}


@dataclass(frozen=True)
class Datum(Shift):
    """A national datum; the shift is that of a survey in it, read as WGS 84, from the positions here."""

    name: str
    epsg: int

    def explains(self, shift: Shift, one_heading: bool, config: PlausibilityConfig) -> bool:
        """Whether it is this shift; of a single heading only the part across it is known."""
        east_m, north_m, size_m = shift.east_m, shift.north_m, shift.shift_m
        across_m = abs((self.east_m - east_m) * east_m + (self.north_m - north_m) * north_m) / size_m
        off_m = across_m if one_heading else self.off_m(shift)
        return off_m < max(config.datum_near_m, config.datum_near_share * size_m)


def datums_at(latitude_deg: float, longitude_deg: float) -> list[Datum]:
    """The national datums in use around a place."""
    # Imported here because it takes a tenth of a second, and hardly any run needs it.
    import pyproj

    found: list[Datum] = []
    geod = pyproj.Geod(ellps="WGS84")
    for name, code in DATUMS.items():
        area = pyproj.CRS.from_epsg(code).area_of_use
        west, south, east, north = (181.0, 0.0, 0.0, 0.0) if area is None else area.bounds
        if not (south <= latitude_deg <= north and west <= longitude_deg <= east):
            continue
        turn = pyproj.Transformer.from_crs(code, 4326, always_xy=True)
        longitude, latitude = turn.transform(longitude_deg, latitude_deg)
        azimuth_deg, _, distance_m = geod.inv(longitude, latitude, longitude_deg, latitude_deg)
        azimuth = np.radians(azimuth_deg)
        found.append(Datum(float(distance_m * np.sin(azimuth)), float(distance_m * np.cos(azimuth)), name, code))
    return found
