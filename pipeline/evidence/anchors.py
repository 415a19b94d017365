"""Anchors: balise reads, and reference samples at the ends of their pauses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import polars as pl

from pipeline.evidence.carrying import Anchor
from pipeline.odometry import Odometry
from pipeline.track.path import Place, Route, TravelledPath
from pipeline.track.survey import Track
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import AlignConfig, HazardConfig
from schemas.enums import BaliseKind, Evidence

Pairs = tuple[Ints, Ints]


@dataclass(frozen=True)
class ReferencePlaces:
    """The reference on the network, placed by itself: samples in order of time, and the legs that they lie on.

    `path_m`: coordinate on the sample's leg, of the balise antenna; `rival_sample`, `rival_element`: further net
    elements that a sample may as well lie on. `lost_ns`: samples that lie on no track, or where no train can have come.
    """

    t_ns: Ints
    leg: Ints
    path_m: Floats
    sigma_m: Floats
    legs: tuple[Route, ...]
    rival_sample: Ints
    rival_element: Ints
    lost_ns: Ints

    @classmethod
    def of(
        cls,
        epochs: pl.DataFrame,
        path: TravelledPath,
        rivals: Pairs,
        sigma_m: Floats,
        ahead_m: float,
        track: Track,
        config: AlignConfig,
    ) -> Self:
        """Matched samples (`t, leg, path_m, on_track`) and their path; `ahead_m`: the reference's place ahead of the
        balise antenna, along growing path. `rivals`: samples and net elements (numbers of the survey).
        """
        all_ns, all_m = times_ns(epochs), floats(epochs, "path_m")
        placed = np.flatnonzero(flags(epochs, "on_track") & np.isfinite(all_m))
        kept = placed[_reachable(all_ns[placed], all_m[placed], sigma_m[placed], config)]
        leg, path_m = ints(epochs["leg"])[kept], floats(epochs, "path_m")[kept]
        legs = tuple(path.routes(track.index))
        number = np.full(epochs.height, -1)
        number[kept] = np.arange(kept.size)
        sample, element = number[rivals[0]], rivals[1]
        other = np.flatnonzero((sample >= 0) & ~_on_own_way(legs, leg, sample, element))
        order = other[np.argsort(sample[other], kind="stable")]
        lost_ns = np.delete(all_ns, kept)
        return cls(all_ns[kept], leg, path_m - ahead_m, sigma_m[kept], legs, sample[order], element[order], lost_ns)

    def anchor(self, sample: int) -> Anchor:
        element, measure, _ = self.legs[int(self.leg[sample])].locate(self.path_m[[sample]])
        place = Place(int(element[0]), float(measure[0]))
        return Anchor(int(self.t_ns[sample]), place, float(self.sigma_m[sample]), Evidence.REFERENCE)


def _reachable(t_ns: Ints, path_m: Floats, sigma_m: Floats, config: AlignConfig) -> Ints:
    """Samples that a train can have come to from one another: outward from the longest piece without a leap."""

    def leaps(a: Ints, b: Ints) -> Bools:
        """Steps that no train can drive and no noise explains."""
        most_m = config.fastest_mps * (t_ns[b] - t_ns[a]) / NS_PER_S + config.sure_sigmas * (sigma_m[a] + sigma_m[b])
        beyond: Bools = np.abs(path_m[b] - path_m[a]) > most_m
        return beyond

    samples = np.arange(t_ns.size)
    pieces = np.split(samples, np.flatnonzero(leaps(samples[:-1], samples[1:])) + 1)
    longest = int(np.argmax([piece.size for piece in pieces]))
    kept = [pieces[longest]]
    for ahead in pieces[longest + 1 :]:
        if not leaps(kept[-1][-1:], ahead[:1]).any():
            kept.append(ahead)
    for before in pieces[:longest][::-1]:
        if not leaps(before[-1:], kept[0][:1]).any():
            kept.insert(0, before)
    return np.concatenate(kept)


def _on_own_way(legs: tuple[Route, ...], leg: Ints, sample: Ints, element: Ints) -> Bools:
    """The net element is one that the sample's own leg runs over, sooner or later: no other track."""
    near = np.zeros(sample.size, dtype=np.bool_)
    for number, route in enumerate(legs):
        rows = np.flatnonzero(sample >= 0)
        rows = rows[leg[sample[rows]] == number]
        near[rows] = np.isin(element[rows], route.element)
    return near


@dataclass(frozen=True)
class Coverage:
    """Reference samples `first` to `last`, no two neighbours farther apart than a straight line reaches.

    `begin`, `end`: the outermost samples at which the odometer counted, for only from these can a place be carried.
    """

    first: int
    last: int
    begin: Anchor
    end: Anchor


def coverages(reference: ReferencePlaces | None, odometer: Odometry | None, config: HazardConfig) -> list[Coverage]:
    """The times that the reference covers."""
    if reference is None or reference.t_ns.size == 0:
        return []
    silent = np.diff(reference.t_ns) > config.reference_gap_s * NS_PER_S
    lost_before = np.searchsorted(np.sort(reference.lost_ns), reference.t_ns)
    breaks = np.flatnonzero(silent | (np.diff(lost_before) > 0))
    counted = np.zeros(reference.t_ns.size, dtype=np.bool_) if odometer is None else odometer.known_at(reference.t_ns)
    found = []
    for first, last in zip([0, *(breaks + 1).tolist()], [*breaks.tolist(), counted.size - 1], strict=True):
        own = first + np.flatnonzero(counted[first : last + 1])
        ends = (int(own[0]), int(own[-1])) if own.size else (first, last)
        found.append(Coverage(first, last, *(reference.anchor(sample) for sample in ends)))
    return found


def lost_spans(reference: ReferencePlaces | None, config: HazardConfig) -> list[tuple[int, int]]:
    """Times at which the reference was heard and lay nowhere [ns], ends left out: nobody knows where the train was."""
    if reference is None:
        return []
    gap_ns = round(config.reference_gap_s * NS_PER_S)
    spans = []
    for t_ns in reference.lost_ns.tolist():
        after = int(np.searchsorted(reference.t_ns, t_ns))
        before_ns = int(reference.t_ns[after - 1]) if after else t_ns
        after_ns = int(reference.t_ns[after]) if after < reference.t_ns.size else t_ns
        spans.append((max(before_ns, t_ns - gap_ns) + 1, min(after_ns, t_ns + gap_ns)))
    return spans


def disputed_by(one: Coverage, reference: ReferencePlaces, reads: list[Anchor], config: HazardConfig) -> int:
    """How many reads say that the train was not where the reference has it, by more than half the failure limit."""
    inside = [read for read in reads if reference.t_ns[one.first] <= read.t_ns <= reference.t_ns[one.last]]
    part = slice(one.first, one.last + 1)
    count = 0
    for read in inside:
        sample = one.first + int(np.abs(reference.t_ns[part] - read.t_ns).argmin())
        since = (reference.t_ns[part] - reference.t_ns[one.first]).astype(np.float64)
        at_m = np.interp([read.t_ns - reference.t_ns[one.first]], since, reference.path_m[part])
        place = read.place
        route = reference.legs[int(reference.leg[sample])]
        balise_m, _ = route.coordinate(np.array([place.element]), np.array([place.measure_m]), at_m)
        noise_m = config.evidence_factor * float(np.hypot(reference.sigma_m[sample], read.sigma_m))
        apart_m = float(np.abs(balise_m - at_m)[0])
        count += not apart_m <= noise_m + 0.5 * config.failure_limit_m
    return count


def facing_of(reference: ReferencePlaces, covered: list[Coverage], odometer: Odometry, least_m: float) -> set[int]:
    """Oriented net elements over which the train ran as the odometer counted up, by the reference.

    `least_m`: so much way together says which way the odometer counts (DOMAIN section 2).
    """
    found: set[int] = set()
    for one in covered:
        part = slice(one.first, one.last + 1)
        t_ns, path_m, leg = reference.t_ns[part], reference.path_m[part], reference.leg[part]
        counted_m = odometer.between(t_ns[:-1], t_ns[1:]).distance_m
        together = np.where(np.diff(leg) == 0, np.sign(np.diff(path_m)) * counted_m, 0.0)
        if abs(float(np.nansum(together))) >= least_m:
            element, _, sense = reference.legs[int(leg[0])].locate(path_m[:1])
            found.add(2 * int(element[0]) + int(sense[0] * np.nansum(together) < 0.0))
    return found


def read_anchors(
    reads: pl.DataFrame | None,
    balises: pl.DataFrame | None,
    track: Track,
    config: HazardConfig,
) -> list[Anchor]:
    """Reads of physical balises that the site knows, in order of time."""
    if reads is None or balises is None or reads.is_empty():
        return []
    physical = balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.PHYSICAL.value)
    rows, elements = track.holding(physical)
    known = physical[rows].select("balise_id", "measure_m", element=elements)
    read = reads.select("t", "balise_id").join(known, on="balise_id").sort("t", "balise_id")
    return [
        Anchor(t_ns, Place(element, measure_m), config.balise_read_sigma_m, Evidence.BALISE)
        for t_ns, element, measure_m in zip(times_ns(read).tolist(), read["element"], read["measure_m"], strict=True)
    ]
