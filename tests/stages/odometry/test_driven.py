"""What an odometer's rows scatter is neither way nor turn nor movement."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.odometry.driven import evenly_driven, is_moving, travelled_m, with_hysteresis
from schemas.config import AlignConfig, Configuration
from tests.replay.journeys import VEHICLE, journey, replay
from tests.stages.alignment.straight import NO_NOISE

STOPS = {
    "start_m": 200.0,
    "phases": [
        {"speed_mps": 0.0, "hold_s": 60.0},
        {"speed_mps": 25.0},
        {"stop_at_m": 4000.0, "hold_s": 120.0},
        {"speed_mps": 25.0},
        {"stop_at_m": 8000.0, "hold_s": 60.0},
    ],
}
SHUNTING = {
    "start_m": 200.0,
    "phases": [
        {"speed_mps": 20.0},
        {"stop_at_m": 3000.0, "hold_s": 30.0},
        {"speed_mps": -5.0, "hold_m": 300.0},
        {"speed_mps": 0.0, "hold_s": 30.0},
        {"speed_mps": 20.0},
        {"stop_at_m": 8000.0, "hold_s": 20.0},
    ],
}


def test_a_stand_lasts_to_its_last_count_and_to_the_end_of_the_record():
    """Counts of a metre at 1 m/s, a stand from 10 to 70 s at 10 m, and one from 90 s to the last row at 30 m."""
    t_s = np.arange(0.0, 101.0)
    counts = np.where(t_s < 70.0, np.minimum(t_s, 10.0), np.minimum(t_s - 60.0, 30.0))
    at_s, at_m = evenly_driven(t_s, counts, np.full(t_s.size, 1.0 / np.sqrt(12.0)), 0.3, AlignConfig())
    nodes = list(zip(at_s.tolist(), at_m.tolist(), strict=True))
    around = nodes.index((10.0, 10.0))
    assert nodes[around + 1 : around + 3] == [(70.0, 10.0), (71.0, 11.0)]
    assert nodes[-2:] == [(90.0, 30.0), (100.0, 30.0)]


def test_rows_that_scatter_at_a_stand_are_not_under_way():
    """Half a metre from row to row at 5 Hz looks like 2.5 m/s; from 20 s on the train drives 5 m/s."""
    t_s = np.arange(0.0, 40.0, 0.2)
    rows_m = 5.0 * np.maximum(t_s - 20.0, 0.0) + np.random.default_rng(1).normal(0.0, 0.5, t_s.size)
    run_m = travelled_m(t_s, rows_m, np.full(t_s.size, 2.5), 0.3, 1.0)
    moving = is_moving(t_s, run_m, 0.3, 1.0)
    assert not moving[t_s < 20.0].any()
    assert moving[t_s > 21.5].mean() > 0.9


def test_hysteresis_by_hand():
    rows = np.array([0.0, 0.8, -0.7, 3.0, 2.5, 1.5, 0.5, 5.0, np.nan, 6.0])
    held = with_hysteresis(rows, np.full(10, 1.0))
    np.testing.assert_array_equal(held, [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 1.5, 4.0, np.nan, 5.0])


def test_without_hysteresis_the_distance_is_as_it_is():
    rows = np.cumsum(np.random.default_rng(1).normal(size=50))
    np.testing.assert_array_equal(with_hysteresis(rows, np.zeros(50)), rows)
    driven = travelled_m(np.arange(50.0), rows, np.zeros(50), 0.0, 1.0)
    assert driven[-1] == pytest.approx(np.abs(np.diff(rows)).sum())


@pytest.mark.parametrize("turns", [0, 3, 400])
@pytest.mark.parametrize("width_m", [0.0, 0.3, 5.0])
def test_long_drives_are_held_as_each_row_alone_would_be(turns, width_m):
    """By the definition, row by row: the edge that reaches it takes it along. Some rows and widths are unknown."""
    rng = np.random.default_rng(turns)
    sense = np.cos(np.pi * (turns + 0.5) * np.linspace(0.0, 1.0, 20_000))
    distance_m = np.cumsum(0.4 * sense) + 0.1 * rng.normal(size=sense.size)
    distance_m[rng.integers(0, sense.size, 50)] = np.nan
    width = np.full(sense.size, width_m)
    width[:100] = np.inf
    held = with_hysteresis(distance_m, width)
    at_m = distance_m[0]
    for row in np.flatnonzero(np.isfinite(distance_m)).tolist():
        if distance_m[row] - width[row] > at_m:
            at_m = distance_m[row] - width[row]
        elif distance_m[row] + width[row] < at_m:
            at_m = distance_m[row] + width[row]
        assert held[row] == at_m
    assert np.isnan(held[~np.isfinite(distance_m)]).all()


def test_way_to_and_fro_by_hand():
    """100 m there and 40 m back; what scatters within the hysteresis adds nothing."""
    there, back = np.linspace(0.0, 100.0, 201), np.linspace(99.5, 60.0, 80)
    rows = np.concatenate([there, back]) + 0.8 * (-1.0) ** np.arange(281)
    # The extremes of the rows are the way: 0.8 m beyond on either side of the turn, and at the end.
    driven = travelled_m(0.1 * np.arange(281), rows, np.full(281, 2.0), 0.3, 1.0)
    assert driven[-1] == pytest.approx(140.0 + 2 * 0.8 - 2.0, abs=1.7)
    assert np.abs(np.diff(rows)).sum() > 400.0


def test_a_stand_ends_where_the_rows_leave_it():
    t = np.arange(0.0, 60.0, 0.1)
    driven = np.maximum(t - 30.0, 0.0)
    rows = driven + np.random.default_rng(2).normal(0.0, 0.1, t.size)
    at_s, at_m = evenly_driven(t, rows, np.full(t.size, 0.1), 0.3, AlignConfig())
    speed = np.interp(t + 0.5, at_s, at_m) - np.interp(t - 0.5, at_s, at_m)
    began_s = t[np.flatnonzero(speed > 0.3)[0]]
    assert began_s == pytest.approx(30.0, abs=0.7)


def scattered(odometer, kind, size_m):
    distance = odometer["distance_m"].to_numpy()
    if kind == "counts":
        return odometer.with_columns(distance_m=pl.Series(np.floor(distance / size_m) * size_m))
    noise = np.random.default_rng(3).normal(0.0, size_m, distance.size)
    return odometer.with_columns(distance_m=pl.Series(distance + noise))


CASES = [
    *((STOPS, kind, size_m) for kind, size_m in (("noise", 0.1), ("counts", 2.0))),
    *((SHUNTING, kind, size_m) for kind, size_m in (("noise", 0.5), ("counts", 0.5), ("counts", 2.0))),
]


@pytest.mark.parametrize(("motion", "kind", "size_m"), CASES)
def test_way_turns_and_movement_are_those_of_the_train(motion, kind, size_m):
    run, site = journey(motion=motion)
    given = Configuration.model_validate({"monitors": NO_NOISE})
    plain = replay(run, site, VEHICLE, given)
    tables = replay(run.with_streams(odometer=scattered(run.odometer, kind, size_m)), site, VEHICLE, given)
    way, plain_way = (found.runs["distance_m"][0] for found in (tables, plain))
    # What rows scatter by is known from those before: the first second counts what it may.
    assert way == pytest.approx(plain_way, abs=25.0 * size_m + 1.0)
    turns, plain_turns = (found.epochs["direction"].diff().fill_null(0).ne(0).sum() for found in (tables, plain))
    assert turns == plain_turns == (0 if motion is STOPS else 2)
    moving_s, plain_s = (0.1 * found.epochs["moving"].sum() for found in (tables, plain))
    assert moving_s == pytest.approx(plain_s, rel=0.03)
    share, plain_share = (found.runs["availability"][0] for found in (tables, plain))
    assert plain_share - 0.03 < share < plain_share + 0.006
