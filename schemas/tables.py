"""Contracts of the output tables (CONTRACT section 3), one class body each."""

from __future__ import annotations

from typing import Any

import dataframely as dy

from schemas.columns import count, counts, flag, instant, one_of, ones_of, real, reals, text, texts
from schemas.enums import (
    BaliseKind,
    Cause,
    Direction,
    Evidence,
    FailureMode,
    Hazard,
    Judgement,
    LdsMode,
    LdsState,
    LinkingError,
    LostTo,
    MisfitCause,
    MonitorState,
    Origin,
    PassageStatus,
    Reaction,
    Reason,
    Remedy,
    RunStatus,
    RunVerdict,
    SigmaSource,
    Suspect,
    ThrVerdict,
    Timing,
    VehicleFigures,
    Verdict,
)
from schemas.monitors import ALL_MONITORS, Monitor

CONTRACT_VERSION = "2.0"


class Hazards(dy.Schema):
    """One row per hazard episode and class (DIAG, section Hazards; DOMAIN section 5)."""

    solution = text("solution of the run")
    hazard_id = count("0, 1, ... in time order within the solution")
    hazard = one_of(Hazard, "hazard class")
    failure_mode = one_of(FailureMode, "ETCS failure mode")
    timing = one_of(Timing, "a VB offered early or late")
    evidence = one_of(Evidence, "evidence of the judgement")
    suspect = one_of(Suspect, "an opinion on what was at fault; nothing depends on it")
    caused_by = dy.Int64(nullable=True, min=0, description="hazard_id of the row whose end caused this one")
    t_onset = instant("begin of the fault", nullable=True)
    t_hazard = instant("the step, or the offered crossing of the first VB hit")
    t_failure = instant("begin of the position failure", nullable=True)
    t_failure_may = instant("since when it may have been one; null where there is no evidence then", nullable=True)
    t_detected = instant("first failing monitor from onset to the end of the episode", nullable=True)
    t_negated = instant("position blocked: detection plus reaction", nullable=True)
    t_end = instant("end of the episode", nullable=True)
    monitor = text("monitor that failed first", nullable=True)
    detected = flag("a monitor failed within the episode")
    alarm_before_onset = flag("an alarm was active at the onset, or is the onset of a drift: T_D 0 is no measurement")
    time_to_detect_s = real("s", "T_D = t_detected - t_onset")
    time_since_failure_s = real("s", "T_dsf, least = t_detected - t_failure; negative = in time")
    time_since_failure_may_s = real("s", "T_dsf, largest = t_detected - t_failure_may: a bound, not a measurement")
    hazardous_s = real("s", "time judged wrong in use, over the whole failure that the row belongs to", min=0)
    hazardous_may_s = real("s", "the same with the time that is unknown", min=0)
    size_m = real("m", "largest error along the track, signed, + = ahead of the train; of a jump back what it ended")
    rate_mps = real("m/s", "slope of the error from onset to failure; null for a step")
    balise_ids = texts("VBs hit, in order")
    accepted_ids = texts("of these the VBs that the LDS accepted despite the fault")
    netelement_id = text("net element of the train at t_hazard", nullable=True)
    measure_m = real("m", "measure of the train at t_hazard")
    path_m = real("m", "path position of the train at t_hazard")
    speed_mps = real("m/s", "speed of the train at t_hazard")
    budget_s = real("s", "allowed T_D of the configured service level (TVB eq. 7)")
    within_budget = flag("hazardous time within the time allowed (in time); null where unknown", nullable=True)


class Passages(dy.Schema):
    """One row per balise and passage on the path, and per offer beyond it."""

    solution = text("solution of the run")
    balise_id = text("balise")
    kind = one_of(BaliseKind, "virtual or physical")
    netelement_id = text("net element of the balise")
    measure_m = real("m", "measure of the balise")
    path_m = real("m", "path position of the balise")
    direction = one_of(Direction, "direction of travel on the path", nullable=True)
    status = one_of(PassageStatus, "result in the LDS")
    t_offered = instant("the raw matched position crosses the balise, interpolated", nullable=True)
    t_true = instant("the train passes the balise by the evidence: middle of the interval it leaves", nullable=True)
    location_error_m = real("m", "position error at the offer where known to 5 m; + = offered early")
    window_open_m = real("m", "expectation window opens, odometer distance from the LRVB")
    window_close_m = real("m", "expectation window closes, odometer distance from the LRVB")
    odometer_distance_m = real("m", "odometer distance from the LRVB at the offer")
    confidence_m = real("m", "half-width of the confidence interval at the offer")
    linking_error = one_of(LinkingError, "linking error (SUBSET-026 3.16.2.3.1)")
    reaction = one_of(Reaction, "reaction of the train")
    failure_mode = one_of(FailureMode, "ETCS failure mode")
    cause = one_of(Cause, "wrong position or no position")
    suspect_after_the_fact = flag("accepted between a fault's onset and its detection")
    initialising = flag("accepted before any VB or TVB was validated: the most demanding case (TVB section 5)")
    hazard_id = dy.Int64(nullable=True, min=0, description="hazard that this passage belongs to")
    judgement = one_of(Judgement, "what the evidence says of the offer; null where not offered", nullable=True)
    error_low_m = real("m", "least error of the offer that the evidence leaves, in the direction of travel")
    error_high_m = real("m", "largest error of the offer that the evidence leaves")
    evidence = one_of(Evidence, "what the judgement of the offer rests on", nullable=True)
    proof_margin_m = real("m", "by how much the evidence may be wrong before a right offer is no longer", min=0)
    location_accuracy_m = real("m", "location accuracy of the balise (Q_LOCACC)", min=0)
    speed_mps = real("m/s", "speed of the train at the offer, else where it passes the balise", min=0)
    crossing_id = dy.Int64(nullable=True, min=0, description="crossing of the offer; null where not offered")
    undetected_ahead_m = real(
        "m", "largest fault ahead of the train that no monitor would have noticed; not proved on curves", min=0
    )
    undetected_behind_m = real("m", "the same behind it; null as all of these where not computed", min=0)
    undetected_ahead_in_use_m = real(
        "m",
        "largest fault ahead still in use that began after the last fix, alarms or not; null where nothing bounds it",
        min=0,
    )
    undetected_behind_in_use_m = real("m", "the same behind it", min=0)
    undetected_range_ahead_m = real("m", "largest of these by one range at fault, the pseudorange monitor heard", min=0)
    undetected_range_behind_m = real("m", "the same behind it", min=0)
    undetected_since = instant("such a fault began after here: the last independent fix", nullable=True)
    undetected_monitors = texts("monitors that hold it so small, first what holds most", nullable=True)
    physical_before_m = real("m", "a physical balise at most so far before keeps it within the failure limit", min=0)


class Alarms(dy.Schema):
    """One row per alarm episode: fails of any monitor less than the recovery time apart."""

    solution = text("solution of the run")
    alarm_id = count("0, 1, ... in time order within the solution")
    t_start = instant("first fail")
    t_end = instant("last fail")
    monitors = texts("monitors in order of failing")
    peak_ratio = real("1", "largest |value| / threshold", min=0, tolerance=1e-6)
    verdict = one_of(Verdict, "true: a fault was there; unknown without truth")
    suspect = one_of(Suspect, "an opinion on what was at fault; nothing depends on it")
    hazard_id = dy.Int64(nullable=True, min=0, description="hazard that it belongs to")
    netelement_id = text("net element of the position at the first fail", nullable=True)
    measure_m = real("m", "measure of the position at the first fail")


class _EpochsBeforeMonitors(dy.Schema):
    """One row per GNSS epoch and solution."""

    t = instant("time of validity")
    solution = text("solution of the run")
    netelement_id = text("matched net element", nullable=True)
    measure_m = real("m", "measure on it")
    path_m = real("m", "path position of the balise antenna by GNSS")
    cross_track_m = real("m", "position left of growing path")
    vertical_m = real("m", "position above the track")
    on_track = flag("a net element of the path is within reach")
    path_probability = real("1", "confidence in the track by the whole run; null off the network", min=0, max=1)
    odometer_m = real("m", "odometer distance along growing path, scale corrected, 0 at the first epoch")
    speed_mps = real("m/s", "speed along growing path by the odometer, by GNSS where there is none or it is frozen")
    sigma_along_m = real("m", "standard deviation of the position along the track", min=0)
    sigma_cross_m = real("m", "standard deviation of the position across the track", min=0)
    sigma_up_m = real("m", "standard deviation of the height", min=0)
    sigma_source = one_of(SigmaSource, "where the standard deviations come from", nullable=True)
    confidence_m = real("m", "half-width of the confidence interval along the track", min=0)
    error_along_m = real("m", "position minus evidence in the direction of travel, where known to 5 m")
    error_low_m = real("m", "least error along the track that the evidence leaves")
    error_high_m = real("m", "largest error along the track that the evidence leaves")
    judgement = one_of(Judgement, "what the evidence says of the position")
    evidence = one_of(Evidence, "evidence of the judgement; null where there is none", nullable=True)
    true_netelement_ids = texts("net elements on which the train may have been, by the evidence", nullable=True)
    true_measure_low_m = real("m", "least measure of the train; null unless it was on one net element for sure")
    true_measure_high_m = real("m", "largest measure of the train; null unless it was on one net element for sure")


class _EpochsAfterMonitors(dy.Schema):
    alarm = flag("a monitor fails")
    lds_mode = one_of(LdsMode, "mode of the location determination system")
    lds_state = one_of(
        LdsState, "state of the reactive LDS; null where it needs a truth that is missing", nullable=True
    )
    withheld_for = one_of(
        LostTo, "noise, slip or relink: why the position is withheld though no monitor fails", nullable=True
    )
    tvb = flag("the epoch is a valid travelling virtual balise")
    lrvb_id = text("last relevant virtual balise", nullable=True)
    distance_from_lrvb_m = real("m", "odometer distance since the LRVB")
    doubt_over_m = real("m", "over-reading amount of the reported position", min=0)
    doubt_under_m = real("m", "under-reading amount of the reported position", min=0)
    exposure_s = real("s", "time since the last linked TVB or accepted VB", min=0)
    error_cross_m = real(
        "m", "position across the track minus truth, left positive; null beyond the failure limit along"
    )
    error_up_m = real("m", "height minus truth; null beyond the failure limit along")
    direction = dy.Int8(
        nullable=True,
        description="direction of travel along growing path: 1 or -1; without an odometer that of the evidence",
        metadata={"unit": "1"},
    )
    gate_probability = real("1", "the same by what was known then, which detection uses", min=0, max=1)
    odometer_scale = real("1", "scale in use at this epoch (true over odometer distance)")
    latency_s = real("s", "GNSS latency in use at this epoch")
    hpl_m = real("m", "horizontal protection level of the receiver", min=0)
    satellites = dy.Int64(nullable=True, min=0, description="satellites used, as recorded", metadata={"unit": "1"})
    suspect_after_the_fact = flag("a TVB between a fault's onset and its detection")
    moving = flag("the train moves from here to the next epoch; null where not known", nullable=True)
    step_s = real("s", "time to the next epoch, 0 at the last", min=0)
    gap = flag("an epoch is missing before the next one: nothing is known to hold until then")
    moving_s = real("s", "`step_s` where the train moves or may move, gaps included; else 0", min=0)
    lost_s = real("s", "of this without a valid TVB; 1 - sum(lost_s) / sum(moving_s) is the availability", min=0)
    lost_to = one_of(
        LostTo, "what `lost_s` was lost to; null where nothing was, or none of these explains it", nullable=True
    )
    in_use = flag("fix valid, unambiguous, confident, not negated, not withheld (DOMAIN section 5.2)")
    undetected_ahead_m = real(
        "m", "largest fault ahead of the train that no monitor would have noticed; not proved on curves", min=0
    )
    undetected_behind_m = real("m", "the same behind it; both null where not computed", min=0)
    undetected_ahead_in_use_m = real(
        "m",
        "largest fault ahead still in use that began after the last fix, alarms or not; null where nothing bounds it",
        min=0,
    )
    undetected_behind_in_use_m = real("m", "the same behind it", min=0)


def _monitor_columns(monitor: Monitor) -> dict[str, dy.Column]:
    """Columns of one monitor."""
    name, unit = monitor.name, monitor.unit
    return {
        f"{name}_value": real(unit, f"statistic of the monitor `{name}`"),
        f"{name}_threshold": real(unit, f"threshold of the monitor `{name}`", min=0),
        f"{name}_state": one_of(MonitorState, f"state of the monitor `{name}`"),
        f"{name}_reason": text("why it was not evaluated", nullable=True),
    }


def _epochs_schema() -> type[dy.Schema]:
    """Columns of the epochs, with those of all monitors."""
    columns: dict[str, Any] = dict(_EpochsBeforeMonitors.columns())
    for monitor in ALL_MONITORS:
        columns |= _monitor_columns(monitor)
    columns |= _EpochsAfterMonitors.columns()
    return type("Epochs", (dy.Schema,), {"__doc__": _EpochsBeforeMonitors.__doc__, "__module__": __name__, **columns})


Epochs = _epochs_schema()


class Runs(dy.Schema):
    """One row per run and solution; written last, so that it marks the run complete."""

    solution = text("solution of the run; empty where the run failed before any was known")
    verdict = one_of(RunVerdict, "unsafe, unproven or safe; null where the run failed", nullable=True)
    reasons = ones_of(Reason, "why the verdict is what it is; null where the run failed", nullable=True)
    proof_margin_m = real("m", "least proof margin of what was accepted or in use and is right", min=0)
    part_verdict = one_of(RunVerdict, "verdict between first and last anchor; null where that is all", nullable=True)
    part_from = instant("first anchor: a read, or a sample of the reference", nullable=True)
    part_to = instant("last anchor", nullable=True)
    part_share = real("1", "share of the moving time that lies between them", min=0, max=1)
    status = one_of(RunStatus, "ok, partial (damaged input read up to the damage) or failed")
    error = text("what went wrong", nullable=True)
    vehicle = one_of(VehicleFigures, "where odometer scale and latency come from", nullable=True)
    odometer_origin = one_of(Origin, "where the odometer of the LDS comes from, as declared", nullable=True)
    odometer_follows = real(
        "1", "how closely the odometer follows the positions (V): below the limit it is made of them; null: not tested"
    )
    share_unknown = real("1", "share of moving time in use that could not be checked", min=0, max=1)
    odometer_contradicted = count("gaps between anchors that the odometer does not close (with a vehicle file)")
    t_start = instant("first epoch", nullable=True)
    t_end = instant("last epoch", nullable=True)
    partial_until = instant("the log is complete up to here", nullable=True)
    duration_s = real("s", "last minus first epoch", min=0)
    distance_m = real("m", "distance travelled", min=0)
    epochs = count("GNSS epochs")
    gnss_rate_hz = real("Hz", "nominal rate of the positions; null for fewer than two", min=0)
    moving_s = real("s", "time in which the train moved or may have moved, gaps included", min=0)
    availability = real("1", "share of moving time with a valid TVB", min=0, max=1)
    outages = count("stretches without a usable position")
    longest_outage_s = real("s", "longest of them", min=0)
    duplicates = count("epochs dropped because their time occurs twice")
    out_of_order = count("epochs that were recorded out of order")
    evidence = one_of(Evidence, "what served as truth", nullable=True)
    latency_s = real("s", "GNSS latency at the end of the run")
    latency_sigma_s = real("s", "its standard deviation", min=0)
    odometer_scale = real("1", "true distance over odometer distance")
    odometer_scale_sigma = real("1", "its standard deviation", min=0)
    white_noise_along_m = real(
        "m", "white noise of positions along the track, as measured at the end; null: not known", min=0
    )
    white_noise_cross_m = real("m", "the same across the track", min=0)
    white_noise_up_m = real("m", "the same of the height", min=0)
    cross_bias_m = real("m", "median cross-track residual over the run")
    along_error_mean_m = real("m", "mean error along the track")
    along_error_p95_m = real("m", "95 % of |error| along the track")
    along_error_max_m = real("m", "largest |error| along the track")
    along_error_epochs = count("epochs that these three are of: errors along the track that are known")
    cross_error_mean_m = real("m", "mean error across the track")
    cross_error_p95_m = real("m", "95 % of |error| across the track")
    cross_error_max_m = real("m", "largest |error| across the track")
    cross_error_epochs = count("epochs that these three are of: errors across the track that are known")
    up_error_mean_m = real("m", "mean error of height")
    up_error_p95_m = real("m", "95 % of |error| of height")
    up_error_max_m = real("m", "largest |error| of height")
    up_error_epochs = count("epochs that these three are of: errors of height that are known")
    balises_passed = count("virtual balises passed, each once however often it was")
    balises_found = count("of these accepted at least once where they are")
    balises_on_path = count("passages of virtual balises")
    balises_accepted = count("virtual balises accepted, each time counted, offers beyond the passages too")
    balises_rejected = count("virtual balises rejected, each time counted")
    balises_missed = count("passages at which one was not found in its window")
    balises_not_available = count("passages without a position")
    unsafe_accepted = count("VBs accepted despite a wrong position")
    unproven_accepted = count("VBs accepted whose position could not be checked")
    initialising_accepted = count("VBs accepted before anything was validated")
    location_error_mean_m = real("m", "mean location error of accepted VBs")
    location_error_p95_m = real("m", "95 % of |location error| of accepted VBs")
    location_error_max_m = real("m", "largest |location error| of accepted VBs")
    location_error_count = count("accepted VBs that these three are of: the error is known to 5 m")
    hazards_1a = count("hazards VB_JUMP_1A")
    hazards_1b = count("hazards VB_JUMP_1B")
    hazards_shift = count("hazards VB_SHIFT")
    hazards_wrong_track = count("hazards VB_WRONG_TRACK")
    hazards_detected = count("hazards that a monitor detected")
    hazards_within_budget = count("hazards in use no longer than the time allowed")
    faults = count("faults in the hazard table, each once: rows of one begin, and what its jump back hits")
    missed_detections = count("of these with a failure that no monitor found for certain by t_failure + time allowed")
    time_to_detect_max_s = real("s", "largest T_D")
    time_since_failure_max_s = real("s", "largest T_dsf")
    time_since_failure_may_max_s = real("s", "largest T_dsf that the evidence leaves")
    hazardous_max_s = real("s", "longest hazardous time of a failure, whether it hit a VB or not")
    hazardous_s = real("s", "hazardous time of all failures", min=0)
    hazardous_natural_s = real("s", "of it what no injected fault of GNSS explains: eq. 7 is of nature's", min=0)
    unknown_in_use_s = real("s", "longest unknown moving time in use; stretches near each other taken together", min=0)
    share_undiagnosed = real("1", "share of the moving time in use without diagnosis (P3)", min=0, max=1)
    alarms = count("alarm episodes")
    false_alarms = count("of these false", nullable=True)
    false_alarm_rate_per_h = real("1/h", "false alarms per hour", min=0)
    false_alarm_rate_low_per_h = real("1/h", "exact two-sided 95 % Poisson bound, lower", min=0)
    false_alarm_rate_high_per_h = real("1/h", "exact two-sided 95 % Poisson bound, upper", min=0)
    exposure_max_s = real("s", "longest exposure", min=0)
    exposure_p99_s = real("s", "99 % of exposure", min=0)
    share_p0 = real("1", "share of time in P0", min=0, max=1)
    share_p1 = real("1", "share of time in P1", min=0, max=1)
    share_p2 = real("1", "share of time in P2", min=0, max=1)
    share_p3 = real("1", "share of time in P3", min=0, max=1)
    stanford_nominal = count("epochs: error <= confidence <= limit")
    stanford_misleading = count("epochs: confidence < error <= limit")
    stanford_hazardous = count("epochs: confidence <= limit < error")
    stanford_unavailable = count("epochs: confidence > limit")
    mtbf_h = real("h", "mean time between outages of valid, confident, unambiguous positions", min=0)
    continuity_15s = real("1", "exp(-15 s / MTBF) (LOC eq. 8)", min=0, max=1)
    calibrated_by = texts("runs that vehicle and noise were calibrated by (`replay --calibrate`)")
    config_digest = text("SHA-256 of configuration and vehicle")
    input_digest = text("SHA-256 of log and site")
    software = text("name and version of the program")
    contract = text("version of this contract")
    stanford_hpl_nominal = count("as stanford_nominal, with the receiver's HPL; null without one", nullable=True)
    stanford_hpl_misleading = count("as stanford_misleading, with the receiver's HPL", nullable=True)
    stanford_hpl_hazardous = count("as stanford_hazardous, with the receiver's HPL", nullable=True)
    stanford_hpl_unavailable = count("as stanford_unavailable, with the receiver's HPL", nullable=True)
    ambiguous_stretches = count("stretches where a parallel path is as likely")
    remedies = ones_of(Remedy, "what would mend verdict or availability, the largest gain first", nullable=True)
    remedies_gain = reals(
        "1", "share of the moving time that each of these would win back or prove, at most", nullable=True
    )
    misfits = ones_of(MisfitCause, "why streams of the run do not fit each other, the impossible first", nullable=True)
    faults_injected = flag("the log says that faults were injected: rates are those of a trial", nullable=True)
    lost_to = ones_of(
        LostTo, "what moving time without a valid TVB was lost to, the largest share first", nullable=True
    )
    lost_to_share = reals("1", "share of the moving time lost to each of these", nullable=True)
    lost_to_monitor = text("monitor that failed in most of the time lost to alarms", nullable=True)
    notes = text("remarks on the run: data left out, weak evidence, causes of low availability", nullable=True)
    failures = count("faults with time judged wrong in use, whether they hit a VB or not")
    failures_within_budget = count("of these in time: within the allowed T_D of the configured level")
    failures_beyond_budget = count("of these too late; of the rest it is unknown")
    failure_hazardous_s = reals("s", "hazardous time of each failure, in order of time", nullable=True)
    failure_hazardous_may_s = reals("s", "the same with the time that is unknown", nullable=True)
    failure_accepted = ones_of(
        Judgement,
        "worst judgement of the balises accepted in each failure; right where none was",
        nullable=True,
    )
    service_levels = texts("service levels of the configuration, in order", nullable=True)
    level_allowed_s = reals("s", "allowed T_D of each of them (TVB eq. 7)", nullable=True)
    level_within = counts("failures within it, what is unknown included", nullable=True)
    level_exceeded = counts("failures beyond it, what is unknown left out", nullable=True)
    level_verdict = ones_of(
        ThrVerdict,
        "kept: in time; exceeded: too late; no failure; unknown where it could not be checked",
        nullable=True,
    )
    held_s = real("s", "time of the epochs, without gaps", min=0)
    monitored_s = real("s", "of this with a verdict of the along-track bank", min=0)
    evidence_s = real("s", "of this judged right or wrong", min=0)
    judged_s = real("s", "of this with both, in use: what the false alarm rate counts", min=0)
    in_use_s = real("s", "time with a position in use", min=0)
    in_use_judged_s = real("s", "of this judged right or wrong: what rates of hazards and failures count", min=0)
    negated_s = real("s", "time negated", min=0)
    trusted_s = real("s", "time with a valid, confident, unambiguous position", min=0)
    trusted_losses = count("how often that was lost")
    accepted_judged = count("accepted VBs judged right or wrong")
    undetected_median_m = real("m", "median over epochs in use of the larger of undetected ahead and behind", min=0)
    undetected_p95_m = real("m", "95 % of them are below", min=0)
    undetected_max_m = real("m", "the largest of them", min=0)
    undetected_share_beyond = real("1", "share of epochs in use with one beyond the failure limit", min=0, max=1)
    t_undetected_beyond = instant("first epoch in use with one beyond the failure limit", nullable=True)
    undetected_beyond_path_m = real("m", "path position there")
    physical_spacing_m = real("m", "least distance from a physical balise at any time to one beyond the limit", min=0)
    physical_spacing_s = real("s", "shortest time from such a balise to one beyond the limit", min=0)
    physical_spacing_starts = count("such balises tried; null where not computed", nullable=True)
    physical_spacing_reached = count("of these those from which the run reaches the limit", nullable=True)


TABLES: dict[str, type[dy.Schema]] = {
    "hazards": Hazards,
    "passages": Passages,
    "alarms": Alarms,
    "epochs": Epochs,
    "runs": Runs,
}
