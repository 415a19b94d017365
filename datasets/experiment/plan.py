"""What is simulated and what is asked: the grid of the experiment, and its monitors as linear forms.

All that the monitors see is linear in the noise, so a monitor is a row over the basis (EWMAs of six
signals, and the horizontal position): value = row . basis. Everything that depends on heading, reading and
satellite geometry is in the rows; the noise path is drawn once for all of them.
"""

from __future__ import annotations

from dataclasses import field
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from datasets.experiment.geometry import TAUS_S, Geometry
from datasets.experiment.sigmas import bank_sigmas
from schemas.arrays import Floats
from schemas.config import threshold_factor
from schemas.frozen import frozen

Reading = Literal["increments", "position"]
Sensors = Literal["odometer", "odometer_and_track"]

READINGS: tuple[Reading, ...] = ("increments", "position")
SENSORS: tuple[Sensors, ...] = ("odometer", "odometer_and_track")
RATES_MPS: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
HEADINGS_DEG: tuple[float, ...] = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
# The two readings of the odometer's noise and the slowest EWMA that goes with each (DOMAIN section 7).
BANKS: dict[Reading, tuple[float, ...]] = {
    "increments": (1.0, 0.1, 0.01, 0.001),
    "position": (1.0, 0.1, 0.01, 0.002),
}
SIGNALS: tuple[str, ...] = ("east", "north", "up", "map_cross", "odometer_increments", "odometer_position")


@frozen
class ExperimentPlan:
    """The grid. `span_s` epochs at 1 Hz, ramp from `onset_s`, failure beyond `failure_limit_m` along the track."""

    geometry: Geometry
    headings_deg: tuple[float, ...] = HEADINGS_DEG
    rates_mps: tuple[float, ...] = RATES_MPS
    readings: tuple[Reading, ...] = READINGS
    sensors: tuple[Sensors, ...] = SENSORS
    banks: dict[Reading, tuple[float, ...]] = field(default_factory=lambda: dict(BANKS))
    span_s: int = 15_000
    onset_s: int = 5_000
    failure_limit_m: float = 20.0
    odometer_m: float = 0.05
    map_m: float = 1.0
    false_alarm_probability: float = 1e-7

    @cached_property
    def alphas(self) -> Floats:
        """Every EWMA weight that some reading uses; the first is the raw monitor."""
        return np.array(sorted({alpha for bank in self.banks.values() for alpha in bank}, reverse=True))

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
    alpha: npt.NDArray[np.int64]
    threshold: Floats
    slope: Floats
    members: npt.NDArray[np.bool_]
    names: tuple[str, ...]


def bank_forms(plan: ExperimentPlan) -> Forms:
    """All monitors of all headings and readings (DIAG eq. 1-3, 8, 10-16)."""
    forms = []
    for heading in plan.headings_deg:
        for reading in plan.readings:
            forms += _along(plan, heading, reading)
        if "odometer_and_track" in plan.sensors:
            axis = plan.geometry.axes(heading)[1]
            signals = {"east": axis[0], "north": axis[1], "map_cross": -plan.map_m}
            forms += _forms_against_map(plan, f"cross_{heading:g}", axis, signals, heading)
    if "odometer_and_track" in plan.sensors:
        forms += _forms_against_map(plan, "up", np.array([0.0, 0.0, 1.0]), {"up": 1.0}, None)
    rows, alpha, sigma, slope, members, names = zip(*forms, strict=True)
    return Forms(
        np.array(rows),
        np.array(alpha),
        threshold_factor(plan.false_alarm_probability) * np.column_stack(sigma),
        np.array(slope),
        np.array(members).T,
        names,
    )


def failure_forms(plan: ExperimentPlan) -> Forms:
    """The along-track error itself, by heading, in units of the failure limit."""
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
        tuple(f"failure_{heading:g}" for heading in plan.headings_deg),
    )


def _towards(slope: float) -> float:
    return -1.0 if slope < 0 else 1.0


# Row over the basis, index of the weight, sigma by epoch, slope, the questions it answers, name.
_Form = tuple[Floats, int, Floats, float, list[bool], str]


def _along(plan: ExperimentPlan, heading: float, reading: Reading) -> list[_Form]:
    axis = plan.geometry.axes(heading)[0]
    white = (plan.odometer_m, 0.0) if reading == "increments" else (0.0, plan.odometer_m)
    signals = {"east": axis[0], "north": axis[1], f"odometer_{reading}": -plan.odometer_m}
    members = [(r, h) == (reading, heading) for r, h, _ in plan.questions]
    name = f"along_{reading}_{heading:g}"
    return [_form(plan, name, axis, alpha, signals, white, members) for alpha in plan.banks[reading]]


def _forms_against_map(
    plan: ExperimentPlan, name: str, axis: Floats, signals: dict[str, float], heading: float | None
) -> list[_Form]:
    """Across the track, or in height at any heading: against the map."""
    white = (0.0, plan.map_m)
    return [_form(plan, name, axis, alpha, signals, white, _with_track(plan, alpha, heading)) for alpha in plan.alphas]


def _with_track(plan: ExperimentPlan, alpha: float, heading: float | None) -> list[bool]:
    """The questions with track, of this heading or all, whose bank has the weight."""
    return [s == "odometer_and_track" and alpha in plan.banks[r] and heading in (None, h) for r, h, s in plan.questions]


def _form(
    plan: ExperimentPlan,
    name: str,
    axis: Floats,
    alpha: float,
    signals: dict[str, float],
    white_m: tuple[float, float],
    members: list[bool],
) -> _Form:
    """The basis is [alpha, signal] with the position at the end; `white_m`: noise on increments and on position."""
    index = int(np.flatnonzero(plan.alphas == alpha)[0])
    slope = float(axis @ plan.geometry.ramp_direction)
    row = np.zeros(plan.basis_size)
    for signal, factor in signals.items():
        row[index * len(SIGNALS) + SIGNALS.index(signal)] = factor * _towards(slope)
    variances = np.einsum("a,jab,b->j", axis, plan.geometry.source_covariances_m2, axis)
    sigma = bank_sigmas(np.array([alpha]), plan.span_s, variances, TAUS_S, *white_m)[:, 0]
    return row, index, sigma, abs(slope), members, f"{name}_{'raw' if alpha == 1.0 else f'{alpha:g}'}"
