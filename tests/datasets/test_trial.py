"""Trials as a whole: reproducible to the byte, true to their scenario."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.line import build_line
from datasets.motion import build_motion
from datasets.scenario import Scenario, load_scenario
from datasets.trial import build_run, build_site, write_run_as, write_trial
from pipeline.read.ingest.run import read_run
from pipeline.read.site.read import read_site
from pipeline.stages.track.geodesy import earth_centred_m
from schemas.config import IngestConfig, settings_from
from schemas.errors import ConfigError, OutputError
from schemas.run import STREAMS, RunLog
from tests.datasets.small import BOTH, GPS_ONLY, scenario

STEP = {"kind": "step", "at_m": 1500.0, "duration_s": 3.0, "size_m": 200.0}


def run_of(spec: Scenario, number: int = 0) -> RunLog:
    return build_run(spec, spec.runs[number])


def xyz(frame: pl.DataFrame) -> np.ndarray:
    return earth_centred_m(*(frame[name].to_numpy() for name in ("latitude_deg", "longitude_deg", "height_m")))


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_one_seed_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    spec = scenario({"faults": [STEP]}, {"gnss": {"sky": BOTH}}, {"log": "json"})
    for name in ("first", "second"):
        write_trial(spec, tmp_path / name)
    write_trial(spec.model_copy(update={"seed": 8}), tmp_path / "other")
    first, other = files(tmp_path / "first"), files(tmp_path / "other")
    assert files(tmp_path / "second") == first
    assert other.keys() == first.keys()
    assert {name for name in first if first[name] == other[name]} == {
        "runs/run0/faults.parquet",
        "site/balises.parquet",
        "site/links.parquet",
        "site/track.parquet",
    }


def test_a_run_does_not_depend_on_the_others() -> None:
    """Neither on how many there are nor on what the one before it draws."""
    one = run_of(scenario({}, {"faults": [STEP]}, {}), 1)
    other = run_of(scenario({"faults": [STEP], "gnss": {"sky": GPS_ONLY}}, {"faults": [STEP]}), 1)
    for name in STREAMS:
        ours, theirs = one.stream(name), other.stream(name)
        assert (ours is None) == (theirs is None)
        assert ours is None or theirs is None or ours.equals(theirs)


@pytest.mark.parametrize("log", ["parquet", "json"])
def test_what_is_written_is_what_is_read(tmp_path: Path, log: str) -> None:
    spec = scenario({"log": log, "faults": [STEP], "gnss": {"sky": GPS_ONLY}})
    (path,) = write_trial(spec, tmp_path)
    built, read = run_of(spec), read_run(path, IngestConfig())
    assert read.run_id == "run0"
    for name in STREAMS:
        ours, theirs = built.stream(name), read.stream(name)
        assert (ours is None) == (theirs is None), name
        if ours is not None and theirs is not None:
            assert theirs.drop(pl.selectors.float()).equals(ours.drop(pl.selectors.float())), name
            for column in ours.select(pl.selectors.float()).columns:
                assert theirs[column].null_count() == ours[column].null_count()
                gap = (theirs[column] - ours[column]).abs().max()
                assert gap is None or gap < 1e-12, (name, column)
    site = read_site(tmp_path / "site")
    assert [finding for finding in site.findings if finding.severity == "error"] == []
    assert site.track.equals(build_site(spec).track)
    assert load_scenario(tmp_path / "scenario.toml") == spec


def test_errors_have_the_stated_covariance_about_the_truth() -> None:
    settings = {"sigma_east_m": 1.0, "sigma_north_m": 2.0, "sigma_up_m": 3.0}
    runs = [scenario({"gnss": settings}, seed=seed) for seed in range(40)]
    gaps = []
    for spec in runs:
        run = run_of(spec)
        truth = run.reference.filter(pl.col("t").is_in(run.gnss["t"].implode())) if run.reference is not None else None
        assert truth is not None
        assert truth.height == run.gnss.height
        gaps.append(np.linalg.norm(xyz(run.gnss) - xyz(truth), axis=1))
    assert run.gnss.row(0, named=True)["cov_nn_m2"] == pytest.approx(4.0)
    assert np.mean(np.square(gaps)) == pytest.approx(1.0 + 4.0 + 9.0, rel=0.15)


def test_positions_are_as_old_as_the_latency_says() -> None:
    quiet = {"sigma_east_m": 1e-6, "sigma_north_m": 1e-6, "sigma_up_m": 1e-6}
    spec = scenario({"gnss": {**quiet, "latency_s": 0.3}, "reference": {"sigma_m": 0.0}})
    run = run_of(spec)
    assert run.reference is not None
    then = run.reference.with_columns(pl.col("t") + pl.duration(milliseconds=300, time_unit="ns"))
    pairs = run.gnss.join(then, on="t", how="inner", suffix="_true")
    assert pairs.height > 1000
    gap = (pairs["latitude_deg"] - pairs["latitude_deg_true"]).abs().max()
    assert gap == pytest.approx(0.0, abs=1e-10)


def test_a_leap_follows_the_track_for_its_three_seconds() -> None:
    quiet = {"sigma_east_m": 1e-6, "sigma_north_m": 1e-6, "sigma_up_m": 1e-6}
    spec = scenario({"gnss": quiet, "faults": [STEP]})
    run, line, motion = run_of(spec), build_line(spec.line), build_motion(spec.runs[0].motion)
    assert run.faults is not None
    t_s = (run.gnss["t"] - run.gnss["t"][0]).dt.total_nanoseconds().to_numpy() / 1e9
    begin_s = (run.faults["t_start"][0] - run.gnss["t"][0]).total_seconds()
    hit = (t_s >= begin_s - 1e-9) & (t_s < begin_s + 3.0 - 1e-9)
    assert hit.sum() == 30
    assert motion.chainage_m(np.array([begin_s]))[0] == pytest.approx(1500.0, abs=2.5)
    places = line.places_at(motion.chainage_m(t_s) + np.where(hit, 200.0, 0.0))
    gap = xyz(run.gnss) - earth_centred_m(places.latitude_deg, places.longitude_deg, places.height_m)
    assert np.abs(gap).max() < 1e-4


def test_lost_epochs_are_missing_or_rows_without_fix() -> None:
    outage = {"kind": "outage", "start_s": 40.0, "duration_s": 4.0}
    whole, thin, kept = (
        run_of(scenario({"faults": faults, "gnss": {"keep_lost": keep}})).gnss
        for faults, keep in (([], False), ([outage], False), ([outage], True))
    )
    assert whole.height - thin.height == 40
    assert kept.height == whole.height
    lost = kept.filter(pl.col("fix") == "none")
    assert lost.height == 40
    assert lost.select("latitude_deg", "hpl_m", "cov_ee_m2").null_count().row(0) == (40, 40, 40)


def test_the_antenna_sits_where_the_vehicle_says() -> None:
    spec = scenario({"reference": {"sigma_m": 0.0}}, vehicle={"gnss_antenna_ahead_m": 7.0, "antenna_height_m": 4.0})
    run = run_of(spec)
    assert run.reference is not None
    places = build_line(spec.line).places_at(np.array([207.0]))
    gap = xyz(run.reference.head(1)) - earth_centred_m(places.latitude_deg, places.longitude_deg, places.height_m)
    assert np.linalg.norm(gap) == pytest.approx(4.0, abs=1e-3)


def test_odometer_scale_noise_and_standstill() -> None:
    spec = scenario(*[{"odometer": {"scale": 1.01, "rate_hz": 20.0}}] * 40)
    totals = []
    for number in range(40):
        odometer = run_of(spec, number).odometer
        assert odometer is not None
        totals.append(odometer["distance_m"][-1])
        assert odometer["speed_mps"][:100].abs().max() == 0.0
    moving_s = build_motion(spec.runs[0].motion).duration_s - 10.0
    assert np.mean(totals) == pytest.approx(2800.0 / 1.01, abs=0.5)
    assert np.std(totals) == pytest.approx(0.05 * np.sqrt(moving_s), rel=0.3)


def test_odometer_counts_down_with_negative_polarity() -> None:
    odometer = run_of(scenario({"odometer": {"polarity": -1}})).odometer
    assert odometer is not None
    assert odometer["distance_m"][-1] < -2700.0
    assert odometer["speed_mps"].mean() < 0.0  # type: ignore[operator]


def test_streams_are_left_out_as_told() -> None:
    run = run_of(scenario({"odometer": False, "reference": False}))
    assert run.odometer is None
    assert run.reference is None
    assert run.faults is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"runs": [{"motion": {"start_m": 0.0, "phases": [{"hold_s": 1.0}]}}]}, "speed_mps or stop_at_m"),
        ({"seed": -1}, "seed"),
        ({"colour": "red"}, "colour"),
        ({"runs": [{}, {"id": "run0"}]}, "repeated"),
        ({"runs": [{"faults": [{"kind": "outage", "start_s": 1.0, "at_m": 3.0}]}]}, "start_s or at_m"),
        ({"start": "2025-03-03T06:00:00"}, "time zone"),
    ],
)
def test_scenarios_that_break_their_contract_are_refused(data: dict[str, object], message: str) -> None:
    good = scenario({}).model_dump()
    runs = [{**good["runs"][0], **change} for change in data.get("runs", [{}])]  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=message):
        settings_from({**good, **data, "runs": runs}, Scenario, "scenario.toml")


def test_common_settings_hold_for_runs_that_say_nothing_else() -> None:
    spec = scenario({"gnss": {"latency_s": 0.1}}, {"odometer": False}, gnss={"rate_hz": 5.0}, odometer={"scale": 1.1})
    assert [(run.gnss.rate_hz, run.gnss.latency_s) for run in spec.runs] == [(5.0, 0.1), (5.0, 0.0)]
    assert spec.runs[0].odometer is not False
    assert spec.runs[0].odometer.scale == 1.1
    assert spec.runs[1].odometer is False


def test_an_unwritable_place_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_trial(scenario({}), tmp_path / "file")


def test_a_run_replaces_the_one_before_it(tmp_path: Path) -> None:
    spec = scenario({})
    run = build_run(spec, spec.runs[0])
    assert run.reference is not None
    write_run_as(run, tmp_path / "run")
    write_run_as(run.with_streams(reference=None), tmp_path / "run")
    assert read_run(tmp_path / "run", IngestConfig()).reference is None
