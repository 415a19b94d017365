"""Anchors: balise reads, and reference samples at the ends of their pauses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.evidence.carrying import Anchor, OdometerReadings, Readings
from pipeline.evidence.routes import Place, Route
from pipeline.track.survey import Track
from schemas.arrays import NS_PER_S, Floats, Ints, floats, times_ns
from schemas.config import HazardConfig
from schemas.enums import BaliseKind, Evidence

# A balise this far beyond its element's end is still on it: surveys and balise lists round [m].
_ON_ELEMENT_M = 0.5


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

    def place(self, sample: int) -> Place:
        element, measure, _ = self.legs[int(self.leg[sample])].locate(self.path_m[[sample]])
        return Place(int(element[0]), float(measure[0]))


@dataclass(frozen=True)
class Coverage:
    """Reference samples `first` to `last`, no two neighbours farther apart than a straight line reaches."""

    first: int
    last: int
    begin: Anchor
    end: Anchor


def coverages(
    reference: ReferencePlaces | None, odometry: OdometerReadings | None, config: HazardConfig
) -> list[Coverage]:
    """Stretches of time that the reference covers."""
    if reference is None or reference.t_ns.size == 0:
        return []
    breaks = np.flatnonzero(np.diff(reference.t_ns) > config.reference_gap_s * NS_PER_S)
    firsts = np.concatenate([[0], breaks + 1]).tolist()
    lasts = np.concatenate([breaks, [reference.t_ns.size - 1]]).tolist()
    ends = np.array([*firsts, *lasts], dtype=np.int64)
    places = [reference.place(sample) for sample in ends.tolist()]
    anchors = _anchors(reference.t_ns[ends], places, reference.sigma_m[ends], Evidence.REFERENCE, odometry)
    pairs = zip(anchors[: len(firsts)], anchors[len(firsts) :], strict=True)
    return [Coverage(first, last, begin, end) for first, last, (begin, end) in zip(firsts, lasts, pairs, strict=True)]


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
