"""Carrying a known place along the track by the odometer (DOMAIN section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.evidence.routes import Place
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.enums import Evidence

_NOWHERE = -1


class OdometerReadings(Protocol):
    """What evidence asks of the odometer, at any instants (int64 nanoseconds)."""

    @property
    def begin_ns(self) -> int: ...
    @property
    def end_ns(self) -> int: ...
    def distance_at(self, t_ns: Ints) -> Floats: ...
    def travelled_at(self, t_ns: Ints) -> Floats: ...
    def moving_s_at(self, t_ns: Ints) -> Floats: ...
    def segment_at(self, t_ns: Ints) -> Ints: ...


@dataclass(frozen=True)
class Figures:
    """What is known of the odometer before the run, and how far evidence is trusted.

    `by_file`: scale and its sigma come from the vehicle file.
    """

    factor: float
    scale: float
    scale_sigma: float
    by_file: bool
    sigma_mps: float
    fixed_m: float
    share: float

    @classmethod
    def of(cls, vehicle: Vehicle, config: Configuration) -> Figures:
        """Scale and sigma of the vehicle file where it gives both, else scale 1 (DOMAIN section 5.1)."""
        scale, sigma = vehicle.odometer_scale, vehicle.odometer_scale_sigma
        known = scale is not None and sigma is not None
        return cls(
            factor=config.hazards.evidence_factor,
            scale=scale if known and scale is not None else 1.0,
            scale_sigma=sigma if known and sigma is not None else 0.0,
            by_file=known,
            sigma_mps=config.monitors.odometer_sigma_mps,
            fixed_m=config.lds.odometer_fixed_m,
            share=config.lds.odometer_share,
        )


@dataclass(frozen=True)
class Readings:
    """The odometer at some instants; NaN and segment -1 where it is silent."""

    t_ns: Ints
    distance_m: Floats
    travelled_m: Floats
    moving_s: Floats
    segment: Ints

    @classmethod
    def of(cls, odometry: OdometerReadings | None, t_ns: Ints) -> Readings:
        if odometry is None:
            unknown = np.full(t_ns.size, np.nan)
            return cls(t_ns, unknown, unknown, unknown, np.full(t_ns.size, _NOWHERE))
        distance_m = odometry.distance_at(t_ns)
        segment = np.where(np.isfinite(distance_m), odometry.segment_at(t_ns), _NOWHERE)
        return cls(t_ns, distance_m, odometry.travelled_at(t_ns), odometry.moving_s_at(t_ns), segment)

    def take(self, rows: Ints) -> Readings:
        return Readings(
            self.t_ns[rows], self.distance_m[rows], self.travelled_m[rows], self.moving_s[rows], self.segment[rows]
        )


@dataclass(frozen=True)
class Anchor:
    """A place known by evidence at an instant, with the odometer there."""

    t_ns: int
    place: Place
    sigma_m: float
    kind: Evidence
    distance_m: float
    travelled_m: float
    moving_s: float
    segment: int

    @property
    def counted(self) -> bool:
        """The odometer was there."""
        return self.segment != _NOWHERE


def joined(a: Anchor | None, b: Anchor | None) -> bool:
    """The odometer counted from the one anchor to the other without losing distance."""
    return a is not None and b is not None and a.counted and a.segment == b.segment


def way_m(anchor: Anchor, readings: Readings, figures: Figures) -> Floats:
    """Distance from the anchor by the odometer [m], in the direction in which it counts up."""
    way: Floats = figures.scale * (readings.distance_m - anchor.distance_m)
    return way


def root_m(anchor: Anchor, readings: Readings, figures: Figures) -> Floats:
    """Standard deviation of the carried place: sqrt(sigma_a^2 + sigma_odo^2 t + (sigma_s D)^2), t moving time."""
    moving_s = np.abs(readings.moving_s - anchor.moving_s)
    scale_m = figures.scale_sigma * (readings.travelled_m - anchor.travelled_m)
    root: Floats = np.sqrt(anchor.sigma_m**2 + figures.sigma_mps**2 * moving_s + scale_m**2)
    return root


def closing_m(a: Anchor, b: Anchor, apart_m: float, figures: Figures) -> float:
    """What the odometer lacks from anchor to anchor [m]."""
    return apart_m - figures.scale * (b.distance_m - a.distance_m)


def closes(a: Anchor, b: Anchor, apart_m: float, figures: Figures) -> bool:
    """The closing error is within k times both roots combined."""
    here = _reading_of(b)
    root = np.hypot(float(root_m(a, here, figures)[0]), b.sigma_m)
    return bool(abs(closing_m(a, b, apart_m, figures)) <= figures.factor * root)


def between_anchors(
    a: Anchor, b: Anchor, at_m: tuple[float, float], readings: Readings, figures: Figures
) -> tuple[Floats, Floats]:
    """Least and largest coordinate [m] between two anchors that lie at these coordinates of their route.

    The inverse-variance mean of what both say where a vehicle file's odometer closes; else the hull of both.
    """
    ahead, back = at_m[0] + way_m(a, readings, figures), at_m[1] + way_m(b, readings, figures)
    root_a, root_b = root_m(a, readings, figures), root_m(b, readings, figures)
    if figures.by_file and closes(a, b, at_m[1] - at_m[0], figures):
        weight_a, weight_b = root_a**-2.0, root_b**-2.0
        centre = (weight_a * ahead + weight_b * back) / (weight_a + weight_b)
        half = figures.factor / np.sqrt(weight_a + weight_b)
        return centre - half, centre + half
    low = np.minimum(ahead - figures.factor * root_a, back - figures.factor * root_b)
    high = np.maximum(ahead + figures.factor * root_a, back + figures.factor * root_b)
    return low, high


def beside_anchor(anchor: Anchor, at_m: float, readings: Readings, figures: Figures) -> tuple[Floats, Floats]:
    """Least and largest coordinate [m] on one side of an anchor: 5 m + 5 % of the way (SUBSET-041 5.3.1.1)."""
    centre = at_m + way_m(anchor, readings, figures)
    driven_m = np.abs(readings.travelled_m - anchor.travelled_m)
    half = max(figures.fixed_m, figures.factor * anchor.sigma_m) + figures.share * driven_m
    return centre - half, centre + half


def _reading_of(anchor: Anchor) -> Readings:
    one = [[anchor.distance_m], [anchor.travelled_m], [anchor.moving_s]]
    distance, travelled, moving = (np.array(value) for value in one)
    return Readings(np.array([anchor.t_ns]), distance, travelled, moving, np.array([anchor.segment]))
