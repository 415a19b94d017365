"""The journeys of the catalogue: a train on a line under a sky that does not change, healthy or with one fault."""

from __future__ import annotations

import numpy as np
import polars as pl

from datasets.experiment.catalogue_faults import CatalogueFault, Journey
from datasets.line import LineAxis, build_line
from datasets.motion import build_motion
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from schemas.config import Vehicle
from schemas.frozen import frozen
from schemas.inputs import BaliseReads
from schemas.run import RunLog, Site

SPEED_MPS = 30.0
# At this instant of the nominal almanac no satellite comes or goes above 10 degrees for the next 3 150 s: a change of
# the sky is a step of the position, and the catalogue is about other steps.
_START = "2024-03-20T21:57:00Z"
_MASK_DEG = 10.0
# The train is 15 m before a border of net elements when the fault begins: faults of the map begin there.
_ELEMENT_M = 2_833.0
_BALISES_EVERY_M = 500.0
_FIRST_BALISE_M = 700.0


@frozen
class JourneyPlan:
    """How long it lasts and when the fault begins [s after the first epoch], under which sky and where to.

    `physical_every`: every so many balises there is a physical one.
    """

    span_s: float
    onset_s: float
    physical_every: int = 0
    start: str = _START
    heading_deg: float = 140.0


JOURNEYS: dict[Journey, JourneyPlan] = {
    "short": JourneyPlan(900.0, 500.0),
    "long": JourneyPlan(5_400.0, 500.0),
    "physical": JourneyPlan(900.0, 500.0, physical_every=3),
}


@frozen
class Stage:
    """A journey made ready: its scenario and line, built once for all faults."""

    plan: JourneyPlan
    scenario: Scenario
    line: LineAxis

    @property
    def vehicle(self) -> Vehicle:
        return self.scenario.vehicle or Vehicle()

    @property
    def first_ns(self) -> int:
        return int(self.scenario.start.timestamp()) * 1_000_000_000

    @property
    def onset_ns(self) -> int:
        return self.first_ns + round(self.plan.onset_s * 1e9)


def stage(plan: JourneyPlan, seed: int, rate_hz: float) -> Stage:
    """Line, train and receiver: GPS as `primary`, GPS + Galileo as `dual`; scale and latency known."""
    length_m = SPEED_MPS * plan.span_s + 3_000.0
    count = int((length_m - _FIRST_BALISE_M) // _BALISES_EVERY_M)
    spec = {
        "name": "catalogue",
        "seed": seed,
        "start": plan.start,
        "vehicle": {
            "odometer_scale": 1.0,
            "odometer_scale_sigma": 1e-4,
            "gnss_latency_s": 0.0,
            "gnss_latency_sigma_s": 0.002,
        },
        "line": {
            "latitude_deg": 50.85,
            "longitude_deg": 4.35,
            "height_m": 100.0,
            "heading_deg": plan.heading_deg,
            "sections": [
                {"length_m": 2_500.0, "grade": 0.004},
                {"length_m": 600.0, "radius_m": 2_500.0},
                {"length_m": 2_500.0, "grade": -0.004},
                {"length_m": 600.0, "radius_m": -2_500.0},
            ],
            "elements": [{"id": f"NE{k:03}", "length_m": _ELEMENT_M} for k in range(int(length_m / _ELEMENT_M) + 2)],
            "balises": [_balise(k, plan) for k in range(count)],
            "parallels": [
                {"id": "BESIDE", "from_m": SPEED_MPS * (plan.onset_s - 100.0), "to_m": length_m, "left_m": 4.5}
            ],
        },
        "gnss": {
            "rate_hz": rate_hz,
            "sky": {"mask_deg": _MASK_DEG, "solutions": {"primary": ["gps"], "dual": ["gps", "galileo"]}},
        },
        "odometer": {"rate_hz": 10.0},
        "reference": {"rate_hz": 1.0},
        "runs": [{"id": "run", "motion": _motion(plan)}],
    }
    scenario = Scenario.model_validate(spec)
    return Stage(plan, scenario, build_line(scenario.line))


def _motion(plan: JourneyPlan) -> dict[str, object]:
    """To speed within a minute, then steady."""
    steady_s = plan.span_s - 5.0 - SPEED_MPS / 0.5
    return {"start_m": 200.0, "phases": [{"speed_mps": SPEED_MPS, "acceleration_mps2": 0.5, "hold_s": steady_s}]}


def _balise(number: int, plan: JourneyPlan) -> dict[str, object]:
    physical = plan.physical_every and number % plan.physical_every == plan.physical_every - 1
    name = f"{'PB' if physical else 'VB'}{number:03}"
    at_m = _FIRST_BALISE_M + _BALISES_EVERY_M * number
    return {"id": name, "at_m": at_m, "kind": "physical" if physical else "virtual"}


def with_fault(ready: Stage, fault: CatalogueFault) -> tuple[RunLog, Site]:
    """The journey with the fault from its onset on; the noise is that of the healthy one."""
    placed = [{**one, "start_s": ready.plan.onset_s + float(str(one["start_s"]))} for one in fault.injected]
    run_spec = ready.scenario.runs[0]
    spec = type(run_spec).model_validate({**run_spec.model_dump(exclude={"faults"}), "faults": placed})
    scenario = ready.scenario.model_copy(update={"runs": (spec,)})
    run = build_run(scenario, spec, ready.line)
    site = build_site(scenario, ready.line)
    if ready.plan.physical_every:
        run = run.with_streams(balise_reads=_reads(ready))
    if fault.change is None:
        return run, site
    return fault.change(run, site, ready.onset_ns, fault.size)


def _reads(ready: Stage) -> pl.DataFrame:
    """When the antenna is over each physical balise."""
    motion = build_motion(ready.scenario.runs[0].motion)
    end_m = float(motion.chainage_m(np.array([motion.duration_s]))[0])
    passed = [one for one in ready.scenario.line.balises if one.kind.value == "physical" and one.at_m < end_m]
    times = [ready.first_ns + round(motion.time_at(one.at_m) * 1e9) for one in passed]
    table = pl.DataFrame({"t": times, "balise_id": [one.id for one in passed]})
    return BaliseReads.validate(table.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC"))), cast=True)
