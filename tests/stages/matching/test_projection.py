"""Where epochs come to lie on a path that is not in doubt."""

from __future__ import annotations

import pickle

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.stages.matching.epochs import count_contradictory_covariances
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.path import TravelledPath
from pipeline.stages.track.segments import Visit, leg_of
from pipeline.stages.track.survey import track_of
from schemas.config import Vehicle
from schemas.errors import InputError
from schemas.run import Site
from tests.stages.matching.builders import line, matched, odometer, run, site

EAST = {"e": line((0, 0), (1000, 0))}
TWO = {"a": line((0, 0), (500, 0)), "b": line((1000, 0), (500, 0))}
TWO_LINKS = [("a", 1, "b", 1, "both")]


def test_hand_worked_places_on_a_line_to_the_east() -> None:
    x = np.array([100.0, 110.0, 120.0, 130.0])
    y = np.array([0.0, 2.0, -3.0, 60.0])
    epochs = matched(run(x, y), site(EAST)).epochs.table
    assert np.allclose(epochs["path_m"], x, atol=2e-3)
    assert np.allclose(epochs["cross_track_m"], y, atol=2e-3)
    assert epochs["on_track"].to_list() == [True, True, True, False]
    assert epochs["netelement_id"].to_list() == ["e"] * 4
    assert np.allclose(epochs["heading_deg"], 90.0, atol=0.02)
    assert epochs["path_probability"].to_list() == [1.0, 1.0, 1.0, None]
    assert epochs["vertical_m"].null_count() == 4
    assert epochs["slope"].null_count() == 4


def test_a_run_to_the_west_grows_to_the_west_and_left_is_south() -> None:
    x = np.array([900.0, 850.0, 800.0])
    found = matched(run(x, np.array([1.0, 1.0, 1.0])), site(TWO, TWO_LINKS))
    assert found.path.element_names() == ["b"]
    assert np.allclose(found.epochs.table["path_m"], [100.0, 150.0, 200.0], atol=2e-3)
    assert np.allclose(found.epochs.table["measure_m"], [100.0, 150.0, 200.0], atol=2e-3)
    assert np.allclose(found.epochs.table["cross_track_m"], -1.0, atol=1e-4)
    assert np.allclose(found.epochs.table["heading_deg"], 270.0, atol=0.02)


def test_measures_fall_on_an_element_that_points_the_other_way() -> None:
    found = matched(run(np.arange(400.0, 700.0, 50.0), np.zeros(6)), site(TWO, TWO_LINKS))
    assert found.path.element_names() == ["a", "b"]
    assert np.allclose(found.epochs.table["path_m"], np.arange(400.0, 700.0, 50.0), atol=2e-3)
    assert np.allclose(found.epochs.table["measure_m"], [400, 450, 500, 450, 400, 350], atol=2e-3)


def test_only_the_elements_that_were_visited_are_on_the_path() -> None:
    elements = {name: line((500.0 * k, 0), (500.0 * k + 500, 0)) for k, name in enumerate("abcd")}
    links = [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both"), ("c", 1, "d", 0, "both")]
    found = matched(run(np.arange(600.0, 1400.0, 20.0), np.zeros(40)), site(elements, links))
    assert found.path.element_names() == ["b", "c"]
    assert found.epochs.table["path_m"][0] == pytest.approx(100.0, abs=2e-3)


def test_the_balise_antenna_is_behind_the_gnss_antenna() -> None:
    vehicle = Vehicle(gnss_antenna_ahead_m=30.0, antenna_height_m=4.0)
    heights = {"a": np.full(51, 100.0), "b": np.linspace(120.0, 100.0, 51)}
    place = site(TWO, TWO_LINKS, heights_m=heights)
    x = np.array([450.0, 510.0, 550.0])
    fixes = run(x, np.zeros(3), height_m=[104.0, 104.4, 106.5])
    epochs = matched(fixes, place, vehicle=vehicle).epochs.table
    assert np.allclose(epochs["path_m"], [420.0, 480.0, 520.0], atol=5e-3)
    assert epochs["netelement_id"].to_list() == ["a", "a", "b"]
    assert np.allclose(epochs["vertical_m"], [0.0, 0.0, 0.5], atol=1e-3)
    assert np.allclose(epochs["slope"], [0.0, 0.04, 0.04], atol=1e-4)


def test_the_lever_arm_turns_with_the_train() -> None:
    vehicle = Vehicle(gnss_antenna_ahead_m=30.0)
    epochs = matched(run(np.array([900.0, 850.0, 800.0]), np.zeros(3)), site(EAST), vehicle=vehicle).epochs.table
    assert np.allclose(epochs["path_m"], [70.0, 120.0, 170.0], atol=2e-3)
    assert np.allclose(epochs["measure_m"], [930.0, 880.0, 830.0], atol=2e-3)


def test_covariance_is_turned_into_the_track_s_frame() -> None:
    """A line to the north-east: along is (E + N)/√2, left is (N - E)/√2."""
    place = site({"e": line((0, 0), (700, 700))})
    fixes = run(np.array([10.0, 50.0]), np.array([10.0, 50.0])).with_columns(
        cov_ee_m2=pl.lit(4.0), cov_nn_m2=pl.lit(2.0), cov_en_m2=pl.lit(1.0), cov_uu_m2=pl.lit(9.0)
    )
    epochs = matched(fixes, place).epochs.table
    # e-4: the plane of the test's layout turns by as much against true north.
    assert np.allclose(epochs["sigma_along_m"], np.sqrt((4 + 2 + 2 * 1) / 2), atol=1e-3)
    assert np.allclose(epochs["sigma_cross_m"], np.sqrt((4 + 2 - 2 * 1) / 2), atol=1e-3)
    assert epochs["sigma_up_m"].to_list() == [3.0, 3.0]
    assert epochs["sigma_source"].cast(str).to_list() == ["receiver"] * 2


def test_a_correlation_that_cannot_be_is_not_used() -> None:
    """With cov_en = 50 the line across would have a negative variance, and the sigma 0 that a clip makes of it."""
    place = site({"e": line((0, 0), (700, 700))})
    fixes = run(np.array([10.0, 50.0]), np.array([10.0, 50.0])).with_columns(
        cov_ee_m2=pl.lit(4.0), cov_nn_m2=pl.lit(2.0), cov_en_m2=pl.Series([50.0, 1.0]), cov_uu_m2=pl.lit(9.0)
    )
    epochs = matched(fixes, place).epochs.table
    assert np.allclose(epochs["sigma_cross_m"], [np.sqrt(3.0), np.sqrt(2.0)], atol=1e-3)
    assert count_contradictory_covariances(fixes) == 1


@pytest.mark.parametrize(
    ("fix", "sigma_m"),
    [
        ("autonomous", 2.0),
        ("differential", 1.0),
        ("sbas", 1.0),
        ("rtk_float", 0.5),
        ("rtk_fixed", 0.1),
        ("estimated", 5.0),
    ],
)
def test_without_covariance_a_table_says_the_sigma(fix: str, sigma_m: float) -> None:
    fixes = run(np.array([10.0, 50.0]), np.zeros(2), sigma_m=None).with_columns(fix=pl.lit(fix))
    epochs = matched(fixes, site(EAST)).epochs.table
    assert np.allclose(epochs["sigma_along_m"], sigma_m)
    assert np.allclose(epochs["sigma_up_m"], 1.5 * sigma_m)
    assert epochs["sigma_source"].cast(str).to_list() == ["table"] * 2


def test_zero_covariance_is_not_certainty() -> None:
    fixes = run(np.array([10.0, 50.0]), np.zeros(2)).with_columns(cov_ee_m2=pl.lit(0.0), cov_nn_m2=pl.lit(0.0))
    assert matched(fixes, site(EAST)).epochs.table["sigma_source"].cast(str).to_list() == ["table"] * 2


def test_an_epoch_without_a_position_has_none() -> None:
    fixes = run(np.array([10.0, 50.0, 90.0]), np.zeros(3), fix=["sbas", "none", "sbas"])
    fixes = fixes.with_columns(latitude_deg=pl.Series([*fixes["latitude_deg"][:2], None]))
    epochs = matched(fixes, site(EAST)).epochs.table
    assert epochs["fix_valid"].to_list() == [True, False, False]
    assert epochs["on_track"].to_list() == [True, False, False]
    for name in (
        "leg",
        "netelement_id",
        "measure_m",
        "path_m",
        "cross_track_m",
        "sigma_along_m",
        "sigma_source",
        "heading_deg",
    ):
        assert epochs[name].is_null().to_list() == [False, True, True], name


@pytest.mark.parametrize("jump_m", [300.0, -300.0, 45.0])
def test_jumps_along_the_track_stay_what_they_are(jump_m: float) -> None:
    x = 350.0 + 5.0 * np.arange(60.0)
    raw = x + np.where((np.arange(60) >= 20) & (np.arange(60) < 40), jump_m, 0.0)
    found = matched(run(raw, np.zeros(60)), site(TWO, TWO_LINKS), odometer(x - x[0]))
    assert np.allclose(found.epochs.table["path_m"], raw, atol=5e-3)


def test_a_slow_drift_and_a_step_across_stay_what_they_are() -> None:
    x = 100.0 + 5.0 * np.arange(100.0)
    drift = 0.5 * np.maximum(0.0, np.arange(100.0) - 30)
    across = np.where(np.arange(100) < 50, 0.0, 30.0)
    epochs = matched(run(x + drift, across), site(EAST), odometer(x)).epochs.table
    assert np.allclose(epochs["path_m"], x + drift, atol=5e-3)
    assert np.allclose(epochs["cross_track_m"], across, atol=5e-3)
    assert epochs["on_track"].to_list() == (across == 0.0).tolist()


def test_a_jump_at_the_start_does_not_turn_the_run_round() -> None:
    x = 300.0 + 2.0 * np.arange(60.0)
    raw = x + np.where(np.arange(60) < 5, 80.0, 0.0)
    assert np.allclose(matched(run(raw, np.zeros(60)), site(EAST), odometer(x)).epochs.table["path_m"], raw, atol=5e-3)


def test_standstill_keeps_the_site_s_sense() -> None:
    rng = np.random.default_rng(5)
    found = matched(run(500.0 + rng.normal(size=50), rng.normal(size=50)), site(EAST))
    assert found.epochs.table["on_track"].all()
    assert found.epochs.table["heading_deg"].is_not_null().all()


def test_beyond_the_ends_the_path_goes_on_straight() -> None:
    x = np.array([-20.0, -5.0, 15.0, 40.0])
    found = matched(run(x, np.zeros(4)), site(EAST))
    assert np.allclose(found.epochs.table["path_m"], x, atol=2e-3)
    far = matched(run(np.array([950.0, 1005.0, 1006.0, 2000.0]), np.zeros(4)), site(EAST)).epochs.table
    assert far["on_track"].to_list() == [True, True, False, False]


def test_declared_measures_scale_the_geometry_piece_by_piece() -> None:
    place = site({"e": line((0, 0), (1000, 0), spacing_m=500.0)})
    declared = Site(place.track.with_columns(measure_m=pl.Series([0.0, 510.0, 1000.0])), place.links)
    epochs = matched(run(np.array([250.0, 500.0, 750.0]), np.zeros(3)), declared).epochs.table
    assert np.allclose(epochs["path_m"], [255.0, 510.0, 755.0], atol=1e-2)


def test_a_grade_is_longer_than_its_plan() -> None:
    heights = {"e": np.linspace(0.0, 30.0, 101)}
    place = site(EAST, heights_m=heights)
    measure = place.track["measure_m"] * np.hypot(1.0, 0.03)
    epochs = matched(
        run(np.array([100.0, 200.0]), np.zeros(2)), Site(place.track.with_columns(measure), place.links)
    ).epochs.table
    assert epochs["path_m"].diff()[1] == pytest.approx(100.0 * np.hypot(1.0, 0.03), abs=1e-3)
    assert np.allclose(epochs["slope"], 0.03, atol=1e-5)


@pytest.mark.parametrize(("turn", "sign"), [(1.0, 1.0), (-1.0, -1.0)])
def test_an_arc_has_its_curvature_and_its_chords_their_sagitta(turn: float, sign: float) -> None:
    radius, step = 500.0, 20.0
    angle = np.arange(0.0, 1.2, step / radius)
    arc = np.column_stack([radius * np.sin(angle), turn * radius * (1 - np.cos(angle))])
    at = 0.5 * (angle[10:20] + angle[11:21])
    x, y = radius * np.sin(at), turn * radius * (1 - np.cos(at))
    epochs = matched(run(x, y), site({"e": arc})).epochs.table
    assert np.allclose(epochs["curvature_per_m"], sign / radius, rtol=1e-3)
    sagitta = step**2 / (8 * radius)
    assert np.allclose(epochs["interpolation_error_m"], sagitta, rtol=1e-2)
    # The arc lies outside its chords: to the right of a left-hand curve.
    assert np.allclose(epochs["cross_track_m"], -sign * sagitta, rtol=2e-2)


def test_velocity_along_is_signed_by_growing_path() -> None:
    fixes = run(np.array([900.0, 850.0]), np.zeros(2)).with_columns(vel_e_mps=pl.lit(-50.0), vel_n_mps=pl.lit(3.0))
    assert np.allclose(matched(fixes, site(EAST)).epochs.table["velocity_along_mps"], 50.0, atol=1e-2)


def curved() -> TravelledPath:
    x = np.arange(0.0, 3000.0, 7.0)
    points = np.column_stack([x, 200.0 * np.sin(x / 700.0)])
    track = track_of(site({"a": points[:200], "b": points[199:][::-1]}, [("a", 1, "b", 1, "both")]).track)
    return TravelledPath(track, (leg_of(track, [Visit(0, True), Visit(1, False)], 100.0),))


def on_first_leg(
    path: TravelledPath, latitude_deg: np.ndarray, longitude_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Path positions, and how far left of the path [m]."""
    latitude_deg, longitude_deg = np.atleast_1d(latitude_deg), np.atleast_1d(longitude_deg)
    leg, height_m = np.zeros(len(latitude_deg), dtype=np.int64), np.full(len(latitude_deg), np.nan)
    feet = path.nearest_feet(points_of(latitude_deg, longitude_deg), leg, np.isfinite(latitude_deg))
    return path.path_positions(leg, feet, height_m)[0], feet.offset_m


@settings(max_examples=60, deadline=None)
@given(st.floats(100.0, 3000.0), st.floats(-30.0, 30.0))
def test_locating_and_projecting_are_inverse(path_m: float, away_m: float) -> None:
    """A place on the path, moved square to it, projects back to where it was."""
    path = curved()
    leg = path.legs[0]
    segment = int(np.searchsorted(leg.path_start_m, path_m, side="right")) - 1
    share = (path_m - leg.path_start_m[segment]) / (leg.path_end_m[segment] - leg.path_start_m[segment])
    names, measures = path.locate(0, path_m)
    rows = path.track.vertex_range(path.track.index[str(names[0])])
    latitude = np.interp(measures[0], path.track.measure_m[rows], path.track.latitude_deg[rows])
    longitude = np.interp(measures[0], path.track.measure_m[rows], path.track.longitude_deg[rows])
    heading = np.radians(leg.heading_deg[segment])
    north, east = away_m * np.sin(heading), -away_m * np.cos(heading)
    found_m, cross_m = on_first_leg(
        path,
        latitude + np.degrees(north / 6_372_955.9),
        longitude + np.degrees(east / (6_390_702.0 * np.cos(np.radians(latitude)))),
    )
    assert 0.0 <= share <= 1.0
    # Between two chords of a curve a place square to one may be nearer to the next.
    assert found_m[0] == pytest.approx(path_m, abs=0.02 + 0.02 * abs(away_m))
    assert cross_m[0] == pytest.approx(away_m, abs=0.02)


def test_a_path_survives_the_way_between_processes() -> None:
    path = curved()
    other = pickle.loads(pickle.dumps(path))
    place = (np.array([50.0005]), np.array([14.01]))
    assert on_first_leg(other, *place)[0][0] == on_first_leg(path, *place)[0][0]
    assert other.element_names() == ["a", "b"]


def test_unknown_places_are_nan_and_none() -> None:
    path = curved()
    found_m, _ = on_first_leg(path, np.array([50.0, np.nan]), np.array([14.01, 14.01]))
    assert np.isnan(found_m[1])
    assert path.locate(0, [np.nan, 200.0])[0][0] is None


def test_balises_get_their_path_position_in_order() -> None:
    balises = pl.DataFrame(
        {
            "balise_id": ["far", "near", "off", "other"],
            "netelement_id": ["b", "a", "a", "zz"],
            "measure_m": [100.0, 50.0, 5000.0, 1.0],
            "kind": ["virtual", "physical", "virtual", "virtual"],
            "location_accuracy_m": [12.0] * 4,
            "linked": [True] * 4,
            "link_reaction": ["trip"] * 4,
            "direction": ["AB", "BA", "AB", "AB"],
        }
    )
    found = matched(run(np.arange(400.0, 700.0, 50.0), np.zeros(6)), site(TWO, TWO_LINKS)).path.balises_on_path(balises)
    assert found["balise_id"].to_list() == ["near", "far"]
    assert np.allclose(found["path_m"], [50.0, 900.0], atol=1e-3)
    # `b` is run against its measure: AB there is back along the path. Every train reads a physical one.
    assert found["valid_direction"].to_list() == [0, -1]
    unsaid = matched(run(np.arange(400.0, 700.0, 50.0), np.zeros(6)), site(TWO, TWO_LINKS)).path
    assert unsaid.balises_on_path(balises.drop("direction"))["valid_direction"].to_list() == [0, 0]


def test_a_run_somewhere_else_says_what_may_be_wrong() -> None:
    place = site(EAST)
    x = np.arange(0.0, 100.0, 10.0)
    with pytest.raises(InputError, match=r"100 km or more from any track.*coordinate system"):
        matched(run(x + 100_000.0 + 1000.0, x), place)
    good = run(x, np.zeros(10))
    swapped = good.with_columns(latitude_deg=good["longitude_deg"], longitude_deg=good["latitude_deg"])
    with pytest.raises(InputError, match="Latitude and longitude are swapped"):
        matched(swapped, place)
    with pytest.raises(InputError, match=r"120 m or more from any track.*datum read as WGS 84"):
        matched(run(x, np.full(10, 120.0)), place)
    with pytest.raises(InputError, match=r"900 m or more from any track.*site covers this run"):
        matched(run(x, np.full(10, 900.0)), place)
    with pytest.raises(InputError, match="no epoch has a position"):
        matched(good.with_columns(fix=pl.lit("none")), place)


def test_the_caller_s_frames_stay_as_they_were() -> None:
    fixes, place = run(np.arange(100.0, 200.0, 10.0), np.zeros(10)), site(EAST)
    before, track = fixes.clone(), place.track.clone()
    matched(fixes, place)
    assert fixes.equals(before)
    assert place.track.equals(track)


def test_the_lever_arm_stays_where_it_is_on_a_train_that_begins_by_reversing() -> None:
    """The odometer falls: the leading end, and the antenna 30 m towards it, is behind the movement."""
    x = np.arange(300.0, 421.0, 20.0)
    vehicle = Vehicle(gnss_antenna_ahead_m=30.0)
    fixes, place = run(x, np.zeros(x.size)), site(EAST)
    backward = matched(fixes, place, distance=odometer(300.0 - x), vehicle=vehicle)
    forward = matched(fixes, place, distance=odometer(x - 300.0), vehicle=vehicle)
    assert np.allclose(backward.epochs.table["path_m"], x + 30.0, atol=2e-3)
    assert np.allclose(forward.epochs.table["path_m"], x - 30.0, atol=2e-3)
    assert (backward.odometer_sign, forward.odometer_sign) == (-1, 1)
