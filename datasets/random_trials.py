"""Seeded random trials: one run with one fault each, and the hazards that its replay must find.

Faults that come within the noise of a limit are drawn again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from datasets.expected_hazards import ExpectedRow, expected_hazards
from datasets.motion import Motion, build_motion
from datasets.scenario import RunSpec, Scenario
from datasets.trial import build_run, build_site
from schemas.config import Vehicle
from schemas.frozen import frozen
from schemas.run import RunLog, Site

KINDS = ("none", "step", "offset", "ramp", "slow ramp", "outage", "slip", "slide", "scale")
ON_ODOMETER = ("slip", "slide", "scale")
_LENGTH_M = 14_000.0
_DRAWS = 200


@frozen
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
        scenario = _random_scenario(seed, rng, kind)
        spec = scenario.runs[0]
        rows = expected_hazards(scenario, spec)
        if rows is not None:
            vehicle = scenario.vehicle if spec.vehicle else None
            site = build_site(scenario)
            run = build_run(scenario, spec)
            return RandomTrial(seed, kind, site, run, vehicle, rows, spec.gnss.sigma_east_m)
    raise AssertionError(f"no clear trial of kind {kind!r} in {_DRAWS} draws")


def _random_scenario(seed: int, rng: np.random.Generator, kind: str) -> Scenario:
    """A scenario drawn by a seed."""
    sigma_m = float(rng.choice([0.5, 1.0, 1.5]))
    scale = float(rng.choice([1.0, 1.003, 0.996]))
    latency_s = float(rng.choice([0.0, 0.08]))
    places_m = 500.0 + np.cumsum(rng.uniform(400.0, 1500.0, 9))
    forward = bool(rng.random() < 0.5)
    motion = _random_motion(rng, forward)
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
            "velocity": kind in ON_ODOMETER or bool(rng.random() < 0.5),
            "latency_s": latency_s,
        },
        "odometer": {"rate_hz": float(rng.choice([5.0, 20.0, 50.0])), "scale": scale},
        "faults": _random_fault(rng, kind, build_motion(RunSpec.model_validate({"id": "m", "motion": motion}).motion)),
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


def _random_motion(rng: np.random.Generator, forward: bool) -> dict[str, Any]:
    """A motion drawn at random."""
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


def _random_fault(rng: np.random.Generator, kind: str, motion: Motion) -> list[dict[str, Any]]:
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
