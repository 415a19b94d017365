"""Was a position right, wrong, or can nobody tell (DOMAIN section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.stages.evidence.evidence import KINDS, NOTHING, Alternative, EvidenceSet
from pipeline.stages.track.path import Route
from schemas.arrays import Bools, Floats, Ints, flags, floats, ints
from schemas.config import HazardConfig
from schemas.enums import Evidence, Judgement

JUDGEMENTS = tuple(Judgement)
RIGHT, WRONG, UNKNOWN = (JUDGEMENTS.index(one) for one in (Judgement.RIGHT, Judgement.WRONG, Judgement.UNKNOWN))


@dataclass(frozen=True)
class Positions:
    """Positions of one solution on the network at some instants.

    `element`: net element by its number in the survey, -1 without a position; `unambiguous`: the track is not in doubt
    by the train's own knowledge.
    """

    element: Ints
    measure_m: Floats
    leg: Ints
    path_m: Floats
    unambiguous: Bools

    @property
    def known(self) -> Bools:
        known: Bools = (self.element >= 0) & np.isfinite(self.path_m)
        return known


@dataclass(frozen=True)
class Judgements:
    """Per instant: judgement (number in `JUDGEMENTS`), least and largest error along the track [m].

    Along growing path as `judge_positions` makes them, in the direction of travel once `turned`. `kind`: of evidence,
    number in `KINDS`; `wrong_track`: judged wrong for its net element, whatever the place along the track.
    """

    code: Ints
    low_m: Floats
    high_m: Floats
    kind: Ints
    wrong_track: Bools

    @classmethod
    def of(cls, frame: pl.DataFrame) -> Judgements:
        """Those of a frame that holds the columns of `columns`."""
        return cls(
            code=ints(frame["judgement"].to_physical()),
            low_m=floats(frame, "error_low_m"),
            high_m=floats(frame, "error_high_m"),
            kind=ints(frame["evidence"].to_physical(), NOTHING),
            wrong_track=flags(frame, "wrong_track"),
        )

    def take(self, rows: Ints) -> Judgements:
        return Judgements(self.code[rows], self.low_m[rows], self.high_m[rows], self.kind[rows], self.wrong_track[rows])

    def columns(self) -> list[pl.Series]:
        kinds = pl.Series("evidence", [*(kind.value for kind in KINDS), None], dtype=pl.Enum(Evidence))
        return [
            judgement_words(self.code),
            pl.Series("error_low_m", self.low_m, nan_to_null=True),
            pl.Series("error_high_m", self.high_m, nan_to_null=True),
            kinds.gather(np.where(self.kind == NOTHING, len(KINDS), self.kind)),
            pl.Series("wrong_track", self.wrong_track),
        ]

    def turned(self, direction: Ints) -> Judgements:
        """The same with the errors in the direction of travel: +1 along growing path, -1 against it."""
        forward = direction > 0
        low_m = np.where(forward, self.low_m, -self.high_m)
        return replace(self, low_m=low_m, high_m=np.where(forward, self.high_m, -self.low_m))

    @property
    def is_right(self) -> Bools:
        right: Bools = self.code == RIGHT
        return right

    @property
    def is_wrong(self) -> Bools:
        wrong: Bools = self.code == WRONG
        return wrong

    @property
    def middle_m(self) -> Floats:
        middle: Floats = 0.5 * (self.low_m + self.high_m)
        return middle

    @property
    def least_m(self) -> Floats:
        """The smallest size that the error may have."""
        least: Floats = np.maximum(np.maximum(self.low_m, -self.high_m), 0.0)
        return least

    @property
    def largest_m(self) -> Floats:
        """The largest size that the error may have."""
        largest: Floats = np.maximum(-self.low_m, self.high_m)
        return largest

    @property
    def half_m(self) -> Floats:
        half: Floats = 0.5 * (self.high_m - self.low_m)
        return half

    @property
    def by_truth(self) -> Bools:
        """Judged by reference or balise reads, which alone can call a position right."""
        return np.isin(self.kind, [KINDS.index(kind) for kind in (Evidence.REFERENCE, Evidence.BALISE)])

    def known_m(self, known_to_m: float) -> Floats:
        """The error where reference or balise reads tell it so closely [m], else NaN."""
        return np.where(self.by_truth & (self.half_m <= known_to_m), self.middle_m, np.nan)


def margins_m(sigma_m: Floats, config: HazardConfig) -> Floats:
    """Errors of a healthy position: max(5 m, min(3 sigma, failure limit))."""
    noise = np.minimum(config.evidence_factor * np.nan_to_num(sigma_m, nan=np.inf), config.failure_limit_m)
    return np.maximum(config.false_alarm_margin_m, noise)


def judgement_words(code: Ints) -> pl.Series:
    kinds = [one.value for one in JUDGEMENTS]
    return pl.Series("judgement", kinds, dtype=pl.Enum(kinds)).gather(code)


@dataclass(frozen=True)
class _Relative:
    """Positions against one alternative: error interval (NaN: not known), and on another track than it."""

    low_m: Floats
    high_m: Floats
    off_track: Bools


def judge_positions(
    positions: Positions, evidence: EvidenceSet, legs: Sequence[Route], config: HazardConfig
) -> Judgements:
    """Wrong where it is wrong wherever the train may have been, right where it is right wherever it may have been.

    `legs`: the legs of the solution's own path, coordinate `path_m`. The interval is that of the tracks on which the
    place along the track can be compared.
    """
    size, limit_m = positions.element.size, config.failure_limit_m
    low, high = np.full(size, np.inf), np.full(size, -np.inf)
    right, ahead, behind, off = (np.ones(size, dtype=np.bool_) for _ in range(4))
    weighed = np.zeros(size, dtype=np.bool_)
    for alternative in evidence.alternatives:
        kept = positions.known[alternative.rows]
        rows = alternative.rows[kept]
        found = _relative(positions, rows, _only(alternative, kept), legs)
        excluded = found.off_track & positions.unambiguous[rows]
        with np.errstate(invalid="ignore"):
            ahead[rows] &= excluded | (found.low_m > limit_m)
            behind[rows] &= excluded | (found.high_m < -limit_m)
            right[rows] &= ~found.off_track & (found.low_m >= -limit_m) & (found.high_m <= limit_m)
        off[rows] &= excluded
        weighed[rows] = True
        low[rows], high[rows] = np.fmin(low[rows], found.low_m), np.fmax(high[rows], found.high_m)
    wrong = ahead | behind
    code = np.where(weighed & wrong, WRONG, np.where(weighed & right, RIGHT, UNKNOWN))
    told = weighed & np.isfinite(low)
    return Judgements(
        code=code,
        low_m=np.where(told, low, np.nan),
        high_m=np.where(told, high, np.nan),
        kind=np.where(weighed, evidence.kind, NOTHING),
        wrong_track=weighed & wrong & off,
    )


def _only(alternative: Alternative, kept: Bools) -> Alternative:
    rows, low, high = alternative.rows[kept], alternative.low_m[kept], alternative.high_m[kept]
    return Alternative(rows, alternative.route, low, high)


def _relative(positions: Positions, rows: Ints, there: Alternative, legs: Sequence[Route]) -> _Relative:
    """Positions on the track of the evidence, else by their own path where that leads to the train."""
    element, measure = positions.element[rows], positions.measure_m[rows]
    own_sense, middle = _own_sense(positions, rows, legs), 0.5 * (there.low_m + there.high_m)
    at_m, sense = there.route.coordinate(element, measure, middle)
    low, high = at_m - there.high_m, at_m - there.low_m
    facing = own_sense * sense
    off = ~np.isfinite(at_m)
    if off.any():
        away = np.flatnonzero(off)
        by_path = _by_own_path(positions, rows[away], _only(there, off), legs)
        low[away], high[away], off[away] = by_path.low_m, by_path.high_m, by_path.off_track
        facing[away] = 1
    ahead = facing > 0
    return _Relative(np.where(ahead, low, -high), np.where(ahead, high, -low), off)


def _own_sense(positions: Positions, rows: Ints, legs: Sequence[Route]) -> Ints:
    """+1 where the path of the solution grows with the measure of the position's net element."""
    sense = np.ones(rows.size, dtype=np.int64)
    for number, leg in enumerate(legs):
        own = np.flatnonzero(positions.leg[rows] == number)
        here = rows[own]
        _, found = leg.coordinate(positions.element[here], positions.measure_m[here], positions.path_m[here])
        sense[own] = np.where(found == 0, 1, found)
    return sense


def _by_own_path(positions: Positions, rows: Ints, there: Alternative, legs: Sequence[Route]) -> _Relative:
    """Error along growing path, where the train's place lies on the path of the solution too.

    Where the track of the evidence goes on as far as the position is ahead or behind, and on another net element than
    the position's, the position is on another track.
    """
    middle = 0.5 * (there.low_m + there.high_m)
    element, measure, sense = there.route.locate(middle)
    low, high = np.full((2, rows.size), np.nan)
    off = np.ones(rows.size, dtype=np.bool_)
    for number, leg in enumerate(legs):
        own = np.flatnonzero(positions.leg[rows] == number)
        path_m = positions.path_m[rows[own]]
        train_m, path_sense = leg.coordinate(element[own], measure[own], path_m)
        turned = path_sense * sense[own] < 0
        below, above = (middle - there.low_m)[own], (there.high_m - middle)[own]
        low[own] = path_m - train_m - np.where(turned, below, above)
        high[own] = path_m - train_m + np.where(turned, above, below)
        onward = middle[own] + (path_m - train_m) * np.where(turned, -1.0, 1.0)
        off[own] = ~np.isfinite(train_m) | there.route.covers(np.nan_to_num(onward, nan=-np.inf))
    off |= ~np.isfinite(low)
    return _Relative(np.where(off, np.nan, low), np.where(off, np.nan, high), off)


def with_own_anchors(
    judged: Judgements, positions: Positions, train_m: tuple[Floats, Floats], config: HazardConfig
) -> Judgements:
    """Where there is no other evidence, by the odometer since an accepted VB: wrong, or unknown, never right.

    `train_m`: least and largest path position of the train; errors along growing path.
    """
    rows = (judged.kind == NOTHING) & positions.known & np.isfinite(train_m[0])
    low, high = positions.path_m - train_m[1], positions.path_m - train_m[0]
    beyond = rows & ((low > config.failure_limit_m) | (high < -config.failure_limit_m))
    return Judgements(
        code=np.where(beyond, WRONG, judged.code),
        low_m=np.where(rows, low, judged.low_m),
        high_m=np.where(rows, high, judged.high_m),
        kind=np.where(rows, KINDS.index(Evidence.ODOMETER), judged.kind),
        wrong_track=judged.wrong_track,
    )
