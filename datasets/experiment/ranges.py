"""The pseudorange monitor in the experiment: the ramp that the bank misses, in the ranges themselves.

Range errors are simulated satellite by satellite (DIAG Table 1); the train is held on its surveyed track, whose
error is constant in a run. Residuals may be recorded more slowly than positions: the monitor then
looks at these epochs only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from scipy.special import chdtri

from datasets.experiment.bounds import expected
from datasets.experiment.diagnostics import SEED
from datasets.experiment.geometry import CONSTELLATIONS, TAUS_S, Geometry, default_geometry
from datasets.experiment.tables import refuse_configuration, write_tables
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from pipeline.figures.bounds import clopper_pearson
from pipeline.monitors.sight import clock_columns, line_of_sight_rows
from schemas.arrays import Floats
from schemas.config import Configuration

REPETITIONS = 5_000
# Every course of a train: to the other side the error along the track is the same with the other sign.
HEADINGS_DEG: tuple[float, ...] = tuple(15.0 * k for k in range(12))
_BLOCK_REPETITIONS = 250
_UNDETECTED = -1


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class Statistic:
    """`value = |project @ r|^2` of range errors r, chi-square with `project.shape[0]` degrees of freedom."""

    project: Floats
    threshold: float


def statistic(plan: RangePlan, heading_deg: float) -> Statistic:
    """The monitor of `pipeline.monitors.pseudorange` for a fixed sky and heading, as one projection.

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


@dataclass(frozen=True)
class RangePassages:
    """Seconds to detection (`_UNDETECTED` if never), and whether the failure was not later, by heading, rate, run."""

    detected_s: Floats
    failed_first: npt.NDArray[np.bool_]


class _RangeErrors:
    """Unit Gauss-Markov processes of all satellites and sources, at the recording period."""

    def __init__(self, plan: RangePlan, repetitions: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._sigma = np.sqrt(plan.geometry.range_variance_m2.T)[:, :, None]
        self._phi = np.exp(-plan.period_s / TAUS_S)[:, None, None]
        self._step = np.sqrt(1.0 - self._phi**2)
        self._unit = rng.standard_normal((TAUS_S.size, len(plan.geometry.svs), repetitions))

    def advance(self) -> Floats:
        """Errors at the next recorded epoch [m], shape (satellites, repetitions)."""
        self._unit *= self._phi
        self._unit += self._step * self._rng.standard_normal(self._unit.shape)
        return np.asarray((self._sigma * self._unit).sum(axis=0))


def range_passages(plan: RangePlan, repetitions: int, rng: np.random.Generator) -> RangePassages:
    """Ramps from 0 s on, until every run is detected at every heading and rate, or the span is over."""
    geometry, rates = plan.geometry, np.array(plan.rates_mps)
    statistics = [statistic(plan, heading) for heading in plan.headings_deg]
    along = np.stack([geometry.axes(heading)[0] @ geometry.gain for heading in plan.headings_deg])
    survey = rng.standard_normal((2, repetitions)) * plan.survey_m
    offsets = [held_rows(plan, heading) @ survey for heading in plan.headings_deg]
    errors = _RangeErrors(plan, repetitions, rng)
    detected = np.full((len(statistics), rates.size, repetitions), float(_UNDETECTED))
    failed_first = np.zeros(detected.shape, dtype=np.bool_)
    for epoch in range(1, int(plan.span_s / plan.period_s) + 1):
        t_s = epoch * plan.period_s
        error = errors.advance()
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
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Alarm and position failure at ramps of these sizes, shapes (rates, repetitions).

    |z + c l|^2 = |z|^2 + 2 c (l.z) + c^2 |l|^2 with z of the noise and l of the faulty satellite.
    """
    faulty = plan.geometry.faulty
    noise, ramp = one.project @ (error - offset), one.project[:, faulty]
    square, mixed = np.einsum("dr,dr->r", noise, noise), ramp @ noise
    value = square + 2.0 * ramps_m[:, None] * mixed + ramps_m[:, None] ** 2 * (ramp @ ramp)
    position = along @ error + ramps_m[:, None] * along[faulty]
    return value > one.threshold, np.abs(position) > plan.failure_limit_m


@dataclass(frozen=True)
class _Piece:
    plan: RangePlan
    key: tuple[int, ...]
    repetitions: int


def _simulate_piece(piece: _Piece) -> RangePassages:
    return range_passages(piece.plan, piece.repetitions, generator(*piece.key))


def run_ranges(
    repetitions: int = REPETITIONS,
    seed: int = SEED,
    jobs: int = 1,
    plans: tuple[RangePlan, ...] | None = None,
) -> pl.DataFrame:
    """Detection by the pseudorange monitor: both constellations, residuals every 1, 10 and 30 s unless planned."""
    plans = plans or tuple(
        RangePlan(default_geometry(name), period_s=period_s)
        for name in CONSTELLATIONS
        for period_s in (1.0, 10.0, 30.0)
    )
    pieces = [
        _Piece(plan, (seed, 77, number, block), size)
        for number, plan in enumerate(plans)
        for block, size in enumerate(in_blocks(repetitions, _BLOCK_REPETITIONS))
    ]
    results = mapped(_simulate_piece, pieces, jobs)
    blocks = len(results) // len(plans)
    return pl.concat([_table(plan, results[at * blocks : (at + 1) * blocks]) for at, plan in enumerate(plans)])


def _table(plan: RangePlan, parts: list[RangePassages]) -> pl.DataFrame:
    detected = np.concatenate([part.detected_s for part in parts], axis=-1)
    failed_first = np.concatenate([part.failed_first for part in parts], axis=-1)
    rows = [
        _row(plan, heading, rate, detected[h, r], failed_first[h, r])
        for h, heading in enumerate(plan.headings_deg)
        for r, rate in enumerate(plan.rates_mps)
    ]
    return pl.DataFrame(rows, infer_schema_length=None)


def _row(
    plan: RangePlan, heading: float, rate: float, detected_s: Floats, failed_first: npt.NDArray[np.bool_]
) -> dict[str, object]:
    found = detected_s != _UNDETECTED
    missed = clopper_pearson(int(failed_first.sum()), failed_first.size)
    time = expected(np.where(found, detected_s, plan.span_s), 0.0, plan.span_s)
    slope = abs(float(plan.geometry.axes(heading)[0] @ plan.geometry.ramp_direction)) * rate
    return {
        "constellation": plan.geometry.constellation,
        "period_s": plan.period_s,
        "heading_deg": heading,
        "rate_mps": rate,
        "repetitions": failed_first.size,
        "censored": int((~found).sum()),
        "time_to_detect_s": None if time is None else time.mean,
        "time_to_detect_low_s": None if time is None else time.low,
        "time_to_detect_high_s": None if time is None else time.high,
        "mean_failure_s": plan.failure_limit_m / slope if slope > 0 else None,
        "missed_at_failure": int(failed_first.sum()),
        "pmd_at_failure": missed.value,
        "pmd_at_failure_low": missed.low,
        "pmd_at_failure_high": missed.high,
    }


def write_ranges(
    out: Path, repetitions: int | None = None, seed: int = SEED, jobs: int = 1, config: Configuration | None = None
) -> list[Path]:
    """`pseudorange.parquet`."""
    refuse_configuration("pseudorange", config)
    table = run_ranges(repetitions or REPETITIONS, seed, jobs)
    settings = {"experiment": "pseudorange", "repetitions": repetitions or REPETITIONS, "seed": seed}
    return write_tables(out, {"pseudorange": table}, settings)
