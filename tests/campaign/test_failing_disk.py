"""Every write and every read fails in turn, or is the last that a process does."""

from __future__ import annotations

import contextlib
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from datasets.trial import write_run_as
from pipeline.campaign import run_campaign, worker
from pipeline.campaign.plan import RunJob
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from pipeline.results import store
from pipeline.show.export import export_run
from pipeline.show.report import write_report
from pipeline.storage import UNFINISHED
from schemas.config import IngestConfig
from schemas.errors import BaliseError
from schemas.run import RunLog, RunTables
from schemas.tables import TABLES
from tests.campaign.compare import plan_of, result_bytes
from tests.campaign.disk import Disk, Killed, operations
from tests.conftest import SmallTrial

_RUNS = 2
_MOMENTS = 6


def content(folder: Path) -> dict[str, bytes]:
    """Every file under its name but those that hold times or inodes."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.parent.name != ".catalogue")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if not path.match(UNFINISHED)}


def unfinished(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.match(UNFINISHED)]


@pytest.fixture
def campaign(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], object]:
    """A campaign of two runs whose tables are at hand, so that it is all reading and writing."""
    tables = {path.stem: store.read_run(undisturbed, path.stem) for path in small_trial.paths}

    def at_hand(job: RunJob, *_: object) -> RunTables:
        return tables[job.run_id]

    monkeypatch.setattr(worker, "_replay", at_hand)
    monkeypatch.setattr("pipeline.campaign.run.LocalEngine", lambda jobs: _engine())
    plan = plan_of(small_trial, tmp_path / "disk/out", small_trial.paths[:_RUNS])
    return lambda: run_campaign(plan)


def _engine() -> object:
    from pipeline.campaign.engines import SerialEngine

    return SerialEngine(3600.0)


@pytest.mark.parametrize("dies", [True, False])
def test_campaign_ends_at_any_operation(
    campaign: Callable[[], object], undisturbed: Path, tmp_path: Path, dies: bool
) -> None:
    """A kill, or an error of the disk: what counts as complete is whole, and the next call does the rest.

    Kills of real processes at random moments: `python -m benchmarks interruptions`.
    """
    disk, out = Disk(tmp_path / "disk"), tmp_path / "disk/out"
    count = operations(disk, campaign)
    wanted, runs = content(out), result_bytes(undisturbed)
    assert count > 80
    for number in sorted(random.Random(3).sample(range(1, count), _MOMENTS)):
        shutil.rmtree(out, ignore_errors=True)
        with disk.failing(number, dies), contextlib.suppress(BaliseError, Killed):
            campaign()
        complete = store.completed_runs(out)
        for name, data in content(out).items():
            run = complete.get(name.partition("run_id=")[2].partition("/")[0])
            # A failed run is one whose log could not be read then: it is tried again.
            assert run is None or run.get("redo") or data == runs[name], (number, name)
        assert dies or unfinished(out) == [], number
        campaign()
        assert content(out) == wanted, number


@pytest.mark.parametrize("name", ["run", "run.mcap"])
def test_run_is_written_whole_or_not_at_all(small_trial: SmallTrial, tmp_path: Path, name: str) -> None:
    """`convert` and `inject`: over another run, whose odometer must not stay behind."""
    before = read_run(small_trial.paths[0], IngestConfig())
    after = RunLog(before.run_id, read_run(small_trial.paths[1], IngestConfig()).gnss)
    place, disk = tmp_path / "disk" / name, Disk(tmp_path / "disk")

    def write_before() -> dict[str, bytes]:
        shutil.rmtree(tmp_path / "disk", ignore_errors=True)
        write_run_as(before, place)
        return content(tmp_path / "disk")

    old = write_before()
    count = operations(disk, lambda: write_run_as(after, place))
    new = content(tmp_path / "disk")
    assert old.keys() == new.keys() or name == "run"
    for dies in (True, False):
        for number in range(1, count + 1):
            write_before()
            with disk.failing(number, dies), contextlib.suppress(BaliseError, Killed):
                write_run_as(after, place)
            left = content(tmp_path / "disk")
            assert left in (old, new) or (name == "run" and "run/gnss.parquet" not in left), (dies, number)
            assert dies or unfinished(tmp_path) == [], number
            write_run_as(after, place)
            assert content(tmp_path / "disk") == new


@pytest.mark.parametrize("suffix", ["gpx", "mcap"])
def test_export_is_written_whole_or_not_at_all(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, suffix: str
) -> None:
    site, to, disk = read_site(small_trial.site), tmp_path / f"disk/run.{suffix}", Disk(tmp_path)

    def export() -> object:
        return export_run(undisturbed, "run0", to, site)

    count = operations(disk, export)
    whole = content(to.parent)
    for number in range(1, count + 1):
        shutil.rmtree(to.parent, ignore_errors=True)
        error = ""
        try:
            with disk.failing(number):
                export()
        except BaliseError as raised:
            error = str(raised)
        # A folder that is there need not be made.
        assert "cannot be" in error or content(to.parent) == whole, number
        assert content(to.parent).items() <= whole.items(), number
        assert unfinished(to.parent) == [], number


def test_pages_are_written_whole_or_not_at_all(
    undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error of the disk anywhere in a report, of short pages, so that it is all reading and writing."""
    disk, out = Disk(tmp_path / "disk"), tmp_path / "disk/out"
    for table in TABLES:
        shutil.copytree(undisturbed / table / "run_id=run0", out / table / "run_id=run0")
    shutil.copy(undisturbed / "config.toml", out)
    monkeypatch.setattr("pipeline.show.report.write.run_page", lambda tables, *_: f"<p>{tables.runs.height} row</p>\n")
    monkeypatch.setattr(
        "pipeline.show.report.write.campaign_page", lambda campaign, _: f"{campaign.pieces.height} pieces"
    )
    count = operations(disk, lambda: write_report(out))
    whole = content(out)
    assert count > 40
    for number in sorted(random.Random(5).sample(range(1, count), _MOMENTS)):
        for folder in ("report", ".catalogue"):
            shutil.rmtree(out / folder, ignore_errors=True)
        error = ""
        try:
            with disk.failing(number):
                write_report(out)
        except BaliseError as raised:
            error = str(raised)
        assert "cannot be" in error or content(out) == whole, number
        assert content(out).items() <= whole.items(), number
        assert unfinished(out) == [], number
    write_report(out)
    assert content(out) == whole


def test_a_reading_that_fails_is_an_error_of_the_log(small_trial: SmallTrial, tmp_path: Path) -> None:
    """Every read of a log fails in turn: never a run without the stream that could not be read."""
    copy = Path(shutil.copytree(small_trial.paths[0], tmp_path / "log"))
    disk, whole = Disk(copy), read_run(copy, IngestConfig())
    for number in range(1, operations(disk, lambda: read_run(copy, IngestConfig())) + 1):
        with pytest.raises(BaliseError, match="cannot be read"), disk.failing(number):
            read_run(copy, IngestConfig())
    assert whole.odometer is not None
