"""Slip that the odometer reports costs its own time, not the run (DOMAIN sections 4 and 5.2)."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.one_run import replay
from schemas.config import Configuration, EvidenceConfig, MonitorConfig, Vehicle
from schemas.run import RunTables
from tests.replay.slip.world import BALISES, LEG_S, READ_M, STAND_S, VEHICLE, Fault, Slip, chainage_m, ride, site, times

SECOND_START_S = LEG_S + STAND_S
SITE = site()
NONE = (0.0, 0.0, 0.0, 0.0)
# Else nothing would be in use before the run has shown it.
KNOWN = Configuration(
    monitors=MonitorConfig(noise_along_m=NONE, noise_cross_m=NONE, noise_up_m=NONE),
    evidence=EvidenceConfig(survey_complete=True),
)


def accepted(tables: RunTables) -> list[str]:
    return tables.passages.filter(status="accepted", kind="virtual")["balise_id"].to_list()


def replayed(
    slip: Slip | None = None,
    fault: Fault | None = None,
    vehicle: Vehicle = VEHICLE,
    *,
    read: bool = False,
    radar: Slip | None = None,
) -> RunTables:
    return replay(ride(slip, fault, read=read, radar=radar), SITE, vehicle, KNOWN)


@pytest.mark.parametrize(
    ("share", "said"),
    [(0.02, Slip()), (0.08, Slip()), (0.08, Slip(flag=False, sigma_mps=0.4)), (-0.08, Slip(flag=False, sigma_mps=0.4))],
    ids=["little", "flag", "sigma", "slide"],
)
def test_slip_stands_until_its_doubt_adds_up(share: float, said: Slip) -> None:
    """Three starts with 12 s of slip or slide; 4.6 m are lost at 8 %, more than the positions' noise explains.

    Each start leaves 5.8 m in doubt, and the anchor is the first TVB: after the second one only a telegram links again.
    """
    slip = Slip(share, flag=said.flag, sigma_mps=said.sigma_mps)
    tables = replayed(slip)
    run = tables.runs.row(0, named=True)
    assert (run["verdict"], run["unsafe_accepted"], run["alarms"]) == ("safe", 0, 0)
    assert accepted(tables) == ["V0", "V1", "V2", "V3"]
    reasons = dict(tables.epochs["withheld_for"].value_counts().rows())
    assert reasons["slip"] == pytest.approx(360, abs=6)
    read = replayed(slip, read=True)
    beyond = [name for name, at_m in BALISES.items() if at_m > READ_M]
    assert accepted(read) == ["V0", "V1", "V2", "V3", *beyond]
    assert read.runs.select("unsafe_accepted", "alarms").row(0) == (0, 0)


def test_slip_that_nobody_reports_is_the_monitors() -> None:
    tables = replayed(Slip(0.08, flag=False))
    assert tables.runs["alarms"].item() >= 1
    assert "slip" not in set(tables.epochs["withheld_for"])


@pytest.mark.parametrize("size_m", [16.0, -16.0, 60.0])
def test_a_fault_during_slip_does_not_get_through(size_m: float) -> None:
    """From 5 s into the second start to the end: no balise after it, no TVB that is wrong, no alarm to see it by."""
    tables = replayed(Slip(0.08), Fault(SECOND_START_S + 5.0, size_m))
    assert accepted(tables) == ["V0", "V1", "V2", "V3"]
    assert tables.runs["unsafe_accepted"].item() == 0
    tvb_m = tables.epochs["error_along_m"].filter(tables.epochs["tvb"]).abs().max()
    assert isinstance(tvb_m, float)
    assert tvb_m < 10.0


@pytest.mark.parametrize("after_s", [0.1, 0.4, 5.0])
def test_a_fault_right_after_slip_is_found_at_once(after_s: float) -> None:
    """The bank begins with the first epoch after the slip, 12.1 s after the start."""
    tables = replayed(Slip(0.08), Fault(SECOND_START_S + 12.1 + after_s, 25.0))
    # Two starts leave more in doubt than a re-link may explain.
    assert accepted(tables) == ["V0", "V1", "V2", "V3"]
    detected_s = (tables.alarms["t_start"][0] - tables.epochs["t"][0]).total_seconds()
    assert detected_s == pytest.approx(SECOND_START_S + 12.1 + after_s, abs=0.15)


def test_after_too_much_slip_only_a_telegram_links_again() -> None:
    """25 s and 250 m of slip at each start: 25 m in doubt, more than half the failure limit."""
    assert accepted(replayed(Slip(0.02, lasts_s=25.0))) == []
    tables = replayed(Slip(0.02, lasts_s=25.0), read=True)
    # From the read in the second leg to the next start.
    fast = [name for name, at_m in BALISES.items() if READ_M < at_m < 3250.0]
    assert accepted(tables) == fast
    assert tables.runs["verdict"].item() == "safe"


LONG = Slip(0.08, lasts_s=25.0)
DRY = Slip(0.0, lasts_s=0.0)


def test_a_second_odometer_counts_the_way_over_long_slip() -> None:
    """250 m of slip at each start, 20 m counted too much. V4 lies in the second, V8 at 100 m in the third."""
    tables = replayed(LONG, radar=DRY)
    assert tables.runs["verdict"].item() == "safe"
    in_slip = {name for name, at_m in BALISES.items() if (at_m - 50.0) % 1600.0 <= 250.0}
    assert accepted(tables) == [name for name in BALISES if name not in in_slip]
    assert accepted(replayed(LONG, Fault(SECOND_START_S + 5.0, 20.0), radar=DRY)) == ["V1", "V2", "V3"]


def test_a_second_odometer_that_slips_too_counts_nothing() -> None:
    assert accepted(replayed(LONG, radar=LONG)) == []


def test_without_a_vehicle_file_only_a_telegram_links_again() -> None:
    assert accepted(replayed(Slip(0.02), vehicle=Vehicle())) == []
    assert accepted(replayed(Slip(0.02), vehicle=Vehicle(), read=True)) != []


@pytest.mark.parametrize("size_m", [0.0, 25.0])
def test_a_fault_in_a_pause_of_speeds_does_not_get_through(size_m: float) -> None:
    """No row for 3 s, 60 s after the second start; from the middle of the pause to the end the position is ahead."""
    begin_s = SECOND_START_S + 60.0
    whole = ride(fault=Fault(begin_s + 1.5, size_m))
    assert whole.odometer is not None
    at_s = (pl.col("t") - whole.odometer["t"][0]).dt.total_nanoseconds() * 1e-9
    speeds = whole.odometer.with_columns(distance_m=pl.lit(None, pl.Float64))
    paused = whole.with_streams(odometer=speeds.filter(~at_s.is_between(begin_s, begin_s + 3.0, closed="none")))
    tables = replay(paused, SITE, VEHICLE, KNOWN)
    after = [name for name, at_m in BALISES.items() if at_m > chainage_m(np.array([begin_s]))[0]]
    assert (set(after) <= set(accepted(tables))) == (size_m == 0.0)
    assert tables.runs["unsafe_accepted"].item() == 0
    # Until the odometer is back nothing along the track can see it.
    assert tables.runs["hazardous_s"].item() <= 1.6


def test_the_world_is_as_described() -> None:
    t_s = times()
    true_m = chainage_m(t_s)
    assert np.diff(true_m).min() >= 0.0
    assert true_m[-1] == pytest.approx(50.0 + 3 * 1600.0)
    odometer = ride(Slip(0.08)).odometer
    assert odometer is not None
    counted_m = odometer["distance_m"].to_numpy()
    # 8 % of 57.6 m at each of three starts; the noise is 0.02 m per root second.
    assert counted_m[-1] - (true_m[-1] - true_m[0]) == pytest.approx(3 * 0.08 * 57.6, abs=2.0)
    assert odometer.filter("slip").height == pytest.approx(360, abs=3)
    assert isinstance(SITE.balises, pl.DataFrame)
