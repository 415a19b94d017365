"""One fault put into a recorded run in memory, and the run replayed with it to the end of its watch."""

from __future__ import annotations

from dataclasses import replace

import polars as pl

from datasets.experiment.recorded.baseline import Baseline
from datasets.experiment.recorded.draw import Onset
from datasets.faults import FaultKind, FaultSpec
from datasets.inject import inject
from pipeline.stages.monitored import MonitoredSolution, monitor_solution
from pipeline.stages.prepare import PreparedRun, prepare
from pipeline.studies.plausibility.fit import clock_advice
from schemas.arrays import NS_PER_S
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog


@frozen
class Injected:
    """The fault as a fault file of `balise inject` would hold it, and what the train made of it."""

    fault: FaultSpec
    monitored: MonitoredSolution
    end_ns: int


def injected(base: Baseline, onset: Onset) -> Injected:
    """Put the fault in and replay. Raises `InputError` where the recording cannot take it there."""
    cell = onset.cell
    start_s = (onset.t_ns - base.recording.first_ns) / NS_PER_S
    fault = cell.spec(start_s, _satellite(base, onset) if cell.hits_satellite else None)
    end_ns = onset.t_ns + round(cell.watch_s * NS_PER_S)
    faulty = _odometer_hit(base, fault, end_ns) if cell.hits_odometer else _gnss_hit(base, fault, onset.t_ns, end_ns)
    # The monitor that compares two solutions needs both.
    named = (base.solution, base.config.monitors.channel_reference)
    matches = {name: faulty.match(name) for name in faulty.run.solutions() if name in named}
    return Injected(fault, monitor_solution(faulty, base.solution, matches, base.evidence), end_ns)


def _satellite(base: Baseline, onset: Onset) -> str:
    used = base.satellites_at(onset.t_ns)
    if not used:
        raise InputError("has no used satellite at the instant drawn", place=f"{onset.run_id}: satellites")
    return used[int(onset.lot * len(used))]


def _gnss_hit(base: Baseline, fault: FaultSpec, begin_ns: int, end_ns: int) -> PreparedRun:
    """Positions and ranges as cleaned, the fault added from its first epoch on; odometer and reads as they were."""
    run = base.monitored.prepared.run
    # A late position is one of before the fault.
    from_ns = base.recording.first_ns if fault.kind is FaultKind.LATENCY else begin_ns
    tail = run.with_streams(gnss=_between(run.gnss, from_ns, end_ns), satellites=_cut(run.satellites, begin_ns, end_ns))
    hit = inject(tail, fault, base.site, base.recording)
    streams = {
        "gnss": pl.concat([_before(run.gnss, begin_ns), _between(hit.gnss, begin_ns, end_ns)]),
        "satellites": None if run.satellites is None else _append_hit(run.satellites, hit.satellites, begin_ns),
    }
    return replace(base.monitored.prepared, run=run.with_streams(**streams))


def _odometer_hit(base: Baseline, fault: FaultSpec, end_ns: int) -> PreparedRun:
    """All odometers with the fault; positions as recorded, to the end of the watch."""
    prepared = base.monitored.prepared
    first_ns = base.recording.first_ns
    hit = inject(base.run, fault, base.site, base.recording)
    cut = RunLog.with_streams(
        hit, gnss=_between(hit.gnss, first_ns, end_ns), satellites=_cut(hit.satellites, first_ns, end_ns), faults=None
    )
    return prepare(cut, base.site, prepared.vehicle, prepared.config, clock_advice)


def _append_hit(recorded: pl.DataFrame, hit: pl.DataFrame | None, begin_ns: int) -> pl.DataFrame:
    before = _before(recorded, begin_ns)
    return before if hit is None else pl.concat([before, hit])


def _instant(t_ns: int) -> pl.Expr:
    return pl.lit(t_ns).cast(pl.Datetime("ns", "UTC"))


def _before(frame: pl.DataFrame, begin_ns: int) -> pl.DataFrame:
    return frame.filter(pl.col("t") < _instant(begin_ns))


def _between(frame: pl.DataFrame, begin_ns: int, end_ns: int) -> pl.DataFrame:
    return frame.filter(pl.col("t").is_between(_instant(begin_ns), _instant(end_ns)))


def _cut(frame: pl.DataFrame | None, begin_ns: int, end_ns: int) -> pl.DataFrame | None:
    return None if frame is None else _between(frame, begin_ns, end_ns)
