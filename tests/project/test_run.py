"""A project brought up to date: what is made, what is left alone, what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import cli
from pipeline.project.convert import convert_entry
from pipeline.project.made import Product, Record
from pipeline.project.opened import OpenedProject
from schemas.enums import Remedy
from schemas.errors import InputError, UsageError
from schemas.project import Project
from schemas.words import remedy_words
from tests.conftest import SmallTrial

pytestmark = pytest.mark.usefixtures("replayed_once")


def nmea(lines: int = 40, acceleration_mps2: float = 0.0) -> str:
    """A receiver at 1 Hz that goes north, faster and faster."""
    pairs = []
    for second in range(lines):
        place = f"50{1.2 + acceleration_mps2 / 2 * second**2 / 1852:010.7f},N,01400.0000000,E"
        clock = f"10{12 + second // 60:02d}{second % 60:02d}.00"
        pairs.append(f"GPRMC,{clock},A,{place},{acceleration_mps2 * second * 1.943844:.3f},0.0,030325,,,A")
        pairs.append(f"GPGGA,{clock},{place},1,08,1.0,250.0,M,45.0,M,,")
    return "".join(f"${text}*{_sum(text):02X}\r\n" for text in pairs)


def _sum(text: str) -> int:
    total = 0
    for letter in text:
        total ^= ord(letter)
    return total


@pytest.fixture
def project(tmp_path: Path, small_trial: SmallTrial, monkeypatch: pytest.MonkeyPatch, in_process: None) -> Path:
    """A folder with a site, one run by the contract, and a project of it."""
    shutil.copytree(small_trial.site, tmp_path / "site")
    shutil.copytree(small_trial.paths[0], tmp_path / "runs" / "run0")
    (tmp_path / "balise.toml").write_text('[replay]\nruns = ["runs/run0"]\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*arguments: str) -> int:
    return cli._run_guarded(list(arguments), debug=False)


def states(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Runs, tables of runs and their pages; tables and page over all runs are written each time."""
    files = [path for path in sorted(folder.rglob("run*/*")) if path.is_file()]
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def test_second_call_finds_all_up_to_date(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run") == 0
    assert "up to date" not in capsys.readouterr().out
    before = states(project)
    assert (project / "result/report/index.html").exists()
    assert call("run") == 0
    assert "All was up to date." in capsys.readouterr().out
    assert states(project) == before


def test_commands_take_what_is_not_given(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run", "-q") == 0
    for command in (["verify"], ["report"], ["inspect"], ["inspect", "runs/run0"], ["safety"]):
        assert call(*command) == 0, command
        assert "balise: from balise.toml: " in capsys.readouterr().err
    assert call("sql", "SELECT run_id FROM runs", "--csv", "-") == 0
    said = capsys.readouterr()
    assert said.out == "run_id\nrun0\n"
    assert "out result" in said.err


def test_an_option_wins(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run", "-q") == 0
    assert call("verify", "nowhere") == 2
    said = capsys.readouterr().err
    assert "nowhere" in said
    assert "out result" not in said


def test_another_folder_is_named(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (project / "elsewhere").mkdir()
    monkeypatch.chdir(project / "elsewhere")
    assert call("run", "-q", "--project", "..") == 0
    assert call("verify", "-q", "--project", "..") == 0


def test_an_edited_log_is_converted_and_replayed_again(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "still.nmea").write_text(nmea())
    (project / "balise.toml").write_text('[[convert]]\nto = "made/still"\n[[convert.logs]]\nfiles = ["still.nmea"]\n')
    assert call("run") in (0, 1)
    first = pl.read_parquet(project / "made/still/gnss.parquet").height
    assert call("run") in (0, 1)
    assert "0 converted, 1 up to date" in capsys.readouterr().err
    (project / "still.nmea").write_text(nmea(20))
    assert call("run") in (0, 1)
    assert "1 converted, 0 up to date" in capsys.readouterr().err
    assert (first, pl.read_parquet(project / "made/still/gnss.parquet").height) == (40, 20)


def test_what_the_project_did_not_make_stays(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "still.nmea").write_text(nmea())
    (project / "balise.toml").write_text('[[convert]]\nto = "runs/run0"\n[[convert.logs]]\nfiles = ["still.nmea"]\n')
    before = (project / "runs/run0/gnss.parquet").read_bytes()
    assert call("run") == 2
    assert "did not make it" in capsys.readouterr().err
    assert (project / "runs/run0/gnss.parquet").read_bytes() == before


def test_a_log_that_cannot_be_converted_stops_before_the_replay(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "noise.ubx").write_bytes(b"nothing of a receiver")
    text = '[[convert]]\nto = "made/x"\n[[convert.logs]]\nfiles = ["noise.ubx"]\n[replay]\nruns = ["runs/run0"]\n'
    (project / "balise.toml").write_text(text)
    assert call("run") == 1
    assert "noise.ubx: holds no message of a known receiver" in capsys.readouterr().err
    assert not (project / "result").exists()


def test_a_run_taken_out_is_no_part_of_the_figures(project: Path, small_trial: SmallTrial) -> None:
    shutil.copytree(small_trial.paths[1], project / "runs" / "run1")
    (project / "balise.toml").write_text('[replay]\nruns = ["runs"]\n')
    assert call("run", "-q") == 0
    (project / "balise.toml").write_text('[replay]\nruns = ["runs/run1"]\n')
    assert call("run", "-q") == 2
    assert call("run", "-q", "--prune") == 0
    assert pl.read_parquet(project / "result/campaign/runs.parquet")["run_id"].unique().to_list() == ["run1"]
    assert call("verify", "-q") == 0


def test_runs_taken_out_are_removed_from_compact_files(project: Path, small_trial: SmallTrial) -> None:
    shutil.copytree(small_trial.paths[1], project / "runs" / "run1")
    (project / "balise.toml").write_text('[replay]\nruns = ["runs"]\n')
    assert call("run", "-q") == 0
    assert call("compact", "-q", "result") == 0
    (project / "balise.toml").write_text('[replay]\nruns = ["runs/run1"]\n')
    assert call("run", "-q") == 2
    assert call("run", "-q", "--prune") == 0
    assert pl.read_parquet(project / "result/campaign/runs.parquet")["run_id"].unique().to_list() == ["run1"]
    assert call("verify", "-q") == 0


class Killed(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("known", [False, True])
def test_killed_before_it_is_noted_a_product_is_made_again(tmp_path: Path, known: bool) -> None:
    """Files that the killed call left are nobody else's; a file that a failing call did not touch may be."""
    made = tmp_path / "runs/a.parquet"
    made.parent.mkdir()

    def make(content: bytes, error: BaseException | None = None) -> Callable[[], list[Path]]:
        def making() -> list[Path]:
            if content:
                made.write_bytes(content)
            if error is not None:
                raise error
            return [made]

        return making

    if known:
        Record(tmp_path).make_if_changed(Product("run a", made, "old"), make(b"old"))
    with pytest.raises(Killed):
        Record(tmp_path).make_if_changed(Product("run a", made, "new"), make(b"ha", Killed()))
    assert Record(tmp_path).make_if_changed(Product("run a", made, "new"), make(b"half")).made
    assert not Record(tmp_path).make_if_changed(Product("run a", made, "new"), make(b"no")).made
    with pytest.raises(InputError):
        Record(tmp_path).make_if_changed(Product("run a", made, "third"), make(b"", InputError("damaged", place="log")))
    made.write_bytes(b"by hand")
    with pytest.raises(UsageError, match="was changed"):
        Record(tmp_path).make_if_changed(Product("run a", made, "third"), make(b"no"))
    assert made.read_bytes() == b"by hand"


def test_a_file_that_was_added_to_a_run_is_not_removed(tmp_path: Path) -> None:
    run = tmp_path / "runs/a"

    def make() -> list[Path]:
        run.mkdir(parents=True, exist_ok=True)
        (run / "gnss.parquet").write_bytes(b"made")
        return [run / "gnss.parquet"]

    Record(tmp_path).make_if_changed(Product("run a", run, "old"), make)
    (run / "reference.parquet").write_bytes(b"added")
    assert not Record(tmp_path).make_if_changed(Product("run a", run, "old"), make).made
    with pytest.raises(UsageError, match="was added"):
        Record(tmp_path).make_if_changed(Product("run a", run, "new"), make)
    assert Record(tmp_path, force=True).make_if_changed(Product("run a", run, "new"), make).made


def test_unknown_keys_are_refused(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "balise.toml").write_text('[replay]\nrun = ["runs"]\n')
    assert call("run") == 2
    assert "unknown key `replay.run` (did you mean `runs`?)" in capsys.readouterr().err


def test_a_configuration_of_that_name_is_no_project(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "balise.toml").write_text("[hazards]\nfailure_limit_m = 12.0\n")
    assert call("inspect", "runs/run0", "--config", "balise.toml") == 0
    assert "from balise.toml" not in capsys.readouterr().err


def test_a_vehicle_is_measured_once_and_used(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = '[calibrate]\nruns = ["runs/run0"]\n[replay]\nruns = ["runs/run0"]\n'
    (project / "balise.toml").write_text(text)
    assert call("replay") == 2
    assert "is not calibrated yet" in capsys.readouterr().err
    assert call("run") == 0
    assert "calibrate on 1 runs" in " ".join(capsys.readouterr().err.split())
    measured = (project / ".balise/vehicle_measured.toml").read_text()
    assert (project / "result/vehicle.toml").read_text() == measured
    assert call("run") == 0
    assert "calibrate up to date" in " ".join(capsys.readouterr().err.split())


def test_each_run_is_calibrated_on_the_others(project: Path, small_trial: SmallTrial) -> None:
    for number in (1, 2):
        shutil.copytree(small_trial.paths[number], project / "runs" / f"run{number}")
    (project / "balise.toml").write_text('[replay]\nruns = ["runs"]\ncalibrate = ["runs"]\n')
    assert call("run", "-q") == 0
    rows = pl.read_parquet(project / "result/campaign/runs.parquet").select("run_id", "calibrated_by").rows()
    assert dict(rows)["run1"] == ["run0", "run2"]


def test_an_interrupted_conversion_goes_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "two"):
        (project / f"{name}.nmea").write_text(nmea())
    tables = [
        f'[[convert]]\nto = "made/{name}"\n[[convert.logs]]\nfiles = ["{name}.nmea"]\n' for name in ("one", "two")
    ]
    (project / "balise.toml").write_text("".join(tables))
    converted: list[str] = []

    def interrupted(opened: Any, entry: Any, *others: Any) -> Any:
        converted.append(entry.run_id)
        if converted == ["one", "two"]:
            os.kill(os.getpid(), signal.SIGINT)
        return convert_entry(opened, entry, *others)

    monkeypatch.setattr("pipeline.project.run.convert_entry", interrupted)
    assert call("run", "-q") == 128 + signal.SIGINT
    assert not (project / "made/two/gnss.parquet").exists()
    assert not (project / "result").exists()
    assert call("run", "-q") in (0, 1)
    assert converted == ["one", "two", "two"]


def test_a_run_is_exported_and_remedies_name_the_file(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run") == 0
    said = capsys.readouterr().out
    assert "balise replay" not in said
    assert call("export", "run0", "--out", "run0.geojson") == 0
    assert (project / "run0.geojson").exists()


def test_remedies_of_a_project_name_its_keys() -> None:
    places = OpenedProject(Path("week12/balise.toml"), Project()).message_words
    words = remedy_words(Remedy.CALIBRATE, **places)
    assert "week12/balise.toml" in words
    assert words.endswith("`balise run --project week12`")
    assert "balise replay" not in "".join(remedy_words(remedy, **places) for remedy in Remedy)


def test_a_site_is_made_again_for_any_setting(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A survey may be a recorded run: its line depends on settings of more than the survey."""
    drive = project / "drive"
    shutil.copytree(project / "runs/run0", drive)
    file = drive / "gnss.parquet"
    pl.read_parquet(file).with_columns(fix=pl.lit("rtk_fixed")).write_parquet(file)
    shutil.rmtree(project / "site")
    text = 'config = "settings.toml"\n[track]\nsurvey = ["drive"]\n[replay]\nruns = ["runs/run0"]\n'
    (project / "balise.toml").write_text(text)
    for reach_m in (50, 60):
        (project / "settings.toml").write_text(f"[matching]\nreach_m = {reach_m}\n")
        for made in (True, False):
            call("run")
            assert ("made of drive" in capsys.readouterr().err) == made


def test_a_verdict_is_held_against_raw_logs(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A converted run that somebody moved, its new digest in the project's own record, is not what its logs say."""
    (project / "still.nmea").write_text(nmea())
    (project / "balise.toml").write_text('[[convert]]\nto = "made/still"\n[[convert.logs]]\nfiles = ["still.nmea"]\n')
    call("run", "-q")
    manifest = json.loads((project / "result/manifest.json").read_text())
    raw = hashlib.sha256((project / "still.nmea").read_bytes()).hexdigest()
    assert [(file["name"], file["sha256"]) for file in manifest["runs"]["still"]["raw"]] == [("still.nmea", raw)]
    assert call("verify", "--logs", "made/still") == 0
    assert "1 run converted again from raw logs: all agree" in capsys.readouterr().out
    file = project / "made/still/gnss.parquet"
    metadata = pq.read_metadata(file).metadata
    table = pa.table(pl.read_parquet(file).with_columns(pl.col("latitude_deg") + 1e-4).to_arrow())
    pq.write_table(table.replace_schema_metadata(metadata), file)
    record = json.loads((project / ".balise/made.json").read_text())
    record["run made/still"]["files"]["still/gnss.parquet"] = hashlib.sha256(file.read_bytes()).hexdigest()
    (project / ".balise/made.json").write_text(json.dumps(record))
    call("run", "-q")
    assert call("verify", "-q") == 0
    assert call("verify", "--logs", "made/still") == 1
    assert "run still, gnss" in capsys.readouterr().out


def test_the_digest_of_the_manifest_is_printed_and_expected(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("run") == 0
    digest = hashlib.sha256((project / "result/manifest.json").read_bytes()).hexdigest()
    assert f"manifest.json: sha256 {digest} of 1 run\n" in capsys.readouterr().out
    assert call("verify") == 0
    assert capsys.readouterr().out.endswith(f"manifest.json: sha256 {digest} of 1 run\n")
    assert call("verify", "--expect", digest.upper()) == 0
    assert call("verify", "--expect", "0" * 64) == 1
    assert call("verify", "--expect", digest[:12]) == 2
