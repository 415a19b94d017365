"""Streams as records over time: what is compared."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import Points, points_of
from schemas.arrays import Bools, Floats, Ints, floats, times_ns, truths
from schemas.enums import Fix
from schemas.frozen import frozen

# A speed is a mean over this time: positions that scatter by 2 m give it to 0.7 m/s.
SPEED_S = 4.0
# Slower, positions that scatter by some metres may be of a train that stands.
MOVING_MPS = 1.0
# Pauses are bridged up to so many usual periods (loggers drop single rows), and never longer than a minute.
_BRIDGED_PERIODS = 3.5
_BRIDGED_S = 60.0
# Two rows a second show as much as ten.
_ROW_S = 0.5
# Fewer rows of a record show nothing.
_LEAST_ROWS = 10


@frozen
class Record:
    """Values over time [s]: what a counter has counted, in any unit, or places (n, 3) in earth-centred metres."""

    t_s: Floats
    values: Floats

    @cached_property
    def limit_s(self) -> float:
        """A longer pause is not bridged."""
        return float(np.clip(_BRIDGED_PERIODS * np.median(np.diff(self.t_s)), SPEED_S, _BRIDGED_S))

    def known(self, t_s: Floats) -> Bools:
        """Whether instants lie between two rows that are no farther apart than the limit."""
        after = np.searchsorted(self.t_s, t_s, side="left")
        inside = (after < self.t_s.size) & (t_s >= self.t_s[0])
        after = np.minimum(np.maximum(after, 1), self.t_s.size - 1)
        known: Bools = inside & (self.t_s[after] - self.t_s[after - 1] <= self.limit_s)
        return known

    def instants(self, step_s: float, begin_s: float = -np.inf, end_s: float = np.inf) -> Floats:
        """Instants a step apart from the first row (or `begin_s`) on, one per row at most: none inside long pauses."""
        origin_s = max(self.t_s[0], begin_s)
        rows = self.t_s[(self.t_s >= origin_s) & (self.t_s < end_s)]
        return np.asarray(origin_s + np.unique(np.floor((rows - origin_s) / step_s)) * step_s)

    def at(self, t_s: Floats) -> Floats:
        """Values by straight lines."""
        axes = [np.interp(t_s, self.t_s, axis) for axis in np.atleast_2d(self.values.T)]
        return axes[0] if self.values.ndim == 1 else np.column_stack(axes)

    def gained(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Signed distance, or displacement, from some instants to others; NaN where it is not known."""
        gained = self.at(end_s) - self.at(begin_s)
        known = self.known(begin_s) & self.known(end_s)
        return np.where(known if gained.ndim == 1 else known[:, None], gained, np.nan)

    def speed(self, t_s: Floats, over_s: float = SPEED_S) -> Floats:
        """Signed speed of a counter in its units per second, of positions over ground; NaN where it is not known."""
        gained = self.gained(t_s - over_s / 2, t_s + over_s / 2)
        if gained.ndim == 1:
            return gained / over_s
        return np.where(self.known(t_s), np.linalg.norm(gained, axis=1) / over_s, np.nan)


@frozen
class Places(Record):
    """Positions over time, on the ellipsoid: distances at 1,000 m above it are longer by 2e-4; their heights
    separately.
    """

    points: Points
    height_m: Floats

    def moves(self, t_s: Floats) -> Bools:
        """Instants at which the train moves for certain."""
        moves: Bools = np.nan_to_num(self.speed(t_s)) > MOVING_MPS
        return moves

    def distance_m(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Distance run from some instants to others [m]: the chord, and by half of it what a curve adds; NaN where
        unknown.
        """
        instants = begin_s, (begin_s + end_s) / 2, end_s
        begin, middle, end = (np.where(self.known(t_s)[:, None], self.at(t_s), np.nan) for t_s in instants)
        chord, first, second = (np.linalg.norm(moved, axis=1) for moved in (end - begin, middle - begin, end - middle))
        return np.asarray(first + second + (first + second - chord) / 3.0)


def places_of(frame: pl.DataFrame, epoch_ns: int) -> Places | None:
    """Valid positions of a cleaned stream; None where there are hardly any."""
    degrees = np.stack([floats(frame, "latitude_deg"), floats(frame, "longitude_deg")])
    valid = np.isfinite(degrees).all(axis=0)
    if "fix" in frame.columns:
        valid &= truths(frame["fix"].cast(pl.String) != Fix.NONE.value)
    t_s = seconds_since(epoch_ns, frame)
    valid_rows = np.flatnonzero(valid)
    rows = valid_rows[_thinned(t_s[valid_rows])]
    if rows.size < _LEAST_ROWS:
        return None
    points = points_of(*degrees[:, rows])
    return Places(t_s[rows], points.surface, points, floats(frame, "height_m")[rows])


def counters_of(odometer: pl.DataFrame, epoch_ns: int) -> dict[str, Record]:
    """`distance`, and `speed` summed up, of an odometer, each where enough rows have it."""
    counters: dict[str, Record] = {}
    rows_s = seconds_since(epoch_ns, odometer)
    for name, column in ("distance", "distance_m"), ("speed", "speed_mps"):
        values = floats(odometer, column)
        known = np.isfinite(values)
        t_s, values = rows_s[known], values[known]
        if name == "speed" and values.size:
            values = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
        kept = _thinned(t_s)
        if kept.size >= _LEAST_ROWS:
            counters[name] = Record(t_s[kept], values[kept])
    return counters


def seconds_since(epoch_ns: int, frame: pl.DataFrame) -> Floats:
    """Times of a stream from an instant on [s]."""
    return np.asarray((times_ns(frame) - epoch_ns) * 1e-9, dtype=np.float64)


def _thinned(t_s: Floats) -> Ints:
    """Some two of the rows a second."""
    if t_s.size < 2 or np.median(np.diff(t_s)) >= 0.9 * _ROW_S:
        return np.arange(t_s.size)
    slot = np.floor((t_s - t_s[0]) / _ROW_S + 1e-6)
    return np.flatnonzero(np.diff(slot, prepend=-1.0) > 0)
