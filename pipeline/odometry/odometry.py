"""The odometer of a run, made once and handed to everyone who asks how far, how fast and whether the train moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.odometry.odometer import OdometerTrack, odometer_track
from pipeline.odometry.scatter import play_m, with_play
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, Vehicle

_SPEED_WINDOW_S = 1.0


@dataclass(frozen=True)
class Odometry:
    """Distance over time in continuity segments, with its noise. Instants are int64 nanoseconds, distances metres.

    Distances are as recorded (`scale`, true over recorded distance, is not applied) and grow with the path once
    `oriented`. `scale_sigma` belongs to `scale`; both are None unless the vehicle file gives them.
    """

    track: OdometerTrack
    deadband_mps: float
    scale: float | None = None
    scale_sigma: float | None = None

    @property
    def begin_ns(self) -> int:
        """The first row."""
        return self.track.epoch_ns

    @property
    def end_ns(self) -> int:
        """The last row."""
        return self.track.epoch_ns + int(np.ceil(self.track.t_s[-1] * 1e9))

    def oriented(self, sign: int) -> Odometry:
        """The same odometer, growing with the path; `sign` is +1 or -1."""
        return replace(self, track=self.track.oriented(sign))

    def known_at(self, t_ns: Ints) -> Bools:
        """Whether the distance is known: between two rows without a pause, none of which reports slip."""
        return self.track.known_at(self._seconds(t_ns))

    def segment_at(self, t_ns: Ints) -> Ints:
        """Number of the continuity segment: distances can be compared only where it is the same."""
        return self.track.stretch_at(self._seconds(t_ns))

    def slip_at(self, t_ns: Ints) -> Bools:
        """Whether the odometer itself reports slip or slide in the row at the instant, or in one next to it."""
        t_s, rows = self._seconds(t_ns), self.track.t_s
        after = np.searchsorted(rows, t_s, side="left").clip(0, rows.size - 1)
        before = np.where(rows[after] == t_s, after, np.maximum(after - 1, 0))
        inside = (t_s >= rows[0]) & (t_s <= rows[-1])
        return np.asarray(inside & (self.track.slip[before] | self.track.slip[after]))

    def distance_at(self, t_ns: Ints) -> Floats:
        """Distance at these instants [m], as recorded; NaN where it is not known."""
        t_s = self._seconds(t_ns)
        return np.where(self.track.known_at(t_s), self.track.distance_at(t_s), np.nan)

    def speed_at(self, t_ns: Ints) -> Floats:
        """Mean speed over the second before [m/s], as recorded; NaN where the distance is not known."""
        t_s = self._seconds(t_ns)
        return np.where(self.track.known_at(t_s), self.track.speed_at(t_s), np.nan)

    def travelled_at(self, t_ns: Ints) -> Floats:
        """Way driven since the first row [m], turns included; a best guess where the distance is not known.

        Quantisation noise is neither way nor turn, and noise at standstill adds up to no more than it moves the place.
        """
        return np.interp(self._seconds(t_ns), self.track.t_s, self._driven[0])

    def moving_s_at(self, t_ns: Ints) -> Floats:
        """Time since the first row in which the train moved [s]."""
        return np.interp(self._seconds(t_ns), self.track.t_s, self._driven[1])

    def _seconds(self, t_ns: Ints) -> Floats:
        return self.track.seconds(t_ns)

    @cached_property
    def _driven(self) -> tuple[Floats, Floats]:
        """Way driven [m] and time moving [s] up to each row."""
        t_s, noise = self.track.t_s, self.track.reading
        width_m = play_m(np.sqrt(noise.variance_m2(self.track.speed_at(t_s))))
        held = with_play(self.track.distance_m, width_m) if noise else self.track.distance_m
        step_s = np.diff(t_s)
        half_s, centre = 0.5 * np.maximum(step_s, _SPEED_WINDOW_S), 0.5 * (t_s[1:] + t_s[:-1])
        begin, end = np.interp(centre - half_s, t_s, held), np.interp(centre + half_s, t_s, held)
        moving = np.abs(end - begin) > self.deadband_mps * 2.0 * half_s
        # Of a stand only its net way counts, for the noise of its steps would add up.
        edge = np.flatnonzero(np.diff(moving, prepend=~moving[:1]))
        lengths = np.diff(edge, append=moving.size)
        net = np.abs(held[edge + lengths] - held[edge])
        way = np.where(moving, np.abs(np.diff(held)), np.repeat(net / lengths, lengths))
        return np.append(0.0, np.cumsum(way)), np.append(0.0, np.cumsum(np.where(moving, step_s, 0.0)))


def odometry_of(stream: pl.DataFrame | None, vehicle: Vehicle, config: Configuration) -> Odometry | None:
    """The odometer of a cleaned stream (CONTRACT section 1), as recorded; None without at least two rows."""
    if stream is None or stream.height < 2:
        return None
    track = odometer_track(stream, config.align.odometer_gap_s, config.monitors.odometer_sigma_mps)
    known = vehicle.odometer_scale is not None and vehicle.odometer_scale_sigma is not None
    scale = (vehicle.odometer_scale, vehicle.odometer_scale_sigma) if known else (None, None)
    return Odometry(track, config.matching.deadband_mps, *scale)
