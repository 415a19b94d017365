"""Failures: judged wrong in use, over pulses, and for how long (DOMAIN section 5.3)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.judge.judgement import UNKNOWN, WRONG, Judgements
from pipeline.stages.judge.jumps import Jump
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, ints, spans_of, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.conform import dtypes
from schemas.enums import Judgement
from schemas.stages import Failures


@dataclass(frozen=True)
class Course:
    """The positions along time as failures and episodes see them; numbers are rows of `positions`.

    `calm_from`: for each position the first from it on at which the error stays within half the limit for long enough;
    `quiet`: errors that noise explains.
    """

    positions: pl.DataFrame
    t_ns: Ints
    judged: Judgements
    used_s: Floats
    wrong_s: Floats
    calm_from: Ints
    quiet: Bools
    jumps: Sequence[Jump]

    @property
    def size(self) -> int:
        return self.t_ns.size

    def jumps_in(self, begin: int, end: int) -> list[Jump]:
        """Jumps, in order of time, that end at `begin` or later and begin before `end`."""
        first = bisect_left(self.jumps, begin, key=lambda jump: jump.last)
        last = bisect_left(self.jumps, end, key=lambda jump: jump.first)
        return [jump for jump in self.jumps[max(first - 1, 0) : last] if jump.last >= begin]

    def after_quiet(self, floor: int, number: int) -> int:
        """The position after the last quiet one between `floor` and a position."""
        quiet = np.flatnonzero(self.quiet[floor:number])
        return floor + int(quiet[-1]) + 1 if quiet.size else floor

    def unknown_or_wrong_s(self, begin: int, end: int) -> float:
        """Time in use that is wrong, or may be [s]."""
        part = slice(begin, end)
        return float(self.used_s[part][~self.judged.is_right[part]].sum())


def positions_of(epochs: pl.DataFrame) -> pl.DataFrame:
    """The epochs judged that have a position."""
    recorded = ("t", "leg", "path_m", "sigma_along_m")
    judged = ("epoch", "at", "direction", "judgement", "error_low_m", "error_high_m", "evidence", "wrong_track")
    used = ("used_s", "wrong_s", "train_m", "reference_m")
    return epochs.lazy().select(*recorded, *judged, *used).filter(pl.col("path_m").is_not_null()).collect()


def course_of(positions: pl.DataFrame, jumps: Sequence[Jump], config: HazardConfig) -> Course:
    """`positions`: the epochs judged that have a position."""
    t_ns, judged = times_ns(positions), Judgements.of(positions)
    return Course(
        positions=positions,
        t_ns=t_ns,
        judged=judged,
        used_s=floats(positions, "used_s"),
        wrong_s=floats(positions, "wrong_s"),
        calm_from=_calm_from(t_ns, judged, config),
        quiet=_quiet(judged, floats(positions, "sigma_along_m"), config),
        jumps=jumps,
    )


def _calm_from(t_ns: Ints, judged: Judgements, config: HazardConfig) -> Ints:
    calm = (judged.largest_m <= 0.5 * config.failure_limit_m) & ~judged.is_wrong
    hold_ns = round(config.episode_end_s * NS_PER_S)
    begins: Ints = np.full(t_ns.size + 1, t_ns.size, dtype=np.int64)
    for first, last in spans_of(calm):
        latest = int(np.searchsorted(t_ns, t_ns[last] - hold_ns, side="right"))
        begins[first:latest] = np.arange(first, max(first, latest))
    calm_from: Ints = np.minimum.accumulate(begins[::-1])[::-1][: t_ns.size]
    return calm_from


def _quiet(judged: Judgements, sigma_m: Floats, config: HazardConfig) -> Bools:
    """|e| at most min(3 sqrt(sigma_x^2 + sigma_ref^2), half the limit)."""
    sigma_ref_m = np.nan_to_num(judged.half_m) / config.evidence_factor
    noise_m = config.evidence_factor * np.hypot(np.nan_to_num(sigma_m), sigma_ref_m)
    with np.errstate(invalid="ignore"):
        quiet: Bools = np.abs(judged.middle_m) <= np.minimum(noise_m, 0.5 * config.failure_limit_m)
    not_wrong: Bools = quiet & ~judged.is_wrong
    return not_wrong


@dataclass(frozen=True)
class Failure:
    """One failure: its positions `begin` to `end` (the first after it), those judged wrong in use `first` to `last`."""

    begin: int
    first: int
    last: int
    end: int
    hazardous_s: float
    hazardous_may_s: float
    accepted: Judgement
    within_budget: bool | None

    def meets(self, begin: int, end: int) -> bool:
        """It was wrong in use between two positions, or before and after."""
        return self.first < end and self.last >= begin


def find_failures(course: Course, offers: pl.DataFrame, config: Configuration) -> list[Failure]:
    """Wrong positions in use, as one while less than `recovery_s` lies between, or nothing calm: in order of time."""
    wrong = np.flatnonzero(course.wrong_s > 0.0)
    if wrong.size == 0:
        return []
    apart = np.diff(course.t_ns[wrong]) >= config.lds.recovery_s * NS_PER_S
    calm_between = course.calm_from[wrong[:-1]] < wrong[1:]
    found: list[Failure] = []
    for part in np.split(wrong, np.flatnonzero(apart & calm_between) + 1):
        begin = course.after_quiet(found[-1].end if found else 0, int(part[0]))
        end = int(course.calm_from[part[-1]])
        hazardous_s = float(course.wrong_s[part].sum())
        may_s = course.unknown_or_wrong_s(begin, end)
        accepted = accepted_in(offers, course.positions, begin, end)
        within = within_budget(hazardous_s, may_s, accepted, config.budget_s)
        found.append(Failure(begin, int(part[0]), int(part[-1]), end, hazardous_s, may_s, accepted, within))
    return found


def failures_within(epochs: pl.DataFrame, offers: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """The failures of a part of the epochs judged, as if it were all."""
    course = course_of(positions_of(epochs), (), config.hazards)
    return failures_table(find_failures(course, offers, config), course)


def within_budget(hazardous_s: float, hazardous_may_s: float, accepted: Judgement, budget_s: float) -> bool | None:
    """Whether the allowed T_D was kept: not where a VB was accepted wrong; null where nobody knows."""
    if accepted is Judgement.WRONG or hazardous_s > budget_s:
        return False
    return True if hazardous_may_s <= budget_s and accepted is Judgement.RIGHT else None


def accepted_in(offers: pl.DataFrame, positions: pl.DataFrame, begin: int, end: int) -> Judgement:
    """The worst judgement of the VBs accepted at positions `begin` to `end`; right where none was."""
    number = numbers_of(offers, positions)
    inside = pl.Series((number >= begin) & (number < end))
    codes = ints(offers.filter(inside & offers["accepted"])["judgement"].to_physical())
    worst = {WRONG: Judgement.WRONG, UNKNOWN: Judgement.UNKNOWN}
    return next((word for code, word in worst.items() if (codes == code).any()), Judgement.RIGHT)


def numbers_of(offers: pl.DataFrame, positions: pl.DataFrame) -> Ints:
    """The position, by its row, that completes each offer."""
    number: Ints = np.searchsorted(ints(positions["epoch"]), ints(offers["epoch"]))
    return number.clip(0, max(positions.height - 1, 0))


def failures_table(failures: Sequence[Failure], course: Course) -> pl.DataFrame:
    """One row per failure: frame as `schemas.stages.Failures`."""
    last = course.size - 1
    rows = [
        {
            "t_start": int(course.t_ns[one.begin]),
            "t_end": int(course.t_ns[min(one.end, last)]),
            "hazardous_s": one.hazardous_s,
            "hazardous_may_s": one.hazardous_may_s,
            "accepted": one.accepted.value,
            "within_budget": one.within_budget,
        }
        for one in failures
    ]
    return pl.DataFrame(rows, schema=dtypes(Failures))
