"""Known places carried on by the odometer: physical balise reads, accepted virtual balises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.epochs.timeline import linking_gap_s, nominal_period_s
from pipeline.figures.bounds import SURE_SIGMAS
from pipeline.hazards.travel import Travel
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import LdsConfig

# Sigmas of its own noise by which a slip between two anchors may be larger than it shows.
_WIDENED = 3.0


@dataclass(frozen=True)
class Anchors:
    """Instants at which the train was at a known path position, in order of time.

    `odometer_m`: the odometer at that instant, as at the epochs; NaN where only the epochs around can tell it.
    """

    at_ns: Ints
    path_m: Floats
    odometer_m: Floats

    @classmethod
    def of(cls, at_ns: Ints, path_m: Floats, odometer_m: Floats | None = None) -> Anchors:
        counted = np.full(at_ns.size, np.nan) if odometer_m is None else odometer_m
        known = np.isfinite(path_m)
        order = np.argsort(at_ns[known], kind="stable")
        return cls(at_ns[known][order], path_m[known][order], counted[known][order])

    def with_others(self, others: Anchors) -> Anchors:
        return Anchors.of(
            np.concatenate((self.at_ns, others.at_ns)),
            np.concatenate((self.path_m, others.path_m)),
            np.concatenate((self.odometer_m, others.odometer_m)),
        )


@dataclass(frozen=True)
class Carried:
    """Position by the nearest anchor and the odometer [m]; NaN where no anchor reaches.

    `confidence_m` is the odometer's half-width (SUBSET-041 5.3.1.1), `slip_m` by how much at most it counted too far
    along growing path between two anchors, 0 where that is within its white noise: nobody knows where it slipped, or
    whether its scale is wrong, so the place between may be wrong by as much. `share`: of the way from the anchor before
    to the one behind, 0 at the former. `backward`: before the first anchor, so that nothing but the odometer itself
    speaks for the way in between.
    """

    path_m: Floats
    sigma_m: Floats
    confidence_m: Floats
    slip_m: Floats
    share: Floats
    backward: Bools


def carry(
    anchors: Anchors, travel: Travel, at_ns: Ints, lds: LdsConfig, *, both_ways: bool, anchor_sigma_m: float = 0.0
) -> Carried:
    """Carry anchors, known to `anchor_sigma_m`, on to every epoch of their odometer stretch.

    With `both_ways` an epoch between two anchors takes its place from both, the difference shared out
    by distance, and epochs before the first anchor are reached backwards.
    """
    reader = _AnchorReader.of(anchors, travel)
    before = np.searchsorted(reader.at_ns, at_ns, side="right") - 1
    forward = reader.reach(before, travel, lds)
    if not both_ways:
        return Carried(*forward, np.zeros(at_ns.size), np.zeros(at_ns.size), np.zeros(at_ns.size, dtype=np.bool_))
    backward = reader.reach(before + 1, travel, lds)
    return _between(forward, backward, reader, before, travel, anchor_sigma_m)


@dataclass(frozen=True)
class _AnchorReader:
    """Anchors with the odometer at their instants."""

    at_ns: Ints
    path_m: Floats
    distance_m: Floats
    stretch: Ints
    reading_m2: Floats

    @classmethod
    def of(cls, anchors: Anchors, travel: Travel) -> _AnchorReader:
        known = np.flatnonzero(np.isfinite(travel.distance_m))
        if known.size == 0 or anchors.at_ns.size == 0:
            return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0))
        stamps = travel.at_ns[known]
        right = np.clip(np.searchsorted(stamps, anchors.at_ns), 0, known.size - 1)
        left = np.where(stamps[right] > anchors.at_ns, np.maximum(right - 1, 0), right)
        counted = np.isfinite(anchors.odometer_m)
        since_m = anchors.odometer_m - travel.odometer_m[known[left]]
        between_m = np.interp(anchors.at_ns, stamps, travel.distance_m[known])
        distance = np.where(counted, travel.distance_m[known[left]] + since_m, between_m)
        usable = counted | _interpolable(anchors.at_ns, stamps, left, right, travel.stretch[known])
        rows = known[left][usable]
        return cls(
            anchors.at_ns[usable],
            anchors.path_m[usable],
            distance[usable],
            travel.stretch[rows],
            travel.reading_m2[rows],
        )

    def reach(self, index: Ints, travel: Travel, lds: LdsConfig) -> tuple[Floats, Floats, Floats]:
        """Position, its sigma and the odometer's confidence by the anchor `index` of each epoch."""
        if self.at_ns.size == 0:
            nothing = np.full(index.size, np.nan)
            return nothing, nothing, nothing
        safe = np.clip(index, 0, self.at_ns.size - 1)
        reached: Bools = (index == safe) & (self.stretch[safe] == travel.stretch)
        moved = np.where(reached, travel.distance_m - self.distance_m[safe], np.nan)
        elapsed_s = np.abs(travel.at_ns - self.at_ns[safe]) / NS_PER_S
        readings_m2 = travel.reading_m2 + self.reading_m2[safe]
        variance = travel.white_m2_per_s * elapsed_s + (travel.scale_sigma * moved) ** 2 + readings_m2
        confidence = lds.odometer_fixed_m + lds.odometer_share * np.abs(moved)
        return self.path_m[safe] + moved, np.sqrt(variance), confidence


def _interpolable(at_ns: Ints, stamps: Ints, left: Ints, right: Ints, stretch: Ints) -> Bools:
    """Between epochs as near as for a crossing: over an outage the train may have braked or started meanwhile."""
    gap_ns = linking_gap_s(nominal_period_s(stamps)) * NS_PER_S
    inside = (stamps[left] <= at_ns) & (at_ns <= stamps[right])
    near: Bools = inside & (stamps[right] - stamps[left] <= gap_ns) & (stretch[left] == stretch[right])
    return near


def _between(
    forward: tuple[Floats, Floats, Floats],
    backward: tuple[Floats, Floats, Floats],
    reader: _AnchorReader,
    before: Ints,
    travel: Travel,
    anchor_sigma_m: float,
) -> Carried:
    ahead, behind = np.isfinite(forward[0]), np.isfinite(backward[0])
    both = ahead & behind
    share = np.where(both, _share_of_way(reader, before, travel), np.where(ahead, 0.0, 1.0))

    def blend(a: Floats, b: Floats) -> Floats:
        return np.where(both, a * (1.0 - share) + b * share, np.where(ahead, a, b))

    def smaller(a: Floats, b: Floats) -> Floats:
        return np.where(both, np.minimum(a, b), np.where(ahead, a, b))

    difference = np.where(both, np.nan_to_num(forward[0]) - np.nan_to_num(backward[0]), 0.0)
    noise = np.hypot(np.sqrt(_white_m2(reader, before, travel)), np.sqrt(2.0) * anchor_sigma_m)
    allowed = np.minimum(SURE_SIGMAS * noise, np.nan_to_num(forward[2]) + np.nan_to_num(backward[2]))
    widened = difference + np.sign(difference) * _WIDENED * noise
    return Carried(
        path_m=blend(forward[0], backward[0]),
        sigma_m=smaller(forward[1], backward[1]),
        confidence_m=smaller(forward[2], backward[2]),
        slip_m=np.where(np.abs(difference) > allowed, widened, 0.0),
        share=share,
        backward=behind & ~ahead,
    )


def _white_m2(reader: _AnchorReader, before: Ints, travel: Travel) -> Floats:
    """Variance of the odometer's way from the anchor before each epoch to the one behind [m2]."""
    if reader.at_ns.size < 2:
        return np.zeros(before.size)
    a = np.clip(before, 0, reader.at_ns.size - 2)
    white: Floats = travel.white_m2_per_s * (reader.at_ns[a + 1] - reader.at_ns[a]) / NS_PER_S
    return white + reader.reading_m2[a] + reader.reading_m2[a + 1]


def _share_of_way(reader: _AnchorReader, before: Ints, travel: Travel) -> Floats:
    """How far each epoch is from the anchor before to the one behind, 0 to 1, by distance.

    By time where the train stood or turned back between the anchors.
    """
    if reader.at_ns.size < 2:
        return np.zeros(before.size)
    a = np.clip(before, 0, reader.at_ns.size - 2)
    length = reader.distance_m[a + 1] - reader.distance_m[a]
    span = np.maximum(reader.at_ns[a + 1] - reader.at_ns[a], 1)
    by_time = (travel.at_ns - reader.at_ns[a]) / span
    with np.errstate(divide="ignore", invalid="ignore"):
        by_way = (travel.distance_m - reader.distance_m[a]) / length
    monotone = (np.abs(length) > 1.0) & (by_way >= 0.0) & (by_way <= 1.0)
    return np.clip(np.where(monotone, by_way, by_time), 0.0, 1.0)
