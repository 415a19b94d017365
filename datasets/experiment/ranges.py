"""The pseudorange monitor in the experiment: the ramp that the bank misses, in the ranges themselves.

Range errors are simulated satellite by satellite (DIAG Table 1); the train is held on its surveyed track, whose
error is constant in a run. Residuals may be recorded more slowly than positions: the monitor then
looks at these epochs only.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.special import chdtri

from datasets.experiment.geometry import CONSTELLATIONS, TAUS_S, Geometry, default_geometry
from datasets.experiment.passage import concat_passages
from datasets.experiment.tables import Contents, Row, share, table, time_columns
from datasets.experiment.workers import in_pieces
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows
from schemas.arrays import Bools, Floats
from schemas.config import Configuration
from schemas.frozen import frozen

REPETITIONS = 5_000
# Every course of a train: to the other side the error along the track is the same with the other sign.
HEADINGS_DEG: tuple[float, ...] = tuple(15.0 * k for k in range(12))
_BLOCK_REPETITIONS = 250
_UNDETECTED = -1


@frozen
class RangePlan:
    """What is asked of the monitor: `period_s` between recorded residuals, `survey_m` sigma of the track survey."""

    geometry: Geometry
    headings_deg: tuple[float, ...] = HEADINGS_DEG
    rates_mps: tuple[float, ...] = (0.01, 0.03, 0.1, 1.0)
    period_s: float = 1.0
    span_s: float = 10_000.0
    survey_m: float = 1.0
    failure_limit_m: float = 20.0
    false_alarm_probability: float = 1e-7

    def mean_failure_s(self, heading_deg: float, rate_mps: float) -> float:
        """When the mean error along the track of a ramp passes the limit [s]; infinite where it never does."""
        slope = abs(float(self.geometry.axes(heading_deg)[0] @ self.geometry.ramp_direction)) * rate_mps
        return self.failure_limit_m / slope if slope > 0 else float("inf")


class Statistic(NamedTuple):
    """`value = |project @ r|^2` of range errors r, chi-square with `project.shape[0]` degrees of freedom."""

    project: Floats
    threshold: float


def statistic(plan: RangePlan, heading_deg: float) -> Statistic:
    """The monitor of `pipeline.stages.monitors.pseudorange` for a fixed sky and heading, as one projection.

    Ranges have covariance V = diag(sigma^2) + survey^2 (g_c g_c' + g_u g_u'); along and clocks are free.
    """
    geometry = plan.geometry
    rows = line_of_sight_rows(geometry.azimuth_deg, geometry.elevation_deg)
    axes = geometry.axes(heading_deg)
    held = held_rows(plan, heading_deg)
    covariance = np.diag(geometry.range_variance_m2.sum(axis=1)) + plan.survey_m**2 * held @ held.T
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    free = whiten @ np.column_stack([rows @ axes[0], clock_columns(geometry.svs)])
    basis, _ = np.linalg.qr(free, mode="complete")
    kept = basis[:, free.shape[1] :].T
    return Statistic(kept @ whiten, float(chdtri(kept.shape[0], plan.false_alarm_probability)))


def held_rows(plan: RangePlan, heading_deg: float) -> Floats:
    """Range change per metre of survey error across and in height, shape (satellites, 2)."""
    rows = line_of_sight_rows(plan.geometry.azimuth_deg, plan.geometry.elevation_deg)
    return np.asarray(rows @ plan.geometry.axes(heading_deg)[1:].T)


class RangePassages(NamedTuple):
    """Seconds to detection (`_UNDETECTED` if never), and whether the failure was not later, by heading, rate, run."""

    detected_s: Floats
    failed_first: Bools


def _range_errors(plan: RangePlan, repetitions: int, rng: np.random.Generator) -> Iterator[tuple[float, Floats]]:
    """Time [s] and errors [m] (satellites, repetitions) at each recorded epoch: Gauss-Markov by satellite, source."""
    sigma = np.sqrt(plan.geometry.range_variance_m2.T)[:, :, None]
    phi = np.exp(-plan.period_s / TAUS_S)[:, None, None]
    step = np.sqrt(1.0 - phi**2)
    unit = rng.standard_normal((TAUS_S.size, len(plan.geometry.svs), repetitions))
    for epoch in range(1, int(plan.span_s / plan.period_s) + 1):
        unit *= phi
        unit += step * rng.standard_normal(unit.shape)
        yield epoch * plan.period_s, (sigma * unit).sum(axis=0)


def range_passages(plan: RangePlan, repetitions: int, rng: np.random.Generator) -> RangePassages:
    """Ramps from 0 s on, until every run is detected at every heading and rate, or the span is over."""
    geometry = plan.geometry
    rates = np.array(plan.rates_mps)
    statistics = [statistic(plan, heading) for heading in plan.headings_deg]
    along = np.stack([geometry.axes(heading)[0] @ geometry.gain for heading in plan.headings_deg])
    survey = rng.standard_normal((2, repetitions)) * plan.survey_m
    offsets = [held_rows(plan, heading) @ survey for heading in plan.headings_deg]
    detected = np.full((len(statistics), rates.size, repetitions), float(_UNDETECTED))
    failed_first = np.zeros(detected.shape, dtype=np.bool_)
    for t_s, error in _range_errors(plan, repetitions, rng):
        for index, one in enumerate(statistics):
            open_runs = detected[index] == _UNDETECTED
            if not open_runs.any():
                continue
            found, failed = _judge(plan, one, along[index], error, offsets[index], rates * t_s)
            failed_first[index] |= open_runs & failed
            detected[index][open_runs & found] = t_s
        if (detected != _UNDETECTED).all():
            break
    return RangePassages(detected, failed_first)


def _judge(
    plan: RangePlan, one: Statistic, along: Floats, error: Floats, offset: Floats, ramps_m: Floats
) -> tuple[Bools, Bools]:
    """Alarm and position failure at ramps of these sizes, shapes (rates, repetitions).

    |z + c l|^2 = |z|^2 + 2 c (l.z) + c^2 |l|^2 with z of the noise and l of the faulty satellite.
    """
    faulty = plan.geometry.faulty
    noise = one.project @ (error - offset)
    ramp = one.project[:, faulty]
    square = np.einsum("dr,dr->r", noise, noise)
    mixed = ramp @ noise
    value = square + 2.0 * ramps_m[:, None] * mixed + ramps_m[:, None] ** 2 * (ramp @ ramp)
    position = along @ error + ramps_m[:, None] * along[faulty]
    return value > one.threshold, np.abs(position) > plan.failure_limit_m


def made(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`pseudorange`."""
    return {"pseudorange": run_ranges(repetitions, seed, jobs)}


def run_ranges(
    repetitions: int = REPETITIONS,
    seed: int = 1,
    jobs: int = 1,
    plans: tuple[RangePlan, ...] | None = None,
) -> pl.DataFrame:
    """Detection by the pseudorange monitor: both constellations, residuals every 1, 10 and 30 s unless planned."""
    plans = plans or tuple(
        RangePlan(default_geometry(name), period_s=period_s)
        for name in CONSTELLATIONS
        for period_s in (1.0, 10.0, 30.0)
    )
    rows = []
    for number, plan in enumerate(plans):
        pieces = in_pieces(partial(range_passages, plan), repetitions, _BLOCK_REPETITIONS, (seed, 77, number), jobs)
        found = concat_passages(pieces)
        rows += [
            _row(plan, heading, rate, found.detected_s[h, r], found.failed_first[h, r])
            for h, heading in enumerate(plan.headings_deg)
            for r, rate in enumerate(plan.rates_mps)
        ]
    return table(rows)


def _row(plan: RangePlan, heading: float, rate: float, detected_s: Floats, failed_first: Bools) -> Row:
    found = detected_s != _UNDETECTED
    failed = int(failed_first.sum())
    time = time_columns("time_to_detect", np.where(found, detected_s, plan.span_s), 0.0, plan.span_s)
    mean_failure_s = plan.mean_failure_s(heading, rate)
    return {
        "constellation": plan.geometry.constellation,
        "period_s": plan.period_s,
        "heading_deg": heading,
        "rate_mps": rate,
        "repetitions": failed_first.size,
        "censored": int((~found).sum()),
        **{name: time[name] for name in ("time_to_detect_s", "time_to_detect_low_s", "time_to_detect_high_s")},
        "mean_failure_s": mean_failure_s if np.isfinite(mean_failure_s) else None,
        "missed_at_failure": failed,
        **share("pmd_at_failure", failed, failed_first.size),
    }
