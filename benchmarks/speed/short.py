"""Runs of two minutes and lines with many balises, warm, against work that does not change with this program.

Processor time of reading, replaying and writing, in one process. The yardstick sorts two million numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.results import Figure, processor_s
from benchmarks.trials import line_scenario, write_campaign
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline.campaign import make_plan, run_campaign
from schemas.config import Configuration
from schemas.enums import RunStatus

# Multiples of the yardstick: 0.2.0 had 10.4 and 60. The goals are 120 of its 202 ms, and 450 of its 754.
SHORT_TIMES = 6.2
DENSE_TIMES = 36.0
_GOES = 9
_RUNS_OF_A_CAMPAIGN = 100_000


def measure(out: Path) -> list[Figure]:
    """Figures of both, and what a campaign of short runs takes of them."""
    site, logs = write_campaign(out / "short", runs=1, minutes=2.0, different=1)
    short_s, yardstick_s = _against_yardstick(next(logs.iterdir()), site, out / "short-out")
    dense_s, beside_s = _against_yardstick(*_dense(out / "dense"), out / "dense-out")
    return [
        Figure("yardstick", yardstick_s, "s"),
        Figure("run of two minutes, warm", short_s, "s"),
        Figure("run of two minutes / yardstick", short_s / yardstick_s, "times", SHORT_TIMES),
        Figure("half an hour with 1,000 balises, warm", dense_s, "s"),
        Figure("half an hour with 1,000 balises / yardstick", dense_s / beside_s, "times", DENSE_TIMES),
        Figure("1e5 runs of two minutes", _RUNS_OF_A_CAMPAIGN * short_s / 3600.0, "h"),
    ]


def _against_yardstick(log: Path, site: Path, out: Path) -> tuple[float, float]:
    """Least processor time of some goes [s], in turn, so that a slow minute slows both."""
    plan = make_plan([str(log)], site, out, Configuration())
    if run_campaign(plan, force=True).count(RunStatus.OK) != 1:
        raise RuntimeError(f"the run of {log} is not ok: its time means nothing")
    numbers = np.random.default_rng(1).random(2_000_000)
    replays, sorts = zip(
        *(
            (processor_s(1, lambda: run_campaign(plan, force=True)), processor_s(1, lambda: np.sort(numbers)))
            for _ in range(_GOES)
        ),
        strict=True,
    )
    return min(replays), min(sorts)


def _dense(folder: Path) -> tuple[Path, Path]:
    scenario = line_scenario(0.5, balises=1000, seed=11)
    write_site(build_site(scenario), folder / "site")
    return write_run_log(build_run(scenario, scenario.runs[0]), folder / "runs"), folder / "site"
