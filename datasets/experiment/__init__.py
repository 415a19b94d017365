"""The published experiment at its own size, and what was added to it; `balise experiment NAME --out DIR`.

Their names cost nothing; what an experiment needs is loaded when it is called. `diagnostics` is the published one: a
grid of ramps on simulated noise (`monte_carlo`, `figures`). `rare` asks what counting cannot reach (`sampling`), of the
bank and of the pseudorange monitor (`range_system`). Both have the sky of `geometry` and the monitors of `bank`.
`catalogue` replays faults (`catalogue_faults`, `catalogue_report`), `recorded` puts them into the user's own runs.
`tables` writes the results, `workers` splits the work.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import UsageError
from schemas.frozen import frozen

if TYPE_CHECKING:
    from schemas.config import Configuration


@frozen
class Experiment:
    """Writes its tables into a folder and returns what it wrote; its own size where no repetitions are given.

    The module of its name has `REPETITIONS`, `run(repetitions, seed, jobs, config)`, which gives the contents of the
    files by name, and `SETTINGS`, if something is fixed beyond that. `configured`: it judges the bank of a
    configuration; a published experiment has the paper's settings, and silently ignoring others would mislead.
    """

    name: str
    configured: bool

    def __call__(
        self,
        out: Path,
        repetitions: int | None = None,
        seed: int = 1,
        jobs: int = 1,
        config: Configuration | None = None,
        recorded: Path | None = None,
    ) -> list[Path]:
        """Run it.

        `recorded`: a result whose noise replaces the published one, which only `rare` takes. Raises `UsageError` where
        the experiment does not take what is given.
        """
        from datasets.experiment.tables import write_contents

        place = f"experiment {self.name}"
        if config is not None and not self.configured:
            remedy = "`rare` and `catalogue` judge the bank of a configuration."
            raise UsageError("takes no configuration", place=place, expected="the published settings", remedy=remedy)
        if recorded is not None and self.name != "rare":
            raise UsageError("takes no recorded noise", place=place, expected="`experiment rare`")
        module = import_module(f"datasets.experiment.{self.name}")
        count = repetitions or module.REPETITIONS
        settings = {"experiment": self.name, "repetitions": count, "seed": seed} | getattr(module, "SETTINGS", {})
        noise = {} if recorded is None else {"recorded": recorded}
        return write_contents(out, module.run(count, seed, jobs, config, **noise), settings)


EXPERIMENTS: dict[str, Experiment] = {
    "diagnostics": Experiment("diagnostics", configured=False),
    "rare": Experiment("rare", configured=True),
    "catalogue": Experiment("catalogue", configured=True),
}
RECORDED = "recorded"
"""The one on the user's own recordings: it takes runs and a site (`datasets.experiment.recorded`)."""


def experiment_of(name: str, on_recordings: bool = False) -> Experiment:
    """The experiment of this name. Raises `UsageError` with the nearest where there is none.

    `on_recordings`: runs or what belongs to them were named, which only `recorded` takes.
    """
    from schemas.near import did_you_mean

    if name not in EXPERIMENTS:
        known = [*EXPERIMENTS, RECORDED]
        raise UsageError(f"is not an experiment{did_you_mean(name, known)}", place=name, expected=", ".join(known))
    if on_recordings:
        remedy = f"`balise experiment {RECORDED}` does."
        raise UsageError("takes no runs, site, vehicle or plan", place=f"experiment {name}", remedy=remedy)
    return EXPERIMENTS[name]
