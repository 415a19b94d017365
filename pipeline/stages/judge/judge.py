"""The judge: one solution of a run against the evidence, in the order in which an assessor asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import crossing_gap_ns
from pipeline.stages.epochs.failure_log import failure_log
from pipeline.stages.evidence.evidence import KINDS, NOTHING, within_spans
from pipeline.stages.judge.across import errors_across
from pipeline.stages.judge.alarms import alarms_table
from pipeline.stages.judge.case import Case, between_far_epochs
from pipeline.stages.judge.episodes import find_episodes
from pipeline.stages.judge.failures import course_of, failures_table, find_failures, positions_of
from pipeline.stages.judge.hazards import Offers, hazard_rows, hazards_table
from pipeline.stages.judge.judged import epochs_judged, odometer_of, offers_judged
from pipeline.stages.judge.judgement import Judgements
from pipeline.stages.judge.jumps import jumps_of
from pipeline.stages.judge.movement import Span
from pipeline.stages.judge.passages import passages_table
from pipeline.stages.judge.true_crossings import TrueCrossing, true_crossings
from pipeline.stages.track.path import Place
from schemas.arrays import flags, floats, times_ns
from schemas.enums import Evidence


@dataclass(frozen=True)
class Judged:
    """What the judge says of one solution: tables by the contract, and the frames that they were read from.

    `epochs`, `offers`, `failures`: as in `schemas.stages`; `distance_m`: way driven; `evidence`: what most epochs rest
    on.
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
    counted = odometer_of(case)
    epochs = epochs_judged(case, counted)
    epochs = epochs.with_columns(_across(case, epochs))
    offers = offers_judged(case, epochs, counted.stood)
    positions = positions_of(epochs)
    gap_ns = crossing_gap_ns(times_ns(positions), config.lds)
    course = course_of(positions, jumps_of(positions, case.odometry, gap_ns, config.hazards), config.hazards)
    failures = find_failures(course, offers, config)
    log = failure_log(case.solution.epochs, config.lds.recovery_s)
    episodes = find_episodes(course, offers, failures, log, case.faults, config.hazards)
    hit = Offers.of(offers, course.positions)
    rows = hazard_rows(episodes, course, hit, config.hazards)
    spans = [episode.undetected_ns for episode in episodes]
    crossings = _true_crossings(case, counted.stood)
    return Judged(
        hazards=hazards_table(rows, case, epochs, course, hit),
        alarms=alarms_table(case.solution.name, epochs, log, rows, config),
        passages=passages_table(case, epochs, offers, rows, crossings, spans),
        failures=failures_table(failures, course),
        epochs=epochs.with_columns(_suspect_after(epochs, spans)),
        offers=offers,
        distance_m=_distance_m(case, epochs),
        evidence=_evidence(epochs),
    )


def _across(case: Case, epochs: pl.DataFrame) -> list[pl.Series]:
    """Errors across the track and of height, by the reference."""
    hazards, heading_deg = case.config.hazards, floats(epochs, "heading_deg")
    limits = hazards.reference_gap_s, hazards.failure_limit_m
    errors_m = errors_across(case.solution.fixes, heading_deg, times_ns(epochs, "at"), case.reference, *limits)
    names = ("error_cross_m", "error_up_m")
    return [pl.Series(name, values, nan_to_null=True) for name, values in zip(names, errors_m, strict=True)]


def _true_crossings(case: Case, stood: list[Span]) -> dict[str, list[TrueCrossing]]:
    """When the train passed each balise of the path, in a direction in which it is valid."""
    config, balises = case.config, case.solution.balises.unique("balise_id", keep="first")
    elements = case.element_numbers(balises["netelement_id"]).tolist()
    spots = zip(balises["balise_id"], elements, balises["measure_m"], strict=True)
    places = {name: Place(element, measure_m) for name, element, measure_m in spots}
    at_ns = between_far_epochs(case.instants_of_epochs(), config.align.speed_window_s)
    evidence = case.evidence.at(at_ns, stood)
    found = true_crossings(at_ns, evidence, places, config.hazards.known_error_m, config.lds.rearm_m)
    # Along the measure, as the crossings are; 0 is both ways.
    valid = dict(balises.select("balise_id", pl.col("valid_direction") * pl.col("sense")).rows())
    return {name: [one for one in several if valid[name] in (0, one.sense)] for name, several in found.items()}


def _suspect_after(epochs: pl.DataFrame, spans: Sequence[Span]) -> pl.Series:
    """TVBs between a fault's onset and its detection."""
    after = within_spans(times_ns(epochs), spans) & flags(epochs, "tvb")
    return pl.Series("suspect_after_the_fact", after)


def _distance_m(case: Case, epochs: pl.DataFrame) -> float | None:
    """Way driven: by the odometer, else by the reference, else by the positions; None where none of them shows it."""
    if case.odometry is not None:
        begin_m, end_m = case.odometry.travelled_at(times_ns(epochs, "at")[[0, -1]]).tolist()
        return float(end_m - begin_m) * (case.odometry.scale or 1.0)
    train = epochs["train_m"].drop_nulls()
    place = train if train.len() > 1 else epochs["path_m"].drop_nulls()
    return float(place.diff().abs().sum()) if place.len() > 1 else None


def _evidence(epochs: pl.DataFrame) -> Evidence | None:
    """What most epochs rest on."""
    kinds = Judgements.of(epochs).kind
    kinds = kinds[kinds != NOTHING]
    return KINDS[int(np.bincount(kinds).argmax())] if kinds.size else None
