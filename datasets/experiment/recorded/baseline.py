"""One run as it was recorded, by one bank: what it raised without a fault, and where it may be used."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import polars as pl

from datasets.experiment.recorded.plan import Bank
from datasets.inject import Recording
from pipeline.one_run import monitor_alone
from pipeline.stages.epochs.clock import Clock, holds, unambiguous
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.judge import Judged, judge
from pipeline.stages.judge.judgement import JudgeInput
from pipeline.stages.monitored import MonitoredSolution
from pipeline.stages.prepare import require_independent_odometer
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration, Vehicle
from schemas.enums import Judgement, LeftOut, OwnError
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site

_REASONS = tuple(LeftOut)
# Satellites must stand beside so many of the positions: a range fault moves only these.
_RANGES_BESIDE = 0.99


@frozen
class Baseline:
    """One solution of a run, replayed and judged without a fault.

    `recording`: the run as read, for faults; `epochs`: judged; `alarms`: episodes.
    """

    run: RunLog
    site: Site
    bank: Bank
    monitored: MonitoredSolution
    evidence: TrainEvidence
    epochs: pl.DataFrame
    alarms: pl.DataFrame
    recording: Recording

    @property
    def solution(self) -> str:
        return self.monitored.solution.name

    @property
    def config(self) -> Configuration:
        return self.bank.config

    @cached_property
    def t_ns(self) -> Ints:
        return times_ns(self.epochs)

    @cached_property
    def own_error(self) -> OwnError:
        """Whether the recorded position's own error is known: somewhere a reference or reads call it right."""
        known = (self.epochs["judgement"] == Judgement.RIGHT.value).any()
        return OwnError.MEASURED if known else OwnError.ASSUMED

    @cached_property
    def own_m(self) -> tuple[Floats, Floats]:
        """Least and largest own error in the direction of travel [m]; 0 where nothing in the run can say it."""
        if self.own_error is OwnError.ASSUMED:
            zero = np.zeros(self.t_ns.size)
            return zero, zero
        return floats(self.epochs, "error_low_m"), floats(self.epochs, "error_high_m")

    @cached_property
    def alarming(self) -> Bools:
        """A monitor fails, or the position is negated."""
        return flags(self.epochs, "alarm") | flags(self.epochs, "negated")

    @cached_property
    def clock(self) -> Clock:
        return Clock.of(self.epochs, self.config)

    def hours(self) -> float:
        """Time held by epochs at which an alarm could have begun [h]: none can while one stands."""
        return float(self.clock.held_s[self.watched & ~self.alarming].sum()) / 3600.0

    @cached_property
    def watched(self) -> Bools:
        """Some monitor had a verdict."""
        states = pl.any_horizontal(pl.col(r"^.*_state$").cast(pl.String).is_in(["pass", "fail"]))
        return holds(self.epochs, states)

    def left_out(self, quiet_s: float) -> Ints:
        """Per epoch the reason (number in `LeftOut`) why no fault begins there, -1 where one may."""
        after_gap = np.diff(self.t_ns, prepend=self.t_ns[:1]) > self.clock.limit_s * NS_PER_S
        doubtful = np.zeros(self.t_ns.size, dtype=bool)
        if self.own_error is OwnError.MEASURED:
            doubtful = ~holds(self.epochs, pl.col("judgement") == Judgement.RIGHT.value)
        reason = np.full(self.t_ns.size, -1)
        for why, where in (
            (LeftOut.NOT_RIGHT, doubtful),
            (LeftOut.NO_TVB, ~flags(self.epochs, "tvb") | after_gap),
            (LeftOut.AMBIGUOUS, ~holds(self.epochs, unambiguous()) & floats_known(self.epochs, "path_m")),
            (LeftOut.ALARM, self.alarming),
        ):
            reason[where] = _REASONS.index(why)
        return _with_quiet(reason, self.t_ns, quiet_s)

    def satellites_at(self, t_ns: int) -> list[str]:
        """Satellites used at this epoch, in order of name."""
        ranges = self.monitored.prepared.ranges(self.solution)
        if ranges is None:
            return []
        stamp = pl.lit(t_ns).cast(pl.Datetime("ns", "UTC"))
        return ranges.filter((pl.col("t") == stamp) & pl.col("used"))["sv"].unique().sort().to_list()

    @cached_property
    def has_ranges(self) -> bool:
        """Satellites stand beside nearly all positions, so that a range fault can move them."""
        ranges = self.monitored.prepared.ranges(self.solution)
        if ranges is None or ranges.is_empty():
            return False
        return float(np.isin(self.t_ns, times_ns(ranges)).mean()) >= _RANGES_BESIDE


def floats_known(frame: pl.DataFrame, column: str) -> Bools:
    """Where a nullable number is known."""
    return frame[column].is_not_null().to_numpy()


def _with_quiet(reason: Ints, t_ns: Ints, quiet_s: float) -> Ints:
    """Epochs too soon after what is left out, or after the first epoch, are left out too."""
    bad_ns = np.where(reason >= 0, t_ns, t_ns[0])
    soon = t_ns - np.maximum.accumulate(bad_ns) < quiet_s * NS_PER_S
    return np.where((reason < 0) & soon, _REASONS.index(LeftOut.TOO_SOON), reason)


def baseline_of(run: RunLog, site: Site, vehicle: Vehicle, bank: Bank, solution: str) -> Baseline:
    """Replay and judge the run as it is.

    Raises `InputError` where faults were injected, it has no independent odometer, or it cannot be replayed.
    """
    if run.faults is not None and run.faults.height:
        raise InputError(
            "holds injected faults already",
            place=f"{run.run_id}: faults",
            found=f"{run.faults.height} rows",
            expected="a run as it was recorded",
        )
    monitored = monitor_alone(run, site, vehicle, bank.config, solution)
    # Along the track the experiment would measure how well the positions agree with themselves, or nothing at all.
    require_independent_odometer(monitored.prepared)
    evidence = monitored.prepared.evidence()
    judged = _judged(monitored, evidence)
    return Baseline(run, site, bank, monitored, evidence, judged.epochs.table, judged.alarms, Recording(run, site))


def _judged(monitored: MonitoredSolution, evidence: TrainEvidence) -> Judged:
    prepared = monitored.prepared
    reference = prepared.run.reference
    return judge(
        JudgeInput(monitored.solution, evidence, monitored.odometry, prepared.vehicle, prepared.config, reference)
    )
