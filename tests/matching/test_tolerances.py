"""How far beside a track a position may lie, and covariances that contradict themselves, worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from pipeline.matching import match
from pipeline.matching.decode import Chain, Decoded
from pipeline.matching.doubt import elements_about
from pipeline.matching.epochs import on_track_limit_m
from pipeline.matching.fixes import contradictory_covariances
from pipeline.matching.likelihood import step_score
from pipeline.matching.match import pins_of
from pipeline.matching.steps import spaced
from pipeline.track.geodesy import points_of
from pipeline.track.survey import track_of
from schemas.config import FixSigma, MatchingConfig, Vehicle
from tests.matching.builders import line, run, site


@pytest.mark.parametrize(
    ("sigma_m", "survey_m", "limit_m"),
    [
        (3.0, 2.0, 3.0 * np.sqrt(9.0 + 4.0 + 2.25)),
        (3.0, np.nan, 3.0 * np.sqrt(9.0 + 1.0 + 2.25)),  # 1 m where the survey says nothing
        (40.0, 0.0, 50.0),  # no track is looked for farther away
    ],
)
def test_a_position_is_on_track_within_three_roots_of_all_it_may_err(
    sigma_m: float, survey_m: float, limit_m: float
) -> None:
    found = on_track_limit_m(np.array([sigma_m]), np.array([survey_m]), MatchingConfig())
    assert found[0] == pytest.approx(limit_m)


@pytest.mark.parametrize(
    ("east_m2", "both_m2", "north_m2", "count"),
    [(0.5, 0.5, 0.5, 1), (0.5, -0.6, 0.5, 1), (0.5, 0.49, 0.5, 0), (0.0, 0.5, 0.5, 0), (0.5, 0.5, 0.0, 0)],
)
def test_no_covariance_is_larger_than_its_variances_allow(
    east_m2: float, both_m2: float, north_m2: float, count: int
) -> None:
    frame = pl.DataFrame({"cov_ee_m2": [east_m2], "cov_en_m2": [both_m2], "cov_nn_m2": [north_m2]})
    assert contradictory_covariances(frame) == count


@pytest.mark.parametrize(("around", "elements"), [(0, [3]), (1, [2, 3, 4]), (2, [1, 2, 3, 4, 5]), (9, [*range(6)])])
def test_neighbours_on_the_path_are_the_same_way(around: int, elements: list[int]) -> None:
    """Elements 0 to 5 in their own sense, of which the numbers begin at -2."""
    chain = Chain(tuple(range(0, 12, 2)), -2)
    nothing = np.zeros(0)
    decoded = Decoded((chain,), nothing.astype(int), nothing.astype(int), nothing)
    assert elements_about(decoded, 0, 1, around).tolist() == elements


def test_how_many_neighbours_is_a_setting() -> None:
    """At the link of two elements a position is on either of them."""
    place = site({"a": line((0, 0), (500, 0)), "b": line((500, 0), (1000, 0))}, [("a", 1, "b", 0, "both")])
    fixes = run(np.arange(100.0, 900.0, 10.0), np.zeros(80))
    for around, sure in ((0, False), (1, True)):
        config = MatchingConfig(same_way_elements=around)
        found = match(fixes, None, place, Vehicle(), config, FixSigma())
        assert (found.epochs["path_probability"].min() > 0.99) is sure


@pytest.mark.parametrize(("sigmas", "expected_m"), [(3.0, 8.5), (2.0, 9.0), (20.0, 5.0)])
def test_an_error_far_outside_its_sigma_returns_no_faster(sigmas: float, expected_m: float) -> None:
    """10 m aside at a sigma of 1 m, of which a half stays: 1.5 m back from three sigmas, 5 m back from all of it."""
    one = np.ones((1, 1))
    like = SimpleNamespace(
        hypotheses=SimpleNamespace(bias_m=np.zeros(1)), variance_m2=one, fresh_m2=0.1 * one, keep=0.5 * one,
        renewed_m2=np.zeros(1), fixed=np.zeros(1), outlier=1e-9, outlier_scale_m=10.0, return_sigmas=sigmas,
    )  # fmt: skip
    at_m = np.arange(0.0, 12.0, 0.5)
    score = [
        step_score(np.array([10.0]), np.array([m]), np.zeros(1, dtype=int), np.zeros(1, bool), cast(Any, like))[0, 0]
        for m in at_m
    ]
    assert at_m[int(np.argmax(score))] == expected_m


def test_steps_are_a_distance_or_a_time_apart() -> None:
    """4 m each second for 6 s, then a stand to 30 s: every 10 m, every 10 s, and the last; the fifth is left out."""
    t_s = np.array([*range(7), *range(8, 31, 2)], dtype=float)
    points = points_of(np.zeros(len(t_s)), np.degrees(np.minimum(4.0 * t_s, 24.0) / 6378137.0))
    rows = np.delete(np.arange(len(t_s)), 5)
    fixes = SimpleNamespace(points=points, t_s=t_s)
    found = spaced(cast(Any, fixes), rows, MatchingConfig(step_distance_m=10.0, step_time_s=10.0))
    assert t_s[found].tolist() == [0.0, 3.0, 6.0, 10.0, 20.0, 30.0]
    assert t_s[spaced(cast(Any, fixes), rows[:-1], MatchingConfig(step_time_s=100.0))].tolist() == [0.0, 3.0, 6.0, 28.0]


def test_balises_beyond_an_end_by_what_lists_round_lie_where_their_measure_says() -> None:
    """a is 500 m long, and the path runs against it; half a metre is what surveys and balise lists round."""
    place = site({"a": line((0, 0), (500, 0))})
    balises = pl.DataFrame(
        {
            "balise_id": ["before", "inside", "beyond", "off", "elsewhere"],
            "netelement_id": ["a", "a", "a", "a", "z"],
            "measure_m": [-0.4, 100.0, 500.4, 500.6, 10.0],
            "kind": "physical",
            "location_accuracy_m": 5.0,
            "linked": True,
            "link_reaction": "none",
            "direction": "both",
        }
    )
    fixes = run(np.arange(400.0, 50.0, -10.0), np.zeros(35))
    found = match(fixes, None, place, Vehicle(), MatchingConfig(), FixSigma()).path.balises(balises)
    assert found["balise_id"].to_list() == ["beyond", "inside", "before"]
    assert found["path_m"].to_list() == pytest.approx([-0.4, 400.0, 500.4], abs=1e-3)
    assert found["sense"].to_list() == [-1, -1, -1]
    # Read between epochs each proves its element at the later one; after the last epoch, and off it, none does.
    read_ns = pl.Series("t", [0, 1500, 2500, 3500, 99000], dtype=pl.Int64) * 1_000_000
    stamps = read_ns.cast(pl.Datetime("ns", "UTC"))
    reads = pl.DataFrame({"t": stamps, "balise_id": ["before", "off", "beyond", "elsewhere", "inside"]})
    times_ns = np.arange(6) * 1_000_000_000
    epochs = cast(Any, type("Epochs", (), {"t_ns": times_ns, "__len__": lambda self: 6})())
    own = replace(place, balises=balises)
    assert pins_of(epochs, own, track_of(place.track), reads).tolist() == [0, -1, -1, 0, -1, -1]
    assert pins_of(epochs, own, track_of(place.track), None).tolist() == [-1] * 6
