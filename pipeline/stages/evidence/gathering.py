"""Evidence from all recorders: their clocks, what they say of each other, and the stretches between known places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import polars as pl

from pipeline.stages.evidence.anchors import (
    KnownStretch,
    OrientedStretch,
    anchors_outside,
    exclude_other_tracks,
    final_stands,
    orient_stretch,
    put_on_clock,
    reference_movements,
)
from pipeline.stages.evidence.carrying import (
    Lags,
    RecorderClock,
    SignedOdometer,
    TrueAnchor,
    measure_lags,
    possible_leads_s,
    recorder_clocks,
)
from pipeline.stages.evidence.contradictions import (
    EVEN_S,
    KnownPath,
    Levels,
    LevelsBeyond,
    Witness,
    find_contradictions,
    levels_beyond,
    open_for_steps,
    path_speed_mps,
)
from pipeline.stages.evidence.evidence import Span, TrainEvidence
from pipeline.stages.evidence.gaps import CarriedGaps, GapSearch
from pipeline.stages.odometry import Odometry
from pipeline.stages.reference import ReferenceStretch
from pipeline.stages.track.network import Network
from schemas.arrays import NS_PER_S, Floats, Ints, floats, times_ns
from schemas.config import Configuration, HazardConfig, Vehicle
from schemas.enums import Origin


def without_latency(stream: pl.DataFrame | None, latency_s: float) -> pl.DataFrame | None:
    """The stream with its declared lag taken off (vehicle file, `reference_latency_s`, `reads_latency_s`)."""
    if stream is None or latency_s == 0.0:
        return stream
    return stream.with_columns(pl.col("t") - pl.duration(nanoseconds=round(latency_s * 1e9)))


def without_frozen(
    reference: pl.DataFrame | None, odometers: Sequence[Odometry], config: HazardConfig
) -> pl.DataFrame | None:
    """The reference without samples that repeat the one before while an odometer moves on: any, or any independent one.

    A recorder that stands still says nothing of where the train is (DOMAIN section 5.0): after so long the stretch
    ends. A train that stands repeats too: there the odometer shows no movement beyond its dead band and the sample's
    noise.
    """
    witnesses = [odometer for odometer in odometers if odometer.independent] or list(odometers)
    if reference is None or reference.height < 2 or not witnesses:
        return reference
    t_ns = times_ns(reference)
    places = np.column_stack([floats(reference, "latitude_deg"), floats(reference, "longitude_deg")])
    repeats = np.concatenate([[False], (np.diff(places, axis=0) == 0.0).all(axis=1)])
    if not repeats.any():
        return reference
    held = np.arange(t_ns.size)[~repeats][np.cumsum(~repeats) - 1]
    noise_m = config.evidence_factor * reference["sigma_m"].fill_null(config.reference_sigma_m).to_numpy()
    frozen = np.zeros(t_ns.size, dtype=np.bool_)
    for odometer in witnesses:
        frozen |= repeats & odometer.drove(t_ns[held], t_ns, noise_m)
    return reference.filter(~pl.Series(frozen))


# Numerics: before and after all runs [ns].
_EVER_NS = 2**62


def stretch_as_evidence(
    side: OrientedStretch,
    clock: RecorderClock,
    witnesses: Sequence[Witness],
    reads: Sequence[TrueAnchor],
    ahead_m: float,
    config: Configuration,
    beyond: LevelsBeyond | None = None,
) -> KnownStretch:
    """A stretch of the reference as evidence: on the odometer's clock, opened for its steps, less disputed reads.

    `reads` close a step where they confirm the reference; `ahead_m`: of the antenna; `beyond`: the levels of the
    reference on both sides of the stretch.
    """
    beyond = beyond or LevelsBeyond()
    t_ns = side.stretch.t_ns - round(clock.shift_s * NS_PER_S)
    stretch = replace(side.stretch, t_ns=t_ns)
    paths: list[KnownPath] = []
    speed_mps = np.zeros(t_ns.size)
    levels: list[Levels] = []
    possible_ns: set[int] = set()
    for path in stretch.paths:
        at_m = path.at_m - side.sense * ahead_m
        path_mps = path_speed_mps(t_ns, at_m, path.leg)
        speed_mps = np.maximum(speed_mps, path_mps)
        known = KnownPath(path, side.sense, at_m, at_m, at_m, np.zeros(t_ns.size))
        clock_m = path_mps * clock.delta_s
        # A clock that leaves more than half the failure limit open lets a read confirm nothing.
        most_m = config.hazards.limits.confirming_m
        reads_ns = _confirming_ns(known, stretch, clock_m, reads, config.hazards.evidence_factor, most_m)
        steps = find_contradictions(known, side.stretch, witnesses, config)
        of_path = Levels.between_steps(steps, t_ns, reads_ns)
        levels.append(of_path.oriented(side.sense))
        opened = open_for_steps(known, t_ns, steps, of_path, beyond.oriented(side.sense))
        paths.append(opened)
        possible_ns |= set(_confirming_ns(opened, stretch, clock_m, reads, config.align.sure_sigmas, np.inf))
    disputed = _disputed_spans(t_ns, reads, possible_ns)
    for first_ns, last_ns in [] if witnesses else disputed:
        # Nothing is carried from the reads, so nobody knows since when the reference has been off.
        open_m = np.where((t_ns >= first_ns) & (t_ns <= last_ns), np.inf, 0.0)
        paths = [replace(known, low_m=known.low_m - open_m, high_m=known.high_m + open_m) for known in paths]
    if t_ns.size == 1 and witnesses:
        # One sample shows no speed.
        speed_mps = np.abs(witnesses[0].counter.odometer.speed_about(t_ns))
    since_s = (t_ns - t_ns[0]) / NS_PER_S
    lates_s = np.linspace(-clock.delta_s, clock.delta_s, 3 + 2 * int(clock.delta_s / EVEN_S))
    around = [np.interp(since_s + late_s, since_s, speed_mps) for late_s in lates_s.tolist()]
    clock_m = np.maximum.reduce(around) * clock.delta_s
    proved = exclude_other_tracks(stretch, config)
    return KnownStretch(
        t_ns,
        stretch.sigma_m,
        clock_m,
        tuple(paths),
        proved,
        stretch,
        levels[0],
        round(clock.delta_s * NS_PER_S),
        tuple(disputed),
    )


def _disputed_spans(t_ns: Ints, reads: Sequence[TrueAnchor], possible_ns: set[int]) -> list[tuple[int, int]]:
    """The time between the neighbours of each read at which the train was on none of the stretch's paths.

    Which of the two was right nobody knows, nor since when: without end where no read confirms the reference.
    """
    within = sorted(read.t_ns for read in reads if t_ns[0] <= read.t_ns <= t_ns[-1])
    found: list[tuple[int, int]] = []
    for read_ns in within:
        if read_ns not in possible_ns:
            before_ns = max((at_ns for at_ns in possible_ns if at_ns < read_ns), default=-_EVER_NS)
            after_ns = min((at_ns for at_ns in possible_ns if at_ns > read_ns), default=_EVER_NS)
            found.append((before_ns, after_ns))
    return found


def _confirming_ns(
    known: KnownPath,
    stretch: ReferenceStretch,
    clock_m: Floats,
    reads: Sequence[TrueAnchor],
    factor: float,
    most_m: float,
) -> list[int]:
    """Times [ns] of reads at balises where the reference may have been, within `factor` sigmas and both clocks.

    Only where these leave no more than `most_m` open.
    """
    t_ns = stretch.t_ns
    since_ns = (t_ns - t_ns[0]).astype(np.float64)
    confirming: set[int] = set()
    for read in reads:
        if not t_ns[0] <= read.t_ns <= t_ns[-1]:
            continue
        at_m = np.interp([float(read.t_ns - t_ns[0])], since_ns, known.at_m)
        sample = int(np.searchsorted(t_ns, read.t_ns))
        around = slice(max(sample - 1, 0), sample + 1)
        low_m = float(at_m[0] + (known.low_m - known.at_m)[around].min())
        high_m = float(at_m[0] + (known.high_m - known.at_m)[around].max())
        route = known.path.legs[int(known.path.leg[sample])]
        half_m = factor * float(np.hypot(stretch.sigma_m[sample], read.sigma_m))
        half_m += float(clock_m[sample]) + read.clock_m
        for place in read.places:
            there_m, _ = route.coordinates_of(np.array([place.element]), np.array([place.measure_m]), at_m)
            if low_m - half_m <= float(there_m[0]) <= high_m + half_m and half_m <= most_m:
                confirming.add(read.t_ns)
    return sorted(confirming)


# Numerics: movements over which two odometers are compared [s].
_PARTED_S = 60.0


def evidence_of(
    reference: tuple[Sequence[ReferenceStretch], Sequence[Span]],
    recorders: Sequence[Sequence[TrueAnchor]],
    odometers: Sequence[Odometry],
    network: Network,
    vehicle: Vehicle,
    config: Configuration,
) -> TrainEvidence:
    """Everything that is known of where the train was, except from GNSS.

    Where any odometer is independent, the others confirm nothing and narrow nothing; where none is, what they carry
    proves nothing.

    Args:
        reference: stretches of the reference and spans off the track [ns], as from `reference_stretches`.
        recorders: anchors of each other recorder of places, by its own clock, in order of time.
        odometers: all odometers, that of the LDS first.
        network: the track network, its elements not in pieces.
        vehicle: the place of the GNSS antenna [m].
        config: the configuration; used are `hazards`, `evidence`, `align`, `lds` and `matching`.

    Returns:
        The evidence, which is asked for any instants.

    Source:
        DOMAIN sections 5.0 and 5.1.
    """
    hazards = config.hazards
    independent = [odometer for odometer in odometers if odometer.independent]
    counters = [SignedOdometer(odometer, config.hazards.limits.doubt_m) for odometer in independent or odometers]
    main = counters[0] if counters else None
    least_m = config.matching.orientation_distance_m
    stretches, off_track = reference
    sides = [orient_stretch(stretch, main, least_m) for stretch in stretches]
    oriented = frozenset(side.first_oriented_element for side in sides if abs(side.with_m - side.against_m) >= least_m)
    if any(min(side.with_m, side.against_m) >= least_m for side in sides):
        counters = [counter.without_sign() for counter in counters]
    searches = [GapSearch(counter, network, config, oriented) for counter in counters]
    lags = [_measure_reference_lags(stretches, search, least_m) for search in searches]
    # Any odometer contradicts a reference; where one is independent, the others are not asked.
    found = [Witness.with_measured_scale(*of_one, config) for of_one in zip(counters, lags, strict=True)]
    lags_of_others = [
        [_measure_anchor_lags(search.carry_over_gaps(_instant_pairs(anchors)), config) for search in searches]
        for anchors in recorders
    ]
    of_reference, *of_others = recorder_clocks((lags, *lags_of_others), bool(independent), hazards)
    by_recorder = [put_on_clock(anchors, clock, main) for anchors, clock in zip(recorders, of_others, strict=True)]
    clocked = sorted((anchor for anchors in by_recorder for anchor in anchors), key=lambda anchor: anchor.t_ns)
    recorded, unclosed = _known_stretches(sides, of_reference, found, clocked, searches, vehicle, config)
    known = tuple(part for stretch in recorded for part in stretch.without_doubtful())
    unsure = [span for stretch in recorded for span in stretch.doubtful_spans()]
    apart = anchors_outside(clocked, known)
    shift_ns = round(of_reference.shift_s * NS_PER_S)
    return TrainEvidence(
        stretches=known,
        off_track=tuple((begin_ns - shift_ns, end_ns - shift_ns) for begin_ns, end_ns in off_track),
        carried=tuple(search.carry_over_gaps(_anchor_pairs(known, search.counter, apart)) for search in searches),
        by_reads=tuple(search.carry_over_gaps(_instant_pairs(clocked)) for search in searches) if recorded else (),
        reads_ns=np.array([anchor.t_ns for anchor in clocked], dtype=np.int64),
        clocks=(of_reference,) * bool(known)
        + _clocks_in_use(of_others, [anchors_outside(anchors, known) for anchors in by_recorder]),
        network=network,
        config=config,
        stands=final_stands([stretch.reference for stretch in known], independent, config),
        odometers_disagree=_odometers_disagree(odometers, config),
        unsure=tuple(unsure),
        true_clocks_s=possible_leads_s((of_reference,) * bool(known) + _clocks_in_use(of_others, by_recorder)),
        disputes=tuple(span for stretch in recorded for span in stretch.disputed),
        contradiction_count=unclosed
        + sum(stretch.levels.count_doubted_steps for stretch in recorded)
        + (0 if counters else sum(len(stretch.disputed) for stretch in recorded))
        + sum(len(of_one.found) > 1 for of_one in lags),
    )


def _clocks_in_use(
    clocks: Sequence[RecorderClock], anchors: Sequence[Sequence[TrueAnchor]]
) -> tuple[RecorderClock, ...]:
    """The clocks of the recorders that have anchors."""
    return tuple(clock for clock, of_one in zip(clocks, anchors, strict=True) if of_one)


def _known_stretches(
    sides: Sequence[OrientedStretch],
    clock: RecorderClock,
    witnesses: Sequence[Witness],
    reads: Sequence[TrueAnchor],
    searches: Sequence[GapSearch],
    vehicle: Vehicle,
    config: Configuration,
) -> tuple[list[KnownStretch], int]:
    """The stretches of the reference, and how many gaps its own ends and the odometer do not close: steps of it too."""
    ahead_m = vehicle.gnss_antenna_ahead_m
    known = [stretch_as_evidence(side, clock, witnesses, reads, ahead_m, config) for side in sides]
    order = sorted(range(len(known)), key=lambda number: int(known[number].t_ns[0]))
    steps_m = [0.0] * max(len(known) - 1, 0)
    for search, witness in zip(searches[:1], witnesses[:1], strict=True):
        borders = [known[number].end_anchors(search.counter) for number in order]
        steps_m = [
            search.misclosure_m(before[1], after[0], witness.scale, witness.scale_sigma)
            for before, after in pairwise(borders)
        ]
    levels = [known[number].levels for number in order]
    if len(known) < 2 or not (any(steps_m) or any(of.count_doubted_steps for of in levels)):
        return known, 0
    for number, beyond in zip(order, levels_beyond(levels, steps_m), strict=True):
        known[number] = stretch_as_evidence(sides[number], clock, witnesses, reads, ahead_m, config, beyond)
    return known, sum(map(bool, steps_m))


def _anchor_pairs(
    stretches: Sequence[KnownStretch], counter: SignedOdometer, reads: Sequence[TrueAnchor]
) -> list[tuple[TrueAnchor, TrueAnchor]]:
    """First and last anchor of each stretch and of each read: between them nothing has to be carried."""
    return [*(stretch.end_anchors(counter) for stretch in stretches), *_instant_pairs(reads)]


def _instant_pairs(known: Sequence[TrueAnchor]) -> list[tuple[TrueAnchor, TrueAnchor]]:
    """Anchors that last for an instant: first and last anchor are the same."""
    return [(anchor, anchor) for anchor in known]


def _measure_reference_lags(stretches: Sequence[ReferenceStretch], search: GapSearch, least_m: float) -> Lags:
    """The lag of the reference behind one odometer, in the sense in which that one counts.

    An odometer that counts up in both directions is compared where the train cannot have turned.
    """
    sides = [orient_stretch(stretch, search.counter, least_m) for stretch in stretches]
    begin_ns, end_ns, moved_m, sigma_m = reference_movements(sides, search.only_length_m)
    moved_m = moved_m if search.counter.signed else np.abs(moved_m)
    return measure_lags(begin_ns, end_ns, moved_m, sigma_m, search.counter, search.config)


def _measure_anchor_lags(source: CarriedGaps, config: Configuration) -> Lags:
    """The lag of a recorder behind an odometer, by the distances between its anchors, closed or not."""
    movements = [
        (gap.begin_ns, gap.end_ns, apart_m, float(np.linalg.norm([anchor.sigma_m for anchor in gap.anchors])))
        for gap in source.gaps
        for apart_m in gap.only_length_m
    ]
    begins, ends, *lengths = zip(*movements, strict=True) if movements else ((), (), (), ())
    moved_m, sigma_m = (np.array(values, np.float64) for values in lengths)
    return measure_lags(np.array(begins, np.int64), np.array(ends, np.int64), moved_m, sigma_m, source.counter, config)


def _odometers_disagree(odometers: Sequence[Odometry], config: Configuration) -> bool:
    """Whether an odometer of unknown origin and an independent one differ by more than 5 m + 5 % of a distance."""
    independent = [odometer for odometer in odometers if odometer.independent]
    others = [odometer for odometer in odometers if odometer.origin is Origin.UNKNOWN and not odometer.follows_gnss]
    for other in others:
        for witness in independent:
            begin_ns = max(other.begin_ns, witness.begin_ns)
            end_ns = min(other.end_ns, witness.end_ns)
            at_ns = np.arange(begin_ns, end_ns, round(_PARTED_S * NS_PER_S), dtype=np.int64)
            moved_m = [np.abs(odometer.steps_m(at_ns)) for odometer in (other, witness)]
            allowed_m = config.lds.odometer_fixed_m + config.lds.odometer_share * moved_m[1]
            if (np.abs(moved_m[0] - moved_m[1]) > allowed_m).any():
                return True
    return False
