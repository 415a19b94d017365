"""Many runs over one site: on one machine or a cluster, resumed where they stopped, nothing lost.

In: addresses of runs, a site, configuration. Out: the tables of each run and over all runs, on disk; a log of progress.
Touches files, stores, processes and clusters; what one run says is made by `pipeline.one_run` in a worker.

A campaign from `plan` to tables: `run` hands its runs to an engine (`engines`, `cluster`), survives what happens to
workers, and makes the tables over all runs. One run from its log (`recorded_log`) to its tables: `worker`; what became
of it: `outcome`. Which runs are complete: `resume`. One campaign at a time: `lock`. How to stop: `interruption`. Times
that somebody waits: `waits`. Whether a result is what it says: `verify`; many runs in few files: `compact`; the same
logs with other settings: `again`, `calibrated`.
"""

from pipeline.campaign.interruption import Interrupted
from pipeline.campaign.plan import Plan, find_runs, make_plan
from pipeline.campaign.run import run_campaign
from pipeline.results.outcome import CampaignSummary, RunOutcome

__all__ = ["Interrupted", "Plan", "RunOutcome", "CampaignSummary", "find_runs", "make_plan", "run_campaign"]
