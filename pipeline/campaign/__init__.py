"""Many runs over one site: on one machine or a cluster, resumed where they stopped, nothing lost.

In: addresses of runs, a site, configuration. Out: the tables of each run and over all runs, on disk; a log of progress.
Touches files, stores, processes and clusters; what one run says is made by `pipeline.one_run` in a worker.
"""

from pipeline.campaign.interruption import Interrupted
from pipeline.campaign.plan import Plan, find_runs, make_plan
from pipeline.campaign.run import run_campaign
from pipeline.results.outcome import CampaignSummary, RunOutcome

__all__ = ["Interrupted", "Plan", "RunOutcome", "CampaignSummary", "find_runs", "make_plan", "run_campaign"]
