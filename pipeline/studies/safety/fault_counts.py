"""Faults of one solution, or of a pair: what a diagnosis made of them, and whether its alarms were due."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import AlarmEpisode, FailureLog
from pipeline.stages.judge.episodes import verdict_of_intervals
from pipeline.stages.judge.judgement import healthy_margins_m
from pipeline.stages.run_row.bounds import earliest_failure, missed_detection
from schemas.arrays import NS_PER_S, floats
from schemas.config import HazardConfig
from schemas.enums import Verdict
from schemas.frozen import frozen

_OPEN_END_NS = 2**63 - 1


def faults_of_pair(first: pl.DataFrame, second: pl.DataFrame) -> pl.DataFrame:
    """Faults of either solution, as from `independent_episodes`; those that overlap are one fault of the pair.

    `common`: a failure of each solution at the same time.
    """
    both = pl.concat([_mark_common(first, second), _mark_common(second, first)]).sort("begin")
    end_ns = pl.col("t_end").to_physical().fill_null(_OPEN_END_NS)
    begin_ns = pl.col("begin").to_physical()
    apart = begin_ns > end_ns.cum_max().shift(1)
    return both.group_by(fault=apart.fill_null(value=False).cum_sum(), maintain_order=True).agg(
        pl.col("begin", "t_failure").min(),
        t_failure_may=earliest_failure(),
        t_end=pl.when(pl.col("t_end").null_count() == 0).then(pl.col("t_end").max()),
        budget_s=pl.col("budget_s").min(),
        failed=pl.col("failed").any(),
        with_truth=pl.col("with_truth").all(),
        common=pl.col("common").any(),
    )


def _mark_common(faults: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """`faults`, `common` where both they and one of the others at the same time are failures."""
    spans = _spans_ns(faults).with_columns(pl.col("end").fill_null(_OPEN_END_NS)).rows()
    failed = _spans_ns(others.filter("failed"))
    coincides = pl.Series([_overlaps_any(failed, *span) for span in spans], dtype=pl.Boolean)
    return faults.with_columns(common=pl.col("failed") & coincides)


def _spans_ns(faults: pl.DataFrame, begin: str = "begin") -> pl.DataFrame:
    """`begin, end` of faults or alarms [ns]; an end that is open is null."""
    return faults.select(begin=pl.col(begin).to_physical(), end=pl.col("t_end").to_physical())


def _overlaps_any(spans: pl.DataFrame, begin_ns: int, last_ns: int) -> bool:
    """One of the spans, which may be open, lies at least in part between these instants."""
    meets = (pl.col("begin") <= last_ns) & (pl.col("end").is_null() | (pl.col("end") >= begin_ns))
    return spans.filter(meets).height > 0


def fault_counts(faults: pl.DataFrame, fails: FailureLog) -> dict[str, object]:
    """Counts of `pipeline.studies.safety.tally`; those of common faults only where `faults` has `common`."""
    last = int(fails.t_ns[-1])
    kind = faults.schema["begin"]
    ends = _spans_ns(faults).with_columns(pl.col("end").fill_null(last)).rows()
    detected_ns = [_detected_ns(fails, *span) for span in ends]
    failed = pl.col("failed")
    missed = pl.col("missed")
    judged = pl.col("with_truth")
    detected = faults.with_columns(t_detected=pl.Series(detected_ns, dtype=pl.Int64).cast(kind))
    detected = detected.with_columns(missed=missed_detection())
    counts = {
        "hazards": pl.len(),
        "failures": failed.sum(),
        "missed": missed.sum(),
        "failures_judged": (missed.is_not_null() & judged).sum(),
        "missed_judged": (missed & judged).sum(),
    }
    if "common" in faults.columns:
        counts |= {"common_failures": pl.col("common").sum(), "common_missed": (pl.col("common") & missed).sum()}
    delays = [
        (moment - begin) / 1e9 for moment, (begin, _) in zip(detected_ns, ends, strict=True) if moment is not None
    ]
    return detected.select(**counts).row(0, named=True) | {"delays_s": delays}


def _detected_ns(fails: FailureLog, begin: int, last: int) -> int | None:
    """An alarm that stands at the onset detects at once, else the first fail until the fault's end."""
    if fails.standing_at(begin) is not None:
        return begin
    first = fails.first_in(begin, last + 1)
    return None if first is None else first[0]


@frozen
class SolutionTables:
    """Tables of one solution of a run; `faults` one row per fault; `with_truth`: judged by a reference or reads."""

    epochs: pl.DataFrame
    faults: pl.DataFrame
    alarms: pl.DataFrame
    with_truth: bool


def verdict_of_both(alarm: AlarmEpisode, sides: tuple[SolutionTables, SolutionTables], config: HazardConfig) -> Verdict:
    """True where a solution was wrong, false where both were right all along, unknown where the evidence does not say.

    The rule of the `alarms` table (DOMAIN section 5.3), asked of both solutions.
    """
    verdicts = {_verdict_of_side(alarm, side, config) for side in sides}
    return next(verdict for verdict in (Verdict.TRUE, Verdict.UNKNOWN, Verdict.FALSE) if verdict in verdicts)


def _verdict_of_side(alarm: AlarmEpisode, side: SolutionTables, config: HazardConfig) -> Verdict:
    """The verdict of an alarm by the errors of one solution while it stood, and shortly before."""
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    part = side.epochs.filter(pl.col("t").to_physical().is_between(since_ns, alarm.end_ns))
    known = part.filter(pl.col("path_m").is_not_null())
    low_m, high_m, sigma_m = (floats(known, name) for name in ("error_low_m", "error_high_m", "sigma_along_m"))
    if _is_known_wrong(alarm, side):
        return Verdict.TRUE
    margin_m = healthy_margins_m(sigma_m, np.full(known.height, config.limits.failure_m), config)
    return verdict_of_intervals(low_m, high_m, margin_m, np.full(known.height, side.with_truth))


def _is_known_wrong(alarm: AlarmEpisode, side: SolutionTables) -> bool:
    """Whether the replay found a fault at that time, or called an alarm then true."""
    true = side.alarms.filter(pl.col("verdict").cast(pl.String) == Verdict.TRUE.value)
    spans = pl.concat([_spans_ns(side.faults), _spans_ns(true, "t_start")])
    return _overlaps_any(spans, alarm.start_ns, alarm.end_ns)
