"""What is worked out for a whole network at once, or only about a run, is what the plain way gives."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.paths.candidates import candidates_of, search_about, segments_of
from pipeline.stages.track.chords import _least_turns, _wrap_angle
from pipeline.stages.track.geodesy import point_distances_m, points_of
from pipeline.stages.track.network import _successors_of, connected_parts, network_of
from pipeline.stages.track.segments import Polyline
from pipeline.stages.track.survey import SurveyedTrack, track_of
from schemas.conform import conform
from schemas.inputs import Links, Track

SEEDS = pytest.mark.parametrize("seed", range(8))


@SEEDS
def test_parts_are_what_walking_from_place_to_place_reaches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, there = rng.integers(0, 40, (2, rng.integers(0, 45)))
    parts = connected_parts(40, here, there)
    pairs = {*zip(here.tolist(), there.tolist(), strict=True), *zip(there.tolist(), here.tolist(), strict=True)}
    for place in range(40):
        reached = {place}
        while more := {b for a, b in pairs if a in reached} - reached:
            reached |= more
        assert np.flatnonzero(parts == parts[place]).tolist() == sorted(reached)


def test_a_ring_of_many_places_is_one_part() -> None:
    order = np.random.default_rng(0).permutation(10_000)
    assert (connected_parts(10_000, order, np.roll(order, 1)) == 0).all()


@SEEDS
def test_ways_keep_their_order_and_a_repeated_one_allows_what_either_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, there = rng.integers(0, 6, (2, 20))
    forward, backward = rng.integers(0, 2, (2, 20)).astype(np.bool_)
    gap_m = (here * 10 + there).astype(np.float64)
    ways = _successors_of(6, here, there, gap_m, forward, backward)
    for start in range(6):
        rows = np.flatnonzero(here == start)
        expected = {}
        for to in dict.fromkeys(there[rows].tolist()):
            same = rows[there[rows] == to]
            expected[to] = (start * 10.0 + to, bool(forward[same].any()), bool(backward[same].any()))
        assert [(edge.to, edge[1:]) for edge in ways[start]] == list(expected.items())


@SEEDS
def test_the_straightest_way_on_is_the_first_with_the_least_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    leave_rad, enter_rad = rng.integers(-3, 4, (2, 10)).astype(np.float64)
    here, there = np.sort(rng.integers(0, 10, 25)), rng.integers(0, 10, 25)
    onward, turn_rad = _least_turns(leave_rad, enter_rad, here, there)
    for start in range(10):
        turns = [
            (float(_wrap_angle(enter_rad[[to]] - leave_rad[start])[0]), to) for to in there[here == start].tolist()
        ]
        turn, to = min(turns, key=lambda way: abs(way[0]), default=(0.0, -1))
        assert (onward[start], turn_rad[start]) == (to, turn)


def scattered(seed: int, heights: bool = False) -> SurveyedTrack:
    """Winding elements of two to twenty points over some 300 km, the first of them one after the other."""
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(60):
        begin = rng.uniform(49.0, 52.0, 2) if number > 20 else np.array([50.0, 4.0 + 0.005 * number])
        degrees = begin + rng.uniform(1e-5, 6e-4, (int(rng.integers(2, 21)), 2)).cumsum(axis=0)
        frame = pl.DataFrame({"latitude_deg": degrees[:, 0], "longitude_deg": degrees[:, 1]}).with_columns(
            netelement_id=pl.lit(f"E{number}"),
            measure_m=pl.int_range(pl.len()) * 10.0,
            height_m=pl.lit(float(number) if heights else None, pl.Float64),
            sigma_m=pl.lit(0.1),
        )
        frames.append(frame)
    return track_of(conform(pl.concat(frames), Track))


@SEEDS
@pytest.mark.parametrize("heights", [False, True])
def test_measures_of_all_elements_are_those_of_each(seed: int, heights: bool) -> None:
    track = scattered(seed, heights)
    for _, _, part in track.elements():
        steps_m = point_distances_m(
            track.latitude_deg[part], track.longitude_deg[part], np.nan_to_num(track.height_m[part])
        )
        assert track.geometric_m[part].tolist() == [0.0, *np.cumsum(steps_m).tolist()]


@SEEDS
def test_candidates_about_a_run_are_those_of_a_search_everywhere(seed: int) -> None:
    track = scattered(seed)
    network = network_of(track, Links.create_empty())
    near = np.arange(0, int(track.first[15]), 2)
    points = points_of(track.latitude_deg[near] + 2e-4, track.longitude_deg[near])
    for reach_m in (30.0, 200.0):
        about = candidates_of(points, network, search_about(points.surface, network, reach_m), reach_m)
        everywhere = candidates_of(points, network, segments_of(track).search_in(), reach_m)
        assert len(about.step) > 10
        for name in vars(everywhere):
            np.testing.assert_array_equal(getattr(about, name), getattr(everywhere, name))


@SEEDS
def test_the_nearest_sample_is_the_nearest_of_all_however_far(seed: int) -> None:
    track = scattered(seed)
    inside = np.setdiff1d(np.arange(len(track.surface) - 1), track.first[1:-1] - 1)
    line = Polyline(track.surface[inside], track.surface[inside + 1])
    samples = Polyline(line.start, line.end).sample_tree[0].data
    rng = np.random.default_rng(seed)
    # First about the line, then about that and far away, then only far away from all that was looked at.
    for degrees in ((50.0, 4.05), (50.5, 4.6), (20.0, 70.0), (51.9, 51.9)):
        places = points_of(degrees[0] + rng.uniform(0, 0.05, 9), degrees[1] + rng.uniform(0, 0.05, 9)).surface
        found_m, _ = line.nearest_sample(places)
        expected_m = np.linalg.norm(places[:, None] - samples, axis=2).min(axis=1)
        np.testing.assert_allclose(found_m, expected_m, rtol=0.0, atol=1e-6)
