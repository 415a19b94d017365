"""A campaign from its plan to the tables over all runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from pipeline.campaign.cluster import DaskEngine
from pipeline.campaign.engines import HAS_ALARM, Engine, LocalEngine, SerialEngine
from pipeline.campaign.interruption import Interrupted, listening
from pipeline.campaign.lock import locked
from pipeline.campaign.loop import CampaignLoop
from pipeline.campaign.plan import Plan, with_previous
from pipeline.campaign.resume import keep, unchanged
from pipeline.campaign.watch import Follower
from pipeline.results import store
from pipeline.results.manifest import note_settings
from pipeline.results.outcome import CampaignSummary
from pipeline.storage.address import is_url
from schemas.errors import UsageError

TIME_LIMIT_S = 3600.0


def run_campaign(
    plan: Plan,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    force: bool = False,
    time_limit_s: float = TIME_LIMIT_S,
    watches: Sequence[Follower] = (),
) -> CampaignSummary:
    """Replay every run of the plan whose result is not there already.

    Whatever is raised, what is complete stays, and the same call later does the rest. The tables are the same for any
    `jobs`, any `scheduler` and any order of runs.

    Args:
        plan: what to replay, as `make_plan` yields it.
        jobs: number of processes.
        scheduler: address of a Dask scheduler; None: this machine.
        force: replay runs whose result is there already, too.
        time_limit_s: longest time for one run [s].
        watches: what is told of the progress.

    Returns:
        What became of each run.

    Raises:
        OutputError: results cannot be written.
        Interrupted: on SIGINT, SIGTERM and SIGHUP.
    """
    _check_shared(plan, scheduler)
    with locked(plan.out) as campaign:
        store.sweep(plan.out)
        known = [] if force else unchanged(plan)
        left = with_previous(plan, {outcome.run_id for outcome in known}) if not force else plan
        store.write_config(plan.out, plan.config)
        store.write_vehicle(plan.out, plan.vehicle)
        for digest in sorted({job.config_digest for job in plan.jobs}):
            note_settings(plan.out, digest, plan.given_by_digest.get(digest, plan.given))
        engine = _engine_for(jobs, len(left.jobs), scheduler, time_limit_s)
        held = [replace(job, campaign=campaign) for job in left.jobs]
        loop = CampaignLoop(held, engine, time_limit_s, watches, known)
        try:
            summary = _watched(plan, loop, watches, at_once=engine.in_process)
        finally:
            engine.close()
            # Of a cluster's workers one that is still at its run writes it again.
            if loop.disturbed and not is_url(plan.out):
                store.sweep(plan.out)
            if left.jobs:
                keep(plan, loop.outcomes)
        _finish(plan, loop, summary)
        return summary


def _engine_for(jobs: int, runs: int, scheduler: str | None, limit_s: float) -> Engine:
    """The engine that suits a number of runs and processes."""
    if scheduler is not None and runs:
        return DaskEngine(scheduler, limit_s)
    return SerialEngine(limit_s) if runs <= 1 and HAS_ALARM else LocalEngine(max(1, min(jobs, runs)))


def _check_shared(plan: Plan, scheduler: str | None) -> None:
    """Whether a cluster can write there is found out by its workers; that nothing is to do, here."""
    if not plan.jobs:
        raise UsageError("no run is given")
    if scheduler is not None and is_url(plan.out) and plan.out.startswith("memory://"):
        raise UsageError("workers cannot write into this process's memory", place=plan.out)


def _watched(plan: Plan, loop: CampaignLoop, watches: Sequence[Follower], at_once: bool) -> CampaignSummary:
    """`at_once`: the work is in this process, so that the loop's next look may be a whole run away."""
    begun = time.monotonic()
    for watch in watches:
        watch.begin(len(plan.jobs), plan.out)
    stopped: Interrupted | None = None
    with listening(loop.stop, at_once):
        try:
            loop.run()
        except Interrupted as interrupted:
            stopped = interrupted
        finally:
            outcomes = sorted(loop.outcomes, key=lambda outcome: outcome.run_id)
            summary = CampaignSummary(len(plan.jobs), tuple(outcomes), time.monotonic() - begun)
            for watch in watches:
                watch.end(summary)
    if stopped is not None:
        raise Interrupted(stopped.signum, summary)
    return summary


def _finish(plan: Plan, loop: CampaignLoop, summary: CampaignSummary) -> None:
    """The tables over all runs; they too are given up when somebody asks to stop."""
    from pipeline.campaign.finish import write_campaign  # statistics, which take long to load

    made = [outcome.run_id for outcome in summary.outcomes if not outcome.skipped]
    with listening(loop.stop, at_once=True):
        try:
            write_campaign(plan.out, plan.config, made)
        except Interrupted as interrupted:
            raise Interrupted(interrupted.signum, summary) from None
