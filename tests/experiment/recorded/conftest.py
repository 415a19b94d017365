"""One recorded journey without faults, at 2 Hz so that replays are short."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site
from schemas.config import Vehicle
from schemas.run import RunLog, Site


@dataclass(frozen=True)
class Journey:
    run: RunLog
    site: Site
    vehicle: Vehicle


@pytest.fixture(scope="package")
def journey() -> Journey:
    scenario = demo_scenario()
    clean = scenario.runs[0]
    assert clean.odometer
    slow = clean.model_copy(
        update={
            "gnss": clean.gnss.model_copy(update={"rate_hz": 2.0}),
            "odometer": clean.odometer.model_copy(update={"rate_hz": 5.0}),
        }
    )
    scenario = scenario.model_copy(update={"runs": (slow,)})
    run = build_run(scenario, slow).with_streams(faults=None)
    assert scenario.vehicle is not None
    return Journey(run, build_site(scenario), scenario.vehicle)
