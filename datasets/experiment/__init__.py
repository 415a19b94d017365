"""Published experiments at their own size, and what was added to them; `balise experiment NAME --out DIR`."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from datasets.experiment.bank import write_bank
from datasets.experiment.catalogue import write_catalogue
from datasets.experiment.diagnostics import write_experiment
from datasets.experiment.false_alarms import write_thresholds
from datasets.experiment.findings import write_findings
from datasets.experiment.ranges import write_ranges
from datasets.experiment.rare_tables import write_rare
from schemas.config import Configuration


class Experiment(Protocol):
    """Writes its tables into a folder and returns what it wrote; its own size where no repetitions are given.

    `config` is the bank to judge, for `rare`, `bank` and `catalogue`; the published experiments refuse one.
    """

    def __call__(
        self,
        out: Path,
        repetitions: int | None = None,
        seed: int = 1,
        jobs: int = 1,
        config: Configuration | None = None,
    ) -> list[Path]: ...


EXPERIMENTS: dict[str, Experiment] = {
    "diagnostics": write_experiment,
    "findings": write_findings,
    "pseudorange": write_ranges,
    "thresholds": write_thresholds,
    "rare": write_rare,
    "bank": write_bank,
    "catalogue": write_catalogue,
}
