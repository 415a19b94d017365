"""An odometer made of the positions is found by their noise in its steps; none that is free of them is accused."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.follows import COPIES, INDEPENDENT, RECEIVERS, odometer_frame, stamps, tried
from pipeline.stages.follows import NOT_TESTED, Follows, follows_positions
from schemas.config import Configuration, EvidenceConfig

CONFIG = Configuration()
LATITUDE_M = 111_111.0
Floats = np.ndarray


def fixes(t_s: Floats, north_m: Floats, east_m: Floats, up_m: Floats | None = None) -> pl.DataFrame:
    columns = {
        "latitude_deg": north_m / LATITUDE_M,
        "longitude_deg": 14.0 + east_m / LATITUDE_M,
        "height_m": pl.Series([None] * t_s.size, dtype=pl.Float64) if up_m is None else up_m,
    }
    frame = pl.DataFrame({"t": stamps(t_s), **columns, "fix": ["sbas"] * t_s.size})
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def straight(seed: int, length_s: float = 900.0, rate_hz: float = 5.0) -> tuple[Floats, Floats, Floats, Floats]:
    """Times, true way at 20 m/s and more by turns, and what positions are off north and east: a walk of 0.1 m/s."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, length_s, 1.0 / rate_hz)
    travelled_m = 20.0 * t_s + 40.0 * np.sin(t_s / 15.0)
    off_m = 0.1 * np.cumsum(rng.standard_normal((2, t_s.size)), axis=1)
    return t_s, travelled_m, off_m[0], off_m[1]


@pytest.mark.parametrize("receiver", RECEIVERS)
@pytest.mark.parametrize("kind", INDEPENDENT)
def test_no_independent_odometer_is_accused(receiver: str, kind: str) -> None:
    found = [tried(seed, receiver, kind, minutes=8.0) for seed in range(3)]
    assert not any(one.found(CONFIG.evidence) for one in found)
    assert all(one.ratio is None or one.ratio > 0.35 for one in found)


@pytest.mark.parametrize("kind", COPIES)
def test_differences_and_chainage_of_positions_are_found(kind: str) -> None:
    found = [one for seed in range(12) if (one := tried(seed, "sbas", kind, minutes=12.0)).ratio is not None]
    assert len(found) >= 9
    assert sum(one.found(CONFIG.evidence) for one in found) >= len(found) - 1


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("late", [0, 3])
def test_a_counter_of_the_positions_either_way_and_late(sign: float, late: int) -> None:
    t_s, travelled_m, north_m, east_m = straight(1)
    copied_m = np.roll(travelled_m + north_m, late)[late:]
    counter = odometer_frame(t_s[late:], sign * copied_m, None)
    found = follows_positions(counter, fixes(t_s, travelled_m + north_m, east_m), CONFIG)
    assert found.ratio is not None
    assert found.ratio < 0.05


def test_the_same_way_counted_by_a_wheel() -> None:
    t_s, travelled_m, north_m, east_m = straight(2)
    counter = odometer_frame(t_s, np.floor(travelled_m / 0.1) * 0.1, None)
    found = follows_positions(counter, fixes(t_s, travelled_m + north_m, east_m), CONFIG)
    assert found.ratio is not None
    assert found.ratio > 0.8


def test_a_copy_of_what_is_better_than_the_odometers_own_noise_shows_nothing() -> None:
    """Positions to 2 mm, and what was made of them written in metres: the declaration alone stands."""
    t_s, travelled_m, north_m, east_m = straight(3)
    counter = odometer_frame(t_s, np.round(travelled_m + 0.02 * north_m), None)
    found = follows_positions(counter, fixes(t_s, travelled_m + 0.02 * north_m, 0.02 * east_m), CONFIG)
    assert found.ratio is not None
    assert found.ratio > 1.0


def test_too_few_steps_and_no_common_time() -> None:
    t_s, travelled_m, north_m, east_m = straight(4, length_s=70.0)
    counter = odometer_frame(t_s, travelled_m + north_m, None)
    placed = fixes(t_s, travelled_m + north_m, east_m)
    assert follows_positions(counter, placed, CONFIG).ratio is None
    later = odometer_frame(t_s + 1000.0, travelled_m, None)
    assert follows_positions(later, placed, CONFIG) == NOT_TESTED
    assert follows_positions(counter.head(0), placed, CONFIG) == NOT_TESTED
    few = Configuration(evidence=EvidenceConfig(follows_steps_least=200))
    assert follows_positions(counter, placed, few).ratio is not None


def test_a_reset_and_gaps_hide_no_copy() -> None:
    t_s, travelled_m, north_m, east_m = straight(5)
    counted_m = np.where(t_s < 300.0, travelled_m + north_m, travelled_m + north_m - 5000.0)
    kept = ~((t_s > 500.0) & (t_s < 540.0))
    counter = odometer_frame(t_s[kept], counted_m[kept], None)
    found = follows_positions(counter, fixes(t_s, travelled_m + north_m, east_m), CONFIG)
    assert found.ratio is not None
    assert found.ratio < 0.1


def standing(seed: int) -> tuple[Floats, Floats, Floats]:
    """Two minutes at a stand at 1 Hz: times, and what positions are off north and east."""
    rng = np.random.default_rng(seed)
    return np.arange(0.0, 150.0), *(0.05 * rng.standard_normal((2, 150)))


def test_what_errs_at_a_stand_as_the_positions_do() -> None:
    t_s, north_m, east_m = standing(1)
    copied = odometer_frame(t_s, None, np.hypot(np.diff(north_m, prepend=0.0), np.diff(east_m, prepend=0.0)))
    found = follows_positions(copied, fixes(t_s, north_m, east_m), CONFIG)
    assert found == Follows(ratio=None, at_stands=True)
    assert found.found(CONFIG.evidence)


@pytest.mark.parametrize("seed", range(20))
def test_an_odometer_with_noise_of_its_own_at_a_stand(seed: int) -> None:
    t_s, north_m, east_m = standing(seed)
    radar = odometer_frame(t_s, None, 0.05 * np.random.default_rng(99 + seed).standard_normal(t_s.size))
    assert not follows_positions(radar, fixes(t_s, north_m, east_m), CONFIG).at_stands


def test_a_wheel_that_creeps_for_a_while_is_no_copy() -> None:
    t_s, north_m, east_m = standing(3)
    crept_m = np.interp(t_s, [60.0, 70.0], [0.0, 0.6])
    wheel = odometer_frame(t_s, crept_m, None)
    assert not follows_positions(wheel, fixes(t_s, 0.02 * north_m + crept_m, 0.02 * east_m), CONFIG).at_stands
