"""The manifest says what made a result, and `verify` sees what no longer agrees."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.campaign import make_plan, run_campaign
from pipeline.campaign.run import write_campaign
from pipeline.campaign.verify import verify, verify_by_replay
from pipeline.results.manifest import note_pages, settings_files
from pipeline.results.store import table_address
from pipeline.show.report import write_report
from schemas.config import Configuration, Vehicle, load_settings
from schemas.errors import UsageError
from schemas.tables import TABLES
from tests.conftest import SmallTrial


def sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def manifest_of(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "manifest.json").read_text()))


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("train") / "train7.toml"
    file.write_text("antenna_height_m = 4.0\n")
    return file


@pytest.fixture(scope="module")
def out(small_trial: SmallTrial, train: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs and a log that cannot be read, each of a call: a single run needs no worker."""
    folder = tmp_path_factory.mktemp("result")
    bad = tmp_path_factory.mktemp("bad") / "bad.mcap"
    bad.write_bytes(b"no log")
    vehicle = load_settings(train, Vehicle)
    for log in (small_trial.paths[0], bad):
        run_campaign(make_plan([str(log)], small_trial.site, folder))
    given = settings_files(None, train)
    run_campaign(make_plan([str(small_trial.paths[1])], small_trial.site, folder, vehicle=vehicle, given=given))
    return folder


def test_every_source_is_named_with_size_and_digest(out: Path, small_trial: SmallTrial, train: Path) -> None:
    manifest = manifest_of(out)
    assert sorted(manifest["runs"]) == ["bad", "run0", "run1"]
    files = sorted(small_trial.paths[0].iterdir())
    assert manifest["runs"]["run0"]["log"] == [
        {"name": file.name, "bytes": file.stat().st_size, "sha256": sha256(file)} for file in files
    ]
    assert manifest["runs"]["bad"]["log"] == [
        {"name": "bad.mcap", "bytes": 6, "sha256": hashlib.sha256(b"no log").hexdigest()}
    ]
    (site,) = manifest["sites"].values()
    assert {file["name"]: file["sha256"] for file in site} == {
        file.name: sha256(file) for file in small_trial.site.iterdir()
    }
    (entry,) = manifest["settings"][manifest["runs"]["run1"]["config_digest"]]
    assert entry["vehicle"] == {"name": "train7.toml", "bytes": 23, "sha256": sha256(train)}
    for run in ("run0", "run1", "bad"):
        tables = {name: sha256(Path(table_address(out, name, run))) for name in manifest["runs"][run]["tables"]}
        assert manifest["runs"][run]["tables"] == tables
    for name in ("config.toml", "vehicle.toml"):
        assert manifest["files"][name]["sha256"] == sha256(out / name)
    assert str(small_trial.site) not in json.dumps(manifest)


def test_the_order_of_calls_changes_nothing(out: Path, small_trial: SmallTrial, train: Path, tmp_path: Path) -> None:
    vehicle, given = load_settings(train, Vehicle), settings_files(None, train)
    one = make_plan([str(small_trial.paths[1])], small_trial.site, tmp_path, vehicle=vehicle, given=given)
    run_campaign(one)
    run_campaign(make_plan([str(small_trial.paths[0])], small_trial.site, tmp_path))
    before, after = manifest_of(out)["runs"], manifest_of(tmp_path)["runs"]
    assert after == {run: before[run] for run in ("run0", "run1")}
    text = (tmp_path / "manifest.json").read_bytes()
    run_campaign(make_plan([str(small_trial.paths[0])], small_trial.site, tmp_path))
    assert (tmp_path / "manifest.json").read_bytes() == text


def test_verify_sees_what_changed(out: Path, tmp_path: Path) -> None:
    assert verify(out).problems == ()
    copy = shutil.copytree(out, tmp_path / "copy")
    hazards = Path(table_address(copy, "hazards", "run0"))
    hazards.write_bytes(hazards.read_bytes() + b"x")
    shutil.rmtree(copy / "runs" / "run_id=run1")
    (copy / "config.toml").write_text("")
    (copy / "campaign" / "map.parquet").unlink()
    assert [what for what, _, _ in verify(copy).problems] == [
        *("run run1", "config.toml", "campaign/map.parquet", "run run0, hazards"),
    ]


def test_verify_reads_provenance_from_the_runs(out: Path, tmp_path: Path) -> None:
    """What the manifest says of a run beside the digests of its tables."""
    copy = shutil.copytree(out, tmp_path / "copy")
    manifest = manifest_of(copy)
    run = manifest["runs"]["run0"]
    run["log"][0]["sha256"] = "0" * 64
    run |= {"site": "elsewhere", "config_digest": "other", "status": "failed", "software": "other 1.0"}
    run["software_digest"] = "1" * 64
    next(iter(manifest["sites"].values()))[0]["sha256"] = "2" * 64
    (copy / "manifest.json").write_text(json.dumps(manifest))
    found = {what for what, _, _ in verify(copy).problems}
    parts = ("site", "status", "software", "program", "settings", f"log {run['log'][0]['name']}")
    assert found >= {f"run run0, {part}" for part in parts}
    assert any(what.startswith("site ") for what in found)


def test_a_table_and_its_digest_changed_together_disagree_with_the_marker(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    hazards = Path(table_address(copy, "hazards", "run0"))
    shutil.copyfile(table_address(copy, "hazards", "bad"), hazards)
    manifest = manifest_of(copy)
    manifest["runs"]["run0"]["tables"]["hazards"] = sha256(hazards)
    (copy / "manifest.json").write_text(json.dumps(manifest))
    assert [what for what, _, _ in verify(copy).problems] == ["marker of run run0, hazards"]


def test_verify_lists_what_the_manifest_does_not_name(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    shutil.copytree(copy / "hazards/run_id=run0", copy / "hazards/run_id=zz")
    (copy / "campaign/more.csv").write_text("")
    (copy / "campaign/runs2.parquet").write_bytes((copy / "campaign/runs.parquet").read_bytes())
    assert sorted(what for what, _, _ in verify(copy).problems) == [
        *("campaign/more.csv", "campaign/runs2.parquet", "hazards/run_id=zz/hazards.parquet")
    ]


def test_pages_are_part_of_the_manifest(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    write_report(copy, jobs=1)
    assert verify(copy).problems == ()
    assert sorted(manifest_of(copy)["pages"]) == ["index.html", "runs/bad.html", "runs/run0.html", "runs/run1.html"]
    page = copy / "report/runs/run0.html"
    page.write_text(page.read_text().replace("unproven", "safe"))
    assert [what for what, _, _ in verify(copy).problems] == ["page runs/run0.html"]
    write_report(copy, jobs=1)
    assert verify(copy).problems == ()
    (copy / "report/runs/notes.txt").write_text("safe")
    write_report(copy, jobs=1)
    assert [what for what, _, _ in verify(copy).problems] == ["page runs/notes.txt"]


def rewritten(file: Path, verdict: str) -> None:
    """A marker as it was, but for its verdict."""
    table = pq.read_table(file)
    at = table.schema.get_field_index("verdict")
    field = table.schema.field(at)
    words = pa.array([verdict] * table.num_rows).dictionary_encode().cast(field.type)
    pq.write_table(table.set_column(at, field, words).cast(table.schema), file)


def test_a_marker_that_was_changed_is_no_complete_run(out: Path, small_trial: SmallTrial, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    marker = Path(table_address(copy, "runs", "run0"))
    before = marker.read_bytes()
    rewritten(marker, "unsafe")
    assert pl.read_parquet_metadata(marker).items() >= {("balise.run_id", "run0")}
    summary = run_campaign(make_plan([str(small_trial.paths[0])], small_trial.site, copy))
    assert (summary.count_skipped, marker.read_bytes() == before) == (0, True)
    assert verify(copy).problems == ()


@pytest.mark.parametrize("table", ["hazards", "passages"])
def test_a_run_is_not_complete_without_the_tables_that_it_was_written_with(
    out: Path, small_trial: SmallTrial, tmp_path: Path, table: str
) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    file = Path(table_address(copy, table, "run0"))
    before = file.read_bytes()
    shutil.copyfile(table_address(copy, table, "bad"), file)
    summary = run_campaign(make_plan([str(small_trial.paths[0])], small_trial.site, copy))
    assert (summary.count_skipped, file.read_bytes() == before) == (0, True)
    assert verify(copy).problems == ()


def test_what_was_changed_stays_seen_after_other_calls(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    rewritten(Path(table_address(copy, "runs", "run0")), "unsafe")
    write_campaign(copy, Configuration())
    assert [what for what, _, _ in verify(copy).problems] == ["run run0, runs", "marker of run run0, runs"]


def test_the_tables_of_one_run_under_the_name_of_another(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    for table in TABLES:
        shutil.copytree(copy / table / "run_id=run0", copy / table / "run_id=run1", dirs_exist_ok=True)
    write_campaign(copy, Configuration())
    assert verify(copy).problems == (("tables of run run1", "of run run0", "run1"),)


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", '{"manifest": 1}', '{"manifest": 2}', '{"manifest": 1, "runs": 5}', "\x00\xff", "null", "1e999"],
)
def test_a_manifest_of_any_content_stops_nothing(out: Path, tmp_path: Path, content: str) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    expected = manifest_of(copy)["runs"]
    (copy / "manifest.json").write_text(content)
    with pytest.raises(UsageError, match="is not a manifest"):
        verify(copy)
    note_pages(copy, {"index.html": b""})
    assert (copy / "manifest.json").read_text() == content, "pages alone make no manifest"
    write_campaign(copy, Configuration())
    assert manifest_of(copy)["runs"] == expected


@pytest.mark.usefixtures("forked_workers")
def test_a_run_made_without_vehicle_file_is_replayed_without(out: Path, small_trial: SmallTrial, train: Path) -> None:
    logs = [str(path) for path in small_trial.paths[:2]]
    again = verify_by_replay(out, logs, small_trial.site, None, load_settings(train, Vehicle))
    assert (again.problems, again.compared) == ((), "2 of 3 runs replayed again")


def test_a_run_of_an_interrupted_call_is_named(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    manifest = manifest_of(copy)
    del manifest["runs"]["run0"]
    (copy / "manifest.json").write_text(json.dumps(manifest))
    ((what, found, expected),) = verify(copy).problems
    assert (what, found) == ("run run0", "complete")
    assert "interrupted" in expected


def test_no_manifest_is_one_error(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out, tmp_path / "copy")
    (copy / "manifest.json").unlink()
    with pytest.raises(UsageError, match=r"has no manifest\.json"):
        verify(copy)
    (copy / "manifest.json").write_text("{}")
    with pytest.raises(UsageError, match="is not a manifest"):
        verify(copy)


def test_logs_are_replayed_again_and_compared(out: Path, small_trial: SmallTrial, tmp_path: Path) -> None:
    same = verify_by_replay(out, [str(small_trial.paths[0])], small_trial.site, None, Vehicle())
    assert (same.problems, same.compared) == ((), "1 of 3 runs replayed again")
    other = shutil.copytree(small_trial.paths[2], tmp_path / "run1")
    wrong = verify_by_replay(out, [str(other)], small_trial.site, None, Vehicle())
    assert wrong.problems == (("settings of 1 run", "others", "--vehicle train7.toml"),)
    changed = shutil.copytree(small_trial.paths[2], tmp_path / "run0")
    named = {what for what, _, _ in verify_by_replay(out, [str(changed)], small_trial.site, None, Vehicle()).problems}
    assert {"run run0, log gnss.parquet", "run run0, epochs", "run run0, runs"} <= named
