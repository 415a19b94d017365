"""A line of 9 km with virtual and physical balises, and journeys on it with one fault each."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import polars as pl

from datasets.motion import build_motion
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline import one_run
from schemas.config import Configuration, Vehicle
from schemas.inputs import BaliseReads
from schemas.run import RunLog, RunTables, Site

VEHICLE = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.002)
PLACES_M = (900.0, 1700.0, 2500.0, 3400.0, 4300.0, 5300.0, 6200.0, 7100.0)
LINE: dict[str, Any] = {
    "heading_deg": 70.0,
    "sections": [{"length_m": 1500.0, "grade": 0.004}, {"length_m": 900.0, "radius_m": 2500.0}],
    "elements": [
        {"id": "A", "length_m": 3000.0},
        {"id": "B", "length_m": 3000.0, "reversed": True},
        {"id": "C", "length_m": 3000.0},
    ],
    "balises": [
        *({"id": f"VB{i}", "at_m": at_m} for i, at_m in enumerate(PLACES_M)),
        *({"id": f"BG{i}", "at_m": at_m - 100.0, "kind": "physical"} for i, at_m in enumerate(PLACES_M)),
    ],
}
MOTION: dict[str, Any] = {"start_m": 200.0, "phases": [{"speed_mps": 30.0}, {"stop_at_m": 8000.0}]}
QUIET: dict[str, Any] = {"sigma_east_m": 1e-6, "sigma_north_m": 1e-6, "sigma_up_m": 1e-6, "reported_factor": 1e6}


def journey(
    *faults: dict[str, Any],
    gnss: dict[str, Any] | None = None,
    odometer: dict[str, Any] | None = None,
    motion: dict[str, Any] | None = None,
    seed: int = 5,
) -> tuple[RunLog, Site]:
    """One run with its site, built once; physical balises are read where the train passes them."""
    return _built(json.dumps([faults, gnss, odometer, motion, seed]))


@lru_cache(maxsize=64)
def _built(asked: str) -> tuple[RunLog, Site]:
    faults, gnss, odometer, motion, seed = json.loads(asked)
    spec: dict[str, Any] = {"id": "run", "motion": motion or MOTION, "faults": list(faults), "gnss": gnss or {}}
    spec["odometer"] = {"rate_hz": 20.0, **(odometer or {})}
    scenario = Scenario.model_validate({"name": "replay", "seed": seed, "line": LINE, "runs": [spec]})
    run = build_run(scenario, scenario.runs[0])
    return run.with_streams(balise_reads=_reads(run, scenario), faults=None), build_site(scenario)


def _reads(run: RunLog, scenario: Scenario) -> pl.DataFrame:
    motion = build_motion(scenario.runs[0].motion)
    start_ns = run.gnss["t"].dt.timestamp("ns")[0]
    names = [balise for balise in scenario.line.balises if balise.kind == "physical"]
    times = [start_ns + round(motion.time_at(balise.at_m) * 1e9) for balise in names]
    stamps = pl.Series("t", times, dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    return BaliseReads.validate(pl.DataFrame([stamps, pl.Series("balise_id", [b.id for b in names])]), cast=True)


@dataclass(frozen=True, eq=False)
class _Asked:
    """A replay that is asked for: the very same frames, vehicle and configuration."""

    run: RunLog
    site: Site
    vehicle: Vehicle | None
    config: Configuration | None

    def _key(self) -> tuple[object, ...]:
        parts = [id(getattr(whole, part.name)) for whole in (self.run, self.site) for part in fields(whole)]
        settings = [setting.model_dump_json() if setting else None for setting in (self.vehicle, self.config)]
        return self.run.run_id, *parts, *settings

    def __hash__(self) -> int:
        return hash(self._key())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Asked) and self._key() == other._key()


@lru_cache(maxsize=48)
def _replayed(asked: _Asked) -> RunTables:
    return one_run.replay(asked.run, asked.site, asked.vehicle, asked.config)


def replay(run: RunLog, site: Site, vehicle: Vehicle | None = None, config: Configuration | None = None) -> RunTables:
    """`pipeline.replay`, once for the same frames: tests ask different questions about one journey."""
    return _replayed(_Asked(run, site, vehicle, config))


def replayed(*faults: dict[str, Any], **settings: Any) -> RunTables:
    run, site = journey(*faults, **settings)
    return replay(run, site, VEHICLE)


def seconds(tables: RunTables, column: str) -> list[float | None]:
    """A time column of the hazards in seconds after the run's first epoch."""
    since = (tables.hazards[column] - tables.epochs["t"][0]).dt.total_nanoseconds()
    return [None if value is None else value * 1e-9 for value in since]


def hides_no_fault(changed: Callable[[RunLog], RunLog]) -> None:
    """A leap and a drift are found in the changed run as in the plain one, the drift at most 4 s later."""
    leap = {"kind": "step", "size_m": 850.0, "start_s": 150.0, "duration_s": 6.0}
    drift = {"kind": "ramp", "rate_mps": 2.5, "at_m": 3450.0, "duration_s": 30.0}
    for fault in (leap, drift):
        run, site = journey(fault)
        plain, found = (replay(logs, site, VEHICLE).hazards for logs in (run, changed(run)))
        assert plain.height
        assert found["detected"].all()
        assert found["hazard"].to_list() == plain["hazard"].to_list()
        assert found["time_to_detect_s"].max() < plain["time_to_detect_s"].max() + 4.0
