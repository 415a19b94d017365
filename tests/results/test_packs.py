"""Many runs in few files: nothing is lost, nothing is read twice, and every question has the same answer."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.campaign.compact import compact, undo
from pipeline.campaign.verify import NotCompared, verify
from pipeline.results import catalogue, packing, packs, store
from pipeline.results.diff import diff_results
from pipeline.results.manifest import write_manifest
from pipeline.results.query import run_sql
from pipeline.storage.parquet import GroupedFile, read_footer
from schemas.errors import UsageError
from schemas.run import RunTables
from schemas.tables import TABLES
from tests.results.test_store import METADATA, files_in, tables_of, value_of

AT = datetime(2026, 11, 23, tzinfo=UTC)


def with_alarms(run_id: str, count: int, availability: float = 0.5) -> RunTables:
    """A run of two solutions with so many alarms."""
    bare = tables_of(run_id, ("primary", "second"))
    known = {"solution": "primary", "t_start": AT, "t_end": AT, "verdict": "unknown", "suspect": "unknown"}
    rows = [
        {
            name: value_of(name, column, {**known, "alarm_id": number})
            for name, column in TABLES["alarms"].columns().items()
        }
        for number in range(count)
    ]
    alarms = pl.DataFrame(rows, schema=bare.alarms.schema)
    runs = bare.runs.with_columns(availability=pl.lit(availability))
    return RunTables(run_id, bare.hazards, bare.passages, alarms, bare.epochs, runs)


RUNS = {"a b": 2, "c/d": 0, "e": 3, "f": 1}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`RUNS` as they are written; not to be changed."""
    folder = tmp_path_factory.mktemp("written") / "out"
    for run_id, count in RUNS.items():
        store.write_run(with_alarms(run_id, count), folder, METADATA)
    return folder


@pytest.fixture(scope="module")
def packed(written: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The same in packs of so many runs; not to be changed."""
    folders = {}
    for runs in (3, 100):
        folders[runs] = Path(shutil.copytree(written, tmp_path_factory.mktemp("packed") / "out"))
        compact(folders[runs], runs_per_pack=runs)
    return folders


@pytest.fixture
def out(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "out"))


@pytest.fixture
def in_packs(packed: dict[int, Path], tmp_path: Path) -> Path:
    """In two packs."""
    return Path(shutil.copytree(packed[3], tmp_path / "out"))


@pytest.fixture
def in_one_pack(packed: dict[int, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(packed[100], tmp_path / "out"))


def content(out: Path) -> dict[str, list[tuple[object, ...]]]:
    """Every value of a result, and every marker."""
    tables = {name: store.read_table(out, name).collect().rows() for name in TABLES}
    markers = [(marker.run_id, marker.sha256, *sorted(marker.metadata.items())) for marker in store.markers(out)]
    return {**tables, "markers": [tuple(map(str, marker)) for marker in markers]}


def without_copies(out: Path) -> dict[str, bytes]:
    kept = (catalogue.FOLDER, "manifest.json", ".held")
    return {name: data for name, data in files_in(out).items() if not name.startswith(kept)}


def test_every_question_has_the_same_answer(out: Path, tmp_path: Path) -> None:
    before = content(out)
    shutil.copytree(out, tmp_path / "own")
    found = compact(out, runs_per_pack=3)
    assert (found.packed, found.packs, found.own, found.left_out) == (4, 2, 0, {})
    assert content(out) == before
    assert store.run_ids(out) == sorted(RUNS)
    assert diff_results(tmp_path / "own", out).is_same
    assert diff_results(out, tmp_path / "own").is_same
    asked = run_sql(out, "SELECT run_id, alarm_id FROM alarms WHERE run_id <> 'e' ORDER BY run_id, alarm_id")
    assert asked.rows() == [("a b", 0), ("a b", 1), ("f", 0)]
    assert run_sql(out, "SELECT run_id FROM runs WHERE run_id IN ('c/d', 'f') AND solution = 'second'").height == 2
    assert store.read_run(out, "c/d").alarms.is_empty()
    with pytest.raises(UsageError, match="has no run 'g'"):
        store.read_table(out, "alarms", "g")


def test_other_programs_read_the_files_of_packs(in_packs: Path) -> None:
    read = pl.scan_parquet(in_packs / "alarms/*/*.parquet", hive_partitioning=True, hive_schema={"run_id": pl.String})
    assert read.group_by("run_id").len().sort("run_id").collect().rows() == [("a b", 2), ("e", 3), ("f", 1)]


def test_out_of_packs_come_the_same_bytes(written: Path, in_packs: Path) -> None:
    before, out = without_copies(written), in_packs
    assert not any("run_id=" in name for name in without_copies(out))
    assert {store.content_of(out, name, "e") for name in TABLES} == {
        before[f"{name}/run_id=e/{name}.parquet"] for name in TABLES
    }
    undo(out)
    assert without_copies(out) == before


def test_runs_are_removed_from_packs(in_packs: Path) -> None:
    out = in_packs
    before = content(out)
    packing.remove_runs(out, ["c/d"])
    assert store.run_ids(out) == ["a b", "e", "f"]
    assert content(out) == {name: [row for row in rows if row[0] != "c/d"] for name, rows in before.items()}


def test_own_files_count_before_packs(in_packs: Path) -> None:
    """A run that was replayed again, and one that is new, beside packs; then packed again."""
    out = in_packs
    store.write_run(with_alarms("c/d", 4, availability=0.25), out, METADATA)
    store.write_run(with_alarms("d", 1), out, METADATA)
    counts = [("a b", 2), ("c/d", 4), ("d", 1), ("e", 3), ("f", 1)]
    both = content(out)
    for _ in range(2):
        assert run_sql(out, "SELECT run_id, count(*) AS n FROM alarms GROUP BY 1 ORDER BY 1").rows() == counts
        availability = run_sql(out, "SELECT availability FROM runs WHERE run_id = 'c/d'")
        assert availability["availability"].to_list() == [0.25, 0.25]
        assert content(out) == both
        compact(out, runs_per_pack=3)
    # Whoever reads the files of packs alone finds each run once.
    assert pl.read_parquet(out / "alarms/compact/*.parquet").height == 11
    assert sum(pack.runs for pack in packs.read_list(out)) == 5


def test_what_is_packed_stays_as_it_is(in_packs: Path) -> None:
    before = without_copies(in_packs)
    compact(in_packs, runs_per_pack=3)
    assert without_copies(in_packs) == before


class Killed(BaseException):
    """The process ends here."""


def kill_at(instant: int, patch: pytest.MonkeyPatch) -> None:
    """From this change of the disk on there is no other."""
    left = [instant]

    def deadly(change: Callable[..., None]) -> Callable[..., None]:
        def changed(*arguments: object, **named: object) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            change(*arguments, **named)

        return changed

    for name in ("replace", "unlink", "rmdir"):
        patch.setattr(os, name, deadly(getattr(os, name)))


def test_killed_at_any_instant_nothing_is_lost(tmp_path: Path) -> None:
    """With a run in a pack that has been replayed since, and a new one."""
    out = tmp_path / "out"
    for run_id in ("a b", "c/d"):
        store.write_run(with_alarms(run_id, 2), out, METADATA)
    compact(out, runs_per_pack=2)
    store.write_run(with_alarms("c/d", 4, availability=0.25), out, METADATA)
    store.write_run(with_alarms("b", 1), out, METADATA)
    expected = content(out)
    for instant in range(0, 1000, 13):
        trial = tmp_path / f"trial{instant}"
        shutil.copytree(out, trial)
        with pytest.MonkeyPatch.context() as patch:
            kill_at(instant, patch)
            try:
                compact(trial, runs_per_pack=2)
                break
            except Killed:
                pass
        assert content(trial) == expected, instant
        assert compact(trial, runs_per_pack=2).own == 0
        assert content(trial) == expected, instant
        assert pl.read_parquet(trial / "alarms/compact/*.parquet").height == 7
        assert not [name for name in without_copies(trial) if "run_id=" in name or name.endswith(".tmp")]
        shutil.rmtree(trial)
    assert instant > 30


def test_a_run_is_found_without_reading_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.results.packing._ROWS_PER_GROUP", 4)
    for number in range(8):
        store.write_run(with_alarms(f"r{number}", 2), tmp_path, METADATA)
    compact(tmp_path)
    read: list[list[int]] = []
    whole = GroupedFile.read
    monkeypatch.setattr(
        GroupedFile, "read", lambda file, groups, columns: (read.append(list(groups)), whole(file, groups, columns))[1]
    )
    assert store.read_table(tmp_path, "alarms", "r5").collect()["run_id"].to_list() == ["r5", "r5"]
    assert store.tables_of(tmp_path, "alarms", ["r0", "r6"], ["alarm_id"]).height == 4
    assert read == [[2], [0, 3]]


def test_a_file_that_is_not_what_its_marker_says_is_not_packed(out: Path) -> None:
    place = Path(store.table_address(out, "alarms", "e"))
    place.write_bytes(Path(store.table_address(out, "alarms", "f")).read_bytes())
    before = place.read_bytes()
    found = compact(out)
    assert found.left_out == {"e": "its table `alarms` is not the one that its marker names"}
    assert (found.packed, found.own) == (3, 1)
    assert place.read_bytes() == before


def test_what_another_build_wrote_is_not_packed(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would not come out again as it was."""
    before = without_copies(out)
    monkeypatch.setattr("pipeline.storage.parquet._has_dictionary", lambda _: False)
    found = compact(out)
    assert found.left_out.keys() == RUNS.keys()
    assert without_copies(out) == before


@pytest.mark.parametrize("place", ["list", "index", "table"])
def test_damage_is_an_error(in_one_pack: Path, place: str) -> None:
    out = in_one_pack
    (pack,) = packs.read_list(out)
    file = {"list": packs.LIST, "index": f"compact/{pack.name}.parquet", "table": f"runs/compact/{pack.name}.parquet"}
    data = bytearray((out / file[place]).read_bytes())
    data[len(data) // 3] ^= 0xFF
    (out / file[place]).write_bytes(bytes(data))
    with pytest.raises(UsageError, match="cannot be read"):
        store.read_table(out, "runs").collect()


def with_other_values(out: Path) -> Path:
    """The table `runs` of the first pack with a value changed by somebody who can write Parquet."""
    file = out / f"runs/compact/{packs.read_list(out)[0].name}.parquet"
    table = pq.read_table(file)
    at = table.column_names.index("availability")
    field = table.schema.field(at)
    other = table.set_column(at, field, pa.array([0.99] * table.num_rows, field.type))
    pq.write_table(other, file, compression="zstd", write_page_checksum=True)
    return file


def list_anew(out: Path, digests: dict[str, str]) -> None:
    """The list as somebody writes it who knows the program; of each file the end is that of the file there."""
    listed = json.loads((out / packs.LIST).read_text())
    first = listed["packs"][0]
    first["sha256"] = digests
    first["ends"] = {
        name: hashlib.sha256(read_footer(out / name / f"compact/{first['name']}.parquet")).hexdigest()
        for name in TABLES
    }
    (out / packs.LIST).write_text(json.dumps(listed))


def test_the_file_of_another_result_is_refused_when_it_is_read(in_one_pack: Path) -> None:
    """Without `verify`; whole in itself, and under the same name."""
    out = in_one_pack
    with_other_values(out)
    with pytest.raises(UsageError, match=r"runs/compact/.*many runs are in it: it is not the one that was packed"):
        run_sql(out, "SELECT availability FROM runs WHERE run_id = 'e'")
    assert {what.split("/")[0] for what, *_ in verify(out).problems} == {"runs"}


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
def test_what_was_cut_short_is_never_taken_for_whole(in_one_pack: Path, tmp_path: Path, share: float) -> None:
    out = in_one_pack
    for number, name in enumerate(sorted(name for name in files_in(out) if "compact/" in name)):
        trial = shutil.copytree(out, tmp_path / f"cut{number}")
        whole = (trial / name).read_bytes()
        (trial / name).write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(UsageError, match="cannot be read"):
            content(trial)
        with contextlib.suppress(UsageError):
            assert verify(trial).problems, name


def test_a_changed_pack_is_not_packed_again(in_one_pack: Path) -> None:
    """The new pack would be whole, and hide the change."""
    out = in_one_pack
    with_other_values(out)
    store.write_run(with_alarms("g", 1), out, METADATA)
    with pytest.raises(UsageError, match=r"runs/compact/.*not the one that was packed"):
        compact(out)
    list_anew(out, packs.read_list(out)[0].sha256)
    with pytest.raises(UsageError, match="cannot be made again byte for byte"):
        compact(out)


@pytest.mark.parametrize("by_this_build", [True, False])
def test_verify_holds_rows_of_packs_against_markers(
    out: Path, monkeypatch: pytest.MonkeyPatch, by_this_build: bool
) -> None:
    """Pack, list and manifest changed together: the markers still say what the runs' tables were."""
    with_build = {**METADATA, "software_digest": "this"}
    for run_id, count in RUNS.items():
        store.write_run(with_alarms(run_id, count), out, with_build)
    build = "this" if by_this_build else "another"
    monkeypatch.setattr("pipeline.campaign.verify.software_digest", lambda: build)
    compact(out)
    write_manifest(out)
    assert verify(out).problems == ()
    out = shutil.copytree(out, out.with_name("copy"))
    file = with_other_values(out)
    list_anew(out, packs.read_list(out)[0].sha256 | {"runs": hashlib.sha256(file.read_bytes()).hexdigest()})
    write_manifest(out)
    found = verify(out)
    assert {what for what, *_ in found.problems} == (
        {f"run {run}, runs in its pack" for run in RUNS} if by_this_build else set()
    )
    assert (NotCompared.PACKS in found.not_compared) is not by_this_build


def test_verify_sees_own_files_of_a_packed_run(written: Path, in_one_pack: Path) -> None:
    """Without their marker nobody but `**/*.parquet` reads them."""
    out = in_one_pack
    assert verify(out).problems == ()
    shutil.copytree(written / "alarms/run_id=e", out / "alarms/run_id=e")
    assert [what for what, *_ in verify(out).problems] == ["alarms/run_id=e/alarms.parquet"]


def test_a_list_that_names_no_table_cannot_be_read(in_one_pack: Path) -> None:
    out = in_one_pack
    list_anew(out, {"index": packs.read_list(out)[0].sha256["index"]})
    with pytest.raises(UsageError, match="not the digests of all files"):
        store.run_ids(out)


def test_in_an_object_store(out: Path) -> None:
    import fsspec

    fsspec.filesystem("memory").put(str(out), "/packs-test", recursive=True)
    address = "memory://packs-test"
    before = content(out)
    assert compact(address, runs_per_pack=3).packed == 4
    assert {name: store.read_table(address, name).collect().rows() for name in TABLES} == {
        name: before[name] for name in TABLES
    }
    store.write_run(with_alarms("c/d", 4), address, METADATA)
    assert run_sql(address, "SELECT run_id FROM alarms WHERE run_id = 'c/d'").height == 4
    undo(address)
    assert json.loads(json.dumps(store.run_ids(address))) == sorted(RUNS)
    assert packs.read_list(address) == []
