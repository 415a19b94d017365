"""Injection against simulation: a fault added afterwards is the fault simulated at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from datasets.faults import FaultSpec
from datasets.inject import inject, inject_all, load_faults
from datasets.trial import build_run, build_site
from pipeline.stages.track.geodesy import earth_centred_m
from schemas.errors import ConfigError, InputError
from schemas.run import RunLog
from tests.datasets.small import BOTH, scenario


def simulated(*faults: dict[str, Any], **settings: Any) -> RunLog:
    spec = scenario({"faults": list(faults), "gnss": {"sky": BOTH}, **settings})
    return build_run(spec, spec.runs[0])


def fault(**values: object) -> FaultSpec:
    return FaultSpec.model_validate(values)


@pytest.fixture(scope="module")
def clean() -> RunLog:
    return simulated()


def gap_m(a: pl.DataFrame, b: pl.DataFrame) -> float:
    columns = ("latitude_deg", "longitude_deg", "height_m")
    ours, theirs = (earth_centred_m(*(frame[c].to_numpy() for c in columns)) for frame in (a, b))
    return float(np.abs(ours - theirs).max())


@pytest.mark.parametrize(
    ("values", "tolerance_m"),
    [
        ({"kind": "ramp", "target": "G03", "start_s": 50.0, "rate_mps": 0.5, "duration_s": 60.0}, 1e-5),
        ({"kind": "step", "target": "G20", "start_s": 50.0, "size_m": 40.0, "duration_s": 10.0}, 1e-5),
        ({"kind": "outage", "target": "galileo", "start_s": 60.0, "duration_s": 20.0}, 1e-5),
        ({"kind": "outage", "target": "G20", "start_s": 60.0, "duration_s": 20.0}, 1e-5),
        ({"kind": "outage", "target": "satellites", "below_deg": 15.0, "start_s": 60.0, "duration_s": 20.0}, 1e-5),
        ({"kind": "bias", "target": "satellites", "below_deg": 25.0, "size_m": 8.0, "start_s": 30.0}, 1e-5),
        # The way that positions show is known to noise and to the chord of 10 m.
        ({"kind": "step", "target": "along", "start_s": 60.0, "size_m": 30.0, "duration_s": 20.0}, 1.0),
        ({"kind": "step", "target": "cross", "start_s": 60.0, "size_m": 10.0, "duration_s": 20.0}, 1.0),
        ({"kind": "ramp", "target": "up", "start_s": 60.0, "rate_mps": 0.1, "duration_s": 20.0}, 1e-6),
        ({"kind": "outage", "start_s": 60.0, "duration_s": 5.0}, 1e-9),
    ],
)
def test_injected_is_simulated(clean: RunLog, values: dict[str, Any], tolerance_m: float) -> None:
    at_once, afterwards = simulated(values), inject(clean, fault(**values))
    assert afterwards.gnss.select("t", "solution").equals(at_once.gnss.select("t", "solution"))
    assert gap_m(afterwards.gnss, at_once.gnss) < tolerance_m
    assert gap_m(afterwards.gnss, clean.gnss) > 0.1 if values["kind"] != "outage" else True
    for column in ("cov_ee_m2", "cov_nu_m2", "hpl_m", "vpl_m"):
        assert (afterwards.gnss[column] - at_once.gnss[column]).abs().max() < 1e-9  # type: ignore[operator]
    assert afterwards.gnss["satellites"].equals(at_once.gnss["satellites"])
    if "target" in values and values["target"] not in ("along", "cross", "up"):
        assert afterwards.satellites is not None
        assert at_once.satellites is not None
        keys = ("t", "solution", "sv", "used")
        assert afterwards.satellites.select(keys).equals(at_once.satellites.select(keys))
        assert (afterwards.satellites["residual_m"] - at_once.satellites["residual_m"]).abs().max() < 1e-9  # type: ignore[operator]
    assert afterwards.faults is not None
    assert afterwards.faults["kind"].to_list() == [values["kind"]]
    assert afterwards.faults["t_start"].equals(at_once.faults["t_start"] if at_once.faults is not None else None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "values",
    [
        {"kind": "slip", "start_s": 60.0, "rate_mps": 2.0, "duration_s": 5.0},
        {"kind": "slide", "start_s": 60.0, "rate_mps": 3.0, "duration_s": 5.0},
        {"kind": "scale", "start_s": 30.0, "scale": 1.01},
        {"kind": "outage", "target": "odometer", "start_s": 60.0, "duration_s": 5.0},
    ],
)
def test_injected_odometer_faults_are_simulated_ones(clean: RunLog, values: dict[str, Any]) -> None:
    at_once, afterwards = simulated(values).odometer, inject(clean, fault(**values)).odometer
    assert at_once is not None
    assert afterwards is not None
    assert afterwards["t"].equals(at_once["t"])
    assert (afterwards["distance_m"] - at_once["distance_m"]).abs().max() < 1e-6  # type: ignore[operator]
    # Simulated speed noise is not scaled with the wheels, recorded noise is.
    assert (afterwards["speed_mps"] - at_once["speed_mps"]).abs().max() < 0.01  # type: ignore[operator]


def test_the_run_given_is_left_untouched(clean: RunLog) -> None:
    before = clean.gnss.clone()
    inject(clean, fault(kind="bias", size_m=10.0, start_s=20.0))
    assert clean.gnss.equals(before)
    assert clean.faults is None


def test_the_site_keeps_a_displaced_position_on_its_track(clean: RunLog) -> None:
    spec = scenario({"gnss": {"sky": BOTH}})
    values = {"kind": "step", "target": "along", "start_s": 60.0, "size_m": 400.0, "duration_s": 10.0}
    with_site = inject(clean, fault(**values), build_site(spec))
    # The error along the track turns with the curve: 400 m of 900 m radius.
    assert gap_m(with_site.gnss, simulated(values).gnss) < 1.5


def test_late_positions_are_those_of_before(clean: RunLog) -> None:
    late = inject(clean, fault(kind="latency", latency_s=0.5, start_s=60.0, duration_s=10.0)).gnss
    now = late.filter(pl.col("solution") == "gps")
    then = clean.gnss.filter(pl.col("solution") == "gps").with_columns(
        pl.col("t") + pl.duration(milliseconds=500, time_unit="ns")
    )
    hit = now.slice(600, 100)
    assert gap_m(hit, then.join(hit.select("t"), on="t", how="semi")) < 1e-6
    assert gap_m(now.slice(0, 600), clean.gnss.filter(pl.col("solution") == "gps").slice(0, 600)) == 0.0


def test_one_solution_alone_may_be_hit(clean: RunLog) -> None:
    hit = inject(clean, fault(kind="bias", size_m=20.0, start_s=20.0, solution="gps")).gnss
    unhit = [frame.filter(pl.col("solution") == "primary") for frame in (hit, clean.gnss)]
    assert unhit[0].equals(unhit[1])
    assert gap_m(hit, clean.gnss) > 10.0


def test_faults_add_up_and_are_recorded(clean: RunLog) -> None:
    faults = [fault(kind="outage", start_s=90.0, duration_s=2.0), fault(kind="bias", size_m=5.0, start_s=20.0)]
    recorded = inject_all(clean, faults).faults
    assert recorded is not None
    assert recorded["kind"].to_list() == ["bias", "outage"]


def test_the_same_noise_every_time_and_not_between_runs(clean: RunLog) -> None:
    burst = fault(kind="noise", sigma_m=5.0, start_s=20.0, duration_s=30.0)
    first, second = inject(clean, burst).gnss, inject(clean, burst).gnss
    assert first.equals(second)
    other = inject(RunLog("other", clean.gnss, odometer=clean.odometer), burst).gnss
    assert gap_m(first, other) > 1.0


def test_what_cannot_be_injected_is_refused(clean: RunLog) -> None:
    bare = RunLog("bare", clean.gnss)
    with pytest.raises(InputError, match="no odometer"):
        inject(bare, fault(kind="slip", rate_mps=1.0, start_s=1.0))
    with pytest.raises(InputError, match="no satellites stream"):
        inject(bare, fault(kind="step", target="G01", size_m=1.0, start_s=1.0))
    with pytest.raises(InputError, match="has no satellite for this fault"):
        inject(clean, fault(kind="step", target="G32", size_m=1.0, start_s=1.0))
    with pytest.raises(ConfigError, match="after the end"):
        inject(clean, fault(kind="bias", size_m=1.0, start_s=1e5))
    with pytest.raises(ConfigError, match="solution"):
        inject(clean, fault(kind="bias", size_m=1.0, start_s=1.0, solution="glonass"))


def test_fault_files(tmp_path: Path) -> None:
    path = tmp_path / "fault.toml"
    path.write_text('[[faults]]\nkind = "ramp"\nstart_s = 10\nrate_mps = 0.5\n')
    assert load_faults(path) == (fault(kind="ramp", start_s=10.0, rate_mps=0.5),)
    path.write_text("faults = []\n")
    with pytest.raises(ConfigError, match="holds no fault"):
        load_faults(path)
    path.write_text('[[faults]]\nkind = "ramp"\n')
    with pytest.raises(ConfigError, match=r"faults\.0"):
        load_faults(path)


def test_late_positions_of_a_slow_log_stay(clean: RunLog) -> None:
    slow = clean.with_streams(gnss=clean.gnss.filter(pl.col("t").dt.epoch("s") % 2 == 0).unique("t", keep="first"))
    slow = slow.with_streams(gnss=slow.gnss.filter(pl.col("t").dt.truncate("2s") == pl.col("t")).sort("t"))
    assert slow.gnss["t"].diff().drop_nulls().dt.total_milliseconds().unique().to_list() == [2000]
    late = inject(slow, fault(kind="latency", start_s=60.0, duration_s=20.0, latency_s=1.0)).gnss
    assert late["t"].equals(slow.gnss["t"])
    assert (late["latitude_deg"] != slow.gnss["latitude_deg"]).sum() == 10


def test_slip_counts_from_its_start(clean: RunLog) -> None:
    assert clean.odometer is not None
    seconds = clean.odometer.filter(pl.col("t").dt.truncate("1s") == pl.col("t"))
    run = clean.with_streams(odometer=seconds)
    first = clean.gnss["t"].min()
    slipped = inject(run, fault(kind="slip", start_s=60.5, duration_s=2.0, rate_mps=3.0)).odometer
    assert slipped is not None
    more = pl.DataFrame(
        {"s": (seconds["t"] - first).dt.total_seconds(), "m": slipped["distance_m"] - seconds["distance_m"]}
    )
    assert more.filter(pl.col("s").is_between(60, 64))["m"].to_list() == pytest.approx([0.0, 1.5, 4.5, 6.0, 6.0])
