"""The story of one run on one site, from its frames to the five tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import polars as pl

from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.judge import Judged, judge
from pipeline.stages.matching import Match
from pipeline.stages.prepare import PreparedRun, prepare
from pipeline.stages.ride import Ride, ride_of
from pipeline.stages.run_row.notes import ride_notes
from pipeline.stages.run_row.summary import SolutionResults, failed_row, summarise
from pipeline.studies.plausibility.fit import Fit, clock_advice, required_fit
from pipeline.studies.undetected.columns import Undetected
from pipeline.studies.undetected.ride import unnoticed_of
from schemas.config import Configuration, Vehicle
from schemas.conform import conform, shaped
from schemas.enums import Reason
from schemas.errors import InputError
from schemas.run import RunLog, RunTables, Site
from schemas.tables import TABLES

Tables = dict[str, pl.DataFrame]
"""Those of one solution, by name."""


def replay(run: RunLog, site: Site, vehicle: Vehicle | None = None, config: Configuration | None = None) -> RunTables:
    """Replay one recorded run: match, align, monitor, detect balises, judge, summarise.

    `run` as `read_run` yields it, `site` as `read_site` does. A solution that cannot be replayed has a failed row and
    leaves the others alone; raises `InputError` where none can be.
    """
    prepared = prepare(run, site, vehicle or Vehicle(), config or Configuration(), clock_advice)
    evidence = prepared.evidence()
    placed = _place_solutions(prepared)
    tables = [
        _failed(prepared, name, placed.errors[name])
        if name in placed.errors
        else _replay_solution(prepared, name, placed, evidence)
        for name in prepared.run.solutions()
    ]
    return _joined(run.run_id, tables)


def ride_alone(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str) -> Ride:
    """What the train made of one solution, without a judge: for studies of what the monitors could have seen."""
    if solution not in run.solutions():
        raise InputError("has no such solution", place=run.run_id, found=solution, expected=", ".join(run.solutions()))
    prepared = prepare(run, site, vehicle, config, clock_advice)
    placed = _place_solutions(prepared)
    if solution in placed.errors:
        raise placed.errors[solution]
    return ride_of(prepared, solution, placed.matches, prepared.evidence())


@dataclass(frozen=True)
class _Placed:
    """Solutions that fit their run and lie on the track, by name, and why the others do not."""

    fits: Mapping[str, Fit]
    matches: Mapping[str, Match]
    errors: Mapping[str, InputError]


def _place_solutions(prepared: PreparedRun) -> _Placed:
    """Does each solution fit the run, and where is it on the track network?"""
    fits: dict[str, Fit] = {}
    matches: dict[str, Match] = {}
    errors: dict[str, InputError] = {}
    for name in prepared.run.solutions():
        try:
            fits[name] = required_fit(prepared, name, prepared.vehicle)
            matches[name] = prepared.match(name)
        except InputError as error:
            # A receiver that never had a fix must not take the run's other solutions with it.
            errors[name] = error
    if not matches:
        raise next(iter(errors.values()))
    return _Placed(fits, matches, errors)


def _replay_solution(prepared: PreparedRun, solution: str, placed: _Placed, evidence: TrainEvidence) -> Tables:
    """What the train made of one solution, what nobody would have noticed, and what the judge says of it."""
    ride = ride_of(prepared, solution, placed.matches, evidence)
    unnoticed = unnoticed_of(ride)
    judged = judge(_case(ride, unnoticed, evidence))
    epochs = pl.concat([judged.epochs, ride.solution.fixes.select("satellites")], how="horizontal")
    results = _results(ride, judged, epochs, unnoticed, placed.fits[solution], evidence)
    tables = {"hazards": judged.hazards, "passages": judged.passages, "alarms": judged.alarms, "epochs": epochs}
    return {**tables, "runs": summarise(results, prepared.config, prepared.provenance)}


def _case(ride: Ride, unnoticed: Undetected, evidence: TrainEvidence) -> Case:
    """The solution before the judge."""
    replayed = ride.solution
    run = ride.prepared.run
    epochs = pl.concat([replayed.epochs, unnoticed.epochs], how="horizontal")
    return Case(
        solution=replace(replayed, epochs=epochs, passages=replayed.passages.with_columns(unnoticed.passages)),
        evidence=evidence,
        odometry=ride.odometry,
        vehicle=ride.prepared.vehicle,
        config=ride.prepared.config,
        reference=run.reference,
        faults=run.faults,
    )


def _results(
    ride: Ride, judged: Judged, epochs: pl.DataFrame, unnoticed: Undetected, fit: Fit, evidence: TrainEvidence
) -> SolutionResults:
    """All that the `runs` row is made of."""
    prepared = ride.prepared
    name = ride.solution.name
    run = prepared.run
    counts = prepared.counts.solutions[name]
    return SolutionResults(
        solution=name,
        epochs=epochs,
        judged=judged,
        vehicle=prepared.figures_from,
        odometer_contradicted=evidence.contradicted,
        alignment=ride.at_the_end(),
        white_noise=ride.bank.white_noise(),
        counts=counts,
        ingest=run.notes,
        ambiguous_stretches=ride.match.ambiguous.height,
        notes=[*fit.notes, *ride_notes(ride, evidence)],
        misfits=fit.codes,
        faults_injected=run.faults is not None and run.faults.height > 0,
        undetected=unnoticed.figures(epochs, prepared.config),
        reasons=_reasons(evidence, bool(fit.unproving or counts.contradicting)),
        anchored_ns=evidence.anchored_ns,
    )


def _reasons(evidence: TrainEvidence, doubtful: bool) -> list[Reason]:
    """What stands against a verdict whatever was judged (DOMAIN section 5.4)."""
    applies = {
        Reason.EVIDENCE_DISPUTED: evidence.disputed > 0,
        Reason.INPUT_DOUBTFUL: doubtful,
        Reason.CLOCK_ASSUMED: evidence.clock_assumed,
    }
    return [reason for reason, applied in applies.items() if applied]


def _failed(prepared: PreparedRun, solution: str, error: InputError) -> Tables:
    """A solution without content but for the row that says why."""
    nothing = {name: table.create_empty() for name, table in TABLES.items()}
    return nothing | {"runs": failed_row(str(error), prepared.provenance, solution)}


def _joined(run_id: str, parts: list[Tables]) -> RunTables:
    """Rows of all solutions, by the contract."""
    whole = {
        name: conform(pl.concat([shaped(part[name], table) for part in parts]), table) for name, table in TABLES.items()
    }
    return RunTables(run_id=run_id, **whole)
