"""Reactive and composite fail-safety on the same run (LOC section III, Fig. 3 and 4), and redundant channels.

Reactive 1oo1: one solution, diagnosed by all monitors but the comparison of channels. Composite 2oo2: the
comparison of two solutions alone, both of which are needed. Reactive 1oo2: two reactive channels, one of which is
enough (LOC eq. 11). All are judged after the fact on the same faults, whatever the replay itself compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import polars as pl

from pipeline.epochs.clock import Clock, met, trusted
from pipeline.epochs.failure_log import FailureLog, failure_log
from pipeline.epochs.timeline import held_s, uptime
from pipeline.figures.independent import independent_episodes, missed_detection
from pipeline.figures.run_figures import judged as judged_epoch
from pipeline.monitors.channels import on_path_of, paired
from pipeline.monitors.single import channel_monitor
from pipeline.safety.composite_alarms import Solution, verdict_of_both
from pipeline.safety.tally import COMPOSITE, COUNTS, REACTIVE, REDUNDANT
from schemas.arrays import Bools
from schemas.config import Configuration
from schemas.enums import TRUTH, Judgement, MonitorState, RunStatus, Verdict
from schemas.tables import MONITORS, SCALES

Row = dict[str, object]

COMPARISON = "channel"
_DIAGNOSIS = tuple(name for name in MONITORS if name != COMPARISON)
_ALONG = tuple(f"along_{scale}" for scale in SCALES)
EPOCH_COLUMNS = (
    *("t", "solution", "netelement_id", "measure_m", "path_m", "on_track", "gate_probability", "confidence_m"),
    *("sigma_along_m", "error_low_m", "error_high_m", "judgement"),
    *(f"{name}_{part}" for name in _DIAGNOSIS for part in ("state", "value", "threshold")),
)
"""Columns of the epochs that the comparison takes."""


@dataclass(frozen=True)
class _Channel:
    """Epochs under one kind of diagnosis: its fails, where it judged, and where it worked."""

    clock: Clock
    fails: FailureLog
    judged: Bools
    working: Bools
    known: Bools
    wrong: Bools


def side_by_side(
    epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, runs: pl.DataFrame, config: Configuration
) -> pl.DataFrame:
    """What each architecture made of one run (`COUNTS`), from its tables with all solutions.

    `epochs` with `EPOCH_COLUMNS`. Working is: a valid, confident, unambiguous position (of both solutions where both
    are needed), a diagnosis that judges, and no fail now nor in the recovery time before. T_D counts from the
    fault's onset to the first fail. A false alarm of the comparison is one while both solutions were right.
    """
    names = sorted(runs.filter(pl.col("status") != RunStatus.FAILED)["solution"].to_list())
    solutions = {name: _solution(name, epochs, hazards, alarms, runs) for name in names}
    channels = {name: _reactive(one, config) for name, one in solutions.items()}
    rows: list[Row] = []
    for name, channel in channels.items():
        one = solutions[name]
        verdicts = _verdicts_in_table(channel.fails, one.alarms)
        found = _faults(one.faults, None, channel) | _alarms(channel, verdicts) | _working(channel)
        rows.append({"architecture": REACTIVE, "solution": name, **found})
    for name, other in permutations(names, 2):
        pair = {"solution": name, "other": other}
        rows.append({"architecture": COMPOSITE, **pair, **_composite(solutions[name], solutions[other], config)})
        if name < other:
            rows.append({"architecture": REDUNDANT, **pair, **_redundant(channels[name], channels[other])})
    return pl.DataFrame(rows, schema=COUNTS)


def _solution(
    name: str, epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, runs: pl.DataFrame
) -> Solution:
    own = pl.col("solution") == name
    evidence = runs.filter(own)["evidence"].cast(pl.String).to_list()
    return Solution(
        epochs=epochs.filter(own).sort("t"),
        faults=independent_episodes(hazards.filter(own)),
        alarms=alarms.filter(own),
        with_truth=len(evidence) == 1 and evidence[0] in TRUTH,
    )


def _reactive(one: Solution, config: Configuration) -> _Channel:
    judged = pl.any_horizontal(_evaluated(name) for name in _ALONG)
    return _channel(one, one.epochs, _DIAGNOSIS, judged, trusted(config), config)


def _evaluated(monitor: str) -> pl.Expr:
    return pl.col(f"{monitor}_state").cast(pl.String) != MonitorState.NOT_EVALUATED.value


def _composite(one: Solution, other: Solution, config: Configuration) -> Row:
    placed = on_path_of(one.epochs, other.epochs).with_columns(fix_valid=pl.col("path_m").is_not_null())
    positioned = one.epochs.with_columns(fix_valid=pl.col("path_m").is_not_null())
    compared = channel_monitor(positioned, placed, config).select(
        pl.col("value", "threshold", "state").name.prefix(f"{COMPARISON}_")
    )
    met = other.epochs.select(other_trusted=trusted(config).gather(paired(one.epochs, other.epochs)["row_other"]))
    frame = one.epochs.select("t", own_trusted=trusted(config)).hstack(compared).hstack(met)
    trust = pl.col("own_trusted") & pl.col("other_trusted")
    channel = _channel(one, frame, (COMPARISON,), _evaluated(COMPARISON), trust, config)
    verdicts = [verdict_of_both(alarm, (one, other), config.hazards) for alarm in channel.fails.alarms]
    return _faults(one.faults, other.faults, channel) | _alarms(channel, verdicts) | _working(channel)


def _channel(
    one: Solution,
    epochs: pl.DataFrame,
    monitors: tuple[str, ...],
    judged: pl.Expr,
    position: pl.Expr,
    config: Configuration,
) -> _Channel:
    """`epochs`: those of the solution, with the columns that `monitors`, `judged` and `position` take."""
    columns = [f"{name}_{part}" for name in monitors for part in ("state", "value", "threshold")]
    fails = failure_log(epochs.select("t", *columns, negated=pl.lit(value=False)), config.lds.recovery_s)
    clock = Clock.of(epochs, config)
    seen = met(epochs, judged)
    working = seen & met(epochs, position)
    for span in fails.alarms:
        until_ns = span.end_ns + round(config.lds.recovery_s * 1e9)
        working &= (clock.t_ns < span.start_ns) | (clock.t_ns > until_ns)
    known = met(one.epochs, judged_epoch() & pl.lit(one.with_truth))
    wrong = known & met(one.epochs, pl.col("judgement") == Judgement.WRONG)
    return _Channel(clock, fails, seen, working, known, wrong)


def _alarms(channel: _Channel, verdicts: list[Verdict]) -> Row:
    return {
        "alarms": len(verdicts),
        "false_alarms": verdicts.count(Verdict.FALSE),
        "open_alarms": verdicts.count(Verdict.UNKNOWN),
        "judged_s": float(channel.clock.held_s[channel.judged].sum()),
    }


def _working(channel: _Channel) -> Row:
    clock, held = channel.clock, channel.clock.held_s
    up = uptime(clock.t_ns, channel.working, clock.limit_s)
    return {
        "held_s": float(held.sum()),
        "working_s": float(held[channel.working].sum()),
        "up_s": up.up_s,
        "losses": up.losses,
        "truth_s": float(held[channel.known].sum()),
        "wrong_s": float(held[channel.wrong & channel.working].sum()),
    }


def _redundant(one: _Channel, other: _Channel) -> Row:
    """Time in which at least one of two reactive channels works; an epoch counts at its own time (LOC eq. 11)."""
    parts = [pl.DataFrame({"t_ns": channel.clock.t_ns, "working": channel.working}) for channel in (one, other)]
    merged = pl.concat(parts).group_by("t_ns").agg(pl.col("working").any()).sort("t_ns")
    t_ns, working = merged["t_ns"].to_numpy(), merged["working"].to_numpy()
    limit_s = max(one.clock.limit_s, other.clock.limit_s)
    whole_s, up = float(held_s(t_ns, limit_s).sum()), uptime(t_ns, working, limit_s)
    return {"held_s": whole_s, "working_s": min(up.up_s, whole_s), "up_s": up.up_s, "losses": up.losses}


def _faults(faults: pl.DataFrame, others: pl.DataFrame | None, channel: _Channel) -> Row:
    """`others`: faults of the other solution, so that common ones can be told apart."""
    last, kind = int(channel.clock.t_ns[-1]), faults.schema["begin"]
    ends = faults.select(pl.col("begin").to_physical(), pl.col("t_end").to_physical().fill_null(last)).rows()
    found = [_detected_ns(channel.fails, *span) for span in ends]
    failed, missed, common = pl.col("failed"), pl.col("missed"), pl.col("failed") & pl.col("common")
    counts = (
        faults.with_columns(
            t_detected=pl.Series(found, dtype=pl.Int64).cast(kind),
            common=pl.Series([others is not None and _overlaps(others, *span) for span in ends], dtype=pl.Boolean),
        )
        .with_columns(missed=missed_detection().fill_null(value=False))
        .select(
            hazards=pl.len(),
            failures=failed.sum(),
            missed=missed.sum(),
            common_failures=common.sum(),
            common_missed=(common & missed).sum(),
            failures_judged=(failed & pl.col("with_truth")).sum(),
            missed_judged=(missed & pl.col("with_truth")).sum(),
        )
    )
    delays = [(moment - begin) / 1e9 for moment, (begin, _) in zip(found, ends, strict=True) if moment is not None]
    return counts.row(0, named=True) | {"delays_s": delays}


def _detected_ns(fails: FailureLog, begin: int, last: int) -> int | None:
    """An alarm that stands at the onset detects at once, else the first fail until the fault's end."""
    if fails.standing_at(begin) is not None:
        return begin
    first = fails.first_in(begin, last + 1)
    return None if first is None else first[0]


def _overlaps(faults: pl.DataFrame, begin: int, last: int) -> bool:
    end = pl.col("t_end").to_physical()
    meets = (pl.col("begin").to_physical() <= last) & (end.is_null() | (end >= begin))
    return faults.filter(pl.col("failed") & meets).height > 0


def _verdicts_in_table(fails: FailureLog, alarms: pl.DataFrame) -> list[Verdict]:
    """Each alarm of the architecture has the verdict of the alarm of the replay that it began in."""
    spans = alarms.select(pl.col("t_start", "t_end").to_physical(), pl.col("verdict").cast(pl.String)).rows()
    return [
        next((Verdict(verdict) for start, end, verdict in spans if start <= span.start_ns <= end), Verdict.UNKNOWN)
        for span in fails.alarms
    ]
