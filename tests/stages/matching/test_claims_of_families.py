"""Are claims right in any network? A short form of `python -m benchmarks.tracks`, whose seeds are others."""

from __future__ import annotations

import pytest

from benchmarks.tracks import CLAIM_S, FAMILIES, outcome


@pytest.mark.parametrize("family", FAMILIES)
def test_no_wrong_track_is_claimed(family: str) -> None:
    found = [outcome(family, seed) for seed in (501, 502)]
    assert max(one.live_wrong_s for one in found) < CLAIM_S
    assert max(one.later_wrong_s for one in found) < CLAIM_S


@pytest.mark.parametrize("family", ["ladder yard", "junction", "throat", "ring"])
def test_where_tracks_part_they_are_claimed(family: str) -> None:
    one = outcome(family, 503)
    assert one.live_s > 0.3 * one.total_s
