"""What passes between the stages of a run is what `schemas.stages` says."""

from __future__ import annotations

import pytest

from pipeline.stages.alignment.align import align
from pipeline.stages.matching import match
from pipeline.stages.odometry import odometry_of
from schemas.config import Configuration, Vehicle
from schemas.stages import Aligned, Positions
from tests.replay.journeys import VEHICLE, journey

CONFIG = Configuration()


def stages(vehicle, with_odometer):
    """A run with a stretch off the track and one without a fix."""
    faults = (
        {"kind": "step", "size_m": 850.0, "start_s": 150.0, "duration_s": 6.0},
        {"kind": "outage", "start_s": 60.0, "duration_s": 5.0},
    )
    run, site = journey(*faults)
    odometry = odometry_of(run.odometer if with_odometer else None, vehicle, CONFIG)
    found = match(run.gnss, odometry, site, vehicle, CONFIG.matching, CONFIG.fix_sigma)
    oriented = None if odometry is None else odometry.oriented(found.odometer_sign)
    return found.epochs, align(found.epochs, oriented, vehicle, CONFIG)


@pytest.mark.parametrize("vehicle", [VEHICLE, Vehicle()], ids=["file", "learned"])
@pytest.mark.parametrize("with_odometer", [True, False])
def test_stages_hand_on_the_columns_of_their_schema(vehicle, with_odometer):
    for frame, schema in zip(stages(vehicle, with_odometer), (Positions, Aligned), strict=True):
        assert set(frame.columns) == set(schema.column_names())
        schema.validate(frame)


def test_every_column_between_stages_tells_its_meaning_and_unit():
    for name, column in Aligned.columns().items():
        assert column.description, name
        assert not type(column).__name__.startswith("Float") or column.metadata["unit"], name
