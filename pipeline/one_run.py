"""The story of one run on one site, from its frames to the five tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import polars as pl

from pipeline.stages.evidence import TrainEvidence
from pipeline.stages.judge.judge import Judged, judge
from pipeline.stages.judge.judgement import JudgeInput
from pipeline.stages.matching import Match
from pipeline.stages.monitored import MonitoredSolution, monitor_solution
from pipeline.stages.prepare import PreparedRun, prepare
from pipeline.stages.run_row.lost_time import lost_columns
from pipeline.stages.run_row.summary import SolutionResults, failed_row, replay_notes, summarise
from pipeline.studies.plausibility.fit import Fit, accuracy_checks, clock_advice, refuted, required_fit, with_checks
from pipeline.studies.undetected.columns import Undetected, largest_unnoticed
from schemas.config import Configuration, Vehicle
from schemas.conform import shaped
from schemas.enums import Reason
from schemas.errors import InputError
from schemas.run import RunLog, RunTables, Site
from schemas.tables import TABLES

Tables = dict[str, pl.DataFrame]
"""Those of one solution, by name."""
Matches = dict[str, Match]
"""By solution: the one that is replayed, and the one, if any, that the channel monitor compares with it."""
Channel = dict[str, tuple[Fit, Match]]
"""The solution that the channel monitor compares with; empty without one."""


def replay(run: RunLog, site: Site, vehicle: Vehicle | None = None, config: Configuration | None = None) -> RunTables:
    """Replay one recorded run: match, align, monitor, detect balises, judge, summarise.

    Args:
        run: the run as `read_run` yields it.
        site: the site as `read_site` yields it.
        vehicle: antenna places [m], odometer scale [1] and latencies [s], as far as known; None: nothing is.
        config: the configuration; None: the defaults.

    Returns:
        The five tables of the run; a solution that cannot be replayed has a failed row in `runs` and no other.

    Raises:
        InputError: no solution can be replayed.

    Source:
        DOMAIN sections 2 to 5; CONTRACT section 3.
    """
    prepared = prepare(run, site, vehicle or Vehicle(), config or Configuration(), clock_advice)
    evidence = prepared.evidence()
    channel = _fit_channel_reference(prepared)
    errors: list[InputError] = []
    parts: list[Tables] = []
    # A solution at a time: of those done only the tables are kept.
    for solution in prepared.run.solutions():
        try:
            parts.append(_replay_solution(prepared, solution, channel, evidence))
        except InputError as error:
            # A receiver that never had a fix must not take the run's other solutions with it.
            errors.append(error)
            parts.append(_failed_tables(prepared, solution, error))
    if len(errors) == len(parts):
        raise errors[0]
    return RunTables(run_id=run.run_id, **(parts[0] if len(parts) == 1 else _below_one_another(parts)))


def _below_one_another(parts: Sequence[Tables]) -> Tables:
    """The tables of several solutions as one each."""
    return {name: pl.concat([shaped(part[name], schema) for part in parts]) for name, schema in TABLES.items()}


def monitor_alone(run: RunLog, site: Site, vehicle: Vehicle, config: Configuration, solution: str) -> MonitoredSolution:
    """What the train made of one solution, without a judge: for studies of what monitors could detect.

    Args:
        run: the run as `read_run` yields it.
        site: the site.
        vehicle: what is known of the vehicle.
        config: the configuration.
        solution: name of the solution.

    Returns:
        Alignment, monitors and detected balises, with the solution on its path.

    Raises:
        InputError: the run has no such solution, or it cannot be replayed.
    """
    if solution not in run.solutions():
        raise InputError("has no such solution", place=run.run_id, found=solution, expected=", ".join(run.solutions()))
    prepared = prepare(run, site, vehicle, config, clock_advice)
    _, matches = _fit_and_match(prepared, solution, _fit_channel_reference(prepared))
    return monitor_solution(prepared, solution, matches, prepared.evidence())


def _fit_channel_reference(prepared: PreparedRun) -> Channel:
    """The fit and match of the solution that the channel monitor compares with, kept over all solutions.

    Empty where that solution does not fit the run or lies on no track: then it has a failed row of its own.
    """
    channel = prepared.config.monitors.channel_reference
    if channel is None or channel not in prepared.run.solutions():
        return {}
    try:
        return {channel: (required_fit(prepared, channel, prepared.vehicle), prepared.match(channel))}
    except InputError:
        return {}


def _fit_and_match(prepared: PreparedRun, solution: str, channel: Channel) -> tuple[Fit, Matches]:
    """How the solution fits the run, and its match beside that of the channel; raises `InputError` as both do."""
    known = channel.get(solution)
    fit, match = known or (required_fit(prepared, solution, prepared.vehicle), prepared.match(solution))
    return fit, {**{name: other for name, (_, other) in channel.items()}, solution: match}


def _replay_solution(prepared: PreparedRun, solution: str, channel: Channel, evidence: TrainEvidence) -> Tables:
    """The five tables of one solution: what the train made of it, what nobody would have noticed, what the judge says.

    Raises `InputError` where the solution does not fit the run or lies on no track.
    """
    fit, matches = _fit_and_match(prepared, solution, channel)
    monitored = monitor_solution(prepared, solution, matches, evidence)
    unnoticed = largest_unnoticed(monitored)
    judged = judge(_judge_input(monitored, unnoticed, evidence, fit.leaps_s(evidence.shares_odometer_clock)))
    results = _collect_results(monitored, judged, unnoticed, fit, evidence)
    suspect = pl.Series("suspect_after_the_fact", judged.suspect_after_the_fact)
    of_fixes = monitored.solution.fixes["satellites"]
    columns = (suspect, *results.lost.columns(), of_fixes, *unnoticed.epochs)
    return {
        "hazards": judged.hazards,
        "passages": judged.passages,
        "alarms": judged.alarms,
        "epochs": pl.DataFrame([*judged.epochs.contract_series(), *columns]),
        "runs": summarise(results, prepared.config, prepared.provenance),
    }


def _judge_input(
    monitored: MonitoredSolution, unnoticed: Undetected, evidence: TrainEvidence, leaps_s: Sequence[int]
) -> JudgeInput:
    """What the judge is given of one solution."""
    replayed = monitored.solution
    run = monitored.prepared.run
    return JudgeInput(
        solution=replace(replayed, passages=replayed.passages.with_columns(unnoticed.passages)),
        evidence=evidence,
        odometry=monitored.odometry,
        vehicle=monitored.prepared.vehicle,
        config=monitored.prepared.config,
        reference=run.reference,
        faults=run.faults,
        leaps_s=tuple(leaps_s),
    )


def _collect_results(
    monitored: MonitoredSolution, judged: Judged, unnoticed: Undetected, fit: Fit, evidence: TrainEvidence
) -> SolutionResults:
    """All that the `runs` row of one solution is made of: figures, notes, and the reasons against a verdict."""
    prepared = monitored.prepared
    run = prepared.run
    accuracy = accuracy_checks(judged.epochs, run.faults, prepared.config)
    fit = with_checks(fit, accuracy)
    counts = prepared.counts.solutions[monitored.solution.name]
    odometry = prepared.odometry
    columns = {
        "vehicle": prepared.figures_from,
        "faults_injected": run.faults is not None and run.faults.height > 0,
        "misfits": fit.codes,
        "duplicates": counts.duplicates,
        "out_of_order": counts.out_of_order,
        "odometer_contradicted": evidence.count_contradicted_gaps,
        "odometer_origin": None if odometry is None else odometry.origin,
        "odometer_follows": prepared.follows_of(monitored.solution.name).ratio,
        "ambiguous_stretches": monitored.match.ambiguous.height,
        **monitored.at_the_end(),
        **monitored.bank.white_noise(),
        **unnoticed.figures(judged.epochs, prepared.config),
    }
    # What stands against a verdict whatever was judged (DOMAIN section 5.4).
    against = {
        Reason.ODOMETER_ORIGIN_UNKNOWN: odometry is not None and not odometry.origin.independent,
        Reason.ODOMETER_FOLLOWS_GNSS: odometry is not None and odometry.follows_gnss,
        Reason.EVIDENCE_DISPUTED: evidence.count_disputed_reads > 0 or evidence.odometers_disagree,
        Reason.EVIDENCE_CONTRADICTED: evidence.contradiction_count > 0,
        Reason.TRACK_ASSUMED: _rests_on_assumed_track(judged),
        Reason.SIGMA_DOUBTFUL: refuted(accuracy),
        Reason.INPUT_DOUBTFUL: bool(
            fit.unproving or fit.leaps_s(evidence.shares_odometer_clock) or counts.contradicting
        ),
        Reason.CLOCK_ASSUMED: evidence.clock_assumed,
    }
    return SolutionResults(
        solution=monitored.solution.name,
        lost=lost_columns(judged.epochs, prepared.config),
        judged=judged,
        undetected=unnoticed.epochs,
        columns=columns,
        ingest=run.notes,
        notes=[*fit.notes, *replay_notes(monitored, evidence)],
        reasons=[reason for reason, applies in against.items() if applies],
        anchored_ns=evidence.anchored_span_ns,
        clock_open_s=evidence.clock_open_s,
    )


def _rests_on_assumed_track(judged: Judged) -> bool:
    """Whether a position in use or an accepted balise is right only if the train's track is the surveyed one."""
    used = judged.epochs.in_use & judged.epochs.judgements.track_assumed
    return bool(used.any() or (judged.offers.accepted & judged.offers.judged.track_assumed).any())


def _failed_tables(prepared: PreparedRun, solution: str, error: InputError) -> Tables:
    """The five tables of a solution that cannot be replayed: empty but for the `runs` row that says why."""
    nothing = {name: table.create_empty() for name, table in TABLES.items()}
    return nothing | {"runs": shaped(failed_row(str(error), prepared.provenance, solution), TABLES["runs"])}
