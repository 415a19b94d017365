"""Positions and offered balises against the evidence: right, wrong or unknown (DOMAIN section 5.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import MonitoredEpochs
from pipeline.stages.evidence import TrainEvidence, unite
from pipeline.stages.evidence.carrying import Interval, carry_from_accepted
from pipeline.stages.evidence.evidence import NOTHING, Alternative, EvidenceSet, inside_spans
from pipeline.stages.judge.judged import ODOMETER, RIGHT, UNKNOWN, WRONG, Judgements
from pipeline.stages.odometry import Odometry
from pipeline.stages.track.path import RoutePath, TravelledPath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration, HazardConfig, Vehicle
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs, Crossings


@frozen
class Solution:
    """One solution: `fixes` as recorded, its epochs up to the LDS, what the LDS passed, `balises` on its path."""

    name: str
    fixes: pl.DataFrame
    epochs: MonitoredEpochs
    crossings: Crossings
    passages: pl.DataFrame
    balises: pl.DataFrame
    path: TravelledPath

    @cached_property
    def offers(self) -> Ints:
        """Numbers of the crossings that are judged: those offered, and those before the balise was re-armed."""
        return np.flatnonzero(self.crossings.offered | (self.crossings.status < 0))


@frozen
class JudgeInput:
    """One solution with the evidence of its run; `odometry` grows with its path, `faults` were injected.

    `leaps_s`: whole leap seconds that may have to be added to the stamps of the positions, or none; nobody knows.
    """

    solution: Solution
    evidence: TrainEvidence
    odometry: Odometry | None
    vehicle: Vehicle
    config: Configuration
    reference: pl.DataFrame | None = None
    faults: pl.DataFrame | None = None
    leaps_s: tuple[int, ...] = ()

    def evidence_at(self, at_ns: Ints) -> EvidenceSet:
        """Where the train was at instants of the positions' clock [ns].

        By either clock where that may be off by leaps.
        """
        return unite([self.evidence.at(clock_ns) for clock_ns in self.on_possible_clocks_ns(at_ns)])

    def on_possible_clocks_ns(self, at_ns: Ints) -> list[Ints]:
        """The same instants on each clock of the evidence that they may be stamps of [ns]."""
        return [at_ns, *(at_ns + leap_s * NS_PER_S for leap_s in self.leaps_s)]

    def instants(self, t_ns: Ints) -> Ints:
        """When positions of these stamps were true [ns]."""
        return valid_at_ns(t_ns, self.vehicle)

    def epochs_valid_at_ns(self) -> Ints:
        """When the positions of the epochs were true [ns]."""
        return self.instants(self.solution.epochs.t_ns)

    def failure_limit_m(self, at_ns: Ints) -> Floats:
        """The failure limit at instants of the positions' clock [m], shape (instants,); all that is judged takes it."""
        return np.full(at_ns.size, self.config.hazards.limits.failure_m)

    def legs(self) -> list[RoutePath]:
        """Legs of the solution's path, by the numbers of net elements that the evidence counts with."""
        return self.solution.path.routes_by_leg(self.evidence.network.track.index)


def valid_at_ns(t_ns: Ints, vehicle: Vehicle) -> Ints:
    """When positions of these stamps were true [ns]: less the latency of the vehicle file, 0 without one."""
    return t_ns - round((vehicle.gnss_latency_s or 0.0) * NS_PER_S)


@frozen
class MatchedPositions:
    """Positions of a solution, or balises that it offers, on the network; `element` -1 without a position.

    `unambiguous`: the track was not in doubt by what the train knew then.
    """

    element: Ints
    measure_m: Floats
    leg: Ints
    path_m: Floats
    unambiguous: Bools

    @classmethod
    def of_epochs(cls, epochs: AlignedEpochs, index: Mapping[str, int]) -> MatchedPositions:
        """The positions of epochs; `index`: numbers of net elements by name."""
        element = np.where(epochs.positioned, epochs.element_by(index), -1)
        return cls(element, epochs.measure_m, epochs.leg, epochs.path_m, epochs.unambiguous)

    @classmethod
    def of_balises(cls, crossings: Crossings, rows: Ints, index: Mapping[str, int], unambiguous: Bools) -> Self:
        """The places of the balises of some crossings; `index`: numbers of net elements by name."""
        element = np.array([index.get(crossings.netelement_id[row], -1) for row in rows.tolist()], dtype=np.int64)
        leg, path_m = crossings.leg[rows], crossings.path_m[rows]
        return cls(element, crossings.measure_m[rows], leg, path_m, unambiguous)

    @property
    def known(self) -> Bools:
        """Which of them have a place on the network."""
        return np.isfinite(self.path_m) & np.greater_equal(self.element, 0)


def healthy_margins_m(sigma_m: Floats, failure_m: Floats, config: HazardConfig) -> Floats:
    """Largest error of a healthy position [m]: max(5 m, min(3 sigma, failure limit)); arrays of one shape."""
    most_m = config.limits.healthy_at_m(failure_m)
    noise = np.minimum(config.evidence_factor * np.nan_to_num(sigma_m, nan=np.inf), most_m)
    return np.maximum(config.false_alarm_margin_m, noise)


def judge_with_odometer(
    given: JudgeInput, positions: MatchedPositions, at_ns: Ints, evidence: EvidenceSet
) -> Judgements:
    """Judge positions by the evidence; where there is none, by the odometer since the last accepted VB."""
    judged = judge_positions(positions, evidence, given.legs(), given.failure_limit_m(at_ns))
    if given.odometry is None:
        return judged
    crossings = given.solution.crossings
    accepted_ns = given.instants(crossings.t_ns[crossings.accepted])
    standstills = given.evidence.standstills
    place_m = crossings.path_m[crossings.accepted]
    own = [
        carry_from_accepted(anchor_ns, place_m, clock_ns, given.odometry, standstills, given.config)
        for anchor_ns, clock_ns in zip(
            given.on_possible_clocks_ns(accepted_ns), given.on_possible_clocks_ns(at_ns), strict=True
        )
    ]
    # NaN, where one of the clocks leaves nothing known.
    low_m, high_m = np.min([low for low, _ in own], axis=0), np.max([high for _, high in own], axis=0)
    # Where it contradicts a reference, and nobody knows which of the two failed, it shows nothing.
    unsure = inside_spans(at_ns, given.evidence.unsure)
    train_m = np.where(unsure, np.nan, low_m), np.where(unsure, np.nan, high_m)
    return judge_by_own_anchors(judged, positions, train_m)


def judge_positions(
    positions: MatchedPositions, evidence: EvidenceSet, legs: Sequence[RoutePath], limit_m: Floats
) -> Judgements:
    """Wrong where it is too far ahead, or too far behind, for every alternative; right where it is right for all.

    The interval of the error spans the alternatives whose track joins the position's, as only there a distance along
    the track exists.

    Args:
        positions: n positions on the network.
        evidence: where the train was at the same n instants.
        legs: the legs of the solution's path; their coordinate is `path_m`.
        limit_m: failure limit at each of the n instants [m].

    Returns:
        n judgements; errors along growing path.

    Source:
        DOMAIN section 5.2.
    """
    size = positions.element.size
    low_m = np.full(size, np.inf)
    high_m = np.full(size, -np.inf)
    # True as long as it holds for every alternative seen so far.
    right, ahead, behind, elsewhere = np.ones((4, size), dtype=np.bool_)
    judged = np.zeros(size, dtype=np.bool_)
    sense = _path_senses(positions, legs)
    for alternative in evidence.alternatives:
        there = alternative.some_rows(positions.known[alternative.rows])
        rows = there.rows
        least_m, most_m, off_track = _compare_with_alternative(positions, sense, there, legs)
        # On another track a position is wrong only if the match was sure of its own track.
        excluded = off_track & positions.unambiguous[rows]
        allowed_m = limit_m[rows]
        with np.errstate(invalid="ignore"):
            ahead[rows] &= excluded | (least_m > allowed_m)
            behind[rows] &= excluded | (most_m < -allowed_m)
            right[rows] &= ~off_track & (least_m >= -allowed_m) & (most_m <= allowed_m)
        elsewhere[rows] &= excluded
        judged[rows] = True
        low_m[rows] = np.fmin(low_m[rows], least_m)
        high_m[rows] = np.fmax(high_m[rows], most_m)
    wrong = judged & (ahead | behind)
    compared = judged & np.isfinite(low_m)
    # What rests on a witness that may be made of the positions proves nothing (DOMAIN section 5.0).
    right &= judged & evidence.proves & ~wrong
    return Judgements(
        code=np.where(wrong, WRONG, np.where(right & evidence.on_survey, RIGHT, UNKNOWN)),
        low_m=np.where(compared, low_m, np.nan),
        high_m=np.where(compared, high_m, np.nan),
        kind=np.where(judged, evidence.kind, NOTHING),
        wrong_track=wrong & elsewhere,
        track_assumed=right & ~evidence.on_survey,
        limit_m=limit_m,
    )


def _path_senses(positions: MatchedPositions, legs: Sequence[RoutePath]) -> Ints:
    """+1 where the path of the solution grows with the measure of the position's net element, else -1."""
    sense = np.ones(positions.element.size, dtype=np.int64)
    for number, leg in enumerate(legs):
        rows = np.flatnonzero((positions.leg == number) & positions.known)
        _, along = leg.coordinates_of(positions.element[rows], positions.measure_m[rows], positions.path_m[rows])
        sense[rows] = np.where(along == 0, 1, along)
    return sense


_Relative = tuple[Floats, Floats, Bools]
"""Error interval along growing path (NaN: not known), and where the position is on another track."""


def _compare_with_alternative(
    positions: MatchedPositions, sense: Ints, there: Alternative, legs: Sequence[RoutePath]
) -> _Relative:
    """The error of positions against one alternative: on its track, else along their own path to the train."""
    rows = there.rows
    at_m, along = there.route.coordinates_of(positions.element[rows], positions.measure_m[rows], there.middle_m)
    forward = sense[rows] * along > 0
    low_m = np.where(forward, at_m - there.high_m, there.low_m - at_m)
    high_m = np.where(forward, at_m - there.low_m, there.high_m - at_m)
    off_track = ~np.isfinite(at_m)
    if off_track.any():
        low_m[off_track], high_m[off_track], off_track[off_track] = _compare_along_own_path(
            positions, there.some_rows(off_track), legs
        )
    return low_m, high_m, off_track


def _compare_along_own_path(positions: MatchedPositions, there: Alternative, legs: Sequence[RoutePath]) -> _Relative:
    """The error along the solution's own path, of positions off the train's track, where that leads to the train.

    Counted that far along the train's track, the position's place may lie on that track: then the two tracks are
    parallel, and the position is on another track, at no distance along. (Without this 5 of 5 runs that end 1 to 8 m
    before a border of elements, with a position 6 to 12 m ahead, are `unsafe` for the element behind it; with it none.)
    """
    rows = there.rows
    middle_m = there.middle_m
    element, measure_m, sense = there.route.locate(middle_m)
    path_m = positions.path_m[rows]
    train_m = np.full(rows.size, np.nan)
    along = np.zeros(rows.size, dtype=np.int64)
    for number, leg in enumerate(legs):
        part = np.flatnonzero(positions.leg[rows] == number)
        train_m[part], along[part] = leg.coordinates_of(element[part], measure_m[part], path_m[part])
    # The train's route counts against the path of the solution.
    against = along * sense < 0
    ahead_m = path_m - train_m
    # The place of the position, if it were on the train's route: as far from the train's.
    onward_m = middle_m + np.where(against, -ahead_m, ahead_m)
    off_track = ~np.isfinite(train_m) | there.route.covers_coordinates(np.nan_to_num(onward_m, nan=-np.inf))
    low_m = ahead_m - np.where(against, middle_m - there.low_m, there.high_m - middle_m)
    high_m = ahead_m + np.where(against, there.high_m - middle_m, middle_m - there.low_m)
    return np.where(off_track, np.nan, low_m), np.where(off_track, np.nan, high_m), off_track


def judge_by_own_anchors(judged: Judgements, positions: MatchedPositions, train_m: Interval) -> Judgements:
    """The judgements, where there is no other evidence by the odometer since an accepted VB.

    Wrong or unknown, never right. `train_m`: least and largest path position of the train.
    """
    rows = (judged.kind == NOTHING) & positions.known & np.isfinite(train_m[0])
    low_m = positions.path_m - train_m[1]
    high_m = positions.path_m - train_m[0]
    beyond = rows & ((low_m > judged.limit_m) | (high_m < -judged.limit_m))
    return replace(
        judged,
        code=np.where(beyond, WRONG, judged.code),
        low_m=np.where(rows, low_m, judged.low_m),
        high_m=np.where(rows, high_m, judged.high_m),
        kind=np.where(rows, ODOMETER, judged.kind),
    )
