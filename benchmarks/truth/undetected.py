"""The largest unnoticed error, proved: its profile injected into the same run is not detected, 5 % more is.

Random runs: speeds, stops, sigmas, rates, outages, balise reads, scale and latency of a vehicle file; on straight
track, where the bank is exactly linear in the fault, and on curves. At a random epoch and in a random direction the
profile of the whole linear program is injected; the judge has to find it, the monitors must not. Beside it: how close
the bound of the tables is, and what it takes.

python -m benchmarks undetected
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.results import Figure
from datasets.faults import FaultKind, FaultSpec
from datasets.inject import inject
from datasets.motion import build_motion
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import monitor_alone, replay
from pipeline.stages.monitored import MonitoredSolution
from pipeline.studies.undetected.columns import fault_windows, watched_rows
from pipeline.studies.undetected.profile import FaultProfile, profile_at
from schemas.arrays import floats, times_ns
from schemas.config import Configuration, Vehicle
from schemas.monitors import MONITORS
from schemas.run import RunLog, Site

RUNS = 200
CURVED_RUNS = 50
SCALED = 1.05
# Asked for without a vehicle file; the same for both.
HOUR_S = 4.0
# On curves the fault moves the position to where the track lies otherwise: by how much it may be beyond the bound.
_CURVED_SCALES = (1.02, 1.01, 1.005, 1.002, 1.0, 0.995, 0.99, 0.98, 0.95)
_LENGTH_M = 60_000.0
_READS_EVERY_M = 2_000.0


@dataclass(frozen=True)
class Trial:
    """A run without faults and everything that its replay needs."""

    run: RunLog
    site: Site
    vehicle: Vehicle


@dataclass(frozen=True)
class Outcome:
    """One profile: the exact optimum [m], the table's bound over it, by how much the judge's error differs [m].

    `not_detected`: no new fail up to the epoch; `detected_scaled`: one at 1.05 of it; `held_by_rate`: no monitor held
    it, but the largest rate of a fault (the first epochs at 10 Hz, where the raw monitor allows more);
    `undetected_scale`: the largest scale of `_CURVED_SCALES` that stays undetected (1 on straight track).
    """

    seed: int
    error_m: float
    closeness: float
    judged_apart_m: float
    not_detected: bool
    detected_scaled: bool
    held_by_rate: bool
    undetected_scale: float


_GIVEN_M = dict.fromkeys(("noise_along_m", "noise_cross_m", "noise_up_m"), (0.0, 0.0, 0.0, 0.0))
_NOISE_GIVEN = Configuration.model_validate({"monitors": _GIVEN_M})


def trial_of(seed: int, curved: bool) -> Trial:
    """A random run, the same for the same seed."""
    rng = np.random.default_rng([25, seed])
    scenario = Scenario.model_validate(_scenario(seed, rng, curved))
    spec = scenario.runs[0]
    site, run = build_site(scenario), build_run(scenario, spec)
    if rng.random() < 0.5:
        run = run.with_streams(balise_reads=_reads(scenario, run))
    assert scenario.vehicle is not None
    return Trial(run.with_streams(faults=None), site, scenario.vehicle)


def _scenario(seed: int, rng: np.random.Generator, curved: bool) -> dict[str, Any]:
    fast = bool(rng.random() < 0.2)
    sigma_m, scale, latency_s = float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.99, 1.01)), float(rng.uniform(0, 0.2))
    hold_s = rng.uniform(20.0, 60.0, 2) if fast else rng.uniform(60.0, 600.0, 2)
    phases = [
        {"speed_mps": float(speed), "hold_s": float(s)} for speed, s in zip(rng.uniform(10, 40, 2), hold_s, strict=True)
    ]
    if rng.random() < 0.3:
        phases.insert(1, {"speed_mps": 0.0, "hold_s": float(rng.uniform(10.0, 60.0))})
    vehicle = {
        "odometer_scale": scale,
        "odometer_scale_sigma": float(rng.choice([1e-4, 5e-4])),
        "gnss_latency_s": latency_s,
        "gnss_latency_sigma_s": 0.003,
    }
    gnss = {
        "rate_hz": 10.0 if fast else 1.0,
        "sigma_east_m": sigma_m,
        "sigma_north_m": sigma_m,
        "sigma_up_m": 1.5 * sigma_m,
        "latency_s": latency_s,
    }
    return {
        "name": "undetected",
        "seed": seed,
        "vehicle": vehicle,
        "line": _line(rng, curved),
        "runs": [
            {
                "id": f"run{seed}",
                "motion": {"start_m": 1000.0, "phases": phases},
                "gnss": gnss,
                "odometer": {"rate_hz": 20.0, "scale": scale},
                "faults": [
                    {"kind": "outage", "start_s": float(start_s), "duration_s": float(rng.uniform(3.0, 50.0))}
                    for start_s in rng.uniform(30.0, 200.0, int(rng.integers(0, 3)))
                ],
            }
        ],
    }


def _line(rng: np.random.Generator, curved: bool) -> dict[str, Any]:
    sections = [{"length_m": float(rng.uniform(500.0, 1500.0)), "grade": float(rng.uniform(-0.01, 0.01))}]
    if curved:
        radius_m = float(rng.choice([-1.0, 1.0]) * rng.uniform(400.0, 3000.0))
        sections.append({"length_m": float(rng.uniform(300.0, 900.0)), "radius_m": radius_m})
    else:
        sections[0]["grade"] = 0.0
    reads = np.arange(1500.0, _LENGTH_M - _READS_EVERY_M, _READS_EVERY_M)
    return {
        # Only a meridian is straight: a line of any other constant heading turns a little.
        "heading_deg": float(rng.uniform(0.0, 360.0)) if curved else float(rng.choice([0.0, 180.0])),
        "sections": sections,
        "elements": [{"id": "NE0", "length_m": _LENGTH_M}],
        "balises": [
            *({"id": f"BG{i}", "at_m": float(at), "kind": "physical"} for i, at in enumerate(reads)),
            *({"id": f"VB{i}", "at_m": float(at) + 700.0} for i, at in enumerate(reads)),
        ],
    }


def _reads(scenario: Scenario, run: RunLog) -> pl.DataFrame:
    motion = build_motion(scenario.runs[0].motion)
    first_ns = int(times_ns(run.odometer)[0]) if run.odometer is not None else 0
    passed = [
        (first_ns + round(motion.time_at(balise.at_m) * 1e9), balise.id)
        for balise in scenario.line.balises
        if balise.kind == "physical" and 1000.0 < balise.at_m < 1000.0 + motion.distances_m[-1]
    ]
    frame = pl.DataFrame(passed, schema={"t": pl.Int64, "balise_id": pl.String}, orient="row")
    return frame.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))


def proof(seed: int, curved: bool, folder: Path) -> Outcome | None:
    """One random run with its profile; None where nothing was watched.

    The bound is that of the thresholds as they were. Measured noise would make thresholds of their own of the run with
    the profile in it, so the noise is given.
    """
    trial, config = trial_of(seed, curved), _NOISE_GIVEN
    rng = np.random.default_rng([250, seed])
    monitored = monitor_alone(trial.run, trial.site, trial.vehicle, config, "primary")
    epoch = _some_epoch(monitored, rng)
    if epoch is None:
        return None
    found = profile_at(monitored, epoch, bool(rng.random() < 0.5))
    clean = replay(trial.run, trial.site, trial.vehicle, config).epochs
    once = _injected(trial, found, 1.0, folder)
    size_m = found.fault["size_m"][-1] * clean["direction"][epoch]
    apart = floats(once, "error_along_m")[epoch] - floats(clean, "error_along_m")[epoch] - size_m
    scales = _CURVED_SCALES if curved else (1.0,)
    passing = (scale for scale in scales if not _new_fail(clean, _injected(trial, found, scale, folder), epoch))
    return Outcome(
        seed=seed,
        error_m=found.error_m,
        closeness=found.bound_m / found.error_m,
        judged_apart_m=abs(float(apart)),
        not_detected=not _new_fail(clean, once, epoch),
        detected_scaled=_new_fail(clean, _injected(trial, found, SCALED, folder), epoch),
        held_by_rate=_held_by_rate(found, config),
        undetected_scale=next(passing, 0.0) if curved else 1.0,
    )


def _some_epoch(monitored: MonitoredSolution, rng: np.random.Generator) -> int | None:
    rows = watched_rows(monitored)
    parts = fault_windows(monitored, rows)
    if not parts:
        return None
    chosen = parts[int(rng.integers(len(parts)))]
    return int(rows.epoch[int(rng.integers(chosen.start + 1, chosen.end + 1))])


def _injected(trial: Trial, found: FaultProfile, scale: float, folder: Path) -> pl.DataFrame:
    """Epochs of the run with the profile, times a scale."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "profile.csv"
    found.fault.with_columns(pl.col("size_m") * scale).write_csv(file)
    fault = FaultSpec(kind=FaultKind.PROFILE, target="along", profile=str(file))
    return replay(inject(trial.run, fault, trial.site), trial.site, trial.vehicle, _NOISE_GIVEN).epochs


def _held_by_rate(found: FaultProfile, config: Configuration) -> bool:
    """Every step of the profile is as fast as a fault may be."""
    rate_mps = found.fault["size_m"].diff() / found.fault["t_s"].diff()
    return bool((rate_mps.drop_nulls().abs() > 0.999 * config.undetected.max_rate_mps).all())


def _new_fail(clean: pl.DataFrame, faulty: pl.DataFrame, epoch: int) -> bool:
    """A monitor fails up to the epoch that did not in the run as it was recorded, by the thresholds of that run.

    The noise that a run measures follows its fault by some tenths of a percent, and a profile leaves no room for it.
    """
    return any(_fails_anew(clean.head(epoch + 1), faulty.head(epoch + 1), monitor) for monitor in MONITORS)


def _fails_anew(clean: pl.DataFrame, faulty: pl.DataFrame, monitor: str) -> bool:
    state = f"{monitor}_state"
    beyond = (faulty[f"{monitor}_value"].abs() > clean[f"{monitor}_threshold"]).fill_null(value=True)
    return bool(((faulty[state] == "fail") & (clean[state] != "fail") & beyond).any())


def outcomes(runs: int, curved: bool, folder: Path) -> Iterator[Outcome]:
    for seed in range(runs):
        found = proof(seed, curved, folder)
        if found is not None:
            yield found


def hour(rate_hz: float, vehicle_file: bool) -> float:
    """Processor time of all columns of an hour's run beyond that of its replay [s]."""
    rng = np.random.default_rng(1)
    data = _scenario(1, rng, curved=True)
    data["runs"][0]["motion"]["phases"] = [{"speed_mps": 15.0, "hold_s": 3500.0}]
    data["runs"][0] |= {"faults": [], "gnss": {**data["runs"][0]["gnss"], "rate_hz": rate_hz}}
    scenario = Scenario.model_validate(data)
    site, run = build_site(scenario), build_run(scenario, scenario.runs[0])
    vehicle = scenario.vehicle if vehicle_file else Vehicle()
    spent = []
    for compute in (False, True):
        config = Configuration.model_validate({"undetected": {"compute": compute}})
        begun = time.process_time()
        replay(run, site, vehicle, config)
        spent.append(time.process_time() - begun)
    return spent[1] - spent[0]


def _hours() -> list[Figure]:
    return [
        Figure(f"an hour at {rate_hz:g} Hz, {which}", hour(rate_hz, vehicle_file), "s", HOUR_S)
        for rate_hz in (1.0, 10.0)
        for vehicle_file, which in ((True, "vehicle file"), (False, "no vehicle file"))
    ]


def measure(out: Path) -> list[Figure]:
    straight, curved = list(outcomes(RUNS, False, out)), list(outcomes(CURVED_RUNS, True, out))
    monitored = [one for one in straight if not one.held_by_rate]
    return [
        Figure("profiles on straight track", len(straight), ""),
        Figure("... that a monitor saw", sum(not one.not_detected for one in straight), "", 0.0),
        Figure("... held by the largest rate of a fault alone", sum(one.held_by_rate for one in straight), ""),
        Figure("... of the others, that none saw at 1.05", sum(not one.detected_scaled for one in monitored), "", 0.0),
        Figure("largest difference of the judge's error", max(one.judged_apart_m for one in straight), "m", 1e-6),
        Figure("bound over optimum, smallest", min(one.closeness for one in straight), "", 1.0, "above"),
        Figure("bound over optimum, largest", max(one.closeness for one in straight), "", 1.1),
        Figure("profiles on curves", len(curved), ""),
        Figure("largest scale that no monitor saw", max(one.undetected_scale for one in curved), "", 1.01),
        Figure("smallest scale that no monitor saw", min(one.undetected_scale for one in curved), ""),
        *_hours(),
    ]
