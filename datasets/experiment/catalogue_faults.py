"""The fault catalogue: kinds by sizes, on the positions, the ranges, the odometer, the clocks, the map and balises.

Faults that are no displacement change the streams of a run, or its site: such a `Change` takes the run, its site, the
fault's onset and its size, and leaves what it was given as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import polars as pl

from datasets.line import RailPlaces, offset_places
from schemas.frozen import frozen
from schemas.run import RunLog, Site

Journey = Literal["short", "long", "physical"]
Change = Callable[[RunLog, Site, int, float], tuple[RunLog, Site]]

# The satellite at fault: in view all along, and its errors lie along the line.
SATELLITE = "G16"
HEALTHY = "healthy"
_SLOW_MPS = 0.1
_SECOND_NS = 1_000_000_000
_PLACE = ("latitude_deg", "longitude_deg", "height_m")
_VELOCITY = ("vel_e_mps", "vel_n_mps", "vel_u_mps")


@frozen
class CatalogueFault:
    """One fault from the onset on. `injected`: faults of a scenario (times from the onset); `change`: the rest.

    `journey`: short suffices for all but slow drifts; `physical` has physical balises besides virtual ones.
    """

    kind: str
    size: float
    unit: str
    injected: tuple[dict[str, object], ...] = ()
    change: Change | None = None
    journey: Journey = "short"

    @property
    def name(self) -> str:
        """Kind, size and unit: unique in the catalogue."""
        return self.kind if self.is_healthy else f"{self.kind} {self.size:g} {self.unit}".strip()

    @property
    def is_healthy(self) -> bool:
        """A journey without a fault, to show what is no detection."""
        return self.kind.startswith(HEALTHY)


def catalogue() -> tuple[CatalogueFault, ...]:
    """All faults; the first ones are none, to show what is no detection."""
    journeys: tuple[Journey, ...] = ("short", "long", "physical")
    healthy = [CatalogueFault(f"{HEALTHY} {journey}", 0.0, "", journey=journey) for journey in journeys]
    return (
        *healthy,
        *_range_faults(),
        *_position_faults(),
        *_receiver_faults(),
        *_odometer_faults(),
        *_map_and_balise_faults(),
    )


def _injected_faults(
    label: str, unit: str, sizes: Sequence[float], kind: str, target: str, quantity: str, **fixed: object
) -> list[CatalogueFault]:
    """Faults of a scenario from the onset on, one of each size; slow ramps need the long journey to their failure."""
    return [
        CatalogueFault(
            label,
            size,
            unit,
            ({"kind": kind, "target": target, "start_s": 0.0, quantity: size, **fixed},),
            journey="long" if kind == "ramp" and abs(size) <= _SLOW_MPS else "short",
        )
        for size in sizes
    ]


def _changed_faults(
    label: str, unit: str, sizes: Sequence[float], change: Change, journey: Journey = "short"
) -> list[CatalogueFault]:
    """Faults that a function makes of the streams, one of each size."""
    return [CatalogueFault(label, size, unit, change=change, journey=journey) for size in sizes]


def _range_faults() -> list[CatalogueFault]:
    """Faults in the ranges of one satellite."""
    return [
        *_injected_faults("range ramp", "m/s", (0.01, 0.03, 0.1, 1.0, 5.0), "ramp", SATELLITE, "rate_mps"),
        *_injected_faults("range step", "m", (10.0, 30.0, 100.0), "step", SATELLITE, "size_m"),
    ]


def _position_faults() -> list[CatalogueFault]:
    """Common-mode steps and drifts: all ranges in accord, as a spoofer makes them."""
    return [
        *_injected_faults("step along", "m", (5.0, 25.0, -25.0, 600.0, 1_200.0), "step", "along", "size_m"),
        *_injected_faults("step cross", "m", (3.0, 10.0, 25.0), "step", "cross", "size_m"),
        *_injected_faults("step up", "m", (5.0, 15.0, 40.0), "step", "up", "size_m"),
        *_injected_faults("drift along", "m/s", (0.01, 0.03, 0.1, 0.3, 1.0, -0.3, -1.0), "ramp", "along", "rate_mps"),
        *_injected_faults("drift cross", "m/s", (0.1, 1.0), "ramp", "cross", "rate_mps"),
    ]


def _receiver_faults() -> list[CatalogueFault]:
    """Faults of the receiver: late, frozen or lost positions, clocks, noise."""
    gap: dict[str, object] = {"kind": "outage", "target": "position", "start_s": 0.0, "duration_s": 90.0}
    off = _injected_faults(
        "outage of 90 s, then off by", "m", (10.0, 30.0, 100.0, 300.0, -300.0), "step", "along", "size_m", start_s=90.0
    )
    return [
        *_injected_faults("latency", "s", (0.2, 1.0, 3.0), "latency", "position", "latency_s"),
        *_changed_faults("clock ahead", "s", (0.2, 1.0, 3.0), stamps_ahead),
        *_changed_faults("frozen position", "s", (2.0, 10.0), position_frozen),
        *_injected_faults("outage", "s", (5.0, 30.0, 90.0), "outage", "position", "duration_s"),
        *(replace(one, injected=(gap, *one.injected)) for one in off),
        *_injected_faults("noise along", "m", (1.0, 3.0, 10.0), "noise", "along", "sigma_m"),
        *_injected_faults("multipath below 40 deg", "m", (3.0, 10.0), "noise", "satellites", "sigma_m", below_deg=40.0),
        *_injected_faults(
            "one solution drifts along", "m/s", (0.01, 0.1, 1.0), "ramp", "along", "rate_mps", solution="primary"
        ),
    ]


def _odometer_faults() -> list[CatalogueFault]:
    """Faults of the odometer."""
    return [
        *_injected_faults("slip", "m/s", (0.3, 0.8, 3.0), "slip", "odometer", "rate_mps", duration_s=20.0),
        *_injected_faults("slide", "m/s", (0.3, 0.8, 3.0), "slide", "odometer", "rate_mps", duration_s=20.0),
        *_injected_faults("odometer scale", "", (1.001, 1.005, 1.02), "scale", "odometer", "scale"),
        *_changed_faults("odometer late", "s", (0.2, 1.0), odometer_late),
        *_injected_faults("odometer outage", "s", (20.0,), "outage", "odometer", "duration_s"),
    ]


def _map_and_balise_faults() -> list[CatalogueFault]:
    """Track, map and balises."""
    return [
        *_injected_faults("on the parallel track, left", "m", (4.5,), "step", "cross", "size_m"),
        *_changed_faults("map off to the left", "m", (1.0, 5.0, 20.0), map_left),
        *_changed_faults("balise list wrong", "m", (10.0, 30.0), list_shifted),
        *_changed_faults("physical balise missing", "", (1.0, 2.0), read_missing, "physical"),
        *_changed_faults("physical balise late", "s", (0.5, 3.0, 10.0), read_late, "physical"),
    ]


def position_frozen(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """The receiver repeats its last position and velocity for `size_s`, with fresh stamps."""
    held = _is_from(onset_ns) & ~_is_from(onset_ns + round(size_s * _SECOND_NS))
    last = pl.when(~held).then(pl.struct(*_PLACE, *_VELOCITY))
    parts = [
        part.with_columns(kept=last.forward_fill())
        .with_columns(pl.col("kept").struct.field(name) for name in (*_PLACE, *_VELOCITY))
        .drop("kept")
        for part in run.gnss.partition_by("solution", maintain_order=True)
    ]
    return run.with_streams(gnss=pl.concat(parts).sort("t", "solution", maintain_order=True)), site


def stamps_ahead(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """The receiver's clock jumps: its stamps run ahead of the odometer's by `size_s`."""
    return run.with_streams(
        gnss=_with_late_stamps(run.gnss, onset_ns, size_s),
        satellites=_with_late_stamps(run.satellites, onset_ns, size_s),
    ), site


def odometer_late(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """The odometer's counts are stamped `size_s` too late."""
    return run.with_streams(odometer=_with_late_stamps(run.odometer, onset_ns, size_s)), site


def _with_late_stamps(frame: pl.DataFrame | None, onset_ns: int, size_s: float) -> pl.DataFrame:
    """Rows from the onset on with stamps later by `size_s`."""
    later = pl.col("t") + pl.duration(nanoseconds=round(size_s * _SECOND_NS))
    return _require_stream(frame).with_columns(t=pl.when(_is_from(onset_ns)).then(later).otherwise(pl.col("t")))


def _require_stream(frame: pl.DataFrame | None) -> pl.DataFrame:
    """A stream or list that the journeys of the catalogue have."""
    if frame is None:
        raise ValueError("the journey lacks what the fault is about")
    return frame


def _is_from(onset_ns: int) -> pl.Expr:
    """Expression on a stream: rows from the onset on."""
    return pl.col("t").dt.timestamp("ns") >= onset_ns


def map_left(run: RunLog, site: Site, onset_ns: int, size_m: float) -> tuple[RunLog, Site]:
    """From the first net element entered after the onset on, the survey lies `size_m` to the left of the track."""
    later = _elements_after(run, site, onset_ns)
    parts = [
        _move_left(part, size_m) if part["netelement_id"][0] in later else part
        for part in site.track.partition_by("netelement_id", maintain_order=True)
    ]
    return run, Site(pl.concat(parts), site.links, site.balises, site.route)


def _move_left(points: pl.DataFrame, size_m: float) -> pl.DataFrame:
    """Points of a net element moved to its left."""
    latitude, longitude, height = (points[name].to_numpy() for name in _PLACE)
    north = np.gradient(latitude)
    east = np.gradient(longitude) * np.cos(np.radians(latitude))
    heading_deg = np.degrees(np.arctan2(east, north))
    moved = offset_places(RailPlaces(latitude, longitude, height, heading_deg, np.zeros(height.size)), size_m)
    return points.with_columns(latitude_deg=pl.Series(moved.latitude_deg), longitude_deg=pl.Series(moved.longitude_deg))


def list_shifted(run: RunLog, site: Site, onset_ns: int, size_m: float) -> tuple[RunLog, Site]:
    """The balise list has every balise of the elements after the onset `size_m` further on than meant."""
    later = pl.col("netelement_id").is_in(_elements_after(run, site, onset_ns))
    moved = pl.when(later).then(pl.col("measure_m") + size_m).otherwise(pl.col("measure_m"))
    return run, Site(site.track, site.links, _require_stream(site.balises).with_columns(measure_m=moved), site.route)


def _elements_after(run: RunLog, site: Site, onset_ns: int) -> list[str]:
    """Linked net elements that begin beyond the train's place at the onset, by the survey point that is nearest."""
    here = _require_stream(run.reference).filter(_is_from(onset_ns)).row(0, named=True)
    line = site.track.filter(
        pl.col("netelement_id").is_in(site.links["netelement_a"].to_list() + site.links["netelement_b"].to_list())
    )
    away = pl.sum_horizontal((pl.col(name) - here[name]).abs() for name in _PLACE[:2])
    names: list[str] = line["netelement_id"].unique(maintain_order=True).to_list()
    nearest = line.sort(away, maintain_order=True)["netelement_id"][0]
    return names[names.index(nearest) + 1 :]


def read_missing(run: RunLog, site: Site, onset_ns: int, size: float) -> tuple[RunLog, Site]:
    """The next `size` physical balises are not there any more."""
    reads = _require_stream(run.balise_reads)
    later = reads.filter(_is_from(onset_ns))[: round(size)]
    return run.with_streams(balise_reads=reads.join(later, on="t", how="anti", maintain_order="left")), site


def read_late(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """Physical balises stand further on than listed: they are read `size_s` late."""
    return run.with_streams(balise_reads=_with_late_stamps(run.balise_reads, onset_ns, size_s)), site
