"""One fault put into a recorded run in memory and replayed to the end of its watch, and what became of it.

Noticed when and by what, failed when, in use how long, balises accepted wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from datasets.experiment.recorded.baseline import Baseline, Onset, instant
from datasets.experiment.tables import Row
from datasets.faults import FaultKind, FaultSpec
from datasets.inject import inject
from pipeline.stages.epochs.clock import reactions_ns
from pipeline.stages.epochs.verdicts import MonitoredEpochs
from pipeline.stages.judge.epochs import time_in_use
from pipeline.stages.judge.judged import RIGHT, UNKNOWN, WRONG
from pipeline.stages.monitored import MonitoredSolution, monitor_solution
from pipeline.stages.prepare import PreparedRun, prepare
from pipeline.studies.plausibility.fit import clock_advice
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, runs_of
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.monitors import MONITORS, SCALES
from schemas.run import RunLog

# Epochs before the onset that the time in use is reckoned from: a negation in force there has no part in it.
_LEAD_S = 30.0
# DOMAIN section 5.3: the first wrong epoch of so much time is the failure.
_LASTING_S = 1.0


@frozen
class InjectedFault:
    """The fault as a fault file of `balise inject` would hold it, and what the train made of it."""

    fault: FaultSpec
    monitored: MonitoredSolution
    end_ns: int


def inject_fault(base: Baseline, onset: Onset) -> InjectedFault:
    """Put the fault in and replay. Raises `InputError` where the recording cannot take it there."""
    cell = onset.cell
    start_s = (onset.t_ns - base.recording.first_ns) / NS_PER_S
    fault = cell.spec(start_s, _drawn_satellite(base, onset) if cell.hits_satellite else None)
    end_ns = onset.t_ns + round(cell.watch_s * NS_PER_S)
    faulty = (
        _with_odometer_fault(base, fault, end_ns)
        if cell.hits_odometer
        else _with_gnss_fault(base, fault, onset.t_ns, end_ns)
    )
    # The monitor that compares two solutions needs both.
    named = (base.solution, base.config.monitors.channel_reference)
    matches = {name: faulty.match(name) for name in faulty.run.solutions() if name in named}
    return InjectedFault(fault, monitor_solution(faulty, base.solution, matches, base.evidence), end_ns)


def _drawn_satellite(base: Baseline, onset: Onset) -> str:
    """The satellite that an onset draws among those used; raises `InputError` where none is."""
    used = base.satellites_at(onset.t_ns)
    if not used:
        raise InputError("has no used satellite at the instant drawn", place=f"{onset.run_id}: satellites")
    return used[int(onset.lot * len(used))]


def _with_gnss_fault(base: Baseline, fault: FaultSpec, begin_ns: int, end_ns: int) -> PreparedRun:
    """Positions and ranges as cleaned, the fault added from its first epoch on; odometer and reads as they were."""
    run = base.monitored.prepared.run
    # A late position is one of before the fault.
    from_ns = base.recording.first_ns if fault.kind is FaultKind.LATENCY else begin_ns
    tail = run.with_streams(
        gnss=_rows_between(run.gnss, from_ns, end_ns), satellites=_cut_stream(run.satellites, begin_ns, end_ns)
    )
    hit = inject(tail, fault, base.site, base.recording)
    streams = {
        "gnss": pl.concat([_rows_before(run.gnss, begin_ns), _rows_between(hit.gnss, begin_ns, end_ns)]),
        "satellites": None if run.satellites is None else _replace_from(run.satellites, hit.satellites, begin_ns),
    }
    return replace(base.monitored.prepared, run=run.with_streams(**streams))


def _with_odometer_fault(base: Baseline, fault: FaultSpec, end_ns: int) -> PreparedRun:
    """All odometers with the fault; positions as recorded, to the end of the watch."""
    prepared = base.monitored.prepared
    first_ns = base.recording.first_ns
    hit = inject(base.run, fault, base.site, base.recording)
    cut = RunLog.with_streams(
        hit,
        gnss=_rows_between(hit.gnss, first_ns, end_ns),
        satellites=_cut_stream(hit.satellites, first_ns, end_ns),
        faults=None,
    )
    return prepare(cut, base.site, prepared.vehicle, prepared.config, clock_advice)


def _replace_from(recorded: pl.DataFrame, hit: pl.DataFrame | None, begin_ns: int) -> pl.DataFrame:
    """The recorded rows before an instant, and the faulty ones after it."""
    before = _rows_before(recorded, begin_ns)
    return before if hit is None else pl.concat([before, hit])


def _rows_before(frame: pl.DataFrame, begin_ns: int) -> pl.DataFrame:
    """Rows before an instant."""
    return frame.filter(pl.col("t") < instant(begin_ns))


def _rows_between(frame: pl.DataFrame, begin_ns: int, end_ns: int) -> pl.DataFrame:
    """Rows from one instant to another."""
    return frame.filter(pl.col("t").is_between(instant(begin_ns), instant(end_ns)))


def _cut_stream(frame: pl.DataFrame | None, begin_ns: int, end_ns: int) -> pl.DataFrame | None:
    """A stream from one instant to another, if it is there."""
    return None if frame is None else _rows_between(frame, begin_ns, end_ns)


@frozen
class Watch:
    """The epochs of an injected run from a little before the onset on, compared with those of the fault-free run.

    `moved_m`: by what the fault has moved the position in the direction of travel, NaN where not known; `code`:
    the judgement; `doubtful`: it may be wrong, and by the fault; `begin`: the first epoch of the fault.
    """

    epochs: MonitoredEpochs
    moved_m: Floats
    code: Ints
    doubtful: Bools
    begin: int

    @property
    def t_ns(self) -> Ints:
        """Times of the epochs [ns]."""
        return self.epochs.t_ns


def outcome_row(base: Baseline, onset: Onset, found: InjectedFault) -> Row:
    """The row of `schemas.experiment.Injections`, but for the bank."""
    watch = _watch_epochs(base, onset, found)
    after = watch.t_ns >= onset.t_ns
    alarm = watch.epochs.alarm & after
    noticed_ns = int(watch.t_ns[alarm.argmax()]) if alarm.any() else None
    failure_ns, may_ns = _first_failures(watch)
    use = time_in_use(watch.epochs, watch.code, base.config)
    in_use = use.in_use & after
    delays_ns = reactions_ns(watch.t_ns, watch.t_ns, base.config)
    stopped_from = np.inf if noticed_ns is None else noticed_ns + int(delays_ns[alarm.argmax()])
    unnoticed = after if noticed_ns is None else after & (watch.t_ns < noticed_ns)
    return {
        **_fault_columns(onset, found),
        **_place_columns(base, onset),
        "t_onset": onset.t_ns,
        "watched_s": (found.end_ns - onset.t_ns) / NS_PER_S,
        "noticed": noticed_ns is not None,
        "monitors": _failing_monitors(watch, int(alarm.argmax())) if noticed_ns is not None else [],
        "time_to_detect_s": _seconds_between(noticed_ns, onset.t_ns),
        "time_to_failure_s": _seconds_between(failure_ns, onset.t_ns),
        "time_to_failure_may_s": _seconds_between(may_ns, onset.t_ns),
        "time_since_failure_s": _seconds_between(noticed_ns, failure_ns),
        "time_since_failure_may_s": _seconds_between(noticed_ns, may_ns),
        "stopped": _is_stopped(watch, use.in_use, stopped_from) if noticed_ns is not None else None,
        "hazardous_s": float(use.wrong_s[after].sum()),
        "hazardous_may_s": float(use.used_s[after & (watch.code != RIGHT)].sum()),
        "unnoticed_m": _largest_movement_m(watch.moved_m, unnoticed),
        "in_use_m": _largest_movement_m(watch.moved_m, in_use),
        "tvb_lost_s": _tvb_lost_s(base, watch, onset, found.end_ns),
        **_acceptance_columns(base, onset, found),
    }


def _watch_epochs(base: Baseline, onset: Onset, found: InjectedFault) -> Watch:
    """The epochs of the injected run, compared with those of the fault-free one."""
    lead_ns = onset.t_ns - round(_LEAD_S * NS_PER_S)
    epochs = found.monitored.solution.epochs
    epochs = epochs.where(np.flatnonzero(epochs.t_ns >= lead_ns))
    t_ns = epochs.t_ns
    row = np.searchsorted(base.t_ns, t_ns).clip(max=base.t_ns.size - 1)
    same = base.t_ns[row] == t_ns
    moved_m, astray = _movement_by_fault_m(
        base, epochs.element_by(base.monitored.match.path.track.index), epochs.measure_m, row
    )
    moved_m = np.where(same, moved_m, np.nan)
    code = _judgement_codes(base, row, moved_m, astray & epochs.unambiguous)
    was_right = _judgement_codes(base, row, np.zeros(row.size), np.zeros(row.size, dtype=bool)) == RIGHT
    beyond = np.abs(moved_m) > base.config.hazards.limits.failure_m
    doubtful = (code == UNKNOWN) & np.isfinite(moved_m) & (was_right | beyond)
    return Watch(epochs, moved_m, code, doubtful, int(np.searchsorted(t_ns, onset.t_ns)))


def _judgement_codes(base: Baseline, row: Ints, moved_m: Floats, astray: Bools) -> Ints:
    """Judgement of positions at these rows of the fault-free run that the fault has moved; wrong where `astray`.

    The error is an interval: the position's own, by its evidence, and what the fault has added.
    """
    low_m, high_m = (own_m[row] + moved_m for own_m in base.own_errors_m)
    limit_m = base.config.hazards.limits.failure_m
    code = np.full(row.size, UNKNOWN)
    # Comparisons with NaN, an error not known, are false.
    code[(low_m >= -limit_m) & (high_m <= limit_m)] = RIGHT
    code[(low_m > limit_m) | (high_m < -limit_m) | astray] = WRONG
    return code


def _movement_by_fault_m(base: Baseline, number: Ints, measure_m: Floats, row: Ints) -> tuple[Floats, Bools]:
    """How much further along the fault-free run's path positions lie [m]; and where they lie off that path.

    `number`: of the net element, -1 for none; `row`: the epoch of the fault-free run.
    """
    path = base.monitored.match.path
    near_m = floats(base.epochs, "path_m")[row]
    leg = ints(base.epochs["leg"], 0)[row]
    at_m = np.full(number.size, np.nan)
    for index, route in enumerate(path.routes_by_leg(path.track.index)):
        rows = np.flatnonzero((leg == index) & (number >= 0) & np.isfinite(near_m))
        at_m[rows], _ = route.coordinates_of(number[rows], measure_m[rows], near_m[rows])
    sense = ints(base.epochs["direction"], 1)[row]
    return (at_m - near_m) * sense, (number >= 0) & np.isfinite(near_m) & ~np.isfinite(at_m)


def _first_failures(watch: Watch) -> tuple[int | None, int | None]:
    """The first wrong epoch of a second of them, else the first (DOMAIN section 5.3); and the first that may be.

    The latter: the first of the unbroken unknown or wrong epochs that lead there; where none is certainly wrong, the
    first doubtful one.
    """
    wrong = watch.code == WRONG
    wrong[: watch.begin] = False
    firsts, lasts = runs_of(wrong)
    if not firsts.size:
        doubtful = np.flatnonzero(watch.doubtful[watch.begin :])
        return None, int(watch.t_ns[watch.begin + doubtful[0]]) if doubtful.size else None
    lasting = watch.t_ns[lasts] - watch.t_ns[firsts] >= _LASTING_S * NS_PER_S
    first = int(firsts[lasting.argmax()])
    before = np.flatnonzero(watch.code[watch.begin : first] == RIGHT)
    may = watch.begin + int(before[-1]) + 1 if before.size else watch.begin
    return int(watch.t_ns[first]), int(watch.t_ns[may])


def _is_stopped(watch: Watch, in_use: Bools, from_ns: float) -> bool:
    """Whether no wrong position was in use any more after the reaction to the first alarm."""
    return not bool((in_use & (watch.code == WRONG) & (watch.t_ns > from_ns)).any())


def _failing_monitors(watch: Watch, epoch: int) -> list[str]:
    """Monitors that fail at an epoch."""
    return [name for name in MONITORS if watch.epochs.verdicts[name].fails[epoch]]


def _largest_movement_m(moved_m: Floats, where: Bools) -> float:
    """The largest movement at some epochs [m]."""
    return float(np.abs(moved_m[where & np.isfinite(moved_m)]).max(initial=0.0))


def _tvb_lost_s(base: Baseline, watch: Watch, onset: Onset, end_ns: int) -> float:
    """Time with a TVB in the fault-free run less that with the fault, over the watch [s]."""
    there = (base.t_ns >= onset.t_ns) & (base.t_ns <= end_ns) & flags(base.epochs, "tvb")
    had = set(base.t_ns[there].tolist())
    has = set(watch.t_ns[(watch.t_ns >= onset.t_ns) & watch.epochs.tvb].tolist())
    period_s = base.clock.period_s or 0.0
    return len(had - has) * period_s


def _acceptance_columns(base: Baseline, onset: Onset, found: InjectedFault) -> Row:
    """Balises accepted since the onset, and of them those whose position was wrong there, or may have been."""
    crossings = found.monitored.solution.crossings
    accepted = np.flatnonzero(crossings.accepted & (crossings.t_ns >= onset.t_ns))
    t_ns = crossings.t_ns[accepted]
    row = np.searchsorted(base.t_ns, t_ns).clip(max=base.t_ns.size - 1)
    train_m, sense = _fault_free_place(base, t_ns, row)
    index = base.monitored.match.path.track.index
    elements = [index.get(crossings.netelement_id[number], -1) for number in accepted.tolist()]
    at_m, astray = _movement_by_fault_m(base, np.array(elements, dtype=np.int64), crossings.measure_m[accepted], row)
    at_m = at_m * sense + floats(base.epochs, "path_m")[row]
    code = _judgement_codes(base, row, (at_m - train_m) * sense, astray)
    wrong = accepted[code == WRONG]
    return {
        "accepted": accepted.size,
        "accepted_wrong": wrong.size,
        "accepted_unknown": int((code == UNKNOWN).sum()),
        "accepted_wrong_ids": [crossings.balise_id[number] for number in wrong.tolist()],
    }


def _fault_free_place(base: Baseline, t_ns: Ints, row: Ints) -> tuple[Floats, Ints]:
    """Where the fault-free position was on its path at these times [m], and the direction of travel."""
    path_m = floats(base.epochs, "path_m")
    known = np.isfinite(path_m)
    at_m = np.interp(t_ns.astype(np.float64), base.t_ns[known].astype(np.float64), path_m[known])
    return at_m, ints(base.epochs["direction"], 1)[row]


def _fault_columns(onset: Onset, found: InjectedFault) -> Row:
    """Columns of which fault it was."""
    return {
        **onset.cell.labels,
        "injection_id": onset.number,
        "run_id": onset.run_id,
        "solution": found.monitored.solution.name,
        "target": found.fault.target,
        "duration_s": found.fault.duration_s,
        "start_s": found.fault.start_s,
    }


def _place_columns(base: Baseline, onset: Onset) -> Row:
    """The place and what the bank knew there, in the fault-free run."""
    epoch = base.epochs.row(int(np.searchsorted(base.t_ns, onset.t_ns)), named=True)
    fixes = base.monitored.solution.fixes
    satellites = fixes.filter(pl.col("t") == instant(onset.t_ns))["satellites"].to_list()
    kept = ("netelement_id", "measure_m", "path_m", "speed_mps", "curvature_per_m", "sigma_along_m")
    thresholds = {f"along_{scale}_threshold": epoch[f"along_{scale}_threshold"] for scale in SCALES}
    return {name: epoch[name] for name in kept} | {"satellites": satellites[0] if satellites else None} | thresholds


def _seconds_between(until_ns: int | None, since_ns: int | None) -> float | None:
    """Time from one instant to another [s]; None where either is not known."""
    return None if until_ns is None or since_ns is None else (until_ns - since_ns) / NS_PER_S
