"""The ramp that the published bank misses, in a run that the program replays: found before it becomes a failure."""

from datetime import timedelta

import polars as pl
import pytest

from datasets.experiment.catalogue import JOURNEYS, JourneyPlan, prepare_journey, with_fault
from datasets.experiment.catalogue_faults import CatalogueFault
from pipeline.one_run import replay
from schemas.config import Configuration
from schemas.run import RunLog


def ramp_of(satellite: str) -> CatalogueFault:
    return CatalogueFault(
        "ramp", 0.01, "m/s", ({"kind": "ramp", "target": satellite, "start_s": 0.0, "rate_mps": 0.01},)
    )


def recorded_every(run: RunLog, period_s: int) -> RunLog:
    assert run.satellites is not None
    second = pl.col("t").dt.timestamp("ms") // 1000
    return run.with_streams(satellites=run.satellites.filter(second % period_s == 0))


# Satellites whose ranges move the position of the solution along the line, for as long as it takes to fail.
GPS = ("primary", "G16", JOURNEYS["long"])
DUAL = ("dual", "E18", JourneyPlan(7_000.0, 500.0, start="2024-03-20T07:21:40Z", heading_deg=12.0))


@pytest.mark.parametrize(("solution", "satellite", "plan", "period_s"), [(*GPS, 1), (*DUAL, 30)])
def test_a_range_ramp_of_1_cm_per_second_is_found_before_the_failure(
    solution: str, satellite: str, plan: JourneyPlan, period_s: int
) -> None:
    prepared = prepare_journey(plan, 11, 1.0)
    run, site = with_fault(prepared, ramp_of(satellite))
    other = {"primary": "dual", "dual": "primary"}[solution]
    run = run.with_streams(gnss=run.gnss.filter(pl.col("solution") != other))
    tables = replay(recorded_every(run, period_s), site, prepared.vehicle, Configuration())
    hazard = tables.hazards.row(0, named=True)
    assert hazard["detected"]
    assert hazard["t_failure"] is not None
    assert hazard["t_negated"] < hazard["t_failure"] - timedelta(seconds=600)
    first = tables.epochs.filter(pl.col("pseudorange_state") == "fail")["t"][0]
    assert timedelta(0) < first - hazard["t_onset"] < timedelta(seconds=2_400)
    evaluated = tables.epochs.filter(pl.col("pseudorange_state") != "not_evaluated").height
    # The ramp moves the position across too: where that refutes the track, the ranges are not tested on it, until a
    # movement has led back (40 % of the time, long after the failure was found).
    assert 0.55 < evaluated * period_s / tables.epochs.height < 1.1
