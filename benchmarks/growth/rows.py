"""How time and memory grow: ratios within one run, so that the machine does not matter.

Time of the LDS: the same journey of an hour is walked along with a few balises, or reads, and with four times as many.
Memory: `balise replay` of journeys of five solutions at 10 Hz, one twice as long as the other.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.results import Figure
from benchmarks.speed.end_to_end import command_peak_mb
from benchmarks.trials import line_scenario
from benchmarks.truth.relink import SCALE_SIGMA, SPEED_MPS, journey
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline.stages.alignment.align import align, odometer_at
from pipeline.stages.lds import run_lds
from pipeline.stages.matching import match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry import Odometry, odometry_of
from schemas.config import Configuration
from schemas.enums import BaliseKind
from schemas.stages import AlignedEpochs

DURATION_S = 3_600.0
FEW, TIMES = 2_500, 4
# Four times as much work may take four times as long, and what the machine adds; sixteen would be quadratic.
MOST = 6.0
SOLUTIONS = 5
HOURS = 4.0, 8.0
DAY_MB = 6_000.0


def measure(out: Path) -> list[Figure]:
    """Processor time of the LDS with four times the balises, and with four times the reads, over that with few."""
    config = Configuration()
    aligned, odometry = _aligned(config)
    figures: list[Figure] = []
    for kind in BaliseKind:
        seconds = [_seconds(aligned, odometry, count, kind, config) for count in (FEW, TIMES * FEW)]
        name = f"{TIMES * FEW} {kind.value} balises"
        figures.append(Figure(f"LDS, {name}", seconds[1], "s"))
        figures.append(Figure(f"LDS, {name} over {FEW}", seconds[1] / seconds[0], "times", MOST))
    return figures + _memory(out)


def _memory(out: Path) -> list[Figure]:
    """Peak memory by hours, and what a day comes to by the two."""
    few_mb, many_mb = (_peak_mb(out / f"hours-{hours:g}", hours) for hours in HOURS)
    an_hour_mb = (many_mb - few_mb) / (HOURS[1] - HOURS[0])
    return [
        Figure(f"peak memory, {HOURS[1]:g} h of {SOLUTIONS} solutions", many_mb, "MB"),
        Figure("memory of one hour of one solution", an_hour_mb / SOLUTIONS, "MB"),
        Figure(f"peak memory, a day of {SOLUTIONS} solutions", many_mb + (24.0 - HOURS[1]) * an_hour_mb, "MB", DAY_MB),
    ]


def _peak_mb(folder: Path, hours: float) -> float:
    """Peak memory of replaying one journey; the solutions differ by nothing but their names."""
    if not folder.exists():
        scenario = line_scenario(hours, balises=int(20 * hours), seed=11)
        run = build_run(scenario, scenario.runs[0])
        named = [run.gnss.with_columns(solution=pl.lit(f"receiver{number}")) for number in range(SOLUTIONS)]
        gnss = pl.concat(named).sort("t", "solution")
        write_site(build_site(scenario), folder / "site")
        write_run_log(run.with_streams(gnss=gnss, faults=None), folder / "runs")
    return command_peak_mb(folder / "runs", folder / "site", folder / "out")


def _aligned(config: Configuration) -> tuple[AlignedEpochs, Odometry]:
    """Aligned epochs of a steady journey, and its odometer."""
    t_s = np.arange(DURATION_S)
    made = journey(np.random.default_rng(1), t_s, np.zeros(t_s.size), 0.5)
    odometry = odometry_of(made.run.odometer, made.vehicle, config)
    assert odometry is not None
    matched = match(made.run.gnss, odometry, made.site, made.vehicle, config.matching, config.fix_sigma, None)
    odometry = odometry.growing_along_path(matched.odometer_sign)
    return align(matched.epochs, odometry, made.vehicle, config), odometry


def _seconds(aligned: AlignedEpochs, odometry: Odometry, count: int, kind: BaliseKind, config: Configuration) -> float:
    """Processor time of the LDS over a line with so many balises; the shorter of two goes."""
    places_m = np.linspace(500.0, SPEED_MPS * DURATION_S - 500.0, count)
    names = [f"B{number:05}" for number in range(count)]
    balises = pl.DataFrame({"balise_id": names, "path_m": places_m, "measure_m": places_m}).with_columns(
        leg=pl.lit(0, pl.Int32),
        kind=pl.lit(kind.value),
        netelement_id=pl.lit("E"),
        location_accuracy_m=pl.lit(12.0),
        linked=pl.lit(value=True),
        link_reaction=pl.lit("none"),
        valid_direction=pl.lit(0),
    )
    reads = None
    if kind is BaliseKind.PHYSICAL:
        since_s = (places_m - places_m[0]) / SPEED_MPS
        t_ns = aligned.t_ns[20] + np.round(since_s * 1e9).astype(np.int64)
        t = pl.Series("t", t_ns).cast(pl.Datetime("ns", "UTC"))
        reads = pl.DataFrame({"t": t, "balise_id": names, "odometer_m": odometer_at(t_ns, aligned, odometry)})
    seconds = []
    for _ in range(2):
        bank = MonitorBank(aligned, {}, config)
        begun = time.process_time()
        run_lds(aligned, bank, balises, reads, SCALE_SIGMA, config)
        seconds.append(time.process_time() - begun)
    return min(seconds)
