"""A short line and runs on it, for the tests of synthetic trials."""

from __future__ import annotations

from typing import Any

from datasets.scenario import Scenario

LINE: dict[str, Any] = {
    "latitude_deg": 50.0,
    "longitude_deg": 14.0,
    "height_m": 300.0,
    "heading_deg": 30.0,
    "sections": [
        {"length_m": 800.0, "grade": 0.01},
        {"length_m": 700.0, "radius_m": 900.0, "grade": -0.005},
        {"length_m": 500.0, "radius_m": -1200.0},
    ],
    "elements": [
        {"id": "A", "length_m": 1500.0},
        {"id": "B", "length_m": 2000.0, "reversed": True},
        {"id": "C", "length_m": 1500.0},
    ],
    "balises": [{"id": "VB1", "at_m": 700.0}, {"id": "VB2", "at_m": 1700.0}, {"id": "VB3", "at_m": 3600.0}],
}
MOTION: dict[str, Any] = {
    "start_m": 200.0,
    "phases": [{"speed_mps": 25.0}, {"stop_at_m": 3000.0, "acceleration_mps2": 0.5, "hold_s": 5.0}],
}
GPS_ONLY: dict[str, Any] = {"solutions": {"primary": ["gps"]}}
BOTH: dict[str, Any] = {"solutions": {"primary": ["gps", "galileo"], "gps": ["gps"]}}


def scenario(*runs: dict[str, Any], line: dict[str, Any] | None = None, **settings: Any) -> Scenario:
    """A scenario of runs that share line and motion; `settings` are top-level keys."""
    named = [{"id": f"run{number}", "motion": MOTION, **run} for number, run in enumerate(runs)]
    return Scenario.model_validate(
        {"name": "small", "seed": 7, "line": {**LINE, **(line or {})}, "runs": named, **settings}
    )
