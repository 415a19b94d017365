"""What alignment reads of the epochs, and the estimates of scale and latency in use at each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from schemas.arrays import Bools, Floats, Ints

# Over more periods a step tells nothing of the clock: the receiver may have started anew.
_REGULAR_PERIODS = 3


@dataclass(frozen=True)
class EpochArrays:
    """The matched epochs, in order: instants [ns], path positions [m] and their errors, usability; shapes (n,).

    `sigma_m`: as the receiver states it and `calibrate` found; `digits_m`: how coarsely positions are written down;
    `jitter_s`: by how much the stamps scatter about the receiver's regular times (see `stamp_jitter_s`).
    """

    t_ns: Ints
    path_m: Floats
    sigma_m: Floats
    digits_m: Floats
    usable: Bools
    jitter_s: float


class Estimate(NamedTuple):
    """Scale (true over odometer distance) and latency [s] with their standard deviations."""

    scale: float
    scale_sigma: float
    latency_s: float
    latency_sigma_s: float


@dataclass(frozen=True)
class Learned:
    """Estimates in use at each epoch; shapes (n,)."""

    scale: Floats
    scale_sigma: Floats
    latency_s: Floats
    latency_sigma_s: Floats

    @classmethod
    def constant(cls, estimate: Estimate, n: int) -> Learned:
        return cls(*(np.full(n, value) for value in estimate))

    def at(self, rows: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Scale, its sigma, latency [s] and its sigma at these epochs."""
        return self.scale[rows], self.scale_sigma[rows], self.latency_s[rows], self.latency_sigma_s[rows]

    def put(self, begins: Ints, estimates: Floats) -> None:
        """Set estimates (changes, 4): each change holds from its epoch to the next, the last for good."""
        lengths = np.diff(begins, append=self.scale.size)
        columns = (self.scale, self.scale_sigma, self.latency_s, self.latency_sigma_s)
        for column, value in zip(columns, estimates.T, strict=True):
            column[begins[0] :] = np.repeat(value, lengths)


def stamp_jitter_s(t_s: Floats) -> float:
    """Standard deviation of the stamps about a regular clock [s].

    A receiver measures at regular times; a recorder that stamps on receipt scatters them, and at 40 m/s ten
    milliseconds are 0.4 m from one epoch to the next. Only the stamps are looked at, never a position.
    """
    dt = np.diff(t_s)
    period = float(np.median(dt))
    periods = np.round(dt / period)
    regular = (periods >= 1) & (periods <= _REGULAR_PERIODS)
    away = (dt - periods * period)[regular]
    return float(np.sqrt(np.mean(away**2) / 2.0)) if away.size else 0.0
