"""The published Monte Carlo (DIAG, sections Error models and Simulation) at its own size.

Definitions that the paper leaves open. The bank starts at 0 s; what it did before the ramp's onset is
counted apart and detection means the first failing epoch after the onset. The failure is the first epoch at
which the along-track error, noise included, is beyond the limit. A run without detection within the span
is missed, and enters expected times with the end of the span, which makes them lower bounds (column `censored`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.experiment.bounds import Expected, expected
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, Geometry, default_geometry
from datasets.experiment.passage import NEVER, Passages, first_passages, joined
from datasets.experiment.plan import Plan, bank_forms, failure_forms
from datasets.experiment.tables import refuse_configuration, write_tables
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from pipeline.figures.bounds import clopper_pearson
from schemas.arrays import Ints
from schemas.config import Configuration

REPETITIONS = 10_000
SEED = 1
_BLOCK_REPETITIONS = 256
_PMD_POINTS = 81


@dataclass(frozen=True)
class Frames:
    """`pmd`: Fig. 5; `detection`: Fig. 6 and 7 and the shares at the moment of failure; `geometry`: the skies."""

    pmd: pl.DataFrame
    detection: pl.DataFrame
    geometry: pl.DataFrame


@dataclass(frozen=True)
class _Piece:
    plan: Plan
    key: tuple[int, ...]
    repetitions: int


def run_diagnostics(
    repetitions: int = REPETITIONS,
    seed: int = SEED,
    jobs: int = 1,
    plans: tuple[Plan, ...] | None = None,
) -> Frames:
    """Simulate and tabulate; without plans, the paper's grid for both constellations."""
    plans = plans or tuple(Plan(default_geometry(constellation)) for constellation in CONSTELLATIONS)
    passages = simulate(plans, repetitions, seed, jobs)
    pairs = list(zip(plans, passages, strict=True))
    return Frames(
        pmd=pl.concat([pmd_over_time(plan, result) for plan, result in pairs]),
        detection=pl.concat([detection_times(plan, result) for plan, result in pairs]),
        geometry=pl.concat([geometry_table(plan.geometry) for plan in plans]),
    )


def simulate(plans: tuple[Plan, ...], repetitions: int, seed: int, jobs: int) -> list[Passages]:
    """First passages of every plan; the same for any number of jobs."""
    pieces = [
        _Piece(plan, (seed, number, block), size)
        for number, plan in enumerate(plans)
        for block, size in enumerate(in_blocks(repetitions, _BLOCK_REPETITIONS))
    ]
    results = mapped(_simulate_piece, pieces, jobs)
    blocks = len(results) // len(plans)
    return [joined(results[at : at + blocks]) for at in range(0, len(results), blocks)]


def _simulate_piece(piece: _Piece) -> Passages:
    plan = piece.plan
    return first_passages(plan, bank_forms(plan), failure_forms(plan), piece.repetitions, generator(*piece.key))


def pmd_over_time(plan: Plan, passages: Passages) -> pl.DataFrame:
    """Share of failed runs not yet detected at a time since failure, with exact bounds (Fig. 5)."""
    rows = [row for cell in _cells(plan, passages) for row in _pmd_rows(plan, cell)]
    return pl.DataFrame(rows, schema=_PMD_SCHEMA, orient="row")


def detection_times(plan: Plan, passages: Passages) -> pl.DataFrame:
    """Expected times of detection by question and rate (Fig. 6 and 7), shares detected and missed at failure."""
    rows = [_detection_row(plan, cell) for cell in _cells(plan, passages)]
    return pl.DataFrame(rows, schema=_DETECTION_SCHEMA, orient="row")


@dataclass(frozen=True)
class _Cell:
    """One question at one rate: seconds from onset, the span where it never came."""

    labels: tuple[Constellation, str, str, float, float]
    detected_s: Ints
    detected: npt.NDArray[np.bool_]
    failed_s: Ints
    failed: npt.NDArray[np.bool_]
    alarmed_before: int


def _cells(plan: Plan, passages: Passages) -> list[_Cell]:
    end_s = plan.span_s - plan.onset_s
    cells = []
    for index, (reading, heading, sensors) in enumerate(plan.questions):
        for rate, rate_mps in enumerate(plan.rates_mps):
            detected = passages.detected_s[index, rate].astype(np.int64)
            failed = passages.failed_s[plan.headings_deg.index(heading), rate].astype(np.int64)
            cells.append(
                _Cell(
                    (plan.geometry.constellation, reading, sensors, heading, rate_mps),
                    np.where(detected == NEVER, end_s, detected),
                    detected != NEVER,
                    np.where(failed == NEVER, end_s, failed),
                    failed != NEVER,
                    int(passages.alarmed_before[index].sum()),
                )
            )
    return cells


def _pmd_rows(plan: Plan, cell: _Cell) -> list[tuple[object, ...]]:
    trials = int(cell.failed.sum())
    if trials == 0:
        return []
    failed_s = cell.failed_s[cell.failed]
    lateness = np.where(cell.detected, cell.detected_s - cell.failed_s, np.iinfo(np.int64).max)[cell.failed]
    reach_s = int(np.median(failed_s))
    # Beyond this time after failure some run would be over before it could be detected.
    last_s = plan.span_s - plan.onset_s - int(failed_s.max())
    times = np.unique(np.linspace(-reach_s, min(reach_s, last_s), _PMD_POINTS).round().astype(np.int64))
    times = np.union1d(times, [0])
    rows: list[tuple[object, ...]] = []
    for time_s in times:
        missed = int((lateness > time_s).sum())
        share = clopper_pearson(missed, trials)
        rows.append((*cell.labels, float(time_s), missed, trials, share.value, share.low, share.high))
    return rows


def _detection_row(plan: Plan, cell: _Cell) -> tuple[object, ...]:
    end_s = float(plan.span_s - plan.onset_s)
    repetitions, trials = cell.detected.size, int(cell.failed.sum())
    detected = clopper_pearson(int(cell.detected.sum()), repetitions)
    alarmed = clopper_pearson(cell.alarmed_before, repetitions)
    since = (cell.detected_s - cell.failed_s)[cell.failed]
    missed = clopper_pearson(int((~cell.detected[cell.failed] | (since > 0)).sum()), trials)
    return (
        *cell.labels,
        repetitions,
        repetitions - int(cell.detected.sum()),
        detected.value,
        detected.low,
        detected.high,
        *_times(expected(cell.detected_s.astype(np.float64), 0.0, end_s)),
        trials,
        *_times(expected(since.astype(np.float64), -end_s, end_s)),
        missed.value,
        missed.low,
        missed.high,
        alarmed.value,
        alarmed.low,
        alarmed.high,
    )


def _times(result: Expected | None) -> tuple[float | None, ...]:
    if result is None:
        return (None,) * 7
    return (
        result.mean,
        result.standard_error,
        result.low,
        result.high,
        result.median,
        result.median_low,
        result.median_high,
    )


def geometry_table(geometry: Geometry) -> pl.DataFrame:
    """The sky: satellites, directions, and what a metre of range error does to the position."""
    gain = geometry.gain
    return pl.DataFrame(
        {
            "constellation": geometry.constellation,
            "place": geometry.place,
            "t": geometry.t_ns,
            "sv": list(geometry.svs),
            "azimuth_deg": geometry.azimuth_deg,
            "elevation_deg": geometry.elevation_deg,
            "sigma_m": np.sqrt(geometry.range_variance_m2.sum(axis=1)),
            "gain_east": gain[0],
            "gain_north": gain[1],
            "gain_up": gain[2],
            "faulty": [index == geometry.faulty for index in range(len(geometry.svs))],
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def write_experiment(
    out: Path,
    repetitions: int | None = None,
    seed: int = SEED,
    jobs: int = 1,
    config: Configuration | None = None,
    figures: bool = True,
) -> list[Path]:
    """Tables and pictures of the experiment into a folder; returns what was written."""
    from datasets.experiment.figures import draw_figures, require_matplotlib

    refuse_configuration("diagnostics", config)
    if figures:
        require_matplotlib()
    frames = run_diagnostics(repetitions or REPETITIONS, seed, jobs)
    settings = {"experiment": "diagnostics", "repetitions": repetitions or REPETITIONS, "seed": seed}
    tables = {"pmd": frames.pmd, "detection": frames.detection, "geometry": frames.geometry}
    written = write_tables(out, tables, settings)
    return written + (draw_figures(frames.pmd, frames.detection, frames.geometry, out) if figures else [])


_LABELS = {
    "constellation": pl.String,
    "reading": pl.String,
    "sensors": pl.String,
    "heading_deg": pl.Float64,
    "rate_mps": pl.Float64,
}
_PMD_SCHEMA = _LABELS | {
    "time_since_failure_s": pl.Float64,
    "missed": pl.Int64,
    "trials": pl.Int64,
    "pmd": pl.Float64,
    "pmd_low": pl.Float64,
    "pmd_high": pl.Float64,
}


def _time_columns(name: str) -> dict[str, type[pl.DataType]]:
    suffixes = ("", "_standard_error", "_low", "_high", "_median", "_median_low", "_median_high")
    return {f"{name}{suffix}_s": pl.Float64 for suffix in suffixes}


_DETECTION_SCHEMA = (
    _LABELS
    | {
        "repetitions": pl.Int64,
        "censored": pl.Int64,
        "detected": pl.Float64,
        "detected_low": pl.Float64,
        "detected_high": pl.Float64,
    }
    | _time_columns("time_to_detect")
    | {"failed": pl.Int64}
    | _time_columns("time_since_failure")
    | {
        "pmd_at_failure": pl.Float64,
        "pmd_at_failure_low": pl.Float64,
        "pmd_at_failure_high": pl.Float64,
        "alarmed_before": pl.Float64,
        "alarmed_before_low": pl.Float64,
        "alarmed_before_high": pl.Float64,
    }
)
