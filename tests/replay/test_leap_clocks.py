"""A clock that is off by whole leap seconds makes nothing unsafe by itself, and nothing safe."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.one_run import replay
from pipeline.stages.evidence import EvidenceSet, unite
from pipeline.stages.evidence.evidence import Alternative
from schemas.config import Configuration, Vehicle
from schemas.run import RunLog
from tests.replay.journeys import journey

WARN = Configuration.model_validate({"ingest": {"plausibility": "warn"}})
STREAMS = {
    "reference": {"odometer": None, "balise_reads": None},
    "odometer and reference": {"balise_reads": None},
    "odometer and reads": {"reference": None},
}


def _shifted(run: RunLog, leap_s: float) -> RunLog:
    """The positions with stamps that are later by so much."""
    return run.with_streams(gnss=run.gnss.with_columns(pl.col("t") + pl.duration(milliseconds=round(1000 * leap_s))))


@pytest.mark.parametrize("kept", STREAMS)
@pytest.mark.parametrize("leap_s", [-3, 2, 17, 18])
def test_a_clock_off_by_leap_seconds_is_unproven_and_said(kept: str, leap_s: int) -> None:
    run, site = journey()
    (row,) = replay(_shifted(run, leap_s).with_streams(**STREAMS[kept]), site, Vehicle(), WARN).runs.to_dicts()
    assert row["verdict"] == "unproven"
    assert "input_doubtful" in row["reasons"]
    assert "leap second" in row["notes"] or "GPS time" in row["notes"]


@pytest.mark.parametrize("leap_s", [-2, 18])
def test_the_clock_of_an_odometer_alone_is_no_doubt_of_the_positions(leap_s: int) -> None:
    run, site = journey()
    assert run.odometer is not None
    late = run.with_streams(odometer=run.odometer.with_columns(pl.col("t") + pl.duration(seconds=leap_s)))
    (row,) = replay(late, site, Vehicle(), WARN).runs.to_dicts()
    assert row["verdict"] != "unsafe"
    assert "input_doubtful" not in row["reasons"]


@pytest.mark.parametrize("lag_s", [1.0, 1.5])
def test_a_lag_that_no_leap_second_makes_stays_a_failure(lag_s: float) -> None:
    """One second is the age of positions as often as a leap second."""
    run, site = journey()
    late = _shifted(run, lag_s).with_streams(odometer=None, balise_reads=None)
    (row,) = replay(late, site, Vehicle(), WARN).runs.to_dicts()
    assert row["verdict"] == "unsafe"


def test_a_failure_by_either_clock_stays_one() -> None:
    """200 m ahead for a minute: two seconds at 30 m/s do not explain it."""
    run, site = journey({"kind": "step", "size_m": 200.0, "start_s": 140.0, "duration_s": 60.0})
    by_reference = _shifted(run, 2).with_streams(odometer=None, balise_reads=None)
    (row,) = replay(by_reference, site, Vehicle(), WARN).runs.to_dicts()
    assert row["verdict"] == "unsafe"


def test_of_two_clocks_everything_that_either_leaves_stays_possible() -> None:
    """Worked by hand over three instants: both speak, one is silent, both speak and one proves nothing."""
    first = EvidenceSet(
        kind=np.array([0, 0, 1]),
        alternatives=(Alternative(np.arange(3), None, np.zeros(3), np.ones(3)),),  # type: ignore[arg-type]
        proves=np.array([True, True, True]),
        on_survey=np.array([True, True, True]),
    )
    second = EvidenceSet(
        kind=np.array([1, -1, 1]),
        alternatives=(Alternative(np.array([0, 2]), None, np.full(2, 60.0), np.full(2, 61.0)),),  # type: ignore[arg-type]
        proves=np.array([True, False, False]),
        on_survey=np.array([True, False, True]),
    )
    both = unite([first, second])
    assert both.kind.tolist() == [1, -1, 1]
    assert [there.rows.tolist() for there in both.alternatives] == [[0, 2], [0, 2]]
    assert both.proves.tolist() == [True, False, False]
    assert both.on_survey.tolist() == [True, False, True]
    assert unite([first]) is first
