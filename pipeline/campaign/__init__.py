"""Many runs over one site: on one machine or a cluster, resumed where they stopped, nothing lost."""

from pipeline.campaign.loop import Interrupted, Summary, run_campaign
from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan, find_runs, make_plan

__all__ = ["Interrupted", "Plan", "RunOutcome", "Summary", "find_runs", "make_plan", "run_campaign"]
