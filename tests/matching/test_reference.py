"""The reference by itself on the network: where it was, and which tracks it leaves possible."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.matching.match import Match
from pipeline.matching.reference import match_reference
from schemas.arrays import Floats
from schemas.config import HazardConfig, MatchingConfig
from schemas.run import Site
from tests.matching.builders import line, run, site

TRACKS = site(
    {"a": line((0, 0), (1000, 0)), "b": line((1000, 0), (2000, 0)), "c": line((0, 4), (2000, 4))},
    [("a", 1, "b", 0, "both")],
)
X_M = np.arange(100.0, 1900.0, 20.0)


def placed(y_m: Floats, sigma_m: float | None, place: Site = TRACKS) -> Match | None:
    sigma = pl.Series("sigma_m", [sigma_m] * len(X_M), dtype=pl.Float64)
    stream = run(X_M, y_m).select("t", "latitude_deg", "longitude_deg", "height_m").with_columns(sigma)
    return match_reference(stream, place, MatchingConfig(), HazardConfig())


def possible(found: Match, epoch: int, limit: float = 0.001) -> list[str]:
    """Names of the net elements possible at an epoch."""
    names = list(dict.fromkeys(found.path.track.ids))
    rows, elements = found.rivals(limit, {name: number for number, name in enumerate(names)})
    return [names[element] for element in elements[rows == epoch]]


def test_an_exact_reference_leaves_one_track() -> None:
    found = placed(0.0 * X_M, 0.05)
    assert found is not None
    assert np.allclose(found.epochs["path_m"], X_M, atol=1e-3)
    assert all(possible(found, epoch) for epoch in range(len(X_M)))
    assert possible(found, 5) == ["a"]
    assert possible(found, len(X_M) - 5) == ["b"]


def test_an_exact_reference_whose_antenna_is_aside_is_on_its_track() -> None:
    found = placed(np.full(len(X_M), 0.4), 0.02)
    assert found is not None
    assert found.epochs["on_track"].all()
    assert "a" in possible(found, 5)


@pytest.mark.parametrize("sigma_m", [2.0, None])
def test_a_coarse_reference_leaves_both(sigma_m: float | None) -> None:
    found = placed(np.full(len(X_M), 1.8), sigma_m)
    assert found is not None
    assert possible(found, 5) == ["a", "c"]


def test_the_path_s_own_element_is_there_whatever_the_limit() -> None:
    found = placed(np.full(len(X_M), 2.0), 2.0)
    assert found is not None
    assert [possible(found, k, 0.999)[0] for k in range(len(X_M))] == found.epochs["netelement_id"].to_list()


def test_on_one_chain_there_is_its_own_element_only() -> None:
    found = placed(0.0 * X_M, 5.0, site({"a": line((0, 0), (2000, 0))}))
    assert found is not None
    assert possible(found, 3) == ["a"]


def test_a_reference_beside_every_track_is_no_witness() -> None:
    assert placed(np.full(len(X_M), 400.0), 1.0) is None
    assert placed(np.full(len(X_M), np.nan), 1.0) is None
