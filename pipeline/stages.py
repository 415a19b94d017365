"""The main job: one run on one site, from its frames to the five tables."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.alignment.align import align, odometer_at
from pipeline.figures.bounds import threshold_factor
from pipeline.figures.evidence_notes import evidence_notes, motion_notes, reading_notes, return_notes, undiagnosed_notes
from pipeline.figures.run_notes import run_notes
from pipeline.figures.summary import Alignment, SolutionResults, failed_row, summarise
from pipeline.hazards import Case, HazardResult, classify, establish_truth, places_between, with_unoffered
from pipeline.ingest.clean import CleanCounts, clean, require_one_journey, require_two_times
from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.run import LdsResult, run_lds
from pipeline.lds.telegrams import place_reads, places_near
from pipeline.matching import Match, match
from pipeline.monitors.bank import MonitorBank
from pipeline.monitors.channels import on_path_of
from pipeline.monitors.pseudorange import pseudorange_monitor
from pipeline.monitors.single import NO_OTHER_SOLUTION, channel_monitor, doppler_monitor
from pipeline.motion import Motion, motion_of, void_evidence
from pipeline.odometry import Odometry, odometry_of
from pipeline.results.provenance import provenance
from schemas.config import Configuration, Vehicle
from schemas.conform import conform, shaped
from schemas.enums import Evidence
from schemas.errors import InputError
from schemas.run import RunLog, RunTables, Site
from schemas.tables import TABLES


@dataclass(frozen=True)
class _Solution:
    """Tables of one solution."""

    epochs: pl.DataFrame
    result: HazardResult
    summary: pl.DataFrame


@dataclass(frozen=True)
class _Context:
    """What every solution of a run shares."""

    run: RunLog
    site: Site
    vehicle: Vehicle
    config: Configuration
    counts: CleanCounts
    factor: float
    odometry: Odometry | None


@dataclass(frozen=True)
class _Ride:
    """One solution on its way, before anything is known of the truth.

    `balises`: those on the path; `aligned`: epochs before the monitors; `monitored`: with their columns and those of
    the LDS; `telegrams`: reads of physical balises, none where the run has no such stream;
    `odometry`: growing with the path.
    """

    solution: str
    fixes: pl.DataFrame
    found: Match
    balises: pl.DataFrame
    aligned: pl.DataFrame
    monitored: pl.DataFrame
    telegrams: pl.DataFrame | None
    lds: LdsResult
    odometry: Odometry | None


def replay(run: RunLog, site: Site, vehicle: Vehicle | None = None, config: Configuration | None = None) -> RunTables:
    """Replay one recorded run: match, align, monitor, detect balises, classify hazards, summarise.

    `run` as `pipeline.ingest.read_run` yields it, `site` as `read_site` does. A solution that cannot be replayed has
    a failed row and leaves the others alone; raises `InputError` where none can be.
    """
    config = config or Configuration()
    cleaned, counts = clean(run)
    factor = threshold_factor(config.monitors.false_alarm_probability)
    vehicle = vehicle or Vehicle()
    odometry = odometry_of(cleaned.odometer, vehicle, config)
    context = _Context(cleaned, site, vehicle, config, counts, factor, odometry)
    matches, errors = _matches(context)
    parts = [
        _failed(context, name, errors[name]) if name in errors else _replay_solution(context, name, matches)
        for name in cleaned.solutions()
    ]
    return _tables(run.run_id, parts)


def _matches(context: _Context) -> tuple[dict[str, Match], dict[str, InputError]]:
    """Every solution on the track, and why those that are not could not be."""
    matches: dict[str, Match] = {}
    errors: dict[str, InputError] = {}
    for name in context.run.solutions():
        try:
            matches[name] = _match(context, name)
        except InputError as error:
            # A receiver that never had a fix must not take the run's other solutions with it.
            errors[name] = error
    if not matches:
        raise next(iter(errors.values()))
    return matches, errors


def _match(context: _Context, solution: str) -> Match:
    run = context.run
    fixes = run.gnss.filter(pl.col("solution") == solution)
    require_two_times(fixes, "gnss", f" of solution {solution!r}")
    require_one_journey(fixes, f"gnss of solution {solution!r}")
    return match(
        fixes,
        context.odometry,
        context.site,
        context.vehicle,
        context.config.matching,
        context.config.fix_sigma,
        run.balise_reads,
    )


def _failed(context: _Context, solution: str, error: InputError) -> _Solution:
    """A solution without content but for the row that says why."""
    made = provenance(context.run, context.site, context.vehicle, context.config)
    nothing = {name: table.create_empty() for name, table in TABLES.items()}
    result = HazardResult(nothing["hazards"], nothing["alarms"], nothing["passages"], nothing["epochs"].select([]))
    return _Solution(nothing["epochs"], result, failed_row(str(error), made, solution))


def _replay_solution(context: _Context, solution: str, matches: dict[str, Match]) -> _Solution:
    ride = _ride(context, solution, matches)
    case, motion = _case(context, ride)
    result = classify(case)
    epochs = pl.concat([case.epochs, result.epochs_columns], how="horizontal")
    results = SolutionResults(
        solution=solution,
        epochs=epochs,
        passages=result.passages,
        hazards=result.hazards,
        alarms=result.alarms,
        motion=motion,
        evidence=_evidence(case.truth),
        alignment=_alignment(ride.aligned),
        counts=context.counts.solutions[solution],
        ingest=context.run.notes,
        ambiguous_stretches=ride.found.ambiguous.height,
        notes=(*_notes(context, ride, case.truth, result, epochs), *motion_notes(motion, epochs)),
    )
    made = provenance(context.run, context.site, context.vehicle, context.config)
    return _Solution(epochs, result, summarise(results, context.config, made))


def _ride(context: _Context, solution: str, matches: dict[str, Match]) -> _Ride:
    run, config, found = context.run, context.config, matches[solution]
    balises = found.path.balises(context.site.balises)
    fixes = run.gnss.filter(pl.col("solution") == solution)
    odometry = None if context.odometry is None else context.odometry.oriented(found.odometer_sign)
    aligned = align(found.epochs, odometry, context.vehicle, config)
    bank = MonitorBank(aligned, _single_monitors(context, solution, aligned, matches), config, context.factor)
    telegrams = place_reads(run.balise_reads, aligned, balises, odometry)
    lds = run_lds(aligned, bank, balises, telegrams, config.lds, LdsLimits.of(config), solution)
    monitored = pl.concat([aligned, pl.DataFrame(bank.columns()), lds.epochs.drop("t")], how="horizontal")
    return _Ride(solution, fixes, found, balises, aligned, monitored, telegrams, lds, odometry)


def _case(context: _Context, ride: _Ride) -> tuple[Case, Motion]:
    """The ride with the truth beside it, how the train moved by it, and what it passed unoffered."""
    config = context.config
    reference = _reference_on_path(context, ride.found, ride.aligned)
    reads = None if ride.telegrams is None else ride.telegrams.drop_nulls("path_m")
    truth = establish_truth(ride.monitored, reference, reads, ride.lds.passages, config)
    motion = motion_of(ride.monitored, truth, config)
    epochs = ride.monitored.with_columns(motion.columns())
    between = _between(context, ride, truth, reference, reads)
    passages = with_unoffered(ride.lds.passages, epochs, truth, ride.balises, config.lds, ride.solution, between)
    case = Case(
        solution=ride.solution,
        epochs=epochs,
        truth=truth,
        passages=passages,
        balises=ride.balises,
        faults=context.run.faults,
        locate=ride.found.path.locate,
        config=config,
        between=between,
        void=void_evidence(motion, epochs, truth, passages),
    )
    return case, motion


def _notes(
    context: _Context, ride: _Ride, truth: pl.DataFrame, result: HazardResult, epochs: pl.DataFrame
) -> tuple[str, ...]:
    """What the reader should know beside the figures."""
    limit_m = context.config.hazards.failure_limit_m
    counts = context.counts.solutions[ride.solution]
    return (
        *run_notes(
            context.run,
            context.site,
            counts,
            ride.fixes,
            ride.found,
            ride.lds,
            context.vehicle,
            context.odometry,
            context.config.align.straight_s,
        ),
        *reading_notes(ride.aligned, context.config),
        *evidence_notes(ride.aligned, truth, limit_m),
        *return_notes(epochs, result.hazards, limit_m),
        *undiagnosed_notes(epochs, result.passages),
    )


def _evidence(truth: pl.DataFrame) -> Evidence | None:
    """The kind of evidence that most epochs rest on."""
    kinds = truth["evidence"].drop_nulls().value_counts(sort=True)
    return Evidence(kinds["evidence"][0]) if kinds.height else None


def _alignment(aligned: pl.DataFrame) -> Alignment:
    """Scale and latency as they stand at the end of the run."""
    names = ("latency_s", "latency_sigma_s", "odometer_scale", "scale_sigma")
    return Alignment(*(aligned[name][-1] for name in names))


def _single_monitors(
    context: _Context, solution: str, aligned: pl.DataFrame, matches: dict[str, Match]
) -> dict[str, pl.DataFrame]:
    other = context.config.monitors.channel_reference
    satellites = context.run.satellites
    ranges = None if satellites is None else satellites.filter(pl.col("solution") == solution)
    named = other in matches and other != solution
    compared = on_path_of(aligned, matches[other].epochs) if other is not None and named else None
    absent = NO_OTHER_SOLUTION if other in (None, solution) else f"the run has no solution {other!r} to compare with"
    return {
        "along_doppler": doppler_monitor(aligned, context.config, context.factor),
        "channel": channel_monitor(aligned, compared, context.factor, absent),
        "pseudorange": pseudorange_monitor(aligned, ranges, context.config),
    }


def _reference_on_path(context: _Context, found: Match, aligned: pl.DataFrame) -> pl.DataFrame | None:
    """The reference stream as path positions of the balise antenna, as the epochs are.

    Where the path comes back to a place, the epochs around say which passage of it is meant.
    """
    reference = context.run.reference
    if reference is None:
        return None
    leg, near_path_m = places_near(reference["t"], aligned) or (None, None)
    places = found.path.project(
        reference["latitude_deg"], reference["longitude_deg"], reference["height_m"], leg, near_path_m
    )
    return reference.select(
        "t",
        pl.Series("path_m", places.path_m - found.antenna_ahead_m, nan_to_null=True),
        pl.Series("cross_track_m", places.cross_m, nan_to_null=True),
        pl.Series("vertical_m", places.vertical_m - context.vehicle.antenna_height_m, nan_to_null=True),
        "sigma_m",
    )


def _between(
    context: _Context,
    ride: _Ride,
    truth: pl.DataFrame,
    reference: pl.DataFrame | None,
    reads: pl.DataFrame | None,
) -> pl.DataFrame | None:
    """Places inside gaps of the positions, by the streams that go on there."""

    def counted(times: pl.Series) -> pl.Series:
        unknown = pl.Series("odometer_m", [None] * times.len(), dtype=pl.Float64)
        return unknown if ride.odometry is None else odometer_at(times, ride.aligned, ride.odometry)

    return places_between(ride.aligned, truth, reference, reads, context.run.odometer, counted)


def _tables(run_id: str, solutions: list[_Solution]) -> RunTables:
    return RunTables(
        run_id=run_id,
        hazards=_table("hazards", [part.result.hazards for part in solutions]),
        passages=_table("passages", [part.result.passages for part in solutions]),
        alarms=_table("alarms", [part.result.alarms for part in solutions]),
        epochs=_table("epochs", [part.epochs for part in solutions]),
        runs=_table("runs", [part.summary for part in solutions]),
    )


def _table(name: str, parts: list[pl.DataFrame]) -> pl.DataFrame:
    """Rows of all solutions, by the contract."""
    return conform(pl.concat([shaped(part, TABLES[name]) for part in parts]), TABLES[name])
