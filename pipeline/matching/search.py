"""Viterbi, forward and backward over the steps (Rabiner 1989, section III), in logarithms.

Every state carries a weight for each hypothesis of what lasts. On a change of net element part of the bias is drawn
anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.matching.trellis import Trellis
from schemas.arrays import Bools, Floats, Ints

# Least probability that is told from none.
_TINY = 1e-300


@dataclass(frozen=True)
class Found:
    """Per state: probability from the steps up to its own, and from all; per step the best path's state."""

    forward: Floats
    posterior: Floats
    best: Ints


@dataclass(frozen=True)
class _Block:
    """Steps `begin : end`, over whose later steps every state stays.

    It is entered by `transitions` `[before, after, hypothesis]`, of which `changes` lead to another element.
    """

    begin: int
    end: int
    transitions: Floats | None
    changes: Bools | None


@dataclass(frozen=True)
class _Survivors:
    """The best way to each state of a step with its weight under each hypothesis, and where each came from."""

    weight: Floats
    origin: Ints


def search(trellis: Trellis) -> Found:
    """The most probable sequence of states, and how probable each state is at each step.

    `forward` is causal: it uses nothing that a train would not know at that step.
    """
    blocks = _blocks(trellis)
    forward, best = _forward(trellis, blocks)
    backward = _backward(trellis, blocks)
    return Found(
        forward=_of_states(forward, trellis.first),
        posterior=_of_states(forward + backward, trellis.first),
        best=best,
    )


def _blocks(trellis: Trellis) -> list[_Block]:
    """Runs of steps between which something can be decided."""
    starts = np.flatnonzero(~trellis.stays)
    ends = np.append(starts[1:], len(trellis))
    blocks = []
    for begin, end in zip(starts.tolist(), ends.tolist(), strict=True):
        entered = (trellis.transitions(begin), trellis.changes(begin)) if begin else (None, None)
        blocks.append(_Block(begin, end, *entered))
    return blocks


def _forward(trellis: Trellis, blocks: list[_Block]) -> tuple[Floats, Ints]:
    """Weights of all states by what came before, and the state of the best path at each step."""
    renewal = trellis.like.hypotheses.renewal
    forward = np.empty_like(trellis.initial)
    back: list[Ints] = []
    alpha, best = np.zeros((0, 0)), np.zeros((0, 0))
    for block in blocks:
        rows = slice(int(trellis.first[block.begin]), int(trellis.first[block.end]))
        count = int(trellis.first[block.begin + 1] - trellis.first[block.begin])
        if block.transitions is None:
            alpha = best = trellis.initial[rows][:count] + trellis.like.hypotheses.log_prior
            back.append(np.zeros(count, dtype=np.int64))
        else:
            alpha = _log_sum(_entered(alpha, block, renewal), 0)
            survivors = _survivors(_entered(best, block, renewal))
            best = survivors.weight
            back.append(survivors.origin)
        gained = _gained(trellis, block, count)
        filtered = alpha + gained
        filtered -= _log_sum(filtered.reshape(len(filtered), -1), 1)[:, None, None]
        forward[rows] = filtered.reshape(-1, forward.shape[1])
        alpha, best = filtered[-1], best + gained[-1]
        best = best - best.max()
    return forward, _trace(trellis, blocks, back, int(np.argmax(_log_sum(best, 1))))


def _entered(weight: Floats, block: _Block, renewal: Floats) -> Floats:
    """Weights after a block's transitions: `[before, after, hypothesis]`."""
    assert block.transitions is not None
    assert block.changes is not None
    carried = np.where(block.changes[:, :, None], _renewed(weight, renewal)[:, None, :], weight[:, None, :])
    return np.asarray(carried + block.transitions)


def _renewed(weight: Floats, renewal: Floats) -> Floats:
    """Weights over the hypotheses after a change of element."""
    most = weight.max(axis=1, keepdims=True)
    return np.asarray(np.log(np.exp(weight - most) @ renewal + _TINY) + most)


def _survivors(entered: Floats) -> _Survivors:
    """To each state the way that is most probable under all hypotheses together."""
    origin = np.argmax(_log_sum(entered, 2), axis=0)
    return _Survivors(entered[origin, np.arange(entered.shape[1])], origin)


def _gained(trellis: Trellis, block: _Block, count: int) -> Floats:
    """Log-probability that each state has gained within a block, step by step (first row zero)."""
    rows = slice(int(trellis.first[block.begin + 1]), int(trellis.first[block.end]))
    gained = np.zeros((block.end - block.begin, count, trellis.stay.shape[1]))
    np.cumsum(trellis.stay[rows].reshape(-1, count, gained.shape[2]), axis=0, out=gained[1:])
    return gained


def _backward(trellis: Trellis, blocks: list[_Block]) -> Floats:
    """Weights of all states by what came after."""
    renewal = trellis.like.hypotheses.renewal.T
    backward = np.empty_like(trellis.initial)
    beta = np.zeros((0, 0))
    after: _Block | None = None
    for block in reversed(blocks):
        count = int(trellis.first[block.begin + 1] - trellis.first[block.begin])
        if after is None or after.transitions is None or after.changes is None:
            beta = np.zeros((count, backward.shape[1]))
        else:
            onward = after.transitions + beta[None, :, :]
            elsewhere = after.changes[:, :, None]
            same = _log_sum(np.where(elsewhere, -np.inf, onward), 1)
            other = _renewed(_log_sum(np.where(elsewhere, onward, -np.inf), 1), renewal)
            beta = np.logaddexp(same, other)
        beta = beta - beta.max()
        gained = _gained(trellis, block, count)
        later = beta + gained[-1] - gained
        rows = slice(int(trellis.first[block.begin]), int(trellis.first[block.end]))
        backward[rows] = later.reshape(-1, backward.shape[1])
        beta, after = later[0], block
    return backward


def _trace(trellis: Trellis, blocks: list[_Block], back: list[Ints], last: int) -> Ints:
    """State of the best path at each step."""
    best = np.empty(len(trellis), dtype=np.int64)
    place = last
    for block, pointer in zip(reversed(blocks), reversed(back), strict=True):
        best[block.begin : block.end] = trellis.first[block.begin : block.end] + place
        place = int(pointer[place])
    return best


def _log_sum(values: Floats, axis: int) -> Floats:
    """Logarithm of the sum of exponentials along an axis; at least the logarithm of next to nothing."""
    most = np.maximum(values.max(axis=axis, keepdims=True), _LOWEST)
    return np.asarray(np.log(np.exp(values - most).sum(axis=axis) + _TINY) + np.squeeze(most, axis=axis))


def _of_states(log_values: Floats, first: Ints) -> Floats:
    """Probabilities of states, under all hypotheses together, that sum to one within each step."""
    count = np.diff(first)
    most = np.repeat(np.maximum.reduceat(log_values.max(axis=1), first[:-1]), count)
    values = np.exp(log_values - most[:, None]).sum(axis=1)
    return np.asarray(values / np.repeat(np.add.reduceat(values, first[:-1]), count))


# Of next to nothing, so that differences of such values stay numbers.
_LOWEST = -1e9
