"""The odometer at given instants: where its samples lie about them, and all figures there, each made once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.stages.odometry.driven import hysteresis_m
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

if TYPE_CHECKING:
    from pipeline.stages.odometry.odometry import Odometry
    from pipeline.stages.odometry.quantisation import KnownNoise


class StepTimes(NamedTuple):
    """Begin and end of each step [s], shape (n,)."""

    begin_s: Floats
    end_s: Floats

    def at_begins(self, at_ends: Floats, look_up: Callable[[Floats], Floats]) -> Floats:
        """Figures at the begins: mostly those at the end of the step before, else looked up."""
        before = np.concatenate([at_ends[:1], at_ends[:-1]])
        others = np.flatnonzero(self.begin_s != np.concatenate([self.end_s[:1], self.end_s[:-1]]))
        before[others] = look_up(self.begin_s[others])
        return before


@frozen(eq=False)
class OdometerReading:
    """What `odometry` says of the instants `t_s` [s since its first row]; all figures are arrays of shape (n,).

    Whoever asks more than one question about the same instants asks them of one reading.
    """

    odometry: Odometry
    t_s: Floats

    @cached_property
    def inside(self) -> Bools:
        """Within the recording."""
        rows_s = self.odometry.t_s
        return np.asarray((self.t_s >= rows_s[0]) & (self.t_s <= rows_s[-1]))

    @cached_property
    def slips(self) -> Bools:
        """Whether the sample before or after is slip."""
        if not self.odometry.has_slips:
            return np.zeros(self.t_s.size, dtype=np.bool_)
        before, after = self._around
        return np.asarray(self.odometry.slip[before] | self.odometry.slip[after])

    @cached_property
    def known(self) -> Bools:
        """Between two samples without a pause, none of which reports slip."""
        known = self.inside
        if self.odometry.has_pauses:
            before, after = self._around
            pause = self.odometry.pause
            known = known & ~((before != after) & pause[np.minimum(before, pause.size - 1)])
        return known & ~self.slips if self.odometry.has_slips else known

    @cached_property
    def doubt_m(self) -> Floats:
        """Distances compare to a millimetre where it is the same, and not at all across a loss (`is_lost`) [m]."""
        sums_m = self.odometry.doubt_m
        # A sum that ends at zero was zero all along.
        return np.interp(self.t_s, self.odometry.t_s, sums_m) if sums_m[-1] else np.zeros(self.t_s.size)

    @cached_property
    def distance_m(self) -> Floats:
        """Interpolated where it is not known, the end value outside the recording [m]."""
        return self.odometry.distance_at_s(self.t_s)

    @cached_property
    def speed_mps(self) -> Floats:
        """Mean over the second before [m/s]."""
        rows_s = self.odometry.t_s
        start_s = np.maximum(self.t_s - self.odometry.config.speed_window_s, rows_s[0])
        span_s = np.maximum(np.minimum(self.t_s, rows_s[-1]) - start_s, 1e-9)
        return np.asarray((self.distance_m - self.odometry.distance_at_s(start_s)) / span_s)

    @property
    def noise(self) -> KnownNoise:
        """The noise as the rows up to each instant show it."""
        return self.odometry.known_noise.at(self._sample)

    @property
    def noise_shown(self) -> Bools:
        """Whether the rows up to each instant show by how much they scatter."""
        return self.odometry.known_noise.shown[self._sample]

    @property
    def period_s(self) -> Floats:
        """The period of the rows, as known at each instant [s]."""
        return self.odometry.known_noise.period_s[self._sample]

    @cached_property
    def row_sigma_m(self) -> Floats:
        """Sigma of the rows' noise, as known at these instants [m]."""
        if not self.odometry.known_noise.scatters:
            return np.zeros(self.t_s.size)
        return np.sqrt(self.noise.row_m2(self.speed_mps))

    @property
    def hysteresis_m(self) -> Floats:
        """How far the distance may leave the held distance before that follows, as known at these instants [m].

        Before it is known by how much rows scatter nothing moves; what was driven counts once it is.
        """
        return np.where(self.noise_shown, hysteresis_m(self.row_sigma_m, self.odometry.config), np.inf)

    @property
    def white_m2_per_s(self) -> Floats:
        """White noise of the steps to these instants as known there, with that of bridged resets [m^2/s]."""
        white = self.odometry.known_noise.white_m2_per_s[self._sample]
        if self.odometry.bridged_m2 is not None:
            dt_s = np.diff(self.t_s)
            bridged_m2 = np.diff(self.odometry.bridged_m2_at(self.t_s))
            white[1:] += np.where(dt_s > 0.0, bridged_m2 / np.maximum(dt_s, 1e-9), 0.0)
        return white

    @cached_property
    def _last(self) -> Ints:
        """The last sample not after each instant; -1 before the recording."""
        if self.t_s is self.odometry.t_s:
            return np.arange(self.t_s.size)
        last: Ints = np.searchsorted(self.odometry.t_s, self.t_s, side="right") - 1
        return last

    @cached_property
    def _sample(self) -> Ints:
        """The same; the first one before the recording."""
        return np.maximum(self._last, 0)

    @cached_property
    def _around(self) -> tuple[Ints, Ints]:
        """Samples before and after each instant; twice the same at a sample."""
        at_sample = self.odometry.t_s[self._sample] == self.t_s
        after = np.minimum(self._last + ~at_sample, self.odometry.t_s.size - 1)
        return np.where(at_sample, after, np.maximum(after - 1, 0)), after
