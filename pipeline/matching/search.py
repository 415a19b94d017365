"""Viterbi, forward and backward over the steps (Rabiner 1989, section III).

Every state carries a weight for each hypothesis of what lasts. On a change of net element part of the bias is drawn
anew.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.matching.trellis import Trellis
from schemas.arrays import Floats, Ints

# Least probability that is told from none.
_TINY = 1e-300
# Pairs of states that are weighed at once: enough to be quick, few enough to hold.
_AT_ONCE = 50_000


@dataclass(frozen=True)
class Found:
    """Per state: probability from the steps up to its own, and from all; per step the best path's state."""

    forward: Floats
    posterior: Floats
    best: Ints


@dataclass(frozen=True)
class _Block:
    """Steps `begin : end`, over whose later steps every state stays, and how it is entered.

    `same`, `other`: weights `[before, after, hypothesis]` of staying on an element and of changing to another; empty
    for the first block.
    """

    begin: int
    end: int
    same: Floats
    other: Floats


def search(trellis: Trellis) -> Found:
    """The most probable sequence of states, and how probable each state is at each step.

    `forward` is causal: it uses nothing that a train would not know at that step.
    """
    blocks = list(_blocks(trellis))
    forward, best = _forward(trellis, blocks)
    backward = _backward(trellis, blocks)
    return Found(
        forward=_of_states(forward, trellis.first),
        posterior=_of_states(forward + backward, trellis.first),
        best=best,
    )


def _blocks(trellis: Trellis) -> Iterator[_Block]:
    """Runs of steps between which something can be decided."""
    begins = np.flatnonzero(~trellis.stays)
    ends = np.append(begins[1:], len(trellis))
    nothing = np.zeros((0, 0, len(trellis.like.hypotheses)))
    yield _Block(0, int(ends[0]), nothing, nothing)
    for rows in _batches(trellis, begins[1:]):
        pairs = trellis.pairs(begins[1:][rows])
        for begin, end, pair in zip(begins[1:][rows].tolist(), ends[1:][rows].tolist(), pairs, strict=True):
            yield _Block(begin, end, *pair)


def _batches(trellis: Trellis, steps: Ints) -> Iterator[slice]:
    """Parts of the steps with so many pairs each."""
    count = np.diff(trellis.first)
    batch = np.cumsum(count[steps - 1] * count[steps]) // _AT_ONCE
    cuts = [0, *(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(steps)]
    for begin, end in itertools.pairwise(cuts):
        if end > begin:
            yield slice(begin, end)


def _forward(trellis: Trellis, blocks: list[_Block]) -> tuple[Floats, Ints]:
    """Weights of all states by what came before, in logarithms, and the state of the best path at each step.

    The best path is the one that is most probable under all hypotheses together: each state keeps one way to it.
    """
    renewal = trellis.like.hypotheses.renewal
    forward = np.empty_like(trellis.initial)
    back: list[Ints] = []
    start = trellis.initial[: int(trellis.first[1])] + trellis.like.hypotheses.log_prior
    both = np.stack([start, start])
    for block in blocks:
        count = int(trellis.first[block.begin + 1] - trellis.first[block.begin])
        if len(block.same):
            weight = _weights(both)
            entered = weight[:, :, None] * block.same + (weight @ renewal)[:, :, None] * block.other
            origin = entered[1].sum(axis=2).argmax(axis=0)
            best = entered[1, origin, np.arange(count)]
            both = np.log(np.stack([entered[0].sum(axis=0), best]) + _TINY)
            back.append(origin)
        else:
            back.append(np.zeros(count, dtype=np.int64))
        gained = _gained(trellis, block, count)
        rows = slice(int(trellis.first[block.begin]), int(trellis.first[block.end]))
        forward[rows] = (both[0] + gained).reshape(-1, forward.shape[1])
        both = both + gained[-1]
    return forward, _trace(trellis, blocks, back, int(_weights(both)[1].sum(axis=1).argmax()))


def _weights(logs: Floats) -> Floats:
    """Weights from logarithms, the largest of each of the two being one."""
    return np.asarray(np.exp(logs - logs.max(axis=(1, 2), keepdims=True)))


def _gained(trellis: Trellis, block: _Block, count: int) -> Floats:
    """Log-probability that each state has gained within a block, step by step (first row zero)."""
    rows = slice(int(trellis.first[block.begin + 1]), int(trellis.first[block.end]))
    gained = np.zeros((block.end - block.begin, count, trellis.stay.shape[1]))
    if len(gained) > 1:
        np.cumsum(trellis.stay[rows].reshape(-1, count, gained.shape[2]), axis=0, out=gained[1:])
    return gained


def _backward(trellis: Trellis, blocks: list[_Block]) -> Floats:
    """Weights of all states by what came after, in logarithms."""
    renewal = trellis.like.hypotheses.renewal.T
    backward = np.empty_like(trellis.initial)
    beta = np.zeros((int(trellis.first[-1] - trellis.first[-2]), backward.shape[1]))
    for block in reversed(blocks):
        gained = _gained(trellis, block, len(beta))
        later = beta + gained[-1] - gained
        rows = slice(int(trellis.first[block.begin]), int(trellis.first[block.end]))
        backward[rows] = later.reshape(-1, backward.shape[1])
        if not len(block.same):
            break
        weight = np.exp(later[0] - later[0].max())
        beta = np.log((block.same * weight).sum(axis=1) + (block.other * weight).sum(axis=1) @ renewal + _TINY)
    return backward


def _trace(trellis: Trellis, blocks: list[_Block], back: list[Ints], last: int) -> Ints:
    """State of the best path at each step."""
    best = np.empty(len(trellis), dtype=np.int64)
    place = last
    for block, pointer in zip(reversed(blocks), reversed(back), strict=True):
        best[block.begin : block.end] = trellis.first[block.begin : block.end] + place
        place = int(pointer[place])
    return best


def _of_states(log_values: Floats, first: Ints) -> Floats:
    """Probabilities of states, under all hypotheses together, that sum to one within each step."""
    count = np.diff(first)
    most = np.repeat(np.maximum.reduceat(log_values.max(axis=1), first[:-1]), count)
    values = np.exp(log_values - most[:, None]).sum(axis=1)
    return np.asarray(values / np.repeat(np.add.reduceat(values, first[:-1]), count))
