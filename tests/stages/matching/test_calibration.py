"""Are the claimed probabilities right? A short form of `python -m benchmarks.calibration`, whose seeds are others."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration import Claim, claims, trial
from tests.stages.matching.builders import line, matched, run, site


@pytest.fixture(scope="module")
def found() -> list[Claim]:
    return claims(200, seed=77)


@pytest.mark.parametrize("name", ["gate", "path"])
def test_claims_come_true_as_often_as_they_say(name: str, found: list[Claim]) -> None:
    """Of runs that claim a track with p at least p are right, two standard errors of so few runs allowed for."""
    claimed, right = (
        np.array([getattr(one, name) for one in found]),
        np.array([getattr(one, f"{name}_right") for one in found]),
    )
    for level in (0.7, 0.8, 0.9, 0.95, 0.99):
        count = int((claimed >= level).sum())
        assert count >= 30, level
        allowed = 1.0 - level + 2.0 * np.sqrt(level * (1.0 - level) / count)
        assert (~right[claimed >= level]).mean() <= allowed, level


def test_most_runs_are_on_the_track_that_they_are_said_to_be_on(found: list[Claim]) -> None:
    """The claims are not bought by choosing badly: two of three times it is the nearest that is right."""
    assert np.mean([one.path_right for one in found]) > 0.8


def test_a_constant_offset_is_one_observation() -> None:
    """Positions 1.9 m aside of the true track, its neighbour 4 m away: no number of epochs makes it sure."""
    x = 10.0 * np.arange(500.0)
    found = matched(run(x, np.full(500, 1.9)), site({"a": line((0, 0), (5000, 0)), "b": line((0, 4), (5000, 4))}))
    assert found.epochs["path_probability"].max() < 0.8
    assert found.epochs["gate_probability"].max() < 0.8
    assert found.ambiguous.height == 1


def test_tracks_far_apart_are_told() -> None:
    x = 10.0 * np.arange(100.0)
    found = matched(run(x, np.full(100, 2.0)), site({"a": line((0, 0), (1000, 0)), "b": line((0, 20), (1000, 20))}))
    assert found.epochs["path_probability"].min() >= 0.99


def test_the_bias_shown_on_one_element_counts_on_the_next() -> None:
    """2 m aside for a kilometre where there is one track only; then a second one lies 4 m beside, nearer."""
    elements = {"s": line((0, 0), (1000, 0)), "m": line((1000, 0), (3000, 0)), "b": line((1000, 4), (3000, 4))}
    links = [("s", 1, "m", 0, "both"), ("s", 1, "b", 0, "both")]
    x = np.arange(0.0, 3000.0, 20.0)
    found = matched(run(x, np.full(len(x), 2.1), sigma_m=0.5), site(elements, links)).epochs
    assert found["netelement_id"][-1] == "m"
    assert found["path_probability"][-1] > 0.99


def test_a_trial_is_the_same_every_time() -> None:
    one, again = trial(5), trial(5)
    assert one.fixes.equals(again.fixes)
    assert matched(one.fixes, one.site, one.odometer).path.elements()[0].startswith(tuple("abc"))
