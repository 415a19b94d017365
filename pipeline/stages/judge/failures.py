"""Jumps of the position, the history of its error, and position failures in use (DOMAIN section 5.3; DIAG, Hazards)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.stages.epochs.clock import crossing_gaps_ns
from pipeline.stages.judge.judged import JUDGEMENTS, UNKNOWN, WRONG, JudgedEpochs, JudgedOffers, Judgements
from pipeline.stages.odometry import Odometry
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of
from schemas.config import Configuration, HazardConfig
from schemas.enums import Judgement
from schemas.frozen import frozen


class PositionChanges(NamedTuple):
    """Per position: sum of the changes of position minus evidence up to it [m], along growing path.

    `linked`: the change since the position before is known, and no gap lies between.
    """

    t_ns: Ints
    excess_m: Floats
    linked: Bools


class Jump(NamedTuple):
    """A jump from position `first - 1` to `last`; `step_m` in the direction of travel."""

    first: int
    last: int
    step_m: float


def jumps_of(positions: JudgedEpochs, odometry: Odometry | None, gap_ns: Ints, config: HazardConfig) -> list[Jump]:
    """Jumps between the positions, in order of time; numbers are rows of `positions`, `gap_ns` the longest steps."""
    counted_m = np.full(max(positions.height - 1, 0), np.nan)
    if odometry is not None:
        counted_m = odometry.steps_m(positions.at_ns)
    steps = position_changes(positions.t_ns, positions.path_m, positions.reference_m, counted_m, gap_ns)
    return find_jumps(steps, positions.direction, config)


def position_changes(
    t_ns: Ints, path_m: Floats, reference_m: Floats, counted_m: Floats, gap_ns: Ints
) -> PositionChanges:
    """Running sum of position minus evidence [m], from position to position.

    Evidence is `reference_m`, the path position by the reference (NaN elsewhere), else the odometer's steps
    `counted_m`.
    """
    by_reference_m = np.diff(path_m - reference_m)
    change_m = np.where(np.isfinite(by_reference_m), by_reference_m, np.diff(path_m) - counted_m)
    linked = np.isfinite(change_m) & (np.diff(t_ns) <= gap_ns[1:])
    excess_m = np.concatenate([[0.0], np.cumsum(np.where(linked, change_m, 0.0))])
    return PositionChanges(t_ns, excess_m[: t_ns.size], np.concatenate([[False], linked])[: t_ns.size])


def find_jumps(steps: PositionChanges, direction: Ints, config: HazardConfig) -> list[Jump]:
    """Jumps in order of time: where the changes within a window exceed the limit, in either direction."""
    largest_m = largest_changes_m(steps, config)
    jumps: list[Jump] = []
    for sign in (1.0, -1.0):
        for begin, end in spans_of(largest_m * sign > config.limits.jump_m):
            first, last = _jump_ends(steps, begin, end, sign, config)
            step_m = float(steps.excess_m[last] - steps.excess_m[first - 1]) * float(direction[last])
            jumps.append(Jump(first, last, step_m))
    return sorted(jumps, key=lambda jump: jump[:2])


def largest_changes_m(steps: PositionChanges, config: HazardConfig) -> Floats:
    """The largest signed change [m] up to each position, over the positions in the window before it.

    The one just before always counts. Zero where all positions about it are within the limit of a jump.
    """
    excess_m = steps.excess_m
    count = excess_m.size
    largest_m = np.zeros(count)
    if count < 2 or np.ptp(excess_m) <= config.limits.jump_m:
        return largest_m
    window_ns = round(config.jump_window_s * NS_PER_S)
    # In blocks as long as the longest window: those before a position are in its block or the one before.
    longest = int((np.arange(count) - np.searchsorted(steps.t_ns, steps.t_ns - window_ns)).max())
    begins = np.arange(0, count, max(longest, 1))
    most_m, least_m = np.maximum.reduceat(excess_m, begins), np.minimum.reduceat(excess_m, begins)
    most_m[1:], least_m[1:] = np.maximum(most_m[1:], most_m[:-1]), np.minimum(least_m[1:], least_m[:-1])
    ends = np.append(begins[1:], count)
    chain = np.cumsum(~steps.linked, dtype=np.int64)
    for first, last in spans_of(~(most_m - least_m <= config.limits.jump_m)):
        before = int(begins[max(first - 1, 0)])
        part = slice(before, int(ends[last]))
        of_part_m = _largest_changes_within_m(excess_m[part], steps.t_ns[part], chain[part], window_ns)
        largest_m[begins[first] : ends[last]] = of_part_m[begins[first] - before :]
    return largest_m


def _largest_changes_within_m(excess_m: Floats, t_ns: Ints, chain: Ints, window_ns: int) -> Floats:
    """The same among some positions, lag by lag: as soon as no pair so far apart is in the window, no longer lag has
    one.
    """
    largest_m = np.zeros(excess_m.size)
    for lag in range(1, excess_m.size):
        near = chain[lag:] == chain[:-lag]
        if lag > 1:
            near &= t_ns[lag:] - t_ns[:-lag] <= window_ns
        if not near.any():
            break
        step_m = np.where(near, excess_m[lag:] - excess_m[:-lag], 0.0)
        part = largest_m[lag:]
        part[:] = np.where(np.abs(step_m) > np.abs(part), step_m, part)
    return largest_m


def _jump_ends(steps: PositionChanges, begin: int, end: int, sign: float, config: HazardConfig) -> tuple[int, int]:
    """First and last position of the increments that make up the jump over the limit at positions `begin..end`.

    Those of at least `jump_share` of the largest count, from one window before `begin` on.
    """
    window_ns = round(config.jump_window_s * NS_PER_S)
    earliest = int(np.searchsorted(steps.t_ns, steps.t_ns[begin] - window_ns, side="left"))
    start = max(min(earliest + 1, begin), 1)
    increments_m = np.diff(steps.excess_m[start - 1 : end + 1]) * sign
    increments_m[~steps.linked[start : end + 1]] = 0.0
    part = np.flatnonzero(increments_m >= config.jump_share * increments_m.max())
    return start + int(part[0]), start + int(part[-1])


@frozen
class ErrorHistory:
    """The positions in order of time, with the jumps between them and the offers; numbers are rows of `positions`.

    `settled_from`: the first position from each on at which the error stays within half the limit for long enough;
    `within_noise`: noise explains the error. `completing`: of each offer the position that completes it.
    """

    positions: JudgedEpochs
    settled_from: Ints
    within_noise: Bools
    jumps: Sequence[Jump]
    offers: JudgedOffers
    completing: Ints
    config: Configuration

    @property
    def size(self) -> int:
        """Number of positions."""
        return self.positions.height

    @property
    def t_ns(self) -> Ints:
        """Times of the positions [ns]."""
        return self.positions.t_ns

    @property
    def judged(self) -> Judgements:
        """What the judge says of each position."""
        return self.positions.judgements

    def offers_between(self, begin: int, end: int) -> Bools:
        """Offers that positions `begin` to `end` complete; shape (offers,)."""
        return np.logical_and(self.completing >= begin, self.completing < end)

    def worst_accepted(self, begin: int, end: int) -> Judgement:
        """The worst judgement of the VBs accepted at positions `begin` to `end`; right where none was."""
        codes = self.offers.judged.code[self.offers.accepted & self.offers_between(begin, end)]
        return next((JUDGEMENTS[code] for code in (WRONG, UNKNOWN) if code in codes), Judgement.RIGHT)

    def jumps_in(self, begin: int, end: int) -> list[Jump]:
        """Jumps, in order of time, that end at `begin` or later and begin before `end`."""
        first = bisect_left(self.jumps, begin, key=lambda jump: jump.last)
        last = bisect_left(self.jumps, end, key=lambda jump: jump.first)
        return [jump for jump in self.jumps[max(first - 1, 0) : last] if jump.last >= begin]

    def after_noise(self, floor: int, number: int) -> int:
        """The position after the last one within noise between `floor` and a position."""
        within_noise = np.flatnonzero(self.within_noise[floor:number])
        return floor + int(within_noise[-1]) + 1 if within_noise.size else floor


def error_history(
    epochs: JudgedEpochs, offers: JudgedOffers, odometry: Odometry | None, config: Configuration
) -> ErrorHistory:
    """The history of those epochs that have a position."""
    positions = epochs.where(np.flatnonzero(epochs.positioned))
    jumps = jumps_of(positions, odometry, crossing_gaps_ns(positions.t_ns, config.lds), config.hazards)
    return history_of_positions(positions, offers, jumps, config)


def history_of_positions(
    positions: JudgedEpochs, offers: JudgedOffers, jumps: Sequence[Jump], config: Configuration
) -> ErrorHistory:
    """The history of judged positions, with the jumps between them (numbered as these positions) and the offers."""
    completing = np.searchsorted(positions.epoch, offers.epoch)
    return ErrorHistory(
        positions=positions,
        settled_from=_settled_from(positions.t_ns, positions.judgements, config.hazards),
        within_noise=_is_within_noise(positions.judgements, positions.sigma_along_m, config.hazards),
        jumps=jumps,
        offers=offers,
        completing=completing.clip(0, max(positions.height - 1, 0)),
        config=config,
    )


def _settled_from(t_ns: Ints, judged: Judgements, config: HazardConfig) -> Ints:
    """Per position the number of the first one from there on that begins `episode_end_s` within half the limit."""
    settled = (judged.largest_m <= config.limits.settled_at_m(judged.limit_m)) & ~judged.is_wrong
    hold_ns = round(config.episode_end_s * NS_PER_S)
    begins = np.full(t_ns.size, t_ns.size)
    for first, last in spans_of(settled):
        # The positions of a settled span up to here have `hold_ns` of it ahead of them.
        after_last = int(np.searchsorted(t_ns, t_ns[last] - hold_ns, side="right"))
        begins[first:after_last] = np.arange(first, max(first, after_last))
    return np.asarray(np.minimum.accumulate(begins[::-1])[::-1])


def _is_within_noise(judged: Judgements, sigma_m: Floats, config: HazardConfig) -> Bools:
    """Positions at which noise explains the error: |e| <= min(3 sqrt(sigma_x^2 + sigma_ref^2), half the limit)."""
    sigma_ref_m = np.nan_to_num(judged.half_m) / config.evidence_factor
    noise_m = config.evidence_factor * np.hypot(np.nan_to_num(sigma_m), sigma_ref_m)
    most_m = np.minimum(noise_m, config.limits.settled_at_m(judged.limit_m))
    within = np.less_equal(np.abs(judged.middle_m), most_m)
    return np.logical_and(within, ~judged.is_wrong)


@frozen
class Failure:
    """Positions `begin` to `end` (the first after it), those judged wrong in use `first` to `last`; for how long.

    Judged wrong in use, over pulses, whether it crosses a VB or not (DOMAIN section 5.3). `hazardous_s`: time judged
    wrong in use; `natural_s`: of it what no injected fault of GNSS explains; `hazardous_may_s`: the same with the time
    that is unknown; `accepted`: the worst judgement of the VBs accepted in it; `within_budget`: None where it cannot be
    said.
    """

    begin: int
    first: int
    last: int
    end: int
    hazardous_s: float
    natural_s: float
    hazardous_may_s: float
    accepted: Judgement
    within_budget: bool | None


def find_failures(history: ErrorHistory) -> list[Failure]:
    """Wrong positions in use, in order of time.

    Two belong to one failure where less than `recovery_s` lies between them, or no settled position does.

    Args:
        history: the positions, judged.

    Returns:
        One for each time that positions were wrong in use.

    Source:
        DOMAIN section 5.3.
    """
    wrong = np.flatnonzero(history.positions.wrong_s > 0.0)
    if wrong.size == 0:
        return []
    apart = np.diff(history.t_ns[wrong]) >= history.config.lds.recovery_s * NS_PER_S
    settled_between = history.settled_from[wrong[:-1]] < wrong[1:]
    failures: list[Failure] = []
    for part in np.split(wrong, np.flatnonzero(apart & settled_between) + 1):
        begin = history.after_noise(failures[-1].end if failures else 0, int(part[0]))
        failures.append(failure_between(history, begin, int(history.settled_from[part[-1]]), part))
    return failures


def failure_between(history: ErrorHistory, begin: int, end: int, wrong: Ints) -> Failure:
    """The failure of positions `begin` to `end` with its times; `wrong`: those judged wrong in use, maybe none."""
    positions = history.positions
    hazardous_s, natural_s = (float(time_s[wrong].sum()) for time_s in (positions.wrong_s, positions.natural_s))
    may_be_wrong = ~history.judged.is_right[begin:end]
    may_s = float(positions.used_s[begin:end][may_be_wrong].sum())
    accepted = history.worst_accepted(begin, end)
    within = keeps_budget(hazardous_s, may_s, accepted, history.config.budget_s)
    first, last = (int(wrong[0]), int(wrong[-1])) if wrong.size else (begin, end)
    return Failure(begin, first, last, end, hazardous_s, natural_s, may_s, accepted, within)


def failures_of_part(epochs: JudgedEpochs, offers: JudgedOffers, config: Configuration) -> list[Failure]:
    """The failures of some of the judged epochs, as if these were the whole run."""
    positions = epochs.where(np.flatnonzero(epochs.positioned))
    return find_failures(history_of_positions(positions, offers, (), config))


def keeps_budget(hazardous_s: float, hazardous_may_s: float, accepted: Judgement, budget_s: float) -> bool | None:
    """Whether the allowed T_D was kept (never with a VB accepted wrong); None where the evidence cannot say."""
    if accepted is Judgement.WRONG or hazardous_s > budget_s:
        return False
    return True if hazardous_may_s <= budget_s and accepted is Judgement.RIGHT else None
