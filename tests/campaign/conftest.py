"""A result that campaigns are held against."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.campaign import run_campaign
from tests.campaign.compare import plan_of
from tests.conftest import Shared, SmallTrial


@pytest.fixture(autouse=True)
def _replayed_once(replayed_once: None) -> None:
    """Campaigns are the subject here."""


@pytest.fixture(scope="session")
def undisturbed(shared: Shared, small_trial: SmallTrial) -> Path:
    """Each run replayed by itself, in this process."""

    def replayed(out: Path) -> None:
        for path in small_trial.paths:
            run_campaign(plan_of(small_trial, out, [path]))

    return shared("undisturbed", replayed)
