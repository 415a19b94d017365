"""From the tolerable hazard rate of a virtual balise to the time allowed for detecting a fault."""

from __future__ import annotations

import polars as pl

from pipeline.figures.bounds import hours_to_substantiate
from schemas.config import SafetyConfig

S_PER_H = 3600.0

ETCS_CORE_THR_PER_H = 2e-9  # TVB section 3, SUBSET-091
ONBOARD_THR_PER_H = 1e-9  # TVB section 3: the half of it
THR_BALISE_PER_H = 0.67e-9  # TVB section 3: balise transmission, taken over as THR_VB
THR_DELETION_PER_H = 3.3e-10  # TVB section 3, SUBSET-088
THR_INSERTION_PER_H = 3.3e-10
THR_CORRUPTION_PER_H = 1e-11
LAMBDA_IP_PER_H = 1e-9  # TVB section 2: a balise group
THR_SIGNAL_IN_SPACE_PER_H = 1e-8  # LOC section I (3InSat)

RECEIVER_PERIOD_S = 0.1  # TVB section 5: a receiver of 10 Hz


def allocation_table(config: SafetyConfig) -> pl.DataFrame:
    """How the ETCS core THR comes down to the virtual balise; `thr_per_h` [1/h]."""
    rows = [
        ("ETCS core, per train", ETCS_CORE_THR_PER_H, "", "TVB s.3, SUBSET-091"),
        ("on-board", ONBOARD_THR_PER_H, "ETCS core, per train", "TVB s.3"),
        ("trackside", ETCS_CORE_THR_PER_H - ONBOARD_THR_PER_H, "ETCS core, per train", "TVB s.3"),
        ("balise transmission", THR_BALISE_PER_H, "trackside", "TVB s.3"),
        ("balise deletion", THR_DELETION_PER_H, "balise transmission", "TVB s.3, SUBSET-088"),
        ("balise insertion", THR_INSERTION_PER_H, "balise transmission", "TVB s.3, SUBSET-088"),
        ("balise corruption", THR_CORRUPTION_PER_H, "balise transmission", "TVB s.3, SUBSET-088"),
        ("virtual balise, deletion and insertion", config.thr_vb_per_h, "", "TVB s.3 and configuration"),
        ("balise group (rate of failure)", LAMBDA_IP_PER_H, "", "TVB s.2"),
        ("signal in space, 3InSat", THR_SIGNAL_IN_SPACE_PER_H, "", "LOC s.I"),
    ]
    columns = ["quantity", "thr_per_h", "share_of", "source"]
    return pl.DataFrame(rows, schema=columns, orient="row")


def allowed_time_to_detect_s(thr_per_h: float, hazard_rate_per_h: float, demands_per_hour: float = 1.0) -> float:
    """Allowed time to detect and negate a fault [s] (TVB eq. 7; LOC eq. 6).

    The published form takes one VB per hour for granted; with more demands the time shrinks.
    """
    return thr_per_h / (hazard_rate_per_h * demands_per_hour) * S_PER_H


def tolerable_gnss_rate_per_h(thr_per_h: float, time_to_detect_s: float, demands_per_hour: float = 1.0) -> float:
    """Hazard rate of GNSS [1/h] that a detection within `time_to_detect_s` makes tolerable (TVB eq. 7)."""
    return thr_per_h / (time_to_detect_s / S_PER_H * demands_per_hour)


def tolerable_table(
    config: SafetyConfig, times_s: tuple[float, ...] = (2.0 * RECEIVER_PERIOD_S, 1.0, 10.0, 30.0, 100.0)
) -> pl.DataFrame:
    """The other way round: which hazard rate of GNSS a diagnosis of this speed could live with (TVB eq. 7)."""
    thr, demands = config.thr_vb_per_h, config.demands_per_hour
    rows = [
        (time_s, tolerable_gnss_rate_per_h(thr, time_s), demands, tolerable_gnss_rate_per_h(thr, time_s, demands))
        for time_s in times_s
    ]
    columns = ["time_to_detect_s", "tolerable_published_per_h", "demands_per_hour", "tolerable_per_h"]
    return pl.DataFrame(rows, schema=columns, orient="row")


def demands_per_hour(speed_kmh: float, spacing_m: float) -> float:
    """Virtual balises passed in an hour: 64 at 160 km/h and 2.5 km, 400 at 400 m."""
    return speed_kmh * 1000.0 / spacing_m


def allowed_table(
    config: SafetyConfig, period_s: float = RECEIVER_PERIOD_S, negation_s: float = RECEIVER_PERIOD_S
) -> pl.DataFrame:
    """Allowed time to detect per service level, as published and with the configured demands.

    The quickest possible negation takes one epoch and the negation time (TVB section 5).
    """
    rows = []
    for level, service in config.service_levels.items():
        allowed_s = config.allowed_time_to_detect_s(level)
        rows.append(
            {
                "service_level": level,
                "integrity_risk": service.integrity_risk,
                "exposure_s": service.exposure_s,
                "hazard_rate_per_h": service.hazard_rate_per_h,
                "allowed_published_s": allowed_time_to_detect_s(config.thr_vb_per_h, service.hazard_rate_per_h),
                "demands_per_hour": config.demands_per_hour,
                "allowed_s": allowed_s,
                "receiver_needs_s": period_s + negation_s,
                "receiver_quick_enough": period_s + negation_s <= allowed_s,
            }
        )
    return pl.DataFrame(rows)


def demands_table(
    config: SafetyConfig,
    speeds_kmh: tuple[float, ...] = (80.0, 160.0, 300.0),
    spacings_m: tuple[float, ...] = (400.0, 2000.0, 2500.0),
) -> pl.DataFrame:
    """What is left of the allowed time [s] when every VB passed in an hour is a demand."""
    rows = []
    for level, service in config.service_levels.items():
        for speed_kmh in speeds_kmh:
            for spacing_m in spacings_m:
                demands = demands_per_hour(speed_kmh, spacing_m)
                allowed_s = allowed_time_to_detect_s(config.thr_vb_per_h, service.hazard_rate_per_h, demands)
                rows.append((level, speed_kmh, spacing_m, demands, allowed_s))
    columns = ["service_level", "speed_kmh", "spacing_m", "demands_per_hour", "allowed_s"]
    return pl.DataFrame(rows, schema=columns, orient="row")


def substantiation_table(config: SafetyConfig, events: tuple[int, ...] = (0, 1, 2, 5)) -> pl.DataFrame:
    """Hours [h] that show a rate at 95 %, by events seen, for THR_VB and the rate of each service level."""
    targets = {"THR_VB": config.thr_vb_per_h} | {
        f"signal in space, {level}": service.hazard_rate_per_h for level, service in config.service_levels.items()
    }
    rows = [
        (target, rate, count, hours_to_substantiate(rate, count), hours_to_substantiate(rate, count) / 8766.0)
        for target, rate in targets.items()
        for count in events
    ]
    return pl.DataFrame(rows, schema=["target", "rate_per_h", "events", "hours", "years"], orient="row")
