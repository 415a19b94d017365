"""The catalogue of a result: quicker, never another answer."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal
from pydantic import TypeAdapter

from pipeline import storage
from pipeline.campaign import run_campaign
from pipeline.campaign.finish import write_campaign
from pipeline.campaign.outcome import outcome_of
from pipeline.campaign.verify import verify
from pipeline.results import catalogue, store
from pipeline.results.outcome import RunOutcome
from pipeline.results.query import run_sql
from pipeline.results.software import software_digest
from pipeline.storage import parquet
from pipeline.storage.objects import version_of
from schemas.config import Configuration
from schemas.errors import UsageError
from tests.campaign.compare import campaign_bytes, plan_of
from tests.conftest import SmallTrial

QUERIES = (
    "SELECT * FROM passages ORDER BY run_id, solution, path_m, balise_id",
    "SELECT run_id, solution, status, duration_s FROM runs ORDER BY run_id, solution",
    "SELECT hazard, COUNT(*) AS n FROM hazards JOIN runs USING (run_id, solution) GROUP BY hazard ORDER BY hazard",
    "SELECT COUNT(*) AS n FROM alarms WHERE run_id = 'run2'",
)


@pytest.fixture
def out(undisturbed: Path, tmp_path: Path) -> Path:
    """A result of four runs whose catalogue is of these very files."""
    shutil.copytree(undisturbed, tmp_path / "out")
    catalogue.gather(tmp_path / "out")
    return tmp_path / "out"


def is_fresh(out: Path) -> list[bool]:
    return [catalogue.fresh(out, table) is not None for table in catalogue.CATALOGUED]


@pytest.mark.parametrize("query", QUERIES)
def test_same_answers_with_and_without(out: Path, query: str) -> None:
    assert is_fresh(out) == [True] * 4
    with_it = run_sql(out, query)
    shutil.rmtree(out / ".catalogue")
    assert is_fresh(out) == [False] * 4
    assert_frame_equal(with_it, run_sql(out, query))


def poison(out: Path, digest: bool = True) -> None:
    """Say `safe` of every run in the catalogue; with `digest` as somebody does who knows the format."""
    entry = catalogue.address_of(out, "runs")
    _, key, _ = Path(entry).read_bytes().split(b"\n", 2)
    frame = catalogue.fresh(out, "runs")
    assert frame is not None
    lie = frame.with_columns(verdict=pl.lit("safe", dtype=frame.schema["verdict"]))
    assert not lie.equals(frame)
    if digest:
        catalogue.keep(out, "runs", key.decode(), parquet.parquet_bytes(lie))
    else:
        first, _ = Path(entry).read_bytes().split(b"\n", 1)
        Path(entry).write_bytes(b"\n".join((first, key, parquet.parquet_bytes(lie))))


VERDICTS = "SELECT run_id, verdict FROM runs ORDER BY run_id, solution"


def test_an_entry_that_was_changed_does_not_answer(out: Path) -> None:
    before = run_sql(out, VERDICTS)
    poison(out, digest=False)
    assert is_fresh(out) == [False, True, True, True]
    assert_frame_equal(run_sql(out, VERDICTS), before)


def test_campaign_tables_come_from_the_runs_and_verify_sees_a_false_entry(out: Path) -> None:
    write_campaign(out, Configuration())
    assert verify(out).problems == ()
    before = campaign_bytes(out)
    poison(out)
    assert [what for what, _, _ in verify(out).problems] == [".catalogue/runs"]
    (out / "campaign/runs.parquet").unlink()
    write_campaign(out, Configuration())
    assert campaign_bytes(out) == before
    assert verify(out).problems == ()


@pytest.mark.parametrize(
    ("name", "lie"), [("hazards", 9), ("balises_accepted", 99), ("why", "all is well"), ("status", "partial")]
)
def test_verify_sees_a_false_outcome(small_trial: SmallTrial, tmp_path: Path, name: str, lie: object) -> None:
    """`replay` repeats what is kept of a run, so every figure of it is the tables'."""
    run_campaign(plan_of(small_trial, tmp_path, small_trial.paths[:1]))
    job = plan_of(small_trial, tmp_path, small_trial.paths[:1]).jobs[0]
    tables = [store.tables_of(tmp_path, table, [job.run_id]) for table in ("runs", "hazards", "passages")]
    whole = TypeAdapter(RunOutcome).dump_python(outcome_of(job.run_id, "", 0.0, *tables), mode="json")
    for lies in ({}, {name: lie}):
        kept = {**whole, "proof": "kept", **lies}
        catalogue.keep(tmp_path, "complete", software_digest(), json.dumps([kept]).encode())
        found = [what for what, _, _ in verify(tmp_path).problems]
        assert found == [f".catalogue/complete, {job.run_id}" for _ in lies]


def test_a_copy_of_tables_that_cannot_be_read_is_no_answer(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_campaign(out, Configuration())
    poison(out)

    def unreadable(of: Path, table: str) -> pl.LazyFrame:
        if table == "passages":
            raise UsageError("was written by another build of the program")
        return read_table(of, table)

    read_table = store.read_table
    monkeypatch.setattr(store, "read_table", unreadable)
    assert [what for what, _, _ in verify(out).problems] == [".catalogue/runs", ".catalogue/passages"]


@pytest.mark.parametrize("entry", ["runs", "complete", "pages"])
def test_one_damaged_byte_means_not_there(out: Path, entry: str) -> None:
    file = out / ".catalogue" / entry
    if not file.exists():
        catalogue.keep(out, entry, "key", b"content")
    content = file.read_bytes()
    key = content.split(b"\n")[1].decode()
    assert catalogue.kept(out, entry, key) is not None
    for at in range(0, len(content), max(1, len(content) // 97)):
        damaged = bytearray(content)
        damaged[at] ^= 0x10
        file.write_bytes(damaged)
        assert catalogue.kept(out, entry, key) is None
    file.unlink()
    file.mkdir()
    assert catalogue.kept(out, entry, key) is None


def test_campaigns_keep_it(small_trial: SmallTrial, tmp_path: Path) -> None:
    run_campaign(plan_of(small_trial, tmp_path, small_trial.paths[:1]))
    assert is_fresh(tmp_path) == [True] * 4
    run_campaign(plan_of(small_trial, tmp_path, small_trial.paths[1:2]))
    assert is_fresh(tmp_path) == [True] * 4
    assert run_sql(tmp_path, "SELECT run_id FROM runs ORDER BY run_id")["run_id"].to_list() == ["run0", "run1"]


def test_a_run_that_came_or_went_makes_it_stale(out: Path) -> None:
    shutil.rmtree(out / "runs/run_id=run3")
    assert is_fresh(out) == [False] * 4
    assert run_sql(out, "SELECT run_id FROM runs ORDER BY run_id")["run_id"].to_list() == ["run0", "run1", "run2"]
    catalogue.gather(out)
    for table in ("runs", "hazards", "passages", "alarms"):
        shutil.copytree(out / table / "run_id=run0", out / table / "run_id=run9", dirs_exist_ok=True)
    assert is_fresh(out) == [False] * 4
    assert run_sql(out, "SELECT COUNT(*) AS n FROM runs")["n"].to_list() == [4]


def test_a_touched_file_makes_it_stale(out: Path) -> None:
    """Also one of the same size, put back to its old time."""
    file = out / "passages/run_id=run1/passages.parquet"
    stat = file.stat()
    file.write_bytes(file.read_bytes())
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert is_fresh(out) == [True, True, False, True]


def test_tables_of_another_build_are_no_catalogue(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files did not change, but the contract did: the runs' own files say what is wrong."""
    monkeypatch.setitem(catalogue.TABLES, "passages", catalogue.TABLES["alarms"])
    assert is_fresh(out) == [True, True, False, True]
    with pytest.raises(UsageError, match="written by another build"):
        run_sql(out, "SELECT * FROM passages")


def test_damaged_catalogue_is_none(out: Path) -> None:
    file = out / ".catalogue/runs"
    file.write_bytes(file.read_bytes()[:100])
    assert is_fresh(out) == [False, True, True, True]
    assert run_sql(out, "SELECT COUNT(*) AS n FROM runs")["n"].to_list() == [4]


def test_what_changes_while_it_is_read_is_not_kept(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(out / ".catalogue")
    read = store.read_table

    def read_and_touch(place: Path, table: str) -> pl.LazyFrame:
        frame = read(place, table)
        file = Path(store.table_address(out, "hazards", "run0"))
        file.write_bytes(file.read_bytes())
        return frame

    monkeypatch.setattr(store, "read_table", read_and_touch)
    catalogue.gather(out)
    assert is_fresh(out) == [True, False, True, True]


def test_no_copy_where_a_store_names_no_versions() -> None:
    import fsspec

    fsspec.filesystem("memory").pipe_file("/versions/runs/run_id=a/runs.parquet", b"x")
    assert storage.versions("memory://versions/runs", "runs.parquet") is None
    assert storage.versions("memory://versions/none", "runs.parquet") == {}
    assert version_of({"ETag": "abc", "size": 3, "LastModified": "noon"}) == "abc 3 noon"
    assert version_of({"etag": 'W/"abc"', "size": 3}) is None
