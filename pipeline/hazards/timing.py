"""When a hazard began, failed, was detected and negated (DOMAIN section 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.hazards.arrays import runs_of
from pipeline.hazards.case import Case
from pipeline.hazards.episodes import Draft
from pipeline.hazards.jumps import Jump
from pipeline.hazards.series import Series
from schemas.arrays import NS_PER_S
from schemas.config import HazardConfig

# Faults that do not displace the position along the track; trials name them in words of their own.
_OTHER_KINDS = "(?i)slip|slid|scale|outage|gap|odo|wheel"
_OTHER_TARGETS = "(?i)odo|wheel|^cross|^up$"


@dataclass(frozen=True)
class Timing:
    """Instants of one hazard [ns]; epochs are indices of the series."""

    onset_ns: int
    onset_epoch: int
    failure_epoch: int | None
    failure_ns: int | None
    is_step: bool
    end_ns: int
    detected_ns: int | None
    negated_ns: int | None
    monitor: str | None
    alarm_before_onset: bool


def time_hazard(draft: Draft, jumps: list[Jump], case: Case) -> Timing:
    """Onset, failure, detection and negation of one hazard."""
    series, config = case.series, case.config.hazards
    begun_by_own_jump = draft.jump is not None and not draft.returns
    step = draft.jump if begun_by_own_jump else _step_of_shift(draft, series, jumps, config)
    if step is not None:
        onset, failure = step.first, _failure_of_step(step, draft, series, config)
    else:
        failure = _sustained_failure(draft.floor + 1, draft.end, series, config)
        onset = _drift_onset(draft, failure, series)
    onset_ns = _onset_ns(draft, step, onset, case)
    end_ns = int(series.t_ns[min(draft.end, series.size - 1)])
    detected = _detection(draft, onset_ns, end_ns, case)
    reaction_s = series.period_s if config.reaction_s is None else config.reaction_s
    negated = None if detected.t_ns is None else detected.t_ns + round(reaction_s * NS_PER_S)
    return Timing(
        onset_ns=onset_ns,
        onset_epoch=onset,
        failure_epoch=failure,
        failure_ns=None if failure is None else int(series.t_ns[failure]),
        is_step=step is not None,
        end_ns=max(end_ns, onset_ns),
        detected_ns=detected.t_ns,
        negated_ns=negated,
        monitor=detected.monitor,
        alarm_before_onset=detected.standing,
    )


def _failure_of_step(step: Jump, draft: Draft, series: Series, config: HazardConfig) -> int | None:
    """A step counts at once; one that leaves a small error fails only if that grows."""
    inside = np.flatnonzero(np.abs(series.error_m[step.first : step.last + 1]) > config.failure_limit_m)
    if inside.size and abs(step.error_after_m) > config.failure_limit_m:
        return step.first + int(inside[0])
    return _sustained_failure(step.first, draft.end, series, config)


def _sustained_failure(begin: int, end: int, series: Series, config: HazardConfig) -> int | None:
    """First epoch of `failure_hold_s` beyond the limit, in `begin <= epoch < end`."""
    beyond = np.abs(series.error_m[begin:end]) > config.failure_limit_m
    firsts, lasts = runs_of(beyond)
    held = series.t_ns[begin + lasts] - series.t_ns[begin + firsts] >= config.failure_hold_s * NS_PER_S
    return begin + int(firsts[held][0]) if held.any() else None


def _drift_onset(draft: Draft, failure: int | None, series: Series) -> int:
    """The epoch after the last one before the failure (or the hit, if sooner) with |e| within 3 sigma."""
    until = draft.first_epoch if failure is None else min(failure, draft.first_epoch)
    begin = draft.floor + 1
    small = np.flatnonzero(np.abs(series.error_m[begin:until]) <= series.noise_m[begin:until])
    return begin + int(small[-1]) + 1 if small.size else begin


def _step_of_shift(draft: Draft, series: Series, jumps: list[Jump], config: HazardConfig) -> Jump | None:
    """The jump between VBs that a shift stayed after, if that is what brought the error beyond noise.

    An error that is a little beyond 3 sigma before it (a late clock, a bad minute) is no drift that the jump
    ended: below max(5 m, 3 sigma) the position counts as healthy.
    """
    failure = _sustained_failure(draft.floor + 1, draft.end, series, config)
    onset = _drift_onset(draft, failure, series)
    until = draft.first_epoch if failure is None else min(failure, draft.first_epoch)
    begins = [jump for jump in jumps if jump.last >= onset and jump.first <= max(until, onset)]
    return next((jump for jump in begins if jump.first <= onset or _made_the_error(jump, series, config)), None)


def _made_the_error(jump: Jump, series: Series, config: HazardConfig) -> bool:
    healthy = max(config.false_alarm_margin_m, float(series.quiet_m[jump.first - 1]))
    return abs(jump.error_before_m) <= healthy and abs(jump.error_after_m) > config.failure_limit_m


def _onset_ns(draft: Draft, step: Jump | None, onset: int, case: Case) -> int:
    series = case.series
    by_error = int(series.t_ns[onset])
    if draft.caused_by is not None:
        return by_error
    latest = max(by_error, int(series.t_ns[draft.first_epoch]))
    named = _named_onset(case.faults, by_error, latest)
    if named is not None:
        return named
    if step is not None:
        return by_error
    lead_ns = round(case.config.hazards.alarm_lead_s * NS_PER_S)
    floor_ns = int(series.t_ns[draft.floor]) if draft.floor >= 0 and _ended_at(draft, series) else 0
    alarm = case.fails.start_within(max(by_error - lead_ns, floor_ns), by_error)
    return by_error if alarm is None else alarm


def _ended_at(draft: Draft, series: Series) -> bool:
    """The floor is the end of an earlier error rather than a calm that runs up to this one."""
    return bool(abs(series.error_m[draft.floor]) > series.quiet_m[draft.floor])


def _named_onset(faults: pl.DataFrame | None, by_error_ns: int, latest_ns: int) -> int | None:
    """`t_start` of the injected fault on the position that was on at the onset: the one that began last
    before it, else the first that began between it and the hazard.
    """
    if faults is None or faults.height == 0:
        return None
    on_position = ~pl.col("kind").str.contains(_OTHER_KINDS) & ~pl.col("target").str.contains(_OTHER_TARGETS)
    starts = pl.col("t_start").dt.timestamp("ns")
    ends = pl.col("t_end").dt.timestamp("ns").fill_null(np.iinfo(np.int64).max)
    on = faults.filter(on_position & (starts <= latest_ns) & (ends >= by_error_ns))
    if on.height == 0:
        return None
    begun = on["t_start"].dt.timestamp("ns").to_numpy()
    before = begun[begun <= by_error_ns]
    return int(before.max()) if before.size else int(begun.min())


@dataclass(frozen=True)
class _Detection:
    t_ns: int | None
    monitor: str | None
    standing: bool


def _detection(draft: Draft, onset_ns: int, end_ns: int, case: Case) -> _Detection:
    """First fail from onset to the episode's end; an alarm that stands already detects at once.

    The epoch of a jump back is no part of the episode: a monitor that sees only the way back did not
    see the fault. The row of the jump back itself lasts until the calm after it is proved.
    """
    series, fails = case.series, case.fails
    standing = fails.standing_at(onset_ns)
    if standing is not None:
        return _Detection(onset_ns, standing, True)
    until = end_ns + 1 if draft.end >= series.size else end_ns
    if draft.jump is not None:
        until = max(until, int(series.t_ns[draft.jump.last]) + 1)
    if draft.caused_by is not None:
        until = max(until, onset_ns + round(case.config.hazards.episode_end_s * NS_PER_S))
    found = fails.first_in(onset_ns, until)
    return _Detection(found[0], found[1], False) if found else _Detection(None, None, False)
