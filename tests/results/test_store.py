"""What stands on disk after a run is written, whole or interrupted."""

from __future__ import annotations

import contextlib
import hashlib
import json
import random
import time
from collections.abc import Mapping
from pathlib import Path

import dataframely as dy
import polars as pl
import pyarrow.parquet as pq
import pytest

from pipeline import storage
from pipeline.campaign import find_runs
from pipeline.results import store
from pipeline.results.query import run_sql
from pipeline.show.terminal import table_lines, to_json
from pipeline.storage import files
from pipeline.storage.address import Address, redacted, stem_of
from pipeline.storage.parquet import parquet_bytes
from schemas.config import Configuration
from schemas.errors import InputError, OutputError, UsageError
from schemas.run import RunTables
from schemas.tables import CONTRACT_VERSION, TABLES

METADATA = {"software": "balise test", "config_digest": "c", "log_digest": "l"}


def tables_of(run_id: str, solutions: tuple[str, ...] = ("primary",)) -> RunTables:
    """A run without content but for its `runs` rows."""
    blank = {"status": "ok", "config_digest": "c", "input_digest": "i", "software": "s", "contract": "1"}
    rows = [
        {
            name: value_of(name, column, {**blank, "solution": solution})
            for name, column in TABLES["runs"].columns().items()
        }
        for solution in solutions
    ]
    runs = pl.DataFrame(rows, schema=TABLES["runs"].create_empty().schema)
    return RunTables(
        run_id=run_id, runs=runs, **{name: table.create_empty() for name, table in TABLES.items() if name != "runs"}
    )


def value_of(name: str, column: dy.Column, known: Mapping[str, object]) -> object:
    if name in known:
        return known[name]
    if column.nullable:
        return None
    return [] if isinstance(column, dy.List) else 0


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_layout_and_metadata(tmp_path: Path) -> None:
    store.write_run(tables_of("r1"), tmp_path, METADATA)
    assert sorted(files_in(tmp_path)) == sorted(f"{name}/run_id=r1/{name}.parquet" for name in TABLES)
    found = pq.read_metadata(tmp_path / "runs/run_id=r1/runs.parquet")
    metadata = {key.decode(): value.decode() for key, value in found.metadata.items() if key.startswith(b"balise.")}
    others = [name for name in TABLES if name != "runs"]
    files = {name: (tmp_path / f"{name}/run_id=r1/{name}.parquet").read_bytes() for name in others}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    assert json.loads(metadata.pop("balise.tables")) == digests
    expected = {**METADATA, "run_id": "r1", "table": "runs", "contract": CONTRACT_VERSION}
    assert metadata == {f"balise.{key}": value for key, value in expected.items()}
    assert found.row_group(0).column(0).compression == "ZSTD"


def test_every_field_tells_unit_and_meaning(tmp_path: Path) -> None:
    store.write_run(tables_of("r1"), tmp_path, METADATA)
    for name, contract in TABLES.items():
        schema = pq.read_schema(tmp_path / f"{name}/run_id=r1/{name}.parquet")
        noted = {
            field.name: (field.metadata[b"unit"].decode(), field.metadata[b"meaning"].decode()) for field in schema
        }
        columns = contract.columns().items()
        assert noted == {column: ((rule.metadata or {}).get("unit", ""), rule.description) for column, rule in columns}
        assert store.read_table(tmp_path, name, "r1").drop("run_id").collect_schema() == contract.create_empty().schema


def test_same_content_same_bytes(tmp_path: Path) -> None:
    store.write_run(tables_of("r1"), tmp_path / "a", METADATA)
    store.write_run(tables_of("r1"), tmp_path / "b", dict(reversed(METADATA.items())))
    store.write_run(tables_of("r1"), tmp_path / "b", METADATA)
    assert files_in(tmp_path / "a") == files_in(tmp_path / "b")


@pytest.mark.parametrize("run_id", ["r1", "007", "2024-01-02", "a b", "ü%20", "a=b", "x;y:z", "copy[1]", "s*"])
def test_any_run_id_comes_back(tmp_path: Path, run_id: str) -> None:
    store.write_run(tables_of(run_id), tmp_path, METADATA)
    assert store.run_ids(tmp_path) == [run_id]
    assert store.read_table(tmp_path, "runs").collect()["run_id"].to_list() == [run_id]
    assert store.read_table(tmp_path, "runs", run_id).collect()["run_id"].to_list() == [run_id]
    assert store.completed_runs(tmp_path)[run_id]["log_digest"] == "l"
    assert run_sql(tmp_path, "SELECT run_id FROM runs").rows() == [(run_id,)]


@pytest.mark.parametrize("folder", ["trial=3", "run_id=7", "hazard=none/trial=3", "t[1]", "t{a}*"])
def test_any_output_folder_is_read(tmp_path: Path, folder: str) -> None:
    out = tmp_path / folder
    for run_id in ("b", "a"):
        store.write_run(tables_of(run_id), out, METADATA)
    assert store.read_table(out, "runs").collect()["run_id"].to_list() == ["a", "b"]
    assert store.small_tables(out)["runs"]["run_id"].to_list() == ["a", "b"]
    assert run_sql(out, "SELECT run_id FROM hazards").height == 0
    assert run_sql(out, "SELECT run_id FROM runs WHERE run_id = 'b'").rows() == [("b",)]


def test_tables_of_several_runs(tmp_path: Path) -> None:
    for run_id in ("b", "a"):
        store.write_run(tables_of(run_id, ("gps", "egnos")), tmp_path, METADATA)
    runs = store.read_table(tmp_path, "runs").collect()
    assert runs.select("run_id", "solution").rows() == [("a", "gps"), ("a", "egnos"), ("b", "gps"), ("b", "egnos")]
    assert dict(runs.schema) == {"run_id": pl.String(), **TABLES["runs"].create_empty().schema}
    assert store.completed_runs(tmp_path)["a"]["log_digest"] == "l"


def test_empty_result_has_the_schema(tmp_path: Path) -> None:
    hazards = store.read_table(tmp_path, "hazards").collect()
    assert hazards.height == 0
    assert hazards.columns == ["run_id", *TABLES["hazards"].column_names()]


def test_run_without_marker_does_not_count(tmp_path: Path) -> None:
    for run_id in ("a", "b"):
        store.write_run(tables_of(run_id), tmp_path, METADATA)
    (tmp_path / "runs/run_id=b/runs.parquet").unlink()
    folders = ("epochs/run_id=a/.epochs.parquet", "campaign/.runs.parquet", ".catalogue/.runs", ".config.toml")
    leftovers = [tmp_path / f"{name}.0123456789ab.tmp" for name in folders]
    for leftover in leftovers:
        leftover.parent.mkdir(exist_ok=True)
        leftover.write_bytes(b"cut short")
    of_somebody = tmp_path / ".notes.tmp"
    of_somebody.touch()
    assert store.run_ids(tmp_path) == ["a"]
    store.sweep(tmp_path)
    assert not any("run_id=b" in name for name in files_in(tmp_path) if not name.startswith("runs"))
    assert not any(leftover.exists() for leftover in leftovers)
    of_somebody.unlink()
    assert len(files_in(tmp_path)) == len(TABLES)


@pytest.mark.parametrize("failing", range(5))
def test_interrupted_write_leaves_no_half_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    calls = 0
    stage = storage.stage

    def stage_or_stop(address: Path, content: bytes) -> tuple[Address, Address]:
        nonlocal calls
        calls += 1
        if calls == failing + 1:
            raise KeyboardInterrupt
        return stage(address, content)

    monkeypatch.setattr(storage, "stage", stage_or_stop)
    with pytest.raises(KeyboardInterrupt):
        store.write_run(tables_of("r"), tmp_path, METADATA)
    assert files_in(tmp_path) == {}


def test_redo_is_unmarked_until_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store.write_run(tables_of("r"), tmp_path, METADATA)

    def stop(staged: list[tuple[Address, Address]]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(storage, "commit", stop)
    with pytest.raises(KeyboardInterrupt):
        store.write_run(tables_of("r"), tmp_path, METADATA)
    assert store.run_ids(tmp_path) == []


def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file is in the way")
    with pytest.raises(OutputError, match=r"out.*cannot be written: Not a directory.*--out"):
        store.write_run(tables_of("r"), tmp_path / "out", METADATA)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("distance_m", pl.lit(float("nan")), "distance_m holds NaN"),
        ("epochs", pl.lit(None, pl.Int64), "epochs holds null"),
    ],
)
def test_breach_of_the_contract_is_refused(tmp_path: Path, column: str, value: pl.Expr, message: str) -> None:
    tables = tables_of("r")
    broken = tables.runs.with_columns(value.alias(column))
    with pytest.raises(ValueError, match=message):
        store.write_run(RunTables(**{**tables.__dict__, "runs": broken}), tmp_path, METADATA)
    assert files_in(tmp_path) == {}


def test_unknown_enum_is_refused(tmp_path: Path) -> None:
    tables = tables_of("r")
    broken = tables.runs.with_columns(status=pl.lit("fine"))
    with pytest.raises(pl.exceptions.PolarsError, match="fine"):
        store.write_run(RunTables(**{**tables.__dict__, "runs": broken}), tmp_path, METADATA)
    assert files_in(tmp_path) == {}


def test_unknown_names(tmp_path: Path) -> None:
    store.write_run(tables_of("r"), tmp_path, METADATA)
    with pytest.raises(UsageError, match="is not a table"):
        store.read_table(tmp_path, "epoch")
    with pytest.raises(UsageError, match=r"has no run 'other'; found r$"):
        store.read_table(tmp_path, "epochs", "other")
    with pytest.raises(UsageError, match="has no run 'r'; found no complete run"):
        store.read_table("memory://nowhere", "epochs", "r")


def test_a_table_that_is_gone_from_a_complete_run_is_missed_and_not_left_out(tmp_path: Path) -> None:
    for out in (tmp_path, "memory://lost-table/out"):
        for run_id in ("a", "b"):
            store.write_run(tables_of(run_id), out, METADATA)
        storage.remove(store.table_address(out, "hazards", "a"))
        with pytest.raises(UsageError, match="run a, table `hazards`: cannot be read"):
            store.read_table(out, "hazards").collect()


def test_config_is_written_resolved(tmp_path: Path) -> None:
    store.write_config(tmp_path, Configuration())
    assert "ci_limit_m = 14.0" in (tmp_path / "config.toml").read_text()


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("s3://key:secret@bucket/run", "s3://bucket/run"),
        ("https://store/run?X-Amz-Signature=abc refused", "https://store/run refused"),
        ("key AKIAIOSFODNN7EXAMPLE refused", "key  refused"),
        ("/data/run.mcap: damaged", "/data/run.mcap: damaged"),
        ("s3://KEY:sec/ret@bucket/run.mcap: damaged", "s3://bucket/run.mcap: damaged"),
        ("s3://KEY:sec/ret", "s3://"),
        ("http://user:p@ss/word@store/run", "http://store/run"),
        ("s3://bucket/run@2.mcap", "s3://bucket/run@2.mcap"),
        ("tcp://10.0.0.1:8786 does not answer", "tcp://10.0.0.1:8786 does not answer"),
    ],
)
def test_secrets_are_taken_out(text: str, clean: str) -> None:
    assert redacted(text) == clean


def test_remote_store_holds_the_same_bytes(tmp_path: Path) -> None:
    out = "memory://store-test/out"
    for run_id in ("a", "b c"):
        store.write_run(tables_of(run_id), out, METADATA)
        store.write_run(tables_of(run_id), tmp_path, METADATA)
    assert store.run_ids(out) == ["a", "b c"]
    assert store.completed_runs(out) == store.completed_runs(tmp_path)
    local = store.read_table(tmp_path, "runs").collect()
    assert store.read_table(out, "runs").collect().equals(local)
    for name in TABLES:
        place = str(store.table_address(out, name, "b c"))
        assert storage.read_many([place])[place] == Path(store.table_address(tmp_path, name, "b c")).read_bytes()
    storage.remove(store.table_address(out, "runs", "a"))
    store.sweep(out)
    assert store.run_ids(out) == ["b c"]
    assert storage.read_many([str(store.table_address(out, "epochs", "a"))]) == {}


def as_of_another_build(out: object, run_id: str) -> None:
    """The run's `runs` file lacks a column and has another in another type."""
    place = store.table_address(out, "runs", run_id)  # type: ignore[arg-type]
    content = storage.read_many([str(place)])[str(place)] if str(out).startswith("memory") else Path(place).read_bytes()
    frame = pl.read_parquet(content).drop("notes").cast({"outages": pl.Int32})
    storage.write_bytes(place, parquet_bytes(frame, {}))


@pytest.mark.parametrize("remote", [False, True])
def test_results_of_another_build_are_named(tmp_path: Path, remote: bool) -> None:
    out = "memory://another-build/out" if remote else tmp_path
    for run_id in ("a", "b"):
        store.write_run(tables_of(run_id), out, METADATA)
    as_of_another_build(out, "b")
    message = "run b, table `runs`: .* another build .* found outages, notes missing or of.*[Rr]eplay"
    with pytest.raises(UsageError, match=message):
        store.read_table(out, "runs").collect()
    assert store.read_table(out, "runs", "a").collect().height == 1
    assert store.read_table(out, "hazards").collect().height == 0


def test_configuration_comes_back(tmp_path: Path) -> None:
    assert store.read_config(tmp_path) is None
    config = Configuration.model_validate({"lds": {"ci_limit_m": 12.5}, "safety": {"demands_per_hour": 64.0}})
    store.write_config(tmp_path, config)
    assert store.read_config(tmp_path) == config


def test_configuration_of_another_build_is_one_message(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("[matching]\nbias_sigma_m = 2.0\n")
    with pytest.raises(UsageError, match=r"config.toml: was not written by this build.*bias_sigma_m.*[Rr]eplay"):
        store.read_config(tmp_path)


@pytest.mark.parametrize(
    "sql", ["DROP TABLE runs", "truncate table runs", "CREATE TABLE x AS SELECT * FROM runs", "show runs", "", "-- x"]
)
def test_results_are_only_read(tmp_path: Path, sql: str) -> None:
    store.write_run(tables_of("r1"), tmp_path, METADATA)
    with pytest.raises(UsageError, match=r"is not a query.*found.*SELECT"):
        run_sql(tmp_path, sql)


@pytest.mark.parametrize(
    "sql",
    [
        "  -- all\n/* of\nthem */ SELECT run_id FROM runs",
        "with a as (select run_id from runs) select run_id from a",
        "(select run_id from runs)",
    ],
)
def test_queries_in_any_dress_are_answered(tmp_path: Path, sql: str) -> None:
    store.write_run(tables_of("r1"), tmp_path, METADATA)
    assert run_sql(tmp_path, sql).rows() == [("r1",)]


@pytest.mark.parametrize("address", ["s3://KEY:sec/ret@bucket/run.mcap", "s3://KEY:sec@bucket", "s3a://KEY:sec/ret"])
def test_a_key_in_the_address_of_a_bucket_is_refused_and_not_repeated(address: str) -> None:
    for read in (store.run_ids, files.exists, lambda name: find_runs([name])):
        with pytest.raises(UsageError, match="AWS_ACCESS_KEY_ID") as caught:
            read(address)
        assert "sec" not in str(caught.value)


def test_a_signature_is_no_part_of_a_run_id() -> None:
    assert stem_of("https://host/runs/run7.mcap?X-Amz-Signature=abc") == "run7"
    assert stem_of("s3://bucket/run7?.mcap") == "run7?"


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT * FROM read_csv('{file}')",
        "select * from READ_CSV('{file}')",
        "SELECT * FROM \"read_csv\"('{file}')",
        "SELECT * FROM read_csv /* of all */ ('{file}')",
        "WITH a AS (SELECT * FROM read_csv('{file}')) SELECT * FROM a",
        "SELECT run_id FROM runs UNION ALL SELECT * FROM read_csv('{file}')",
    ],
)
def test_sql_reads_other_files_only_when_it_may(tmp_path: Path, sql: str) -> None:
    store.write_run(tables_of("r1"), tmp_path / "out", METADATA)
    (tmp_path / "secret.csv").write_text("run_id\nsecret\n")
    query = sql.format(file=tmp_path / "secret.csv")
    with pytest.raises(UsageError, match=r"reads files outside the result.*--allow-files"):
        run_sql(tmp_path / "out", query)
    assert "secret" in run_sql(tmp_path / "out", query, allow_files=True)["run_id"].to_list()


def test_any_query_has_an_answer_or_one_message(tmp_path: Path) -> None:
    """Seeded random SQL, and what once took minutes: many empty comments."""
    store.write_run(tables_of("r1"), tmp_path, METADATA)
    words = [
        *(
            "SELECT",
            "FROM",
            "WHERE",
            "runs",
            "hazards",
            "epochs",
            "run_id",
            "t",
            "hazard",
            "(",
            ")",
            ",",
            "*",
            "1",
            "-1",
        ),
        *("1e308", "'x'", "NULL", "IS", "NOT", "AND", "OR", "=", "<", "+", "/", "COUNT(*)", "SUM(", "GROUP BY", "AS a"),
        *("ORDER BY", "LIMIT", "JOIN", "USING (run_id)", "UNION ALL", "CASE", "WHEN", "THEN", "END", "CAST(", "[", ";"),
    ]
    draw = random.Random(11)
    for _ in range(300):
        sql = "SELECT " + " ".join(draw.choices(words, k=draw.randint(1, 14)))
        with contextlib.suppress(UsageError):
            assert isinstance(run_sql(tmp_path, sql), pl.DataFrame), sql
    begun_s = time.process_time()
    assert run_sql(tmp_path, "/**/" * 2000 + "SELECT run_id FROM runs").height == 1
    with pytest.raises(UsageError, match="is not a query"):
        run_sql(tmp_path, "/**/" * 2000 + "DROP")
    assert time.process_time() - begun_s < 10.0


def test_control_characters_are_shown_and_not_sent() -> None:
    title = "\x1b]0;owned\x07\x9b31m\u202e\n"
    frame = pl.DataFrame({"name": [title]})
    for text in ("\n".join(table_lines(frame)), to_json(frame), str(InputError("bad", place=title))):
        assert not set(text) & {"\x1b", "\x07", "\x9b"}
    assert table_lines(frame)[-1] == r"\x1b]0;owned\x07\x9b31m\u202e\n"
    assert json.loads(to_json(frame))[0]["name"] == title
