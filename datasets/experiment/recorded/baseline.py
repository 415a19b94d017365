"""One run as it was recorded, by one bank, and the instants at which faults begin: the same for every bank.

They are drawn where nothing was wrong.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left, insort
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import polars as pl

from datasets.experiment.recorded.plan import Bank, Cell, RecordedPlan
from datasets.experiment.workers import random_generator
from datasets.inject import Recording
from pipeline.one_run import monitor_alone
from pipeline.stages.epochs.clock import Clock, holds_at_rows, unambiguous
from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.judge import judge
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
# Share of the positions that must have satellites: a range fault moves only these.
_SHARE_WITH_RANGES = 0.99


@frozen
class FaultFree:
    """One bank on recorded runs without a fault: alarms in so many hours, time with a TVB and in all."""

    bank: str
    runs: int
    hours: float
    alarms: int
    tvb_s: float
    recorded_s: float


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
        """Name of the solution."""
        return self.monitored.solution.name

    @property
    def config(self) -> Configuration:
        """The configuration of the bank."""
        return self.bank.config

    @cached_property
    def t_ns(self) -> Ints:
        """Times of the epochs [ns]."""
        return times_ns(self.epochs)

    @cached_property
    def own_error(self) -> OwnError:
        """Whether the recorded position's own error is known: somewhere a reference or reads call it right."""
        known = (self.epochs["judgement"] == Judgement.RIGHT.value).any()
        return OwnError.MEASURED if known else OwnError.ASSUMED

    @cached_property
    def own_errors_m(self) -> tuple[Floats, Floats]:
        """Least and largest own error in the direction of travel [m]; 0 where nothing in the run can say it."""
        if self.own_error is OwnError.ASSUMED:
            zero = np.zeros(self.t_ns.size)
            return zero, zero
        return floats(self.epochs, "error_low_m"), floats(self.epochs, "error_high_m")

    @cached_property
    def are_alarming(self) -> Bools:
        """Epochs at which a monitor fails, or the position is negated."""
        return flags(self.epochs, "alarm") | flags(self.epochs, "negated")

    @cached_property
    def clock(self) -> Clock:
        """How long each epoch holds."""
        return Clock.of(self.epochs, self.config)

    def fault_free(self) -> FaultFree:
        """What this bank did on the run as it was recorded; no alarm can begin while one stands."""
        held_s = self.clock.held_s
        hours = float(held_s[self.have_verdict & ~self.are_alarming].sum()) / 3600.0
        tvb_s = float(held_s[flags(self.epochs, "tvb")].sum())
        return FaultFree(self.bank.name, 1, hours, self.alarms.height, tvb_s, float(held_s.sum()))

    @cached_property
    def have_verdict(self) -> Bools:
        """Epochs at which some monitor had a verdict."""
        states = pl.any_horizontal(pl.col(r"^.*_state$").cast(pl.String).is_in(["pass", "fail"]))
        return holds_at_rows(self.epochs, states)

    def left_out(self, quiet_s: float) -> Ints:
        """Per epoch the reason (number in `LeftOut`) why no fault begins there, -1 where one may."""
        after_gap = np.diff(self.t_ns, prepend=self.t_ns[:1]) > self.clock.limit_s * NS_PER_S
        doubtful = np.zeros(self.t_ns.size, dtype=bool)
        if self.own_error is OwnError.MEASURED:
            doubtful = ~holds_at_rows(self.epochs, pl.col("judgement") == Judgement.RIGHT.value)
        reason = np.full(self.t_ns.size, -1)
        for why, where in (
            (LeftOut.NOT_RIGHT, doubtful),
            (LeftOut.NO_TVB, ~flags(self.epochs, "tvb") | after_gap),
            (
                LeftOut.AMBIGUOUS,
                ~holds_at_rows(self.epochs, unambiguous()) & self.epochs["path_m"].is_not_null().to_numpy(),
            ),
            (LeftOut.ALARM, self.are_alarming),
        ):
            reason[where] = _REASONS.index(why)
        return _leave_out_before_quiet(reason, self.t_ns, quiet_s)

    def satellites_at(self, t_ns: int) -> list[str]:
        """Satellites used at this epoch, in order of name."""
        ranges = self.monitored.prepared.ranges(self.solution)
        if ranges is None:
            return []
        return ranges.filter((pl.col("t") == instant(t_ns)) & pl.col("used"))["sv"].unique().sort().to_list()

    @cached_property
    def has_ranges(self) -> bool:
        """Nearly all positions have satellites, so that a range fault can move them."""
        ranges = self.monitored.prepared.ranges(self.solution)
        if ranges is None or ranges.is_empty():
            return False
        return float(np.isin(self.t_ns, times_ns(ranges)).mean()) >= _SHARE_WITH_RANGES


def instant(t_ns: int) -> pl.Expr:
    """A time stamp [ns since 1970, UTC] to compare with columns `t`."""
    return pl.lit(t_ns).cast(pl.Datetime("ns", "UTC"))


def _leave_out_before_quiet(reason: Ints, t_ns: Ints, quiet_s: float) -> Ints:
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
    prepared = monitored.prepared
    # Along the track the experiment would measure how well the positions agree with themselves, or nothing at all.
    require_independent_odometer(prepared)
    evidence, reference = prepared.evidence(), prepared.run.reference
    judged = judge(
        JudgeInput(monitored.solution, evidence, monitored.odometry, prepared.vehicle, prepared.config, reference)
    )
    return Baseline(run, site, bank, monitored, evidence, judged.epochs.table, judged.alarms, Recording(run, site))


@frozen
class OnsetRoom:
    """Where faults may begin in one run, by all banks; arrays per epoch.

    `left_out`: number of the reason in `LeftOut`, -1 where a fault may begin; `free_ns`: before the next alarm or
    negation, or the last epoch.
    """

    run_id: str
    first_ns: int
    t_ns: Ints
    held_s: np.ndarray
    left_out: Ints
    free_ns: Ints
    has_ranges: bool

    def takes_cell(self, cell: Cell) -> bool:
        """Whether the run records what the fault of a cell needs."""
        return self.has_ranges or not cell.hits_satellite

    def eligible_epochs(self, cell: Cell) -> Bools:
        """Epochs at which a fault of this cell may begin and be watched to its end."""
        watched: Bools = self.t_ns + round(cell.watch_s * NS_PER_S) <= self.free_ns
        return watched & (self.left_out < 0) & self.takes_cell(cell)

    def longest_s(self) -> float:
        """The longest watch that some epoch allows [s]."""
        allowed = (self.free_ns - self.t_ns)[self.left_out < 0]
        return float(allowed.max(initial=0)) / NS_PER_S

    def seconds_left_out(self) -> dict[str, float]:
        """Time in which no fault begins, by reason, and the rest [s]."""
        by_reason = {
            f"{why.value}_s": float(self.held_s[self.left_out == number].sum()) for number, why in enumerate(_REASONS)
        }
        return {**by_reason, "usable_s": float(self.held_s[self.left_out < 0].sum())}


def room_of(baselines: Sequence[Baseline], quiet_s: float) -> OnsetRoom:
    """What all banks leave of a run: an epoch that one of them leaves out is left out for all."""
    first = baselines[0]
    left_out = np.max([base.left_out(quiet_s) for base in baselines], axis=0)
    alarming = np.logical_or.reduce([base.are_alarming for base in baselines])
    # An alarm at the very end of a watch would be taken for one of the fault.
    ends_ns = np.where(alarming, first.t_ns - 1, first.t_ns[-1])
    return OnsetRoom(
        run_id=first.run.run_id,
        first_ns=first.recording.first_ns,
        t_ns=first.t_ns,
        held_s=first.clock.held_s,
        left_out=left_out,
        free_ns=np.minimum.accumulate(ends_ns[::-1])[::-1],
        has_ranges=first.has_ranges,
    )


@frozen
class Onset:
    """One fault to put in: of this cell, into this run, at this epoch; `lot`: what a satellite is drawn by, [0, 1)."""

    number: int
    cell: Cell
    run_id: str
    t_ns: int
    lot: float


def onsets_of(
    rooms: Sequence[OnsetRoom], cells: Sequence[Cell], plan: RecordedPlan
) -> dict[str, list[tuple[str, int, float]]]:
    """Per cell the runs, epochs and lots drawn: at most `cell.count`, fewer where there is no room for more."""
    return {cell.name: _draw_onsets(rooms, cell, plan) for cell in cells}


def number_onsets(cells: Sequence[Cell], drawn: Mapping[str, list[tuple[str, int, float]]]) -> list[Onset]:
    """All onsets, cell by cell, in order of run and time."""
    rows = [(cell, *place) for cell in cells for place in sorted(drawn[cell.name])]
    return [Onset(number, *row) for number, row in enumerate(rows)]


def _draw_onsets(rooms: Sequence[OnsetRoom], cell: Cell, plan: RecordedPlan) -> list[tuple[str, int, float]]:
    """Epochs of all runs in random order, each taken unless it is too near to one of its run that was taken before."""
    rng = random_generator(plan.seed, zlib.crc32(cell.name.encode()))
    places = [np.flatnonzero(room.eligible_epochs(cell)) for room in rooms]
    owner = np.repeat(np.arange(len(rooms)), [rows.size for rows in places])
    rows = np.concatenate(places) if places else np.zeros(0, dtype=np.int64)
    apart_ns = round(plan.apart_s * NS_PER_S)
    taken_ns: list[list[int]] = [[] for _ in rooms]
    drawn: list[tuple[str, int, float]] = []
    for place in rng.permutation(rows.size).tolist():
        room = rooms[int(owner[place])]
        t_ns = int(room.t_ns[rows[place]])
        if len(drawn) == cell.count:
            break
        if _is_apart(taken_ns[int(owner[place])], t_ns, apart_ns):
            insort(taken_ns[int(owner[place])], t_ns)
            drawn.append((room.run_id, t_ns, float(rng.random())))
    return drawn


def _is_apart(taken_ns: list[int], t_ns: int, apart_ns: int) -> bool:
    """Whether an instant is far enough from all that were taken."""
    at = bisect_left(taken_ns, t_ns)
    neighbours = taken_ns[max(at - 1, 0) : at + 1]
    return all(abs(t_ns - other) >= apart_ns for other in neighbours)
