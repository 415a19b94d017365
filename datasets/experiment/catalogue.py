"""Which monitor sees which fault first, how soon and how often, and what none sees: the program's own replay decides.

Every fault of the catalogue is put into the same journeys: a train on a line under a sky that does not change. They are
replayed with and without it. A monitor sees the fault where it fails at an epoch from the onset on at which it does not
fail in the healthy replay.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import polars as pl

from datasets.experiment.catalogue_faults import CatalogueFault, Journey, catalogue
from datasets.experiment.catalogue_report import catalogue_page, faults_table, monitors_table
from datasets.experiment.tables import Contents, Row
from datasets.line import LineAxis, build_line
from datasets.motion import build_motion
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from pipeline.results.workers import map_in_processes
from schemas.config import Configuration, Vehicle
from schemas.frozen import frozen
from schemas.inputs import BaliseReads
from schemas.monitors import MONITORS
from schemas.run import RunLog, RunTables, Site

REPETITIONS = 40
RATE_HZ = 1.0
SETTINGS = {"rate_hz": RATE_HZ}
_SOLUTION = "primary"
_OTHER = "dual"
# Columns of which no row may know anything.
_NULLABLE: dict[str, pl.DataType | type[pl.DataType]] = {
    **dict.fromkeys(("detected_s", "way_m", "failure_s"), pl.Float64),
    "first": pl.List(pl.String),
    "seen_s": pl.List(pl.Float64),
}
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
class PreparedJourney:
    """A journey with its scenario and line, built once for all faults."""

    plan: JourneyPlan
    scenario: Scenario
    line: LineAxis

    @property
    def vehicle(self) -> Vehicle:
        """What the replay knows of the train."""
        return self.scenario.vehicle or Vehicle()

    @property
    def first_ns(self) -> int:
        """First epoch [ns since 1970, UTC]."""
        return int(self.scenario.start.timestamp()) * 1_000_000_000

    @property
    def onset_ns(self) -> int:
        """When the fault begins [ns since 1970, UTC]."""
        return self.first_ns + round(self.plan.onset_s * 1e9)


def prepare_journey(plan: JourneyPlan, seed: int, rate_hz: float) -> PreparedJourney:
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
            "balises": [_balise_spec(k, plan) for k in range(count)],
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
        "runs": [{"id": "run", "motion": _motion_phases(plan)}],
    }
    scenario = Scenario.model_validate(spec)
    return PreparedJourney(plan, scenario, build_line(scenario.line))


def _motion_phases(plan: JourneyPlan) -> dict[str, object]:
    """Phases of a motion that reaches its speed within a minute and holds it."""
    steady_s = plan.span_s - 5.0 - SPEED_MPS / 0.5
    return {"start_m": 200.0, "phases": [{"speed_mps": SPEED_MPS, "acceleration_mps2": 0.5, "hold_s": steady_s}]}


def _balise_spec(number: int, plan: JourneyPlan) -> dict[str, object]:
    """One balise of the line, virtual or physical."""
    physical = plan.physical_every and number % plan.physical_every == plan.physical_every - 1
    name = f"{'PB' if physical else 'VB'}{number:03}"
    at_m = _FIRST_BALISE_M + _BALISES_EVERY_M * number
    return {"id": name, "at_m": at_m, "kind": "physical" if physical else "virtual"}


def with_fault(prepared: PreparedJourney, fault: CatalogueFault) -> tuple[RunLog, Site]:
    """The journey with the fault from its onset on; the noise is that of the healthy one."""
    placed = [{**one, "start_s": prepared.plan.onset_s + float(str(one["start_s"]))} for one in fault.injected]
    run_spec = prepared.scenario.runs[0]
    spec = type(run_spec).model_validate({**run_spec.model_dump(exclude={"faults"}), "faults": placed})
    scenario = prepared.scenario.model_copy(update={"runs": (spec,)})
    run = build_run(scenario, spec, prepared.line)
    site = build_site(scenario, prepared.line)
    if prepared.plan.physical_every:
        run = run.with_streams(balise_reads=_balise_reads(prepared))
    if fault.change is None:
        return run, site
    return fault.change(run, site, prepared.onset_ns, fault.size)


def _balise_reads(prepared: PreparedJourney) -> pl.DataFrame:
    """When the antenna is over each physical balise."""
    motion = build_motion(prepared.scenario.runs[0].motion)
    end_m = float(motion.chainage_m(np.array([motion.duration_s]))[0])
    passed = [one for one in prepared.scenario.line.balises if one.kind.value == "physical" and one.at_m < end_m]
    times = [prepared.first_ns + round(motion.time_at(one.at_m) * 1e9) for one in passed]
    table = pl.DataFrame({"t": times, "balise_id": [one.id for one in passed]})
    return BaliseReads.validate(table.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC"))), cast=True)


def run(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`catalogue` by fault, `monitors` by fault and monitor, `runs`, and `catalogue.md`."""
    runs = run_catalogue(repetitions, seed, jobs, config, catalogue())
    faults = faults_table(runs)
    monitors = monitors_table(runs)
    page = catalogue_page(faults, monitors)
    return {"catalogue": faults, "monitors": monitors, "runs": runs, "catalogue.md": page}


def run_catalogue(
    repetitions: int,
    seed: int = 1,
    jobs: int = 1,
    config: Configuration | None = None,
    faults: Sequence[CatalogueFault] = catalogue(),
) -> pl.DataFrame:
    """One row per fault and repetition, in the order of the catalogue; see `judged`."""
    journeys = dict.fromkeys(one.journey for one in faults)
    tasks = [(journey, number) for journey in journeys for number in range(repetitions)]
    replayed = partial(_replay_faults, tuple(faults), seed, with_comparison(config or Configuration()))
    rows = [row for part in map_in_processes(replayed, tasks, jobs) for row in part]
    order = {one.name: place for place, one in enumerate(faults)}
    rows.sort(key=lambda row: (order[str(row["fault"])], row["repetition"]))
    return pl.DataFrame(rows, infer_schema_length=None, schema_overrides=_NULLABLE)


def with_comparison(config: Configuration) -> Configuration:
    """The configuration with the two solutions compared, unless it names another one itself."""
    if config.monitors.channel_reference is not None:
        return config
    monitors = config.monitors.model_copy(update={"channel_reference": _OTHER})
    return config.model_copy(update={"monitors": monitors})


def _replay_faults(
    faults: tuple[CatalogueFault, ...], seed: int, config: Configuration, task: tuple[Journey, int]
) -> list[Row]:
    """One journey with one noise, and each of the faults that go into it."""
    journey, number = task
    prepared = prepare_journey(JOURNEYS[journey], 1_000 * seed + number, RATE_HZ)
    healthy = replay(*with_fault(prepared, CatalogueFault("healthy", 0.0, "")), prepared.vehicle, config)
    rows = []
    for fault in (one for one in faults if one.journey == journey):
        tables = healthy if fault.is_healthy else replay(*with_fault(prepared, fault), prepared.vehicle, config)
        rows.append(
            {"fault": fault.name, "kind": fault.kind, "size": fault.size, "unit": fault.unit}
            | {"journey": journey, "repetition": number}
            | judge_replay(prepared, tables, None if fault.is_healthy else healthy, config)
        )
    return rows


def judge_replay(prepared: PreparedJourney, tables: RunTables, healthy: RunTables | None, config: Configuration) -> Row:
    """What one replay shows of the fault; times from its onset.

    `seen_s`: by monitor when it first failed; `first`: those that failed at the first of these epochs, the largest
    over its threshold first. Without a healthy replay every failure counts. `failure_s`: first epoch with an
    along-track error beyond the limit. `unsafe`: balises accepted beyond it.
    """
    epochs = _epochs_from_onset(tables.epochs, prepared)
    without_fault = healthy.epochs if healthy is not None else tables.epochs.clear()
    failed_s = _first_fails(epochs, _epochs_from_onset(without_fault, prepared))
    detected_s = min(failed_s.values(), default=None)
    beyond = epochs.filter(pl.col("error_along_m").abs() > config.hazards.limits.failure_m)
    return {
        "detected_s": detected_s,
        "way_m": None if detected_s is None else _travelled_m(prepared, detected_s),
        "first": _failed_first(epochs, failed_s, detected_s),
        "failure_s": beyond["since_s"][0] if beyond.height else None,
        "unsafe": _count_unsafe(tables, prepared, config)
        - (_count_unsafe(healthy, prepared, config) if healthy else 0),
        "linking_errors": _count_linking_errors(tables) - (_count_linking_errors(healthy) if healthy else 0),
        "seen_s": [failed_s.get(monitor) for monitor in MONITORS],
        "budget_s": config.budget_s,
        "reaction_s": config.hazards.reaction_s if config.hazards.reaction_s is not None else 1.0 / RATE_HZ,
    }


def _epochs_from_onset(epochs: pl.DataFrame, prepared: PreparedJourney) -> pl.DataFrame:
    """The epochs of the solution from the onset on, with the time since then."""
    since = (pl.col("t").dt.timestamp("ns") - prepared.onset_ns) / 1e9
    return epochs.filter(pl.col("solution") == _SOLUTION).with_columns(since_s=since).filter(pl.col("since_s") >= 0.0)


def _first_fails(epochs: pl.DataFrame, healthy: pl.DataFrame) -> dict[str, float]:
    """Seconds to the first failure that the healthy replay does not have, by monitor."""
    states = [f"{monitor}_state" for monitor in MONITORS]
    both = epochs.select("t", "since_s", *states).join(
        healthy.select("t", *states), on="t", how="left", suffix="_healthy", maintain_order="left"
    )
    found = {}
    for monitor, state in zip(MONITORS, states, strict=True):
        fails = (pl.col(state) == "fail") & (pl.col(f"{state}_healthy") != "fail").fill_null(True)
        first = both.filter(fails)["since_s"]
        if first.len():
            found[monitor] = float(first[0])
    return found


def _failed_first(epochs: pl.DataFrame, failed_s: dict[str, float], detected_s: float | None) -> list[str]:
    """Monitors that failed first, the largest value over its threshold first."""
    if detected_s is None:
        return []
    row = epochs.row(by_predicate=pl.col("since_s") == detected_s, named=True)
    first = [monitor for monitor, since_s in failed_s.items() if since_s == detected_s]
    return sorted(first, key=lambda monitor: -abs(row[f"{monitor}_value"]) / row[f"{monitor}_threshold"])


def _travelled_m(prepared: PreparedJourney, since_s: float) -> float:
    """Distance of the train from the onset to the detection [m]."""
    motion = build_motion(prepared.scenario.runs[0].motion)
    begin_s = prepared.plan.onset_s
    at = motion.distance_m(pl.Series([begin_s, begin_s + since_s]).to_numpy())
    return float(at[1] - at[0])


def _count_unsafe(tables: RunTables, prepared: PreparedJourney, config: Configuration) -> int:
    """Virtual balises accepted from the onset on with an error beyond the limit."""
    wrong = (pl.col("status") == "accepted") & (pl.col("location_error_m").abs() > config.hazards.limits.failure_m)
    return tables.passages.filter(
        (pl.col("solution") == _SOLUTION)
        & wrong
        & (pl.col("kind") == "virtual")
        & (pl.col("t_offered").dt.timestamp("ns") >= prepared.onset_ns)
    ).height


def _count_linking_errors(tables: RunTables) -> int:
    """Passages with a linking error."""
    ours = tables.passages.filter(pl.col("solution") == _SOLUTION)
    return ours.filter(pl.col("linking_error") != "none").height
