"""Forward over the steps and back (Rabiner 1989, section III; Kim 1994): how probable each state is.

A state's weight is a quadratic in the run's bias across the track for each scale (`Terms`): exact along one track.
Where several states lead to one, their mixture becomes one Gaussian of its mean and variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.stages.matching.likelihood import Terms
from pipeline.stages.matching.trellis import Trellis
from schemas.arrays import Floats, Ints

# Log-probability that is none.
_NONE = -1e6


@dataclass(frozen=True)
class Beliefs:
    """Per state: probability from the steps up to its own, and from all; per step the best path's state."""

    forward: Floats
    posterior: Floats
    best: Ints


def search(trellis: Trellis) -> Beliefs:
    """How probable each state is at each step, and the most probable sequence.

    `forward` is causal: it uses nothing that a train would not know at that step.
    """
    begins = np.flatnonzero(~trellis.stays)
    ends = np.append(begins[1:], len(trellis))
    weights, come = _forward(trellis, begins, ends)
    forward = _of_states(weights, trellis.first)
    posterior = np.empty_like(forward)
    best = np.empty(len(trellis), dtype=np.int64)
    probability = forward[int(trellis.first[-2]) :]
    place = int(probability.argmax())
    for begin, end, origin in zip(begins[::-1].tolist(), ends[::-1].tolist(), [*come[::-1], None], strict=True):
        # Within a block no state can change: all of its steps are as sure as the last of them.
        posterior[trellis.first[begin] : trellis.first[end]] = np.tile(probability, end - begin)
        best[begin:end] = trellis.first[begin:end] + place
        if origin is not None:
            place = int(origin[:, place].argmax())
            probability = origin @ probability
    return Beliefs(forward, posterior, best)


def _forward(trellis: Trellis, begins: Ints, ends: Ints) -> tuple[Floats, list[Floats]]:
    """Log-weight of each state by the steps up to its own; and per block but the first, where its states come from.

    The latter as probabilities `[before, after]`, each column adding up to one.
    """
    weights = np.empty(len(trellis.oriented))
    state = trellis.initial[:, : int(trellis.first[1])] + trellis.like.prior()[:, None]
    state = _gained(trellis, state, int(begins[0]), int(ends[0]), weights)
    come: list[Floats] = []
    for numbers in trellis.batches():
        for number, (moves, enters) in enumerate(trellis.moves(numbers), numbers.start + 1):
            entered = state[:, :, None] + moves
            mass = log_mass(entered) + _best_branch(entered, enters)[:, :, None]
            come.append(_share(_log_sum(mass, axis=2), axis=0))
            state = _gained(trellis, merged(entered, mass), int(begins[number]), int(ends[number]), weights)
    return weights, come


def _gained(trellis: Trellis, state: Terms, begin: int, end: int, weights: Floats) -> Terms:
    """Go on over a block, each state from its own; fills in the weights of its states and returns its last terms."""
    rows = slice(int(trellis.first[begin]), int(trellis.first[end]))
    terms = trellis.stay[:, rows].reshape(3, end - begin, *state.shape[1:]).copy()
    terms[:, 0] = state
    np.cumsum(terms, axis=1, out=terms)
    weights[rows] = _log_sum(log_mass(terms), axis=2).ravel()
    return np.asarray(terms[:, -1])


def _best_branch(entered: Terms, enters: Ints) -> Floats:
    """0 for the best of the branches that lead to a state over one end, next to impossible for the others.

    The position of a train standing on a switch goes to and fro over it. If each time all branches added up, its track
    would become likelier for no reason.
    """
    total = _log_sum(log_mass(entered), axis=2)
    out = np.zeros_like(total)
    for end in (1, 2):
        by_this_end = np.where(enters == end, total, -np.inf)
        out[(enters == end) & (by_this_end < by_this_end.max(axis=0))] = _NONE
    return out


def log_mass(terms: Terms) -> Floats:
    """Log of the integral over the bias, but for a constant."""
    constant, linear, precision = terms
    return np.asarray(constant + 0.5 * linear**2 / precision - 0.5 * np.log(precision))


def merged(entered: Terms, mass: Floats) -> Terms:
    """One Gaussian of the bias with mass, mean and variance of all that enter a state (first axis)."""
    _, linear, precision = entered
    share = _share(mass, axis=0)
    mean = linear / precision
    middle = (share * mean).sum(axis=0)
    sharp = 1.0 / (share * (1.0 / precision + (mean - middle) ** 2)).sum(axis=0)
    constant = _log_sum(mass, axis=0) - 0.5 * sharp * middle**2 + 0.5 * np.log(sharp)
    return np.stack([constant, sharp * middle, sharp])


def _log_sum(logs: Floats, axis: int) -> Floats:
    most = logs.max(axis=axis, keepdims=True)
    return np.asarray(np.log(np.exp(logs - most).sum(axis=axis)) + most.squeeze(axis))


def _share(logs: Floats, axis: int) -> Floats:
    values = np.exp(logs - logs.max(axis=axis, keepdims=True))
    return np.asarray(values / values.sum(axis=axis, keepdims=True))


def _of_states(logs: Floats, first: Ints) -> Floats:
    """Probabilities of states that sum to one within each step."""
    count = np.diff(first)
    values = np.exp(logs - np.repeat(np.maximum.reduceat(logs, first[:-1]), count))
    return np.asarray(values / np.repeat(np.add.reduceat(values, first[:-1]), count))
