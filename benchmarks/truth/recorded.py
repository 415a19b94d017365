"""Faults put into a recorded hour at 10 Hz: what 2,000 of them take on two cores, and whether T_D is exact.

The hour is synthetic: straight and curved line, 33 m/s, a balise about every two kilometres, with vehicle file. T_D is
held against `inject` and `replay` of the whole run from its start.

python -m benchmarks recorded
"""

from __future__ import annotations

import time
from pathlib import Path

from benchmarks.results import Figure, stopwatch
from benchmarks.trials import line_scenario
from datasets.experiment.recorded.baseline import Baseline, Onset, baseline_of, number_onsets, onsets_of, room_of
from datasets.experiment.recorded.command import recorded_experiment
from datasets.experiment.recorded.outcome import inject_fault, outcome_row
from datasets.experiment.recorded.plan import Bank, PlannedFault, RecordedPlan, load_plan
from datasets.faults import FaultKind, FaultSpec
from datasets.inject import inject
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline.one_run import replay
from schemas.arrays import NS_PER_S, flags, times_ns
from schemas.config import Configuration, Vehicle, to_toml

INJECTIONS = 2000
COMPARED = 100
_TARGET_S = 600.0
_TARGET_EACH_S = 0.6
_SAMPLE_PER_CELL = 3


def measure(folder: Path) -> list[Figure]:
    """The whole experiment, the processor time of one injection, and T_D against a replay from the start."""
    scenario = line_scenario(hours=1.0, balises=60, seed=11)
    assert scenario.vehicle is not None
    run = build_run(scenario, scenario.runs[0]).with_streams(faults=None)
    site = build_site(scenario)
    write_site(site, folder / "site")
    write_run_log(run, folder / "runs")
    (folder / "vehicle.toml").write_text(to_toml(scenario.vehicle))
    base = baseline_of(run, site, scenario.vehicle, Bank("bank", Configuration()), "primary")
    return [*_processor_time(base), *_compared(scenario), *_whole(folder, base)]


def _processor_time(base: Baseline) -> list[Figure]:
    onsets = _drawn(base, load_plan(None).model_copy(update={"per_cell": _SAMPLE_PER_CELL}))
    begun = time.process_time()
    for onset in onsets:
        outcome_row(base, onset, inject_fault(base, onset))
    each_s = (time.process_time() - begun) / len(onsets)
    return [Figure("processor time of an injection", each_s, "s", target=_TARGET_EACH_S)]


def _compared(scenario: Scenario) -> list[Figure]:
    """One ramp at a hundred instants, at 1 Hz."""
    spec = scenario.runs[0]
    slow = spec.model_copy(update={"gnss": spec.gnss.model_copy(update={"rate_hz": 1.0})})
    scenario = scenario.model_copy(update={"runs": (slow,)})
    run = build_run(scenario, slow).with_streams(faults=None)
    vehicle = scenario.vehicle or Vehicle()
    config = Configuration()
    site = build_site(scenario)
    base = baseline_of(run, site, vehicle, Bank("bank", config), "primary")
    fault = PlannedFault(kind=FaultKind.RAMP, rates_mps=(0.05,), both_ways=False)
    onsets = _drawn(base, RecordedPlan(per_cell=COMPARED, apart_s=5.0, faults=(fault,)))

    def from_the_start(onset: Onset, hit: FaultSpec) -> float | None:
        epochs = replay(inject(run, hit, site), site, vehicle, config).epochs
        since_s = (times_ns(epochs) - onset.t_ns) / NS_PER_S
        alarm = flags(epochs, "alarm") & (since_s >= 0.0) & (since_s <= onset.cell.watch_s)
        return float(since_s[alarm.argmax()]) if alarm.any() else None

    differing = 0
    for onset in onsets:
        found = inject_fault(base, onset)
        differing += outcome_row(base, onset, found)["time_to_detect_s"] != from_the_start(onset, found.fault)
    name = f"T_D that differ from a replay from the start, of {len(onsets)}"
    return [Figure(name, differing, "injections", target=0)]


def _drawn(base: Baseline, plan: RecordedPlan) -> list[Onset]:
    room = room_of([base], plan.quiet_s)
    cells = [cell for cell in plan.cells(base.config.hazards.failure_limit_m) if room.takes_cell(cell)]
    return number_onsets(cells, onsets_of([room], cells, plan))


def _whole(folder: Path, base: Baseline) -> list[Figure]:
    cells = len({onset.cell.name for onset in _drawn(base, load_plan(None).model_copy(update={"per_cell": 1}))})
    runs = [str(folder / "runs")]
    per_cell = -(-INJECTIONS // cells)
    with stopwatch() as watch:
        made = recorded_experiment(
            *(runs, str(folder / "site"), folder / "out", None, folder / "vehicle.toml"),
            *(Configuration(), None, per_cell, "primary", 2),
        )
    count = made.tables["injections"].height
    return [
        Figure("injections", count, "injections"),
        Figure("all of them, two cores", watch.seconds, "s", target=_TARGET_S),
    ]
