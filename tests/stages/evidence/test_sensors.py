"""Several odometers of a train: one is the LDS's, all of them are evidence."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.clean.clean import clean
from schemas.config import Configuration, LdsConfig
from schemas.errors import InputError
from schemas.run import RunLog
from tests.stages.matching.builders import odometer, run


def two_sensors() -> RunLog:
    """A tachometer and a radar, rows by turns, the radar's stamps half a second late."""
    tacho = odometer(np.array([0.0, 10.0, 20.0, 30.0])).with_columns(sensor=pl.lit("tacho"))
    late = (pl.col("t") + pl.duration(milliseconds=500)).dt.cast_time_unit("ns")
    radar = odometer(np.array([0.0, 11.0, 22.0])).with_columns(late, sensor=pl.lit("radar"))
    both = pl.concat([tacho, radar]).sort("t")
    return RunLog("two", run(np.array([0.0, 10.0, 20.0, 30.0]), np.zeros(4)), odometer=both)


def using(sensor: str) -> Configuration:
    return Configuration(lds=LdsConfig(odometer_sensor=sensor))


def test_the_lds_uses_the_sensor_that_is_named_and_the_others_stay_apart() -> None:
    for used, other in (("tacho", "radar"), ("radar", "tacho")):
        cleaned, _ = clean(two_sensors(), using(used))
        assert cleaned.odometer is not None
        assert cleaned.odometer["sensor"].unique().to_list() == [used]
        assert [frame["sensor"].unique().to_list() for frame in cleaned.other_odometers] == [[other]]
        again, _ = clean(cleaned, using(used))
        assert len(again.other_odometers) == 1


def test_stamps_of_two_sensors_are_neither_double_nor_late() -> None:
    log = two_sensors()
    assert log.odometer is not None
    apart = log.with_streams(odometer=log.odometer.sort("sensor", "t"))
    _, counts = clean(apart, using("tacho"))
    assert (counts.streams["odometer"].duplicates, counts.streams["odometer"].out_of_order) == (0, 0)


def test_a_sensor_that_was_not_recorded_is_one_clear_error() -> None:
    with pytest.raises(InputError, match=r"column sensor.*radar, tacho.*primary.*odometer_sensor"):
        clean(two_sensors(), Configuration())
