"""Where an odometer comes from: as its rows declare, then as the vehicle file does."""

import polars as pl
import pytest

from pipeline.stages.odometry import odometry_of
from schemas.config import Configuration, Vehicle
from schemas.enums import Origin
from tests.tables import NS


def rows(*origins: str | None, column: bool = True) -> pl.DataFrame:
    frame = pl.DataFrame(
        {
            "t": [second * NS for second in range(len(origins))],
            "distance_m": [10.0 * second for second in range(len(origins))],
            "speed_mps": [10.0] * len(origins),
            "sigma_speed_mps": [None] * len(origins),
            "slip": [None] * len(origins),
            "origin": list(origins),
        },
        schema_overrides={"sigma_speed_mps": pl.Float64, "slip": pl.Boolean, "origin": pl.Enum(Origin)},
    ).with_columns(t=pl.col("t").cast(pl.Datetime("ns", "UTC")))
    return frame if column else frame.drop("origin")


@pytest.mark.parametrize(
    ("origins", "of_vehicle", "expected", "independent"),
    [
        (["wheel"] * 3, None, Origin.WHEEL, True),
        (["radar"] * 3, None, Origin.RADAR, True),
        (["inertial"] * 3, None, Origin.INERTIAL, True),
        (["fused"] * 3, None, Origin.FUSED, False),
        ([None] * 3, None, Origin.UNKNOWN, False),
        (["unknown"] * 3, None, Origin.UNKNOWN, False),
        # The stream says it: the vehicle file does not.
        (["gnss"] * 3, Origin.WHEEL, Origin.GNSS, False),
        ([None] * 3, Origin.WHEEL, Origin.WHEEL, True),
        (["unknown"] * 3, Origin.RADAR, Origin.RADAR, True),
        # Rows of several origins prove what the least of them proves.
        (["wheel", None, "wheel"], None, Origin.UNKNOWN, False),
        (["wheel", "gnss", None], Origin.WHEEL, Origin.GNSS, False),
    ],
)
def test_the_stream_speaks_before_the_vehicle_file(origins, of_vehicle, expected, independent):
    odometry = odometry_of(rows(*origins), Vehicle(odometer_origin=of_vehicle), Configuration())
    assert odometry is not None
    assert (odometry.origin, odometry.independent) == (expected, independent)


def test_a_stream_without_the_column_is_of_unknown_origin():
    odometry = odometry_of(rows(None, None, None, column=False), Vehicle(), Configuration())
    assert odometry is not None
    assert odometry.origin is Origin.UNKNOWN
