"""First passages of all monitors, for all rates at once, on one noise path per repetition.

A monitor m with threshold T and ramp response b >= 0 per m/s fails at rate c where m + c b > T, that is
where (T - m) / b < c: the running minimum of (T - m) / b answers every rate. Blocks of epochs are looked
at one by one only where their envelope says that a passage is possible, which changes nothing in the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from datasets.experiment.geometry import SOURCES, TAUS_S
from datasets.experiment.plan import SIGNALS, ExperimentPlan, Forms
from schemas.arrays import Bools, Floats
from schemas.arrays import Ints as Index

Ints = npt.NDArray[np.int32]

BLOCK_EPOCHS = 64
_FIRST_BLOCK = 4
NEVER = -1
_NORMALS = 3 * len(SOURCES) + 3
# White noise: odometer, map across, map up.
_ODOMETER = _NORMALS - 3
_UP, _CROSS, _INCREMENTS, _POSITION = (
    SIGNALS.index(name) for name in ("up", "map_cross", "odometer_increments", "odometer_position")
)
_TINY = 1e-12


class FirstPassages(NamedTuple):
    """Seconds from onset to the first passage, `NEVER` where there was none within the span.

    `detected_s` (questions, rates, repetitions), `failed_s` (headings, rates, repetitions);
    `alarmed_before` (questions, repetitions): the bank failed before the onset.
    """

    detected_s: Ints
    failed_s: Ints
    alarmed_before: Bools


class NoisePaths:
    """Draws the normals of `repetitions` runs and turns them into the basis of the monitors, block by block.

    Each source is a vector Gauss-Markov process of the position error (exact for a fixed geometry): three
    unit processes, coloured by the Cholesky factor of S diag(R_j) S'. EWMAs are kept divided by their
    weight, which saves a multiplication; `weights` restores it.
    """

    def __init__(self, plan: ExperimentPlan, repetitions: int, rng: np.random.Generator) -> None:
        self._plan = plan
        self._rng = rng
        self._phi = np.repeat(np.exp(-1.0 / TAUS_S), 3)[:, None]
        step = np.sqrt(-np.expm1(-2.0 / TAUS_S))
        colour = np.linalg.cholesky(plan.geometry.source_covariances_m2)
        self._colour = np.hstack([step[j] * colour[j] for j in range(len(SOURCES))])
        self._keep = (1.0 - plan.alphas[1:])[:, None, None]
        first = rng.standard_normal((_NORMALS, repetitions))
        self._unit = first[:-3] / np.repeat(step, 3)[:, None]
        self._white = first[-3:]
        self._position = self._colour @ self._unit
        self._ewma = np.zeros((plan.alphas.size - 1, len(SIGNALS), repetitions))
        self._normals = np.empty((BLOCK_EPOCHS, _NORMALS, repetitions))
        self._basis = np.empty((BLOCK_EPOCHS, plan.basis_size, repetitions))
        self._scratch = np.empty_like(self._unit)

    @property
    def weights(self) -> Floats:
        """What each basis row has to be multiplied by."""
        return np.append(np.repeat(self._plan.alphas, len(SIGNALS)), [1.0, 1.0])

    def advance(self, epochs: int) -> Floats:
        """Basis of the next epochs, shape (epochs, basis, repetitions); valid until the next call."""
        normals = self._rng.standard_normal(out=self._normals[:epochs])
        unit = normals[:, :_ODOMETER]
        before = self._unit
        for step in range(epochs):
            np.multiply(before, self._phi, out=self._scratch)
            before = np.add(unit[step], self._scratch, out=unit[step])
        self._unit = before.copy()
        basis = self._basis[:epochs]
        self._signals(normals, basis)
        self._filter(basis)
        return basis

    def _signals(self, normals: Floats, basis: Floats) -> None:
        """Raw increments (rows of alpha 1) and the horizontal position, written into the basis."""
        position = np.matmul(self._colour, normals[:, :_ODOMETER])
        white = normals[:, _ODOMETER:]
        np.subtract(position[1:], position[:-1], out=basis[1:, :3])
        np.subtract(position[0], self._position, out=basis[0, :3])
        basis[:, _INCREMENTS] = white[:, 0]
        for row, source in ((_POSITION, 0), (_CROSS, 1)):
            np.subtract(white[1:, source], white[:-1, source], out=basis[1:, row])
            np.subtract(white[0, source], self._white[source], out=basis[0, row])
        basis[1:, _UP] -= self._plan.map_m * (white[1:, 2] - white[:-1, 2])
        basis[0, _UP] -= self._plan.map_m * (white[0, 2] - self._white[2])
        basis[:, -2:] = position[:, :2]
        self._position = position[-1].copy()
        self._white = white[-1].copy()

    def _filter(self, basis: Floats) -> None:
        signals = basis[:, : len(SIGNALS)]
        rows = basis[:, len(SIGNALS) : -2].reshape(len(basis), -1, len(SIGNALS), basis.shape[2])
        before = self._ewma
        for step, drive in enumerate(signals):
            np.multiply(before, self._keep, out=rows[step])
            before = np.add(rows[step], drive, out=rows[step])
        self._ewma = before.copy()


class FirstAnswers:
    """Keeps, for every question, rate and repetition, when it was first answered."""

    def __init__(self, plan: ExperimentPlan, banks: Forms, failures: Forms, weights: Floats, repetitions: int) -> None:
        self._plan = plan
        self._rates = np.array(plan.rates_mps)
        self._banks = banks
        self._rows = np.vstack([banks.rows, failures.rows]) * weights
        self._bounds = csr_array(np.hstack([np.maximum(self._rows, 0.0), np.minimum(self._rows, 0.0)]))
        members = block_diag(banks.members, failures.members)
        self._forms = [np.flatnonzero(row) for row in members]
        self._failure_limit = failures.threshold[0]
        self._slope = np.concatenate([banks.slope, failures.slope])
        self._monitors = banks.slope.size
        self._first = np.full((len(members), self._rates.size, repetitions), NEVER, dtype=np.int32)
        self.alarmed = np.zeros((banks.members.shape[0], repetitions), dtype=np.bool_)

    @property
    def first(self) -> Ints:
        """Seconds from onset to the first passage, shape (questions, rates, repetitions)."""
        return self._first

    def thresholds(self, begin: int, end: int) -> Floats:
        """Of epochs begin+1 .. end, shape (epochs, forms)."""
        limit = np.broadcast_to(self._failure_limit, (end - begin, self._failure_limit.size))
        return np.hstack([self._banks.threshold[begin:end], limit])

    def responses(self, begin: int, end: int) -> Floats:
        """To a ramp of 1 m/s, shape (epochs, forms): 1 - (1 - alpha)^k of an EWMA, k s of the position."""
        elapsed = np.arange(begin + 1, end + 1)[:, None] - self._plan.onset_s
        smooth = (1.0 - (1.0 - self._plan.alphas) ** np.maximum(elapsed, 0))[:, self._banks.alpha]
        drift = np.broadcast_to(elapsed, (end - begin, self._slope.size - self._monitors))
        return np.asarray(np.maximum(np.hstack([smooth, drift]) * self._slope, _TINY))

    def before_onset(self, basis: Floats, begin: int) -> None:
        """Note which questions are alarmed in these epochs; `basis` (epochs, basis, repetitions)."""
        threshold = self.thresholds(begin, begin + len(basis))
        high, low = self._envelope(basis)
        least = threshold.min(axis=0)[:, None]
        suspect = ((high > least) | (low < -least))[: self._monitors].any(axis=0)
        for index in np.flatnonzero(suspect):
            values = basis[:, :, index] @ self._rows.T
            failing = (np.abs(values) > threshold)[:, : self._monitors].any(axis=0)
            self.alarmed[:, index] |= (self._banks.members & failing).any(axis=1)

    def after_onset(self, basis: Floats, begin: int) -> None:
        """Note the first passages in these epochs; `basis` (epochs, basis, repetitions)."""
        end = begin + len(basis)
        threshold = self.thresholds(begin, end)
        response = self.responses(begin, end)
        high, low = self._envelope(basis)
        least = threshold.min(axis=0)[:, None]
        slowest = (least - high) / response[-1][:, None]
        largest_open = np.where(self._first == NEVER, self._rates[:, None], -np.inf).max(axis=1)
        for question, asked in enumerate(self._forms):
            waiting = largest_open[question]
            possible = (slowest[asked] <= waiting) | ((low[asked] < -least[asked]) & (waiting > 0.0))
            runs = np.flatnonzero(possible.any(axis=0))
            if runs.size:
                forms = asked[possible.any(axis=1)]
                terms = np.flatnonzero(self._rows[forms].any(axis=0))
                values = np.matmul(self._rows[np.ix_(forms, terms)], basis[:, terms[:, None], runs])
                self._note(question, runs, values, threshold[:, forms, None], response[:, forms, None], begin)

    def _note(
        self, question: int, runs: Index, values: Floats, threshold: Floats, response: Floats, begin: int
    ) -> None:
        """When each rate, if still open, is first answered; `values` (epochs, forms, runs)."""
        # The smallest rate at which a form fails with the ramp; against it, -m > T + c b: a false alarm, likelier for
        # the slower ramp.
        with_ramp = ((threshold - values) / response).min(axis=1)
        against = -((threshold + values) / response).min(axis=1)
        for index, rate in enumerate(self._rates):
            waiting = self._first[question, index, runs] == NEVER
            if waiting.any():
                failing = (with_ramp < rate) | (against > rate)
                found = failing.any(axis=0) & waiting
                when = failing.argmax(axis=0) + begin + 1 - self._plan.onset_s
                self._first[question, index, runs[found]] = when[found]

    def _envelope(self, basis: Floats) -> tuple[Floats, Floats]:
        """Upper and lower bound of every form over the block."""
        top = basis.max(axis=0)
        bottom = basis.min(axis=0)
        return self._bounds @ np.vstack([top, bottom]), self._bounds @ np.vstack([bottom, top])


def first_passages(
    plan: ExperimentPlan, banks: Forms, failures: Forms, repetitions: int, rng: np.random.Generator
) -> FirstPassages:
    """Simulate `repetitions` runs of the plan and answer all of its questions."""
    paths = NoisePaths(plan, repetitions, rng)
    answers = FirstAnswers(plan, banks, failures, paths.weights, repetitions)
    for begin, end in _blocks(0, plan.onset_s):
        answers.before_onset(paths.advance(end - begin), begin)
    for begin, end in _blocks(plan.onset_s, plan.span_s, _FIRST_BLOCK):
        answers.after_onset(paths.advance(end - begin), begin)
    questions = banks.members.shape[0]
    return FirstPassages(answers.first[:questions], answers.first[questions:], answers.alarmed)


def _blocks(begin: int, end: int, shortest: int = BLOCK_EPOCHS) -> Iterator[tuple[int, int]]:
    """Blocks that grow with the time since `begin`: passages of fast ramps crowd at the onset."""
    at = begin
    while at < end:
        size = min(max(shortest, (at - begin) // 8), BLOCK_EPOCHS, end - at)
        yield at, at + size
        at += size
