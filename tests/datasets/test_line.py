"""The synthetic line: lengths, curves, grades, survey, links, balises."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from datasets.line import balises_table, build_line, element_at, links_table, offset_places, track_table
from datasets.scenario import LineSpec
from pipeline.stages.track.geodesy import earth_centred_m, point_distances_m
from schemas.errors import ConfigError
from tests.datasets.small import LINE


def spec(**changes: object) -> LineSpec:
    return LineSpec.model_validate({**LINE, **changes})


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def track(line_spec: LineSpec) -> pl.DataFrame:
    return track_table(build_line(line_spec), rng())


def test_chainage_is_the_distance_along_the_rail() -> None:
    samples = build_line(spec()).samples
    steps = point_distances_m(samples.latitude_deg, samples.longitude_deg, samples.height_m)
    assert steps == pytest.approx(1.0, abs=2e-6)
    assert steps.sum() == pytest.approx(5000.0, abs=1e-3)


def test_curves_turn_by_length_over_radius_and_to_the_named_side() -> None:
    line = build_line(spec())
    heading = line.places_at(np.array([0.0, 700.0, 1150.0, 1750.0])).heading_deg
    assert heading[1] == pytest.approx(30.0, abs=1e-9)
    # Left turns lower the heading; 350 m and 700 m of 900 m radius, 250 m of 1200 m radius to the right.
    assert heading[2] == pytest.approx(30.0 - np.degrees(350.0 / 900.0), abs=1e-6)
    assert heading[3] == pytest.approx(30.0 - np.degrees(700.0 / 900.0 - 250.0 / 1200.0), abs=1e-6)


def test_grade_is_rise_over_run() -> None:
    height = build_line(spec()).places_at(np.array([100.0, 600.0])).height_m
    assert height[1] - height[0] == pytest.approx(500.0 * np.sin(np.arctan(0.01)), abs=1e-9)


def test_a_place_beyond_the_line_is_refused() -> None:
    with pytest.raises(ConfigError, match="leaves the line"):
        build_line(spec()).places_at(np.array([5001.0]))


def test_reversed_elements_meet_their_neighbours_at_the_linked_ends() -> None:
    table, links = track(spec()), links_table(spec())
    assert links.rows() == [("A", 1, "B", 1, "both"), ("B", 0, "C", 0, "both")]
    for a, end_a, b, end_b, _ in links.iter_rows():
        ends = []
        for name, end in ((a, end_a), (b, end_b)):
            points = table.filter(pl.col("netelement_id") == name)
            ends.append(points.row(-1 if end else 0, named=True))
        for column in ("latitude_deg", "longitude_deg", "height_m"):
            assert ends[0][column] == pytest.approx(ends[1][column], abs=1e-12)


@pytest.mark.parametrize(
    ("at_m", "element", "measure_m"), [(700.0, "A", 700.0), (1700.0, "B", 1800.0), (3600.0, "C", 100.0)]
)
def test_balises_lie_at_the_measure_of_their_element(at_m: float, element: str, measure_m: float) -> None:
    assert element_at(spec(), at_m) == (element, measure_m)
    row = balises_table(spec()).filter((pl.col("netelement_id") == element) & (pl.col("measure_m") == measure_m))
    assert row.height == 1


def test_survey_measures_agree_with_survey_places() -> None:
    for _, points in track(spec()).group_by("netelement_id", maintain_order=True):
        chords = point_distances_m(*(points[c].to_numpy() for c in ("latitude_deg", "longitude_deg", "height_m")))
        assert np.diff(points["measure_m"].to_numpy()) == pytest.approx(chords, abs=1e-3)


def test_flat_survey_has_no_heights() -> None:
    assert track(spec(survey={"flat": True}))["height_m"].null_count() == track(spec()).height


def test_survey_bias_moves_the_survey_and_not_the_line() -> None:
    true, moved = track(spec()), track(spec(survey={"bias_east_m": 1.0, "bias_north_m": 2.0, "bias_up_m": -3.0}))
    columns = ("latitude_deg", "longitude_deg", "height_m")
    gap = earth_centred_m(*(moved[c].to_numpy() for c in columns)) - earth_centred_m(
        *(true[c].to_numpy() for c in columns)
    )
    assert np.linalg.norm(gap, axis=1) == pytest.approx(np.sqrt(14.0), rel=1e-4)


def test_survey_noise_has_its_sigma_and_is_smooth_in_place() -> None:
    settings = {"noise_sigma_m": 0.5, "noise_length_m": 50.0, "spacing_m": 5.0}
    true = track(spec(survey={"spacing_m": 5.0}))["height_m"].to_numpy()
    draws = [
        track_table(build_line(spec(survey=settings)), np.random.default_rng(seed))["height_m"].to_numpy() - true
        for seed in range(20)
    ]
    noise = np.array(draws)
    assert noise.std() == pytest.approx(0.5, rel=0.1)
    assert np.diff(noise[:, :300], axis=1).std() == pytest.approx(0.5 * np.sqrt(2 * (1 - np.exp(-0.1))), rel=0.05)


def test_parallel_tracks_run_beside_the_line_unlinked() -> None:
    parallel = {"id": "P", "from_m": 100.0, "to_m": 2900.0, "left_m": 4.5}
    line_spec = spec(parallels=[parallel])
    table = track(line_spec).filter(pl.col("netelement_id") == "P")
    places = build_line(line_spec).places_at(100.0 + table["measure_m"].to_numpy())
    columns = ("latitude_deg", "longitude_deg", "height_m")
    gap = earth_centred_m(*(table[c].to_numpy() for c in columns)) - earth_centred_m(
        *(getattr(places, c) for c in columns)
    )
    assert np.linalg.norm(gap, axis=1) == pytest.approx(4.5, abs=1e-3)
    assert "P" not in links_table(line_spec)["netelement_a"].to_list()


def test_left_is_left_of_the_heading() -> None:
    north = build_line(spec(heading_deg=0.0)).places_at(np.array([10.0]))
    assert offset_places(north, 5.0).longitude_deg[0] < north.longitude_deg[0]
