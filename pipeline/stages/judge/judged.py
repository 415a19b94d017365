"""The two frames that everything else is read from: epochs judged, and offers judged (`schemas.stages`)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import met, unambiguous
from pipeline.stages.evidence import true_places
from pipeline.stages.evidence.carrying import carried_forward
from pipeline.stages.evidence.evidence import KINDS, NOTHING, EvidenceSet, within_spans
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.judgement import Judgements, Positions, judge_positions, with_own_anchors
from pipeline.stages.judge.movement import Counted, Span, counted_of, moving, travel_direction
from pipeline.stages.judge.use import lds_states, odometer_beyond_confidence, time_in_use
from schemas.arrays import Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import HazardConfig
from schemas.enums import BaliseKind, Evidence, PassageStatus

_REFERENCE = KINDS.index(Evidence.REFERENCE)


def odometer_of(case: Case) -> Counted:
    """What the odometer says from epoch to epoch."""
    path_m = floats(case.solution.epochs, "path_m")
    return counted_of(case.odometry, case.instants_of_epochs(), path_m, case.config.hazards.failure_limit_m)


def epochs_judged(case: Case, counted: Counted) -> pl.DataFrame:
    """The epochs of the solution with the columns of `JudgedEpochs`: evidence, direction, judgement, movement, use."""
    epochs, config, at_ns = case.solution.epochs, case.config, case.instants_of_epochs()
    path_m = floats(epochs, "path_m")
    positions = _positions(case)
    evidence = case.evidence.at(at_ns, counted.stood)
    along = _judge(case, positions, at_ns, evidence, counted.stood)
    given = ints(epochs["direction"], 1)
    direction = travel_direction(given, along, at_ns, path_m, case.odometry is not None, config.hazards)
    train_m = path_m - along.known_m(config.hazards.known_error_m)
    by_reference_m = np.where(along.kind == _REFERENCE, train_m, np.nan)
    moved, sure = moving(at_ns, by_reference_m, along.half_m, counted, config)
    counted_wrong = _odometer_wrong(case, train_m, along.half_m)
    undiagnosed = flags(epochs, "diagnosis_faulty") | counted_wrong
    use = time_in_use(epochs, along.code, config)
    judged = along.turned(direction)
    return epochs.drop("direction").with_columns(
        pl.Series("epoch", np.arange(epochs.height)),
        pl.Series("at", at_ns).cast(pl.Datetime("ns", "UTC")),
        pl.Series("direction", direction, dtype=pl.Int8),
        *judged.columns(),
        *true_places(evidence, case.evidence.network.track),
        pl.Series("error_along_m", judged.known_m(config.hazards.known_error_m), nan_to_null=True),
        *use,
        lds_states(epochs, along.code, flags(use, "in_use"), undiagnosed),
        pl.Series("train_m", train_m, nan_to_null=True),
        pl.Series("reference_m", by_reference_m, nan_to_null=True),
        pl.Series("unambiguous", positions.unambiguous),
        pl.Series("stood", within_spans(at_ns, counted.stood)),
        pl.Series("odometer_wrong", counted_wrong),
        pl.Series("undiagnosed", undiagnosed),
        moving=pl.when(pl.Series(sure)).then(pl.Series(moved)),
    )


def _positions(case: Case) -> Positions:
    epochs, path_m = case.solution.epochs, floats(case.solution.epochs, "path_m")
    return Positions(
        element=np.where(np.isfinite(path_m), case.element_numbers(epochs["netelement_id"]), -1),
        measure_m=floats(epochs, "measure_m"),
        leg=ints(epochs["leg"]),
        path_m=path_m,
        unambiguous=met(epochs, unambiguous(case.config)),
    )


def direction_by_evidence(case: Case) -> pl.Series:
    """Direction of travel of a run without an odometer, before anything is judged: `epochs` as they are aligned."""
    at_ns, positions = case.instants_of_epochs(), _positions(case)
    along = judge_positions(positions, case.evidence.at(at_ns), case.legs(), case.config.hazards)
    given = ints(case.solution.epochs["direction"], 1)
    found = travel_direction(given, along, at_ns, positions.path_m, has_odometer=False, config=case.config.hazards)
    return pl.Series("direction", found, dtype=pl.Int8)


def offers_judged(case: Case, epochs: pl.DataFrame, stood: list[Span]) -> pl.DataFrame:
    """Crossings of virtual balises and telegrams, judged against where the train was: frame as `JudgedOffers`.

    The place judged is that of the balise; of a virtual one at the instant at which a position of that stamp was true.
    """
    offered = _offered(case)
    t_ns = times_ns(offered)
    before = ints(offered["before"])
    unambiguous_both = pl.Series(flags(epochs, "unambiguous"))
    positions = Positions(
        element=case.element_numbers(offered["netelement_id"]),
        measure_m=floats(offered, "measure_m"),
        leg=ints(offered["leg"]),
        path_m=floats(offered, "path_m"),
        unambiguous=(unambiguous_both.gather(before) & unambiguous_both.gather(offered["epoch"])).to_numpy(),
    )
    at_ns = np.where(flags(offered, "virtual"), case.instants(t_ns), t_ns)
    along = _judge(case, positions, at_ns, case.evidence.at(at_ns, stood), stood)
    late = case.solution.passages.filter(pl.col("odometer_distance_m") > pl.col("window_close_m"))["crossing_id"]
    judged = along.turned(ints(epochs["direction"].gather(before)))
    known_m = pl.Series("location_error_m", judged.known_m(case.config.hazards.known_error_m), nan_to_null=True)
    return offered.select(
        *("crossing_id", "balise_id", "t", "epoch", "path_m", "virtual", "accepted"),
        offered=pl.col("virtual") & pl.col("offered"),
        beyond_window=pl.col("crossing_id").is_in(late.drop_nulls().implode()),
    ).with_columns(known_m, *judged.columns(), proof_margin(judged, case.config.hazards))


def proof_margin(judged: Judgements, config: HazardConfig) -> pl.Series:
    """By how many metres all that the evidence says may be wrong before what is right is no longer (DOMAIN 5.2)."""
    margin_m = np.where(judged.is_right, config.failure_limit_m - judged.largest_m, np.nan)
    return pl.Series("proof_margin_m", margin_m, nan_to_null=True)


def _judge(case: Case, positions: Positions, at_ns: Ints, evidence: EvidenceSet, stood: list[Span]) -> Judgements:
    """Errors along growing path; where nothing else speaks, against the odometer since the last accepted VB."""
    config = case.config.hazards
    found = judge_positions(positions, evidence, case.legs(), config)
    if case.odometry is None or not ((found.kind == NOTHING) & positions.known).any():
        return found
    accepted = _accepted(case)
    since_ns = case.instants(times_ns(accepted))
    carried = carried_forward(since_ns, floats(accepted, "path_m"), at_ns, case.odometry, stood, case.config)
    return with_own_anchors(found, positions, carried, config)


def _offered(case: Case) -> pl.DataFrame:
    """Crossings and telegrams of the LDS, those of a balise not re-armed yet (not `offered`) among them."""
    status, kind = (pl.col(name).cast(pl.String) for name in ("status", "kind"))
    virtual = kind == BaliseKind.VIRTUAL.value
    accepted = (virtual & (status == PassageStatus.ACCEPTED.value)).fill_null(value=False)
    crossings = case.solution.crossings.filter(pl.col("offered") | pl.col("status").is_null())
    return crossings.with_columns(virtual=virtual, accepted=accepted)


def _accepted(case: Case) -> pl.DataFrame:
    """The virtual balises that the LDS accepted, in order of time."""
    return _offered(case).filter("accepted").sort("t")


def _odometer_wrong(case: Case, train_m: Floats, half_m: Floats) -> Bools:
    """Epochs at which the distance since the last accepted VB is beyond 5 m + 5 % by the evidence."""
    epochs = case.solution.epochs
    half_m = np.where(np.isfinite(train_m), half_m, np.nan)
    counted_m, accepted_ns = floats(epochs, "odometer_m"), times_ns(_accepted(case))
    return odometer_beyond_confidence(times_ns(epochs), counted_m, train_m, half_m, accepted_ns, case.config.lds)
