"""What a campaign tells of itself: to whoever watches while it goes on, and in the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan
from pipeline.figures.verdict import CampaignHead, head_of
from schemas.enums import RunStatus


@dataclass(frozen=True)
class Summary:
    """A campaign in figures."""

    planned: int
    outcomes: tuple[RunOutcome, ...]
    seconds: float

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs that were reached, and their counts."""
        return head_of(outcome.verdict for outcome in self.outcomes)

    def count(self, status: RunStatus) -> int:
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def skipped(self) -> int:
        return sum(outcome.skipped for outcome in self.outcomes)

    @property
    def defects(self) -> int:
        return sum(outcome.defect for outcome in self.outcomes)

    @property
    def left(self) -> int:
        """Runs that were not reached."""
        return self.planned - len(self.outcomes)


class Watch(Protocol):
    """Whoever wants to see a campaign go on."""

    def begin(self, plan: Plan) -> None: ...

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        """Called several times a second with the runs under way and their age [s]."""

    def lost(self, run_id: str, attempt: int) -> None:
        """The worker died that was at this attempt of a run; it is tried again."""

    def noted(self, text: str) -> None:
        """Something that somebody should see to."""

    def finished(self, outcome: RunOutcome) -> None: ...

    def end(self, summary: Summary) -> None: ...
