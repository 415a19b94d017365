"""A run that leaves the surveyed network is no shift of a datum; a run wholly beside it by one shift is."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.studies.plausibility.check import Check
from pipeline.studies.plausibility.fit import fit_run
from schemas.config import PlausibilityConfig, Vehicle
from schemas.inputs import Gnss
from schemas.run import RunLog
from tests.replay.test_shunting import stream
from tests.stages.matching import builders


def journey(seed: int) -> np.ndarray:
    """Twelve kilometres at 20 m/s, one position a second; the heading changes every 400 m."""
    heading = np.repeat(np.cumsum(np.random.default_rng(seed).normal(0.0, 0.6, 30)), 20)
    return np.cumsum(20.0 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)


def against_survey(places: np.ndarray, surveyed: np.ndarray) -> Check:
    run = RunLog("walk", stream(Gnss, builders.run(places[:, 0], places[:, 1], 1.0)))
    checks = fit_run(run, "primary", Vehicle(), PlausibilityConfig(), builders.site({"a": surveyed})).checks
    return next(check for check in checks if check.what == "positions against the survey")


@pytest.mark.parametrize(("seed", "fifth"), [(0, 4), (5, 2), (6, 0), (8, 0)])
def test_a_run_of_which_four_fifths_leave_the_network_tells_no_shift(seed: int, fifth: int) -> None:
    """Each of these was reported as shifted by 1 to 4 km."""
    places = journey(seed)
    found = against_survey(places, places[fifth * 120 : (fifth + 1) * 120])
    assert not found.causes


@pytest.mark.parametrize("seed", [0, 4, 6])
def test_one_shift_of_a_run_off_the_network_is_reported(seed: int) -> None:
    places = journey(seed)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, places.shape)
    found = against_survey(places + noise, places - np.array([131.0, 68.0]))
    assert "the survey lies 131 m west, 68 m south of them" in found.found
