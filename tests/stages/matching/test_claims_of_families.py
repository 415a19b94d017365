"""Are claims right in any network? A short form of `python -m benchmarks.truth.tracks`, whose seeds are others."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.truth import topologies
from benchmarks.truth.calibration import stated
from benchmarks.truth.tracks import CLAIM_S, FAMILIES, outcome


@pytest.mark.parametrize("family", FAMILIES)
def test_no_wrong_track_is_claimed(family: str) -> None:
    found = [outcome(family, seed) for seed in (501, 502)]
    assert max(one.live_wrong_s for one in found) < CLAIM_S
    assert max(one.later_wrong_s for one in found) < CLAIM_S


@pytest.mark.parametrize("family", ["ladder yard", "junction", "throat", "ring"])
def test_where_tracks_part_they_are_claimed(family: str) -> None:
    one = outcome(family, 503)
    assert one.live_s > 0.3 * one.total_s


def test_beside_platforms_a_receiver_that_states_its_sigma_claims_no_other_track(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """5.5 m aside with a sigma of 2.2 m: with the 1 m of a table in its place the neighbour is claimed."""

    def right(rng: np.random.Generator, sigma_m: float) -> float:
        stated(rng, sigma_m)
        return sigma_m

    monkeypatch.setattr(topologies, "stated", right)
    assert topologies.judge("station", 100_014).sure_and_wrong == 0.0
