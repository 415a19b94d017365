"""Object stores that never come back: the campaign gives up on what is there, soon, and goes on with the rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline import storage
from pipeline.campaign import make_plan, run_campaign
from pipeline.storage import files, object_store
from schemas.enums import RunStatus
from schemas.errors import InputError, OutputError, SiteError, UsageError
from tests.campaign.compare import by_run, plan_of
from tests.conftest import SmallTrial

_PATIENCE_S = 0.5
# Clients that ask again by themselves wait for 60 s, five times over. A busy machine takes nothing like that.
_SOON_S = 150.0
# Of a store that is slow and no more, by a clock that stands but in its pauses: no busy machine makes it look dead.
_LONG_PATIENCE_S, _PAUSE_S = 15.0, 3.3
# Of real time in each pause: the campaign looks several times.
_REAL_PAUSE_S, _LOOK_S = 0.1, 0.02
_BLOCKS, _BLOCK = 6, b"x" * (1 << 16)
_LISTING = b"<ListBucketResult><Name>b</Name><IsTruncated>false</IsTruncated></ListBucketResult>"


class Pauses:
    """The clock of a store's client: it stands, but for the pauses of the store."""

    def __init__(self) -> None:
        self.now_s, self.silences_s, self._came = 0.0, list[float](), threading.Event()

    def use(self, patch: pytest.MonkeyPatch) -> None:
        arrived, silence_s = object_store._PatientStore.arrived, object_store._PatientStore.silence_s

        def arrives(store: object_store._PatientStore, *_: object) -> None:
            arrived(store)
            self._came.set()

        def silent_s(store: object_store._PatientStore) -> float:
            self.silences_s.append(silence_s.fget(store))  # type: ignore[attr-defined]
            return self.silences_s[-1]

        patch.setattr(object_store, "time", SimpleNamespace(monotonic=lambda: self.now_s, sleep=time.sleep))
        patch.setattr(object_store, "_LOOK_S", _LOOK_S)
        patch.setattr(object_store._PatientStore, "arrived", arrives)
        patch.setattr(object_store._PatientStore, "silence_s", property(silent_s))

    def pause(self) -> None:
        self.now_s += _PAUSE_S
        time.sleep(_REAL_PAUSE_S)
        self._came.clear()

    def wait_until_it_came(self) -> None:
        """What was sent: the next pause begins then, or at last where a client does not notice what comes."""
        self._came.wait(10.0)


class Ill(BaseHTTPRequestHandler):
    """Says 503, breaks off, says nothing, sends objects one by one or drop by drop: as its server's `ailment` is."""

    protocol_version = "HTTP/1.1"
    ailment = ""
    well = threading.Event()
    turn = threading.Lock()
    pauses = Pauses()

    def do_GET(self) -> None:
        if self.ailment == "busy":
            self._answer(503, b"<Error><Code>ServiceUnavailable</Code><Message>Come back later</Message></Error>")
        elif self.ailment == "silent":
            self.well.wait(300.0)
            self.close_connection = True
        elif self.ailment == "one by one":
            with self.turn:
                self.pauses.pause()
                self._answer(200, _BLOCK)
                self.pauses.wait_until_it_came()
        elif self.ailment == "slow":
            self._answer(200, _LISTING) if "list-type" in self.path else self._drip()
        else:
            self.connection.close()
            self.close_connection = True

    do_HEAD = do_PUT = do_POST = do_GET  # noqa: N815 - names that the base class looks for

    def log_message(self, *_: object) -> None:
        """Nothing in the tests' output."""

    def _drip(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(_BLOCKS * len(_BLOCK)))
        self.end_headers()
        for _ in range(0 if self.command == "HEAD" else _BLOCKS):
            self.pauses.pause()
            self.wfile.write(_BLOCK)
            self.pauses.wait_until_it_came()

    def _answer(self, status: int, content: bytes) -> None:
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


@pytest.fixture
def ill(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[str]:
    """The address of a bucket in a store with this ailment."""
    handler = type("Ailing", (Ill,), {"ailment": request.param, "well": threading.Event()})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "somebody")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("BALISE_STORE_PATIENCE_S", str(_PATIENCE_S))
    _forget_stores()
    yield f"s3://{request.param}"
    _forget_stores()
    handler.well.set()  # type: ignore[attr-defined]
    server.shutdown()
    server.server_close()
    thread.join()


def _forget_stores() -> None:
    """Connections are kept, and know where the store of the test before was."""
    import s3fs

    object_store._filesystem.cache_clear()
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("ill", ["busy", "silent", "broken"], indirect=True)
def test_run_in_a_dead_store_is_given_up(ill: str, small_trial: SmallTrial, tmp_path: Path) -> None:
    named = [f"{ill}/far.mcap", str(small_trial.paths[0])]
    begun_s = time.monotonic()
    summary = run_campaign(make_plan(named, small_trial.site, tmp_path))
    assert time.monotonic() - begun_s < _SOON_S
    outcomes = by_run(summary)
    assert outcomes["far"].status is RunStatus.FAILED
    assert "far.mcap: the store gave no usable answer for 0.5 s: " in (outcomes["far"].error or "")
    assert outcomes["far"].is_defect is False
    assert outcomes["run0"].status is RunStatus.OK


@pytest.mark.parametrize("ill", ["busy", "silent", "broken"], indirect=True)
def test_dead_store_ends_the_command_soon(ill: str, small_trial: SmallTrial, tmp_path: Path) -> None:
    """Site, runs and output are asked for before any work is done."""
    begun_s = time.monotonic()
    with pytest.raises(SiteError, match="no usable answer"):
        make_plan([str(small_trial.runs)], f"{ill}/site", tmp_path)
    with pytest.raises(UsageError, match="no usable answer"):
        make_plan([f"{ill}/runs"], small_trial.site, tmp_path)
    with pytest.raises(OutputError, match="no usable answer"):
        run_campaign(plan_of(small_trial, f"{ill}/out", small_trial.paths[:1]))
    assert time.monotonic() - begun_s < _SOON_S


# Each way of reading, and each ailment twice: what is ill is the store, whoever reads.
READERS = [files.exists, files.is_dir, files.list_dir, files.open_binary, files.read_bytes, files.size_of]


@pytest.mark.parametrize(
    ("ill", "read"), [*zip(["busy", "silent", "broken"] * 2, READERS, strict=True)], indirect=["ill"]
)
def test_reading_by_address_is_as_patient(
    ill: str, read: Callable[[str], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BALISE_STORE_PATIENCE_S", "0.3")
    begun_s = time.monotonic()
    with pytest.raises(InputError, match=r"far/track.csv: the store gave no usable answer for 0.3 s: "):
        read(f"{ill}/far/track.csv")
    assert time.monotonic() - begun_s < _SOON_S


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> Pauses:
    """The clock that the client of this test goes by."""
    monkeypatch.setenv("BALISE_STORE_PATIENCE_S", str(_LONG_PATIENCE_S))
    pauses = Pauses()
    monkeypatch.setattr(Ill, "pauses", pauses)
    pauses.use(monkeypatch)
    return pauses


@pytest.mark.parametrize("ill", ["slow"], indirect=True)
def test_slow_is_not_dead(ill: str, pauses: Pauses) -> None:
    """A download may take longer than the patience as long as something arrives."""
    with storage.local_copy(f"{ill}/far.mcap") as path:
        assert path.read_bytes() == _BLOCKS * _BLOCK
    assert pauses.now_s > _LONG_PATIENCE_S
    assert max(pauses.silences_s) >= _PAUSE_S, "the campaign did not look in a pause"


@pytest.mark.parametrize("ill", ["one by one"], indirect=True)
def test_many_objects_may_take_longer_than_the_patience(ill: str, pauses: Pauses) -> None:
    addresses = [f"s3://bucket/{name}" for name in range(5)]
    assert storage.read_many(addresses) == dict.fromkeys(addresses, _BLOCK)
    assert pauses.now_s > _LONG_PATIENCE_S
    assert max(pauses.silences_s) >= _PAUSE_S, "the campaign did not look in a pause"


def test_patience_is_under_a_minute_unless_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BALISE_STORE_PATIENCE_S", raising=False)
    assert object_store.patience_s() < 60.0
    monkeypatch.setenv("BALISE_STORE_PATIENCE_S", "7.5")
    assert object_store.patience_s() == 7.5
    for wrong in ("0", "-3", "nan", "soon"):
        monkeypatch.setenv("BALISE_STORE_PATIENCE_S", wrong)
        with pytest.raises(UsageError, match="BALISE_STORE_PATIENCE_S"):
            object_store.patience_s()


def test_what_is_wrong_for_good_is_not_asked_again() -> None:
    assert object_store._tries(FileNotFoundError()) == object_store._tries(PermissionError()) == 1
    assert object_store._tries(ValueError("no credentials")) < object_store._tries(OSError(16, "busy"))
