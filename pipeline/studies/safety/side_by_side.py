"""Reactive and composite fail-safety on the same run (LOC section III, Fig. 3 and 4), and redundant channels.

Reactive 1oo1: one solution, diagnosed by all monitors but the comparison of channels. Composite 2oo2: the
comparison of two solutions alone, both of which are needed. Reactive 1oo2: two reactive channels, one of which is
enough (LOC eq. 11). All are judged after the fact on the same faults, whatever the replay itself compared.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import (
    Clock,
    held_s,
    holds_at_rows,
    may_move,
    nominal_period_s,
    position_ns,
    trusted,
    uptime,
)
from pipeline.stages.epochs.verdicts import FailureLog, Verdicts, failure_log
from pipeline.stages.monitors.single import channel_monitor, on_path_of, paired
from pipeline.stages.run_row.bounds import independent_episodes
from pipeline.stages.run_row.run_figures import is_judged as judged_epoch
from pipeline.studies.safety.fault_counts import SolutionTables, fault_counts, faults_of_pair, verdict_of_both
from pipeline.studies.safety.tally import COMPOSITE, COUNTS, REACTIVE, REDUNDANT
from schemas.arrays import NS_PER_S, Bools
from schemas.config import Configuration
from schemas.enums import TRUTH, Judgement, MonitorState, RunStatus, Verdict
from schemas.frozen import frozen
from schemas.monitors import ALL_MONITORS

Row = dict[str, object]

COMPARISON = "channel"
"""The monitor of two solutions that composite fail-safety consists of."""
_DIAGNOSIS = tuple(monitor.name for monitor in ALL_MONITORS if monitor.solutions == 1)
"""The monitors that one solution is diagnosed by."""
_STATES = pl.col("trusted", "known", "wrong")
_ALONG = tuple(monitor.name for monitor in ALL_MONITORS if monitor.axis == "along" and monitor.scale is not None)
EPOCH_COLUMNS = (
    *("t", "solution", "netelement_id", "measure_m", "path_m", "on_track", "gate_probability", "confidence_m"),
    *("sigma_along_m", "error_low_m", "error_high_m", "judgement", "moving"),
    *(f"{name}_{part}" for name in _DIAGNOSIS for part in ("state", "value", "threshold")),
)
"""Columns of the epochs that the comparison takes."""


@frozen
class _Diagnosed:
    """Epochs under one kind of diagnosis: its fails, where it worked, and where a truth judged."""

    clock: Clock
    fails: FailureLog
    working: Bools
    known: Bools
    wrong: Bools
    moving: Bools


def side_by_side(
    epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, runs: pl.DataFrame, config: Configuration
) -> pl.DataFrame:
    """What each architecture made of one run, from its tables with all solutions.

    Working is: a valid, confident, unambiguous position (of both solutions where both are needed), a diagnosis that
    judges, and no fail now nor in the recovery time before. T_D counts from the fault's onset to the first fail. A
    false alarm of the comparison is one while both solutions were right. A pair has one row, and the time of all rows
    is that of the run.

    Args:
        epochs: of all solutions of the run, with `EPOCH_COLUMNS`.
        hazards: of the run.
        alarms: of the run.
        runs: its rows of `runs`, one per solution.
        config: the configuration of the result.

    Returns:
        `COUNTS`, one row per architecture and solution or pair.

    Source:
        LOC section III, Fig. 3 and 4; LOC eq. 11.
    """
    names = sorted(runs.filter(pl.col("status") != RunStatus.FAILED)["solution"].to_list())
    solutions = {name: _tables_of_solution(name, epochs, hazards, alarms, runs) for name in names}
    channels = {name: _diagnose_reactive(one, config) for name, one in solutions.items()}
    rows: list[Row] = []
    for name, channel in channels.items():
        one = solutions[name]
        counts = _architecture_counts(one.faults, channel, _verdicts_in_table(channel.fails, one.alarms))
        rows.append({"architecture": REACTIVE, "solution": name, **counts})
    for name, other in combinations(names, 2):
        pair = {"solution": name, "other": other}
        rows.append({"architecture": COMPOSITE, **pair, **_count_composite(solutions[name], solutions[other], config)})
        rows.append({"architecture": REDUNDANT, **pair, **_count_redundant(channels[name], channels[other])})
    moving_s = _moving_s(epochs.filter(pl.col("solution").is_in(names)))
    return pl.DataFrame(rows, schema=COUNTS).with_columns(moving_s=pl.lit(moving_s, pl.Float64))


def _moving_s(epochs: pl.DataFrame) -> float | None:
    """Time in which the train moved or nobody knows whether it did [s], gaps included, from the first epoch of any
    solution to the last; None where it is never known to have moved (as `runs.availability`).
    """
    steps = epochs.group_by("t").agg(may=may_move().any(), known=pl.col("moving").any()).sort("t")
    steps = steps.with_columns(step_s=(pl.col("t").shift(-1) - pl.col("t")).dt.total_nanoseconds() / NS_PER_S)[:-1]
    return float(steps.filter("may")["step_s"].sum()) if steps["known"].any() else None


def _tables_of_solution(
    name: str, epochs: pl.DataFrame, hazards: pl.DataFrame, alarms: pl.DataFrame, runs: pl.DataFrame
) -> SolutionTables:
    """The tables of one solution."""
    of_solution = pl.col("solution") == name
    evidence = runs.filter(of_solution)["evidence"].cast(pl.String).to_list()
    return SolutionTables(
        epochs=epochs.filter(of_solution).sort("t"),
        faults=independent_episodes(hazards.filter(of_solution)),
        alarms=alarms.filter(of_solution),
        with_truth=len(evidence) == 1 and evidence[0] in TRUTH,
    )


def _diagnose_reactive(solution: SolutionTables, config: Configuration) -> _Diagnosed:
    """One solution under all monitors but the comparison (1oo1); diagnosed where a monitor along has a verdict."""
    judged = pl.any_horizontal(_has_verdict(name) for name in _ALONG)
    epochs = solution.epochs.drop("moving", "path_m").hstack(_state_columns(solution, trusted(config)).drop("t"))
    return _diagnose(epochs, _DIAGNOSIS, judged, config)


def _has_verdict(monitor: str) -> pl.Expr:
    """Expression on epochs: the monitor has a verdict."""
    return pl.col(f"{monitor}_state").cast(pl.String) != MonitorState.NOT_EVALUATED.value


def _count_composite(first: SolutionTables, second: SolutionTables, config: Configuration) -> Row:
    """Counts of two solutions that are compared, at the epochs of the one that measures less often."""
    slower, faster = (first, second) if _period_s(first) >= _period_s(second) else (second, first)
    placed = on_path_of(slower.epochs, faster.epochs, config.lds).with_columns(fix_valid=pl.col("path_m").is_not_null())
    positioned = slower.epochs.with_columns(fix_valid=pl.col("path_m").is_not_null())
    compared = pl.DataFrame(channel_monitor(positioned, placed, config).columns(COMPARISON))
    row_other = paired(slower.epochs, faster.epochs, config.lds)["row_other"]
    theirs = _state_columns(faster, trusted(config)).select(_STATES.gather(row_other).fill_null(value=False))
    ours = _state_columns(slower, trusted(config))
    wrong = ours["wrong"] | theirs["wrong"]
    both = ours.with_columns(
        trusted=ours["trusted"] & theirs["trusted"], known=(ours["known"] & theirs["known"]) | wrong, wrong=wrong
    )
    channel = _diagnose(both.hstack(compared), (COMPARISON,), _has_verdict(COMPARISON), config)
    verdicts = [verdict_of_both(alarm, (slower, faster), config.hazards) for alarm in channel.fails.alarms]
    return _architecture_counts(faults_of_pair(slower.faults, faster.faults), channel, verdicts)


def _period_s(solution: SolutionTables) -> float:
    """Usual time between positions [s], 0 where there are hardly any."""
    return nominal_period_s(position_ns(solution.epochs)) or 0.0


def _state_columns(solution: SolutionTables, position: pl.Expr) -> pl.DataFrame:
    """Columns: `position` (an expression) may be relied on, a truth judged it, and judged it wrong."""
    known = judged_epoch() & pl.lit(solution.with_truth)
    return solution.epochs.select(
        "t",
        "moving",
        "path_m",
        trusted=position.fill_null(value=False),
        known=known.fill_null(value=False),
        wrong=(known & (pl.col("judgement") == Judgement.WRONG)).fill_null(value=False),
    )


def _diagnose(epochs: pl.DataFrame, monitors: tuple[str, ...], judged: pl.Expr, config: Configuration) -> _Diagnosed:
    """What one kind of diagnosis, by these monitors, makes of epochs.

    `epochs`: `_state_columns`, with the columns of `monitors` and those that `judged` takes.
    """
    clock = Clock.of(epochs, config)
    verdicts = {name: Verdicts.of_table(epochs, name) for name in monitors}
    fails = failure_log(clock.t_ns, np.zeros(clock.t_ns.size, dtype=np.bool_), verdicts, config.lds.recovery_s)
    evaluated = holds_at_rows(epochs, judged)
    working = evaluated & holds_at_rows(epochs, pl.col("trusted"))
    for span in fails.alarms:
        until_ns = span.end_ns + round(config.lds.recovery_s * 1e9)
        working &= (clock.t_ns < span.start_ns) | (clock.t_ns > until_ns)
    known, wrong, moving = (holds_at_rows(epochs, pl.col(name)) for name in ("known", "wrong", "moving"))
    return _Diagnosed(clock, fails, working, known, known & wrong, moving)


def _architecture_counts(faults: pl.DataFrame, channel: _Diagnosed, verdicts: list[Verdict]) -> Row:
    """What one kind of diagnosis made of the faults, its alarms, and of the time (`COUNTS`)."""
    clock = channel.clock
    up = uptime(clock.t_ns, channel.working, clock.limit_s)
    # Time in work that a truth judged: what rates count (DOMAIN section 6).
    judged_s = float(clock.held_s[channel.known & channel.working].sum())
    return fault_counts(faults, channel.fails) | {
        "alarms": len(verdicts),
        "false_alarms": verdicts.count(Verdict.FALSE),
        "open_alarms": verdicts.count(Verdict.UNKNOWN),
        "judged_s": judged_s,
        "working_s": float(clock.held_s[channel.working & channel.moving].sum()),
        "up_s": up.up_s,
        "losses": up.losses,
        "truth_s": judged_s,
        "wrong_s": float(clock.held_s[channel.wrong & channel.working].sum()),
    }


def _count_redundant(first: _Diagnosed, second: _Diagnosed) -> Row:
    """Time in which at least one of two reactive channels works; an epoch counts at its own time (LOC eq. 11)."""
    parts = [
        pl.DataFrame({"t_ns": channel.clock.t_ns, "working": channel.working, "moving": channel.moving})
        for channel in (first, second)
    ]
    merged = pl.concat(parts).group_by("t_ns").agg(pl.col("working", "moving").any()).sort("t_ns")
    t_ns, working, moving = (merged[name].to_numpy() for name in ("t_ns", "working", "moving"))
    limit_s = max(first.clock.limit_s, second.clock.limit_s)
    up = uptime(t_ns, working, limit_s)
    # Held from one working epoch to the next: between them may lie epochs of the channel that does not work.
    working_s = float(held_s(t_ns[working], limit_s)[moving[working]].sum())
    return {"working_s": working_s, "up_s": up.up_s, "losses": up.losses}


def _verdicts_in_table(fails: FailureLog, alarms: pl.DataFrame) -> list[Verdict]:
    """Verdict of each alarm of the architecture: that of the replay's alarm that it began in."""
    spans = alarms.select(pl.col("t_start", "t_end").to_physical(), pl.col("verdict").cast(pl.String)).rows()
    return [
        next((Verdict(verdict) for start, end, verdict in spans if start <= span.start_ns <= end), Verdict.UNKNOWN)
        for span in fails.alarms
    ]
