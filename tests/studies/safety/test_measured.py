"""Campaign figures from small tables worked by hand."""

import math
from typing import Any

import polars as pl
import pytest

from pipeline.results.figures.campaign_figures import detection_by_level, measured_figures
from pipeline.results.figures.campaign_tables import campaign_levels
from pipeline.stages.run_row.bounds import clopper_pearson, independent_episodes, poisson_rate, poisson_rate_upper
from pipeline.studies.safety.sentences import plain_statements
from schemas.config import Configuration, SafetyConfig
from schemas.tables import Runs
from tests.tables import NS, hazards, table

CONFIG = SafetyConfig()


def with_run(frame: pl.DataFrame, run_id: str | list[str]) -> pl.DataFrame:
    ids = [run_id] * frame.height if isinstance(run_id, str) else run_id
    return frame.with_columns(pl.Series("run_id", ids, dtype=pl.String))


def runs(height: int, **columns: Any) -> pl.DataFrame:
    plain: dict[str, Any] = {
        "solution": "primary",
        "status": "ok",
        "duration_s": 3600.0,
        "held_s": 3600.0,
        "evidence_s": 3600.0,
        "judged_s": 3600.0,
        "in_use_s": 3600.0,
        "in_use_judged_s": 3600.0,
        "negated_s": 0.0,
        "evidence": "reference",
        "false_alarm_rate_per_h": 0.0,
        "false_alarms": 0,
        "share_unknown": 0.0,
    }
    return with_run(table(Runs, height, **(plain | columns)), [f"r{k}" for k in range(height)])


def failed(spent: list[list[tuple[float, float]]], **columns: Any) -> pl.DataFrame:
    """Runs with their failures: hazardous time of each, for certain and with what is unknown [s]."""
    frame = runs(len(spent), failures=[len(one) for one in spent], **columns)
    lists = {
        name: pl.Series([[pair[part] for pair in one] for one in spent], dtype=pl.List(pl.Float64))
        for part, name in enumerate(("failure_hazardous_s", "failure_hazardous_may_s"))
    }
    accepted = pl.Series([["right"] * len(one) for one in spent], dtype=frame.schema["failure_accepted"])
    return frame.with_columns(**lists, failure_accepted=accepted)


def fault(height: int, **columns: Any) -> pl.DataFrame:
    plain = {"t_onset": [k * 100 * NS for k in range(height)], "budget_s": 1.675}
    return with_run(hazards(height, solution="primary", **(plain | columns)), "r0")


NO_HAZARDS = fault(0)


def test_the_same_time_in_another_run_or_solution_is_another_event() -> None:
    frame = pl.concat([fault(1), with_run(fault(1), "r1"), fault(1).with_columns(solution=pl.lit("gps"))])
    assert independent_episodes(frame).height == 3


def test_rates_over_the_campaign() -> None:
    catalogue = runs(
        6,
        status=["ok", "partial", "ok", "ok", "failed", "ok"],
        evidence=["reference", "balise", "odometer", None, None, "reference"],
        duration_s=[3600.0, 1800.0, 7200.0, 3600.0, None, 1800.0],
        evidence_s=[3600.0, 1800.0, 7200.0, 0.0, None, 900.0],
        judged_s=[3600.0, 1440.0, 7200.0, 0.0, None, 900.0],
        in_use_s=[3000.0, 1800.0, 7200.0, 3600.0, None, 900.0],
        in_use_judged_s=[3000.0, 1800.0, 7200.0, 0.0, None, 600.0],
        negated_s=[600.0, 0.0, 0.0, 0.0, None, 900.0],
        false_alarms=[2, 0, None, None, None, 1],
        false_alarm_rate_per_h=[2.0, 0.0, None, None, None, None],
        balises_accepted=[10, 5, 5, 5, 0, 5],
        accepted_judged=[10, 5, 0, 0, 0, 3],
        unsafe_accepted=[0, 1, 2, 0, 0, 0],
        unproven_accepted=[0, 4, 3, 5, 0, 2],
        failures=[2, 1, 1, 0, 0, 0],
        failures_within_budget=[1, 0, 0, 0, 0, 0],
        failures_beyond_budget=[1, 0, 1, 0, 0, 0],
        verdict=["unsafe", "unsafe", "unsafe", "unproven", None, "unproven"],
        outages=[1, 0, 2, 0, 0, 0],
    )
    faults = fault(
        3,
        t_failure=[10 * NS, 120 * NS, None],
        t_detected=[11 * NS, None, None],
        time_since_failure_s=[1.0, None, None],
    )
    figures = measured_figures(catalogue, faults, CONFIG)
    found = figures.row(0, named=True)
    assert (found["runs"], found["runs_failed"], found["runs_partial"], found["hours"]) == (5, 1, 1, 5.0)
    assert (found["runs_unsafe"], found["runs_unproven"], found["runs_safe"]) == (3, 2, 0)
    assert (found["hours_with_evidence"], found["hours_with_truth"], found["hours_judged"]) == (3.75, 1.5, 1.4)
    # Rates count what was in use and judged: 600 s negated, 900 s negated and 300 s in use without a judgement do not.
    assert (found["hours_negated"], found["hours_unjudged"]) == (pytest.approx(1500 / 3600), pytest.approx(3900 / 3600))
    rate = poisson_rate(3, 1.5)
    assert (found["hazards"], found["hazards_judged"], found["hazard_rate_per_h"]) == (3, 3, pytest.approx(3 / 1.5))
    assert (found["hazard_rate_low_per_h"], found["hazard_rate_high_per_h"]) == (rate.low, rate.high)
    share = clopper_pearson(1, 2)
    assert (found["missed"], found["missed_known"], found["missed_share"]) == (1, 2, 0.5)
    assert (found["missed_share_low"], found["missed_share_high"]) == (share.low, share.high)
    # Of four failures one was within the budget; of one nobody can say, one was seen by the odometer alone.
    assert (found["failures"], found["failures_within_budget"], found["failures_beyond_budget"]) == (4, 1, 2)
    assert (found["failures_judged"], found["beyond_budget_share"]) == (2, 0.5)
    assert found["beyond_budget_rate_upper_per_h"] == poisson_rate_upper(3, 1.5)
    assert (found["false_alarms"], found["false_alarm_rate_per_h"]) == (2, pytest.approx(2 / 1.4))
    assert (found["accepted"], found["unsafe_accepted"], found["unproven_accepted"]) == (30, 3, 14)
    unsafe = clopper_pearson(1, 18)  # what nothing can judge is not safe
    assert (found["accepted_judged"], found["unsafe_judged"], found["unsafe_share"]) == (18, 1, unsafe.value)
    assert (found["unsafe_share_low"], found["unsafe_share_high"]) == (unsafe.low, unsafe.high)
    (sentence,) = plain_statements(figures)
    assert "4 position failures in use, at a virtual balise or not: 1 in time, 2 too late, 1 unknown" in sentence
    assert "Hours judged: 3.75, of these 1.5 by a truth" in sentence
    assert "Of 18 accepted virtual balises judged by a truth 1 were accepted despite a wrong position" in sentence
    assert "and 2 more by the odometer alone; 14 accepted ones could not be checked" in sentence


def test_a_trial_without_a_miss_says_what_it_lacks() -> None:
    figures = measured_figures(runs(100), NO_HAZARDS, CONFIG)
    found = figures.row(0, named=True)
    assert found["hours_needed"] == pytest.approx(4.4713e9, rel=1e-4)
    assert found["hours_still_needed"] == found["hours_needed"] - 100.0
    assert found["beyond_budget_rate_upper_per_h"] == pytest.approx(2.9957 / 100, rel=1e-4)
    (sentence,) = plain_statements(figures)
    assert "0 position failures in use, at a virtual balise or not: 0 in time, 0 too late." in sentence
    assert "not negated" not in sentence
    assert "Fault-free hours still needed to prove" in sentence
    assert "4.47e+09 h" in sentence


def test_a_trial_that_is_long_enough_says_so() -> None:
    loose = SafetyConfig(thr_vb_per_h=0.1)
    (sentence,) = plain_statements(measured_figures(runs(100), NO_HAZARDS, loose))
    assert "This proves a THR_VB of 1.00e-01/h at 95 % by counting" in sentence


def test_a_position_wrong_between_balises_is_not_kept_quiet() -> None:
    """No virtual balise was hit, yet for 0.4 % of the time the position was wrong and in use."""
    figures = measured_figures(runs(2, held_s=3600.0, share_p1=[0.008, 0.0]), NO_HAZARDS, CONFIG)
    assert "Position wrong and not blocked: 0.400% of the time in runs with a truth." in plain_statements(figures)[0]


def test_no_runs_no_rows() -> None:
    assert measured_figures(runs(0), NO_HAZARDS, CONFIG).height == 0
    assert measured_figures(runs(2, status="failed"), NO_HAZARDS, CONFIG).height == 0
    assert detection_by_level(runs(0), NO_HAZARDS, campaign_levels(runs(0), Configuration())).height == 0


def test_solutions_are_counted_apart() -> None:
    catalogue = runs(4, solution=["gps", "primary", "gps", "primary"], duration_s=[3600.0, 3600.0, 1800.0, 1800.0])
    figures = measured_figures(catalogue, with_run(fault(2), "r1"), CONFIG)
    assert figures["solution"].to_list() == ["gps", "primary"]
    assert figures["hazards"].to_list() == [0, 2]
    assert figures["hours"].to_list() == [1.5, 1.5]


def test_shares_are_of_failures_that_a_truth_judged() -> None:
    """The odometer alone can show that a position was wrong, never that it was right."""
    faults = fault(
        4,
        evidence=["reference", "odometer", "odometer", "balise"],
        t_failure=[10 * NS, 110 * NS, 210 * NS, 310 * NS],
        t_detected=[11 * NS, 111 * NS, None, None],
        time_since_failure_s=[1.0, 1.0, None, None],
    )
    columns = {"evidence": ["reference", "odometer"], "stanford_nominal": [5, 7], "stanford_hpl_nominal": [None, 7]}
    catalogue = failed([[(1.0, 1.0), (0.2, 0.2), (0.2, 9.0)], [(3.0, 3.0)]], **columns)
    figures = measured_figures(catalogue, faults, CONFIG)
    found, share = figures.row(0, named=True), clopper_pearson(1, 2)
    assert (found["missed"], found["missed_known"], found["missed_judged"]) == (2, 2, 1)
    assert (found["missed_share"], found["missed_share_low"]) == (0.5, share.low)
    assert (found["stanford_nominal"], found["stanford_hpl_nominal"]) == (5, None)
    (sentence,) = plain_statements(figures)
    assert "No monitor found 1 of 2 faults with a failure that a truth judged; 1 more are known by the" in sentence
    row = detection_by_level(catalogue, faults, campaign_levels(catalogue, Configuration())).row(
        1, named=True
    )  # LPV-200, 0.5025 s
    assert (row["failures"], row["within"], row["exceeded"]) == (4, 1, 2)
    assert (row["failures_judged"], row["within_judged"]) == (2, 1)
    assert (row["within_share"], row["within_share_high"]) == (0.5, share.high)


def test_a_run_fails_for_the_solution_that_failed_or_for_all() -> None:
    catalogue = with_run(
        runs(5, solution=["gps", "primary", "gps", "primary", ""], status=["failed", "ok", "ok", "ok", "failed"]),
        ["half", "half", "whole", "whole", "lost"],
    )
    figures = measured_figures(catalogue, NO_HAZARDS, CONFIG)
    assert figures.select("solution", "runs", "runs_failed").rows() == [("gps", 1, 2), ("primary", 2, 1)]


def test_measured_times_against_every_level() -> None:
    """Hazardous times 0.2, 1.0, 20 s and 0.3 s that may be 30 s, against 24.12, 0.5025, 1.675 and 100.5 s."""
    faults = fault(5, time_to_detect_s=[5.2, 6.0, 25.0, None, 2.0])
    catalogue = failed([[(0.2, 0.2), (1.0, 1.0)], [(20.0, 20.0), (0.3, 30.0)]])
    table = detection_by_level(catalogue, faults, campaign_levels(catalogue, Configuration()))
    assert table["service_level"].to_list() == ["npa", "lpv200", "egnos_observed", "horizontal_sis"]
    assert table["within"].to_list() == [3, 1, 2, 4]
    assert table["exceeded"].to_list() == [0, 2, 1, 0]
    assert set(table["failures"]) == {4}
    row = table.row(1, named=True)
    assert (row["hazardous_max_s"], row["hazardous_may_max_s"]) == (20.0, 30.0)
    assert row["hazardous_median_s"] == pytest.approx(0.65)
    assert (row["detected"], row["time_to_detect_median_s"], row["time_to_detect_max_s"]) == (4, 5.6, 25.0)
    bounds = clopper_pearson(1, 3)
    assert (row["within_share_low"], row["within_share_high"]) == (bounds.low, bounds.high)


def test_shares_continuity_and_stanford_counts_over_the_campaign() -> None:
    """Two runs of 1 h and 3 h; the second lost its position four times in 2 h; most of its states are not known."""
    catalogue = runs(
        2,
        evidence=["reference", "balise"],
        held_s=[3600.0, 10800.0],
        share_p0=[0.9, None],
        share_p1=[0.02, None],
        share_p2=[0.08, 0.04],
        share_p3=[0.0, 0.2],
        trusted_s=[3600.0, 7200.0],
        trusted_losses=[0, 4],
        stanford_nominal=[10, 20],
        stanford_hazardous=[0, 3],
        stanford_hpl_nominal=[None, 7],
    )
    found = measured_figures(catalogue, NO_HAZARDS, CONFIG).row(0, named=True)
    assert (found["share_p0"], found["share_p1"]) == (pytest.approx(0.225), pytest.approx(0.005))
    assert (found["share_p2"], found["share_p3"]) == (pytest.approx(0.05), pytest.approx(0.15))
    assert found["share_unknown"] == pytest.approx(0.57)
    assert (found["trusted_losses"], found["mtbf_h"]) == (4, 0.75)
    rate = poisson_rate(4, 3.0)
    assert rate.low is not None
    assert rate.high is not None
    assert (found["mtbf_low_h"], found["mtbf_high_h"]) == (1 / rate.high, 1 / rate.low)
    assert found["continuity_15s"] == pytest.approx(math.exp(-15 / 3600 / 0.75))
    assert found["continuity_15s_low"] < found["continuity_15s"] < found["continuity_15s_high"]
    assert (found["stanford_nominal"], found["stanford_hazardous"]) == (30, 3)
    assert (found["stanford_hpl_nominal"], found["stanford_hpl_hazardous"]) == (7, None)


def test_shares_of_time_are_of_one_time_and_what_is_left_is_unknown() -> None:
    """The odometer alone calls no position right, and time without a state is nobody's."""
    catalogue = runs(
        3,
        evidence=["balise", "odometer", "reference"],
        held_s=[3600.0, 36000.0, 1800.0],
        share_p0=[0.5, 1.0, 0.8],
        share_p1=[0.1, 0.0, None],
        share_p2=[0.2, 0.0, 0.2],
        share_p3=[0.1, 0.0, 0.0],
    )
    found = measured_figures(catalogue, NO_HAZARDS, CONFIG).row(0, named=True)
    assert found["share_p0"] == pytest.approx((1800 + 1440) / 5400)
    assert found["share_p1"] == pytest.approx(360 / 5400)
    assert (found["share_p2"], found["share_p3"]) == (pytest.approx(1080 / 5400), pytest.approx(360 / 5400))
    assert found["share_unknown"] == pytest.approx(360 / 5400)
    blind = measured_figures(catalogue.filter(pl.col("evidence") == "odometer"), NO_HAZARDS, CONFIG)
    row = blind.row(0, named=True)
    assert (row["share_p0"], row["share_p1"], row["share_p2"], row["share_unknown"]) == (None, None, 0.0, 1.0)


def test_without_a_loss_the_mtbf_has_a_lower_bound_alone() -> None:
    found = measured_figures(runs(1, trusted_s=7200.0), NO_HAZARDS, CONFIG).row(0, named=True)
    assert (found["mtbf_h"], found["mtbf_high_h"]) == (None, None)
    assert found["mtbf_low_h"] == pytest.approx(2.0 / 3.6889, rel=1e-4)
