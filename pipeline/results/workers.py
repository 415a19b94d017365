"""Independent pieces of work on several processes; results in the order of the tasks, whatever the number."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing import get_context
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

_PROGRESS: ContextVar[Callable[[int, int], None] | None] = ContextVar("progress", default=None)
_THREADS = (
    "POLARS_MAX_THREADS",
    "RAYON_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OMP_NUM_THREADS",
)


def map_in_processes(function: Callable[[T], R], tasks: Sequence[T], jobs: int) -> list[R]:
    """`function` of every task; `jobs` processes, or this one for a single job or task."""
    return [result for _, result in zip(with_progress(tasks), each_in_processes(function, tasks, jobs), strict=True)]


def with_progress(items: Collection[T]) -> Iterator[T]:
    """The items, one after the other; whoever watches hears how many of how many are done."""
    for done, item in enumerate(items, start=1):
        yield item
        tell(done, len(items))


def tell(done: int, total: int) -> None:
    """Report progress to whoever waits for it."""
    if (progress := _PROGRESS.get()) is not None:
        progress(done, total)


@contextmanager
def watched(progress: Callable[[int, int], None] | None) -> Iterator[None]:
    """Tell how many of how many tasks of each `mapped`, and items of each `with_progress` inside are done."""
    before = _PROGRESS.set(progress)
    try:
        yield
    finally:
        _PROGRESS.reset(before)


def each_in_processes(function: Callable[[T], R], tasks: Sequence[T], jobs: int) -> Iterator[R]:
    """Results as of `mapped`, one after the other as soon as it and those before it are there."""
    workers = min(jobs, len(tasks))
    if workers <= 1:
        yield from map(function, tasks)
        return
    with single_threaded_children(), ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(function, tasks)


@contextmanager
def single_threaded_children() -> Iterator[None]:
    """Processes started meanwhile have one thread: several of them use the cores better than threads in one."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
