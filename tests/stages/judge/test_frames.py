"""What the judge hands on has the columns that `schemas.stages` names."""

from __future__ import annotations

from pipeline.one_run import monitor_alone
from pipeline.stages.judge.judge import judge
from pipeline.stages.judge.judgement import JudgeInput
from schemas.config import Configuration
from schemas.conform import dtypes
from schemas.stages import JudgedEpochs, JudgedOffers
from tests.replay.journeys import VEHICLE, journey


def test_judged_epochs_and_offers_have_their_columns() -> None:
    """Epochs keep the columns of the stages before the judge too."""
    run, site = journey()
    ride = monitor_alone(run, site, VEHICLE, Configuration(), "primary")
    prepared = ride.prepared
    given = JudgeInput(
        ride.solution, prepared.evidence(), ride.odometry, prepared.vehicle, prepared.config, run.reference
    )
    judged = judge(given)
    expected = dtypes(JudgedEpochs)
    assert dict(judged.epochs.select(list(expected)).schema) == expected
    assert judged.offers.height > 0
    assert dict(judged.offers.schema) == dtypes(JudgedOffers)
