"""Logs replayed once more with other settings: what the sensitivity of a verdict takes."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.campaign.plan import make_plan
from pipeline.campaign.run import run_campaign
from pipeline.safety.sensitivity import Replay
from schemas.config import Configuration, Vehicle
from schemas.errors import UsageError


def again(logs: Sequence[str], site: str | None, vehicle: Vehicle, jobs: int) -> Replay | None:
    """How to replay these logs with another configuration; none without logs. Raises `UsageError` without a site."""
    if not logs:
        return None
    if site is None:
        raise UsageError("needs the site", place="--logs", remedy="Give it with --site.")
    ground = site

    def replay_with(settings: Configuration, to: str) -> None:
        run_campaign(make_plan(logs, ground, to, settings, vehicle), jobs=jobs)

    return replay_with
