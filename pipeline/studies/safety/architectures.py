"""Linking, testing balise and travelling virtual balise; composite and reactive fail-safety; continuity.

Every figure may be a number or a column.
"""

from __future__ import annotations

import math

import polars as pl

from pipeline.stages.run_row.bounds import continuity_over
from pipeline.studies.safety.budget import S_PER_H, Figure, combine_values, levels_table
from pipeline.studies.safety.markov import lds_hazard_rate_per_h
from schemas.config import SafetyConfig

APV_CONTINUITY_RISK, APV_INTERVAL_S = 8e-6, 15.0  # LOC section VI: ICAO, APV I
REQUIRED_MTBF_ONBOARD_H = 3e5  # LOC section VI: MTBF-S_ONB


def linking_time_s(distance_m: Figure, speed_kmh: Figure) -> Figure:
    """T_L = D_L / v [s] between two linked information points (TVB eq. 3)."""
    return distance_m / (speed_kmh / 3.6)


def failure_probability(lambda_per_h: Figure, duration_s: Figure) -> Figure:
    """Probability that a failure lasting `duration_s` deletes an information point (TVB eq. 3 and 5)."""
    return lambda_per_h * duration_s / S_PER_H


def hazard_rate_with_linking_per_h(lambda_per_h: Figure, distance_m: Figure, speed_kmh: Figure) -> Figure:
    """Rate of deletions on a mission of 1 h [1/h] (TVB eq. 4): two missed in a row brake the train."""
    return lambda_per_h * 2.0 * linking_time_s(distance_m, speed_kmh) / S_PER_H


def hazard_rate_with_testing_per_h(lambda_per_h: Figure, time_to_detect_s: Figure) -> Figure:
    """Rate of deletions with a testing balise or a TVB [1/h] (TVB eq. 6): spacing plays no part."""
    return lambda_per_h * time_to_detect_s / S_PER_H


def architectures_table(config: SafetyConfig) -> pl.DataFrame:
    """Linking against TVB by service level, spacing and speed (TVB eq. 3-6), T_D as allowed by eq. 7.

    TVB section 2: 400 m between balises on average, 2500 m at most.
    """
    speeds_kmh = (40.0, 80.0, 120.0, 160.0, 200.0, 300.0)
    table = combine_values(levels_table(config), spacing_m=(400.0, 2000.0, 2500.0), speed_kmh=speeds_kmh)
    rate = pl.col("rate")
    detect_s = pl.col("detect_s")
    link_s = pl.col("linking_time_s")
    linked = hazard_rate_with_linking_per_h(rate, pl.col("spacing_m"), pl.col("speed_kmh"))
    return table.with_columns(linking_time_s=linking_time_s(pl.col("spacing_m"), pl.col("speed_kmh"))).select(
        *("service_level", "spacing_m", "speed_kmh", "linking_time_s"),
        two_linking_times_s=2.0 * link_s,
        deletion_probability=failure_probability(rate, link_s),
        linking_per_h=linked,
        linking_fulfils_thr=linked <= config.thr_vb_per_h,
        time_to_detect_s=detect_s,
        testing_or_tvb_per_h=hazard_rate_with_testing_per_h(rate, detect_s),
        gain=2.0 * link_s / detect_s,
    )


def composite_rate_per_h(
    first_per_h: float, second_per_h: float, time_to_detect_s: float, common_cause_share: float = 0.0
) -> float:
    """Rate [1/h] at which both of two compared channels are wrong at once.

    A fault of one lasts until the comparison negates it, and the other fails meanwhile:
    2 h1 h2 T_D, plus what strikes both (EN 50129:2003 annex B.3, independent channels; ours for the share).
    """
    both = 2.0 * first_per_h * second_per_h * time_to_detect_s / S_PER_H
    return both + common_cause_share * min(first_per_h, second_per_h)


def fail_safety_table(config: SafetyConfig) -> pl.DataFrame:
    """Reactive (LOC Fig. 4) and composite (LOC Fig. 3) fail-safety side by side per service level.

    Of two redundant reactive channels one is in use at a time, so that its faults alone count.
    `common_cause_limit` is the share of common causes at which the composite LDS alone uses up
    the THR: signals corrected by one SBAS are not independent.
    """
    channel_h = mtbf_h(APV_CONTINUITY_RISK, APV_INTERVAL_S)
    rows = []
    for level, rate, detect_s in levels_table(config).iter_rows():
        reactive = lds_hazard_rate_per_h(rate, detect_s)
        composite = composite_rate_per_h(rate, rate, detect_s)
        common = max(0.0, config.thr_vb_per_h - composite) / rate
        rows += [
            (level, "reactive 1oo1", detect_s, reactive, None, channel_h),
            (level, "reactive 1oo2", detect_s, reactive, None, mtbf_one_of_two_h(channel_h)),
            (level, "composite 2oo2", detect_s, composite, common, mtbf_two_of_two_h(channel_h)),
        ]
    columns = ["service_level", "architecture", "time_to_detect_s", "hazard_rate_per_h", "common_cause_limit", "mtbf_h"]
    table = pl.DataFrame(rows, schema=columns, orient="row")
    return table.with_columns(fulfils_thr=pl.col("hazard_rate_per_h") <= config.thr_vb_per_h * (1.0 + 1e-12))


def mtbf_h(continuity_risk: float, t_s: float) -> float:
    """MTBF [h] from a continuity risk per `t_s` (LOC eq. 10): 8e-6 per 15 s are 520.8 h."""
    return t_s / S_PER_H / continuity_risk


def mtbf_one_of_two_h(channel_mtbf_h: float) -> float:
    """MTBF [h] of two redundant channels, one of which is enough (LOC eq. 11, t = 1 h)."""
    return channel_mtbf_h**2


def continuity_one_of_two(t_s: float, channel_mtbf_h: float) -> float:
    """Probability that not both of two channels fail within the same `t_s`, from two sound ones at its start.

    The MTBF of LOC eq. 11 is that of a mission of 1 h, in which a failed channel is not repaired: put into eq. 8 with
    15 s it would count failures of the first channel that lie up to an hour back.
    """
    one_fails = -math.expm1(-t_s / S_PER_H / channel_mtbf_h)
    return 1.0 - one_fails**2


def mtbf_two_of_two_h(channel_mtbf_h: float) -> float:
    """MTBF [h] of two channels that are compared, so that both are needed (two exponential lives)."""
    return channel_mtbf_h / 2.0


def continuity_table() -> pl.DataFrame:
    """MTBF and continuity by architecture, against what ETCS asks of on-board equipment."""
    single_h = mtbf_h(APV_CONTINUITY_RISK, APV_INTERVAL_S)
    composite_h = mtbf_two_of_two_h(single_h)
    rows = [
        ("1oo1, reactive", single_h, continuity_over(APV_INTERVAL_S, single_h), "LOC eq. 8 and 10"),
        (
            "1oo2, reactive",
            mtbf_one_of_two_h(single_h),
            continuity_one_of_two(APV_INTERVAL_S, single_h),
            "MTBF LOC eq. 11, t = 1 h; continuity ours: both channels fail within the same 15 s",
        ),
        (
            "2oo2, composite",
            composite_h,
            continuity_over(APV_INTERVAL_S, composite_h),
            "ours: both channels are needed",
        ),
    ]
    table = pl.DataFrame(rows, schema=["architecture", "mtbf_h", "continuity_15s", "source"], orient="row")
    return table.with_columns(
        continuity_risk_15s=1.0 - pl.col("continuity_15s"),
        required_mtbf_h=pl.lit(REQUIRED_MTBF_ONBOARD_H),
        share_of_required=pl.col("mtbf_h") / REQUIRED_MTBF_ONBOARD_H,
        fulfilled=pl.col("mtbf_h") >= REQUIRED_MTBF_ONBOARD_H,
    ).select(pl.exclude("source"), "source")
