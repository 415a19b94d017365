"""States of the LDS through the whole replay, the first that applies: P1 wrong in use, P2 negated, P3 faulty, P0."""

from __future__ import annotations

import polars as pl
import pytest

from schemas.config import Configuration, Vehicle
from schemas.tables import ALL_MONITORS
from tests.replay.journeys import QUIET, VEHICLE, journey, replay, seconds
from tests.stages.alignment.straight import NO_NOISE

# The wheel counts 1 m for 1.08 m, and the vehicle file admits it: no increment monitor can see that.
WORN = {"scale": 1.08}
ADMITTED = Vehicle(odometer_scale=1.0, odometer_scale_sigma=0.05, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002)
# 8 % of the distance counted exceed 5 m + 5 % of it from here on.
BEYOND_M = 5.0 / 0.03


def states(odometer, vehicle, *faults, disabled=(), reads=True, **settings):
    run, site = journey(*faults, odometer=odometer, **settings)
    run = run if reads else run.with_streams(balise_reads=None)
    config = Configuration.model_validate({"monitors": {"disabled": list(disabled), **NO_NOISE}})
    return replay(run, site, vehicle, config)


def test_odometer_error_beyond_5_m_and_5_percent_since_the_lrvb_is_p3():
    # Without the reads, which such an odometer carries to where the reference is not.
    tables = states(WORN, ADMITTED, disabled=["link_distance"], reads=False)
    epochs = tables.epochs.filter(pl.col("distance_from_lrvb_m").is_not_null() & (pl.col("lds_mode") == "linked"))
    chainage_m = pl.col("distance_from_lrvb_m")
    # Both ends of the way are known by the reference to a metre or so, most of it for its clock.
    within, beyond = epochs.filter(chainage_m < BEYOND_M - 15.0), epochs.filter(chainage_m > BEYOND_M + 130.0)
    assert min(within.height, beyond.height) > 400
    assert set(within["lds_state"]) == {"P0"}
    assert set(beyond["lds_state"]) == {"P3"}
    row = tables.runs.row(0, named=True)
    assert row["share_p3"] == pytest.approx((tables.epochs["lds_state"] == "P3").mean(), abs=0.001)
    assert row["share_p0"] + row["share_p3"] == pytest.approx(1.0)
    # The position is right all along: nothing of this is a hazard.
    assert tables.hazards.height == 0


def test_negated_comes_before_a_faulty_diagnosis():
    """The linking monitor finds the same odometer; while the position is negated the state is P2, nearer P3."""
    tables = states(WORN, ADMITTED)
    negated = tables.epochs.filter(pl.col("lds_mode") == "fail_safe")
    assert negated.height > 100
    assert set(negated["lds_state"]) == {"P2"}
    assert "P3" in set(tables.epochs.filter(pl.col("distance_from_lrvb_m") > BEYOND_M + 15.0)["lds_state"])


def test_an_odometer_that_slips_within_its_confidence_is_p0_again_after_the_recovery():
    """30 m lost, found at once; since the LRVB, 2 km before, that is within 5 m + 5 %."""
    slip = {"kind": "slip", "rate_mps": 15.0, "start_s": 150.0, "duration_s": 2.0}
    tables = states({}, VEHICLE, slip)
    phases = tables.epochs["lds_state"].rle().struct.unnest()
    assert phases.filter(pl.col("len") > 5)["value"].to_list() == ["P0", "P2", "P0"]
    assert tables.hazards.height == 0


def test_position_off_by_more_than_the_failure_limit_and_not_negated_is_p1():
    """A ramp that no monitor sees is P1 from 20 m on."""
    ramp = {"kind": "ramp", "rate_mps": 0.5, "start_s": 100.0, "duration_s": 80.0}
    all_but_raw = [monitor.name for monitor in ALL_MONITORS if monitor.scale != "raw"]
    tables = states({}, VEHICLE, ramp, disabled=all_but_raw, gnss=QUIET)
    failed = tables.epochs.filter(pl.col("lds_state") == "P1")
    assert failed["error_along_m"].min() > 20.0
    # 1.3 m later at most: the clock of the reference is known to 0.04 s or so.
    assert seconds(tables, "t_failure") == pytest.approx([142.3], abs=1.3)
    assert tables.epochs.filter(pl.col("judgement") == "wrong").height == failed.height > 300


def test_without_an_odometer_the_state_is_p3_throughout():
    run, site = journey()
    tables = replay(run.with_streams(odometer=None), site, VEHICLE)
    assert set(tables.epochs["lds_state"]) == {"P3"}
    assert not tables.epochs["tvb"].any()
    assert tables.runs["false_alarm_rate_per_h"].to_list() == [None]
    assert tables.runs["balises_accepted"].item() == 8
