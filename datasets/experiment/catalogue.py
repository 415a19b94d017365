"""Which monitor sees which fault first, how soon and how often, and what none sees: the program's own replay decides.

Every fault of the catalogue is put into the same journeys, which are replayed with and without it. A monitor sees the
fault where it fails at an epoch from the onset on at which it does not fail in the healthy replay.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import polars as pl

from datasets.experiment.catalogue_faults import CatalogueFault, Journey, catalogue
from datasets.experiment.catalogue_report import catalogue_page, faults_table, monitors_table
from datasets.experiment.catalogue_trial import JOURNEYS, Stage, stage, with_fault
from datasets.experiment.tables import Contents, Row
from datasets.motion import build_motion
from pipeline.one_run import replay
from pipeline.results.workers import mapped
from schemas.config import Configuration
from schemas.run import RunTables
from schemas.tables import MONITORS

REPETITIONS = 40
RATE_HZ = 1.0
SETTINGS = {"rate_hz": RATE_HZ}
_SOLUTION = "primary"
_OTHER = "dual"


def made(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
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
    replayed = partial(_replayed, tuple(faults), seed, compared(config or Configuration()))
    rows = [row for part in mapped(replayed, tasks, jobs) for row in part]
    order = {one.name: place for place, one in enumerate(faults)}
    rows.sort(key=lambda row: (order[str(row["fault"])], row["repetition"]))
    return pl.DataFrame(rows, schema=_SCHEMA, orient="row")


def compared(config: Configuration) -> Configuration:
    """The configuration with the two solutions compared, unless it names another one itself."""
    if config.monitors.channel_reference is not None:
        return config
    monitors = config.monitors.model_copy(update={"channel_reference": _OTHER})
    return config.model_copy(update={"monitors": monitors})


def _replayed(
    faults: tuple[CatalogueFault, ...], seed: int, config: Configuration, task: tuple[Journey, int]
) -> list[Row]:
    """One journey with one noise, and each of the faults that go into it."""
    journey, number = task
    ready = stage(JOURNEYS[journey], 1_000 * seed + number, RATE_HZ)
    healthy = replay(*with_fault(ready, CatalogueFault("healthy", 0.0, "")), ready.vehicle, config)
    rows = []
    for fault in (one for one in faults if one.journey == journey):
        tables = healthy if fault.is_healthy else replay(*with_fault(ready, fault), ready.vehicle, config)
        rows.append(
            {"fault": fault.name, "kind": fault.kind, "size": fault.size, "unit": fault.unit}
            | {"journey": journey, "repetition": number}
            | judged(ready, tables, None if fault.is_healthy else healthy, config)
        )
    return rows


def judged(ready: Stage, tables: RunTables, healthy: RunTables | None, config: Configuration) -> Row:
    """What one replay shows of the fault; times from its onset.

    `seen_s`: by monitor when it first failed; `first`: those that failed at the first of these epochs, loudest first.
    Without a healthy replay beside it every failure counts. `failure_s`: first epoch with an along-track error beyond
    the limit. `unsafe`: balises accepted beyond it.
    """
    epochs = _from_onset(tables.epochs, ready)
    beside = healthy.epochs if healthy is not None else tables.epochs.clear()
    seen = _first_fails(epochs, _from_onset(beside, ready))
    detected_s = min(seen.values(), default=None)
    beyond = epochs.filter(pl.col("error_along_m").abs() > config.hazards.limits.failure_m)
    return {
        "detected_s": detected_s,
        "way_m": None if detected_s is None else _way_m(ready, detected_s),
        "first": _loudest(epochs, seen, detected_s),
        "failure_s": beyond["since_s"][0] if beyond.height else None,
        "unsafe": _unsafe(tables, ready, config) - (_unsafe(healthy, ready, config) if healthy else 0),
        "linking_errors": _linking_errors(tables) - (_linking_errors(healthy) if healthy else 0),
        "seen_s": [seen.get(monitor) for monitor in MONITORS],
        "budget_s": config.budget_s,
        "reaction_s": config.hazards.reaction_s if config.hazards.reaction_s is not None else 1.0 / RATE_HZ,
    }


def _from_onset(epochs: pl.DataFrame, ready: Stage) -> pl.DataFrame:
    since = (pl.col("t").dt.timestamp("ns") - ready.onset_ns) / 1e9
    return epochs.filter(pl.col("solution") == _SOLUTION).with_columns(since_s=since).filter(pl.col("since_s") >= 0.0)


def _first_fails(epochs: pl.DataFrame, healthy: pl.DataFrame) -> dict[str, float]:
    """By monitor the seconds to its first failure that the healthy replay does not have."""
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


def _loudest(epochs: pl.DataFrame, seen: dict[str, float], detected_s: float | None) -> list[str]:
    """Monitors that failed first, by their value over the threshold."""
    if detected_s is None:
        return []
    row = epochs.row(by_predicate=pl.col("since_s") == detected_s, named=True)
    first = [monitor for monitor, since_s in seen.items() if since_s == detected_s]
    return sorted(first, key=lambda monitor: -abs(row[f"{monitor}_value"]) / row[f"{monitor}_threshold"])


def _way_m(ready: Stage, since_s: float) -> float:
    """Way of the train from the onset to the detection [m]."""
    motion = build_motion(ready.scenario.runs[0].motion)
    begin_s = ready.plan.onset_s
    at = motion.distance_m(pl.Series([begin_s, begin_s + since_s]).to_numpy())
    return float(at[1] - at[0])


def _unsafe(tables: RunTables, ready: Stage, config: Configuration) -> int:
    """Virtual balises accepted from the onset on with an error beyond the limit."""
    wrong = (pl.col("status") == "accepted") & (pl.col("location_error_m").abs() > config.hazards.limits.failure_m)
    return tables.passages.filter(
        (pl.col("solution") == _SOLUTION)
        & wrong
        & (pl.col("kind") == "virtual")
        & (pl.col("t_offered").dt.timestamp("ns") >= ready.onset_ns)
    ).height


def _linking_errors(tables: RunTables) -> int:
    ours = tables.passages.filter(pl.col("solution") == _SOLUTION)
    return ours.filter(pl.col("linking_error") != "none").height


_SCHEMA: dict[str, pl.DataType | type[pl.DataType]] = {
    "fault": pl.String,
    "kind": pl.String,
    "size": pl.Float64,
    "unit": pl.String,
    "journey": pl.String,
    "repetition": pl.Int64,
    "detected_s": pl.Float64,
    "way_m": pl.Float64,
    "first": pl.List(pl.String),
    "failure_s": pl.Float64,
    "unsafe": pl.Int64,
    "linking_errors": pl.Int64,
    "seen_s": pl.List(pl.Float64),
    "budget_s": pl.Float64,
    "reaction_s": pl.Float64,
}
