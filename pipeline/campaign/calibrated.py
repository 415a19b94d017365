"""Vehicle and noise of each run from other runs of the same vehicle (`balise replay --calibrate`).

A run is measured once (`calibration.observe_run`), whoever uses it; a run never calibrates itself. Order and
number of processes change nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.campaign.plan import Plan, RunJob, find_runs, site_at
from pipeline.campaign.recorded_log import RecordedLog
from pipeline.read.site.route import with_route
from pipeline.results.workers import map_in_processes
from schemas.config import Configuration, digest_of
from schemas.errors import BaliseError, InputError, UsageError
from schemas.frozen import frozen

if TYPE_CHECKING:
    from pipeline.studies.calibration.calibrate import ObservedRun

AUTO = "auto"


@frozen
class _CalibrationRun:
    """A run that may calibrate others; `reason`: why it does not, empty where it does."""

    run_id: str
    content: str = ""
    observed: ObservedRun | None = None
    reason: str = ""


def calibrate_plan(plan: Plan, runs: Sequence[str], jobs: int = 1) -> Plan:
    """The plan with vehicle, noise and sigmas of each run as measured on the given runs.

    `runs`: paths, globs and folders, or `auto`: the runs of the plan itself that raise no alarm beyond their noise.
    Each run is left out of its own calibration. Raises `UsageError` where given runs cannot calibrate, are too few, or
    are of different vehicles.
    """
    automatic = list(runs) == [AUTO]
    sources = map_in_processes(_observe_job, _jobs_to_observe(plan, runs, automatic), jobs)
    refused = "; ".join(f"{source.run_id}: {source.reason}" for source in sources if source.reason)
    if refused and not automatic:
        raise UsageError("cannot calibrate", place="--calibrate", found=refused, expected="fault-free runs")
    good = [source for source in sources if not source.reason]
    _require_one_vehicle(good, plan.config)
    contents = {source.run_id: source.content for source in sources}
    made: dict[tuple[str, ...], RunJob] = {}
    finished = []
    for job in plan.jobs:
        content = contents.get(job.run_id)
        others = [source for source in good if source.run_id != job.run_id and source.content != content]
        names = tuple(source.run_id for source in others)
        if names not in made:
            _require_enough(job, len(others), refused)
            made[names] = _calibrate_job(job, others)
        like = made[names]
        finished.append(replace(job, config=like.config, vehicle=like.vehicle, config_digest=like.config_digest))
    whole = plan if len(made) != 1 else replace(plan, config=finished[0].config, vehicle=finished[0].vehicle)
    return replace(whole, jobs=tuple(finished))


def _jobs_to_observe(plan: Plan, runs: Sequence[str], automatic: bool) -> list[RunJob]:
    """The runs to observe, as jobs on the plan's site."""
    if automatic:
        return list(plan.jobs)
    try:
        addresses = find_runs(runs)
    except InputError as error:
        raise UsageError(error.message, place=error.place, expected=error.expected, remedy=error.remedy) from None
    model = replace(plan.jobs[0], route="", route_digest="", write_route="")
    return [replace(model, run_id=run_id, address=address) for run_id, address in addresses.items()]


def _observe_job(job: RunJob) -> _CalibrationRun:
    """What a run shows, or why it shows nothing; no error of a log ends the campaign here."""
    from pipeline.studies.calibration.calibrate import (
        observe_run,  # replays, which the parent of a campaign need not load
    )

    log = RecordedLog(job)
    try:
        with log.local_copy() as path:
            run = log.read(path)
        site = site_at(job.site, job.site_digest, job.config.site)
        site = with_route(site, job.route, job.config.site) if job.route else site
        observed = observe_run(run, site, job.vehicle, job.config, run.main_solution())
    except InputError as error:
        return _CalibrationRun(job.run_id, log.digest, reason=str(error))
    if observed.estimate is None:
        return _CalibrationRun(job.run_id, log.digest, reason="GNSS and odometer cannot be compared")
    if observed.alarms:
        return _CalibrationRun(job.run_id, log.digest, reason=f"alarms beyond its noise ({', '.join(observed.alarms)})")
    return _CalibrationRun(job.run_id, log.digest, observed)


def _calibrate_job(job: RunJob, sources: Sequence[_CalibrationRun]) -> RunJob:
    """The job with the calibration that other fault-free runs give."""
    from pipeline.studies.calibration.calibrate import combine_runs

    observed = [source.observed for source in sources if source.observed is not None]
    try:
        calibration = combine_runs(observed, job.vehicle, job.config)
    except BaliseError as error:
        raise UsageError(error.message, place=error.place, found=error.found, remedy=error.remedy) from None
    names = tuple(source.run_id for source in sources)
    changes = {
        "monitors": job.config.monitors.model_copy(update=calibration.monitors),
        "calibration": job.config.calibration.model_copy(update={"runs": names}),
    }
    config = job.config.model_copy(update=changes)
    digest = digest_of(config, calibration.vehicle)
    return replace(job, config=config, vehicle=calibration.vehicle, config_digest=digest)


def _require_enough(job: RunJob, count: int, refused: str) -> None:
    """Refuse to calibrate by too few runs."""
    least = job.config.calibration.least_runs
    if count < least:
        raise UsageError(
            f"too few other fault-free runs to calibrate {job.run_id}",
            place="--calibrate",
            found=f"{count}" + (f" (left out: {refused})" if refused else ""),
            expected=f"{least} at least (calibration.least_runs)",
            remedy="Give more fault-free runs of this vehicle.",
        )


def _require_one_vehicle(sources: Sequence[_CalibrationRun], config: Configuration) -> None:
    """Scales that differ by more than wear are of different vehicles, whose mean fits none."""
    estimates = {run.observed.estimate: run.run_id for run in sources if run.observed and run.observed.estimate}
    if not estimates:
        return
    least = min(estimates, key=lambda estimate: estimate.scale)
    most = max(estimates, key=lambda estimate: estimate.scale)
    noise = config.monitors.threshold_factor * (least.scale_sigma**2 + most.scale_sigma**2) ** 0.5
    if most.scale - least.scale <= config.calibration.same_vehicle_scale + noise:
        return
    raise UsageError(
        "the runs are of different vehicles",
        place="--calibrate",
        found=f"odometer scale {least.scale:.4f} in {estimates[least]}, {most.scale:.4f} in {estimates[most]}",
        expected=f"scales within {config.calibration.same_vehicle_scale:g} (calibration.same_vehicle_scale)",
        remedy="Give runs of one vehicle, or replay each vehicle's runs by themselves.",
    )
