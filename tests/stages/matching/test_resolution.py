"""The step of recorded coordinates, from known digits."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.matching import match
from pipeline.stages.matching.epochs import RecordedDigits, TrackShape, coordinate_step_m, digit_deviations_m
from schemas.config import FixSigma, MatchingConfig, Vehicle
from tests.replay.journeys import VEHICLE, hides_no_fault, journey, replay
from tests.stages.matching.builders import line, run, site

_PER_DEG_M = np.radians(1.0) * 6_371_000.0
LEAST_M = 0.02
STRAIGHT = site({"a": line((0.0, 0.0), (1000.0, 0.0))})


def latitudes(seed=0, count=4000):
    """A train that gathers and loses speed northwards, with the noise of a receiver."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(count)
    chainage_m = 20.0 * t + 100.0 * np.sin(t / 30.0) + rng.normal(0.0, 0.05, count).cumsum() * 0.1
    return 50.8 + chainage_m / _PER_DEG_M


@pytest.mark.parametrize("step_deg", [1e-6, 1e-5, 1.0 / 600_000.0, 1.0 / 60_000.0, 2.0**-18])
@pytest.mark.parametrize("seed", range(3))
def test_the_step_of_decimals_minutes_and_single_precision(seed, step_deg):
    written = np.round(latitudes(seed) / step_deg) * step_deg
    assert coordinate_step_m(written, _PER_DEG_M, LEAST_M) == pytest.approx(step_deg * _PER_DEG_M, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_digits_enough_or_no_digits_are_no_step(seed):
    values = latitudes(seed)
    assert coordinate_step_m(values, _PER_DEG_M, LEAST_M) == 0.0
    assert coordinate_step_m(np.round(values, 7), _PER_DEG_M, LEAST_M) == 0.0
    assert coordinate_step_m(np.full(100, 50.8), _PER_DEG_M, LEAST_M) == 0.0
    assert coordinate_step_m(np.round(values[:6], 5), _PER_DEG_M, LEAST_M) == 0.0
    assert coordinate_step_m(50.8 + 1e-4 * np.arange(100), _PER_DEG_M, LEAST_M) == 0.0
    one_off = np.round(values, 5)
    one_off[2000] += 0.3e-5
    assert coordinate_step_m(one_off, _PER_DEG_M, LEAST_M) == 0.0


def test_the_finest_step_that_counts_is_a_setting():
    """Seven decimals of a degree are 11 mm; positions of a run show it under the deviation of a uniform error."""
    written = np.round(latitudes(), 7)
    assert coordinate_step_m(written, _PER_DEG_M, 0.011) == pytest.approx(0.01112, abs=1e-5)
    assert coordinate_step_m(written, _PER_DEG_M, 0.012) == 0.0
    x_m = np.cumsum(2.0 + np.sin(np.arange(400) / 9.0))
    fixes = run(x_m, np.zeros(400)).with_columns(pl.col("longitude_deg").round(7))
    sigmas_m = [
        match(fixes, None, STRAIGHT, Vehicle(), MatchingConfig(), FixSigma(digits_least_m=least_m)).epochs.table[
            "digits_along_m"
        ][-1]
        for least_m in (0.02, 0.001)
    ]
    assert sigmas_m[0] == 0.0
    assert 0.001 < sigmas_m[1] < 0.011 / np.sqrt(12.0)


def turned_m(fixes, heading_deg):
    shape = TrackShape(heading_deg, *(np.zeros(heading_deg.size) for _ in range(4)))
    return RecordedDigits("primary", *digit_deviations_m(fixes, LEAST_M)).along_cross_up_m(shape)


def test_noise_is_turned_into_the_track():
    values = latitudes()
    fixes = pl.DataFrame(
        {"latitude_deg": np.round(values, 5), "longitude_deg": values - 46.0, "height_m": values // 0.5}
    )
    heading = np.where(np.arange(values.size) < 10, 0.0, np.where(np.arange(values.size) < 20, 90.0, 60.0))
    along, cross, up = turned_m(fixes, heading)
    north = 1e-5 * _PER_DEG_M / np.sqrt(12.0)
    for row, (a, c) in {0: (1.0, 0.0), 15: (0.0, 1.0), 30: (0.5, np.sqrt(0.75))}.items():
        assert along[row] == pytest.approx(a * north, rel=1e-3, abs=1e-12)
        assert cross[row] == pytest.approx(c * north, rel=1e-3, abs=1e-12)
    assert (up == 0.0).all()
    metres = fixes.with_columns(height_m=pl.Series(np.round(100.0 + 5.0 * np.sin(np.arange(values.size) / 20.0))))
    up = turned_m(metres, heading)[2]
    assert up == pytest.approx(np.full(values.size, 1.0 / np.sqrt(12.0)))


@pytest.mark.parametrize("decimals", [6, 5])
def test_coarse_positions_raise_no_alarm_and_hide_no_leap(decimals):
    def coarse(run):
        columns = [pl.col(name).round(decimals) for name in ("latitude_deg", "longitude_deg")]
        return run.with_streams(gnss=run.gnss.with_columns(*columns))

    run, site = journey()
    healthy = replay(coarse(run), site, VEHICLE)
    assert healthy.runs["alarms"].item() == 0
    assert healthy.passages["status"].unique().to_list() == ["accepted"]
    hides_no_fault(coarse)
