"""The pseudorange monitor against generalised least squares, its own distribution, and known faults."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from datasets.constellation import GALILEO, GPS, visible_satellites
from pipeline.stages.epochs.verdicts import NO_POSITION
from pipeline.stages.monitors.pseudorange import (
    AMBIGUOUS,
    NO_RANGES,
    NO_RANGES_AT_EPOCH,
    TOO_FEW,
    clock_columns,
    line_of_sight_rows,
    pseudorange_monitor,
    range_variances_m2,
)
from schemas.config import Configuration, MonitorConfig
from schemas.stages import MatchedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.frames import verdict_table

T0 = datetime(2024, 3, 20, 6, 27, tzinfo=UTC)
HEADING_DEG, SLOPE, SURVEY_M = 35.0, 0.02, 0.7
SKY = visible_satellites(GPS + GALILEO, np.array([int(T0.timestamp()) * 1_000_000_000]), 50.85, 4.35)


def monitored(epochs, satellites, config):
    return verdict_table(pseudorange_monitor(arrays_of_table(MatchedEpochs, epochs), satellites, config))


def epochs_of(count: int, **columns: object) -> pl.DataFrame:
    frame = pl.DataFrame(
        {
            "t": [T0 + timedelta(seconds=k) for k in range(count)],
            "heading_deg": HEADING_DEG,
            "slope": SLOPE,
            "cross_track_m": 0.0,
            "vertical_m": 0.0,
            "survey_sigma_m": SURVEY_M,
            "interpolation_error_m": 0.0,
            "fix_valid": True,
            "on_track": True,
            "gate_probability": 1.0,
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    return frame.with_columns(**{name: pl.Series(name, value) for name, value in columns.items()})


def satellites_of(epochs: pl.DataFrame, residuals: np.ndarray, sky: pl.DataFrame = SKY) -> pl.DataFrame:
    """`residuals` (epochs, satellites)."""
    n = sky.height
    sigma = np.sqrt(range_variances_m2(sky["elevation_deg"].to_numpy()).sum(axis=-1))
    return pl.DataFrame(
        {
            "t": epochs["t"].gather(np.repeat(np.arange(epochs.height), n)),
            "solution": "primary",
            "sv": np.tile(sky["sv"].to_numpy(), epochs.height),
            "azimuth_deg": np.tile(sky["azimuth_deg"].to_numpy(), epochs.height),
            "elevation_deg": np.tile(sky["elevation_deg"].to_numpy(), epochs.height),
            "residual_m": residuals.ravel(),
            "sigma_m": np.tile(sigma, epochs.height),
            "used": True,
        }
    )


def chi2_at(tail: float, freedom: int) -> float:
    """Above it lies `tail` of a chi-square distribution."""
    from scipy.stats import chi2  # takes long to load, in each of the test processes

    return float(chi2.isf(tail, freedom))


def published(
    errors: np.ndarray, survey_m: np.ndarray, sky: pl.DataFrame = SKY
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A receiver's residuals, and its position left of and above the surveyed track, from range errors.

    `survey_m` (epochs, 2): where the surveyed track lies left of and above the true one.
    """
    rows = line_of_sight_rows(sky["azimuth_deg"].to_numpy(), sky["elevation_deg"].to_numpy())
    design = np.hstack([rows, clock_columns(sky["sv"].to_list())])
    weight = 1.0 / range_variances_m2(sky["elevation_deg"].to_numpy()).sum(axis=-1)
    gain = np.linalg.solve(design.T @ (weight[:, None] * design), design.T * weight)
    state = errors @ gain.T
    heading = np.radians(HEADING_DEG)
    left = np.array([-np.cos(heading), np.sin(heading), 0.0])
    horizontal = np.array([np.sin(heading), np.cos(heading), 0.0])
    cross = state[:, :3] @ left - survey_m[:, 0]
    # Height over the track is taken at the foot of the position, which lies on the slope.
    up = state[:, 2] - SLOPE * (state[:, :3] @ horizontal) - survey_m[:, 1]
    return errors - state @ design.T, cross, up


def test_value_is_the_generalised_least_squares_sum() -> None:
    """Survey error as covariance of the ranges, along and clocks eliminated: another way to the same number."""
    rng = np.random.default_rng(3)
    epochs = epochs_of(1, cross_track_m=[0.8], vertical_m=[-1.3])
    residual = rng.normal(0.0, 2.0, SKY.height)
    result = monitored(epochs, satellites_of(epochs, residual[None]), Configuration())
    rows = line_of_sight_rows(SKY["azimuth_deg"].to_numpy(), SKY["elevation_deg"].to_numpy())
    heading, rise = np.radians(HEADING_DEG), np.arctan(SLOPE)
    along = np.array([np.cos(rise) * np.sin(heading), np.cos(rise) * np.cos(heading), np.sin(rise)])
    left = np.array([-np.cos(heading), np.sin(heading), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    moved = residual + rows @ (0.8 * left - 1.3 * up)
    spread = np.outer(rows @ left, rows @ left) + np.outer(rows @ up, rows @ up)
    variances = range_variances_m2(SKY["elevation_deg"].to_numpy()).sum(axis=-1)
    covariance = np.diag(variances) + SURVEY_M**2 * spread
    free = np.column_stack([rows @ along, clock_columns(SKY["sv"].to_list())])
    inverse = np.linalg.inv(covariance)
    estimate = np.linalg.solve(free.T @ inverse @ free, free.T @ inverse @ moved)
    left_over = moved - free @ estimate
    assert result["value"][0] == pytest.approx(left_over @ inverse @ left_over, rel=1e-9)
    assert result["threshold"][0] == pytest.approx(chi2_at(1e-7, SKY.height - 3), rel=1e-9)


@pytest.mark.parametrize("heights", [True, False])
@pytest.mark.parametrize("systems", ["G", "GE"])
def test_healthy_ranges_are_chi_square_distributed(heights: bool, systems: str) -> None:
    """Whatever the receiver published, survey errors included; at 1e-2 so that 20 000 epochs can tell."""
    count = 20_000
    sky = SKY.filter(pl.col("sv").str.slice(0, 1).is_in(list(systems)))
    rng = np.random.default_rng(4)
    sigma = np.sqrt(range_variances_m2(sky["elevation_deg"].to_numpy()).sum(axis=-1))
    errors = rng.standard_normal((count, sky.height)) * sigma
    residual, cross, up = published(errors, rng.normal(0.0, SURVEY_M, (count, 2)), sky)
    epochs = epochs_of(count, cross_track_m=cross, vertical_m=up if heights else [None] * count)
    epochs = epochs.with_columns(pl.col("vertical_m").cast(pl.Float64))
    config = Configuration(monitors=MonitorConfig(false_alarm_probability=1e-2))
    result = monitored(epochs, satellites_of(epochs, residual, sky), config)
    freedom = sky.height - 1 - len(systems) - (not heights)
    assert result["value"].mean() == pytest.approx(freedom, rel=0.02)
    alarms = int((result["state"] == "fail").sum())
    # Five standard deviations of a binomial count of 200.
    assert abs(alarms - 200) < 5 * np.sqrt(200)


def test_a_range_ramp_is_found_before_its_position_failure() -> None:
    """0.01 m/s on G08 along with noise: found once the bias is some 10 m, hours before 20 m along the track."""
    rng = np.random.default_rng(5)
    count = 2000
    sigma = np.sqrt(range_variances_m2(SKY["elevation_deg"].to_numpy()).sum(axis=-1))
    errors = rng.standard_normal((count, SKY.height)) * sigma
    errors[:, SKY["sv"].to_list().index("G08")] += 0.01 * np.arange(count)
    residual, cross, up = published(errors, np.zeros((count, 2)))
    epochs = epochs_of(count, cross_track_m=cross, vertical_m=up)
    result = monitored(epochs, satellites_of(epochs, residual), Configuration())
    first = int(np.flatnonzero((result["state"] == "fail").to_numpy())[0])
    assert 300 < first < 1200
    assert (result["state"][-200:] == "fail").mean() > 0.8  # type: ignore[operator]


def test_each_gap_in_the_data_has_its_reason() -> None:
    epochs = epochs_of(
        6,
        fix_valid=[True, False, True, True, True, True],
        on_track=[True, False, True, True, True, True],
        gate_probability=[1.0, 1.0, 0.5, 1.0, 1.0, None],
    )
    satellites = satellites_of(epochs, np.zeros((6, SKY.height)))
    fourth, fifth = epochs["t"][3], epochs["t"][4]
    few = ["G08", "G13"]
    satellites = satellites.filter((pl.col("t") != fourth) & ((pl.col("t") != fifth) | pl.col("sv").is_in(few)))
    result = monitored(epochs, satellites, Configuration())
    assert result["state"].to_list() == ["pass"] + ["not_evaluated"] * 5
    assert result["reason"].to_list() == [None, NO_POSITION, AMBIGUOUS, NO_RANGES_AT_EPOCH, TOO_FEW, AMBIGUOUS]
    assert result["value"].null_count() == result["threshold"].null_count() == 5


def test_no_stream_is_no_health() -> None:
    epochs = epochs_of(2)
    for stream in (None, satellites_of(epochs, np.zeros((2, SKY.height))).clear()):
        result = monitored(epochs, stream, Configuration())
        assert result["reason"].to_list() == [NO_RANGES] * 2


def test_satellites_that_were_not_used_or_have_no_residual_are_left_out() -> None:
    epochs = epochs_of(1)
    residual = np.zeros((1, SKY.height))
    residual[0, :2] = 500.0
    satellites = satellites_of(epochs, residual).with_columns(
        used=pl.Series([False] + [True] * (SKY.height - 1)),
        residual_m=pl.Series([500.0, None] + [0.0] * (SKY.height - 2)),
    )
    result = monitored(epochs, satellites, Configuration())
    assert result["value"][0] == pytest.approx(0.0, abs=1e-9)
    assert result["threshold"][0] == pytest.approx(chi2_at(1e-7, SKY.height - 2 - 3), rel=1e-9)


def test_slower_residuals_and_unknown_sigmas() -> None:
    """Residuals at every fifth epoch, sigma from the elevation model: the same value there, no verdict between."""
    epochs = epochs_of(10)
    rng = np.random.default_rng(6)
    satellites = satellites_of(epochs, rng.normal(0, 1, (10, SKY.height)))
    slow = satellites.filter(pl.col("t").is_in(epochs["t"][::5].implode()))
    nameless = slow.with_columns(sigma_m=pl.lit(None, pl.Float64))
    full = monitored(epochs, satellites, Configuration())
    part = monitored(epochs, nameless, Configuration())
    assert part["state"].to_list() == (["pass"] + ["not_evaluated"] * 4) * 2
    assert part["value"][5] == pytest.approx(full["value"][5], rel=1e-12)


def test_stamps_may_differ_by_rounding_and_rows_come_in_any_order() -> None:
    epochs = epochs_of(4)
    rng = np.random.default_rng(7)
    satellites = satellites_of(epochs, rng.normal(0, 1, (4, SKY.height)))
    shifted = satellites.with_columns(pl.col("t") + pl.duration(nanoseconds=400_000)).sample(
        fraction=1.0, shuffle=True, seed=1
    )
    full = monitored(epochs, satellites, Configuration())
    again = monitored(epochs, shifted, Configuration())
    assert again["value"].to_list() == pytest.approx(full["value"].to_list(), rel=1e-9)


def test_an_epoch_of_few_satellites_is_judged_by_these_alone() -> None:
    """Beside an epoch that sees all of them, and by itself."""
    epochs, residuals = epochs_of(2), np.random.default_rng(4).normal(0.0, 2.0, (2, SKY.height))
    satellites = satellites_of(epochs, residuals)
    few = satellites.filter((pl.col("t") == epochs["t"][0]) | pl.col("sv").is_in(SKY["sv"].head(7).implode()))
    together = monitored(epochs, few, Configuration())
    alone = monitored(epochs.tail(1), few.filter(pl.col("t") == epochs["t"][1]), Configuration())
    assert together["value"][1] == pytest.approx(alone["value"][0], rel=1e-9)
    assert together["value"][0] != pytest.approx(together["value"][1], rel=1e-3)
