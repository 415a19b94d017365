"""A scenario becomes a trial: a site and runs, in memory or on disk.

Every random number depends on the scenario's seed, the run's name and what is drawn, never on the order of work:
one run written alone has the bytes that it has in the whole trial.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import numpy as np
import polars as pl

from datasets.faults import FaultSpec, PlacedFault, faults_table
from datasets.line import LineAxis, balises_table, build_line, links_table, track_table
from datasets.mcap_log import write_mcap
from datasets.motion import Motion, build_motion
from datasets.odometer import odometer_stream
from datasets.receiver import TrainOnLine, gnss_streams, reference_stream
from datasets.scenario import LogKind, RunSpec, Scenario
from pipeline.read.ingest.correct import recorded_notes
from pipeline.storage import replace_files
from pipeline.storage.described import table_bytes
from schemas.config import Vehicle, settings_from, to_toml
from schemas.errors import OutputError
from schemas.inputs import SITE_SCHEMAS, STREAM_SCHEMAS
from schemas.run import STREAMS, RunLog, Site, Stream

# Runs of a trial start one hour after the other.
_RUN_SPACING = timedelta(hours=1)


def build_site(scenario: Scenario, line: LineAxis | None = None) -> Site:
    """The surveyed site of a scenario."""
    line = line or build_line(scenario.line)
    balises = balises_table(scenario.line) if scenario.line.balises else None
    return Site(track_table(line, _named_generator(scenario, "site", "survey")), links_table(scenario.line), balises)


def build_run(scenario: Scenario, spec: RunSpec, line: LineAxis | None = None) -> RunLog:
    """Simulate one run."""
    journey = TrainOnLine(line or build_line(scenario.line), build_motion(spec.motion), scenario.vehicle or Vehicle())
    first_ns = _start_ns(scenario, spec)
    faults = [place_fault(fault, journey.motion, spec.gnss.rate_hz) for fault in spec.faults]

    def rng(purpose: str) -> np.random.Generator:
        """Random numbers of this run for one purpose."""
        return _named_generator(scenario, spec.id, purpose)

    gnss, satellites = gnss_streams(spec.gnss, journey, faults, first_ns, rng("gnss"))
    last_ns = first_ns + round(journey.motion.duration_s * 1e9)
    odometer = reference = None
    if spec.odometer:
        odometer = odometer_stream(spec.odometer, journey.motion, faults, first_ns, rng("odometer"))
    if spec.reference:
        reference = reference_stream(spec.reference, journey, first_ns, rng("reference"))
    truth = faults_table(faults, first_ns, last_ns) if faults else None
    return RunLog(spec.id, gnss, odometer=odometer, satellites=satellites, reference=reference, faults=truth)


def place_fault(fault: PlacedFault, motion: Motion, rate_hz: float) -> FaultSpec:
    """A fault with its times: from the first GNSS epoch on once the train is at its place."""

    def epoch_s(time_s: float) -> float:
        """The first epoch at or after a time [s]."""
        return float(np.ceil(time_s * rate_hz - 1e-9) / rate_hz)

    start_s = epoch_s(motion.time_at(fault.at_m) if fault.at_m is not None else fault.begins_s())
    duration_s = fault.duration_s
    if fault.until_m is not None:
        duration_s = epoch_s(motion.time_at(fault.until_m)) - start_s
    given = fault.model_dump(exclude={"at_m", "until_m", "start_s", "duration_s"})
    return settings_from({**given, "start_s": start_s, "duration_s": duration_s}, FaultSpec, "scenario: faults")


def write_trial(scenario: Scenario, out: Path, done: Callable[[str], None] | None = None) -> list[Path]:
    """Write `site/`, `runs/`, `vehicle.toml` and the resolved `scenario.toml`; returns the runs' paths.

    One scenario always gives the same bytes. `done` gets the name of each run written.
    """
    line = build_line(scenario.line)
    try:
        write_site(build_site(scenario, line), out / "site")
        (out / "scenario.toml").write_text(to_toml(scenario), encoding="utf-8")
        if scenario.vehicle is not None:
            (out / "vehicle.toml").write_text(to_toml(scenario.vehicle), encoding="utf-8")
        paths = []
        for spec in scenario.runs:
            paths.append(write_run_log(build_run(scenario, spec, line), out / "runs", spec.log))
            if done is not None:
                done(spec.id)
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(error.filename or out)) from None
    return paths


def write_site(site: Site, folder: Path) -> None:
    """The tables of a site as Parquet (CONTRACT section 2)."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("track", "links", "balises", "route"):
        table: pl.DataFrame | None = getattr(site, name)
        if table is not None:
            (folder / f"{name}.parquet").write_bytes(table_bytes(table, name, SITE_SCHEMAS[name], {}))


def write_run_log(run: RunLog, folder: Path, log: LogKind = "parquet") -> Path:
    """One run under its own name: a folder of Parquet files, or an MCAP log (`json`, `protobuf`, `cdr`)."""
    path = folder / (run.run_id if log == "parquet" else f"{run.run_id}.mcap")
    write_run_as(run, path, log)
    return path


def write_run_as(run: RunLog, path: Path, log: LogKind | None = None) -> None:
    """One run at a path: `*.mcap` (JSON unless said otherwise, which keeps everything), else a folder of Parquet."""
    log = log or ("json" if path.suffix == ".mcap" else "parquet")
    if log != "parquet":
        write_mcap(run, path, encoding=log)
        return
    # No stream that an earlier run left here may be taken for one of this run, and without GNSS none is a run.
    contents = {f"{name}.parquet": _stream_bytes(name, run, path.name) for name in STREAMS}
    replace_files(path, contents, marker="gnss.parquet")


def _stream_bytes(name: Stream, run: RunLog, run_id: str) -> bytes | None:
    """A stream as a Parquet file."""
    stream = run.stream(name)
    if stream is None:
        return None
    return table_bytes(stream, name, STREAM_SCHEMAS[name], {"run_id": run_id, **recorded_notes(run, name)})


def _start_ns(scenario: Scenario, spec: RunSpec) -> int:
    """Start of a run [ns]; the hour follows its place in the scenario."""
    place = [run.id for run in scenario.runs].index(spec.id)
    start = scenario.start + place * _RUN_SPACING
    return int(start.timestamp()) * 1_000_000_000 + start.microsecond * 1000


def _named_generator(scenario: Scenario, owner: str, purpose: str) -> np.random.Generator:
    """Independent random numbers by name; CRC-32 serves as a stable number of a name."""
    return np.random.default_rng([scenario.seed, zlib.crc32(owner.encode()), zlib.crc32(purpose.encode())])
