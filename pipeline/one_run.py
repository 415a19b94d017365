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
from pipeline.studies.undetected.columns import Undetected, unnoticed_of
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
    beside = _compared_with(prepared)
    # A solution at a time: of those done only the tables are kept.
    parts = {name: _of_solution(prepared, name, beside, evidence) for name in prepared.run.solutions()}
    errors = [part for part in parts.values() if isinstance(part, InputError)]
    if len(errors) == len(parts):
        raise errors[0]
    return _joined(
        run.run_id, [part if isinstance(part, dict) else _failed(prepared, name, part) for name, part in parts.items()]
    )


def ride_alone(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str) -> Ride:
    """What the train made of one solution, without a judge: for studies of what the monitors could have seen."""
    if solution not in run.solutions():
        raise InputError("has no such solution", place=run.run_id, found=solution, expected=", ".join(run.solutions()))
    prepared = prepare(run, site, vehicle, config, clock_advice)
    placed = _place(prepared, solution)
    if isinstance(placed, InputError):
        raise placed
    return ride_of(prepared, solution, _matches(solution, placed, _compared_with(prepared)), prepared.evidence())


@dataclass(frozen=True)
class _Placed:
    """A solution that fits its run and lies on the track."""

    fit: Fit
    match: Match


Beside = Mapping[str, "_Placed | InputError"]
"""By name: the one solution, if any, that the channel monitor compares the others with."""


def _compared_with(prepared: PreparedRun) -> Beside:
    """Placed once, and the only match that is kept over all solutions."""
    channel = prepared.config.monitors.channel_reference
    return {channel: _place(prepared, channel)} if channel in prepared.run.solutions() else {}


def _place(prepared: PreparedRun, solution: str) -> _Placed | InputError:
    """Does the solution fit the run, and where is it on the track network? Else why not."""
    try:
        return _Placed(required_fit(prepared, solution, prepared.vehicle), prepared.match(solution))
    except InputError as error:
        # A receiver that never had a fix must not take the run's other solutions with it.
        return error


def _matches(solution: str, placed: _Placed, beside: Beside) -> dict[str, Match]:
    """The matches that a ride looks at."""
    others = {name: other.match for name, other in beside.items() if isinstance(other, _Placed)}
    return {**others, solution: placed.match}


def _of_solution(prepared: PreparedRun, solution: str, beside: Beside, evidence: TrainEvidence) -> Tables | InputError:
    """What the train made of one solution, what nobody would have noticed, and what the judge says of it."""
    placed = beside.get(solution) or _place(prepared, solution)
    if isinstance(placed, InputError):
        return placed
    ride = ride_of(prepared, solution, _matches(solution, placed, beside), evidence)
    unnoticed = unnoticed_of(ride)
    judged = judge(_case(ride, unnoticed, evidence))
    epochs = pl.concat([judged.epochs, ride.solution.fixes.select("satellites")], how="horizontal")
    results = _results(ride, judged, epochs, unnoticed, placed.fit, evidence)
    tables = {
        "hazards": judged.hazards,
        "passages": judged.passages,
        "alarms": judged.alarms,
        "epochs": epochs,
        "runs": summarise(results, prepared.config, prepared.provenance),
    }
    # Judged epochs have more columns than the contract: those end here.
    return {name: shaped(table, TABLES[name]) for name, table in tables.items()}


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
    whole = {name: conform(pl.concat([part[name] for part in parts]), table) for name, table in TABLES.items()}
    return RunTables(run_id=run_id, **whole)
