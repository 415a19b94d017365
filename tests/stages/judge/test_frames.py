"""What the judge hands on are arrays of the kind and length that its classes declare."""

from __future__ import annotations

from typing import Any

from pipeline.one_run import monitor_alone
from pipeline.stages.judge.judge import judge
from pipeline.stages.judge.judgement import JudgeInput
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.tables import Epochs
from tests.replay.journeys import VEHICLE, journey
from tests.schemas.test_stages import KINDS, annotations_of

# What `one_run` adds to the judged epochs.
_ADDED = {"satellites", "suspect_after_the_fact", "step_s", "gap", "moving_s", "lost_s", "lost_to"}


def columns_of(one: Any) -> dict[str, str]:
    return {name: kind for name, kind in annotations_of(type(one)).items() if kind in KINDS}


def test_epochs_crossings_and_offers_have_one_length_and_the_kinds_that_they_declare() -> None:
    run, site = journey()
    monitored = monitor_alone(run, site, VEHICLE, Configuration(), "primary")
    prepared = monitored.prepared
    given = JudgeInput(
        monitored.solution, prepared.evidence(), monitored.odometry, prepared.vehicle, prepared.config, run.reference
    )
    judged = judge(given)
    crossings = monitored.lds.crossings
    assert judged.offers.size > 0
    for one, size in (
        (judged.epochs, run.gnss.height),
        (judged.epochs.judgements, run.gnss.height),
        (monitored.lds.epochs, run.gnss.height),
        (crossings, crossings.size),
        (judged.offers, judged.offers.size),
        (judged.offers.judged, judged.offers.size),
    ):
        assert columns_of(one)
        for name, kind in columns_of(one).items():
            values = getattr(one, name)
            assert (values.shape, values.dtype) == ((size,), KINDS[kind]), name


def test_judged_epochs_hold_every_column_of_the_table_but_those_of_lost_time_and_studies() -> None:
    run, site = journey()
    monitored = monitor_alone(run, site, VEHICLE, Configuration(), "primary")
    prepared = monitored.prepared
    given = JudgeInput(monitored.solution, prepared.evidence(), monitored.odometry, prepared.vehicle, prepared.config)
    table = judge(given).epochs.table
    missing = dtypes(Epochs).keys() - set(table.columns) - _ADDED
    assert {name for name in missing if not name.startswith("undetected_")} == set()
