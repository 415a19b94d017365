"""Outages and slow drifts with noise, through matching, alignment, bank and LDS; the truth is the generator's own."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.relink import Journey, Outcome, journey, lds_of, outcome, ramp
from pipeline.stages.lds import LdsResult
from schemas.config import Configuration, LdsConfig, Vehicle

CONFIG = Configuration()
LOST_S = 600


def tunnel(seed: int, gap_s: int, offset_m: float) -> Journey:
    """No position for `gap_s` from 600 s on; from its end on the position is off along the track."""
    fault_m = np.zeros(LOST_S + gap_s + 200)
    fault_m[LOST_S : LOST_S + gap_s] = np.nan
    fault_m[LOST_S + gap_s :] = offset_m
    return journey(np.random.default_rng(seed), np.arange(float(fault_m.size)), fault_m, 1.0 + seed % 2)


def accepted_after(made: Journey, lds: LdsResult) -> int:
    since_s = (pl.col("t_offered") - made.run.gnss["t"][0]).dt.total_seconds()
    return lds.passages.filter(pl.col("status") == "accepted", since_s >= LOST_S).height


@pytest.mark.parametrize("gap_s", [5, 40, 90, 300])
@pytest.mark.parametrize("seed", [1, 2])
def test_an_offset_that_comes_out_of_an_outage_is_never_accepted(seed: int, gap_s: int) -> None:
    made = tunnel(seed, gap_s, 0.0)
    _, healthy = lds_of(made, CONFIG)
    assert accepted_after(made, healthy) >= 5
    assert not healthy.epochs.alarm.any()
    for offset_m in (30.0, -30.0):
        made = tunnel(seed, gap_s, offset_m)
        _, off = lds_of(made, CONFIG)
        assert accepted_after(made, off) == 0
        assert off.epochs.alarm[LOST_S]


@pytest.mark.parametrize("gap_s", [40, 90])
def test_without_a_vehicle_file_a_long_outage_ends_the_use_of_the_position(gap_s: int) -> None:
    for offset_m in (0.0, 30.0):
        made = tunnel(4, gap_s, offset_m)
        _, lds = lds_of(made, CONFIG, Vehicle())
        used = gap_s == 40 and offset_m == 0.0
        assert (accepted_after(made, lds) > 0) == used
        assert (lds.epochs.negated[-1] or lds.epochs.withheld[-1]) is not used


def test_slow_drifts_after_a_return() -> None:
    """10 random drifts (three without re-link: none is in use again): after a return none is in use beyond 20 m."""

    def outcomes(config: LdsConfig, drifts: int) -> list[Outcome]:
        return [outcome(ramp(seed, 1.0 + seed % 2), Configuration(lds=config)) for seed in range(drifts)]

    assert not any(one.returned for one in outcomes(LdsConfig(relink=False), 3))
    by_rule = outcomes(LdsConfig(), 10)
    assert sum(one.negated for one in by_rule) >= 8
    assert any(one.returned for one in by_rule)
    assert max(one.beyond_s for one in by_rule) == 0.0


@pytest.mark.parametrize("seed", [32, 1052, 2012])
def test_a_drift_found_late_does_not_come_back(seed: int) -> None:
    """0.029 to 0.037 m/s: by an anchor 300 s before the alarm all are in use again beyond 20 m, for 335 s or more."""
    found = outcome(ramp(seed, 1.0 + seed % 2), CONFIG)
    assert found.negated
    assert found.beyond_s == 0.0


@pytest.mark.parametrize("rate_mps", [0.06, -0.1])
def test_a_drift_found_in_time_does_not_come_back(rate_mps: float) -> None:
    drift_m = np.clip(rate_mps * np.maximum(np.arange(1_800.0) - 700.0, 0.0), -40.0, 40.0)
    made = journey(np.random.default_rng(5), np.arange(1_800.0), drift_m, 1.0)
    aligned, lds = lds_of(made, CONFIG)
    error_m = np.abs(aligned.path_m - made.true_m)
    assert lds.epochs.negated.any()
    assert error_m[~lds.epochs.negated].max() < 20.0
