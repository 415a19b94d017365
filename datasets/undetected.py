"""The largest unnoticed fault of a run as a fault file: inject it, and no monitor says a word."""

from __future__ import annotations

from pathlib import Path

import tomli_w

from pipeline.one_run import monitor_alone
from pipeline.studies.undetected.profile import FaultProfile, epoch_of, profile_at
from schemas.config import Configuration, Vehicle
from schemas.errors import OutputError
from schemas.run import RunLog, Site

FAULT = "fault.toml"
PROFILE = "profile.csv"


def largest_fault(
    run: RunLog,
    site: Site,
    vehicle: Vehicle,
    config: Configuration,
    solution: str,
    balise: str | None = None,
    at_s: float | None = None,
    behind: bool = False,
) -> FaultProfile:
    """The largest fault that no monitor would have noticed, at a balise, a time after the first epoch, or the end."""
    monitored = monitor_alone(run, site, vehicle, config, solution)
    return profile_at(monitored, epoch_of(monitored, balise, at_s), behind)


def fault_sentence(found: FaultProfile) -> str:
    """The fault in words: how large, since when, and what a ramp and a step would have reached."""
    began, reached = (stamp.strftime("%H:%M:%S") for stamp in found.t)
    return (
        f"{found.error_m:.3f} m at {reached}, of a fault since {began}; the tables say {found.bound_m:.3f} m at most.\n"
        f"Of a ramp {found.ramp_m:.3f} m would have gone unnoticed there, of a step {found.step_m:.3f} m.\n"
        f"It reaches the thresholds of {', '.join(found.monitors) or 'no monitor'}."
    )


def fault_figures(found: FaultProfile) -> dict[str, object]:
    """The fault for programs: when it begins and reaches its size, its sizes [m], the monitors at their thresholds."""
    t_start, t_reached = found.t
    sizes = {"error_m": found.error_m, "bound_m": found.bound_m, "ramp_m": found.ramp_m, "step_m": found.step_m}
    return {"t_start": t_start, "t_reached": t_reached, **sizes, "monitors": list(found.monitors)}


def write_fault(profile: FaultProfile, solution: str | None, out: Path) -> Path:
    """`fault.toml` and its `profile.csv` in a folder; `solution`: the only one that is hit, None for all."""
    fault = {"kind": "profile", "target": "along", "profile": PROFILE}
    if solution is not None:
        fault["solution"] = solution
    try:
        out.mkdir(parents=True, exist_ok=True)
        profile.fault.write_csv(out / PROFILE)
        (out / FAULT).write_text(tomli_w.dumps({"faults": [fault]}), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(error.filename or out)) from None
    return out / FAULT
