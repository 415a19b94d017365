"""The paper's findings as statements that hold or do not, and the share of geometries in which they do.

The findings stand in DIAG, section Simulation, for one sky that is lost. Each is put as a condition on
simulated times, judged per sky, constellation and reading of the odometer's noise, and null where it says nothing (the
failure never happens there).
"""

from __future__ import annotations

from functools import partial

import polars as pl

from datasets.experiment.diagnostics import detection_times, passages_of
from datasets.experiment.geometry import Geometry, skies_of_day
from datasets.experiment.plan import ExperimentPlan
from datasets.experiment.tables import Contents, share
from datasets.experiment.workers import generator
from pipeline.results.workers import mapped
from schemas.config import Configuration

EPOCHS_PER_PLACE = 40
REPETITIONS = 500
SETTINGS = {"epochs_per_place": EPOCHS_PER_PLACE}
_TWICE = 2.0
_THIRD_SMALLER = 2.0 / 3.0
# From this rate on, every ramp is to be detected; up to this one, spreads are compared.
_SLOWEST_COVERED_MPS = 0.03
_FASTEST_COMPARED_MPS = 1.0
_KEYS = ("constellation", "reading")

STATEMENTS: dict[str, str] = {
    "pmd_zero_0p03": "heading 0, odometer only: no run at 0.03 m/s is undetected at the failure (Fig. 5)",
    "pmd_zero_0p1": "heading 0, odometer only: no run at 0.10 m/s is undetected at the failure (Fig. 5)",
    "pmd_not_zero_0p01": "heading 0, odometer only: some run at 0.01 m/s is undetected at the failure (Fig. 5)",
    "dual_ahead": "heading 0: expected T_dsf of GPS + Galileo, cut off at the end of the 15 000 s, is below "
    "that of GPS at every rate (Fig. 7); at 0.01 m/s the cut decides, and over 60 000 s GPS alone is ahead",
    "dual_ahead_from_0p02": "the same at every rate from 0.02 m/s on, where hardly anything is cut off",
    "turning_away": "odometer only: T_d at 75 deg is at least twice that at 0 deg, or nothing is detected (Fig. 6)",
    "track_covers": "with track: every run from 0.03 m/s on is detected, at every heading (Fig. 6)",
    "track_steadies": "max/min of T_d over headings is with track at most 2/3 of odometer only, 0.03 to 1 m/s (Fig. 6)",
}


def made(repetitions: int, seed: int, jobs: int, config: Configuration | None = None) -> Contents:
    """`findings` (per sky) and `shares`."""
    skies = list(enumerate(skies_of_day(EPOCHS_PER_PLACE)))
    by_geometry = pl.concat(mapped(partial(_judge_sky, seed, repetitions), skies, jobs))
    return {"findings": by_geometry, "shares": shares(by_geometry)}


def shares(by_geometry: pl.DataFrame) -> pl.DataFrame:
    """Share of skies in which each finding holds, with exact bounds; `silent` counts those where it says nothing."""
    keys = ["finding", *_KEYS]
    counted = by_geometry.group_by(keys, maintain_order=True).agg(
        holds=pl.col("holds").sum(), judged=pl.col("holds").count(), silent=pl.col("holds").null_count()
    )
    bounds = [share("share", row["holds"], row["judged"]) for row in counted.iter_rows(named=True)]
    return (
        counted.hstack(pl.DataFrame(bounds, schema=dict.fromkeys(("share", "share_low", "share_high"), pl.Float64)))
        .with_columns(statement=pl.col("finding").replace_strict(STATEMENTS))
        .sort(keys)
    )


def _judge_sky(seed: int, repetitions: int, sky: tuple[int, tuple[Geometry, ...]]) -> pl.DataFrame:
    """`place, t, elevation_deg, constellation, reading, finding, holds`, one row per statement."""
    number, geometries = sky
    plans = [ExperimentPlan(geometry) for geometry in geometries]
    frames = [
        detection_times(plan, passages_of(plan, repetitions, generator(seed, number, index, 0)))
        for index, plan in enumerate(plans)
    ]
    geometry = geometries[0]
    return judge(pl.concat(frames)).select(
        pl.lit(geometry.place).alias("place"),
        pl.lit(geometry.t_ns).cast(pl.Datetime("ns", "UTC")).alias("t"),
        pl.lit(float(geometry.elevation_deg[geometry.faulty])).alias("elevation_deg"),
        pl.all(),
    )


def judge(detection: pl.DataFrame) -> pl.DataFrame:
    """`constellation, reading, finding, holds` from the table of detection times of one sky."""
    odometer_only = detection.filter(sensors="odometer")
    ahead = odometer_only.filter(heading_deg=0.0)
    pmd = pl.col("pmd_at_failure")
    time_s = pl.col("time_to_detect_s")
    # 0.10 m/s is the middle of the rates; faster ramps are seen within seconds whatever the heading.
    turned = odometer_only.filter(pl.col("heading_deg").is_in([0.0, 75.0]), rate_mps=0.1).sort("heading_deg")
    with_track = detection.filter(pl.col("rate_mps") >= _SLOWEST_COVERED_MPS, sensors="odometer_and_track")
    away = (time_s.last() >= _TWICE * time_s.first()) | (pl.col("detected").last() == 0)
    parts = [
        _holds("pmd_zero_0p03", ahead.filter(rate_mps=0.03), (pmd == 0).first()),
        _holds("pmd_zero_0p1", ahead.filter(rate_mps=0.1), (pmd == 0).first()),
        _holds("pmd_not_zero_0p01", ahead.filter(rate_mps=0.01), (pmd > 0).first()),
        _dual_ahead("dual_ahead", ahead),
        _dual_ahead("dual_ahead_from_0p02", ahead.filter(pl.col("rate_mps") >= 0.02)),
        _holds("turning_away", turned, away),
        _holds("track_covers", with_track, (pl.col("censored") == 0).all()),
        _track_steadies("track_steadies", detection),
    ]
    return pl.concat(parts).sort("finding", *_KEYS)


def _holds(finding: str, chosen: pl.DataFrame, holds: pl.Expr) -> pl.DataFrame:
    judged = chosen.group_by(_KEYS, maintain_order=True).agg(holds=holds)
    return judged.select(*_KEYS, finding=pl.lit(finding), holds="holds")


def _dual_ahead(finding: str, ahead: pl.DataFrame) -> pl.DataFrame:
    """Judged for odometer only, as Fig. 5; null where the failure never happens with one of the two."""
    times = ahead.pivot("constellation", index=["reading", "rate_mps"], values="time_since_failure_s").with_columns(
        constellation=pl.lit("gps_galileo"), ahead=pl.col("gps_galileo") < pl.col("gps")
    )
    every = pl.when(pl.col("ahead").null_count() == 0).then(pl.col("ahead").all())
    return _holds(finding, times, every)


def _track_steadies(finding: str, detection: pl.DataFrame) -> pl.DataFrame:
    compared = pl.col("rate_mps").is_between(_SLOWEST_COVERED_MPS, _FASTEST_COMPARED_MPS)
    spread = (
        detection.filter(compared)
        .group_by(*_KEYS, "rate_mps", "sensors", maintain_order=True)
        .agg(ratio=pl.col("time_to_detect_s").max() / pl.col("time_to_detect_s").min())
        .pivot("sensors", index=[*_KEYS, "rate_mps"], values="ratio")
    )
    return _holds(finding, spread, (pl.col("odometer_and_track") <= _THIRD_SMALLER * pl.col("odometer")).all())
