"""Carrying a known place along the track by the odometer (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.odometry import Odometry
from pipeline.track.path import Place
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration
from schemas.enums import Evidence


@dataclass(frozen=True)
class Anchor:
    """A place known by evidence at an instant."""

    t_ns: int
    place: Place
    sigma_m: float
    kind: Evidence


Interval = tuple[Floats, Floats]


def beside_m(driven_m: Floats, sigma_m: float, config: Configuration) -> Floats:
    """Half the interval on one side of an anchor of this sigma: 5 m + 5 % of the way (SUBSET-041 5.3.1.1)."""
    lds, noise_m = config.lds, config.hazards.evidence_factor * sigma_m
    half: Floats = max(lds.odometer_fixed_m, noise_m) + lds.odometer_share * driven_m
    return half


def driven_m(odometer: Odometry, since_ns: Ints | int, t_ns: Ints) -> Floats:
    """Way driven from instants, or from one, to others, turns included [m]."""
    driven: Floats = np.abs(odometer.travelled_at(t_ns) - odometer.travelled_at(np.atleast_1d(since_ns)))
    return driven


def carried(
    odometer: Odometry, since_ns: Ints | int, at_m: Floats | float, sigma_m: float, t_ns: Ints, config: Configuration
) -> Interval:
    """Least and largest coordinate on one side of anchors of this sigma; NaN where the odometer does not reach.

    Of each instant `t_ns` the anchor, or the one of all: when it was, and its coordinate.
    """
    centre = at_m + odometer.between(since_ns, t_ns).distance_m
    half = beside_m(driven_m(odometer, since_ns, t_ns), sigma_m, config)
    return centre - half, centre + half


def between_anchors(
    odometer: Odometry, anchors: tuple[Anchor, Anchor], at_m: tuple[float, float], t_ns: Ints, config: Configuration
) -> Interval:
    """Least and largest coordinate between two anchors that lie at these coordinates of their route.

    The inverse-variance mean of what both say where a vehicle file's odometer closes, else the hull of both: the
    odometer lost or gained the difference somewhere between.
    """
    ways = [odometer.between(anchor.t_ns, t_ns) for anchor in anchors]
    places = [at + way.distance_m for at, way in zip(at_m, ways, strict=True)]
    variances = [anchor.sigma_m**2 + way.variance_m2 for anchor, way in zip(anchors, ways, strict=True)]
    if odometer.scale is not None and closes(odometer, anchors, at_m[1] - at_m[0], config):
        weights = [1.0 / variance for variance in variances]
        centre = (weights[0] * places[0] + weights[1] * places[1]) / (weights[0] + weights[1])
        half = config.hazards.evidence_factor / np.sqrt(weights[0] + weights[1])
        return centre - half, centre + half
    halves = [config.hazards.evidence_factor * np.sqrt(variance) for variance in variances]
    low = np.minimum(places[0] - halves[0], places[1] - halves[1])
    return low, np.maximum(places[0] + halves[0], places[1] + halves[1])


def closes(odometer: Odometry, anchors: tuple[Anchor, Anchor], apart_m: float, config: Configuration) -> bool:
    """The odometer's way from anchor to anchor is their distance, within k times both roots combined."""
    begin, end = anchors
    way = odometer.between(begin.t_ns, np.array([end.t_ns]))
    root = np.sqrt(begin.sigma_m**2 + end.sigma_m**2 + way.variance_m2)
    return bool((np.abs(apart_m - way.distance_m) <= config.hazards.evidence_factor * root)[0])


def carried_forward(
    accepted_ns: Ints,
    path_m: Floats,
    t_ns: Ints,
    odometer: Odometry,
    stood: Sequence[tuple[int, int]],
    config: Configuration,
) -> Interval:
    """Least and largest path position of the train [m], NaN where no accepted balise reaches.

    5 m + 5 % of the way since the last balise accepted (`accepted_ns`, in order, at `path_m` of the solution's own
    path), never bridged. It can show that something was wrong, never that it was right. A balise that was accepted
    beyond the limit by the one before is no anchor. `odometer` grows with the path.
    """
    used = _consistent(accepted_ns, path_m, odometer, config)
    low, high = np.full((2, t_ns.size), np.nan)
    if used.size:
        last = np.searchsorted(accepted_ns[used], t_ns, side="right") - 1
        rows = np.flatnonzero(last >= 0)
        own = used[last[rows]]
        found = carried(odometer, accepted_ns[own], path_m[own], 0.0, t_ns[rows], config)
        void = _stood_since(accepted_ns[own], t_ns[rows], stood)
        low[rows], high[rows] = (np.where(void, np.nan, values) for values in found)
    return low, high


def _consistent(accepted_ns: Ints, path_m: Floats, odometer: Odometry, config: Configuration) -> Ints:
    """Accepted balises, but for those that the odometer since the one before puts beyond the limit."""
    used: list[int] = []
    limit_m = config.hazards.failure_limit_m
    for number in range(path_m.size):
        here = slice(number, number + 1)
        if used:
            before = np.array(used[-1:])
            low, high = carried(odometer, accepted_ns[before], path_m[before], 0.0, accepted_ns[here], config)
            if path_m[number] < low[0] - limit_m or path_m[number] > high[0] + limit_m:
                continue
        if odometer.known_at(accepted_ns[here])[0]:
            used.append(number)
    return np.array(used, dtype=np.int64)


def _stood_since(begin_ns: Ints, t_ns: Ints, stood: Sequence[tuple[int, int]]) -> Bools:
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for from_ns, until_ns in stood:
        void |= (t_ns >= from_ns) & (begin_ns <= until_ns)
    return void
