"""Faults of position and odometer as functions of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.stages.judge.ground import Floats


@dataclass(frozen=True)
class Fault:
    """A fault of the GNSS from `begin_s` to `end_s`.

    `kind`: `step` (`size_m` ahead along the growing route), `pulses` (the same for `size_s` of each second), `ramp`
    (`rate_mps`, gone at the end), `return` (`size_m` at the middle and back to nothing), `cross` (`size_m` to the
    left), `other_track` (on the track beside it), `latency` (stamps `size_s` late, negative early), `tunnel` (no
    position; behind it `size_m` that fades with 20 s), `outage` (no position). `in_velocity`: the velocity carries the
    same fault (a filtered receiver, spoofing).
    """

    kind: str
    begin_s: float
    end_s: float
    size_m: float = 0.0
    rate_mps: float = 0.0
    size_s: float = 0.0
    in_velocity: bool = False

    def inside(self, time_s: Floats) -> NDArray[np.bool_]:
        return (time_s >= self.begin_s) & (time_s < self.end_s)

    def along_m(self, time_s: Floats) -> Floats:
        """What it adds along the growing route."""
        since = time_s - self.begin_s
        if self.kind == "step":
            return np.where(self.inside(time_s), self.size_m, 0.0)
        if self.kind == "pulses":
            return np.where(self.inside(time_s) & ((since + 1e-6) % 1.0 < self.size_s), self.size_m, 0.0)
        if self.kind == "ramp":
            return np.where(self.inside(time_s), self.rate_mps * since, 0.0)
        if self.kind == "return":
            half = (self.end_s - self.begin_s) / 2
            return np.where(self.inside(time_s), self.size_m * (1 - np.abs(since - half) / half), 0.0)
        if self.kind == "tunnel":
            after = time_s - self.end_s
            return np.where(after >= 0, self.size_m * np.exp(-np.maximum(after, 0.0) / 20.0), 0.0)
        return np.zeros_like(time_s)

    def left_m(self, time_s: Floats, other_m: Floats) -> Floats:
        """What it adds to the left; `other_m`: how far to the left the other track lies."""
        if self.kind == "other_track":
            return np.where(self.inside(time_s), other_m, 0.0)
        return np.where(self.inside(time_s), self.size_m if self.kind == "cross" else 0.0, 0.0)

    def late_s(self, time_s: Floats) -> Floats:
        return np.where(self.inside(time_s), self.size_s if self.kind == "latency" else 0.0, 0.0)

    def silent(self, time_s: Floats) -> NDArray[np.bool_]:
        """No position is given."""
        return self.inside(time_s) & (self.kind in ("tunnel", "outage"))


@dataclass(frozen=True)
class Slip:
    """A fault of the odometer from `begin_s` to `end_s`.

    `kind`: `slip` (counts `extra_m` too many, negative: slide), `freeze` (stands), `outage` (no rows).
    """

    kind: str
    begin_s: float
    end_s: float
    extra_m: float = 0.0
    flagged: bool = False

    def inside(self, time_s: Floats) -> NDArray[np.bool_]:
        return (time_s >= self.begin_s) & (time_s < self.end_s)
