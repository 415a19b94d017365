"""Viterbi, forward and backward over the steps (Rabiner 1989, section III), in logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.matching.trellis import Trellis
from schemas.arrays import Floats, Ints


@dataclass(frozen=True)
class Found:
    """Per state: probability from the steps up to its own, and from all; per step the best path's state."""

    forward: Floats
    posterior: Floats
    best: Ints


@dataclass(frozen=True)
class _Block:
    """Steps `begin : end`, entered by `transitions`, over whose later steps every state stays."""

    begin: int
    end: int
    transitions: Floats | None


def search(trellis: Trellis) -> Found:
    """The most probable sequence of states, and how probable each state is at each step.

    `forward` is causal: it uses nothing that a train would not know at that step.
    """
    first = trellis.first
    blocks = _blocks(trellis)
    forward = np.empty(len(trellis.oriented))
    back: list[Ints] = []
    alpha, best = np.zeros(0), np.zeros(0)
    for block in blocks:
        rows = slice(int(first[block.begin]), int(first[block.end]))
        count = int(first[block.begin + 1] - first[block.begin])
        if block.transitions is None:
            alpha = best = trellis.initial[rows][:count]
            back.append(np.zeros(count, dtype=np.int64))
        else:
            back.append(np.argmax(best[:, None] + block.transitions, axis=0))
            best = np.max(best[:, None] + block.transitions, axis=0)
            alpha = np.logaddexp.reduce(alpha[:, None] + block.transitions, axis=0)
        gained = _gained(trellis, block, count)
        filtered = alpha + gained
        filtered -= np.logaddexp.reduce(filtered, axis=1, keepdims=True)
        forward[rows] = filtered.ravel()
        alpha, best = filtered[-1], best + gained[-1]
        best = best - best.max()
    backward = _backward(trellis, blocks)
    return Found(
        forward=np.exp(forward),
        posterior=_normalised(forward + backward, first),
        best=_trace(trellis, blocks, back, int(np.argmax(best))),
    )


def _blocks(trellis: Trellis) -> list[_Block]:
    """Runs of steps between which something can be decided."""
    starts = np.flatnonzero(~trellis.stays)
    ends = np.append(starts[1:], len(trellis))
    return [
        _Block(int(begin), int(end), trellis.transitions(int(begin)) if begin else None)
        for begin, end in zip(starts.tolist(), ends.tolist(), strict=True)
    ]


def _gained(trellis: Trellis, block: _Block, count: int) -> Floats:
    """Log-probability that each state has gained within a block, step by step (first row zero)."""
    rows = slice(int(trellis.first[block.begin + 1]), int(trellis.first[block.end]))
    gained = np.zeros((block.end - block.begin, count))
    np.cumsum(trellis.stay[rows].reshape(-1, count), axis=0, out=gained[1:])
    return gained


def _backward(trellis: Trellis, blocks: list[_Block]) -> Floats:
    backward = np.empty(len(trellis.oriented))
    beta = np.zeros(0)
    after: Floats | None = None
    for block in reversed(blocks):
        count = int(trellis.first[block.begin + 1] - trellis.first[block.begin])
        beta = np.zeros(count) if after is None else np.logaddexp.reduce(after + beta[None, :], axis=1)
        beta = beta - beta.max()
        gained = _gained(trellis, block, count)
        later = beta + gained[-1] - gained
        backward[int(trellis.first[block.begin]) : int(trellis.first[block.end])] = later.ravel()
        beta, after = later[0], block.transitions
    return backward


def _trace(trellis: Trellis, blocks: list[_Block], back: list[Ints], last: int) -> Ints:
    """State of the best path at each step."""
    best = np.empty(len(trellis), dtype=np.int64)
    place = last
    for block, pointer in zip(reversed(blocks), reversed(back), strict=True):
        best[block.begin : block.end] = trellis.first[block.begin : block.end] + place
        place = int(pointer[place])
    return best


def _normalised(log_values: Floats, first: Ints) -> Floats:
    """Probabilities that sum to one within each step."""
    count = np.diff(first)
    values = np.exp(log_values - np.repeat(np.maximum.reduceat(log_values, first[:-1]), count))
    return np.asarray(values / np.repeat(np.add.reduceat(values, first[:-1]), count))
