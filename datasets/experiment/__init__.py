"""Published experiments at their own size, and what was added to them; `balise experiment NAME --out DIR`.

Their names cost nothing; what an experiment needs is loaded when it is called.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.frozen import frozen

if TYPE_CHECKING:
    from schemas.config import Configuration


@frozen
class Experiment:
    """Writes its tables into a folder and returns what it wrote; its own size where no repetitions are given.

    Its module has `REPETITIONS`, `made(repetitions, seed, jobs, config)`, which gives the contents of the files by
    name, and `SETTINGS`, if something is fixed beyond that. `configured`: it judges the bank of a configuration; the
    published experiments have the paper's settings, and silently ignoring others would mislead.
    """

    name: str
    module: str
    configured: bool = False

    def __call__(
        self,
        out: Path,
        repetitions: int | None = None,
        seed: int = 1,
        jobs: int = 1,
        config: Configuration | None = None,
        recorded: Path | None = None,
    ) -> list[Path]:
        if config is not None and not self.configured:
            from schemas.errors import UsageError

            raise UsageError(
                "takes no configuration",
                place=f"experiment {self.name}",
                expected="the published settings",
                remedy="`rare`, `bank` and `catalogue` judge the bank of a configuration.",
            )
        if recorded is not None and self.name != "rare":
            from schemas.errors import UsageError

            raise UsageError("takes no recorded noise", place=f"experiment {self.name}", expected="`experiment rare`")
        from datasets.experiment.tables import write

        module = import_module(f"datasets.experiment.{self.module if recorded is None else 'rare_recorded'}")
        count = repetitions or module.REPETITIONS
        settings = {"experiment": self.name, "repetitions": count, "seed": seed} | getattr(module, "SETTINGS", {})
        noise = () if recorded is None else (recorded,)
        return write(out, module.made(*noise, count, seed, jobs, config), settings)


EXPERIMENTS: dict[str, Experiment] = {
    one.name: one
    for one in (
        Experiment("diagnostics", "diagnostics"),
        Experiment("findings", "findings"),
        Experiment("pseudorange", "ranges"),
        Experiment("thresholds", "false_alarms"),
        Experiment("rare", "rare_tables", configured=True),
        Experiment("bank", "bank", configured=True),
        Experiment("catalogue", "catalogue", configured=True),
    )
}


RECORDED = "recorded"
"""The one on the user's own recordings: it takes runs and a site (`datasets.experiment.recorded`)."""


def experiment_of(name: str, on_recordings: bool = False) -> Experiment:
    """The experiment of this name. Raises `UsageError` with the nearest where there is none.

    `on_recordings`: runs or what belongs to them were named, which only `recorded` takes.
    """
    from schemas.errors import UsageError
    from schemas.near import did_you_mean

    if name not in EXPERIMENTS:
        known = [*EXPERIMENTS, RECORDED]
        raise UsageError(f"is not an experiment{did_you_mean(name, known)}", place=name, expected=", ".join(known))
    if on_recordings:
        remedy = f"`balise experiment {RECORDED}` does."
        raise UsageError("takes no runs, site, vehicle or plan", place=f"experiment {name}", remedy=remedy)
    return EXPERIMENTS[name]
