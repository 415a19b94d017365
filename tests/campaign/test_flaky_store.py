"""Object stores that err, shorten, alter and lose at every request: never a result of anything but what is there."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import storage
from pipeline.campaign import make_plan, run_campaign
from pipeline.results import store
from pipeline.results.marker import metadata_of
from pipeline.storage import files, object_store
from schemas.enums import RunStatus
from schemas.errors import BaliseError, InputError, UsageError
from schemas.tables import TABLES
from tests.campaign.compare import result_bytes
from tests.campaign.flaky import AILMENTS, Flaky
from tests.conftest import SmallTrial

BUCKET = "flaky://bucket"


@pytest.fixture(autouse=True)
def bucket(small_trial: SmallTrial, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The first run of the small trial in a store that is asked again without a pause."""
    monkeypatch.setattr(object_store, "_FIRST_PAUSE_S", 0.0)
    Flaky.store.clear()
    Flaky.well()
    for file in sorted(small_trial.paths[0].iterdir()):
        Flaky().pipe_file(f"/bucket/runs/run0/{file.name}", file.read_bytes())
    Flaky.well()
    yield
    Flaky.well()


def fetched() -> dict[str, bytes]:
    with storage.local_copy(f"{BUCKET}/runs/run0") as path:
        return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*")}


@pytest.mark.parametrize("ailment", AILMENTS)
def test_a_copy_is_what_the_store_holds(small_trial: SmallTrial, ailment: str) -> None:
    """The n-th request goes wrong, once or from then on, for all n."""
    wanted = {file.name: file.read_bytes() for file in small_trial.paths[0].iterdir()}
    assert fetched() == wanted
    requests = Flaky.count
    assert requests >= 4
    Flaky.ailment = ailment
    for number in range(1, requests + 1):
        for Flaky.lasting in (False, True):
            Flaky.count, Flaky.fail_at = 0, number
            found = None
            with contextlib.suppress(InputError):
                found = fetched()
            # That an object is not there is believed when it is not listed either; the run then fails for now.
            assert found == wanted or (found is None and (Flaky.lasting or ailment == "gone"))


@pytest.mark.parametrize("ailment", AILMENTS)
def test_a_run_whose_object_fails_for_a_while(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, ailment: str
) -> None:
    """It fails with a reason that does not last, and is the same as ever when the store is well again."""
    plan = make_plan([f"{BUCKET}/runs/run0"], small_trial.site, tmp_path)
    Flaky.ailment, Flaky.sick = ailment, "odometer.parquet"
    (sick,) = run_campaign(plan).outcomes
    assert (sick.status, sick.is_defect) == (RunStatus.FAILED, False)
    assert store.completed_runs(tmp_path)["run0"]["redo"] == "yes"
    Flaky.well()
    (well,) = run_campaign(plan).outcomes
    assert (well.status, well.skipped) == (RunStatus.OK, False)
    assert result_bytes(tmp_path) == {name: data for name, data in result_bytes(undisturbed).items() if "run0" in name}


@pytest.mark.parametrize(
    "question",
    [
        lambda: files.exists(f"{BUCKET}/runs/run0"),
        lambda: files.is_dir(f"{BUCKET}/runs/run0"),
        lambda: files.list_dir(f"{BUCKET}/runs"),
        lambda: storage.folders_in(f"{BUCKET}/runs"),
        lambda: storage.glob_remote(f"{BUCKET}/run*/**/*.parquet"),
        lambda: storage.glob_remote(f"{BUCKET}/*/run?"),
    ],
)
def test_no_answer_is_not_no(question: Callable[[], object]) -> None:
    """A store that failed to answer must not pass for one without the file."""
    wanted = question()
    assert wanted
    for number in range(1, Flaky.count + 1):
        Flaky.count, Flaky.fail_at, Flaky.lasting = 0, number, False
        assert question() == wanted
        Flaky.count, Flaky.lasting = 0, True
        with pytest.raises(BaliseError, match="Please reduce your request rate"):
            question()


def test_every_write_of_a_result_fails_in_turn(undisturbed: Path) -> None:
    """What is marked complete holds all tables of one replay: the old one or the new one."""
    old, new = (replace(store.read_run(undisturbed, run), run_id="r") for run in ("run1", "run2"))
    out = f"{BUCKET}/out"
    store.write_run(old, out, {"of": "old"})
    Flaky.count = 0
    store.write_run(new, out, {"of": "new"})
    for number in range(1, Flaky.count + 1):
        for lasting in (False, True):
            Flaky.well()
            store.write_run(old, out, {"of": "old"})
            Flaky.count, Flaky.fail_at, Flaky.lasting = 0, number, lasting
            with contextlib.suppress(BaliseError):
                store.write_run(new, out, {"of": "new"})
                assert not lasting or number > Flaky.count
            Flaky.well()
            made = {metadata_of(_content(out, name)).get("of") for name in TABLES if store.run_ids(out)}
            assert len(made) <= 1 or not files.exists(str(store.table_address(out, "runs", "r"))), (number, lasting)
            assert lasting or made == {"new"}


def _content(out: str, table: str) -> bytes:
    return storage.content_of(store.table_address(out, table, "r")) or b""


def test_runs_that_cannot_be_listed_end_the_command(small_trial: SmallTrial, tmp_path: Path) -> None:
    Flaky.fail_at, Flaky.lasting = 1, True
    with pytest.raises(UsageError, match=r"bucket/runs: the store .*Please reduce"):
        make_plan([f"{BUCKET}/runs"], small_trial.site, tmp_path)
