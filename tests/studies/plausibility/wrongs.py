"""Ways to record a run wrongly, each with what must be said of it and whether it must fail the run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from schemas.config import Vehicle
from schemas.run import RunLog, Site, Stream

Change = Callable[[RunLog], RunLog]


@dataclass(frozen=True)
class Wrong:
    """`change` makes it; a check whose words hold all of `reported` must say so; `fails`: it must be impossible.

    `needs`: stream columns that the run must have. `vehicle`, `site`: what the run is held against
    instead; `place`: where on earth.
    """

    name: str
    reported: tuple[str, ...]
    change: Change = lambda run: run
    fails: bool = True
    needs: tuple[str, ...] = ()
    vehicle: Callable[[float, float], Vehicle] | None = None
    site: Callable[[Site], Site] | None = None
    place: tuple[float, float] | None = None
    least_hours: float = 0.0
    speed_changes: bool = False


def scaled(stream: Stream, **factors: float) -> Change:
    def change(run: RunLog) -> RunLog:
        frame = run.stream(stream)
        assert frame is not None
        return run.with_streams(**{stream: frame.with_columns(pl.col(name) * by for name, by in factors.items())})

    return change


def shifted(seconds: float, *streams: Stream) -> Change:
    def change(run: RunLog) -> RunLog:
        later = pl.col("t") + pl.duration(milliseconds=round(seconds * 1000))
        present = {name: frame for name in streams if (frame := run.stream(name)) is not None}
        return run.with_streams(**{name: frame.with_columns(later) for name, frame in present.items()})

    return change


def exchanged(stream: Stream, one: str, other: str) -> Change:
    def change(run: RunLog) -> RunLog:
        frame = run.stream(stream)
        assert frame is not None
        return run.with_streams(**{stream: frame.with_columns(pl.col(one).alias(other), pl.col(other).alias(one))})

    return change


def _minutes(run: RunLog) -> RunLog:
    """Latitude and longitude as dd.mmmm."""
    whole = {name: pl.col(name).sign() * pl.col(name).abs().floor() for name in ("latitude_deg", "longitude_deg")}
    turned = [(at + (pl.col(name) - at) * 0.6).alias(name) for name, at in whole.items()]
    return run.with_streams(gnss=run.gnss.with_columns(turned))


_HEIGHTS = ("reference.height_m", "gnss.height_m")


def _feet(run: RunLog) -> RunLog:
    return scaled(_R, height_m=3.2808399)(run)


def _turned(site: Site, one: str, other: str) -> Site:
    return replace(site, track=site.track.with_columns(pl.col(one).alias(other), pl.col(other).alias(one)))


def moved_site(aside_m: float, along_m: float = 0.0, up_m: float = 0.0) -> Callable[[Site], Site]:
    """A survey moved to the right of the line's general direction, along it, and up."""

    def change(site: Site) -> Site:
        track = site.track
        latitude = np.radians(track["latitude_deg"][0])
        ends = track[[0, -1]]
        east, north = (ends["longitude_deg"].diff()[1] * np.cos(latitude), ends["latitude_deg"].diff()[1])
        size = float(np.hypot(east, north))
        east_m = (aside_m * north + along_m * east) / size
        north_m = (-aside_m * east + along_m * north) / size
        moved = [
            pl.col("latitude_deg") + np.degrees(north_m / 6_367_000.0),
            pl.col("longitude_deg") + np.degrees(east_m / (6_385_000.0 * np.cos(latitude))),
            pl.col("height_m") + up_m,
        ]
        return replace(site, track=track.with_columns(moved))

    return change


def in_datum(epsg: int) -> Callable[[Site], Site]:
    """The survey written down in another datum, as if it were WGS 84."""

    def change(site: Site) -> Site:
        import pyproj

        turn = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
        east, north = turn.transform(site.track["longitude_deg"].to_numpy(), site.track["latitude_deg"].to_numpy())
        places = [pl.Series("latitude_deg", north), pl.Series("longitude_deg", east)]
        return replace(site, track=site.track.with_columns(places))

    return change


_SPEED = {
    "km/h": 3.6,
    "mph": 2.2369363,
    "knots": 1.9438445,
    "mm/s": 1000.0,
    "cm/s": 100.0,
    "feet/s": 3.2808399,
    "divided by 3.6": 1 / 3.6,
    "hundredths of km/h": 360.0,
    "m/min": 60.0,
    "feet/min": 196.850394,
}
_WAY = {"km": 0.001, "mm": 1000.0, "cm": 100.0, "feet": 3.2808399, "miles": 1 / 1609.344, "yards": 1.0936133}
_VELOCITY = {"km/h": 3.6, "mph": 2.2369363, "knots": 1.9438445, "mm/s": 1000.0, "cm/s": 100.0, "feet/s": 3.2808399}
_LAGS = {
    "GPS time": 18.0,
    "1 h": 3600.0,
    "2 h": 7200.0,
    "8 h": 28_800.0,
    "5.5 h": 19_800.0,
    "1 days": 86_400.0,
    "7 days": 604_800.0,
    "1024 weeks": 619_315_200.0,
}
_O: Stream = "odometer"
_G: Stream = "gnss"
_R: Stream = "reference"
_B: Stream = "balise_reads"


# A place in the middle of the area in which each is used.
_DATUMS = {4314: (50.5, 9.5), 4230: (43.0, -3.5), 4313: (50.8, 4.4), 4277: (52.5, -1.5), 4312: (47.3, 14.5)}


def _speeds() -> list[Wrong]:
    return [
        Wrong(
            f"odometer speed: {unit}", ("odometer speed", unit), scaled(_O, speed_mps=by), needs=("odometer.speed_mps",)
        )
        for unit, by in _SPEED.items()
    ]


def _ways() -> list[Wrong]:
    needs = ("odometer.distance_m",)
    found = [
        Wrong(f"distance: {unit}", ("odometer distance", unit), scaled(_O, distance_m=by), needs=needs)
        for unit, by in _WAY.items()
    ]
    return [*found, Wrong("distance: pulses", ("pulses",), scaled(_O, distance_m=47.3), needs=needs)]


def _velocities() -> list[Wrong]:
    needs = ("gnss.vel_e_mps",)

    def all_axes(by: float) -> Change:
        return scaled(_G, vel_e_mps=by, vel_n_mps=by, vel_u_mps=by)

    found = [
        Wrong(f"velocity: {unit}", ("GNSS velocity", unit), all_axes(by), needs=needs) for unit, by in _VELOCITY.items()
    ]
    return [
        *found,
        Wrong(
            "velocity: axes", ("east and north are exchanged",), exchanged(_G, "vel_e_mps", "vel_n_mps"), needs=needs
        ),
        Wrong("velocity: east", ("east with the wrong sign",), scaled(_G, vel_e_mps=-1.0), needs=needs),
        Wrong("velocity: north", ("north with the wrong sign",), scaled(_G, vel_n_mps=-1.0), needs=needs),
        Wrong(
            "velocity: both",
            ("east and north with the wrong sign",),
            scaled(_G, vel_e_mps=-1.0, vel_n_mps=-1.0),
            needs=needs,
        ),
        Wrong(
            "velocity: down", ("counts down",), scaled(_G, vel_u_mps=-1.0), needs=("gnss.vel_e_mps", "gnss.height_m")
        ),
    ]


def _clocks() -> list[Wrong]:
    found: list[Wrong] = []
    for name, by in _LAGS.items():
        cause = "GPS time" if name == "GPS time" else name
        for sign in (1.0, -1.0):
            way = "later" if sign > 0 else "earlier"
            found.append(
                Wrong(
                    f"odometer {way}: {name}",
                    ("clock of the odometer", cause),
                    shifted(sign * by, _O),
                    speed_changes=True,
                )
            )
        found.append(
            Wrong(
                f"reference later: {name}", ("clock of the reference", cause), shifted(by, _R), needs=("reference.t",)
            )
        )
    found += [
        Wrong(
            "GNSS in GPS time",
            ("GPS time", "in the GNSS"),
            shifted(18.0, _G),
            needs=("reference.t",),
            speed_changes=True,
        ),
        Wrong(
            "GNSS 1 h later", ("1 h", "in the GNSS"), shifted(3600.0, _G), needs=("reference.t",), speed_changes=True
        ),
        Wrong("reads 1 h later", ("clock of the balise reads", "1 h"), shifted(3600.0, _B), needs=("balise_reads.t",)),
        Wrong(
            "reads in GPS time", ("clock of the balise reads", "GPS time"), shifted(18.0, _B), needs=("balise_reads.t",)
        ),
        Wrong("odometer 10 s later", ("clock of the odometer", "constant lag"), shifted(10.0, _O), speed_changes=True),
        Wrong(
            "odometer 100 s earlier", ("clock of the odometer", "constant lag"), shifted(-100.0, _O), speed_changes=True
        ),
        Wrong("odometer 1 h later, long run", ("1 h",), shifted(3600.0, _O), least_hours=1.5, speed_changes=True),
        Wrong("reference 1 h later, long run", ("1 h",), shifted(3600.0, _R), needs=("reference.t",), least_hours=1.5),
        Wrong("odometer 3 s later", ("clock of the odometer",), shifted(3.0, _O), fails=False, speed_changes=True),
    ]
    return found


def _places() -> list[Wrong]:
    survey = ("positions against the survey",)
    written = ("positions as written",)
    axes = ("latitude_deg", "longitude_deg")
    return [
        Wrong("latitude and longitude", (*written, "exchanged"), exchanged(_G, *axes)),
        Wrong("longitude west", (*written, "longitude has the wrong sign"), scaled(_G, longitude_deg=-1.0)),
        Wrong("latitude south", (*written, "latitude has the wrong sign"), scaled(_G, latitude_deg=-1.0)),
        Wrong("radians", (*written, "radians"), scaled(_G, latitude_deg=np.pi / 180, longitude_deg=np.pi / 180)),
        Wrong("ddmm.mm", (*written, "minutes"), _minutes),
        Wrong("survey: axes", (*written, "exchanged"), site=lambda site: _turned(site, *axes)),
        Wrong("reference: feet", ("heights", "unit"), _feet, fails=False, needs=_HEIGHTS),
        Wrong("reference: axes", ("reference", "exchanged"), exchanged(_R, *axes), needs=("reference.t",)),
        *(
            Wrong(
                f"survey {size} m {where}", (*survey, "shift"), site=moved_site(size * aside, size * along), fails=False
            )
            for size in (15, 30, 60)
            for where, aside, along in (("aside", 1.0, 0.0), ("askew", 0.8, 0.6))
        ),
        *(
            Wrong(f"survey in EPSG:{code}", survey, site=in_datum(code), fails=False, place=place)
            for code, place in _DATUMS.items()
        ),
        Wrong(
            "survey: sea level",
            ("heights", "above the sea"),
            site=moved_site(0.0, 0.0, -47.0),
            fails=False,
            needs=("gnss.height_m",),
        ),
        Wrong(
            "heights in feet",
            ("heights", "unit"),
            scaled(_G, height_m=3.2808399),
            fails=False,
            needs=("gnss.height_m",),
        ),
    ]


def _vehicles() -> list[Wrong]:
    def file(scale_by: float, latency_s: float) -> Callable[[float, float], Vehicle]:
        def vehicle(scale: float, latency: float) -> Vehicle:
            return Vehicle(
                odometer_scale=scale_by / scale,
                odometer_scale_sigma=2e-4,
                gnss_latency_s=latency + latency_s,
                gnss_latency_sigma_s=0.02,
            )

        return vehicle

    return [
        Wrong("vehicle file: 2 % more", ("odometer scale of the vehicle file",), vehicle=file(1.02, 0.0), fails=False),
        Wrong("vehicle file: 5 % less", ("odometer scale of the vehicle file",), vehicle=file(0.95, 0.0), fails=False),
        Wrong("vehicle file: percent", ("odometer scale of the vehicle file", "no odometer"), vehicle=file(100.0, 0.0)),
        Wrong(
            "vehicle file: 1 s",
            ("clock of the odometer", "vehicle file"),
            vehicle=file(1.0, 1.0),
            fails=False,
            speed_changes=True,
        ),
    ]


def _counters() -> list[Wrong]:
    def unsigned(run: RunLog) -> RunLog:
        assert run.odometer is not None
        way = pl.col("distance_m").diff().abs().fill_null(0.0).cum_sum()
        return run.with_streams(odometer=run.odometer.with_columns(way.alias("distance_m"), pl.col("speed_mps").abs()))

    both = ("odometer.distance_m", "odometer.speed_mps")
    return [
        Wrong("speed backwards", ("sign of the odometer", "backwards"), scaled(_O, speed_mps=-1.0), needs=both),
        Wrong("distance backwards", ("sign of the odometer", "backwards"), scaled(_O, distance_m=-1.0), needs=both),
        Wrong("counter without sign", ("reverses", "unsigned"), unsigned, fails=False, needs=("reverses",)),
    ]


WRONGS = (*_speeds(), *_ways(), *_velocities(), *_clocks(), *_places(), *_vehicles(), *_counters())
