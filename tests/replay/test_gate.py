"""A wrong date takes no memory: streams with a gap of 100 years, in a process that may take 1 GB more than it has."""

from __future__ import annotations

import subprocess
import sys

import pytest

if sys.platform != "linux":
    pytest.skip("reads /proc", allow_module_level=True)

_SCRIPT = """
import resource
from pathlib import Path
import polars as pl
from pipeline.studies.plausibility.fit import fit_report
from schemas.config import Configuration, Vehicle
from schemas.errors import BaliseError
from tests.replay.journeys import QUIET, journey
from pipeline.one_run import replay

motion = {"start_m": 200.0, "phases": [{"speed_mps": 60.0}, {"stop_at_m": 8000.0}]}
run, site = journey(gnss={"sky": {}, "rate_hz": 5.0}, motion=motion)
fixes = journey(gnss={**QUIET, "rate_hz": 5.0}, motion=motion, seed=9)[0].gnss
run = run.with_streams(
    reference=fixes.select("t", "latitude_deg", "longitude_deg", "height_m", pl.lit(0.1).alias("sigma_m")),
    gnss=pl.concat([run.gnss, run.gnss.with_columns(solution=pl.lit("second"))]),
)
config = Configuration()
replay(run, site, Vehicle(), config)
fit_report(run, config, site)
has = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (has + 1_000_000_000, has + 1_000_000_000))


def outcome(call, *arguments):
    try:
        return call(*arguments)
    except BaliseError as error:
        return str(error)


for stream in ("gnss", "odometer", "satellites", "reference", "balise_reads"):
    frame = run.stream(stream)
    whole = pl.lit(True) if stream != "gnss" else pl.col("solution") == "primary"
    late = whole & (pl.int_range(pl.len()) >= frame.filter(whole).height // 2)
    apart = frame.with_columns(t=pl.col("t") + pl.when(late).then(pl.duration(days=36525)).otherwise(pl.duration()))
    damaged = run.with_streams(**{stream: apart})
    tables = outcome(replay, damaged, site, Vehicle(), config)
    said = tables if isinstance(tables, str) else ",".join(tables.runs["status"])
    problems = outcome(fit_report, damaged, config, site).problems
    print(stream, said.split(";")[0], len(problems), sep="|")
"""


def test_a_gap_of_a_century_in_any_stream() -> None:
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    outcomes = [tuple(line.split("|")) for line in done.stdout.splitlines()]
    assert outcomes == [
        ("gnss", "failed,ok", "1"),
        ("odometer", "run: odometer, column t: lasts longer than a journey", "1"),
        ("satellites", "ok,ok", "0"),
        ("reference", "ok,ok", "0"),
        ("balise_reads", "ok,ok", "0"),
    ]
