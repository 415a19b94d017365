"""Faults that follow a file, and where along faults put a position on curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.faults import FaultSpec, fault_offset_m, faults_table
from datasets.inject import inject, load_faults
from pipeline.one_run import monitor_alone, replay
from pipeline.studies.undetected.profile import epoch_of, profile_at
from schemas.config import Configuration
from schemas.errors import ConfigError, UsageError
from tests.replay.journeys import VEHICLE, journey
from tests.studies.undetected.test_replay import ONE_HZ

TABLE = "t_s,size_m\n10.0,0.0\n20.0,5.0\n30.0,-1.0\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "p.csv").write_text(TABLE)
    fault = tmp_path / "fault.toml"
    fault.write_text('[[faults]]\nkind = "profile"\nprofile = "p.csv"\n')
    return fault


def test_a_profile_runs_in_straight_lines_from_row_to_row(file: Path) -> None:
    (fault,) = load_faults(file)
    at_s = np.array([0.0, 10.0, 15.0, 20.0, 25.0, 30.0, 99.0])
    found = fault_offset_m(fault, at_s, np.random.default_rng(0))
    assert found.tolist() == [0.0, 0.0, 2.5, 5.0, 2.0, -1.0, -1.0]
    assert faults_table([fault], 0, 100_000_000_000)["size"].item() == 5.0


@pytest.mark.parametrize("text", ["t_s,size_m\n", "t_s,size_m\n2,1\n1,1\n", "t,size\n1,1\n", "t_s,size_m\n1,x\n", ""])
def test_what_is_no_profile_is_one_error(file: Path, text: str) -> None:
    (file.parent / "p.csv").write_text(text)
    (fault,) = load_faults(file)
    with pytest.raises(ConfigError, match=r"p\.csv"):
        fault_offset_m(fault, np.zeros(1), np.random.default_rng(0))


def test_a_fault_along_the_site_moves_the_position_on_its_path_and_not_beside_it() -> None:
    run, site = journey(gnss=ONE_HZ)
    before = replay(run, site, VEHICLE).epochs
    step = FaultSpec.model_validate({"kind": "step", "target": "along", "start_s": 0.0, "size_m": 18.0})
    after = replay(inject(run, step, site), site, VEHICLE).epochs
    assert ((after["path_m"] - before["path_m"]) - 18.0).abs().max() < 0.01
    assert (after["cross_track_m"] - before["cross_track_m"]).abs().max() < 0.01


def test_there_is_no_profile_where_nothing_watched() -> None:
    run, site = journey(gnss=ONE_HZ)
    monitored = monitor_alone(run, site, VEHICLE, Configuration(), "primary")
    with pytest.raises(UsageError, match="epoch 0"):
        profile_at(monitored, 0, False)
    found = profile_at(monitored, 60, False)
    # The fault grows since the last balise read before its epoch.
    epoch_t = run.gnss["t"][60]
    assert found.t.to_list() == [run.balise_reads.filter(pl.col("t") < epoch_t)["t"].max(), epoch_t]
    with pytest.raises(UsageError, match="--balise VB99: was not passed in this run; expected") as refused:
        epoch_of(monitored, "VB99", None)
    named = str(refused.value).partition("expected ")[2].rstrip(".").split(", ")
    assert all(epoch_of(monitored, balise, None) > 0 for balise in named), "what is proposed can be asked for"
    behind = profile_at(monitored, 60, True)
    assert found.fault["size_m"][-1] == pytest.approx(found.error_m)
    assert behind.fault["size_m"][-1] == pytest.approx(-behind.error_m)
    assert found.fault["size_m"][0] == 0.0
    assert found.fault["t_s"].dtype == pl.Float64
