"""An injected fault replayed in memory against `inject` and `replay` of the whole run from the start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment.recorded.baseline import Baseline, Onset, baseline_of, number_onsets, onsets_of, room_of
from datasets.experiment.recorded.outcome import InjectedFault, inject_fault, outcome_row
from datasets.experiment.recorded.plan import Bank, PlannedFault, RecordedPlan
from datasets.experiment.tables import Row
from datasets.faults import FaultKind
from datasets.inject import inject
from datasets.scenario import load_scenario
from datasets.trial import build_run, build_site
from pipeline import replay
from schemas.arrays import NS_PER_S, times_ns
from schemas.config import Configuration
from schemas.monitors import BANK_MONITORS
from schemas.run import RunTables
from tests.experiment.recorded.conftest import Journey

ROOT = Path(__file__).parents[3]
BLIND = Configuration.model_validate({"monitors": {"disabled": ["along_doppler", *BANK_MONITORS[1:]]}})


def _baseline(journey: Journey, config: Configuration) -> Baseline:
    return baseline_of(journey.run, journey.site, journey.vehicle, Bank("bank", config), "primary")


@pytest.fixture(scope="module")
def base(journey: Journey) -> Baseline:
    return _baseline(journey, Configuration())


def _drawn(base: Baseline, fault: PlannedFault, count: int) -> list[Onset]:
    plan = RecordedPlan(per_cell=count, faults=(fault,))
    room = room_of([base], plan.quiet_s)
    cells = plan.cells(20.0)
    return number_onsets(cells, onsets_of([room], cells, plan))


def _brute_force(journey: Journey, config: Configuration, found: InjectedFault) -> RunTables:
    return replay(inject(journey.run, found.fault, journey.site), journey.site, journey.vehicle, config)


def _first_alarm_s(tables: RunTables, onset: Onset, watched_s: float) -> float | None:
    epochs = tables.epochs.filter(solution="primary")
    since_s = (times_ns(epochs) - onset.t_ns) / NS_PER_S
    alarm = epochs["alarm"].to_numpy() & (since_s >= 0.0) & (since_s <= watched_s)
    return float(since_s[alarm.argmax()]) if alarm.any() else None


@pytest.mark.parametrize(
    "fault",
    [
        PlannedFault(kind=FaultKind.RAMP, rates_mps=(0.2,)),
        PlannedFault(kind=FaultKind.STEP, sizes_m=(3.0,)),
        PlannedFault(kind=FaultKind.SLIP, rates_mps=(0.5,), duration_s=20.0),
        PlannedFault(kind=FaultKind.OUTAGE, durations_s=(20.0,)),
        # Its first epochs hold positions of before the fault.
        PlannedFault(kind=FaultKind.LATENCY, latencies_s=(0.7,)),
    ],
    ids=lambda fault: fault.kind.value,
)
def test_detects_at_the_same_epoch_as_a_replay_from_the_start(
    journey: Journey, base: Baseline, fault: PlannedFault
) -> None:
    onsets = _drawn(base, fault, 1)
    assert onsets
    for onset in onsets:
        found = inject_fault(base, onset)
        row = outcome_row(base, onset, found)
        tables = _brute_force(journey, Configuration(), found)
        assert row["time_to_detect_s"] == _first_alarm_s(tables, onset, onset.cell.watch_s)


def test_a_ramp_in_one_range_follows_the_sky_as_in_a_replay_from_the_start() -> None:
    scenario = load_scenario(ROOT / "datasets/scenarios/satellites.toml")
    spec = scenario.runs[0]
    spec = spec.model_copy(update={"gnss": spec.gnss.model_copy(update={"rate_hz": 1.0})})
    scenario = scenario.model_copy(update={"runs": (spec,)})
    run = build_run(scenario, spec).with_streams(faults=None)
    assert scenario.vehicle is not None
    sky = Journey(run, build_site(scenario), scenario.vehicle)
    base = _baseline(sky, Configuration())
    fault = PlannedFault(kind=FaultKind.RAMP, target="satellite", rates_mps=(1.0,), both_ways=False)
    (onset,) = _drawn(base, fault, 1)
    found = inject_fault(base, onset)
    row = outcome_row(base, onset, found)
    assert row["target"] in base.satellites_at(onset.t_ns)
    assert row["time_to_detect_s"] == _first_alarm_s(_brute_force(sky, Configuration(), found), onset, 245.0)
    assert row["time_to_detect_s"] is not None


def test_hours_of_a_standing_alarm_do_not_dilute_its_rate(journey: Journey) -> None:
    base = _baseline(journey, Configuration.model_validate({"monitors": {"false_alarm_probability": 0.02}}))
    stands = base.epochs["alarm"].to_numpy() | base.epochs["negated"].to_numpy()
    standing_s = float(base.clock.held_s[stands].sum())
    assert base.alarms.height > 0
    assert standing_s > 30.0
    assert base.fault_free().hours * 3600.0 <= base.clock.duration_s - standing_s + 1.0


@pytest.fixture(scope="module")
def unnoticed(journey: Journey) -> tuple[Row, RunTables, Onset]:
    """A ramp that a bank without all but one monitor lets pass, watched to the very end of the run."""
    base = _baseline(journey, BLIND)
    end_ns = int(base.t_ns[-1])
    onset_ns = int(base.t_ns[np.searchsorted(base.t_ns, end_ns - 200 * NS_PER_S)])
    fault = PlannedFault(kind=FaultKind.RAMP, rates_mps=(0.25,), watch_s=(end_ns - onset_ns) / NS_PER_S)
    cell = RecordedPlan(faults=(fault,)).cells(20.0)[0]
    onset = Onset(0, cell, journey.run.run_id, onset_ns, 0.0)
    found = inject_fault(base, onset)
    return outcome_row(base, onset, found), _brute_force(journey, BLIND, found), onset


def test_fails_when_the_judge_says_so(unnoticed: tuple[Row, RunTables, Onset]) -> None:
    row, tables, onset = unnoticed
    hazard = tables.hazards.row(0, named=True)
    failed = pl.Series([hazard["t_failure"], hazard["t_failure_may"]]).dt.timestamp("ns").to_numpy()
    assert row["noticed"] is False
    assert row["time_to_failure_s"] == pytest.approx((failed[0] - onset.t_ns) / NS_PER_S, abs=1e-9)
    assert row["time_to_failure_may_s"] == pytest.approx((failed[1] - onset.t_ns) / NS_PER_S, abs=1e-9)


def test_counts_the_same_hazardous_time_and_balises_as_the_judge(unnoticed: tuple[Row, RunTables, Onset]) -> None:
    row, tables, _ = unnoticed
    assert row["hazardous_s"] > 30.0
    assert row["hazardous_s"] == pytest.approx(tables.runs["hazardous_s"][0], abs=1e-6)
    wrong = tables.passages.filter(status="accepted", judgement="wrong", kind="virtual")["balise_id"].to_list()
    assert wrong
    assert row["accepted_wrong_ids"] == wrong
    assert 20.0 < row["in_use_m"] <= 50.0
