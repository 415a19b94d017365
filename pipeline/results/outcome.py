"""What became of the runs of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl

from pipeline.results.figures.head import CampaignHead, head_of, verdict_figures
from schemas.enums import RunStatus, RunVerdict
from schemas.frozen import frozen

VERDICT_FIGURES = {
    "balises_found": pl.Int64,
    "balises_passed": pl.Int64,
    "balises_accepted": pl.Int64,
    "balises_on_path": pl.Int64,
    "availability": pl.Float64,
    "proof_margin_m": pl.Float64,
    "moving_s": pl.Float64,
    "odometer_origin": pl.String,
}
"""Figures of a run that stand beside its verdict."""
UnderWay = Sequence[tuple[str, float]]
"""Ids of the runs under way, and for how long [s]."""


@frozen
class RunOutcome:
    """What became of one run. With a `trace` its failure is a defect of ours, else the input's.

    `verdict`: the worst of its solutions, None where all failed. `attempts` is more than one where workers were lost
    over it; `hazards` and `missed_detections` are None where nothing could be judged. `why`: what decides the verdict;
    `faults`: each in words, the worst first. `proof`: that of `resume`, empty where nothing is proved. `log`: what was
    replayed. The figures next to the verdict, `remedies`, their gains and `lost` are of the solution that heads the
    run; `lost`: what the moving time of a run of low availability was lost to.
    """

    run_id: str
    status: RunStatus
    error: str | None = None
    verdict: RunVerdict | None = None
    skipped: bool = False
    trace: str | None = None
    seconds: float = 0.0
    hazards: int | None = None
    missed_detections: int | None = None
    attempts: int = 1
    why: str = ""
    faults: tuple[str, ...] = ()
    proof: str = ""
    log: str = ""
    balises_found: int | None = None
    balises_passed: int | None = None
    balises_accepted: int | None = None
    balises_on_path: int | None = None
    availability: float | None = None
    proof_margin_m: float | None = None
    moving_s: float | None = None
    odometer_origin: str | None = None
    remedies: tuple[str, ...] = ()
    remedies_gain: tuple[float, ...] = ()
    lost: str = ""

    @property
    def is_defect(self) -> bool:
        """Whether the run failed by a defect of the program."""
        return self.trace is not None


@frozen
class CampaignSummary:
    """What became of all runs of a campaign."""

    planned: int
    outcomes: tuple[RunOutcome, ...]
    seconds: float

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs that were reached, and their counts."""
        return head_of(outcome.verdict for outcome in self.outcomes)

    def verdict_figures(self) -> dict[str, Any]:
        """The figures next to the verdict over all runs that have one; nothing where none has."""
        names = {**VERDICT_FIGURES, "verdict": pl.String}
        rows = [
            {name: getattr(outcome, name) for name in names}
            for outcome in self.outcomes
            if outcome.moving_s is not None
        ]
        return dict(verdict_figures(pl.DataFrame(rows, schema=names))) if rows else {}

    def count(self, status: RunStatus) -> int:
        """How many runs ended so."""
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def all_ok(self) -> bool:
        """Whether every planned run is there, and is ok."""
        return self.count(RunStatus.OK) == self.planned

    @property
    def count_skipped(self) -> int:
        """How many runs were there already."""
        return sum(outcome.skipped for outcome in self.outcomes)

    @property
    def count_defects(self) -> int:
        """How many runs failed by a defect of the program."""
        return sum(outcome.is_defect for outcome in self.outcomes)

    @property
    def count_left(self) -> int:
        """How many planned runs were not reached."""
        return self.planned - len(self.outcomes)
