"""The judge: one solution of a run against the evidence, in the order in which an assessor asks."""

from __future__ import annotations

from dataclasses import replace

import polars as pl

from pipeline.stages.epochs.clock import crossing_gaps_ns
from pipeline.stages.epochs.failure_log import failure_log
from pipeline.stages.evidence.evidence import within_spans
from pipeline.stages.judge.alarms import alarms_table
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.episodes import find_episodes
from pipeline.stages.judge.epochs import judged_epochs, judged_offers
from pipeline.stages.judge.failures import course_of, failures_table, find_failures, positions_of
from pipeline.stages.judge.hazards import hazard_rows, hazards_table
from pipeline.stages.judge.jumps import jumps_of
from pipeline.stages.judge.passages import passages_table
from pipeline.stages.judge.travel import odometer_steps
from schemas.arrays import flags, times_ns
from schemas.enums import Evidence
from schemas.frozen import frozen


@frozen
class Judged:
    """Tables by the contract, and the frames that they were read from (`schemas.stages`).

    `distance_m`: way driven; `evidence`: what most epochs rest on.
    """

    hazards: pl.DataFrame
    alarms: pl.DataFrame
    passages: pl.DataFrame
    failures: pl.DataFrame
    epochs: pl.DataFrame
    offers: pl.DataFrame
    distance_m: float | None
    evidence: Evidence | None


def judge(case: Case) -> Judged:
    """Judge one solution: epochs, offers, jumps, failures, episodes, then the rows."""
    config = case.config
    steps = odometer_steps(case)
    case = replace(case, evidence=replace(case.evidence, stood=steps.stood))
    epochs = judged_epochs(case, steps)
    offers = judged_offers(case, epochs)
    positions = positions_of(epochs)
    gap_ns = crossing_gaps_ns(times_ns(positions), config.lds)
    course = course_of(positions, offers, jumps_of(positions, case.odometry, gap_ns, config.hazards), config)
    failures = find_failures(course)
    log = failure_log(case.solution.epochs, config.lds.recovery_s)
    episodes = find_episodes(course, failures, log, case.faults)
    rows = hazard_rows(episodes, course)
    # From a fault's onset to its detection.
    undetected = [episode.undetected_ns for episode in episodes]
    suspect_after = within_spans(times_ns(epochs), undetected) & flags(epochs, "tvb")
    return Judged(
        hazards=hazards_table(rows, case, epochs, course),
        alarms=alarms_table(case.solution.name, epochs, log, [row.episode for row in rows], config),
        passages=passages_table(case, epochs, offers, rows, undetected),
        failures=failures_table(failures, course),
        epochs=epochs.with_columns(pl.Series("suspect_after_the_fact", suspect_after)),
        offers=offers,
        distance_m=_distance_m(case, epochs),
        evidence=_evidence(epochs["evidence"]),
    )


def _distance_m(case: Case, epochs: pl.DataFrame) -> float | None:
    """Way driven: by the odometer, else by the reference, else by the positions; None where none of them shows it."""
    if case.odometry is not None:
        begin_m, end_m = case.odometry.travelled_at(times_ns(epochs, "at")[[0, -1]]).tolist()
        return float(end_m - begin_m) * (case.odometry.scale or 1.0)
    train = epochs["train_m"].drop_nulls()
    place = train if train.len() > 1 else epochs["path_m"].drop_nulls()
    return float(place.diff().abs().sum()) if place.len() > 1 else None


def _evidence(kinds: pl.Series) -> Evidence | None:
    """What most epochs rest on; of equally many the first in the order of the enum."""
    counts = {kind: (kinds == kind.value).sum() for kind in Evidence}
    most = max(counts, key=lambda kind: counts[kind])
    return most if counts[most] else None
