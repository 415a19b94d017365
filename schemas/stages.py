"""What passes between the stages of one run: each frame's columns with unit and meaning (docs/architecture.md)."""

from __future__ import annotations

import dataframely as dy
import polars as pl

from schemas.columns import flag, instant, one_of, real, text
from schemas.enums import BaliseKind, Evidence, Judgement, LdsState, PassageStatus, SigmaSource

# Confidence where one track is left of the set of those that the positions do not reject (DOMAIN section 2).
ONE_TRACK_LEFT = 0.99


class Positions(dy.Schema):
    """One row per GNSS epoch of a solution, in order of time: the position on the track network, by matching.

    Positions are those of the balise antenna. What is null says the rest: only a valid fix has a path position, only a
    path position is near or on the track, and only on the track the path has a probability (`placed`).
    """

    t = instant("stamp of the epoch")
    solution = text("solution of the run")
    leg = dy.Int32(nullable=True, min=0, description="leg of the path, on which path positions are one to one")
    netelement_id = text("matched net element", nullable=True)
    measure_m = real("m", "measure on it")
    path_m = real("m", "path position, raw: never smoothed")
    cross_track_m = real("m", "position left of growing path")
    vertical_m = real("m", "position above the track; null without a height in position or survey")
    on_track = flag("a net element of the path is within what the position's errors allow")
    near_track = flag("a net element of the path is within `reach_m`: the monitors can compare the position with it")
    path_probability = real("1", "confidence in the track in hindsight: 0.99 where one is left, 1 alone", min=0, max=1)
    gate_probability = real("1", "the same by what was known then; null off the network", min=0, max=1)
    heading_deg = real("deg", "azimuth of growing path at the GNSS antenna, clockwise from north")
    slope = real("1", "rise over run of growing path")
    curvature_per_m = real("1/m", "curvature of the track, positive to the left")
    interpolation_error_m = real("m", "chord error of the survey's polyline at that place", min=0)
    survey_sigma_m = real("m", "standard deviation of the survey; null where not stated", min=0)
    sigma_along_m = real("m", "standard deviation of the position along the track, as stated", min=0)
    sigma_cross_m = real("m", "standard deviation of the position across the track, as stated", min=0)
    sigma_up_m = real("m", "standard deviation of the height, as stated", min=0)
    sigma_source = one_of(SigmaSource, "receiver, or a table by kind of fix", nullable=True)
    fix_valid = flag("the receiver has a fix and a position")
    velocity_along_mps = real("m/s", "GNSS velocity along growing path")
    hpl_m = real("m", "horizontal protection level of the receiver", min=0)
    digits_along_m = real("m", "deviation by the step in which positions are written down, along", min=0)
    digits_cross_m = real("m", "the same across the track", min=0)
    digits_up_m = real("m", "the same of the height", min=0)

    @dy.rule()
    def placed(cls):  # type: ignore[no-untyped-def]  # noqa: N805
        """What later stages rest on, and do not ask again."""
        has_place = pl.col("path_m").is_not_null()
        near = pl.col("near_track") | ~pl.col("on_track")
        sure = pl.col("gate_probability").is_null() | pl.col("on_track")
        return (~has_place | pl.col("fix_valid")) & (~pl.col("near_track") | has_place) & near & sure


class Aligned(Positions):
    """`Positions` with the odometer at each epoch's time of validity, and what tests along the track allow for.

    Scale and latency are those in use at the epoch: of the vehicle file, or learned from earlier epochs only.
    """

    position_sigma_m = real("m", "deviation that every test along the track counts with: calibrated, digits", min=0)
    calibrated_along_m = real("m", "a + b sigma_along_m, as `calibrate` found: of errors with memory", min=0)
    calibrated_cross_m = real("m", "the same across the track", min=0)
    calibrated_up_m = real("m", "the same of the height", min=0)
    confidence_m = real("m", "half-width of the confidence interval along the track", min=0)
    along_m = real("m", "path position without the way that a curve adds beside the track: for increments")
    odometer_m = real("m", "odometer distance along growing path, scale corrected, 0 at the first epoch")
    travelled_m = real("m", "way driven since the first epoch by the odometer, turns included, scale corrected", min=0)
    odometer_reason = text("why there is no odometer", nullable=True)
    odometer_slips = flag("the odometer says itself that it slips here")
    odometer_doubt_m = real(
        "m",
        "by how much slip, pauses and losses (1e6 m each) may have falsified the distance since the first row: "
        "distances compare where it is the same",
        min=0,
    )
    odometer_white_m2_per_s = real("m2/s", "variance that the odometer's distance gathers in a second", min=0)
    odometer_rows_m = real(
        "m", "quantisation noise of the odometer's rows as shown so far, as far as thresholds allow for it", min=0
    )
    odometer_period_s = real("s", "time between rows of the odometer", min=0)
    stamp_jitter_s = real("s", "deviation of the stamps about the receiver's clock", min=0)
    speed_mps = real("m/s", "speed along growing path by the odometer, by GNSS where there is none")
    direction = dy.Int8(description="direction of travel along growing path, 1 or -1, held in the dead band")
    odometer_scale = real("1", "true over odometer distance", min=0)
    scale_sigma = real("1", "its standard deviation", min=0)
    latency_s = real("s", "by how much the position is older than its stamp")
    latency_sigma_s = real("s", "its standard deviation", min=0)


class Crossings(dy.Schema):
    """One row per crossing of a balise by the raw matched position, or per telegram read, in order of time.

    The LDS finds each crossing once and says what became of it; who needs it later joins by `crossing_id`.
    """

    crossing_id = dy.Int64(min=0, description="0, 1, ... in order of time within the solution")
    balise_id = text("balise")
    kind = one_of(BaliseKind, "virtual: crossed by the position; physical: read")
    netelement_id = text("net element of the balise")
    measure_m = real("m", "measure of the balise", nullable=False)
    leg = dy.Int32(description="leg of the path")
    path_m = real("m", "path position of the balise", nullable=False)
    before = dy.Int64(min=0, description="row of the last epoch before the crossing with a position; of a telegram any")
    epoch = dy.Int64(min=0, description="row of the first epoch at or after the crossing")
    t = instant("the crossing, interpolated; of a telegram its own time; after a gap that of `epoch`")
    sense = dy.Int8(description="+1 passed along growing path, -1 against it")
    direction = dy.Int8(description="direction of travel at the crossing, +1 or -1 along growing path")
    odometer_m = real("m", "odometer distance at the crossing")
    offered = flag("offered to the train; false: inside a gap, or crossed again before the balise was re-armed")
    status = one_of(
        PassageStatus, "what became of it; null where crossed again before the balise was re-armed", nullable=True
    )


class JudgedEpochs(dy.Schema):
    """What the judge adds to the epochs of a solution, row for row (DOMAIN sections 5.2 and 5.3)."""

    epoch = dy.Int64(min=0, description="row among the epochs of the solution")
    at = instant("the instant at which the position is judged: its stamp less the latency of the vehicle file")
    direction = dy.Int8(
        description="direction of travel along growing path, 1 or -1; without an odometer the evidence's"
    )
    judgement = one_of(Judgement, "what the evidence says of the position")
    error_low_m = real("m", "least error in the direction of travel that the evidence leaves")
    error_high_m = real("m", "largest error in the direction of travel that the evidence leaves")
    error_along_m = real("m", "error where reference or reads give it to `known_error_m`")
    evidence = one_of(Evidence, "what the judgement rests on; null where nothing is known", nullable=True)
    wrong_track = flag("judged wrong for its net element, wherever along it")
    track_assumed = flag("right if the survey holds the train's track, which nothing shows")
    train_m = real("m", "path position of the train where reference or reads give it to `known_error_m`")
    reference_m = real("m", "the same where the reference gives it")
    unambiguous = flag("the track of the position was not in doubt by what the train knew then")
    moving = flag("the train moves from here to the next epoch; null where not known", nullable=True)
    stood = flag("the odometer stood while positions left their place by more than the failure limit")
    odometer_wrong = flag("the distance since the last accepted VB is beyond 5 m + 5 % by the evidence")
    undiagnosed = flag("state P3: no verdict of `along_raw`, by the LDS, or `odometer_wrong`")
    in_use = flag("fix valid, unambiguous, confident, not negated, not withheld")
    used_s = real("s", "time in use that the epoch stands for", nullable=False, min=0)
    wrong_s = real("s", "the same where it was wrong", nullable=False, min=0)
    natural_s = real("s", "of it what no injected fault of GNSS explains", nullable=False, min=0)
    counted_s = real("s", "time that the epoch stands for in shares of time", nullable=False, min=0)
    lds_state = one_of(
        LdsState, "state of the reactive LDS; null where it needs a truth that is missing", nullable=True
    )


class JudgedOffers(dy.Schema):
    """One row per crossing of a virtual balise or telegram, judged against where the train was; joined by its id."""

    crossing_id = dy.Int64(min=0, description="as in `Crossings`")
    balise_id = text("balise")
    t = instant("the crossing, interpolated")
    epoch = dy.Int64(min=0, description="row of the first epoch at or after the crossing")
    path_m = real("m", "path position of the balise", nullable=False)
    virtual = flag("a virtual balise; else a telegram")
    accepted = flag("a virtual balise that the LDS accepted")
    offered = flag("a virtual balise offered; false where crossed again before it was re-armed, which only a jump does")
    beyond_window = flag("offered after its window closed")
    location_error_m = real("m", "error where reference or reads give it to `known_error_m`")
    judgement = one_of(Judgement, "what the evidence says of the offer")
    error_low_m = real("m", "least error in the direction of travel that the evidence leaves")
    error_high_m = real("m", "largest error in the direction of travel that the evidence leaves")
    evidence = one_of(Evidence, "what the judgement rests on; null where nothing is known", nullable=True)
    wrong_track = flag("judged wrong for its net element, wherever along it")
    track_assumed = flag("right if the survey holds the train's track, which nothing shows")
    proof_margin_m = real("m", "by how much the evidence may be wrong before what is right is no longer", min=0)


class Failures(dy.Schema):
    """One row per failure: judged wrong in use, over pulses, whether it crosses a VB or not (DOMAIN section 5.3)."""

    t_start = instant("first position that may belong to it")
    t_end = instant("first position that no longer does")
    hazardous_s = real("s", "time judged wrong in use, over the whole failure", nullable=False, min=0)
    natural_s = real("s", "of it what no injected fault of GNSS explains", nullable=False, min=0)
    hazardous_may_s = real("s", "the same with the time that is unknown", nullable=False, min=0)
    accepted = one_of(Judgement, "worst judgement of the virtual balises accepted in it; right where none was")
    within_budget = flag("hazardous time within the budget; null where it cannot be said", nullable=True)
