"""How the train moves: its way over the route as a function of time, and nothing measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.stages.judge.ground import Floats

TICK_S = 0.02


@dataclass(frozen=True)
class Leg:
    """Change to a signed speed at `acceleration_mps2`, then hold it."""

    speed_mps: float
    hold_s: float
    acceleration_mps2: float = 0.6


@dataclass(frozen=True)
class Ride:
    """Seconds from the start of the run, way [m] and speed [m/s] along the route at each tick."""

    time_s: Floats
    track_m: Floats
    velocity_mps: Floats

    @property
    def length_s(self) -> float:
        return float(self.time_s[-1])

    def chainage_m(self, time_s: Floats) -> Floats:
        """Way over the route; before the start and after the end the train stands."""
        return np.interp(time_s, self.time_s, self.track_m)

    def speed_mps(self, time_s: Floats) -> Floats:
        return np.interp(time_s, self.time_s, self.velocity_mps)

    def sense(self, time_s: Floats) -> Floats:
        """+1 or -1 along the route, of the last time it moved."""
        return self._senses[np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)]

    @property
    def _senses(self) -> Floats:
        moved = np.abs(self.velocity_mps) > 0.05
        last = np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))
        last = np.where(last == 0, np.argmax(moved), last)
        return np.sign(self.velocity_mps[last])

    def passings_s(self, chainage_m: float) -> list[float]:
        """When the train passes a place."""
        side = np.sign(self.track_m - chainage_m)
        at = np.flatnonzero(side[1:] * side[:-1] < 0)
        share = (chainage_m - self.track_m[at]) / (self.track_m[at + 1] - self.track_m[at])
        return [float(time) for time in self.time_s[at] + share * TICK_S]


def make_ride(legs: list[Leg], start_m: float) -> Ride:
    """The legs one after the other, from standstill at `start_m`."""
    speeds: list[Floats] = [np.zeros(1)]
    for leg in legs:
        begin = float(speeds[-1][-1])
        change_s = abs(leg.speed_mps - begin) / leg.acceleration_mps2
        change = np.linspace(begin, leg.speed_mps, max(round(change_s / TICK_S), 1) + 1, dtype=np.float64)
        speeds.append(change[1:])
        speeds.append(np.full(round(leg.hold_s / TICK_S), leg.speed_mps))
    velocity: Floats = np.concatenate(speeds)
    track = start_m + np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2 * TICK_S)])
    return Ride(np.arange(len(velocity), dtype=np.float64) * TICK_S, np.asarray(track, np.float64), velocity)
