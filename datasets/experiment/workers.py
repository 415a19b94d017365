"""Independent pieces of work on several processes; results in the order of the tasks, whatever the number."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

import numpy as np

T = TypeVar("T")
R = TypeVar("R")

_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


def mapped(function: Callable[[T], R], tasks: Sequence[T], jobs: int) -> list[R]:
    """`function` of every task; `jobs` processes, or this one for a single job or task."""
    workers = min(jobs, len(tasks))
    if workers <= 1:
        return [function(task) for task in tasks]
    with _single_threaded_children(), ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return list(pool.map(function, tasks))


def generator(*key: int) -> np.random.Generator:
    """A stream of its own for every key (seed, piece of work, ...), whoever draws from it and when."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))


def in_blocks(total: int, size: int) -> list[int]:
    """Sizes of blocks that make up `total`."""
    return [min(size, total - at) for at in range(0, total, size)]


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Processes are the parallelism: threads of the linear algebra library would only fight for the cores."""
    before = {name: os.environ.get(name) for name in _BLAS_THREADS}
    os.environ.update(dict.fromkeys(_BLAS_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
