"""Places on the rails against hand-worked ones and against the log that the run was made from."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.results.places import ground_at, ground_of, offset_positions, plane_m, stretches_of
from pipeline.show.export.positions import positions_of
from pipeline.stages.track.geodesy import distance_m
from tests.show.export.conftest import Result

# One degree of longitude on the equator is 111 319.49 m: 6 378 137 m · π / 180.
DEGREE_M = 6_378_137.0 * np.pi / 180.0


def equator(*elements: str) -> pl.DataFrame:
    """Elements of 1000 m one after the other, eastward along the equator; height rises by 10 m on each."""
    rows = []
    for number, name in enumerate(elements):
        for measure in (0.0, 400.0, 1000.0):
            rows.append((name, measure, 0.0, (1000.0 * number + measure) / DEGREE_M, 10.0 * number + measure / 100.0))
    schema = ["netelement_id", "measure_m", "latitude_deg", "longitude_deg", "height_m"]
    frame = pl.DataFrame(rows, schema=schema, orient="row")
    return frame.with_columns(sigma_m=pl.lit(None, dtype=pl.Float64))


def test_between_points_and_beyond_ends() -> None:
    names = pl.Series(["A", "A", "B", None, "A", "other"])
    ground = ground_of(equator("A", "B"), names, np.array([200.0, 700.0, 1000.0, 5.0, -100.0, 1.0]))
    expected = [200.0, 700.0, 2000.0, np.nan, -100.0, np.nan]
    np.testing.assert_allclose(ground.longitude_deg * DEGREE_M, expected, atol=1e-6)
    np.testing.assert_allclose(ground.height_m, [2.0, 7.0, 20.0, np.nan, -1.0, np.nan], atol=1e-9)
    np.testing.assert_allclose(ground.heading_deg[:3], 90.0)


@pytest.mark.parametrize(("sign", "north"), [(1.0, 3.0), (-1.0, -3.0)])
def test_left_is_left_of_growing_path(sign: float, north: float) -> None:
    rails = ground_of(equator("A"), pl.Series(["A"]), np.array([500.0]))
    placed = offset_positions(rails, np.array([sign]), np.array([3.0]), np.array([2.0]))
    east_m, north_m = plane_m(placed, (0.0, 500.0 / DEGREE_M))
    assert north_m[0] == pytest.approx(north, abs=0.05)
    assert east_m[0] == pytest.approx(0.0, abs=0.01)
    assert placed.height_m[0] == pytest.approx(7.0)


def test_path_that_runs_against_the_measure() -> None:
    """Path grows over B backwards, then A backwards: path 0 is the end of B, 1500 the middle of A."""
    epochs = pl.DataFrame(
        {
            "netelement_id": ["B", "B", "A", "A"],
            "measure_m": [900.0, 100.0, 950.0, 700.0],
            "path_m": [100.0, 900.0, 1050.0, 1300.0],
        }
    )
    stretches = stretches_of(epochs)
    assert stretches.select("netelement_id", "sign").rows() == [("B", -1), ("A", -1)]
    ground = ground_at(equator("A", "B"), stretches, np.array([0.0, 1000.0, 1500.0, 2300.0]))
    np.testing.assert_allclose(ground.longitude_deg * DEGREE_M, [2000.0, 1000.0, 500.0, np.nan], atol=1e-6)


def test_a_stand_still_has_no_direction() -> None:
    epochs = pl.DataFrame({"netelement_id": ["A", "A"], "measure_m": [5.0, 5.0], "path_m": [5.0, 5.0]})
    assert stretches_of(epochs).is_empty()


def test_truth_is_the_reference_of_the_log(result: Result) -> None:
    """True positions come back from the tables to where the reference was, less the antenna's 2.5 m ahead.

    Beside the track and in time they cannot be distinguished, so only the fault's 1300 m would show.
    """
    truth = positions_of(result.tables.epochs, result.site).truth
    assert result.log.reference is not None
    both = truth.join(result.log.reference, on="t", suffix="_log")
    assert both.height > 1000
    pairs = both.select("latitude_deg", "longitude_deg", "latitude_deg_log", "longitude_deg_log").iter_rows()
    away = np.array([distance_m(*pair) for pair in pairs])
    moving_delay_m = 0.05 * 41.0
    assert away.max() < 2.5 + moving_delay_m + 1.0


def test_truth_needs_no_position(result: Result) -> None:
    epochs = result.tables.epochs
    silent = epochs.with_columns(pl.lit(None, pl.Float64).alias(name) for name in ("path_m", "error_along_m"))
    assert positions_of(silent, result.site).truth.equals(positions_of(epochs, result.site).truth)


def test_matched_less_truth_is_the_error(result: Result) -> None:
    epochs = result.tables.epochs
    places = positions_of(epochs, result.site)
    both = places.matched.join(places.truth, on="t", suffix="_true").join(epochs.select("t", "error_along_m"), on="t")
    east, north = (both[name].to_numpy() for name in ("longitude_deg", "latitude_deg"))
    pairs = zip(north, east, both["latitude_deg_true"], both["longitude_deg_true"], strict=True)
    away = np.array([distance_m(*pair) for pair in pairs])
    error = both["error_along_m"].abs().to_numpy()
    near = error < 10.0
    np.testing.assert_allclose(away[near], error[near], atol=0.01)
    # A jump of 1300 m bends with the track: its chord is shorter than its path, never longer.
    assert error.max() > 1000.0
    assert np.all(away <= error + 0.01)
    assert away[error.argmax()] > 0.97 * error.max()
