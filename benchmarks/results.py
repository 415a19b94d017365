"""Figures of a benchmark beside the target they are held against."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Figure:
    """One measured figure; without a target it is only reported."""

    name: str
    value: float
    unit: str
    target: float | None = None
    better: Literal["below", "above"] = "below"

    @property
    def met(self) -> bool | None:
        if self.target is None:
            return None
        return self.value <= self.target if self.better == "below" else self.value >= self.target


@dataclass
class Stopwatch:
    """Seconds that passed inside `stopwatch()`."""

    seconds: float = 0.0


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    watch = Stopwatch()
    begun = time.perf_counter()
    yield watch
    watch.seconds = time.perf_counter() - begun


@contextmanager
def processor_time() -> Iterator[Stopwatch]:
    """Processor time of this process, and of its children that have ended."""
    watch = Stopwatch()
    begun = _spent_s()
    yield watch
    watch.seconds = _spent_s() - begun


def _spent_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def best_of(times: int, work: Callable[[], object]) -> float:
    """Shortest of several goes [s]: what the machine can do when nothing else disturbs it."""
    seconds = []
    for _ in range(times):
        with stopwatch() as watch:
            work()
        seconds.append(watch.seconds)
    return min(seconds)


def processor_s(times: int, work: Callable[[], object]) -> float:
    """Least processor time of several goes [s]: other processes slow it less than the time that passes."""
    seconds = []
    for _ in range(times):
        begun = time.process_time()
        work()
        seconds.append(time.process_time() - begun)
    return min(seconds)


def children_peak_mb() -> float:
    """Largest resident memory of any ended child process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0


def own_peak_mb() -> float:
    """Largest resident memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
