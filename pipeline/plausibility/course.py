"""Streams as ways over time: what is compared."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.track.geodesy import Points, earth_centred_m, points_of
from schemas.arrays import Bools, Floats, Ints, floats, times_ns
from schemas.enums import Fix

# Speed over this time: positions that scatter by 2 m give it to 0.7 m/s. A shorter pause is bridged. Not yet a key:
# limits of `[plausibility]` are set for speeds over it.
SPEED_S = 4.0


@dataclass(frozen=True)
class _Record:
    """Rows over time [s]."""

    t_s: Floats

    @cached_property
    def limit_s(self) -> float:
        """A longer pause is not bridged."""
        return max(SPEED_S, 3.5 * float(np.median(np.diff(self.t_s))))

    def known(self, t_s: Floats) -> Bools:
        """Whether instants lie between two rows that are no farther apart than the limit."""
        after = np.searchsorted(self.t_s, t_s, side="left")
        inside = (after < self.t_s.size) & (t_s >= self.t_s[0])
        after = np.clip(after, 1, self.t_s.size - 1)
        known: Bools = inside & (self.t_s[after] - self.t_s[after - 1] <= self.limit_s)
        return known


@dataclass(frozen=True)
class Places(_Record):
    """Positions over time, with earth-centred coordinates [m] at the stream's median height."""

    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    ecef_m: Floats

    @cached_property
    def points(self) -> Points:
        return points_of(self.latitude_deg, self.longitude_deg)

    def at(self, t_s: Floats) -> Floats:
        """Places by straight lines [m], shape (n, 3)."""
        return np.column_stack([np.interp(t_s, self.t_s, axis) for axis in self.ecef_m.T])

    def moved(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Displacement from some instants to others [m], shape (n, 3); NaN where it is not known."""
        known = self.known(begin_s) & self.known(end_s)
        return np.where(known[:, None], self.at(end_s) - self.at(begin_s), np.nan)

    def speed(self, t_s: Floats) -> Floats:
        """Speed over ground [m/s], never negative; NaN where it is not known."""
        chord = np.linalg.norm(self.moved(t_s - SPEED_S / 2, t_s + SPEED_S / 2), axis=1)
        return np.where(self.known(t_s), chord / SPEED_S, np.nan)

    def way(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Way from some instants to others [m]: the chord, and by half of it what a curve adds; NaN where unknown."""
        middle_s = (begin_s + end_s) / 2
        parts = (begin_s, end_s), (begin_s, middle_s), (middle_s, end_s)
        chord, first, second = (np.linalg.norm(self.moved(*part), axis=1) for part in parts)
        return np.asarray(first + second + (first + second - chord) / 3.0)


@dataclass(frozen=True)
class Course(_Record):
    """A counter over time, of any unit: speeds already summed up."""

    way: Floats

    def speed(self, t_s: Floats, over_s: float = SPEED_S) -> Floats:
        """Signed speed in units per second; NaN where it is not known."""
        return self.gained(t_s - over_s / 2, t_s + over_s / 2) / over_s

    def gained(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Signed way from some instants to others; NaN where it is not known."""
        known = self.known(begin_s) & self.known(end_s)
        return np.where(known, np.interp(end_s, self.t_s, self.way) - np.interp(begin_s, self.t_s, self.way), np.nan)


def places_of(frame: pl.DataFrame, epoch_ns: int) -> Places | None:
    """Valid positions of a cleaned stream, thinned to two a second; None below ten of them."""
    latitude, longitude = floats(frame, "latitude_deg"), floats(frame, "longitude_deg")
    valid = np.isfinite(latitude) & np.isfinite(longitude)
    if "fix" in frame.columns:
        valid &= (frame["fix"].cast(pl.String) != Fix.NONE.value).fill_null(False).to_numpy()
    t_s = seconds_since(epoch_ns, frame)
    rows = _thinned(t_s, np.flatnonzero(valid))
    if rows.size < 10:
        return None
    height = floats(frame, "height_m")[rows] if "height_m" in frame.columns else np.full(rows.size, np.nan)
    level_m = float(np.nanmedian(height)) if np.isfinite(height).any() else 0.0
    flat = np.full(rows.size, level_m if abs(level_m) < 9000.0 else 0.0)
    return Places(
        t_s[rows], latitude[rows], longitude[rows], height, earth_centred_m(latitude[rows], longitude[rows], flat)
    )


def seconds_since(epoch_ns: int, frame: pl.DataFrame) -> Floats:
    """Times of a stream from an instant on [s]."""
    return np.asarray((times_ns(frame) - epoch_ns) * 1e-9, dtype=np.float64)


def courses_of(odometer: pl.DataFrame | None, epoch_ns: int) -> dict[str, Course]:
    """`distance`, and `speed` summed up, of an odometer, each where enough rows have it."""
    found: dict[str, Course] = {}
    if odometer is None:
        return found
    for name, column in ("distance", "distance_m"), ("speed", "speed_mps"):
        t_s, values = seconds_since(epoch_ns, odometer), floats(odometer, column)
        rows = np.flatnonzero(np.isfinite(values))
        t_s, way = t_s[rows], values[rows]
        if name == "speed" and rows.size:
            way = np.concatenate([[0.0], np.cumsum(0.5 * (way[1:] + way[:-1]) * np.diff(t_s))])
        kept = _thinned(t_s, np.arange(rows.size))
        if kept.size >= 10:
            found[name] = Course(t_s[kept], way[kept])
    return found


def _thinned(t_s: Floats, rows: Ints) -> Ints:
    """Of these rows some two a second, which tell all that is asked here."""
    t_s = t_s[rows]
    if t_s.size < 2 or np.median(np.diff(t_s)) >= 0.45:
        return rows
    slot = np.floor((t_s - t_s[0]) / 0.5 + 1e-6)
    kept: Ints = rows[np.diff(slot, prepend=-1.0) > 0]
    return kept
