"""Everything that is judged of each epoch, and of each offer, as columns of one frame each (`schemas.stages`)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import met, unambiguous
from pipeline.stages.evidence import true_places
from pipeline.stages.evidence.evidence import within_spans
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.cross_errors import cross_errors
from pipeline.stages.judge.in_use import lds_states, time_in_use
from pipeline.stages.judge.injected import under_injection
from pipeline.stages.judge.judgement import REFERENCE, Judgements, MatchedPositions, judge_positions, judgements_of
from pipeline.stages.judge.travel import OdometerSteps, beyond_confidence, moving, travel_direction
from schemas.arrays import Ints, flags, floats, ints, times_ns


def judged_epochs(case: Case, steps: OdometerSteps) -> pl.DataFrame:
    """The epochs of the solution with evidence, judgement, direction, movement, time in use and state of the LDS."""
    epochs = case.solution.epochs
    config = case.config
    at_ns = case.instants_of_epochs()
    positions = MatchedPositions.of(case, epochs, met(epochs, unambiguous()))
    evidence = case.evidence_at(at_ns)
    along = judgements_of(case, positions, at_ns, evidence)
    direction = _direction(case, positions, at_ns, along)
    judged = along.turned(direction)
    train_m = positions.path_m - along.known_m(config.hazards.known_error_m)
    reference_m = np.where(along.kind == REFERENCE, train_m, np.nan)
    stood = within_spans(at_ns, case.evidence.stood)
    accepted_ns = times_ns(case.solution.accepted)
    odometer_m = floats(epochs, "odometer_m")
    wrong_count = beyond_confidence(times_ns(epochs), odometer_m, train_m, along.half_m, accepted_ns, config.lds)
    undiagnosed = flags(epochs, "diagnosis_faulty") | wrong_count
    use = time_in_use(epochs, along.code, config)
    injected = under_injection(times_ns(epochs), case.faults, config.lds.recovery_s)
    return epochs.drop("direction").with_columns(
        pl.Series("epoch", np.arange(epochs.height)),
        pl.Series("at", at_ns).cast(pl.Datetime("ns", "UTC")),
        pl.Series("direction", direction, dtype=pl.Int8),
        *judged.columns(),
        *true_places(evidence, case.evidence.network.track),
        pl.Series("error_along_m", judged.known_m(config.hazards.known_error_m), nan_to_null=True),
        *cross_errors(case, floats(epochs, "heading_deg")),
        *use,
        (use["wrong_s"] * ~pl.Series(injected)).alias("natural_s"),
        lds_states(epochs, along.code, flags(use, "in_use"), undiagnosed),
        pl.Series("train_m", train_m, nan_to_null=True),
        pl.Series("reference_m", reference_m, nan_to_null=True),
        pl.Series("unambiguous", positions.unambiguous),
        pl.Series("stood", stood),
        pl.Series("odometer_wrong", wrong_count),
        pl.Series("undiagnosed", undiagnosed),
        moving(at_ns, reference_m, along.half_m, steps, stood, config),
    )


def _direction(case: Case, positions: MatchedPositions, at_ns: Ints, along: Judgements) -> Ints:
    as_driven = ints(case.solution.epochs["direction"], 1)
    hazards = case.config.hazards
    return travel_direction(as_driven, along, at_ns, positions.path_m, case.odometry is not None, hazards)


def direction_by_evidence(case: Case) -> Ints:
    """Direction of travel of a run without an odometer, before anything is judged: `epochs` as they are aligned."""
    at_ns = case.instants_of_epochs()
    positions = MatchedPositions.of(case, case.solution.epochs, met(case.solution.epochs, unambiguous()))
    along = judge_positions(positions, case.evidence_at(at_ns), case.legs(), case.config.hazards)
    return _direction(case, positions, at_ns, along)


def judged_offers(case: Case, epochs: pl.DataFrame) -> pl.DataFrame:
    """The offers of the LDS, every telegram among them, as `schemas.stages.JudgedOffers`; `epochs`: judged.

    Judged is the place of the balise: at the time of the telegram, or of the crossing less the GNSS latency.
    """
    offers = case.solution.offers
    hazards = case.config.hazards
    t_ns = times_ns(offers)
    before = ints(offers["before"])
    sure = flags(epochs, "unambiguous")
    positions = MatchedPositions.of(case, offers, sure[before] & sure[ints(offers["epoch"])])
    at_ns = np.where(flags(offers, "virtual"), case.instants(t_ns), t_ns)
    along = judgements_of(case, positions, at_ns, case.evidence_at(at_ns))
    judged = along.turned(ints(epochs["direction"])[before])
    margin_m = np.where(judged.is_right, hazards.limits.failure_m - judged.largest_m, np.nan)
    late = case.solution.passages.filter(pl.col("odometer_distance_m") > pl.col("window_close_m"))["crossing_id"]
    return offers.select(
        *("crossing_id", "balise_id", "t", "epoch", "path_m", "virtual", "accepted"),
        offered=pl.col("virtual") & pl.col("offered"),
        beyond_window=pl.col("crossing_id").is_in(late.drop_nulls().implode()),
    ).with_columns(
        *judged.columns(),
        pl.Series("location_error_m", judged.known_m(hazards.known_error_m), nan_to_null=True),
        pl.Series("proof_margin_m", margin_m, nan_to_null=True),
    )
