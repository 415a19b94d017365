"""Contracts of the tables that a campaign derives from those of its runs (CONTRACT section 3)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import dataframely as dy

from schemas.columns import count, flag, one_of, real, text, texts
from schemas.config import SafetyConfig
from schemas.enums import BaliseKind, Evidence, ThrVerdict
from schemas.tables import Runs


def _estimate(name: str, meaning: str, unit: str = "1", ending: str = "") -> dict[str, dy.Column]:
    """A figure with its exact two-sided 95 % bounds."""
    return {
        f"{name}{ending}": real(unit, meaning, min=0),
        f"{name}_low{ending}": real(unit, f"{meaning}: lower 95 % bound", min=0),
        f"{name}_high{ending}": real(unit, f"{meaning}: upper 95 % bound", min=0),
    }


def _spread(name: str, meaning: str) -> dict[str, dy.Column]:
    """Columns of mean, standard deviation and 95 % of a quantity."""
    return {
        f"{name}_mean_m": real("m", f"mean {meaning}"),
        f"{name}_sigma_m": real("m", f"standard deviation of the {meaning}", min=0),
        f"{name}_p95_m": real("m", f"95 % of |{meaning}|", min=0),
        f"{name}_max_m": real("m", f"largest |{meaning}|", min=0),
    }


def _level_columns(level: str) -> dict[str, dy.Column]:
    """Columns of one service level."""
    return {
        f"allowed_{level}_s": real("s", f"allowed T_D of the service level {level} (TVB eq. 7)", min=0),
        f"within_{level}": count(f"failures within the allowed T_D of {level}, what is unknown included"),
        f"exceeded_{level}": count(f"failures beyond the allowed T_D of {level}; of the rest it cannot be said"),
        f"verdict_{level}": one_of(ThrVerdict, f"kept, exceeded, no failure, or unknown, for {level}"),
    }


def campaign_runs_schema(levels: Iterable[str]) -> type[dy.Schema]:
    """Contract of `campaign/runs.parquet`; the service levels are those of the configuration.

    Args:
        levels: names of the service levels.

    Returns:
        The schema, with the rates and verdict of each level.
    """
    return _campaign_runs_schema(tuple(levels))


@lru_cache(maxsize=8)
def _campaign_runs_schema(levels: tuple[str, ...]) -> type[dy.Schema]:
    """Columns of the runs of a campaign, with those of its service levels."""
    columns: dict[str, dy.Column] = {"run_id": text("run"), **Runs.columns()}
    columns |= _estimate("hazard_rate", "faults per hour in use judged by a reference or balise reads", "1/h", "_per_h")
    columns["missed"] = count("faults with a failure that no monitor found by t_failure + budget")
    columns |= _estimate("missed_share", "share of missed ones, of the faults with a failure that a truth judged")
    columns |= _estimate("beyond_budget_share", "share of failures beyond the budget, of those where that is known")
    columns |= _estimate("unsafe_share", "share of `accepted_judged` that are `unsafe_accepted`")
    columns |= _estimate("outage_rate", "outages per hour", "1/h", "_per_h")
    for level in levels:
        columns |= _level_columns(level)
    doc = "One row per run and solution: its `runs` row, rates with exact bounds, and the verdict per service level."
    return type("CampaignRuns", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


CampaignRuns = campaign_runs_schema(SafetyConfig().service_levels)


def _campaign_balises_schema() -> type[dy.Schema]:
    """Columns of the balises of a campaign."""
    columns: dict[str, dy.Column] = {
        "solution": text("solution"),
        "balise_id": text("balise"),
        "kind": one_of(BaliseKind, "virtual or physical"),
        "netelement_id": text("net element of the balise"),
        "measure_m": real("m", "measure of the balise"),
        "runs": count("runs that met it"),
        "passages": count("times that a train passed it"),
        "accepted": count("times that the LDS accepted it"),
        **_estimate("accepted_share", "share of passages at which it was accepted"),
        "rejected": count("offers rejected"),
        "missed": count("passages at which it was not found in its window"),
        "not_available": count("passages without a position"),
        "deletions": count("passages with the ETCS failure mode deletion"),
        **_estimate("deletion_rate", "share of passages with the failure mode deletion"),
        "insertions": count("rows with the ETCS failure mode insertion"),
        "linking_errors": count("linking errors at it"),
        "accepted_judged": count("acceptances judged right or wrong by a reference or balise reads"),
        "unsafe_accepted": count("acceptances judged wrong, by any evidence"),
        "unproven_accepted": count("acceptances whose position could not be checked"),
        **_estimate("unsafe_rate", "share of judged acceptances that are wrong"),
        "suspect_after_the_fact": count("accepted between a fault's onset and its detection"),
        "location_error_count": count("acceptances whose location error is known to 5 m: what follows is of these"),
        **_spread("location_error", "location error of acceptances"),
        "undetected_count": count("passages with an unnoticed error computed: what follows is of these"),
        "undetected_median_m": real("m", "median of the larger unnoticed error, ahead or behind", min=0),
        "undetected_p95_m": real("m", "95 % of them are below", min=0),
        "undetected_max_m": real("m", "the largest of them", min=0),
        "physical_before_count": count("passages that a physical balise of the run may lie too far before"),
        "physical_before_median_m": real("m", "median of how far before it may lie at most", min=0),
        "physical_before_p05_m": real("m", "5 % of them are below", min=0),
        "physical_before_min_m": real("m", "the shortest of them", min=0),
    }
    doc = "One row per balise and solution over all runs of the campaign."
    return type("CampaignBalises", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


CampaignBalises = _campaign_balises_schema()


def _accuracy_schema() -> type[dy.Schema]:
    """Columns of the accuracy by groups of balises."""
    columns: dict[str, dy.Column] = {
        "solution": text("solution"),
        "grouped_by": text("what the group has in common: all, netelement_id or speed_band_kmh"),
        "group": text("the net element or speed band"),
        "location_error_count": count("acceptances whose location error is known to 5 m: all figures are of these"),
        **_spread("location_error", "location error of acceptances"),
        "location_error_median_m": real("m", "median location error of acceptances"),
        "location_accuracy_m": real("m", "smallest Q_LOCACC among them; each is held against its own", min=0),
        "location_accuracy_max_m": real("m", "largest Q_LOCACC among them", min=0),
        "within_location_accuracy": count("of these within Q_LOCACC"),
        **_estimate("within_location_accuracy_share", "share within Q_LOCACC"),
        "ci_limit_m": real("m", "limit of the confidence interval", min=0),
        "within_ci_limit": count("of these within the limit"),
        **_estimate("within_ci_limit_share", "share within the limit"),
    }
    doc = "Location error of accepted virtual balises over a campaign, by net element and speed."
    return type("CampaignAccuracy", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


CampaignAccuracy = _accuracy_schema()


STANFORD = ("nominal", "misleading", "hazardous", "unavailable")


def _figures_schema() -> type[dy.Schema]:
    """Columns of the figures of each solution."""
    columns: dict[str, dy.Column] = {
        "solution": text("solution"),
        "runs": count("runs that were replayed"),
        "runs_failed": count("runs that could not be, with this solution or before any was known"),
        "runs_partial": count("of the replayed runs those whose log is damaged; what was read of them counts"),
        "hours": real("h", "recorded time", min=0),
        "runs_unsafe": count("runs with the verdict unsafe"),
        "runs_unproven": count("runs with the verdict unproven"),
        "runs_safe": count("runs with the verdict safe"),
        "hours_with_evidence": real("h", "time judged right or wrong, by any evidence", min=0),
        "hours_with_truth": real("h", "time in use judged right or wrong by a reference or balise reads", min=0),
        "hours_negated": real("h", "time negated, which no rate counts", min=0),
        "hours_unjudged": real("h", "time in use that could not be judged, which no rate counts", min=0),
        "hazards": count("faults; the rows that belong to one fault count once"),
        "hazards_judged": count("of these those that a reference or balise reads tell"),
        **_estimate("hazard_rate", "faults per hour, both by a reference or balise reads", "1/h", "_per_h"),
        "missed": count("faults with a failure that no monitor found by t_failure + budget"),
        "missed_known": count("faults with a failure that a reference or balise reads tell"),
        "missed_judged": count("of these missed"),
        **_estimate("missed_share", "share of missed ones of these"),
        "failures": count("stretches judged wrong in use, whether they hit a VB or not"),
        "failures_within_budget": count("of these in time"),
        "failures_beyond_budget": count("of these too late; of the rest it is unknown"),
        "failures_judged": count("failures, by a reference or balise reads, of which it can be said"),
        "beyond_budget_judged": count("of these too late"),
        **_estimate("beyond_budget_share", "share of failures beyond the budget of these"),
        "beyond_budget_rate_upper_per_h": real(
            "1/h", "one-sided 95 % upper bound of failures not shown to be within the budget, per hour", min=0
        ),
        "hours_judged": real("h", "judged time in runs whose alarms all have a verdict", min=0),
        "false_alarms": count("false alarms in it"),
        **_estimate("false_alarm_rate", "false alarms per judged hour", "1/h", "_per_h"),
        "accepted": count("virtual balises accepted"),
        "accepted_judged": count("of these judged right or wrong by a reference or balise reads"),
        "unsafe_judged": count("of the judged ones wrong"),
        **_estimate("unsafe_share", "share of judged acceptances that are wrong"),
        "unsafe_accepted": count("accepted ones judged wrong, by any evidence"),
        "unproven_accepted": count("accepted ones whose position could not be checked"),
        "outages": count("stretches without a usable position"),
        **_estimate("outage_rate", "outages per hour", "1/h", "_per_h"),
        "trusted_losses": count("how often a valid, confident, unambiguous position was lost"),
        **_estimate("mtbf", "mean time between these losses", "h", "_h"),
        **_estimate("continuity_15s", "exp(-15 s / MTBF) (LOC eq. 8)"),
        **{
            f"share_{state}": real("1", f"share of time in {meaning}", min=0, max=1)
            for state, meaning in (
                ("p0", "P0, in runs judged by a reference or balise reads; null without any"),
                ("p1", "P1 in these runs; null without any"),
                ("p2", "P2 in these runs; in all runs where there are none"),
                ("p3", "P3 in these runs; in all runs where there are none"),
                ("unknown", "which the state is not known; the five add up to one"),
            )
        },
        **{
            f"stanford_{kind}": count(f"epochs of runs judged by a reference or balise reads: {kind}, by confidence")
            for kind in STANFORD
        },
        **{
            f"stanford_hpl_{kind}": count(f"epochs of these runs: {kind}, by the receiver's HPL", nullable=True)
            for kind in STANFORD
        },
        "undetected_max_m": real(
            "m", "largest unnoticed error at any epoch of any run; null where not computed", min=0
        ),
        "physical_spacing_runs": count("runs with a spacing of physical balises computed"),
        "physical_spacing_m": real(
            "m", "least distance from a physical balise at any time to one beyond the limit", min=0
        ),
        "physical_spacing_median_m": real("m", "median over the runs that reach the limit", min=0),
        "physical_spacing_share_low": real(
            "1", "share of runs in which the shortest spacing suffices: one-sided 95 % bound from below", min=0, max=1
        ),
        "thr_vb_per_h": real("1/h", "tolerable hazard rate of a virtual balise", tolerance=0.0, min=0),
        "hours_needed": real(
            "h",
            "hours that prove THR_VB by counting, 95 %",
            min=0,
        ),
        "hours_still_needed": real("h", "of these still needed", min=0),
    }
    doc = "One row per solution: what the campaign measured, with exact bounds, and what it cannot show."
    return type("CampaignFigures", (dy.Schema,), {"__doc__": doc, "__module__": __name__, **columns})


CampaignFigures = _figures_schema()


class CampaignDetection(dy.Schema):
    """Measured hazardous time and T_D against the allowed T_D of every service level (TVB eq. 7)."""

    solution = text("solution")
    service_level = text("service level of the configuration")
    allowed_s = real("s", "allowed T_D", min=0)
    failures = count("stretches judged wrong in use, whether they hit a VB or not")
    within = count("of these in time, what is unknown counted as wrong")
    exceeded = count("of these too late; of the rest it is unknown")
    failures_judged = count("failures, by a reference or balise reads, of which it can be said")
    within_judged = count("of these within the allowed T_D")
    within_share = real("1", "share of these within it", min=0)
    within_share_low = real("1", "share of these within it: lower 95 % bound", min=0)
    within_share_high = real("1", "share of these within it: upper 95 % bound", min=0)
    hazardous_median_s = real("s", "median of the hazardous time", min=0)
    hazardous_p95_s = real("s", "95 % of the hazardous time", min=0)
    hazardous_max_s = real("s", "longest hazardous time", min=0)
    hazardous_may_max_s = real("s", "the longest with the time that is unknown", min=0)
    detected = count("faults that a monitor detected")
    time_to_detect_median_s = real("s", "median of T_D")
    time_to_detect_p95_s = real("s", "95 % of T_D")
    time_to_detect_max_s = real("s", "largest T_D")
    time_since_failure_median_s = real("s", "median of T_dsf, the least that the evidence leaves")
    time_since_failure_p95_s = real("s", "95 % of it")
    time_since_failure_max_s = real("s", "largest of it")
    time_since_failure_may_median_s = real("s", "median of T_dsf, the largest that the evidence leaves")
    time_since_failure_may_p95_s = real("s", "95 % of it")
    time_since_failure_may_max_s = real("s", "largest of it")


class CampaignLevels(dy.Schema):
    """One row per run, solution and service level: would the run have kept this level's allowed T_D (TVB eq. 7)?"""

    run_id = text("run")
    solution = text("solution")
    service_level = text("service level of the configuration")
    allowed_s = real("s", "allowed T_D of the level", min=0)
    evidence = one_of(Evidence, "what served as truth", nullable=True)
    failures = count("stretches judged wrong in use, whether they hit a VB or not")
    within = count("of these in time, what is unknown counted as wrong")
    exceeded = count("of these too late; of the rest it is unknown")
    hazardous_max_s = real("s", "longest hazardous time", min=0)
    hazardous_may_max_s = real("s", "the longest with the time that is unknown", min=0)
    verdict = one_of(ThrVerdict, "kept: in time; exceeded: too late; no failure; unknown where it could not be checked")
    receiver_needs_s = real("s", "period of the epochs and reaction: the least that any fault takes", min=0)
    receiver_quick_enough = flag("that is within the allowed T_D (TVB section 5)", nullable=True)


class CampaignMap(dy.Schema):
    """One row per place where several runs raised the same alarm across the track: the map is in doubt there."""

    netelement_id = text("net element")
    from_m = real("m", "measure of the first alarm there")
    to_m = real("m", "measure of the last alarm there")
    axis = text("cross, up, or both: what the monitors that failed look at")
    runs = count("runs with such an alarm")
    solutions = texts("solutions concerned")
    alarms = count("alarms there")
    run_ids = texts("these runs")


CAMPAIGN_TABLES: dict[str, type[dy.Schema]] = {
    "campaign_runs": CampaignRuns,
    "campaign_balises": CampaignBalises,
    "campaign_accuracy": CampaignAccuracy,
    "campaign_figures": CampaignFigures,
    "campaign_detection": CampaignDetection,
    "campaign_levels": CampaignLevels,
    "campaign_map": CampaignMap,
}
