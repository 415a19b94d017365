"""Seeded random trials: one run with one fault each, and what its tables must say, told without noise.

What must be found follows from the definitions (DOMAIN section 5) applied to the true motion and the injected
error alone. Faults that come within the noise of a limit are drawn again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.faults import PlacedFault, offset_m
from datasets.motion import Motion, build_motion
from datasets.scenario import RunSpec, Scenario
from datasets.trial import build_run, build_site, placed
from pipeline.timeline import nominal_period_s
from schemas.config import Vehicle
from schemas.run import RunLog, RunTables, Site

Floats = npt.NDArray[np.float64]

LIMIT_M = 20.0
KINDS = ("none", "step", "offset", "ramp", "slow ramp", "outage", "slip", "slide", "scale")
_ON_ODOMETER = ("slip", "slide", "scale")
_LENGTH_M = 14_000.0
_DRAWS = 200


@dataclass(frozen=True)
class ExpectedRow:
    """One hazard row; `t_s` is the step after the first epoch, or about when the first VB is hit."""

    hazard: str
    balise_ids: frozenset[str]
    t_s: float
    early: bool | None
    caused_by: int | None


@dataclass(frozen=True)
class RandomTrial:
    """A run with everything that its replay needs, and the hazards that must be found."""

    seed: int
    kind: str
    site: Site
    run: RunLog
    vehicle: Vehicle | None
    rows: tuple[ExpectedRow, ...]
    sigma_m: float


def random_trial(seed: int) -> RandomTrial:
    """The trial of a seed; the same seed always gives the same trial."""
    rng = np.random.default_rng([20250303, seed])
    kind = KINDS[seed % len(KINDS)]
    for _ in range(_DRAWS):
        scenario = _scenario(seed, rng, kind)
        spec = scenario.runs[0]
        rows = _expected(scenario, spec)
        if rows is not None:
            vehicle = scenario.vehicle if spec.vehicle else None
            site, run = build_site(scenario), build_run(scenario, spec)
            return RandomTrial(seed, kind, site, run, vehicle, rows, spec.gnss.sigma_east_m)
    raise AssertionError(f"no clear trial of kind {kind!r} in {_DRAWS} draws")


def _scenario(seed: int, rng: np.random.Generator, kind: str) -> Scenario:
    sigma_m = float(rng.choice([0.5, 1.0, 1.5]))
    scale, latency_s = float(rng.choice([1.0, 1.003, 0.996])), float(rng.choice([0.0, 0.08]))
    places_m = 500.0 + np.cumsum(rng.uniform(400.0, 1500.0, 9))
    forward = bool(rng.random() < 0.5)
    motion = _motion(rng, forward)
    run: dict[str, Any] = {
        "id": f"trial{seed}",
        "vehicle": kind in ("ramp", "slow ramp") or bool(rng.random() < 0.7),
        "motion": motion,
        "gnss": {
            "rate_hz": float(rng.choice([1.0, 10.0])),
            "sigma_east_m": sigma_m,
            "sigma_north_m": sigma_m,
            "sigma_up_m": 1.5 * sigma_m,
            "covariance": sigma_m != 1.0 or bool(rng.random() < 0.7),
            "velocity": kind in _ON_ODOMETER or bool(rng.random() < 0.5),
            "latency_s": latency_s,
        },
        "odometer": {"rate_hz": float(rng.choice([5.0, 20.0, 50.0])), "scale": scale},
        "faults": _faults(rng, kind, build_motion(RunSpec.model_validate({"id": "m", "motion": motion}).motion)),
    }
    return Scenario.model_validate(
        {
            "name": "random",
            "seed": seed,
            "vehicle": {
                "odometer_scale": scale,
                "odometer_scale_sigma": 1e-4,
                "gnss_latency_s": latency_s,
                "gnss_latency_sigma_s": 0.003,
            },
            "line": {
                "heading_deg": float(rng.uniform(0.0, 360.0)),
                "sections": [
                    {"length_m": float(rng.uniform(400.0, 1200.0)), "grade": float(rng.uniform(-0.01, 0.01))},
                    {"length_m": 700.0, "radius_m": float(rng.choice([-1.0, 1.0]) * rng.uniform(900.0, 4000.0))},
                ],
                "elements": [
                    {"id": f"NE{i}", "length_m": _LENGTH_M / 4.0, "reversed": bool(rng.random() < 0.5)}
                    for i in range(4)
                ],
                "balises": [{"id": f"VB{i}", "at_m": float(at_m)} for i, at_m in enumerate(places_m)],
            },
            "runs": [run],
        }
    )


def _motion(rng: np.random.Generator, forward: bool) -> dict[str, Any]:
    phases: list[dict[str, Any]] = [
        {"speed_mps": float(rng.uniform(20.0, 30.0)), "hold_s": float(rng.uniform(60.0, 100.0))}
        for _ in range(int(rng.integers(2, 4)))
    ]
    if rng.random() < 0.3:
        phases.insert(1, {"speed_mps": 0.0, "hold_s": float(rng.uniform(10.0, 60.0))})
    phases.append({"speed_mps": 0.0, "hold_s": 5.0})
    start_m = 300.0 if forward else _LENGTH_M - 300.0
    return {
        "start_m": start_m,
        "direction": "growing" if forward else "falling",
        "stand_s": float(rng.uniform(5.0, 60.0)),
        "phases": phases,
    }


def _faults(rng: np.random.Generator, kind: str, motion: Motion) -> list[dict[str, Any]]:
    """One fault in the middle of the run, where the train has run for a while; slow ones begin earlier."""
    part = rng.uniform(0.25, 0.5) if kind == "slow ramp" else rng.uniform(0.45, 0.8)
    start_s = float(part * motion.duration_s)
    sign = float(rng.choice([-1.0, 1.0]))
    fault: dict[str, Any] = {"start_s": start_s}
    if kind == "none":
        return []
    if kind == "step":
        fault |= {"kind": "step", "size_m": sign * float(rng.uniform(100.0, 2500.0))}
        fault |= {"duration_s": float(np.round(rng.uniform(2.0, 20.0)))}
    elif kind == "offset":
        fault |= {"kind": "step", "size_m": sign * float(rng.uniform(35.0, 150.0))}
    elif kind in ("ramp", "slow ramp"):
        rate = rng.uniform(0.4, 2.0) if kind == "ramp" else rng.uniform(0.08, 0.35)
        fault |= {"kind": "ramp", "rate_mps": sign * float(rate), "duration_s": float(rng.uniform(30.0, 300.0))}
    elif kind == "outage":
        fault |= {"kind": "outage", "duration_s": float(rng.uniform(5.0, 90.0))}
    elif kind == "scale":
        fault |= {"kind": "scale", "scale": 1.0 + sign * float(rng.uniform(0.02, 0.06))}
    else:
        fault |= {"kind": kind, "rate_mps": float(rng.uniform(4.0, 12.0)), "duration_s": float(rng.uniform(1.0, 4.0))}
    return [fault]


@dataclass(frozen=True)
class _World:
    """Without noise, at the epochs: time [s], way run, error in the direction of travel, places of the VBs [m]."""

    t_s: Floats
    way_m: Floats
    error_m: Floats
    names: tuple[str, ...]
    places_m: Floats
    margin_m: float

    def passed(self, a_m: float, b_m: float) -> frozenset[str]:
        low, high = min(a_m, b_m), max(a_m, b_m)
        return frozenset(n for n, at in zip(self.names, self.places_m, strict=True) if low < at <= high)

    def near(self, at_m: float) -> bool:
        return bool((np.abs(self.places_m - at_m) <= self.margin_m).any())


def _expected(scenario: Scenario, spec: RunSpec) -> tuple[ExpectedRow, ...] | None:
    """The rows of the hazard table; `None` where noise could change them."""
    position = [fault for fault in spec.faults if fault.target == "along"]
    if not position:
        return ()
    world = _world(scenario, spec, position[0])
    found = _Found()
    moves = np.flatnonzero((np.diff(world.error_m) != 0.0) | (np.abs(world.error_m[1:]) > LIMIT_M / 2.0)) + 1
    for k in moves.tolist():
        if not _look(world, k, found):
            return None
    return tuple(found.rows())


def _world(scenario: Scenario, spec: RunSpec, fault: PlacedFault) -> _World:
    motion = build_motion(spec.motion)
    t_s = np.arange(0.0, motion.duration_s + 1e-9, 1.0 / spec.gnss.rate_hz)
    exact = placed(fault, motion, spec.gnss.rate_hz)
    error_m = offset_m(exact, t_s, np.random.default_rng(0))
    way_m = motion.distance_m(t_s - spec.gnss.latency_s)
    names = tuple(balise.id for balise in scenario.line.balises)
    at_m = np.array([balise.at_m for balise in scenario.line.balises])
    places_m = (at_m - motion.start_m) * motion.sign
    return _World(t_s, way_m, error_m, names, places_m, 6.0 * spec.gnss.sigma_east_m + 2.0)


class _Found:
    """Jumps and early or late offers in time, sorted into rows."""

    def __init__(self) -> None:
        self.jumps: list[tuple[float, frozenset[str], bool]] = []
        self.hits: list[tuple[float, str, float]] = []

    def rows(self) -> list[ExpectedRow]:
        """An error's first event names its row; a jump back makes one of its own."""
        rows: list[ExpectedRow] = []
        hit = frozenset(name for _, name, _ in self.hits)
        begun = [jump for jump in self.jumps if not jump[2]]
        if begun:
            t_s, ids, _ = begun[0]
            rows.append(ExpectedRow(_class_of(ids), ids | hit, t_s, None, None))
        elif hit:
            t_s, _, error_m = self.hits[0]
            rows.append(ExpectedRow("VB_SHIFT", hit, t_s, error_m > 0.0, None))
        for t_s, ids, back in self.jumps:
            if back:
                rows.append(ExpectedRow(_class_of(ids), ids, t_s, None, 0 if rows else None))
        return rows


def _class_of(ids: frozenset[str]) -> str:
    return "VB_JUMP_1A" if len(ids) > 1 else "VB_JUMP_1B"


def _look(world: _World, k: int, found: _Found) -> bool:
    """Take the movement that leads to epoch `k`; false where it is too close to call."""
    a_m, b_m = world.way_m[k - 1] + world.error_m[k - 1], world.way_m[k] + world.error_m[k]
    step_m = world.error_m[k] - world.error_m[k - 1]
    t_s = float(world.t_s[k])
    if abs(step_m) > LIMIT_M:
        if any(world.near(at_m) for at_m in (a_m, b_m, world.way_m[k - 1], world.way_m[k])):
            return False
        ids = world.passed(a_m, b_m) - world.passed(a_m, a_m + world.way_m[k] - world.way_m[k - 1])
        if ids:
            found.jumps.append((t_s, ids, abs(world.error_m[k]) < abs(world.error_m[k - 1])))
        return True
    offered = world.passed(a_m, b_m)
    size_m = abs(float(world.error_m[k]))
    if offered and abs(size_m - LIMIT_M) < world.margin_m:
        return False
    if size_m > LIMIT_M:
        # A stand near a VB offers it again and again by noise alone.
        if world.near(b_m) and world.way_m[k] == world.way_m[k - 1]:
            return False
        found.hits += [(t_s, name, float(world.error_m[k])) for name in sorted(offered)]
    return True


def deviations(trial: RandomTrial, tables: RunTables) -> list[str]:
    """In words, what the tables of a trial say otherwise than expected; empty where all is right."""
    first = trial.run.gnss["t"].min()
    hazards = tables.hazards.with_columns(t_s=(pl.col("t_hazard") - first).dt.total_nanoseconds() * 1e-9)
    found = hazards.to_dicts()
    wrong: list[str] = []
    if len(found) != len(trial.rows):
        wrong.append(f"{len(found)} rows, expected {len(trial.rows)}: {[row['hazard'] for row in found]}")
    for row, expected in zip(found, trial.rows, strict=False):
        wrong += _differences(row, expected, trial)
    return wrong + _wrong_alarms(trial, tables)


def _differences(row: dict[str, Any], expected: ExpectedRow, trial: RandomTrial) -> list[str]:
    wrong = []
    if row["hazard"] != expected.hazard:
        wrong.append(f"{row['hazard']}, expected {expected.hazard}")
    if frozenset(row["balise_ids"]) != expected.balise_ids:
        wrong.append(f"balises {row['balise_ids']}, expected {sorted(expected.balise_ids)}")
    if row["caused_by"] != expected.caused_by:
        wrong.append(f"caused by {row['caused_by']}, expected {expected.caused_by}")
    if expected.early is not None and row["timing"] != ("early" if expected.early else "late"):
        wrong.append(f"timing {row['timing']}")
    period_s = nominal_period_s(trial.run.gnss["t"].dt.timestamp("ns").to_numpy()) or 1.0
    if expected.early is None and abs(row["t_s"] - expected.t_s) > period_s + 1e-6:
        wrong.append(f"step at {row['t_s']:.2f} s, expected {expected.t_s:.2f} s")
    if row["suspect"] not in ("gnss", "unknown"):
        wrong.append(f"suspect {row['suspect']}")
    return wrong + _late_detections(row, trial, period_s)


def _late_detections(row: dict[str, Any], trial: RandomTrial, period_s: float) -> list[str]:
    """Steps within one epoch; fast ramps before the failure."""
    detected, period = row["detected"], period_s + 1e-6
    is_step = trial.kind in ("step", "offset") and row["caused_by"] is None
    if is_step and not (detected and row["time_to_detect_s"] <= period):
        return [f"step detected after {row['time_to_detect_s']} s"]
    is_ramp = trial.kind == "ramp" and row["t_failure"] is not None
    if is_ramp and not (detected and row["time_since_failure_s"] <= 0.0):
        return [f"ramp detected {row['time_since_failure_s']} s after the failure"]
    return []


def _wrong_alarms(trial: RandomTrial, tables: RunTables) -> list[str]:
    wrong = []
    suspects = set(tables.alarms["suspect"].to_list())
    if trial.kind in ("none", "outage") and tables.alarms.height:
        wrong.append(f"alarm by {tables.alarms['monitors'].to_list()}")
    if trial.kind in _ON_ODOMETER and not suspects <= {"odometer", "unknown"}:
        wrong.append(f"suspects {sorted(suspects)} of a fault of the odometer")
    if trial.kind in ("step", "offset", "ramp", "slow ramp") and not suspects <= {"gnss", "unknown"}:
        wrong.append(f"suspects {sorted(suspects)} of a fault of the position")
    return wrong
