"""Published experiments at their own size, and what was added to them; `balise experiment NAME --out DIR`.

Their names cost nothing; what an experiment needs is loaded when it is called.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from schemas.config import Configuration


@dataclass(frozen=True)
class Experiment:
    """Writes its tables into a folder and returns what it wrote; its own size where no repetitions are given.

    `config` is the bank to judge, for `rare`, `bank` and `catalogue`; the published experiments refuse one.
    """

    module: str
    function: str

    def __call__(
        self,
        out: Path,
        repetitions: int | None = None,
        seed: int = 1,
        jobs: int = 1,
        config: Configuration | None = None,
    ) -> list[Path]:
        write = getattr(import_module(f"datasets.experiment.{self.module}"), self.function)
        written: list[Path] = write(out, repetitions, seed, jobs, config)
        return written


EXPERIMENTS: dict[str, Experiment] = {
    "diagnostics": Experiment("diagnostics", "write_experiment"),
    "findings": Experiment("findings", "write_findings"),
    "pseudorange": Experiment("ranges", "write_ranges"),
    "thresholds": Experiment("false_alarms", "write_thresholds"),
    "rare": Experiment("rare_tables", "write_rare"),
    "bank": Experiment("bank", "write_bank"),
    "catalogue": Experiment("catalogue", "write_catalogue"),
}
