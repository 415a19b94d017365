"""`balise claim`: every requirement of a profile as met, not met or not shown, over all runs of a result."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any

import polars as pl

from pipeline.results import store
from pipeline.results.workers import with_progress
from pipeline.storage.address import Address
from pipeline.studies.claim.front import front_end_of
from pipeline.studies.claim.profile import RequirementProfile
from pipeline.studies.claim.requirements import ALL, ClaimJourney, Requirement, Tallies, requirements, tallies
from pipeline.studies.claim.tally import Kind, Tally, random_share
from pipeline.studies.reservations import failed_runs, reservation_sentences, runs_without_truth, several_settings
from pipeline.studies.tally import S_PER_H, Compliance, without_repeated_journeys
from schemas.config import Configuration
from schemas.enums import NotShown, RunStatus
from schemas.frozen import frozen
from schemas.run import Site
from schemas.words import NOT_SHOWN, say

SCHEMA = {
    **dict.fromkeys(("solution", "requirement", "applies_to", "limit", "demanded", "finding"), pl.String),
    **dict.fromkeys(("events", "possible_events", "trials", "kept", "broken"), pl.Int64),
    **dict.fromkeys(("measured", "low", "high", "worst", "hours", "hours_known", "hours_needed"), pl.Float64),
    **dict.fromkeys(("clause", "reason"), pl.String),
}


@frozen
class Claim:
    """`table`: one row per solution and requirement; `notes`: what the result as a whole cannot say."""

    profile: RequirementProfile
    table: pl.DataFrame
    notes: list[str]


def assess_claim(
    out: Address,
    profile: RequirementProfile,
    site: Site | None = None,
    areas: pl.DataFrame | None = None,
    ahead_m: float = 0.0,
) -> Claim:
    """Hold all complete runs of a result against a profile of requirements.

    Args:
        out: the result of a campaign.
        profile: the requirements.
        site: the site of the result, where requirements ask for places.
        areas: kinds of area along the site, as `read_areas` yields them.
        ahead_m: front end ahead of the balise antenna [m].

    Returns:
        What was found of each requirement, and on what it rests.

    Raises:
        UsageError: the result is of another site.
    """
    run_ids = store.complete_runs(out)
    config = store.read_config(out) or Configuration()
    for run_id, metadata in store.completed_runs(out).items():
        store.check_site(site, metadata.get("site_digest"), run_id)
    runs = store.read_table(out, "runs").collect()
    done = runs.filter((pl.col("status").cast(pl.String) != RunStatus.FAILED.value) & pl.col("run_id").is_in(run_ids))
    done, twice = without_repeated_journeys(done)
    by_solution: dict[str, Tallies] = defaultdict(dict)
    days: set[tuple[object, ...]] = set()
    # Which run of a day is its trial is drawn before an error is looked at, and apart from its instant.
    for run in with_progress(
        sorted(done.iter_rows(named=True), key=lambda row: random_share(f"day\n{_trial_key(row)}"))
    ):
        of_run = _tallies_of_run(out, run, config, profile, areas, ahead_m)
        if profile.method.independent == "day" and run["t_start"] is not None:
            of_run = _once_a_day(of_run, (run["solution"], run["t_start"].date()), days)
        _add_counts(by_solution[run["solution"]], of_run)
    outside_h = sum(counts["no_area", ALL].held_s for counts in by_solution.values()) / S_PER_H
    notes = [*twice, *_reader_notes(runs, outside_h, areas, ahead_m, profile)]
    return Claim(profile, claim_table(by_solution, profile), notes)


def _once_a_day(of_run: Tallies, day: tuple[object, ...], days: set[tuple[object, ...]]) -> Tallies:
    """The tallies without trials of requirements that another run of the day was a trial of; time and events stay."""
    once = dict(of_run)
    for key, counts in of_run.items():
        if counts.trials and (*day, *key) in days:
            once[key] = replace(counts, trials=0, kept=0, broken=0)
        elif counts.trials:
            days.add((*day, *key))
    return once


def _tallies_of_run(
    out: Address,
    run: dict[str, Any],
    config: Configuration,
    profile: RequirementProfile,
    areas: pl.DataFrame | None,
    ahead_m: float,
) -> Tallies:
    """What one run counts for each requirement and area."""
    of_run = (store.read_table(out, name, run["run_id"]).collect() for name in ("epochs", "passages"))
    epochs, passages = (frame.filter(pl.col("solution") == run["solution"]) for frame in of_run)
    front = front_end_of(epochs, passages, run, config, profile.method, areas, ahead_m)
    journey = ClaimJourney(_trial_key(run), front, epochs, passages, profile)
    return tallies(journey) | {("no_area", ALL): journey.tally_outside()}


def _trial_key(run: dict[str, Any]) -> str:
    """What draws the trial of a run."""
    return f"{run['run_id']}\n{run['solution']}"


def _add_counts(sums: Tallies, more: Tallies) -> None:
    """Add counts to the sums, in place."""
    for key, counts in more.items():
        sums[key] = sums.get(key, Tally()) + counts


def claim_table(by_solution: dict[str, Tallies], profile: RequirementProfile) -> pl.DataFrame:
    """One row per solution and requirement, those of the profile that nothing was recorded for included."""
    rows = [
        _requirement_row(solution, requirement, counts.get(requirement.key, Tally()))
        for solution, counts in sorted(by_solution.items())
        for requirement in requirements(profile)
    ]
    return pl.DataFrame(rows, schema=SCHEMA, orient="row")


def _requirement_row(solution: str, requirement: Requirement, counts: Tally) -> dict[str, Any]:
    """One requirement of one solution, as a row of the result."""
    shown = requirement.demand.assess(counts)
    return {
        "solution": solution,
        "requirement": requirement.name,
        "applies_to": requirement.applies_to,
        "limit": requirement.limit,
        "demanded": requirement.demand.words,
        "finding": shown.finding.value,
        "events": counts.events,
        "possible_events": counts.possible,
        "trials": counts.trials,
        "kept": counts.kept,
        "broken": counts.broken,
        "measured": shown.bounds.value,
        "low": shown.bounds.low,
        "high": shown.bounds.high,
        "worst": counts.worst,
        "hours": counts.held_s / S_PER_H,
        "hours_known": counts.known_s / S_PER_H,
        "hours_needed": shown.needed,
        "clause": requirement.clause,
        "reason": NOT_SHOWN[_why_not_shown(requirement, counts)] if shown.finding is Compliance.NOT_SHOWN else None,
    }


# What a recording cannot say of a requirement, however long it is.
_NEVER = {
    ("start", "last position"): NotShown.BEFORE_LOG,
    ("start", "cold movement"): NotShown.AT_SWITCH_ON,
    ("start", "nothing known"): NotShown.SINCE_SWITCH_ON,
    ("cold_movement", ALL): NotShown.WITHOUT_POWER,
    ("speed_accuracy", ALL): NotShown.WITHIN_WINDOW,
    ("availability", ALL): NotShown.NOT_RECORDED,
}


def _why_not_shown(requirement: Requirement, counts: Tally) -> NotShown:
    """Why a requirement is not shown."""
    if requirement.key in _NEVER:
        return _NEVER[requirement.key]
    if requirement.name == "way_without_balise":
        return NotShown.NO_EVENT_ON_WAYS if counts.trials else NotShown.NO_LONG_WAY
    if not counts.held_s and not counts.trials:
        return NotShown.NOTHING_RECORDED
    if not counts.known_s:
        return NotShown.EVIDENCE_SILENT
    if requirement.demand.kind is Kind.ALWAYS:
        return NotShown.NO_PROBABILITY
    return NotShown.PARTLY_SILENT if counts.events == 0 and counts.known_s < counts.held_s else NotShown.TOO_FEW


def _reader_notes(
    runs: pl.DataFrame, outside_h: float, areas: pl.DataFrame | None, ahead_m: float, profile: RequirementProfile
) -> list[str]:
    """What the reader must know before the rows."""
    settings = several_settings(runs, say("claim", "trains"))
    late = runs["latency_sigma_s"].null_count()
    said = {
        "at_antenna": not settings and not ahead_m,
        "outside": areas is not None and outside_h,
        "no_latency": late and (late, runs.height),
        "only_broken": True,
        "rear_end": True,
        "by_day": profile.method.independent == "run",
    }
    return [
        *failed_runs(runs),
        *reservation_sentences("claim", {"no_areas": areas is None}),
        *runs_without_truth(runs, say("claim", "blind")),
        *settings,
        *reservation_sentences("claim", said),
    ]


def rows_for_reading(claim: Claim) -> pl.DataFrame:
    """The rows as they fit a screen: what was found of each requirement, and what it rests on.

    Args:
        claim: what was found.

    Returns:
        One row per requirement and solution.
    """
    by_runs = {
        requirement.key
        for requirement in requirements(claim.profile)
        if requirement.demand.kind in (Kind.SHARE, Kind.AVAILABILITY)
    }
    keys = claim.table.select("requirement", "applies_to").iter_rows()
    shares = pl.Series([key in by_runs for key in keys], dtype=pl.Boolean)
    solution = ["solution"] if claim.table["solution"].n_unique() > 1 else []
    return claim.table.select(
        *solution,
        pl.col("requirement"),
        pl.col("applies_to").alias("of"),
        pl.col("finding"),
        pl.col("events"),
        pl.when(shares).then(pl.format("{}/{}", "kept", "trials")).alias("runs kept"),
        pl.col("hours_needed").round_sig_figs(3).alias("hours needed"),
        pl.col("limit"),
    )
