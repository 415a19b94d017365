"""The published Monte Carlo: the grid of questions, its monitors as linear forms, and the first passages of them all.

All that the monitors see is linear in the noise, so a monitor is a row over the basis (averages of six signals, and the
horizontal position): value = row . basis. Everything that depends on heading, reading and satellite geometry is in the
rows; the noise path is drawn once for all of them.

A monitor m with threshold T and ramp response b >= 0 per m/s fails at rate c where m + c b > T, that is where
(T - m) / b < c: the minimum of (T - m) / b over the monitors of a question answers every rate. Blocks of epochs are
looked at one by one only where their envelope says that a passage is possible, which changes nothing in the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from datasets.experiment.bank import PUBLISHED_WEIGHTS, READINGS, SENSORS, BankSpec, Reading, Sensors, bank_of_axis
from datasets.experiment.geometry import SOURCES, TAUS_S, Geometry
from schemas.arrays import Bools, Floats, Ints
from schemas.config import threshold_factor
from schemas.frozen import frozen

RATES_MPS: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
HEADINGS_DEG: tuple[float, ...] = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
SIGNALS: tuple[str, ...] = ("east", "north", "up", "map_cross", "odometer_increments", "odometer_position")
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

Seconds = npt.NDArray[np.int32]


@frozen
class ExperimentPlan:
    """The grid. `span_s` epochs at 1 Hz, ramp from `onset_s`, failure beyond `failure_limit_m` along the track."""

    geometry: Geometry
    headings_deg: tuple[float, ...] = HEADINGS_DEG
    rates_mps: tuple[float, ...] = RATES_MPS
    readings: tuple[Reading, ...] = READINGS
    sensors: tuple[Sensors, ...] = SENSORS
    span_s: int = 15_000
    onset_s: int = 5_000
    failure_limit_m: float = 20.0
    odometer_m: float = 0.05
    map_m: float = 1.0
    false_alarm_probability: float = 1e-7

    @cached_property
    def alphas(self) -> Floats:
        """Every EWMA weight that some reading uses; the first is the raw monitor."""
        used = {alpha for reading in self.readings for alpha in PUBLISHED_WEIGHTS[reading]}
        return np.array(sorted(used, reverse=True))

    @cached_property
    def questions(self) -> tuple[tuple[Reading, float, Sensors], ...]:
        """Combinations that share a noise path, in the order of the results' first axis."""
        return tuple((r, h, s) for r in self.readings for h in self.headings_deg for s in self.sensors)

    @property
    def basis_size(self) -> int:
        """Rows of the basis: every signal at every weight, and the horizontal position."""
        return len(SIGNALS) * self.alphas.size + 2


@frozen
class Forms:
    """Monitors as linear forms; shapes (monitors, basis), (monitors, alpha index), ...

    `threshold` (span, monitors) is k_T times the exact sigma at each epoch, transient included;
    `slope` (monitors,) the final response of the EWMA to a ramp of 1 m/s; each form is turned so that
    the ramp raises it. `members` (questions, monitors) says which monitors answer which question.
    """

    rows: Floats
    alpha: Ints
    threshold: Floats
    slope: Floats
    members: Bools


def bank_forms(plan: ExperimentPlan) -> Forms:
    """All monitors of all headings and readings (DIAG eq. 1-3, 8, 10-16)."""
    forms: list[_Form] = []
    for heading in plan.headings_deg:
        for reading in plan.readings:
            forms += _forms_along(plan, heading, reading)
        if "odometer_and_track" in plan.sensors:
            axis = plan.geometry.axes(heading)[1]
            signals = {"east": axis[0], "north": axis[1], "map_cross": -plan.map_m}
            forms += _forms_against_map(plan, axis, signals, heading)
    if "odometer_and_track" in plan.sensors:
        # The signal `up` holds the noise of the map already.
        forms += _forms_against_map(plan, np.array([0.0, 0.0, 1.0]), {"up": 1.0}, None)
    return Forms(
        np.array([form.row for form in forms]),
        np.array([form.alpha for form in forms]),
        threshold_factor(plan.false_alarm_probability) * np.column_stack([form.sigma_mps for form in forms]),
        np.array([form.slope for form in forms]),
        np.array([form.members for form in forms]).T,
    )


def failure_forms(plan: ExperimentPlan) -> Forms:
    """The along-track error itself, by heading, against the failure limit."""
    count = len(plan.headings_deg)
    rows = np.zeros((count, plan.basis_size))
    slope = np.zeros(count)
    for index, heading in enumerate(plan.headings_deg):
        along = plan.geometry.axes(heading)[0]
        towards = _sign_of(along @ plan.geometry.ramp_direction)
        rows[index, -2:] = towards * along[:2]
        slope[index] = towards * (along @ plan.geometry.ramp_direction)
    return Forms(
        rows,
        np.zeros(count, dtype=np.int64),
        np.full((1, count), plan.failure_limit_m),
        slope,
        np.eye(count, dtype=np.bool_),
    )


@frozen
class _Form:
    """One monitor: row over the basis, index of its weight, sigma by epoch, slope, and the questions it answers."""

    row: Floats
    alpha: int
    sigma_mps: Floats
    slope: float
    members: list[bool]


def _sign_of(slope: float) -> float:
    """-1 for a negative slope, else +1."""
    return -1.0 if slope < 0 else 1.0


def _forms_along(plan: ExperimentPlan, heading: float, reading: Reading) -> list[_Form]:
    """Along the track, against the odometer with its noise on this reading."""
    axis = plan.geometry.axes(heading)[0]
    signals = {"east": axis[0], "north": axis[1], f"odometer_{reading}": -plan.odometer_m}
    answers = [(r, h) == (reading, heading) for r, h, _ in plan.questions]
    spec = BankSpec(reading=reading, odometer_m=plan.odometer_m, age_s=0.0)
    return _forms_by_weight(plan, axis, spec, 0.0, signals, [answers] * len(spec.weights))


def _forms_against_map(
    plan: ExperimentPlan, axis: Floats, signals: dict[str, float], heading: float | None
) -> list[_Form]:
    """Across the track, or in height at any heading, against the map; of questions whose bank has the weight."""
    spec = BankSpec(alphas=tuple(plan.alphas.tolist()), odometer_m=0.0, age_s=0.0)
    members = [
        [
            sensors == "odometer_and_track" and alpha in PUBLISHED_WEIGHTS[reading] and heading in (None, course)
            for reading, course, sensors in plan.questions
        ]
        for alpha in spec.weights
    ]
    return _forms_by_weight(plan, axis, spec, plan.map_m, signals, members)


def _forms_by_weight(
    plan: ExperimentPlan,
    axis: Floats,
    spec: BankSpec,
    white_m: float,
    signals: dict[str, float],
    members: list[list[bool]],
) -> list[_Form]:
    """A form for each weight of the bank; the basis is [alpha, signal] with the position at the end.

    `axis`: unit vector (3,). `white_m`: noise on the position. `signals`: what of each signal the monitors see.
    """
    variances_m2 = np.einsum("a,jab,b->j", axis, plan.geometry.source_covariances_m2, axis)
    sigmas_mps = bank_of_axis(spec, variances_m2, TAUS_S, white_m).sigmas(plan.span_s)
    slope = float(axis @ plan.geometry.ramp_direction)
    forms = []
    for weight, sigma_mps, answers in zip(spec.weights, sigmas_mps.T, members, strict=True):
        index = int(np.flatnonzero(plan.alphas == weight)[0])
        row = np.zeros(plan.basis_size)
        for signal, factor in signals.items():
            row[index * len(SIGNALS) + SIGNALS.index(signal)] = factor * _sign_of(slope)
        forms.append(_Form(row, index, sigma_mps, abs(slope), answers))
    return forms


class FirstPassages(NamedTuple):
    """Seconds from onset to the first passage, `NEVER` where there was none within the span.

    `detected_s` (questions, rates, repetitions), `failed_s` (headings, rates, repetitions);
    `alarmed_before` (questions, repetitions): the bank failed before the onset.
    """

    detected_s: Seconds
    failed_s: Seconds
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
        self._filter_signals(basis)
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

    def _filter_signals(self, basis: Floats) -> None:
        """Run the averages over the signals of a block, into the basis."""
        signals = basis[:, : len(SIGNALS)]
        rows = basis[:, len(SIGNALS) : -2].reshape(len(basis), -1, len(SIGNALS), basis.shape[2])
        before = self._ewma
        for step, drive in enumerate(signals):
            np.multiply(before, self._keep, out=rows[step])
            before = np.add(rows[step], drive, out=rows[step])
        self._ewma = before.copy()


class FirstAnswers:
    """Keeps, for every question, rate and repetition, when it was first answered.

    `first` (questions, rates, repetitions): seconds from onset to the first passage.
    """

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
        self.first = np.full((len(members), self._rates.size, repetitions), NEVER, dtype=np.int32)
        self.alarmed = np.zeros((banks.members.shape[0], repetitions), dtype=np.bool_)

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
        largest_open = np.where(self.first == NEVER, self._rates[:, None], -np.inf).max(axis=1)
        for question, asked in enumerate(self._forms):
            waiting = largest_open[question]
            possible = (slowest[asked] <= waiting) | ((low[asked] < -least[asked]) & (waiting > 0.0))
            runs = np.flatnonzero(possible.any(axis=0))
            if runs.size:
                forms = asked[possible.any(axis=1)]
                terms = np.flatnonzero(self._rows[forms].any(axis=0))
                values = np.matmul(self._rows[np.ix_(forms, terms)], basis[:, terms[:, None], runs])
                self._note_answers(question, runs, values, threshold[:, forms, None], response[:, forms, None], begin)

    def _note_answers(
        self, question: int, runs: Ints, values: Floats, threshold: Floats, response: Floats, begin: int
    ) -> None:
        """When each rate, if still open, is first answered; `values` (epochs, forms, runs)."""
        # The smallest rate at which a form fails with the ramp; against it, -m > T + c b: a false alarm, likelier for
        # the slower ramp.
        with_ramp = ((threshold - values) / response).min(axis=1)
        against = -((threshold + values) / response).min(axis=1)
        for index, rate in enumerate(self._rates):
            waiting = self.first[question, index, runs] == NEVER
            if waiting.any():
                failing = (with_ramp < rate) | (against > rate)
                found = failing.any(axis=0) & waiting
                when = failing.argmax(axis=0) + begin + 1 - self._plan.onset_s
                self.first[question, index, runs[found]] = when[found]

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
    for begin, end in _growing_blocks(0, plan.onset_s):
        answers.before_onset(paths.advance(end - begin), begin)
    for begin, end in _growing_blocks(plan.onset_s, plan.span_s, _FIRST_BLOCK):
        answers.after_onset(paths.advance(end - begin), begin)
    questions = banks.members.shape[0]
    return FirstPassages(answers.first[:questions], answers.first[questions:], answers.alarmed)


def _growing_blocks(begin: int, end: int, shortest: int = BLOCK_EPOCHS) -> Iterator[tuple[int, int]]:
    """Blocks that grow with the time since `begin`: passages of fast ramps crowd at the onset."""
    at = begin
    while at < end:
        size = min(max(shortest, (at - begin) // 8), BLOCK_EPOCHS, end - at)
        yield at, at + size
        at += size
