"""Streams of random numbers and sizes of blocks for work that is split over processes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from pipeline.results.workers import map_in_processes

T = TypeVar("T")


def random_generator(*key: int) -> np.random.Generator:
    """A stream of its own for every key (seed, piece of work, ...), whoever draws from it and when."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))


def in_blocks(total: int, size: int) -> list[int]:
    """Sizes of blocks that make up `total`."""
    return [min(size, total - at) for at in range(0, total, size)]


def in_pieces(
    work: Callable[[int, np.random.Generator], T], total: int, size: int, key: tuple[int, ...], jobs: int
) -> list[T]:
    """`work` of every block of `total` runs, each with a stream of its own: the same for any number of jobs."""
    return map_in_processes(partial(_work_block, work, key), list(enumerate(in_blocks(total, size))), jobs)


def _work_block(work: Callable[[int, np.random.Generator], T], key: tuple[int, ...], block: tuple[int, int]) -> T:
    """The work of one block, with a stream of its own."""
    number, runs = block
    return work(runs, random_generator(*key, number))
