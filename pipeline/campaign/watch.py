"""What a campaign tells whoever follows it."""

from __future__ import annotations

from typing import Protocol

from pipeline.results.outcome import CampaignSummary, RunOutcome, UnderWay


class Follower(Protocol):
    """Follows a campaign of some runs to its end."""

    def begin(self, runs: int, out: str) -> None: ...

    def look(self, under_way: UnderWay) -> None:
        """Called several times a second."""

    def finished(self, outcome: RunOutcome) -> None: ...

    def lost(self, run_id: str, attempt: int) -> None:
        """The worker died that was at this attempt of a run; it is tried again."""

    def noted(self, text: str) -> None:
        """Something that somebody should see to."""

    def end(self, summary: CampaignSummary) -> None: ...
