"""How the time of the LDS grows with what is on the line: ratios within one run, so that the machine does not matter.

The same journey of an hour is walked along with a few balises, or reads, and with four times as many.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.relink import SCALE_SIGMA, SPEED_MPS, journey
from benchmarks.results import Figure
from pipeline.stages.alignment.align import align, odometer_at
from pipeline.stages.lds import run_lds
from pipeline.stages.matching import match
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry import Odometry, odometry_of
from schemas.config import Configuration
from schemas.enums import BaliseKind

DURATION_S = 3_600.0
FEW, TIMES = 2_500, 4
# Four times as much work may take four times as long, and what the machine adds; sixteen would be quadratic.
MOST = 6.0


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
    return figures


def _aligned(config: Configuration) -> tuple[pl.DataFrame, Odometry]:
    """Aligned epochs of a steady journey, and its odometer."""
    t_s = np.arange(DURATION_S)
    made = journey(np.random.default_rng(1), t_s, np.zeros(t_s.size), 0.5)
    odometry = odometry_of(made.run.odometer, made.vehicle, config)
    assert odometry is not None
    matched = match(made.run.gnss, odometry, made.site, made.vehicle, config.matching, config.fix_sigma, None)
    odometry = odometry.oriented(matched.odometer_sign)
    return align(matched.epochs, odometry, made.vehicle, config), odometry


def _seconds(aligned: pl.DataFrame, odometry: Odometry, count: int, kind: BaliseKind, config: Configuration) -> float:
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
        t_ns = aligned["t"].dt.epoch("ns")[20] + np.round(since_s * 1e9).astype(np.int64)
        t = pl.Series("t", t_ns).cast(pl.Datetime("ns", "UTC"))
        reads = pl.DataFrame({"t": t, "balise_id": names, "odometer_m": odometer_at(t, aligned, odometry)})
    seconds = []
    for _ in range(2):
        bank = MonitorBank(aligned, {}, config)
        begun = time.process_time()
        run_lds(aligned, bank, balises, reads, SCALE_SIGMA, config)
        seconds.append(time.process_time() - begun)
    return min(seconds)
