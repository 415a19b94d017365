"""The main job: one run on one site, from its frames to the five tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.read.ingest.clean import CleanCounts, clean, of_the_journey, require_one_journey, require_two_times
from pipeline.results.provenance import Provenance, provenance
from pipeline.stages.alignment.align import align, odometer_at
from pipeline.stages.evidence import Evidence, evidence_of
from pipeline.stages.judge.case import Case, Solution
from pipeline.stages.judge.epochs import direction_by_evidence
from pipeline.stages.judge.judge import Judged, judge
from pipeline.stages.lds.run import LdsResult, run_lds
from pipeline.stages.matching import Match, match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.monitors.pseudorange import pseudorange_monitor
from pipeline.stages.monitors.single import NO_OTHER_SOLUTION, channel_monitor, doppler_monitor, on_path_of
from pipeline.stages.odometry import Odometry, counted_over_slip, odometry_of
from pipeline.stages.reference import reference_stretches
from pipeline.stages.run_row.notes import ride_notes
from pipeline.stages.run_row.summary import SolutionResults, failed_row, summarise
from pipeline.stages.run_row.undetected import Spacing
from pipeline.stages.track.network import network_in_pieces, site_network
from pipeline.studies.plausibility.fit import Fit, fit_run, refuse_impossible
from pipeline.studies.undetected.columns import Diagnosis, undetected_of
from pipeline.studies.undetected.watched import fixes_ns
from schemas.config import Configuration, Vehicle
from schemas.conform import conform, shaped
from schemas.enums import NotEvaluated, Reason, VehicleFigures
from schemas.errors import InputError
from schemas.run import RunLog, RunTables, Site
from schemas.tables import TABLES


@dataclass(frozen=True)
class _Context:
    """What every solution of a run shares."""

    run: RunLog
    site: Site
    vehicle: Vehicle
    config: Configuration
    counts: CleanCounts
    fits: dict[str, Fit]
    odometry: Odometry | None
    evidence: Evidence

    def fixes(self, solution: str) -> pl.DataFrame:
        return self.run.gnss.filter(pl.col("solution") == solution)

    def ranges(self, solution: str) -> pl.DataFrame | None:
        satellites = self.run.satellites
        return None if satellites is None else satellites.filter(pl.col("solution") == solution)

    @property
    def provenance(self) -> Provenance:
        return provenance(self.run, self.site, self.vehicle, self.config)

    @property
    def figures_from(self) -> VehicleFigures:
        """Where scale and latency come from (DOMAIN section 5.4)."""
        if self.odometry is None:
            return VehicleFigures.NONE
        given = self.vehicle.odometer_scale is not None and self.vehicle.gnss_latency_s is not None
        return VehicleFigures.FILE if given else VehicleFigures.LEARNED


_AT_THE_END = ("latency_s", "latency_sigma_s", "odometer_scale")
Tables = dict[str, pl.DataFrame]
"""Those of one solution, by name."""


def replay(run: RunLog, site: Site, vehicle: Vehicle | None = None, config: Configuration | None = None) -> RunTables:
    """Replay one recorded run: match, align, monitor, detect balises, judge, summarise.

    `run` as `read_run` yields it, `site` as `read_site` does. A solution that cannot be replayed has a failed row and
    leaves the others alone; raises `InputError` where none can be.
    """
    context = _context(run, site, vehicle or Vehicle(), config or Configuration())
    matches, errors = _matches(context)
    parts = [
        _failed(context, name, errors[name]) if name in errors else _replay_solution(context, name, matches)
        for name in context.run.solutions()
    ]
    return _tables(run.run_id, parts)


def diagnosed(
    run: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str
) -> tuple[Diagnosis, pl.DataFrame, pl.DataFrame]:
    """What watched one solution of a run, with its passages and crossings as the LDS made them."""
    if solution not in run.solutions():
        raise InputError("has no such solution", place=run.run_id, found=solution, expected=", ".join(run.solutions()))
    context = _context(run, site, vehicle, config)
    ride = _ride(context, solution, _matches(context)[0])
    return ride.diagnosis, ride.lds.passages, ride.lds.crossings


def _context(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration) -> _Context:
    """The run in order, whether it fits, its odometer, and what is known of where the train was."""
    cleaned, counts = clean(run, config)
    fits = {name: fit_run(cleaned, name, vehicle, config.plausibility, site) for name in cleaned.solutions()}
    cleaned = of_the_journey(cleaned)
    odometry = odometry_of(cleaned.odometer, vehicle, config)
    others = [odometry_of(stream, Vehicle(), config) for stream in cleaned.other_odometers]
    odometers = [one for one in (odometry, *others) if one is not None]
    evidence = _evidence(cleaned, odometers, site, vehicle, config)
    counted = None if odometry is None else counted_over_slip(odometry, odometers[1:], config.align)
    return _Context(cleaned, site, vehicle, config, counts, fits, counted, evidence)


def _evidence(
    run: RunLog, odometers: Sequence[Odometry], site: Site, vehicle: Vehicle, config: Configuration
) -> Evidence:
    """What is known of where the train was, once per run; figures of the vehicle file are of the first odometer."""
    network = site_network(site)
    reference = reference_stretches(run.reference, network_in_pieces(site), network.track.index, config)
    return evidence_of(reference, run.balise_reads, site.balises, odometers, network, vehicle, config)


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
    run, fixes = context.run, context.fixes(solution)
    require_two_times(fixes, "gnss", f" of solution {solution!r}")
    require_one_journey(fixes, f"gnss of solution {solution!r}")
    refuse_impossible(context.fits[solution], f"{run.run_id}: solution {solution!r}", context.config.ingest)
    return match(
        fixes,
        context.odometry,
        context.site,
        context.vehicle,
        context.config.matching,
        context.config.fix_sigma,
        run.balise_reads,
    )


def _failed(context: _Context, solution: str, error: InputError) -> Tables:
    """A solution without content but for the row that says why."""
    nothing = {name: table.create_empty() for name, table in TABLES.items()}
    return nothing | {"runs": failed_row(str(error), context.provenance, solution)}


def _replay_solution(context: _Context, solution: str, matches: dict[str, Match]) -> Tables:
    """One solution: what the train made of it, then what the judge says of that."""
    ride = _ride(context, solution, matches)
    case = Case(
        solution=ride.solution,
        evidence=context.evidence,
        odometry=ride.odometry,
        vehicle=context.vehicle,
        config=context.config,
        reference=context.run.reference,
        faults=context.run.faults,
    )
    judged = judge(case)
    epochs = pl.concat([judged.epochs, ride.solution.fixes.select("satellites")], how="horizontal")
    row = summarise(_results(context, ride, judged, epochs), context.config, context.provenance)
    found = {"hazards": judged.hazards, "passages": judged.passages, "alarms": judged.alarms}
    return {**found, "epochs": epochs, "runs": row}


@dataclass(frozen=True)
class _Ride:
    """One solution as the train saw it, before anything is known of the truth; `odometry` grows with its path."""

    solution: Solution
    found: Match
    aligned: pl.DataFrame
    lds: LdsResult
    odometry: Odometry | None
    diagnosis: Diagnosis
    white_noise: dict[str, float | None]
    spacing: Spacing | None


def _ride(context: _Context, solution: str, matches: dict[str, Match]) -> _Ride:
    """What the train makes of one solution: aligned with the odometer, monitored, detected at balises."""
    config, found = context.config, matches[solution]
    odometry = None if context.odometry is None else context.odometry.oriented(found.odometer_sign)
    aligned = align(found.epochs, odometry, context.vehicle, config)
    if odometry is None:
        # Virtual balises may be valid in one direction, and that is the train's: no position's step (DOMAIN section 4).
        aligned = aligned.with_columns(direction_by_evidence(_undecided(context, solution, aligned, found)))
    compared = _compared(context, solution, aligned, matches)
    singles = _single_monitors(context, solution, aligned, compared)
    bank = MonitorBank(aligned, singles, config)
    balises = found.path.balises(context.site.balises)
    reads = _reads_on_odometer(context.run.balise_reads, aligned, odometry)
    scale_sigma = None if odometry is None else odometry.scale_sigma
    lds = run_lds(aligned, bank, balises, reads, scale_sigma, config, solution)
    seen = pl.concat([aligned, lds.epochs.drop("t")], how="horizontal")
    diagnosis = Diagnosis(
        epochs=seen,
        bank=bank.along(),
        held=lds.held,
        channel=singles["channel"],
        other=compared,
        satellites=context.ranges(solution),
        fixes_ns=fixes_ns(context.run, lds.crossings, config.lds.starts_of_mission, config.undetected),
    )
    unnoticed = undetected_of(diagnosis, lds.passages, lds.crossings, context.vehicle, config)
    monitored = pl.concat([seen, pl.DataFrame(bank.columns()), unnoticed.epochs], how="horizontal")
    passages = lds.passages.with_columns(unnoticed.passages)
    taken = Solution(solution, context.fixes(solution), monitored, lds.crossings, passages, balises, found.path)
    return _Ride(taken, found, aligned, lds, odometry, diagnosis, bank.white_noise(), unnoticed.spacing)


def _undecided(context: _Context, solution: str, aligned: pl.DataFrame, found: Match) -> Case:
    """Positions and evidence of a solution of which nothing is decided yet."""
    nothing = pl.DataFrame()
    given = Solution(solution, context.fixes(solution), aligned, nothing, nothing, nothing, found.path)
    return Case(given, context.evidence, None, context.vehicle, context.config)


def _reads_on_odometer(
    reads: pl.DataFrame | None, aligned: pl.DataFrame, odometry: Odometry | None
) -> pl.DataFrame | None:
    """Telegrams with the odometer at each, on the scale of `aligned`."""
    if reads is None or odometry is None:
        return reads
    return reads.with_columns(odometer_at(reads["t"], aligned, odometry))


def _results(context: _Context, ride: _Ride, judged: Judged, epochs: pl.DataFrame) -> SolutionResults:
    name = ride.solution.name
    counts, fit = context.counts.solutions[name], context.fits[name]
    notes = ride_notes(
        context.run,
        context.site,
        counts,
        ride.solution.fixes,
        ride.found,
        ride.aligned,
        ride.lds,
        context.vehicle,
        context.odometry,
        fit,
        context.evidence,
        context.config,
    )
    return SolutionResults(
        solution=name,
        epochs=epochs,
        judged=judged,
        vehicle=context.figures_from,
        odometer_contradicted=context.evidence.contradicted,
        alignment=ride.aligned.select(*_AT_THE_END, odometer_scale_sigma="scale_sigma").row(-1, named=True),
        white_noise=ride.white_noise,
        counts=counts,
        ingest=context.run.notes,
        ambiguous_stretches=ride.found.ambiguous.height,
        notes=notes,
        misfits=[cause.code for check in fit.misfits for cause in check.causes],
        faults_injected=context.run.faults is not None and context.run.faults.height > 0,
        spacing=ride.spacing,
        reasons=_reasons(context, name),
        anchored_ns=context.evidence.anchored_ns,
    )


def _reasons(context: _Context, solution: str) -> list[Reason]:
    """What stands against a verdict whatever was judged (DOMAIN section 5.4)."""
    doubtful = context.fits[solution].unproving or context.counts.solutions[solution].contradicting
    applies = {
        Reason.EVIDENCE_DISPUTED: context.evidence.disputed > 0,
        Reason.INPUT_DOUBTFUL: bool(doubtful),
        Reason.CLOCK_ASSUMED: context.evidence.clock_assumed,
    }
    return [reason for reason, applied in applies.items() if applied]


def _single_monitors(
    context: _Context, solution: str, aligned: pl.DataFrame, compared: pl.DataFrame | None
) -> dict[str, pl.DataFrame]:
    other = context.config.monitors.channel_reference
    ranges = context.ranges(solution)
    absent = NO_OTHER_SOLUTION if other in (None, solution) else NotEvaluated.OTHER_NOT_RECORDED
    return {
        "along_doppler": doppler_monitor(aligned, context.config),
        "channel": channel_monitor(aligned, compared, context.config, absent),
        "pseudorange": pseudorange_monitor(aligned, ranges, context.config),
    }


def _compared(
    context: _Context, solution: str, aligned: pl.DataFrame, matches: dict[str, Match]
) -> pl.DataFrame | None:
    """The solution to compare with, on this one's path; none where none is named or the run has it not."""
    other = context.config.monitors.channel_reference
    if other is None or other == solution or other not in matches:
        return None
    return on_path_of(aligned, matches[other].epochs, context.config.lds)


def _tables(run_id: str, parts: list[Tables]) -> RunTables:
    """Rows of all solutions, by the contract."""
    whole = {
        name: conform(pl.concat([shaped(part[name], table) for part in parts]), table) for name, table in TABLES.items()
    }
    return RunTables(run_id=run_id, **whole)
