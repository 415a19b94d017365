"""From the tolerable hazard rate of a virtual balise to the time allowed for detecting a fault.

Rates [1/h], times [s]; every figure may be a number or a column.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TypeVar

import polars as pl

from pipeline.stages.run_row.bounds import hours_to_substantiate
from schemas.config import SafetyConfig

Figure = TypeVar("Figure", float, pl.Expr)

S_PER_H = 3600.0


@cache
def published_table(name: str, *figures: str) -> pl.DataFrame:
    """A table that the papers print, from its file next to this one; text except for `figures`."""
    table = pl.read_csv((files("pipeline.studies.safety") / f"{name}.csv").read_bytes(), infer_schema=False)
    return table.cast(dict.fromkeys(figures, pl.Float64)).with_columns(pl.col(pl.String).fill_null(""))


def allocation_table(config: SafetyConfig) -> pl.DataFrame:
    """How the ETCS core THR comes down to the virtual balise; `thr_per_h` [1/h]."""
    table = published_table("allocation", "thr_per_h")
    return table.with_columns(pl.col("thr_per_h").fill_null(config.thr_vb_per_h))


def levels_table(config: SafetyConfig) -> pl.DataFrame:
    """Rate of hazards of each service level [1/h], and the published time allowed [s]."""
    rates = {level: service.hazard_rate_per_h for level, service in config.service_levels.items()}
    table = pl.DataFrame({"service_level": list(rates), "rate": list(rates.values())})
    return table.with_columns(detect_s=allowed_time_to_detect_s(config.thr_vb_per_h, pl.col("rate")))


def combine_values(table: pl.DataFrame, **values: Sequence[float]) -> pl.DataFrame:
    """Every row of a table with every combination of some values."""
    for name, listed in values.items():
        table = table.join(pl.DataFrame({name: listed}), how="cross", maintain_order="left_right")
    return table


def allowed_time_to_detect_s(thr_per_h: float, hazard_rate_per_h: Figure, demands_per_hour: float = 1.0) -> Figure:
    """Allowed time to detect and negate a fault [s] (TVB eq. 7; LOC eq. 6).

    The published form takes one VB per hour for granted; with more demands the time shrinks.
    """
    return thr_per_h / (hazard_rate_per_h * demands_per_hour) * S_PER_H


def tolerable_gnss_rate_per_h(thr_per_h: float, time_to_detect_s: Figure, demands_per_hour: float = 1.0) -> Figure:
    """Hazard rate of GNSS [1/h] that a detection within `time_to_detect_s` makes tolerable (TVB eq. 7)."""
    return thr_per_h / (time_to_detect_s / S_PER_H * demands_per_hour)


def tolerable_table(config: SafetyConfig) -> pl.DataFrame:
    """The reverse: which hazard rate of GNSS a diagnosis of this speed could live with (TVB eq. 7)."""
    thr = config.thr_vb_per_h
    demands = config.demands_per_hour
    time_s = pl.col("time_to_detect_s")
    # The first is two periods of a receiver of 10 Hz (TVB section 5).
    return pl.DataFrame({"time_to_detect_s": [0.2, 1.0, 10.0, 30.0, 100.0]}).with_columns(
        tolerable_published_per_h=tolerable_gnss_rate_per_h(thr, time_s),
        demands_per_hour=pl.lit(demands),
        tolerable_per_h=tolerable_gnss_rate_per_h(thr, time_s, demands),
    )


def demands_per_hour(speed_kmh: Figure, spacing_m: Figure) -> Figure:
    """Virtual balises passed in an hour: 64 at 160 km/h and 2.5 km, 400 at 400 m."""
    return speed_kmh * 1000.0 / spacing_m


def allowed_table(config: SafetyConfig, period_s: float = 0.1, negation_s: float = 0.1) -> pl.DataFrame:
    """Allowed time to detect per service level, as published and with the configured demands.

    The quickest possible negation takes one epoch and the negation time (TVB section 5, a receiver of 10 Hz).
    """
    rows = [
        (level, service.integrity_risk, service.exposure_s, config.allowed_time_to_detect_s(level))
        for level, service in config.service_levels.items()
    ]
    allowed = pl.DataFrame(rows, schema=["service_level", "integrity_risk", "exposure_s", "allowed_s"], orient="row")
    return allowed.join(levels_table(config), on="service_level", maintain_order="left").select(
        *("service_level", "integrity_risk", "exposure_s"),
        hazard_rate_per_h="rate",
        allowed_published_s="detect_s",
        demands_per_hour=pl.lit(config.demands_per_hour),
        allowed_s="allowed_s",
        receiver_needs_s=pl.lit(period_s + negation_s),
        receiver_quick_enough=period_s + negation_s <= pl.col("allowed_s"),
    )


def demands_table(config: SafetyConfig) -> pl.DataFrame:
    """What is left of the allowed time [s] when every VB passed in an hour is a demand."""
    table = combine_values(levels_table(config), speed_kmh=(80.0, 160.0, 300.0), spacing_m=(400.0, 2000.0, 2500.0))
    demands = demands_per_hour(pl.col("speed_kmh"), pl.col("spacing_m"))
    allowed_s = allowed_time_to_detect_s(config.thr_vb_per_h, pl.col("rate") * pl.col("demands_per_hour"))
    return (
        table.with_columns(demands_per_hour=demands)
        .with_columns(allowed_s=allowed_s)
        .select("service_level", "speed_kmh", "spacing_m", "demands_per_hour", "allowed_s")
    )


def substantiation_table(config: SafetyConfig) -> pl.DataFrame:
    """Hours [h] that show a rate at 95 %, by number of events, for THR_VB and each service level's rate."""
    targets = {"THR_VB": config.thr_vb_per_h} | {
        f"signal in space, {level}": service.hazard_rate_per_h for level, service in config.service_levels.items()
    }
    rows = [
        (target, rate, count, hours_to_substantiate(rate, count), hours_to_substantiate(rate, count) / 8766.0)
        for target, rate in targets.items()
        for count in (0, 1, 2, 5)
    ]
    return pl.DataFrame(rows, schema=["target", "rate_per_h", "events", "hours", "years"], orient="row")
