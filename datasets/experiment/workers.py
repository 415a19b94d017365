"""Streams of random numbers and sizes of blocks for work that is split over processes."""

from __future__ import annotations

import numpy as np


def generator(*key: int) -> np.random.Generator:
    """A stream of its own for every key (seed, piece of work, ...), whoever draws from it and when."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))


def in_blocks(total: int, size: int) -> list[int]:
    """Sizes of blocks that make up `total`."""
    return [min(size, total - at) for at in range(0, total, size)]
