"""Faults of the catalogue that are no displacement: what they do to the streams of a run, or to its site.

All take the run, its site, the fault's onset and its size, and leave what they were given as it is.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from datasets.line import RailPlaces, offset_places
from schemas.run import RunLog, Site

_SECOND_NS = 1_000_000_000
_PLACE = ("latitude_deg", "longitude_deg", "height_m")
_VELOCITY = ("vel_e_mps", "vel_n_mps", "vel_u_mps")


def position_frozen(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """The receiver repeats its last position and velocity for `size_s`, with fresh stamps."""
    held = _from(onset_ns) & ~_from(onset_ns + round(size_s * _SECOND_NS))
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
        gnss=_stamped(run.gnss, onset_ns, size_s), satellites=_stamped(run.satellites, onset_ns, size_s)
    ), site


def odometer_late(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """The odometer's counts are stamped `size_s` too late."""
    return run.with_streams(odometer=_stamped(run.odometer, onset_ns, size_s)), site


def _stamped(frame: pl.DataFrame | None, onset_ns: int, size_s: float) -> pl.DataFrame:
    later = pl.col("t") + pl.duration(nanoseconds=round(size_s * _SECOND_NS))
    return _there(frame).with_columns(t=pl.when(_from(onset_ns)).then(later).otherwise(pl.col("t")))


def _there(frame: pl.DataFrame | None) -> pl.DataFrame:
    """A stream or list that the journeys of the catalogue have."""
    if frame is None:
        raise ValueError("the journey lacks what the fault is about")
    return frame


def _from(onset_ns: int) -> pl.Expr:
    return pl.col("t").dt.timestamp("ns") >= onset_ns


def map_left(run: RunLog, site: Site, onset_ns: int, size_m: float) -> tuple[RunLog, Site]:
    """From the first net element entered after the onset on, the survey lies `size_m` to the left of the track."""
    later = _elements_after(run, site, onset_ns)
    parts = [
        _moved_left(part, size_m) if part["netelement_id"][0] in later else part
        for part in site.track.partition_by("netelement_id", maintain_order=True)
    ]
    return run, Site(pl.concat(parts), site.links, site.balises, site.route)


def _moved_left(points: pl.DataFrame, size_m: float) -> pl.DataFrame:
    latitude, longitude, height = (points[name].to_numpy() for name in _PLACE)
    north = np.gradient(latitude)
    east = np.gradient(longitude) * np.cos(np.radians(latitude))
    heading_deg = np.degrees(np.arctan2(east, north))
    moved = offset_places(RailPlaces(latitude, longitude, height, heading_deg, np.zeros(height.size)), size_m)
    return points.with_columns(latitude_deg=pl.Series(moved.latitude_deg), longitude_deg=pl.Series(moved.longitude_deg))


def list_wrong(run: RunLog, site: Site, onset_ns: int, size_m: float) -> tuple[RunLog, Site]:
    """The balise list has every balise of the elements after the onset `size_m` further on than meant."""
    later = pl.col("netelement_id").is_in(_elements_after(run, site, onset_ns))
    moved = pl.when(later).then(pl.col("measure_m") + size_m).otherwise(pl.col("measure_m"))
    return run, Site(site.track, site.links, _there(site.balises).with_columns(measure_m=moved), site.route)


def _elements_after(run: RunLog, site: Site, onset_ns: int) -> list[str]:
    """Linked net elements that begin beyond the train's place at the onset, by the survey point that is nearest."""
    here = _there(run.reference).filter(_from(onset_ns)).row(0, named=True)
    line = site.track.filter(
        pl.col("netelement_id").is_in(site.links["netelement_a"].to_list() + site.links["netelement_b"].to_list())
    )
    away = pl.sum_horizontal((pl.col(name) - here[name]).abs() for name in _PLACE[:2])
    names: list[str] = line["netelement_id"].unique(maintain_order=True).to_list()
    nearest = line.sort(away, maintain_order=True)["netelement_id"][0]
    return names[names.index(nearest) + 1 :]


def read_missing(run: RunLog, site: Site, onset_ns: int, size: float) -> tuple[RunLog, Site]:
    """The next `size` physical balises are not there any more."""
    reads = _there(run.balise_reads)
    later = reads.filter(_from(onset_ns))[: round(size)]
    return run.with_streams(balise_reads=reads.join(later, on="t", how="anti", maintain_order="left")), site


def read_late(run: RunLog, site: Site, onset_ns: int, size_s: float) -> tuple[RunLog, Site]:
    """Physical balises stand further on than listed: they are read `size_s` late."""
    return run.with_streams(balise_reads=_stamped(run.balise_reads, onset_ns, size_s)), site
