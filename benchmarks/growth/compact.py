"""Twenty thousand runs in compact files: one short run under as many names, asked, resumed and shown."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import polars as pl

from benchmarks.results import Figure, children_peak_mb, own_peak_mb, processor_time
from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline import storage
from pipeline.campaign import Plan, make_plan, resume, run_campaign
from pipeline.campaign.compact import compact
from pipeline.campaign.waits import WAITS
from pipeline.results import packing, packs
from pipeline.results.marker import Marker
from pipeline.results.query import run_sql
from pipeline.results.software import software_digest
from pipeline.show.report import write_report
from schemas.run import RunLog
from schemas.tables import TABLES

MANY = 20_000
FEW = 100
_EPOCHS = 300
RESUME_S = 30.0
QUERY_S = 2.0
REPORT_S = 60.0
MEMORY_MB = 2000.0
_QUERIES = {
    "hazards by class": "SELECT hazard, count(*) AS n FROM hazards GROUP BY hazard",
    "verdicts": "SELECT verdict, count(*) AS n FROM runs GROUP BY verdict",
    "one run's epochs": "SELECT max(path_m) FROM epochs WHERE run_id = 'r00777'",
    "alarms of all epochs": "SELECT count(*) AS n FROM epochs WHERE alarm",
}


def measure(folder: Path, count: int = MANY) -> list[Figure]:
    """Processor time throughout: other work on the machine changes it little."""
    shutil.rmtree(folder, ignore_errors=True)
    log = _replayed(folder)
    packed = _packed_ms(folder, log)
    plan = _many(folder, log, count)
    figures = [Figure(f"compact, per run of {FEW}", packed, "ms")]
    for name in ("tables over all runs made", "again"):
        with processor_time() as watch:
            resumed = run_campaign(plan, jobs=2)
        figures.append(Figure(f"{count} complete runs called, {name}", watch.seconds, "s", RESUME_S))
        figures.append(Figure("of these replayed again", count - resumed.count_skipped, "runs", 0))
    for question, sql in _QUERIES.items():
        with processor_time() as watch:
            run_sql(folder / "many", sql)
        figures.append(Figure(f"SQL: {question}", watch.seconds, "s", QUERY_S))
    with processor_time() as watch:
        write_report(folder / "many")
    figures.append(Figure(f"campaign page of {count} runs", watch.seconds, "s", REPORT_S))
    return [*figures, Figure("peak memory", max(own_peak_mb(), children_peak_mb()), "MB", MEMORY_MB)]


def _replayed(folder: Path) -> Path:
    """Half a minute of a journey, and its result in `few`."""
    scenario = demo_scenario()
    run = build_run(scenario, next(spec for spec in scenario.runs if spec.id == "drift_early"))
    gnss = run.gnss.head(_EPOCHS)
    odometer = None if run.odometer is None else run.odometer.filter(pl.col("t") <= gnss["t"].max())
    whole = write_run_log(RunLog(run_id="one", gnss=gnss, odometer=odometer), folder / "one")
    write_site(build_site(scenario), folder / "site")
    run_campaign(make_plan([str(whole)], folder / "site", folder / "few"))
    return whole


def _packed_ms(folder: Path, log: Path) -> float:
    """Processor time of `compact` per run, on copies of the result."""
    for table in TABLES:
        source = folder / "few" / table / "run_id=one"
        for number in range(FEW):
            shutil.copytree(source, folder / "own" / table / f"run_id=r{number:05}")
    with processor_time() as watch:
        found = compact(folder / "own")
    assert (found.packed, log.exists()) == (FEW, True)
    return watch.seconds / FEW * 1000.0


def _many(folder: Path, log: Path, count: int) -> Plan:
    """The result of so many runs in packs, with what a campaign keeps of them; and its plan."""
    out = folder / "many"
    names = [f"r{number:05}" for number in range(count)]
    recorded, tables = packing._read_own_files(str(folder / "few"), "one")
    metadata = recorded.metadata
    listed = []
    for first in range(0, count, packing.RUNS_PER_PACK):
        writer = packing._PackWriter()
        for name in names[first : first + packing.RUNS_PER_PACK]:
            writer.add(Marker(name, recorded.sha256, json.dumps(metadata | {"run_id": name})), tables)
        listed.append(writer.write(packing._Step(str(out), software_digest(), ())))
    packs.write_list(out, listed)
    for name in names:
        (folder / "logs" / name).mkdir(parents=True)
        for file in log.iterdir():
            (folder / "logs" / name / file.name).hardlink_to(file)
    plan = make_plan([str(folder / "logs")], folder / "site", out)
    (outcome,) = run_campaign(make_plan([str(log)], folder / "site", folder / "few")).outcomes
    # Files that were linked just now count as written just now.
    WAITS.settled_s = 0.0
    proofs = {job.run_id: resume.proof_of(job, storage.signature(Path(job.address))) for job in plan.jobs}
    resume.keep_outcomes(plan, [replace(outcome, run_id=name, proof=proof) for name, proof in proofs.items()])
    return plan


if __name__ == "__main__":
    for figure in measure(Path(sys.argv[1]), int(sys.argv[2])):
        print(f"{figure.name:<45}{figure.value:10.2f} {figure.unit:<5} {figure.target or ''}", flush=True)
