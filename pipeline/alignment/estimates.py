"""Scale and latency as estimated, and how the stamps scatter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from schemas.arrays import Floats, Ints


class Estimates(NamedTuple):
    """Scale (true over odometer distance) and latency [s] with their standard deviations: of one, or epoch by epoch."""

    scale: Floats
    scale_sigma: Floats
    latency_s: Floats
    latency_sigma_s: Floats

    @classmethod
    def of(cls, scale: float, scale_sigma: float, latency_s: float, latency_sigma_s: float) -> Estimates:
        """One of each."""
        return cls(*(np.asarray(value) for value in (scale, scale_sigma, latency_s, latency_sigma_s)))

    def over(self, epochs: int) -> Estimates:
        """The same at so many epochs."""
        return Estimates(*(np.full(epochs, value) for value in self))

    def at(self, rows: Ints) -> Estimates:
        return Estimates(*(column[rows] for column in self))

    def put(self, begins: Ints, changes: Estimates) -> None:
        """Set changes: each holds from its epoch to the next, the last for good."""
        lengths = np.diff(begins, append=self.scale.size)
        for column, value in zip(self, changes, strict=True):
            column[begins[0] :] = np.repeat(value, lengths)


def stamp_jitter_s(t_s: Floats, clock_periods: float) -> float:
    """Standard deviation of the stamps about a regular clock [s].

    A receiver measures at regular times; a recorder that stamps on receipt scatters them, and at 40 m/s ten
    milliseconds are 0.4 m from one epoch to the next. Only the stamps are looked at, never a position. Steps of more
    than `clock_periods` tell nothing.
    """
    dt = np.diff(t_s)
    period = float(np.median(dt))
    periods = np.round(dt / period)
    regular = (periods >= 1) & (periods <= clock_periods)
    away = (dt - periods * period)[regular]
    return float(np.sqrt(np.mean(away**2) / 2.0)) if away.size else 0.0
