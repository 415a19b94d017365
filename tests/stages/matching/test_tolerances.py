"""How far beside a track a position may lie, and covariances that contradict themselves, worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from pipeline.stages.matching import match
from pipeline.stages.matching.epochs import count_contradictory_covariances, on_track_limit_m
from pipeline.stages.matching.match import read_elements
from pipeline.stages.track.survey import track_of
from schemas.config import FixSigma, MatchingConfig, Vehicle
from tests.stages.matching.builders import line, run, site


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
    assert count_contradictory_covariances(frame) == count


def test_an_element_shorter_than_positions_scatter_is_the_same_way() -> None:
    """At the links of elements of 10 m a position is on any of them; the path is as sure as that of a whole one."""
    ends = [0.0, 480.0, 490.0, 500.0, 510.0, 1000.0]
    elements = {f"e{k}": line((ends[k], 0), (ends[k + 1], 0)) for k in range(5)}
    place = site(elements, [(f"e{k}", 1, f"e{k + 1}", 0, "both") for k in range(4)])
    found = match(
        run(np.arange(100.0, 900.0, 10.0), np.zeros(80)), None, place, Vehicle(), MatchingConfig(), FixSigma()
    )
    assert found.epochs.table["path_probability"].min() >= 0.99
    assert found.epochs.table["gate_probability"].min() >= 0.99


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
    found = match(fixes, None, place, Vehicle(), MatchingConfig(), FixSigma()).path.balises_on_path(balises)
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
    assert read_elements(epochs, own, track_of(place.track), reads).tolist() == [0, -1, -1, 0, -1, -1]
    assert read_elements(epochs, own, track_of(place.track), None).tolist() == [-1] * 6
