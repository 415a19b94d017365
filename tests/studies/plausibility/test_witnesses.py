"""What inspect, convert and trial say of each odometer: where it comes from, who says so, what it is good for."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.stages.clean.clean import clean
from pipeline.studies.plausibility.check import FitState
from pipeline.studies.plausibility.fit import ODOMETERS, fit_report
from pipeline.studies.plausibility.odometer import follows_checks
from schemas.config import Configuration, Vehicle
from schemas.enums import Origin
from schemas.run import RunLog
from tests.replay.journeys import journey
from tests.replay.test_origin import GNSS, MOTION, of_positions, said

CONFIG = Configuration()


def recorded() -> RunLog:
    return journey(gnss=GNSS, motion=MOTION)[0]


def origin_rows(run: RunLog, vehicle: Vehicle | None = None) -> list[tuple[str, ...]]:
    return fit_report(run, CONFIG, vehicle=vehicle).tables[ODOMETERS].rows()


@pytest.mark.parametrize(
    ("origin", "of_vehicle", "expected"),
    [
        (Origin.WHEEL, None, ("wheel", "the recording", "may prove")),
        (None, Origin.RADAR, ("radar", "the vehicle file", "may prove")),
        (Origin.GNSS, Origin.WHEEL, ("gnss", "the recording", "not independent")),
        (None, Origin.FUSED, ("fused", "the vehicle file", "not independent")),
        (None, None, ("unknown", "nobody", "`odometer_origin = ")),
    ],
)
def test_origin_declaration_and_use_of_an_odometer(origin, of_vehicle, expected) -> None:
    (row,) = origin_rows(said(recorded(), origin), Vehicle(odometer_origin=of_vehicle))
    assert row[:3] == ("primary", *expected[:2])
    assert expected[2] in row[3]


def test_each_sensor_has_its_line_and_the_vehicle_file_speaks_of_the_first() -> None:
    run = said(recorded(), None)
    assert run.odometer is not None
    both = pl.concat([run.odometer, run.odometer.with_columns(sensor=pl.lit("radar"))])
    rows = origin_rows(run.with_streams(odometer=both), Vehicle(odometer_origin=Origin.WHEEL))
    assert [row[:3] for row in rows] == [("primary", "wheel", "the vehicle file"), ("radar", "unknown", "nobody")]
    assert "vehicle file" not in rows[1][3]


def test_one_made_of_the_positions_is_named_whatever_it_was_declared_to_be() -> None:
    report = fit_report(said(of_positions(recorded()), Origin.WHEEL), CONFIG)
    assert "made of the positions" in report.tables[ODOMETERS]["what_it_is_good_for"][0]
    assert any("follow those of the positions" in line for line in report.lines())
    assert any("made of the positions" in line for line in report.of_odometers())
    # A declaration is nothing that a program writes by itself.
    assert not any("origin" in lines for lines in report.mending.values())


def test_the_fit_says_so_too() -> None:
    cleaned, _ = clean(of_positions(recorded()), CONFIG)
    (check,) = follows_checks(cleaned, "primary", CONFIG)
    assert (check.state, check.lines, check.of_evidence) == (FitState.MISFIT, "", False)
    own, _ = clean(recorded(), CONFIG)
    assert [check.state for check in follows_checks(own, "primary", CONFIG)] == [FitState.FITS]


def test_nothing_is_said_of_a_wheel_or_without_an_odometer() -> None:
    assert fit_report(said(recorded(), Origin.WHEEL), CONFIG).of_odometers() == []
    assert ODOMETERS not in fit_report(recorded().with_streams(odometer=None), CONFIG).tables
