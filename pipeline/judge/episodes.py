"""Episodes: since when, until when and for how long in use a position was wrong (DOMAIN section 5.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import FailureLog
from pipeline.judge.bench import Bench, Series
from pipeline.judge.judgement import UNKNOWN, WRONG
from pipeline.judge.jumps import Jump
from schemas.arrays import NS_PER_S, Bools, Ints, spans_of
from schemas.config import HazardConfig

_ODOMETER = "odometer"


@dataclass(frozen=True)
class Episode:
    """A fault from its onset until the position is right again; numbers are of `Series`, `end` is the first after it.

    `step`: the jump that began it; `jump_back`: the one that ended it; `failure`: first position of a lasting wrong.
    """

    mark: int
    onset: int
    end: int
    onset_ns: int
    end_ns: int
    step: Jump | None
    jump_back: Jump | None
    failure: int | None
    failure_known: bool
    detected_ns: int | None
    monitor: str | None
    alarm_before_onset: bool
    hazardous_s: float
    hazardous_may_s: float

    def undetected_ns(self, series: Series) -> tuple[int, int]:
        """From onset to detection, or to the end; what a step offers on its way lies before its first position."""
        begin_ns = self.onset_ns
        if self.step is not None:
            begin_ns = min(begin_ns, int(series.t_ns[self.step.first - 1]) + 1)
        return begin_ns, self.end_ns if self.detected_ns is None else self.detected_ns

    def holds(self, number: Ints) -> Bools:
        """Valid positions that belong to the episode."""
        inside: Bools = (number >= self.onset) & (number < self.end)
        return inside


def find_episodes(bench: Bench, log: FailureLog, faults: pl.DataFrame | None) -> list[Episode]:
    """One episode for each time that positions left the evidence, or offered a VB wrong."""
    series, config = bench.series, bench.config.hazards
    marks = np.flatnonzero((series.judged.code == WRONG) | _marked(bench))
    calm_from = _calm_from(series, config)
    quiet = _quiet(series, config)
    episodes: list[Episode] = []
    until = 0
    for mark in marks.tolist():
        if mark < until:
            continue
        episode = _episode(series, mark, until, calm_from, quiet, log, faults, config)
        episodes.append(episode)
        until = max(episode.end, mark + 1, 0 if episode.jump_back is None else episode.jump_back.last + 1)
    return episodes


def _marked(bench: Bench) -> Bools:
    """Valid positions that complete an offer judged wrong; what a jump offers on its way is the jump's."""
    offers, marked = bench.offers, np.zeros(bench.series.size, dtype=np.bool_)
    marked[offers.number[offers.offered & (offers.judged.code == WRONG)]] = True
    for jump in bench.series.jumps:
        marked[jump.first : jump.last + 1] = False
    return marked


def _episode(
    series: Series,
    mark: int,
    floor: int,
    calm_from: Ints,
    quiet: Bools,
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> Episode:
    calm = np.flatnonzero(quiet[floor:mark])
    after_calm = floor + int(calm[-1]) + 1 if calm.size else floor
    step = next((jump for jump in series.jumps if after_calm <= jump.last and jump.first <= mark), None)
    onset = max(floor, step.first) if step is not None else after_calm
    jump_back, end = _end(series, mark, step, calm_from, config)
    onset_ns = _onset_ns(series, onset, mark, step, log, faults, config)
    end_ns = int(series.t_ns[end]) if end < series.size else int(series.t_ns[-1]) + 1
    detected_ns, monitor, before = _detection(log, onset_ns, end_ns)
    failure = _failure(series, onset, end, step, config)
    known = failure is not None and (failure == 0 or series.judged.code[failure - 1] != UNKNOWN)
    # A position that takes a second to come back is wrong until then: the jump back belongs to the time in use.
    back = slice(onset, end if jump_back is None else jump_back.last + 1)
    code, used_s = series.judged.code[back], series.used_s[back]
    hazardous_s = float(used_s[code == WRONG].sum())
    may_s = hazardous_s + float(used_s[code == UNKNOWN].sum())
    return Episode(
        mark, onset, end, onset_ns, end_ns, step, jump_back, failure, known, detected_ns, monitor, before,
        hazardous_s, may_s,
    )  # fmt: skip


def _calm_from(series: Series, config: HazardConfig) -> Ints:
    """For each position the first one from it on at which the error stays within half the limit for long enough."""
    calm = (series.judged.largest_m <= 0.5 * config.failure_limit_m) & (series.judged.code != WRONG)
    hold_ns = round(config.episode_end_s * NS_PER_S)
    begins: Ints = np.full(series.size + 1, series.size, dtype=np.int64)
    for first, last in spans_of(calm):
        latest = int(np.searchsorted(series.t_ns, series.t_ns[last] - hold_ns, side="right"))
        begins[first:latest] = np.arange(first, max(first, latest))
    calm_from: Ints = np.minimum.accumulate(begins[::-1])[::-1][: series.size]
    return calm_from


def _quiet(series: Series, config: HazardConfig) -> Bools:
    """Errors that noise explains: |e| at most min(3 sqrt(sigma_x^2 + sigma_ref^2), half the limit)."""
    sigma_ref = 0.5 * (series.judged.high_m - series.judged.low_m) / config.evidence_factor
    noise = config.evidence_factor * np.hypot(np.nan_to_num(series.sigma_m), np.nan_to_num(sigma_ref))
    with np.errstate(invalid="ignore"):
        quiet: Bools = np.abs(series.judged.middle_m) <= np.minimum(noise, 0.5 * config.failure_limit_m)
    not_wrong: Bools = quiet & (series.judged.code != WRONG)
    return not_wrong


def _end(
    series: Series, mark: int, step: Jump | None, calm_from: Ints, config: HazardConfig
) -> tuple[Jump | None, int]:
    """The first position after the episode, and the jump back that ends it."""
    calm = int(calm_from[mark])
    for jump in series.jumps:
        after_step = jump.first > mark and (step is None or jump.first > step.last)
        if after_step and jump.first <= calm and _is_back(series, jump, config):
            return jump, jump.first
    return None, calm


def _is_back(series: Series, jump: Jump, config: HazardConfig) -> bool:
    """Against the error before it, and no longer beyond the limit after it."""
    before = float(series.judged.middle_m[jump.first - 1])
    after = float(series.judged.least_m[jump.last])
    return before * jump.step_m < 0.0 and after <= config.failure_limit_m and series.judged.code[jump.last] != WRONG


def _onset_ns(
    series: Series,
    onset: int,
    mark: int,
    step: Jump | None,
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> int:
    """As a `faults` stream names it; else the first epoch of the step or drift, or an alarm up to 30 s before."""
    onset_ns, mark_ns = int(series.t_ns[onset]), int(series.t_ns[mark])
    named = _named_onset_ns(faults, onset_ns, mark_ns)
    if named is not None:
        return named
    if step is None:
        began = log.start_within(onset_ns - round(config.alarm_lead_s * NS_PER_S), onset_ns)
        return onset_ns if began is None else began
    return onset_ns


def _named_onset_ns(faults: pl.DataFrame | None, onset_ns: int, mark_ns: int) -> int | None:
    """Begin of the fault that a `faults` stream names: the last one before the onset as seen, else the first after."""
    if faults is None:
        return None
    of_gnss = ~pl.col("target").str.contains(_ODOMETER)
    begin, end = (pl.col(name).dt.timestamp("ns") for name in ("t_start", "t_end"))
    lasts = of_gnss & (begin <= mark_ns) & (end.is_null() | (end >= onset_ns))
    begins = faults.filter(lasts).select(begin).to_series().sort().to_list()
    before = [t_ns for t_ns in begins if t_ns <= onset_ns]
    return before[-1] if before else next(iter(begins), None)


def _detection(log: FailureLog, onset_ns: int, end_ns: int) -> tuple[int | None, str | None, bool]:
    """First fail of any monitor in the episode; at once where an alarm was standing."""
    standing = log.standing_at(onset_ns)
    if standing is not None:
        return onset_ns, standing, True
    found = log.first_in(onset_ns, end_ns)
    return (None, None, False) if found is None else (*found, False)


def _failure(series: Series, onset: int, end: int, step: Jump | None, config: HazardConfig) -> int | None:
    """First position of a second of `wrong`; a step counts at once."""
    wrong = series.judged.code[onset:end] == WRONG
    hold_ns = round(config.failure_hold_s * NS_PER_S)
    for first, last in spans_of(wrong):
        begin, until = onset + first, onset + last
        at_once = step is not None and step.first <= begin <= step.last
        if at_once or series.t_ns[until] - series.t_ns[begin] >= hold_ns:
            return begin
    return None
