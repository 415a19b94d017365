"""Anchors: balise reads, and reference samples at the ends of their pauses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import polars as pl

from pipeline.evidence.carrying import Anchor, OdometerReadings, Readings
from pipeline.evidence.routes import Place, Route, routes_of_path
from pipeline.track.path import TravelledPath
from pipeline.track.survey import Track
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import HazardConfig
from schemas.enums import BaliseKind, Evidence

# A balise this far beyond its element's end is still on it: surveys and balise lists round [m].
_ON_ELEMENT_M = 0.5
# So much way together says which way the odometer counts (DOMAIN section 2) [m].
_TURNED_M = 20.0

Pairs = tuple[Ints, Ints]


@dataclass(frozen=True)
class ReferencePlaces:
    """The reference on the network, placed by itself: samples in order of time, and the legs that they lie on.

    `path_m`: coordinate on the sample's leg, of the balise antenna; `rival_sample`, `rival_element`: further net
    elements that a sample may as well lie on.
    """

    t_ns: Ints
    leg: Ints
    path_m: Floats
    sigma_m: Floats
    legs: tuple[Route, ...]
    rival_sample: Ints
    rival_element: Ints

    @classmethod
    def of(
        cls, epochs: pl.DataFrame, path: TravelledPath, rivals: Pairs, sigma_m: Floats, ahead_m: float, track: Track
    ) -> Self:
        """Matched samples (`t, leg, path_m, on_track`) and their path; `ahead_m`: the reference's place ahead of the
        balise antenna, along growing path. `rivals`: samples and net elements (numbers of the survey).
        """
        kept = np.flatnonzero(flags(epochs, "on_track") & np.isfinite(floats(epochs, "path_m")))
        leg, path_m = ints(epochs["leg"])[kept], floats(epochs, "path_m")[kept]
        legs = tuple(routes_of_path(path, track.index))
        number = np.full(epochs.height, -1)
        number[kept] = np.arange(kept.size)
        sample, element = number[rivals[0]], rivals[1]
        other = np.flatnonzero((sample >= 0) & ~_on_own_way(legs, leg, sample, element))
        order = other[np.argsort(sample[other], kind="stable")]
        t_ns = times_ns(epochs)[kept]
        return cls(t_ns, leg, path_m - ahead_m, sigma_m[kept], legs, sample[order], element[order])

    def place(self, sample: int) -> Place:
        element, measure, _ = self.legs[int(self.leg[sample])].locate(self.path_m[[sample]])
        return Place(int(element[0]), float(measure[0]))


def _on_own_way(legs: tuple[Route, ...], leg: Ints, sample: Ints, element: Ints) -> Bools:
    """The net element is one that the sample's own leg runs over, sooner or later: no other track."""
    near = np.zeros(sample.size, dtype=np.bool_)
    for number, route in enumerate(legs):
        rows = np.flatnonzero((sample >= 0) & (leg[sample] == number))
        near[rows] = np.isin(element[rows], route.element)
    return near


@dataclass(frozen=True)
class Coverage:
    """Reference samples `first` to `last`, no two neighbours farther apart than a straight line reaches.

    `facing`: how the train ran over the net elements of both anchors as the odometer counted up, where it moved.
    """

    first: int
    last: int
    begin: Anchor
    end: Anchor
    facing: tuple[int, int] | None


def coverages(
    reference: ReferencePlaces | None, odometry: OdometerReadings | None, config: HazardConfig
) -> list[Coverage]:
    """Stretches of time that the reference covers."""
    if reference is None or reference.t_ns.size == 0:
        return []
    breaks = np.flatnonzero(np.diff(reference.t_ns) > config.reference_gap_s * NS_PER_S)
    firsts = np.concatenate([[0], breaks + 1]).tolist()
    lasts = np.concatenate([breaks, [reference.t_ns.size - 1]]).tolist()
    counted = np.isfinite(Readings.of(odometry, reference.t_ns).distance_m)
    inner = [_counted_ends(counted, first, last) for first, last in zip(firsts, lasts, strict=True)]
    ends = np.array([*(begin for begin, _ in inner), *(end for _, end in inner)], dtype=np.int64)
    places = [reference.place(sample) for sample in ends.tolist()]
    anchors = _anchors(reference.t_ns[ends], places, reference.sigma_m[ends], Evidence.REFERENCE, odometry)
    pairs = zip(anchors[: len(firsts)], anchors[len(firsts) :], strict=True)
    return [
        Coverage(first, last, begin, end, _facing(reference, first, last, odometry))
        for first, last, (begin, end) in zip(firsts, lasts, pairs, strict=True)
    ]


def _counted_ends(counted: Bools, first: int, last: int) -> tuple[int, int]:
    """The outermost samples at which the odometer counted, for only from these can a place be carried on."""
    own = first + np.flatnonzero(counted[first : last + 1])
    return (int(own[0]), int(own[-1])) if own.size else (first, last)


def _facing(
    reference: ReferencePlaces, first: int, last: int, odometry: OdometerReadings | None
) -> tuple[int, int] | None:
    """Orientation of the first and last sample's net elements in which the odometer counts up."""
    part = slice(first, last + 1)
    readings, path_m = Readings.of(odometry, reference.t_ns[part]), reference.path_m[part]
    step_m, counted_m = np.diff(path_m), np.diff(readings.distance_m)
    whole = (np.diff(readings.segment) == 0) & (np.diff(reference.leg[part]) == 0) & np.isfinite(counted_m)
    together_m = float((np.sign(step_m) * counted_m)[whole].sum())
    if abs(together_m) < _TURNED_M:
        return None
    ends = []
    for sample in _counted_ends(np.isfinite(readings.distance_m), 0, last - first):
        sample += first
        element, _, sense = reference.legs[int(reference.leg[sample])].locate(reference.path_m[[sample]])
        ends.append(2 * int(element[0]) + int(sense[0] * together_m < 0.0))
    return ends[0], ends[1]


def read_anchors(
    reads: pl.DataFrame | None,
    balises: pl.DataFrame | None,
    track: Track,
    odometry: OdometerReadings | None,
    config: HazardConfig,
) -> list[Anchor]:
    """Reads of physical balises that the site knows, in order of time."""
    if reads is None or balises is None or reads.is_empty():
        return []
    places = _physical_places(balises, track)
    known = reads.filter(pl.col("balise_id").is_in(list(places))).sort("t", "balise_id")
    at = [places[name] for name in known["balise_id"].to_list()]
    sigma_m = np.full(known.height, config.balise_read_sigma_m)
    return _anchors(times_ns(known), at, sigma_m, Evidence.BALISE, odometry)


def _physical_places(balises: pl.DataFrame, track: Track) -> dict[str, Place]:
    """Physical balises on their net elements; one beside its element lies nowhere."""
    physical = balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.PHYSICAL.value)
    places: dict[str, Place] = {}
    rows = zip(physical["balise_id"], physical["netelement_id"], floats(physical, "measure_m").tolist(), strict=True)
    for name, element, measure_m in rows:
        number = track.index.get(element)
        if number is None:
            continue
        own = track.measure_m[track.vertices(number)]
        if own[0] - _ON_ELEMENT_M <= measure_m <= own[-1] + _ON_ELEMENT_M:
            places[name] = Place(number, measure_m)
    return places


def _anchors(
    t_ns: Ints, places: list[Place], sigma_m: Floats, kind: Evidence, odometry: OdometerReadings | None
) -> list[Anchor]:
    at = Readings.of(odometry, t_ns)
    return [
        Anchor(
            t_ns=int(t_ns[row]),
            place=place,
            sigma_m=float(sigma_m[row]),
            kind=kind,
            distance_m=float(at.distance_m[row]),
            travelled_m=float(at.travelled_m[row]),
            moving_s=float(at.moving_s[row]),
            segment=int(at.segment[row]),
        )
        for row, place in enumerate(places)
    ]
