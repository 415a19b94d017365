"""Continuity and mean time between failures (LOC section VI)."""

from __future__ import annotations

import polars as pl

from pipeline.figures.estimates import continuity
from pipeline.safety.budget import S_PER_H

APV_CONTINUITY_RISK = 8e-6  # LOC section VI: ICAO, APV I, per 15 s
APV_INTERVAL_S = 15.0
REQUIRED_MTBF_ONBOARD_H = 3e5  # LOC section VI: MTBF-S_ONB


def mtbf_h(continuity_risk: float, t_s: float) -> float:
    """MTBF [h] from a continuity risk per `t_s` (LOC eq. 10): 8e-6 per 15 s are 520.8 h."""
    return t_s / S_PER_H / continuity_risk


def mtbf_one_of_two_h(channel_mtbf_h: float, t_h: float = 1.0) -> float:
    """MTBF [h] of two redundant channels, one of which is enough (LOC eq. 11)."""
    return channel_mtbf_h**2 / t_h


def mtbf_two_of_two_h(channel_mtbf_h: float) -> float:
    """MTBF [h] of two channels that are compared, so that both are needed (two exponential lives)."""
    return channel_mtbf_h / 2.0


def continuity_table() -> pl.DataFrame:
    """MTBF and continuity by architecture, against what ETCS asks of on-board equipment."""
    single_h = mtbf_h(APV_CONTINUITY_RISK, APV_INTERVAL_S)
    rows = [
        ("1oo1, reactive", single_h, "LOC eq. 10"),
        ("1oo2, reactive", mtbf_one_of_two_h(single_h), "LOC eq. 11, t = 1 h"),
        ("2oo2, composite", mtbf_two_of_two_h(single_h), "ours: both channels are needed"),
    ]
    table = pl.DataFrame(rows, schema=["architecture", "mtbf_h", "source"], orient="row")
    return table.with_columns(
        continuity_15s=pl.Series([continuity(APV_INTERVAL_S, row[1]) for row in rows]),
        required_mtbf_h=pl.lit(REQUIRED_MTBF_ONBOARD_H),
        share_of_required=pl.col("mtbf_h") / REQUIRED_MTBF_ONBOARD_H,
        fulfilled=pl.col("mtbf_h") >= REQUIRED_MTBF_ONBOARD_H,
    ).select(pl.exclude("source"), "source")
