"""Logs, site and results in an object store that answers with errors and slowly."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from werkzeug.serving import BaseWSGIServer, make_server

from pipeline import storage
from pipeline.campaign import lock, make_plan, run_campaign
from pipeline.campaign.lock import hold_output
from pipeline.campaign.verify import verify
from pipeline.campaign.waits import WAITS
from pipeline.results import store
from pipeline.results.manifest import read_manifest
from pipeline.results.query import run_sql
from pipeline.storage import files, object_store
from schemas.enums import RunStatus
from schemas.errors import InputError, OutputError
from schemas.tables import TABLES
from tests.campaign.compare import by_run, result_bytes, wait_for
from tests.conftest import SmallTrial

SECRET = "not-for-anybodys-eyes"


class Moody:
    """A store in front of the store: every so often it refuses, or thinks before it answers."""

    def __init__(self) -> None:
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app  # takes long to load

        self.inner = DomainDispatcherApplication(create_backend_app)
        self.refuse_each = 0
        self.forbidden = ""
        self.answer_after_s = 0.0
        self.asked = 0
        self.refused = 0
        self.fetched: list[str] = []
        self.guard = threading.Lock()

    def __call__(self, environ: dict[str, Any], respond: Callable[..., Any]) -> Iterable[bytes]:
        path = environ["PATH_INFO"]
        with self.guard:
            self.asked += 1
            refuse = self.refuse_each > 0 and self.asked % self.refuse_each == 0
            self.refused += refuse
            if environ["REQUEST_METHOD"] == "GET" and not environ["QUERY_STRING"]:
                self.fetched.append(path)
        time.sleep(self.answer_after_s)
        if self.forbidden and self.forbidden in path:
            respond("403 Forbidden", [("Content-Type", "application/xml")])
            return [b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"]
        if refuse:
            time.sleep(0.05)
            respond("503 Slow Down", [("Content-Type", "application/xml")])
            return [b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"]
        answer: Iterable[bytes] = self.inner(environ, respond)
        return answer


@pytest.fixture(scope="module")
def s3() -> Iterator[Moody]:
    patch = pytest.MonkeyPatch()
    moody = Moody()
    server: BaseWSGIServer = make_server("127.0.0.1", 0, moody, threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
    patch.setenv("AWS_ACCESS_KEY_ID", "somebody")
    patch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    # What asks again is the program and its file system: the client below them takes random pauses of up to a second.
    patch.setenv("AWS_MAX_ATTEMPTS", "1")
    yield moody
    patch.undo()
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def bucket(s3: Moody, small_trial: SmallTrial) -> str:
    """The small trial in a bucket."""
    import s3fs

    remote = s3fs.S3FileSystem(use_listings_cache=False)
    remote.mkdir("trials")
    remote.put(f"{small_trial.site}/", "trials/site/", recursive=True)
    remote.put(f"{small_trial.runs}/", "trials/runs/", recursive=True)
    return "s3://trials"


def remote_bytes(out: str) -> dict[str, bytes]:
    names = [
        str(Path(str(store.table_address("", table, run_id)))) for table in TABLES for run_id in store.run_ids(out)
    ]
    found = storage.read_many([f"{out}/{name}" for name in names])
    return {place.removeprefix(f"{out}/"): data for place, data in found.items()}


def of_run0(result: dict[str, bytes]) -> dict[str, bytes]:
    return {name: data for name, data in result.items() if "run_id=run0" in name}


def of_two(result: dict[str, bytes]) -> dict[str, bytes]:
    """What a result holds of the first two runs: requests to the store of these tests take their time."""
    return {name: data for name, data in result.items() if "run_id=run0" in name or "run_id=run1" in name}


def test_same_bytes_as_on_disk(bucket: str, undisturbed: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    plan = make_plan([f"{bucket}/runs/run0", f"{bucket}/runs/run1"], f"{bucket}/site", f"{bucket}/out")
    assert run_campaign(plan, jobs=1).count(RunStatus.OK) == 2
    assert remote_bytes(f"{bucket}/out") == of_two(result_bytes(undisturbed))
    again = run_campaign(plan, jobs=1)
    assert (again.count_skipped, again.count(RunStatus.OK)) == (2, 2)
    request.getfixturevalue("in_process")
    local = run_campaign(make_plan([f"{bucket}/runs/run0", f"{bucket}/runs/run1"], f"{bucket}/site", tmp_path))
    assert local.count(RunStatus.OK) == 2
    remote, copied, on_disk = (read_manifest(out) or {} for out in (f"{bucket}/out", tmp_path, undisturbed))
    assert remote["runs"].keys() == {"run0", "run1"}
    for run_id, run in remote["runs"].items():
        assert run == on_disk["runs"][run_id]
    assert remote["sites"] == on_disk["sites"]
    assert remote["files"] == copied["files"]
    runs = store.read_table(f"{bucket}/out", "runs").collect()
    assert runs["run_id"].to_list() == ["run0", "run1"]


@pytest.mark.usefixtures("in_process")
def test_questions_to_a_store(bucket: str, small_trial: SmallTrial) -> None:
    out = f"{bucket}/asked"
    for count in (1, 2):
        run_campaign(make_plan([str(path) for path in small_trial.paths[:count]], small_trial.site, out))
        assert run_sql(out, "SELECT COUNT(*) AS n FROM runs")["n"].to_list() == [count]
        assert run_sql(out, "SELECT COUNT(DISTINCT run_id) AS n FROM campaign_runs")["n"].to_list() == [count]
    assert verify(out).problems == ()
    place = str(store.table_address(out, "passages", "run0"))
    storage.write_bytes(place, storage.read_many([place])[place] + b"more")
    assert [what for what, _, _ in verify(out).problems] == ["run run0, passages"]
    storage.remove(store.table_address(out, "runs", "run1"))
    assert [what for what, _, _ in verify(out).problems] == ["run run1", "run run0, passages"]


def test_what_others_write_is_seen_at_once(bucket: str) -> None:
    import s3fs

    folder = f"{bucket}/shared"
    with pytest.raises(InputError, match="shared: does not exist"):
        files.list_dir(folder)
    for count in (1, 2):
        s3fs.S3FileSystem(skip_instance_cache=True).pipe_file(f"trials/shared/{count}[a].csv", b"x" * count)
        assert len(files.list_dir(folder)) == count
    assert files.read_bytes(f"{folder}/2[a].csv") == b"xx"
    with files.open_binary(f"{folder}/2[a].csv") as stream:
        assert (stream.seek(1), stream.read()) == (1, b"x")
    with pytest.raises(InputError, match=r"3.csv: does not exist"):
        files.read_bytes(f"{folder}/3.csv")


@pytest.mark.usefixtures("in_process")
def test_store_that_refuses_now_and_then(
    s3: Moody, bucket: str, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(s3, "refuse_each", 9)
    plan = make_plan([f"{bucket}/runs/run[0]"], f"{bucket}/site", f"{bucket}/moody")
    assert run_campaign(plan).count(RunStatus.OK) == 1
    monkeypatch.setattr(s3, "refuse_each", 0)
    assert s3.refused > 0
    assert remote_bytes(f"{bucket}/moody") == of_run0(result_bytes(undisturbed))


@pytest.mark.usefixtures("in_process")
def test_store_that_answers_slowly(s3: Moody, bucket: str, undisturbed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3, "answer_after_s", 0.03)
    plan = make_plan([f"{bucket}/runs/run[0]"], f"{bucket}/site", f"{bucket}/slow")
    assert run_campaign(plan).count(RunStatus.OK) == 1
    assert remote_bytes(f"{bucket}/slow") == of_run0(result_bytes(undisturbed))


@pytest.mark.usefixtures("in_process")
def test_log_that_cannot_be_had_now_is_tried_again(
    s3: Moody, bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = make_plan([f"{bucket}/runs/run[12]"], f"{bucket}/site", tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(s3, "forbidden", "run2/")
        first = run_campaign(plan)
    assert (first.count(RunStatus.OK), first.count(RunStatus.FAILED)) == (1, 1)
    assert "the store refused" in (by_run(first)["run2"].error or "")
    again = run_campaign(plan)
    assert (again.count(RunStatus.OK), again.count_skipped) == (2, 1)


@pytest.mark.usefixtures("in_process")
def test_logs_are_not_fetched_again(s3: Moody, bucket: str, tmp_path: Path) -> None:
    plan = make_plan([f"{bucket}/runs/run[01]"], f"{bucket}/site", tmp_path)
    run_campaign(plan)
    assert any("/runs/run1/" in place for place in s3.fetched)
    s3.fetched.clear()
    assert run_campaign(plan).count_skipped == 2
    assert [place for place in s3.fetched if "/runs/" in place] == []
    shutil.rmtree(tmp_path / ".catalogue")
    assert run_campaign(plan).count_skipped == 2
    assert any("/runs/run1/" in place for place in s3.fetched)


def test_changed_log_in_a_store_is_replayed_again(bucket: str, small_trial: SmallTrial, tmp_path: Path) -> None:
    """Also where the object has the same size: the tag decides."""
    import s3fs

    remote = s3fs.S3FileSystem(use_listings_cache=False)
    remote.put(f"{small_trial.paths[0]}/", "trials/changing/run0/", recursive=True)
    plan = make_plan([f"{bucket}/changing/run0"], small_trial.site, tmp_path)
    assert [run_campaign(plan).count_skipped for _ in range(2)] == [0, 1]
    place = "trials/changing/run0/odometer.parquet"
    content = bytearray(remote.cat(place))
    content[content.index(b"ARROW:schema")] ^= 1
    remote.pipe(place, bytes(content))
    assert [run_campaign(plan).count_skipped for _ in range(2)] == [0, 1]


def test_log_that_changes_while_it_is_fetched(
    bucket: str, small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = iter(["first", "second"])
    monkeypatch.setattr(object_store, "_FIRST_PAUSE_S", 0.0)
    with monkeypatch.context() as patched:
        patched.setattr(storage, "version", lambda _: next(versions))
        outcome = run_campaign(make_plan([f"{bucket}/runs/run0"], small_trial.site, tmp_path)).outcomes[0]
    assert "changed while it was read" in (outcome.error or "")
    again = run_campaign(make_plan([f"{bucket}/runs/run0"], small_trial.site, tmp_path)).outcomes[0]
    assert (again.status, again.skipped) == (RunStatus.OK, False)


def test_store_that_is_not_there(bucket: str, small_trial: SmallTrial) -> None:
    plan = make_plan([str(small_trial.paths[0])], small_trial.site, "s3://no-such-bucket/out")
    with pytest.raises(OutputError, match="no-such-bucket") as caught:
        run_campaign(plan)
    assert SECRET not in str(caught.value)


@pytest.fixture
def _quick_beat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WAITS, "lock_beat_s", 0.4)
    # Nobody waits for all of it but who finds a lock of a dead campaign.
    monkeypatch.setattr(WAITS, "lock_silence_s", 60.0)


@pytest.mark.usefixtures("_quick_beat")
def test_one_campaign_at_a_time(bucket: str) -> None:
    out = f"{bucket}/held"
    with hold_output(out), pytest.raises(OutputError, match="another campaign is writing here"), hold_output(out):
        pass
    with hold_output(out):
        pass


@pytest.mark.usefixtures("_quick_beat")
def test_lock_that_was_taken_over_is_left_alone(bucket: str) -> None:
    place = f"{bucket}/taken/.lock"
    with hold_output(f"{bucket}/taken") as own:
        lock.check_held(f"{bucket}/taken", own)
        storage.write_bytes(place, b"another 0")
        with pytest.raises(OutputError, match="no longer held"):
            lock.check_held(f"{bucket}/taken", own)
        wait_for(lambda: not any(getattr(one, "_target", None) is lock._renew_lock for one in threading.enumerate()))
    assert storage.read_many([place]) == {place: b"another 0"}


@pytest.mark.usefixtures("_quick_beat")
def test_lock_of_a_dead_campaign_is_taken_over(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WAITS, "lock_silence_s", 1.0)
    storage.write_bytes(f"{bucket}/dead/.lock", b"somebody 7")
    with hold_output(f"{bucket}/dead"):
        assert b"somebody" not in storage.read_many([f"{bucket}/dead/.lock"])[f"{bucket}/dead/.lock"]
    assert storage.read_many([f"{bucket}/dead/.lock"]) == {}
