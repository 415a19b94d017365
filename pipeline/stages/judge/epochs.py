"""Everything that is judged of each epoch, as columns of one frame (`schemas.stages.JudgedEpochs`)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import met, unambiguous
from pipeline.stages.evidence import true_places
from pipeline.stages.evidence.evidence import within_spans
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.cross_errors import cross_errors
from pipeline.stages.judge.in_use import lds_states, time_in_use
from pipeline.stages.judge.judgement import REFERENCE, Judgements, MatchedPositions, judge_positions, judgements_of
from pipeline.stages.judge.travel import OdometerSteps, moving, odometer_wrong, travel_direction
from schemas.arrays import Ints, flags, floats, ints


def judged_epochs(case: Case, steps: OdometerSteps) -> pl.DataFrame:
    """The epochs of the solution with evidence, judgement, direction, movement, time in use and state of the LDS."""
    epochs = case.solution.epochs
    config = case.config
    at_ns = case.instants_of_epochs()
    positions = MatchedPositions.of(case, epochs, met(epochs, unambiguous(config)))
    evidence = case.evidence.at(at_ns)
    along = judgements_of(case, positions, at_ns, evidence)
    direction = _direction(case, positions, at_ns, along)
    judged = along.turned(direction.to_numpy())
    train_m = positions.path_m - along.known_m(config.hazards.known_error_m)
    reference_m = np.where(along.kind == REFERENCE, train_m, np.nan)
    stood = within_spans(at_ns, case.evidence.stood)
    wrong_count = odometer_wrong(case, train_m, along.half_m)
    undiagnosed = flags(epochs, "diagnosis_faulty") | wrong_count
    use = time_in_use(epochs, along.code, config)
    return epochs.drop("direction").with_columns(
        pl.Series("epoch", np.arange(epochs.height)),
        pl.Series("at", at_ns).cast(pl.Datetime("ns", "UTC")),
        direction,
        *judged.columns(),
        *true_places(evidence, case.evidence.network.track),
        pl.Series("error_along_m", judged.known_m(config.hazards.known_error_m), nan_to_null=True),
        *cross_errors(case, floats(epochs, "heading_deg")),
        *use,
        lds_states(epochs, along.code, flags(use, "in_use"), undiagnosed),
        pl.Series("train_m", train_m, nan_to_null=True),
        pl.Series("reference_m", reference_m, nan_to_null=True),
        pl.Series("unambiguous", positions.unambiguous),
        pl.Series("stood", stood),
        pl.Series("odometer_wrong", wrong_count),
        pl.Series("undiagnosed", undiagnosed),
        moving(at_ns, reference_m, along.half_m, steps, stood, config),
    )


def _direction(case: Case, positions: MatchedPositions, at_ns: Ints, along: Judgements) -> pl.Series:
    as_driven = ints(case.solution.epochs["direction"], 1)
    hazards = case.config.hazards
    direction = travel_direction(as_driven, along, at_ns, positions.path_m, case.odometry is not None, hazards)
    return pl.Series("direction", direction, dtype=pl.Int8)


def direction_by_evidence(case: Case) -> pl.Series:
    """Direction of travel of a run without an odometer, before anything is judged: `epochs` as they are aligned."""
    at_ns = case.instants_of_epochs()
    positions = MatchedPositions.of(case, case.solution.epochs, met(case.solution.epochs, unambiguous(case.config)))
    along = judge_positions(positions, case.evidence.at(at_ns), case.legs(), case.config.hazards)
    return _direction(case, positions, at_ns, along)
