"""How a train moves: phases of constant acceleration, and the exact distance and speed at any time."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from schemas.arrays import Floats
from schemas.config import NonNegative, Positive, Settings
from schemas.enums import Direction
from schemas.errors import ConfigError
from schemas.frozen import frozen


class PhaseSpec(Settings):
    """One phase: go to `speed_mps` (negative runs backwards), or on to a stop at `stop_at_m`; then hold for a while.

    `hold_m` is a length run at that speed; at a stop `hold_s` is the dwell time.
    """

    speed_mps: float | None = None
    stop_at_m: NonNegative | None = None
    acceleration_mps2: Positive = 0.5
    hold_s: NonNegative = 0.0
    hold_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _require_one_aim(self) -> Self:
        """A phase has a speed or a stop, and holds a length only while moving."""
        if (self.speed_mps is None) == (self.stop_at_m is None):
            raise ValueError("a phase needs either speed_mps or stop_at_m")
        if self.hold_m and (self.hold_s or not self.speed_mps):
            raise ValueError("hold_m needs a speed_mps other than 0, and no hold_s")
        return self


class MotionSpec(Settings):
    """A journey from standstill at chainage `start_m`, the leading end facing growing or falling chainage."""

    start_m: NonNegative
    direction: Direction = Direction.GROWING
    stand_s: NonNegative = 5.0
    phases: Annotated[tuple[PhaseSpec, ...], Field(min_length=1)]


@frozen
class Motion:
    """Distance run ahead (falling when reversing) as joined parabolas: each holds from `knots_s[i]` on."""

    start_m: float
    sign: int
    knots_s: Floats
    distances_m: Floats
    speeds_mps: Floats
    accelerations_mps2: Floats

    @property
    def duration_s(self) -> float:
        """Length of the journey [s]."""
        return float(self.knots_s[-1])

    def distance_m(self, t_s: Floats) -> Floats:
        """Distance from the start [m]; before the start and after the end the train stands."""
        i, since = self._piece_at(t_s)
        distance: Floats = (
            self.distances_m[i] + self.speeds_mps[i] * since + 0.5 * self.accelerations_mps2[i] * since**2
        )
        return distance

    def speed_mps(self, t_s: Floats) -> Floats:
        """Signed speed, positive ahead."""
        i, since = self._piece_at(t_s)
        speed: Floats = self.speeds_mps[i] + self.accelerations_mps2[i] * since
        return speed

    def chainage_m(self, t_s: Floats) -> Floats:
        """Chainage at these times [m]."""
        return self.start_m + self.sign * self.distance_m(t_s)

    def time_at(self, s_m: float) -> float:
        """When the train first reaches a chainage [s]."""
        grid = np.linspace(0.0, self.duration_s, int(self.duration_s * 20) + 2)
        ahead = self.sign * (self.chainage_m(grid) - s_m)
        reached = np.flatnonzero(ahead >= 0.0)
        if reached.size == 0:
            raise ConfigError("a fault is placed where the train does not run", place="scenario", found=f"at_m = {s_m}")
        i = int(reached[0])
        if i == 0:
            return 0.0
        share = -ahead[i - 1] / (ahead[i] - ahead[i - 1])
        return float(grid[i - 1] + share * (grid[i] - grid[i - 1]))

    def _piece_at(self, t_s: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
        """The parabola that each time lies in, and the time since its begin [s]."""
        inside = np.clip(t_s, 0.0, self.duration_s)
        index = np.searchsorted(self.knots_s, inside, side="right") - 1
        return index, inside - self.knots_s[index]


def build_motion(spec: MotionSpec) -> Motion:
    """Lay the phases end to end; the journey ends with the last one."""
    sign = 1 if spec.direction is Direction.GROWING else -1
    pieces = _MotionPieces(spec.start_m, sign)
    pieces.add_piece(spec.stand_s, 0.0)
    for phase in spec.phases:
        if phase.stop_at_m is not None:
            pieces.stop_at_chainage(phase.stop_at_m, phase.acceleration_mps2)
        else:
            pieces.reach_speed(phase.speed_mps or 0.0, phase.acceleration_mps2)
        hold_s = phase.hold_m / abs(pieces.speed) if phase.hold_m else phase.hold_s
        pieces.add_piece(hold_s, 0.0)
    return pieces.finish()


class _MotionPieces:
    """The journey so far."""

    def __init__(self, start_m: float, sign: int) -> None:
        self.start_m = start_m
        self.sign = sign
        self.time, self.distance, self.speed = 0.0, 0.0, 0.0
        self.rows: list[tuple[float, float, float, float]] = []

    def add_piece(self, duration_s: float, acceleration: float) -> None:
        """Go on at constant acceleration for a time."""
        if duration_s <= 0.0:
            return
        self.rows.append((self.time, self.distance, self.speed, acceleration))
        self.distance += self.speed * duration_s + 0.5 * acceleration * duration_s**2
        self.speed += acceleration * duration_s
        self.time += duration_s

    def reach_speed(self, speed: float, acceleration: float) -> None:
        """Accelerate or brake up to a speed."""
        change = speed - self.speed
        self.add_piece(abs(change) / acceleration, float(np.copysign(acceleration, change)))
        self.speed = speed

    def stop_at_chainage(self, at_m: float, deceleration: float) -> None:
        """Hold the speed until braking brings the train to a stand at the chainage."""
        left_m = self.sign * (at_m - self.start_m) - self.distance
        braking_m = 0.5 * self.speed * abs(self.speed) / deceleration
        if self.speed == 0.0 or (left_m - braking_m) / self.speed < 0.0:
            raise ConfigError(
                "the train cannot stop there",
                place="scenario: motion",
                found=f"stop_at_m = {at_m}, {left_m:.1f} m ahead at {self.speed:.1f} m/s",
                expected=f"at least {abs(braking_m):.1f} m to brake, in the direction of motion",
            )
        self.add_piece((left_m - braking_m) / self.speed, 0.0)
        self.reach_speed(0.0, deceleration)

    def finish(self) -> Motion:
        """The whole journey."""
        rows = [*self.rows, (self.time, self.distance, self.speed, 0.0)]
        columns = np.array(rows, dtype=np.float64).T
        return Motion(self.start_m, self.sign, *columns)
