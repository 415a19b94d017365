"""What tests of several areas share: a small site with small runs on disk."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import hashlib
import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from schemas.run import RunLog, RunTables

# The process that hands out the tests loads this file before it starts the others, and needs nothing of the program:
# polars and what builds a trial are imported where they are used.

# The same examples every time, on a slow machine too.
settings.register_profile(
    "suite", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("suite")

# While everything is loaded there is no garbage, and afterwards little: looking for it each 700 objects takes longer
# than what it finds.
gc.disable()
_GARBAGE_AFTER = 50_000

_LENGTH_S = 40

# What a worker needs of the program. None of it starts threads of its own that a forked process would miss.
_LOADED = (
    "pipeline.campaign.worker",
    "pipeline.one_run",
    "pipeline.read.ingest.run",
    "pipeline.show.report.write",
)

# Tables of replays by what was asked: run, site, vehicle and configuration, with all that is in them.
_REPLAYED: dict[bytes, RunTables] = {}

# Not part of `make quick`: tests that start processes, draw many random numbers, or replay one journey after the other.
_SLOW = (
    "studies/calibration",
    "campaign",
    "cli",
    "datasets/test_demo.py",
    "datasets/test_inject.py",
    "datasets/test_recordings.py",
    "datasets/test_samples.py",
    "datasets/test_sky.py",
    "datasets/test_trial.py",
    "results/diff/test_diff_results.py",
    "docs/test_commands.py",
    "docs/test_queries.py",
    "experiment",
    "show/export",
    "golden",
    "read/ingest/test_damage.py",
    "read/ingest/test_fuzz.py",
    "read/ingest/test_hostile.py",
    "read/ingest/test_json.py",
    "read/ingest/test_oracle.py",
    "stages/judge/test_clean.py",
    "stages/judge/test_defects.py",
    "stages/judge/test_ladder.py",
    "stages/lds/test_invariants.py",
    "stages/lds/test_outages.py",
    "studies/line",
    "stages/matching/test_calibration.py",
    "stages/matching/test_travelled_route.py",
    "stages/odometry/test_properties.py",
    "stages/odometry/test_quantisation.py",
    "studies/plausibility",
    "stages/monitors/test_pseudorange.py",
    "project/test_run.py",
    "project/test_trial.py",
    "replay/test_channels.py",
    "replay/test_evidence.py",
    "replay/test_moving.py",
    "replay/test_properties.py",
    "replay/test_random_trials.py",
    "show/report",
    "results/test_manifest.py",
    "stages/run_row/test_summary.py",
    "studies/undetected/test_replay.py",
)
# The cheap ones of a slow folder: each room has some question that `make quick` asks.
_QUICK = (
    "campaign/test_plan.py",
    "experiment/test_constellation.py",
    "experiment/test_rare_recorded.py",
    "show/export/test_gis.py",
    "show/export/test_places.py",
    "studies/line/test_replayed.py",
    "studies/plausibility/test_copies.py",
    "show/report/test_verdict.py",
)

_SLOW_PLACES = tuple(f"{place}/" for place in _SLOW)

_HERE = Path(__file__).parent


def _is_slow(path: Path) -> bool:
    # As text: of some hundred files and places that is quicker than paths by a quarter of a second.
    name = path.relative_to(_HERE).as_posix()
    return name not in _QUICK and f"{name}/".startswith(_SLOW_PLACES)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """What `make quick` leaves out is not even loaded."""
    quick = config.option.markexpr == "not slow"
    return True if quick and collection_path.suffix == ".py" and _is_slow(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `make quick` leaves out."""
    slow = {path for path in {item.path for item in items} if _is_slow(path)}
    for item in items:
        if item.path in slow:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """What is loaded now stays until the end: nobody needs to look through it for garbage, not even once."""
    gc.freeze()
    gc.set_threshold(_GARBAGE_AFTER)
    gc.enable()


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Campaigns and pages are made here: for tests that are not about workers, which take seconds to start."""
    work_here(monkeypatch)


def work_here(patch: pytest.MonkeyPatch) -> None:
    """As `in_process`, for a fixture of a module."""
    from pipeline.campaign import run
    from pipeline.campaign.engines import SerialEngine
    from pipeline.results import workers

    patch.setattr(os, "cpu_count", lambda: 1)
    patch.setattr(run, "_engine_for", lambda jobs, runs, scheduler, limit_s: SerialEngine(limit_s))
    patch.setattr(workers, "ProcessPoolExecutor", lambda count, mp_context: contextlib.nullcontext(_Here()))


@pytest.fixture
def replayed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a log comes to is worked out once in this process: for tests of what is around a replay, not of replays."""
    from pipeline import one_run

    monkeypatch.setattr(one_run, "replay", _remembered(one_run.replay))


def _remembered(replay: Callable[..., RunTables]) -> Callable[..., RunTables]:

    def once(*asked: object) -> RunTables:
        key = hashlib.sha256(pickle.dumps(asked)).digest()
        if key not in _REPLAYED:
            _REPLAYED[key] = replay(*asked)
        return _REPLAYED[key]

    return once


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers are forked from one process that has loaded the program: for tests of what becomes of them later.

    How they start on this machine is the subject of `campaign/test_local.py` and `campaign/test_interruptions.py`.
    """
    multiprocessing.set_forkserver_preload(list(_LOADED))
    monkeypatch.setattr("pipeline.campaign.engines._KnownProcesses", _Forked)
    monkeypatch.setattr("pipeline.results.workers.get_context", lambda _: multiprocessing.get_context("forkserver"))


class _Forked(ForkServerContext):
    """As `engines._KnownProcesses`."""

    def __init__(self) -> None:
        self.made: list[ForkServerProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> ForkServerProcess:  # type: ignore[override]  # noqa: N802
        self.made.append(ForkServerProcess(*args, **kwargs))
        return self.made[-1]


class _Here:
    """Does pieces of work here, each on a copy as a process would get it."""

    def map(self, function: Callable[[object], object], tasks: Sequence[object]) -> Iterator[object]:
        for task in tasks:
            work, given = pickle.loads(pickle.dumps((function, task)))
            yield pickle.loads(pickle.dumps(work(given)))


@dataclass(frozen=True)
class SmallTrial:
    """Four short cuts of one journey, and the site they are on."""

    site: Path
    runs: Path

    @property
    def paths(self) -> list[Path]:
        return sorted(self.runs.iterdir())


def cut(run: RunLog, run_id: str, begin_s: int, length_s: int = _LENGTH_S) -> RunLog:
    """The part of a run from `begin_s` after its start."""
    import polars as pl

    from schemas.run import RunLog

    start = run.gnss["t"].min() + pl.duration(seconds=begin_s)  # type: ignore[operator]
    inside = pl.col("t").is_between(start, start + pl.duration(seconds=length_s))
    odometer = run.odometer.filter(inside) if run.odometer is not None else None
    return RunLog(run_id=run_id, gnss=run.gnss.filter(inside), odometer=odometer)


Shared = Callable[[str, Callable[[Path], object]], Path]
"""Name of a folder, and what fills it; gives the folder, which is not to be changed."""


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """A folder that is made once, by whichever of the test processes needs it first."""
    top = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        top = top.parent

    def folder(name: str, fill: Callable[[Path], object]) -> Path:
        with (top / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (top / name).exists():
                (top / f"{name}.part").mkdir()
                fill(top / f"{name}.part")
                (top / f"{name}.part").rename(top / name)
        return top / name

    return folder


@pytest.fixture(scope="session")
def small_trial(shared: Shared) -> SmallTrial:
    folder = shared("small-trial", _write_small_trial)
    return SmallTrial(folder / "site", folder / "runs")


def _write_small_trial(folder: Path) -> None:
    from datasets.demo import demo_scenario
    from datasets.trial import build_run, build_site, write_run_log, write_site

    scenario = demo_scenario()
    spec = next(run for run in scenario.runs if run.id == "outage")
    run = build_run(scenario, spec)
    write_site(build_site(scenario), folder / "site")
    for number in range(4):
        write_run_log(cut(run, f"run{number}", 40 + 15 * number), folder / "runs")
