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
_OPEN = np.iinfo(np.int32).max


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
        self._terms = _sparse(self._rows)
        self._members = block_diag(banks.members, failures.members).astype(np.bool_)
        self._asked, self._asks = _padded([np.flatnonzero(column) for column in self._members.T])
        patterns, self._pattern_of_form = np.unique(self._members.T, axis=0, return_inverse=True)
        self._patterns = _padded([np.flatnonzero(pattern) for pattern in patterns])
        self._failure_limit = failures.threshold[0]
        self._slope = np.concatenate([banks.slope, failures.slope])
        self._monitors = banks.slope.size
        self._first = np.full((len(self._members), self._rates.size, repetitions), _OPEN, dtype=np.int32)
        self._largest_open = np.full((len(self._members), repetitions), self._rates.max())
        self.alarmed = np.zeros((banks.members.shape[0], repetitions), dtype=np.bool_)

    @property
    def first(self) -> Ints:
        """Seconds from onset to the first passage, shape (questions, rates, repetitions)."""
        return np.where(self._first == _OPEN, np.int32(NEVER), self._first)

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
        threshold = self.thresholds(begin, begin + len(basis))
        high, low = self._envelope(basis)
        least = threshold.min(axis=0)[:, None]
        suspect = ((high > least) | (low < -least))[: self._monitors].any(axis=0)
        for index in np.flatnonzero(suspect):
            values = basis[:, :, index] @ self._rows.T
            failing = (np.abs(values) > threshold)[:, : self._monitors].any(axis=0)
            self.alarmed[:, index] |= (self._banks.members & failing).any(axis=1)

    def after_onset(self, basis: Floats, begin: int) -> None:
        end = begin + len(basis)
        threshold = self.thresholds(begin, end)
        response = self.responses(begin, end)
        high, low = self._envelope(basis)
        least = threshold.min(axis=0)[:, None]
        reach = np.subtract(least, high, out=high)
        reach /= response[-1][:, None]
        self._look(basis, reach <= self._open_for_forms(), threshold, response, begin, 1.0)
        # Against the ramp, -m > T + c b: false alarms, likelier for the slower ramp.
        self._look(basis, low < -least, threshold, response, begin, -1.0)

    def _open_for_forms(self) -> Floats:
        """Largest rate that some question of the form still waits for, shape (forms, repetitions)."""
        lists, _ = self._patterns
        largest = self._largest_open[lists[:, 0]]
        for column in lists.T[1:]:
            np.maximum(largest, self._largest_open[column], out=largest)
        return np.asarray(largest[self._pattern_of_form])

    def _envelope(self, basis: Floats) -> tuple[Floats, Floats]:
        """Upper and lower bound of every form over the block."""
        top = basis.max(axis=0)
        bottom = basis.min(axis=0)
        return self._bounds @ np.vstack([top, bottom]), self._bounds @ np.vstack([bottom, top])

    def _values(self, basis: Floats, form: Index, run: Index) -> Floats:
        """Forms of runs, epoch by epoch, shape (epochs, pairs)."""
        place, factor = self._terms
        values: Floats = basis[:, place[form, 0], run] * factor[form, 0]
        for term in range(1, place.shape[1]):
            values += basis[:, place[form, term], run] * factor[form, term]
        return values

    def _look(self, basis: Floats, chosen: Bools, threshold: Floats, response: Floats, begin: int, side: float) -> None:
        """First passages of the chosen pairs (forms, runs) on this side, epoch by epoch."""
        form, run = np.nonzero(chosen)
        if form.size:
            reach = threshold[:, form] - side * self._values(basis, form, run)
            reach /= response[:, form]
            self._keep_earliest(reach, side * self._rates, form, run, begin)

    def _keep_earliest(self, series: Floats, limits: Floats, form: Index, run: Index, begin: int) -> None:
        """Tell every question that holds the form when `series` (epochs, pairs) first fell below each limit."""
        least = series.min(axis=0)
        pair, rate = np.nonzero(
            (least[:, None] < limits) & (self._rates <= self._largest_open[:, run].max(axis=0)[:, None])
        )
        if pair.size == 0:
            return
        when = (series[:, pair] < limits[rate]).argmax(axis=0) + begin + 1 - self._plan.onset_s
        hit, place = np.nonzero(self._asks[form[pair]])
        question = self._asked[form[pair[hit]], place]
        chosen = run[pair[hit]]
        np.minimum.at(self._first, (question, rate[hit], chosen), when[hit].astype(np.int32))
        still_open = np.where(self._first[question, :, chosen] == _OPEN, self._rates, -np.inf)
        self._largest_open[question, chosen] = still_open.max(axis=1)


def first_passages(
    plan: ExperimentPlan, banks: Forms, failures: Forms, repetitions: int, rng: np.random.Generator
) -> FirstPassages:
    """Simulate `repetitions` runs of the plan and answer all of its questions."""
    paths = NoisePaths(plan, repetitions, rng)
    watch = FirstAnswers(plan, banks, failures, paths.weights, repetitions)
    for begin, end in _blocks(0, plan.onset_s):
        watch.before_onset(paths.advance(end - begin), begin)
    for begin, end in _blocks(plan.onset_s, plan.span_s, _FIRST_BLOCK):
        watch.after_onset(paths.advance(end - begin), begin)
    questions = banks.members.shape[0]
    return FirstPassages(watch.first[:questions], watch.first[questions:], watch.alarmed)


def _blocks(begin: int, end: int, shortest: int = BLOCK_EPOCHS) -> Iterator[tuple[int, int]]:
    """Blocks that grow with the time since `begin`: passages of fast ramps crowd at the onset."""
    at = begin
    while at < end:
        size = min(max(shortest, (at - begin) // 8), BLOCK_EPOCHS, end - at)
        yield at, at + size
        at += size


def _sparse(rows: Floats) -> tuple[Index, Floats]:
    """Columns and factors of the non-zero entries of each row, padded with factor zero."""
    width = int((rows != 0).sum(axis=1).max())
    place = np.argsort(rows == 0, axis=1, kind="stable")[:, :width]
    return place, np.take_along_axis(rows, place, axis=1)


def _padded(lists: list[Index]) -> tuple[Index, Bools]:
    """Lists of indices as one array, and where it holds them; short ones repeat their first."""
    width = max(items.size for items in lists)
    padded = np.array([np.concatenate([items, np.full(width - items.size, items[0])]) for items in lists])
    return padded, np.arange(width) < np.array([items.size for items in lists])[:, None]
