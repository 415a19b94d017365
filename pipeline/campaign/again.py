"""The logs of a result once more, with another configuration: for what its tables cannot say."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pipeline.campaign.plan import make_plan
from pipeline.campaign.run import run_campaign
from pipeline.campaign.watch import Follower
from schemas.config import Configuration, Vehicle
from schemas.errors import UsageError


def replay_again(
    logs: Sequence[str], site: str | None, vehicle: Vehicle, jobs: int, watch: Callable[[], Follower]
) -> Callable[[Configuration, str], object] | None:
    """How to replay these logs into a folder; none without logs. `watch` makes what follows each replay.

    Raises `UsageError` without a site.
    """
    if not logs:
        return None
    if site is None:
        raise UsageError("needs the site", place="--logs", remedy="Give it with --site.")
    return lambda config, to: run_campaign(make_plan(logs, site, to, config, vehicle), jobs=jobs, watches=[watch()])
