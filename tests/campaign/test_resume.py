"""A campaign that is complete is known to be so by the state of files; contents decide where that has changed."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import storage
from pipeline.campaign import make_plan, resume, run_campaign
from pipeline.campaign.compact import compact
from pipeline.campaign.outcome import failure_of
from pipeline.campaign.verify import verify
from pipeline.campaign.waits import WAITS
from pipeline.results import store
from schemas.config import Configuration, LdsConfig
from schemas.errors import InputError
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial


@pytest.fixture
def settled(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[SmallTrial, Path]:
    """A trial and its result of one run, complete by whatever campaign; files count as settled at once."""
    monkeypatch.setattr(WAITS, "settled_s", 0.0)
    trial = SmallTrial(small_trial.site, tmp_path / "runs")
    shutil.copytree(small_trial.paths[0], trial.runs / "run0")
    assert run_campaign(plan_of(trial, tmp_path / "out")).count_skipped == 0
    return trial, tmp_path / "out"


def never(*_: object, **__: object) -> None:
    raise AssertionError("is asked")


def test_nothing_is_opened_where_nothing_changed(
    settled: tuple[SmallTrial, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, out = settled
    plan = plan_of(trial, out)
    (whole,) = run_campaign(plan).outcomes
    for place in ("pipeline.results.marker.metadata_of", f"{store.__name__}.read_table"):
        monkeypatch.setattr(place, never)
    monkeypatch.setattr(storage, "file_digests", never)
    monkeypatch.setattr("pipeline.campaign.run.write_campaign", lambda *_: None)
    (known,) = run_campaign(plan).outcomes
    assert (known.skipped, known.run_id, known.verdict) == (True, "run0", whole.verdict)


@pytest.mark.parametrize("change", ["log", "same size and time", "marker", "configuration", "catalogue", "damaged"])
def test_whatever_changed_is_looked_into(settled: tuple[SmallTrial, Path], change: str) -> None:
    trial, out = settled
    log, marker = trial.runs / "run0/odometer.parquet", out / "runs/run_id=run0/runs.parquet"
    config, stat = Configuration(), log.stat()
    match change:
        case "log":
            log.unlink()
        case "same size and time":
            content = bytearray(log.read_bytes())
            content[content.index(b"ARROW:schema")] ^= 1
            log.write_bytes(bytes(content))
            os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        case "marker":
            marker.unlink()
        case "configuration":
            config = Configuration(lds=LdsConfig(ci_limit_m=13.0))
        case "catalogue":
            shutil.rmtree(out / ".catalogue")
        case "damaged":
            (out / ".catalogue/complete").write_text("[{}")
    plan = make_plan([str(trial.runs)], trial.site, out, config)
    assert resume.unchanged_outcomes(plan) == []
    assert run_campaign(plan).count_skipped == (change in ("catalogue", "damaged"))
    assert len(resume.unchanged_outcomes(plan)) == 1


def test_a_log_that_was_just_written_is_read_again(
    settled: tuple[SmallTrial, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may change once more within the same tick of the clock."""
    trial, out = settled
    monkeypatch.setattr(WAITS, "settled_s", 3600.0)
    run_campaign(plan_of(trial, out), force=True)
    assert resume.unchanged_outcomes(plan_of(trial, out)) == []


def test_what_the_disk_did_not_give_is_no_failure_of_the_log() -> None:
    for cause, lasting in ((OSError(5, "Input/output error"), False), (ValueError("cut off"), True)):
        try:
            raise cause
        except (OSError, ValueError):
            with pytest.raises(InputError) as found:
                raise InputError("cannot be read") from None
        assert failure_of(found.value, lasting=True).lasting == lasting


@pytest.mark.usefixtures("forked_workers")
def test_packed_runs_are_known_and_new_ones_replayed(
    settled: tuple[SmallTrial, Path], small_trial: SmallTrial, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, out = settled
    (before,) = run_campaign(plan_of(trial, out)).outcomes
    with monkeypatch.context() as patch:
        patch.setattr(storage, "file_digests", never)
        assert compact(out).packed == 1
        assert verify(out).problems == ()
        (known,) = run_campaign(plan_of(trial, out)).outcomes
    assert replace(known, proof="") == replace(before, proof="")
    shutil.copytree(small_trial.paths[1], trial.runs / "run1")
    assert run_campaign(plan_of(trial, out)).count_skipped == 1
    assert (store.run_ids(out), store.own_runs(out)) == (["run0", "run1"], ["run1"])
    shutil.rmtree(out / ".catalogue")
    assert run_campaign(plan_of(trial, out)).count_skipped == 2
    assert verify(out).problems == ()
    assert run_campaign(plan_of(trial, out), force=True).count_skipped == 0
    assert compact(out).packed == 2
    assert verify(out).problems == ()
