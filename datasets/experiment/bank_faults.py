"""The fault catalogue as the linear bank sees it: what each fault adds to the increments of its three axes.

Kinds whose course is known beforehand, of `catalogue_faults`; those that hang on satellites, maps and balises need the
replay. All begin at 0 s; the train runs at a steady speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from datasets.experiment.geometry import Geometry
from datasets.experiment.linear_bank import AXES, LinearBank
from schemas.arrays import Floats
from schemas.frozen import frozen

Kind = Literal["ramp", "step", "latency", "frozen", "slip", "slide", "scale", "odometer late", "noise"]
Shape = Literal["ramp", "step", "noise"]

HEADING_DEG = 30.0
SPEED_MPS = 30.0
_FAILURE_LIMIT_M = 20.0
_KINDS: dict[Kind, tuple[Shape, str, Callable[[float], float]]] = {
    # Course over time, unit, and the size in GNSS minus odometer: late positions and fast odometers leave GNSS behind.
    "ramp": ("ramp", "m/s", lambda size: size),
    "step": ("step", "m", lambda size: size),
    "noise": ("noise", "m", lambda size: size),
    "latency": ("step", "s", lambda size: -SPEED_MPS * size),
    "frozen": ("ramp", "", lambda _: -SPEED_MPS),
    "slip": ("ramp", "m/s", lambda size: -size),
    "slide": ("ramp", "m/s", lambda size: size),
    "scale": ("ramp", "", lambda size: -SPEED_MPS * (size - 1.0)),
    "odometer late": ("step", "s", lambda size: SPEED_MPS * size),
}


@frozen
class Fault:
    """An error that begins at 0 s: a ramp [m/s], a step [m], or white noise [m] of GNSS against odometer or track.

    `target`: `range` (of satellite 8, through the geometry), one axis of the position, or the odometer.
    """

    kind: Kind
    target: str
    size: float

    @property
    def name(self) -> str:
        return " ".join(part for part in (self.kind, f"{self.size:g}", _KINDS[self.kind][1], self.target) if part)

    @property
    def shape(self) -> Shape:
        return _KINDS[self.kind][0]

    def rates(self, geometry: Geometry, axes: int) -> Floats:
        """Per axis: the ramp [m/s], the step [m] or the sigma of the noise [m]."""
        if self.target == "range":
            return np.asarray(self.size * (geometry.axes(HEADING_DEG)[:axes] @ geometry.ramp_direction))
        wanted = np.zeros(len(AXES))
        wanted[AXES.index("along" if self.target == "odometer" else self.target)] = _KINDS[self.kind][2](self.size)
        return wanted[:axes]


def _of(kind: Kind, target: str, *sizes: float) -> tuple[Fault, ...]:
    return tuple(Fault(kind, target, size) for size in sizes)


CATALOGUE: tuple[Fault, ...] = (
    *_of("ramp", "range", 0.01, 0.03, 0.1, 0.3, 1.0, 5.0),
    *_of("step", "range", 10.0, 30.0, 100.0),
    *_of("ramp", "along", 0.01, 0.03, 0.1, 0.3, 1.0, 5.0),
    *_of("step", "along", 3.0, 10.0, 25.0, 100.0),
    *_of("ramp", "cross", 0.1, 1.0),
    *_of("step", "cross", 3.0, 10.0, 25.0),
    *_of("step", "up", 5.0, 15.0, 40.0),
    *_of("latency", "along", 0.2, 1.0, 3.0),
    *_of("frozen", "along", 1.0),
    *_of("noise", "along", 1.0, 3.0, 10.0),
    *_of("slip", "odometer", 0.3, 0.8, 3.0),
    *_of("slide", "odometer", 0.3, 0.8, 3.0),
    *_of("scale", "odometer", 1.001, 1.005, 1.02),
    *_of("odometer late", "odometer", 0.2, 1.0),
)


def fault_response(bank: LinearBank, rates: Floats, shape: Shape, epochs: int) -> Floats:
    """What the fault makes of every monitor at epochs 1 .. n on average, (epochs, monitors).

    An EWMA answers a ramp with 1 - (1-a)^k of its rate, and a step, which is one increment, with a (1-a)^(k-1) / dt.
    """
    k = np.arange(1, epochs + 1)[:, None]
    keep = 1.0 - bank.alpha
    per_monitor = np.repeat(rates, len(bank.spec.weights))
    if shape == "noise":
        return np.zeros((epochs, per_monitor.size))
    if shape == "ramp":
        return np.asarray((1.0 - keep**k) * per_monitor)
    return np.asarray(bank.alpha * keep ** (k - 1) * bank.spec.rate_hz * per_monitor)


class WhiteNoise:
    """What faults that are white noise on a position make of the monitors, epoch by epoch."""

    def __init__(self, bank: LinearBank, faults: Sequence[Fault], runs: int, rng: np.random.Generator) -> None:
        axes = bank.along_error.size
        self._rng = rng
        self._runs = runs
        self._keep = (1.0 - bank.alpha)[:, None]
        self._gain = (bank.alpha * bank.spec.rate_hz)[:, None]
        sizes = np.zeros((len(faults), axes))
        for row, fault in zip(sizes, faults, strict=True):
            if fault.shape == "noise":
                row[AXES.index(fault.target)] = fault.size
        self._sizes = np.repeat(sizes, len(bank.spec.weights), axis=1)[:, :, None]
        self._before = np.zeros(runs)
        self._filtered = np.zeros((bank.alpha.size, runs))

    def step(self, chosen: npt.NDArray[np.int64]) -> Floats:
        """At the next epoch, (chosen faults, monitors, runs); all such faults share their noise."""
        if not self._sizes.any():
            return np.zeros((1, 1, 1))
        now = self._rng.standard_normal(self._runs)
        self._filtered = self._keep * self._filtered + self._gain * (now - self._before)
        self._before = now
        return np.asarray(self._sizes[chosen] * self._filtered)


def failure_s(fault: Fault, geometry: Geometry) -> float | None:
    """When the mean along-track error of the position passes the limit [s]; None where it does not."""
    along = abs(float(fault.rates(geometry, 1)[0]))
    if fault.target == "odometer" or fault.shape == "noise":
        return None
    if fault.shape == "step":
        return 0.0 if along > _FAILURE_LIMIT_M else None
    return _FAILURE_LIMIT_M / along if along > 1e-9 else None
