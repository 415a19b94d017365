"""Trials of known size: long journeys over a long line, and many short ones."""

from __future__ import annotations

import shutil
from pathlib import Path

from datasets.demo import demo_scenario
from datasets.mcap_log import write_mcap
from datasets.motion import MotionSpec, PhaseSpec
from datasets.scenario import BaliseSpec, ElementSpec, RunSpec, Scenario, with_seed
from datasets.trial import build_run, build_site, write_run_log, write_site
from schemas.config import Configuration, IngestConfig, StreamMapping, to_toml
from schemas.enums import Origin

_ELEMENT_M = 6000.0
_SPEED_MPS = 33.0


def line_scenario(hours: float, balises: int, seed: int) -> Scenario:
    """The demonstration's line made long enough, with balises at equal distances and one clean run."""
    scenario = with_seed(demo_scenario(), seed)
    length_m = _SPEED_MPS * hours * 3600.0
    count = int(length_m // _ELEMENT_M) + 2
    elements = tuple(ElementSpec(id=f"NE{number:03}", length_m=_ELEMENT_M) for number in range(count))
    spacing_m = (length_m - 2000.0) / balises
    virtual = tuple(BaliseSpec(id=f"VB{number:03}", at_m=1000.0 + number * spacing_m) for number in range(balises))
    line = scenario.line.model_copy(update={"elements": elements, "balises": virtual})
    return scenario.model_copy(update={"line": line, "runs": (_steady(scenario.runs[0], hours),)})


def _steady(run: RunSpec, hours: float) -> RunSpec:
    phases = (PhaseSpec(speed_mps=_SPEED_MPS), PhaseSpec(speed_mps=_SPEED_MPS, hold_s=hours * 3600.0 - 75.0))
    motion = MotionSpec(start_m=300.0, phases=phases)
    odometer = run.odometer.model_copy(update={"rate_hz": 50.0}) if run.odometer else None
    return run.model_copy(update={"motion": motion, "odometer": odometer, "faults": ()})


# What a project or `--config` says of the wheel of a ROS 2 log: a twist is an odometer only where a mapping names it.
MAPPED_WHEEL = IngestConfig(odometer=(StreamMapping(topic="/odometer", origin=Origin.WHEEL),))


def write_cdr_trial(folder: Path, hours: float, balises: int) -> Path:
    """One long journey as a ROS 2 log (`nav_msgs/Odometry`), its site in `folder/site`, its mapping in
    `folder/config.toml`; returns the log.
    """
    log = folder / "long.mcap"
    if not log.exists():
        scenario = line_scenario(hours, balises, seed=11)
        run = build_run(scenario, scenario.runs[0]).with_streams(reference=None, faults=None)
        write_site(build_site(scenario), folder / "site")
        write_mcap(run, log, "cdr", odometer_message="nav_msgs/msg/Odometry")
        (folder / "config.toml").write_text(to_toml(Configuration(ingest=MAPPED_WHEEL)), encoding="utf-8")
    return log


def write_campaign(folder: Path, runs: int, minutes: float, different: int = 10) -> tuple[Path, Path]:
    """`runs` journeys, some of them the same under another name; returns site and folder of runs."""
    site, logs = folder / "site", folder / "runs"
    if not logs.exists():
        for number in range(min(different, runs)):
            scenario = line_scenario(minutes / 60.0, balises=12, seed=number + 1)
            spec = scenario.runs[0].model_copy(update={"id": f"run{number:04}"})
            scenario = scenario.model_copy(update={"runs": (spec,)})
            write_run_log(build_run(scenario, spec), logs)
            if not site.exists():
                write_site(build_site(scenario), site)
        for number in range(different, runs):
            shutil.copytree(logs / f"run{number % different:04}", logs / f"run{number:04}")
    return site, logs
