"""Carrying a known place along the track by the odometer (DOMAIN section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.evidence.routes import Place
from pipeline.odometry import Odometry, Way
from schemas.arrays import Floats, Ints
from schemas.config import Configuration
from schemas.enums import Evidence


@dataclass(frozen=True)
class Trust:
    """How far evidence goes: k sigma, and 5 m + 5 % of the way on one side of an anchor (SUBSET-041 5.3.1.1).

    `slip_m`, `slip_share`: how far a way between two anchors may differ from the odometer's; `routes`: how many chains
    between them are weighed.
    """

    factor: float
    fixed_m: float
    share: float
    slip_m: float
    slip_share: float
    routes: int

    @classmethod
    def of(cls, config: Configuration) -> Trust:
        hazards, lds = config.hazards, config.lds
        beside = hazards.evidence_factor, lds.odometer_fixed_m, lds.odometer_share
        return cls(*beside, hazards.slip_m, hazards.slip_share, hazards.routes_limit)

    def beside_m(self, driven_m: Floats, sigma_m: float) -> Floats:
        """Half the interval on one side of an anchor of this sigma."""
        half: Floats = max(self.fixed_m, self.factor * sigma_m) + self.share * driven_m
        return half


@dataclass(frozen=True)
class Anchor:
    """A place known by evidence at an instant."""

    t_ns: int
    place: Place
    sigma_m: float
    kind: Evidence


Interval = tuple[Floats, Floats]


def driven_m(odometer: Odometry, since_ns: int, t_ns: Ints) -> Floats:
    """Way driven from an instant to others, turns included [m]."""
    driven: Floats = np.abs(odometer.travelled_at(t_ns) - odometer.travelled_at(np.array([since_ns])))
    return driven


def beside_anchor(odometer: Odometry, anchor: Anchor, at_m: float, t_ns: Ints, trust: Trust) -> Interval:
    """Least and largest coordinate on one side of an anchor; NaN where the odometer does not reach."""
    centre = at_m + _from(odometer, anchor, t_ns).distance_m
    half = trust.beside_m(driven_m(odometer, anchor.t_ns, t_ns), anchor.sigma_m)
    return centre - half, centre + half


def between_anchors(
    odometer: Odometry, anchors: tuple[Anchor, Anchor], at_m: tuple[float, float], t_ns: Ints, trust: Trust
) -> Interval:
    """Least and largest coordinate between two anchors that lie at these coordinates of their route.

    The inverse-variance mean of what both say where a vehicle file's odometer closes, else the hull of both: the
    odometer lost or gained the difference somewhere between.
    """
    ways = [_from(odometer, anchor, t_ns) for anchor in anchors]
    places = [at + way.distance_m for at, way in zip(at_m, ways, strict=True)]
    variances = [anchor.sigma_m**2 + way.variance_m2 for anchor, way in zip(anchors, ways, strict=True)]
    if odometer.scale is not None and closes(odometer, anchors, at_m[1] - at_m[0], trust):
        weights = [1.0 / variance for variance in variances]
        centre = (weights[0] * places[0] + weights[1] * places[1]) / (weights[0] + weights[1])
        half = trust.factor / np.sqrt(weights[0] + weights[1])
        return centre - half, centre + half
    halves = [trust.factor * np.sqrt(variance) for variance in variances]
    low = np.minimum(places[0] - halves[0], places[1] - halves[1])
    return low, np.maximum(places[0] + halves[0], places[1] + halves[1])


def closes(odometer: Odometry, anchors: tuple[Anchor, Anchor], apart_m: float, trust: Trust) -> bool:
    """The odometer's way from anchor to anchor is their distance, within k times both roots combined."""
    begin, end = anchors
    way = _from(odometer, begin, np.array([end.t_ns]))
    root = np.sqrt(begin.sigma_m**2 + end.sigma_m**2 + way.variance_m2)
    return bool((np.abs(apart_m - way.distance_m) <= trust.factor * root)[0])


def _from(odometer: Odometry, anchor: Anchor, t_ns: Ints) -> Way:
    return odometer.between(np.full(t_ns.size, anchor.t_ns), t_ns)
