"""The published Monte Carlo (DIAG, sections Error models and Simulation) at its own size.

Definitions that the paper leaves open. The bank starts at 0 s; what it did before the ramp's onset is
counted apart and detection means the first failing epoch after the onset. The failure is the first epoch at
which the along-track error, noise included, is beyond the limit. A run without detection within the span
is missed, and enters expected times with the end of the span, which makes them lower bounds (column `censored`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import polars as pl

from datasets.experiment.figures import drawn_figures
from datasets.experiment.geometry import CONSTELLATIONS, PLACE, Geometry, default_geometry
from datasets.experiment.monte_carlo import (
    NEVER,
    ExperimentPlan,
    FirstPassages,
    bank_forms,
    failure_forms,
    first_passages,
)
from datasets.experiment.tables import Contents, Row, share_columns, table_of_rows, time_columns
from datasets.experiment.workers import in_pieces
from schemas.arrays import Bools, Ints
from schemas.config import Configuration
from schemas.frozen import frozen

REPETITIONS = 10_000
_BLOCK_REPETITIONS = 256
_PMD_POINTS = 81


def run(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`pmd`, `detection`, `geometry` and pictures of the experiment."""
    frames = run_diagnostics(repetitions, seed, jobs)
    return {**frames, **drawn_figures(frames["pmd"], frames["detection"], frames["geometry"])}


def run_diagnostics(repetitions: int = REPETITIONS, seed: int = 1, jobs: int = 1) -> dict[str, pl.DataFrame]:
    """The paper's grid for both constellations.

    `pmd`: Fig. 5; `detection`: Fig. 6 and 7 and the shares at the moment of failure; `geometry`: the skies.
    """
    plans = tuple(ExperimentPlan(default_geometry(constellation)) for constellation in CONSTELLATIONS)
    pairs = list(zip(plans, simulate(plans, repetitions, seed, jobs), strict=True))
    return {
        "pmd": table_of_rows(
            [row for plan, found in pairs for cell in _rate_answers(plan, found) for row in _pmd_rows(plan, cell)]
        ),
        "detection": pl.concat([detection_times(plan, found) for plan, found in pairs]),
        "geometry": pl.concat([geometry_table(plan.geometry) for plan in plans]),
    }


def simulate(plans: tuple[ExperimentPlan, ...], repetitions: int, seed: int, jobs: int) -> list[FirstPassages]:
    """First passages of every plan; the same for any number of jobs."""
    found = []
    for number, plan in enumerate(plans):
        passages = partial(first_passages, plan, bank_forms(plan), failure_forms(plan))
        pieces = in_pieces(passages, repetitions, _BLOCK_REPETITIONS, (seed, number), jobs)
        found.append(FirstPassages(*(np.concatenate(arrays, axis=-1) for arrays in zip(*pieces, strict=True))))
    return found


def detection_times(plan: ExperimentPlan, passages: FirstPassages) -> pl.DataFrame:
    """Expected times of detection by question and rate (Fig. 6 and 7), shares detected and missed at failure."""
    return table_of_rows([_detection_row(plan, cell) for cell in _rate_answers(plan, passages)])


@frozen
class _RateAnswers:
    """One question at one rate: seconds from onset, the span where it never came."""

    labels: Row
    detected_s: Ints
    detected: Bools
    failed_s: Ints
    failed: Bools
    alarmed_before: int


def _rate_answers(plan: ExperimentPlan, passages: FirstPassages) -> Iterator[_RateAnswers]:
    """Every question at every rate, with the times of detection and failure."""
    end_s = plan.span_s - plan.onset_s
    for index, (reading, heading, sensors) in enumerate(plan.questions):
        for rate, rate_mps in enumerate(plan.rates_mps):
            labels: Row = {"constellation": plan.geometry.constellation, "reading": reading, "sensors": sensors}
            detected = passages.detected_s[index, rate].astype(np.int64)
            failed = passages.failed_s[plan.headings_deg.index(heading), rate].astype(np.int64)
            yield _RateAnswers(
                labels | {"heading_deg": heading, "rate_mps": rate_mps},
                np.where(detected == NEVER, end_s, detected),
                detected != NEVER,
                np.where(failed == NEVER, end_s, failed),
                failed != NEVER,
                int(passages.alarmed_before[index].sum()),
            )


def _pmd_rows(plan: ExperimentPlan, cell: _RateAnswers) -> Iterator[Row]:
    """Share of failed runs not yet detected at a time since failure, with exact bounds (Fig. 5)."""
    trials = int(cell.failed.sum())
    if trials == 0:
        return
    failed_s = cell.failed_s[cell.failed]
    lateness = np.where(cell.detected, cell.detected_s - cell.failed_s, np.iinfo(np.int64).max)[cell.failed]
    reach_s = int(np.median(failed_s))
    # Beyond this time after failure some run would be over before it could be detected.
    last_s = plan.span_s - plan.onset_s - int(failed_s.max())
    times = np.unique(np.linspace(-reach_s, min(reach_s, last_s), _PMD_POINTS).round().astype(np.int64))
    for time_s in np.union1d(times, [0]):
        missed = int((lateness > time_s).sum())
        counts = {"time_since_failure_s": float(time_s), "missed": missed, "trials": trials}
        yield cell.labels | counts | share_columns("pmd", missed, trials)


def _detection_row(plan: ExperimentPlan, cell: _RateAnswers) -> Row:
    """Times of detection and shares missed of one question at one rate."""
    end_s = float(plan.span_s - plan.onset_s)
    repetitions = cell.detected.size
    trials = int(cell.failed.sum())
    detected = int(cell.detected.sum())
    since = (cell.detected_s - cell.failed_s)[cell.failed]
    missed = int((~cell.detected[cell.failed] | (since > 0)).sum())
    return {
        **cell.labels,
        "repetitions": repetitions,
        "censored": repetitions - detected,
        **share_columns("detected", detected, repetitions),
        **time_columns("time_to_detect", cell.detected_s.astype(np.float64), 0.0, end_s),
        "failed": trials,
        **time_columns("time_since_failure", since.astype(np.float64), -end_s, end_s),
        **share_columns("pmd_at_failure", missed, trials),
        **share_columns("alarmed_before", cell.alarmed_before, repetitions),
    }


def geometry_table(geometry: Geometry) -> pl.DataFrame:
    """The sky: satellites, directions, and what a metre of range error does to the position."""
    gain = geometry.gain
    return pl.DataFrame(
        {
            "constellation": geometry.constellation,
            "place": PLACE,
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
