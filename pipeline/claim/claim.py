"""`balise claim`: every requirement of a profile as met, not met or not shown, over all runs of a result."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import polars as pl

from pipeline.claim.front import front_of
from pipeline.claim.profile import Profile
from pipeline.claim.requirements import ALL, Key, Ride, Tallies, run_name, tallies
from pipeline.claim.tally import (
    S_PER_H,
    Finding,
    Shown,
    Tally,
    drawn,
    of_always,
    of_availability,
    of_rate,
    of_share,
)
from pipeline.line import distinct
from pipeline.results import store
from pipeline.storage.address import Address
from schemas.config import Configuration
from schemas.enums import TRUTH, RunStatus
from schemas.run import Site

SCHEMA = {
    **dict.fromkeys(("solution", "requirement", "applies_to", "limit", "demanded", "finding"), pl.String),
    **dict.fromkeys(("events", "possible_events", "trials", "kept", "broken"), pl.Int64),
    **dict.fromkeys(("measured", "low", "high", "worst", "hours", "hours_known", "hours_needed"), pl.Float64),
    **dict.fromkeys(("clause", "reason"), pl.String),
}


@dataclass(frozen=True)
class Claim:
    """`table`: one row per solution and requirement; `notes`: what the result as a whole cannot say."""

    profile: Profile
    table: pl.DataFrame
    notes: list[str]


@dataclass(frozen=True)
class Demand:
    """One requirement: its limit in words, what is demanded, how counts are turned into a finding."""

    limit: str
    demanded: str
    clause: str
    shown: Callable[[Tally], Shown]


def claim(
    out: Address,
    profile: Profile,
    site: Site | None = None,
    areas: pl.DataFrame | None = None,
    ahead_m: float = 0.0,
) -> Claim:
    """Hold all complete runs of a result against a profile; `ahead_m`: front end ahead of the balise antenna."""
    run_ids = store.complete_runs(out)
    config = store.read_config(out) or Configuration()
    for run_id, metadata in store.completed_runs(out).items():
        store.check_site(site, metadata.get("site_digest"), run_id)
    runs = store.read_table(out, "runs").collect()
    done = runs.filter((pl.col("status").cast(pl.String) != RunStatus.FAILED.value) & pl.col("run_id").is_in(run_ids))
    done, twice = distinct(done)
    found: dict[str, Tallies] = defaultdict(dict)
    days: set[tuple[object, ...]] = set()
    # Which run of a day is its trial is drawn before an error is looked at.
    for run in sorted(done.iter_rows(named=True), key=lambda row: drawn(run_name(row))):
        told = _tallies_of(out, run, config, profile, areas, ahead_m)
        if profile.method.independent == "day" and run["t_start"] is not None:
            told = _once_a_day(told, (run["solution"], run["t_start"].date()), days)
        _add(found[run["solution"]], told)
    outside_h = sum(counts["no_area", ALL].held_s for counts in found.values()) / S_PER_H
    notes = [*twice, *_notes(runs, outside_h, areas, ahead_m)]
    if profile.method.independent == "run":
        notes.append(
            'Runs of one day count as independent; `method.independent = "day"` of a profile counts one a day.'
        )
    return Claim(profile, claim_table(found, profile), notes)


def _once_a_day(told: Tallies, day: tuple[object, ...], days: set[tuple[object, ...]]) -> Tallies:
    """Without the trials of requirements that another run of the day was a trial of; time and events stay."""
    spent = {key for key, counts in told.items() if counts.trials and (*day, *key) in days}
    days.update((*day, *key) for key, counts in told.items() if counts.trials)
    return {
        key: replace(counts, trials=0, kept=0, broken=0) if key in spent else counts for key, counts in told.items()
    }


def _tallies_of(
    out: Address,
    run: dict[str, Any],
    config: Configuration,
    profile: Profile,
    areas: pl.DataFrame | None,
    ahead_m: float,
) -> Tallies:
    of_run = (store.read_table(out, name, run["run_id"]).collect() for name in ("epochs", "passages"))
    epochs, passages = (frame.filter(pl.col("solution") == run["solution"]) for frame in of_run)
    front = front_of(epochs, passages, run, config, areas, ahead_m)
    return tallies(Ride(run_name(run), front, epochs, passages, profile))


def _add(sums: Tallies, more: Tallies) -> None:
    for key, counts in more.items():
        sums[key] = sums.get(key, Tally()) + counts


def claim_table(found: dict[str, Tallies], profile: Profile) -> pl.DataFrame:
    """One row per solution and requirement, those of the profile that nothing was recorded for included."""
    rows = [
        _row(solution, key, demand, counts.get(key, Tally()))
        for solution, counts in sorted(found.items())
        for key, demand in demands(profile).items()
    ]
    return pl.DataFrame(rows, schema=SCHEMA, orient="row")


def _row(solution: str, key: Key, demand: Demand, counts: Tally) -> dict[str, Any]:
    shown = demand.shown(counts)
    return {
        "solution": solution,
        "requirement": key[0],
        "applies_to": key[1],
        "limit": demand.limit,
        "demanded": demand.demanded,
        "finding": shown.finding.value,
        "events": counts.events,
        "possible_events": counts.possible,
        "trials": counts.trials,
        "kept": counts.kept,
        "broken": counts.broken,
        "measured": shown.measured.value,
        "low": shown.measured.low,
        "high": shown.measured.high,
        "worst": counts.worst,
        "hours": counts.held_s / S_PER_H,
        "hours_known": counts.known_s / S_PER_H,
        "hours_needed": shown.needed_h,
        "clause": demand.clause,
        "reason": _reason(key, demand, shown.finding, counts),
    }


def demands(profile: Profile) -> dict[Key, Demand]:
    """The requirements of a profile in their order, each with how it is judged."""
    found: dict[Key, Demand] = {}
    for kind, area in profile.areas.items():
        limit = f"{area.limit_m:g} m" if not area.way_s else f"{area.limit_m:g} m/{area.way_s:g} s"
        for name in ("mapo_claimed", "mapu_claimed", "mapo", "mapu"):
            found[name, kind.value] = Demand(limit, "always", area.limit_clause, of_always)
        found["safe_front_end", kind.value] = _rate(profile.failure_rate.aim_per_h, profile)
        found["front_accuracy", kind.value] = _share(
            f"{area.accuracy_m:g} m", area.accuracy_share, area.accuracy_clause
        )
    rate, slow, after = profile.failure_rate, profile.slow, profile.after_balise
    found["safe_front_end", ALL] = _rate(rate.aim_per_h, profile)
    found["safe_front_end_bound", ALL] = _rate(rate.bound_per_h, profile)
    for kind in slow.area_types:
        found["slow_claimed", kind.value] = Demand(f"{slow.limit_m:g} m", "always", slow.clause, of_always)
        found["slow_front_end", kind.value] = Demand(f"{slow.limit_m:g} m", "always", slow.clause, of_always)
        found["slow_accuracy", kind.value] = _share(f"{slow.accuracy_m:g} m", slow.accuracy_share, slow.clause)
    near = f"{after.fixed_m:g} m, from {after.below_kmh:g} km/h {after.offset_m:g} m + {after.per_mps_s:g} s·v"
    for balise in ("physical", "virtual"):
        found["after_balise", balise] = _share(near, after.share, after.clause)
    return found | _demands_of_trains(profile)


def _demands_of_trains(profile: Profile) -> dict[Key, Demand]:
    safe, speed, start, available = profile.safe_speed, profile.speed, profile.start, profile.availability
    margin = f"{safe.low_kmh:g} km/h to {safe.below_kmh:g}, {safe.high_kmh:g} at {safe.at_kmh:g} km/h"
    close = f"{speed.fixed_kmh:g} km/h to {speed.to_kmh:g} km/h, {speed.above_share:.0%} above"
    outside = f"{available.outside_s:g} s in {available.within_s / S_PER_H:g} h"
    starts = {
        "last position": start.last_position_s,
        "cold movement": start.cold_movement_s,
        "nothing known": start.nothing_s,
    }
    return {
        ("maso", ALL): Demand(margin, "always", safe.clause, of_always),
        ("masu", ALL): Demand(margin, "always", safe.clause, of_always),
        ("speed_accuracy", ALL): _share(close, speed.share, speed.clause),
        **{("start", name): Demand(f"{s:g} s", "always", start.clause, of_always) for name, s in starts.items()},
        ("cold_movement", ALL): Demand(
            f"{profile.cold_movement.detected_h:g} h", "always", profile.cold_movement.clause, of_always
        ),
        ("availability", ALL): Demand(
            outside,
            f"p >= {available.share:g}",
            available.clause,
            lambda counts: of_availability(counts, available.share, available.outside_s),
        ),
        ("way_without_balise", ALL): Demand(
            f"{profile.way.without_balise_m / 1000:g} km", "always", profile.way.clause, of_always
        ),
    }


def _share(limit: str, share: float, clause: str) -> Demand:
    return Demand(limit, f"p >= {share:g}", clause, lambda counts: of_share(counts, share))


def _rate(rate_per_h: float, profile: Profile) -> Demand:
    clause = profile.failure_rate.clause
    return Demand("own CI", f"< {rate_per_h:g} /h", clause, lambda counts: of_rate(counts, rate_per_h))


# What a recording cannot say of a requirement, however long it is.
_NEVER = {
    ("start", "last position"): "no recording tells what the unit knew at switch-on; worst: time to a position in use",
    ("start", "cold movement"): "no recording tells what the unit knew at switch-on",
    ("start", "nothing known"): "a recording begins after switch-on, so times are too short; worst: time to a TVB or "
    "an accepted balise",
    ("cold_movement", ALL): "a train without power records nothing",
    ("availability", ALL): "the confidence of speed is not recorded, and gaps of the log are not counted",
}


def _reason(key: Key, demand: Demand, finding: Finding, counts: Tally) -> str | None:
    """Why a requirement is not shown, in words."""
    if finding is not Finding.NOT_SHOWN:
        return None
    if key in _NEVER:
        return _NEVER[key]
    if key[0] == "way_without_balise":
        return "no run is long enough" if not counts.trials else "no event on ways long enough; that is no proof"
    if not counts.held_s and not counts.trials:
        return "nothing recorded to which it applies"
    if not counts.known_s:
        return "the evidence says nothing of it: too wide, missing, or the position in doubt"
    if demand.shown is of_always:
        return "no exceedance was seen, and no number of hours proves a maximum that is demanded without a probability"
    if counts.events == 0 and counts.known_s < counts.held_s:
        return "too few runs or hours; part of the time the evidence does not say"
    return "too few runs or hours"


def _notes(runs: pl.DataFrame, outside_h: float, areas: pl.DataFrame | None, ahead_m: float) -> list[str]:
    """What the reader must know before the rows."""
    said = []
    failed = runs.filter(pl.col("status").cast(pl.String) == RunStatus.FAILED.value).height
    if failed:
        said.append(f"{failed} of {runs.height} rows of runs failed and are not counted.")
    if areas is None:
        said.append("Without areas (`--site` with areas.csv or areas.parquet) nothing is said of limits by area type.")
    blind = runs.filter(~pl.col("evidence").cast(pl.String).is_in(TRUTH).fill_null(value=False)).height
    if blind:
        said.append(
            f"{blind} of {runs.height} runs have no reference and no balise reads: they can show no error small."
        )
    settings = runs["config_digest"].n_unique()
    if settings > 1:
        said.append(
            f"{settings} configurations or vehicle files: trains may differ. Errors do not depend on where the front "
            "end is, but areas are looked up with one distance for all."
        )
    elif not ahead_m:
        said.append("Areas are looked up at the balise antenna; `--front-ahead` puts the front end ahead of it.")
    if outside_h and areas is not None:
        said.append(f"{outside_h:.3g} h lie outside all areas: no limit by area type applied there.")
    late = runs["latency_sigma_s"].null_count()
    if late:
        said.append(f"{late} of {runs.height} runs have no figure of latency: safe front ends are not widened for it.")
    said.append("Nothing is said of the rear end: the length of the train is not recorded.")
    return said


def for_reading(table: pl.DataFrame) -> pl.DataFrame:
    """The rows as they fit a screen: what was found of each requirement, and what it rests on."""
    drawn = pl.when(pl.col("demanded").str.starts_with("p >=")).then(pl.format("{}/{}", "kept", "trials"))
    solution = ["solution"] if table["solution"].n_unique() > 1 else []
    return table.select(
        *solution,
        pl.col("requirement"),
        pl.col("applies_to").alias("of"),
        pl.col("finding"),
        pl.col("events"),
        drawn.alias("runs kept"),
        pl.col("hours_needed").round_sig_figs(3).alias("hours needed"),
        pl.col("limit"),
    )
