"""Negation and return through the whole replay: faults that come back, and what bounds them."""

from __future__ import annotations

import polars as pl
import pytest

from tests.replay.journeys import VEHICLE, journey, replay

SLOW_TRAIN = {"start_m": 200.0, "phases": [{"speed_mps": 12.0}, {"stop_at_m": 7500.0}]}


@pytest.mark.parametrize(("rate_mps", "seed", "reads"), [(0.06, 5, False), (0.1, 11, True)])
def test_a_slow_drift_never_returns_beyond_the_failure_limit(rate_mps, seed, reads):
    """Found a minute after each restart, these drifts used to come back step by step to 33 and 54 m."""
    drift = {"kind": "ramp", "rate_mps": rate_mps, "start_s": 100.0, "duration_s": 540.0}
    run, site = journey(drift, motion=SLOW_TRAIN, seed=seed)
    tables = replay(run if reads else run.with_streams(balise_reads=None), site, VEHICLE)
    modes = tables.epochs["lds_mode"].cast(pl.String)
    assert (modes == "fail_safe").any()
    assert tables.epochs["error_along_m"].max() > 28.0
    assert tables.epochs.filter("tvb")["error_along_m"].abs().max() < 20.0
    assert tables.runs["unsafe_accepted"].to_list() == [0]
