"""Thresholds three ways.

- `exact`: k_T times the sigma of the error model, transient included (the replay's bank).
- `regression`: sigma of each monitor as a line over sigma_x of the position along the track, fitted over skies and
  headings (DIAG: "modeled with standard deviation of the along-track GNSS position by a linear regression method").
- `calibrated`: the model's sigma times the ratio measured on some hours of fault-free runs, as `balise calibrate` does.

A monitor is Gaussian, so a threshold too small by a few percent shows in the tail many times over: the false-alarm
probability that a way really gives at a sky is 2 Q(k_T T_way / T_exact).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.special import ndtr

from datasets.experiment.geometry import CONSTELLATIONS, TAUS_S, Geometry, skies_of_day
from datasets.experiment.passage import BLOCK_EPOCHS, NoisePaths
from datasets.experiment.plan import BANKS, HEADINGS_DEG, READINGS, ExperimentPlan, Reading, bank_forms
from datasets.experiment.sigmas import limit_sigmas
from datasets.experiment.tables import table
from datasets.experiment.workers import generator
from pipeline.studies.calibration.sigmas import overall_ratio
from schemas.arrays import Floats
from schemas.config import threshold_factor

EXTRAPOLATED = 1e-7
_PER_PLACE = 20
_CALIBRATION_RUNS = 20
_CALIBRATION_S = 3_600
_AXES = ("along", "cross", "up")


class SkySigmas(NamedTuple):
    """Of one axis over skies and headings: sigma_x of the position [m] (skies,), exact long-term sigmas of its
    monitors [m/s] (skies, alphas).
    """

    sigma_x_m: Floats
    sigma_mps: Floats


class FittedLine(NamedTuple):
    """sigma_monitor = intercept + slope sigma_x."""

    intercept_mps: float
    slope_per_s: float

    def sigma_mps(self, sigma_x_m: Floats) -> Floats:
        return self.intercept_mps + self.slope_per_s * sigma_x_m


def sky_sigmas(reading: Reading, per_place: int) -> dict[str, SkySigmas]:
    """By axis, over all skies of the day and headings."""
    alphas = np.array(BANKS[reading])
    variances = np.array(
        [
            _variances(sky[number], heading)
            for number in range(len(CONSTELLATIONS))
            for sky in skies_of_day(per_place)
            for heading in HEADINGS_DEG
        ]
    )
    sigma_x = np.array([np.sqrt(one[0].sum()) for one in variances])
    found = {}
    for axis, name in enumerate(_AXES):
        white = _white_noise(reading, axis)
        sigmas = [limit_sigmas(alphas, one, TAUS_S, *white) for one in variances[:, axis]]
        found[name] = SkySigmas(sigma_x, np.array(sigmas))
    return found


def _variances(geometry: Geometry, heading_deg: float) -> Floats:
    """Of the position error by axis and source [m2], (axes, sources)."""
    axes = geometry.axes(heading_deg)
    return np.asarray(np.einsum("ai,jik,ak->aj", axes, geometry.source_covariances_m2, axes))


def _white_noise(reading: Reading, axis: int) -> tuple[float, float]:
    """White noise on increments and on position of an axis [m]."""
    if axis > 0:
        return 0.0, 1.0
    return (0.05, 0.0) if reading == "increments" else (0.0, 0.05)


def regression_lines(skies: dict[str, SkySigmas]) -> dict[tuple[str, int], FittedLine]:
    """One line per axis and alpha, least squares over all skies and headings (DIAG eq. 17 and below)."""
    lines = {}
    for axis, (sigma_x, sigmas) in skies.items():
        for index in range(sigmas.shape[1]):
            slope, intercept = np.polyfit(sigma_x, sigmas[:, index], 1)
            lines[axis, index] = FittedLine(float(intercept), float(slope))
    return lines


def regression_table(per_place: int = _PER_PLACE) -> pl.DataFrame:
    """How the regressed sigma compares with the exact one over skies, and what that does to false alarms at 1e-7."""
    factor = threshold_factor(EXTRAPOLATED)
    rows: list[dict[str, object]] = []
    for reading in READINGS:
        skies = sky_sigmas(reading, per_place)
        for (axis, index), line in regression_lines(skies).items():
            ratio = line.sigma_mps(skies[axis].sigma_x_m) / skies[axis].sigma_mps[:, index]
            real = two_sided(factor * np.maximum(ratio, 0.0))
            rows.append(
                {
                    "reading": reading,
                    "axis": axis,
                    "alpha": BANKS[reading][index],
                    "intercept_mps": line.intercept_mps,
                    "slope_per_s": line.slope_per_s,
                    "skies": ratio.size,
                    "ratio_least": float(ratio.min()),
                    "ratio_median": float(np.median(ratio)),
                    "ratio_greatest": float(ratio.max()),
                    "false_alarm_median": float(np.median(real)),
                    "false_alarm_worst": float(real.max()),
                }
            )
    return table(rows)


def two_sided(factor: Floats) -> Floats:
    """Probability that a Gaussian is beyond +- factor sigmas."""
    return np.asarray(2.0 * ndtr(-factor))


def calibrated_ratios(plan: ExperimentPlan, seed: int, runs: int = _CALIBRATION_RUNS) -> Floats:
    """Measured over modelled sigma of each monitor on fault-free runs of an hour."""
    long = replace(plan, span_s=_CALIBRATION_S, onset_s=_CALIBRATION_S)
    forms = bank_forms(long)
    factor = threshold_factor(long.false_alarm_probability)
    paths = NoisePaths(long, runs, generator(seed, 51))
    blocks = [
        np.matmul(forms.rows * paths.weights, paths.advance(BLOCK_EPOCHS))
        for _ in range(_CALIBRATION_S // BLOCK_EPOCHS)
    ]
    values = np.concatenate(blocks)
    ratios = factor * values / forms.threshold[: len(values), :, None]
    return np.array([overall_ratio(ratios[:, form]) for form in range(values.shape[1])])


def regressed_ratios(plan: ExperimentPlan) -> Floats:
    """Regressed over exact long-term sigma of each monitor of the plan, from the lines over all skies."""
    forms = bank_forms(plan)
    variances = _variances(plan.geometry, 0.0)
    sigma_x = np.sqrt(variances[:1].sum(axis=1))
    ratios = []
    lines = {reading: regression_lines(sky_sigmas(reading, _PER_PLACE)) for reading in READINGS}
    for name, alpha in zip(forms.names, plan.alphas[forms.alpha], strict=True):
        axis = _AXES.index(name.split("_", 1)[0])
        # Across and up, sigmas do not depend on the odometer: any reading serves whose bank has this weight.
        with_weight = [r for r in READINGS if float(alpha) in BANKS[r]]
        reading: Reading = next((r for r in READINGS if f"along_{r}" in name), with_weight[0])
        exact = limit_sigmas(np.array([alpha]), variances[axis], TAUS_S, *_white_noise(reading, axis))
        line = lines[reading][_AXES[axis], BANKS[reading].index(float(alpha))]
        ratios.append(float((line.sigma_mps(sigma_x) / exact)[0]))
    return np.array(ratios)
