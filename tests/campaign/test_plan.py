"""Which runs a command means."""

from __future__ import annotations

from pathlib import Path

import fsspec
import pytest

from pipeline import storage
from pipeline.campaign import find_runs, run_campaign
from pipeline.results import store
from pipeline.storage import files
from pipeline.storage.address import Address, join
from schemas.errors import InputError, UsageError
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    for name in ("b.mcap", "a.mcap", "notes.txt", ".hidden.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "gnss.parquet").touch()
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "odometer.parquet").touch()
    (tmp_path / "empty").mkdir()
    return tmp_path


def test_a_run_is_not_called_as_hive_calls_null(tmp_path: Path) -> None:
    (tmp_path / "__HIVE_DEFAULT_PARTITION__.mcap").touch()
    with pytest.raises(UsageError, match=r"'__HIVE_DEFAULT_PARTITION__' cannot be a run id.*[Rr]ename"):
        find_runs([str(tmp_path)])


def test_a_folder_of_runs(logs: Path) -> None:
    assert list(find_runs([str(logs)])) == ["a", "b", "c", "d"]


def test_one_run_of_either_kind(logs: Path) -> None:
    assert find_runs([str(logs / "a.mcap"), str(logs / "c")]) == {"a": str(logs / "a.mcap"), "c": str(logs / "c")}


def test_globs_and_repetition(logs: Path) -> None:
    assert list(find_runs([str(logs / "*.mcap"), str(logs / "a.mcap")])) == ["a", "b"]


def test_relative_paths_become_absolute(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(logs)
    assert find_runs(["a.mcap"]) == {"a": str(logs / "a.mcap")}


@pytest.mark.parametrize("name", ["none.mcap", "*.bag", "nowhere/"])
def test_nothing_found(logs: Path, name: str) -> None:
    with pytest.raises(UsageError, match="no such run"):
        find_runs([str(logs / name)])


def test_folder_without_runs(logs: Path) -> None:
    with pytest.raises(UsageError, match="holds no run"):
        find_runs([str(logs / "empty")])


def test_two_logs_of_one_name_are_refused(logs: Path) -> None:
    (logs / "c" / "a.mcap").touch()
    with pytest.raises(UsageError, match="same run id 'a'"):
        find_runs([str(logs / "a.mcap"), str(logs / "c" / "a.mcap")])


def test_addresses() -> None:
    store = fsspec.filesystem("memory")
    for name in ("/find/x/gnss.parquet", "/find/y.mcap", "/find/z.txt"):
        store.pipe_file(name, b"")
    assert find_runs(["memory://find"]) == {"x": "memory://find/x", "y": "memory://find/y.mcap"}
    assert list(find_runs(["memory://find/*.mcap"])) == ["y"]
    with pytest.raises(UsageError, match="no such run"):
        find_runs(["memory://find/*.bag"])


@pytest.mark.parametrize("in_a_store", [True, False])
def test_a_folder_that_cannot_be_listed_leaves_no_run_out(
    tmp_path: Path, in_a_store: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = "memory://silent" if in_a_store else str(tmp_path / "silent")
    for name in ("x/gnss.parquet", "y/gnss.parquet"):
        storage.write_bytes(join(out if in_a_store else Path(out), name), b"")
    listed = files.list_dir

    def silent(folder: Address) -> list[str]:
        if str(folder).endswith("/y"):
            raise InputError("cannot be read: Permission denied", place=str(folder))
        return listed(folder)

    monkeypatch.setattr(files, "list_dir", silent)
    with pytest.raises(InputError, match="silent/y: cannot be read"):
        find_runs([out])


def test_names_too_long_to_file_are_refused_at_once(small_trial: SmallTrial, tmp_path: Path) -> None:
    """A file system allows 255 bytes; what a path cannot hold everywhere takes three per byte."""
    for name in ("\N{STEAM LOCOMOTIVE}" * 25, "\N{CYRILLIC SMALL LETTER YA}" * 42):
        (tmp_path / f"{name}.mcap").touch()
        with pytest.raises(UsageError, match=f"{name}.mcap: its name is too long to file results under"):
            plan_of(small_trial, tmp_path / "out", [tmp_path / f"{name}.mcap", small_trial.paths[0]])
    longest = "\N{CYRILLIC SMALL LETTER YA}" * 41
    (tmp_path / f"{longest}.mcap").touch()
    (outcome,) = run_campaign(plan_of(small_trial, tmp_path / "out", [tmp_path / f"{longest}.mcap"])).outcomes
    assert (outcome.run_id, store.run_ids(tmp_path / "out")) == (longest, [longest])
