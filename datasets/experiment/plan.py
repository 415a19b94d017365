"""What is simulated and what is asked: the grid of the experiment, and its monitors as linear forms.

All that the monitors see is linear in the noise, so a monitor is a row over the basis (EWMAs of six
signals, and the horizontal position): value = row . basis. Everything that depends on heading, reading and
satellite geometry is in the rows; the noise path is drawn once for all of them.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from datasets.experiment.bank import (
    PUBLISHED_WEIGHTS,
    READINGS,
    SENSORS,
    BankSpec,
    Reading,
    Sensors,
    bank_of_axis,
)
from datasets.experiment.geometry import TAUS_S, Geometry
from schemas.arrays import Bools, Floats, Ints
from schemas.config import threshold_factor
from schemas.frozen import frozen

RATES_MPS: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
HEADINGS_DEG: tuple[float, ...] = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
SIGNALS: tuple[str, ...] = ("east", "north", "up", "map_cross", "odometer_increments", "odometer_position")


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
        towards = _towards(along @ plan.geometry.ramp_direction)
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


def _towards(slope: float) -> float:
    return -1.0 if slope < 0 else 1.0


def _forms_along(plan: ExperimentPlan, heading: float, reading: Reading) -> list[_Form]:
    """Along the track, against the odometer with its noise on this reading."""
    axis = plan.geometry.axes(heading)[0]
    signals = {"east": axis[0], "north": axis[1], f"odometer_{reading}": -plan.odometer_m}
    answers = [(r, h) == (reading, heading) for r, h, _ in plan.questions]
    spec = BankSpec(reading=reading, odometer_m=plan.odometer_m, age_s=0.0)
    return _forms(plan, axis, spec, 0.0, signals, [answers] * len(spec.weights))


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
    return _forms(plan, axis, spec, plan.map_m, signals, members)


def _forms(
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
            row[index * len(SIGNALS) + SIGNALS.index(signal)] = factor * _towards(slope)
        forms.append(_Form(row, index, sigma_mps, abs(slope), answers))
    return forms
