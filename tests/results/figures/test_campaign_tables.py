"""Campaign tables from a few rows worked by hand."""

from typing import Any

import polars as pl
import pytest

from pipeline.results.figures.campaign_figures import detection_by_level
from pipeline.results.figures.campaign_tables import (
    campaign_accuracy,
    campaign_balises,
    campaign_levels,
    campaign_runs,
    with_truth,
)
from pipeline.stages.run_row.bounds import clopper_pearson, poisson_rate
from schemas.campaign import CampaignAccuracy, CampaignBalises, campaign_runs_schema
from schemas.config import Configuration, SafetyConfig, ServiceLevel
from schemas.tables import Runs
from tests.tables import NS, hazards, passages, table

CONFIG = Configuration()
ACCEPTED = table(Runs, 0).schema["failure_accepted"]


def runs(ids: list[str], **columns: Any) -> pl.DataFrame:
    plain: dict[str, Any] = {"solution": "primary", "status": "ok", "duration_s": 1800.0, "evidence": "reference"}
    plain |= {"in_use_judged_s": columns.get("duration_s", 1800.0), "balises_accepted": 1, "faults_injected": True}
    return table(Runs, len(ids), **(plain | columns)).with_columns(run_id=pl.Series(ids, dtype=pl.String))


def faults(ids: list[str], **columns: Any) -> pl.DataFrame:
    plain: dict[str, Any] = {"t_onset": [k * NS for k in range(len(ids))], "budget_s": 1.675, "solution": "primary"}
    return hazards(len(ids), **(plain | columns)).with_columns(run_id=pl.Series(ids, dtype=pl.String))


def passages_of(ids: list[str], evidence: str | None = "reference", **columns: Any) -> pl.DataFrame:
    """Passages of runs with this evidence."""
    plain: dict[str, Any] = {
        "solution": "primary",
        "balise_id": "VB1",
        "kind": "virtual",
        "netelement_id": "ne1",
        "measure_m": 500.0,
        "status": "accepted",
        "failure_mode": "none",
        "linking_error": "none",
        "t_offered": [k * NS for k in range(len(ids))],
        "t_true": [k * NS for k in range(len(ids))],
        "location_error_m": 1.0,
        "judgement": "right",
    }
    frame = passages(len(ids), **(plain | columns)).with_columns(run_id=pl.Series(ids, dtype=pl.String))
    of_runs = frame.select("run_id", "solution").unique(maintain_order=True)
    catalogue = runs(of_runs["run_id"].to_list(), solution=of_runs["solution"].to_list(), evidence=evidence)
    return with_truth(frame, catalogue)


class TestRuns:
    def test_rates_bounds_and_verdicts(self) -> None:
        catalogue = runs(
            ["b", "a", "c", "d"],
            evidence=["reference", "reference", None, None],
            status=["ok", "ok", "ok", "failed"],
            balises_accepted=[10, 10, 0, 0],
            accepted_judged=[8, 10, 0, 0],
            unsafe_accepted=[1, 0, 0, 0],
            outages=[3, 0, 0, 0],
            duration_s=[1800.0, 1800.0, 1800.0, None],
        )
        found = campaign_runs(
            catalogue.with_columns(
                failures=pl.Series([3, 0, 0, 0]),
                failures_within_budget=pl.Series([1, 0, 0, 0]),
                failures_beyond_budget=pl.Series([1, 0, 0, 0]),
                failure_hazardous_s=pl.Series([[0.1, 1.0, 0.2], [], [], None]),
                failure_hazardous_may_s=pl.Series([[0.1, 1.0, 9.0], [], [], None]),
                failure_accepted=pl.Series([["right"] * 3, [], [], None], dtype=ACCEPTED),
            ),
            faults(["b", "b"], t_failure=[NS, 2 * NS], t_detected=[2 * NS, None], time_since_failure_s=[1.0, None]),
            CONFIG,
        )
        campaign_runs_schema(CONFIG.safety.service_levels).validate(found)
        assert found["run_id"].to_list() == ["a", "b", "c", "d"]
        row = found.row(1, named=True)
        rate, share = poisson_rate(2, 0.5), clopper_pearson(1, 2)
        assert (row["faults"], row["hazard_rate_per_h"]) == (2, 4.0)
        assert (row["hazard_rate_low_per_h"], row["hazard_rate_high_per_h"]) == (rate.low, rate.high)
        assert (row["failures"], row["missed"], row["missed_share"]) == (3, 1, 0.5)
        assert (row["missed_share_low"], row["missed_share_high"]) == (share.low, share.high)
        # One within the budget, one beyond it; of the third nobody can say, and no share counts it.
        assert (row["beyond_budget_share"], row["beyond_budget_share_high"]) == (0.5, share.high)
        assert (row["unsafe_share"], row["outage_rate_per_h"]) == (0.125, 6.0)
        assert (row["allowed_lpv200_s"], row["within_lpv200"]) == (pytest.approx(0.5025), 1)
        # A balise accepted wrong is beyond every level.
        assert (row["exceeded_lpv200"], row["within_egnos_observed"], row["within_npa"]) == (1, 2, 3)
        assert {row[f"verdict_{level}"] for level in ("lpv200", "egnos_observed", "npa")} == {"exceeded"}
        assert found["verdict_lpv200"].to_list() == ["no_failure", "exceeded", "unknown", "unknown"]
        assert found["hazard_rate_per_h"].to_list() == [0.0, 4.0, None, None]
        assert found["outage_rate_per_h"].to_list()[3] is None
        assert found["unsafe_share"].to_list() == [0.0, 0.125, None, None]
        assert found["unsafe_share_high"][0] == clopper_pearson(0, 10).high

    def test_shares_leave_out_what_the_odometer_alone_tells(self) -> None:
        """It can show that a position was wrong, never that it was right: its share would always be one."""
        counts = {"accepted_judged": 2, "unsafe_accepted": 2, "unproven_accepted": 8}
        hazards = faults(["a"], evidence="odometer", t_failure=[NS], t_detected=None)
        row = campaign_runs(runs(["a"], evidence="odometer", **counts), hazards, CONFIG).row(0, named=True)
        assert (row["unsafe_accepted"], row["unproven_accepted"], row["unsafe_share"]) == (2, 8, None)
        assert (row["missed"], row["missed_share"], row["hazard_rate_per_h"]) == (1, None, None)

    def test_a_failure_without_evidence_for_the_rest_is_still_a_failure(self) -> None:
        lost = runs(["a"], evidence=None, failures=1).with_columns(
            failure_hazardous_s=pl.Series([[200.0]]),
            failure_hazardous_may_s=pl.Series([[200.0]]),
            failure_accepted=pl.Series([["right"]], dtype=ACCEPTED),
        )
        assert campaign_runs(lost, faults([]), CONFIG)["verdict_npa"].to_list() == ["exceeded"]

    def test_levels_are_those_of_the_configuration(self) -> None:
        safety = SafetyConfig(service_levels={"lpv200": ServiceLevel(integrity_risk=1e-7, exposure_s=360.0)})
        found = campaign_runs(runs(["a"]), faults([]), Configuration(safety=safety))
        assert {name for name in found.columns if name.startswith("verdict_")} == {"verdict_lpv200"}

    def test_no_runs(self) -> None:
        assert campaign_runs(runs([]), faults([]), CONFIG).height == 0


class TestBalises:
    def test_shares_are_of_the_passages(self) -> None:
        found = campaign_balises(
            passages_of(
                ["a", "a", "b", "c", "d", "e"],
                status=["accepted", "accepted", "accepted", "missed", "rejected_window", "not_available"],
                t_true=[0, None, NS, NS, NS, NS],
                t_offered=[0, NS, NS, None, NS, None],
                location_error_m=[1.0, 30.0, -3.0, None, 40.0, None],
                failure_mode=["none", "insertion", "none", "deletion", "insertion", "deletion"],
                linking_error=["none", "none", "none", "missed", "early", "missed"],
                suspect_after_the_fact=[False, True, False, False, False, False],
                judgement=["right", "wrong", "right", None, "wrong", None],
            )
        )
        CampaignBalises.validate(found)
        row = found.row(0, named=True)
        assert (row["runs"], row["passages"], row["accepted"]) == (5, 5, 3)
        assert row["accepted_share"] == pytest.approx(2 / 5)
        assert (row["rejected"], row["missed"], row["not_available"], row["linking_errors"]) == (1, 1, 1, 3)
        deletion, unsafe = clopper_pearson(2, 5), clopper_pearson(1, 3)
        assert (row["deletions"], row["deletion_rate"]) == (2, 0.4)
        assert (row["deletion_rate_low"], row["deletion_rate_high"]) == (deletion.low, deletion.high)
        assert (row["unsafe_accepted"], row["accepted_judged"]) == (1, 3)
        assert (row["unsafe_rate_low"], row["unsafe_rate_high"]) == (unsafe.low, unsafe.high)
        assert (row["insertions"], row["suspect_after_the_fact"]) == (2, 1)
        assert row["location_error_mean_m"] == pytest.approx(28 / 3)
        assert row["location_error_sigma_m"] == pytest.approx(18.0093, abs=1e-4)
        assert (row["location_error_p95_m"], row["location_error_max_m"]) == (pytest.approx(27.3), 30.0)

    def test_without_evidence_nothing_is_known_of_unsafe_acceptances(self) -> None:
        row = campaign_balises(passages_of(["a", "b"], t_true=None, location_error_m=None, judgement="unknown")).row(
            0, named=True
        )
        assert (row["passages"], row["accepted"], row["accepted_judged"], row["unproven_accepted"]) == (2, 2, 0, 2)
        assert (row["unsafe_rate"], row["unsafe_rate_high"], row["location_error_mean_m"]) == (None, None, None)

    def test_the_odometer_alone_calls_no_acceptance_safe(self) -> None:
        """What it shows to be wrong is counted all the same, and no share counts it."""
        errors = {"location_error_m": None, "judgement": ["unknown", "wrong"]}
        frame = pl.concat(
            [passages_of(["a"], "balise", location_error_m=2.0), passages_of(["b", "b"], "odometer", **errors)]
        )
        row = campaign_balises(frame).row(0, named=True)
        assert (row["accepted"], row["accepted_judged"], row["unsafe_accepted"]) == (3, 1, 1)
        assert (row["unproven_accepted"], row["location_error_count"]) == (1, 1)
        assert (row["unsafe_rate"], row["unsafe_rate_high"]) == (0.0, clopper_pearson(0, 1).high)
        assert (row["location_error_mean_m"], row["location_error_max_m"]) == (2.0, 2.0)
        assert campaign_accuracy(frame, CONFIG)["location_error_count"].to_list() == [1, 1, 1]

    def test_solutions_and_kinds_apart_and_in_order(self) -> None:
        frame = pl.concat(
            [
                passages_of(["a"], solution="primary", balise_id="VB2"),
                passages_of(["a"], solution="gps"),
                passages_of(["a"], solution="primary"),
                passages_of(["a"], kind="physical", balise_id="BG9"),
            ]
        )
        found = campaign_balises(frame)
        assert found.select("solution", "balise_id").rows() == [
            ("gps", "VB1"), ("primary", "VB1"), ("primary", "VB2"), ("primary", "BG9"),
        ]  # fmt: skip

    def test_any_order_of_runs_gives_the_same_table(self) -> None:
        parts = [passages_of([run] * 3, location_error_m=[0.1 * k, 0.3, 1 / 3]) for k, run in enumerate("abcdefg")]
        forth, back = pl.concat(parts), pl.concat(parts[::-1])
        assert campaign_balises(forth).equals(campaign_balises(back))

    def test_nothing(self) -> None:
        assert campaign_balises(passages_of([])).height == 0


class TestAccuracy:
    def test_by_element_and_speed(self) -> None:
        frame = passages_of(
            ["a", "a", "a", "b", "b", "b"],
            netelement_id=["ne1", "ne2", "ne1", "ne1", "ne1", "ne1"],
            location_error_m=[1.0, -13.0, 2.0, 15.0, None, 99.0],
            status=["accepted"] * 5 + ["rejected_window"],
            speed_mps=[0.0, 11.2, 11.0, None, 5.0, 5.0],
            location_accuracy_m=12.0,
        )
        found = campaign_accuracy(frame, CONFIG)
        CampaignAccuracy.validate(found)
        rows = {(row["grouped_by"], row["group"]): row for row in found.iter_rows(named=True)}
        assert set(rows) == {
            ("all", ""), ("netelement_id", "ne1"), ("netelement_id", "ne2"),
            ("speed_band_kmh", "000-040"), ("speed_band_kmh", "040-080"), ("speed_band_kmh", "unknown"),
        }  # fmt: skip
        assert rows["all", ""]["location_error_count"] == 4
        assert (rows["all", ""]["within_location_accuracy"], rows["all", ""]["within_ci_limit"]) == (2, 3)
        assert rows["all", ""]["within_ci_limit_share_low"] == clopper_pearson(3, 4).low
        assert rows["netelement_id", "ne1"]["location_error_max_m"] == 15.0
        assert rows["speed_band_kmh", "000-040"]["location_error_mean_m"] == 1.5
        assert rows["netelement_id", "ne2"]["location_error_sigma_m"] is None

    def test_each_against_the_accuracy_of_its_own_balise(self) -> None:
        """4 m off: beyond the 3 m of the first balise, within the 5 m of the second."""
        frame = passages_of(["a"] * 3, location_error_m=[4.0, -4.0, 2.0], location_accuracy_m=[3.0, 5.0, 3.0])
        row = campaign_accuracy(frame, CONFIG).row(0, named=True)
        assert (row["location_error_count"], row["within_location_accuracy"]) == (3, 2)
        assert (row["location_accuracy_m"], row["location_accuracy_max_m"]) == (3.0, 5.0)
        assert row["location_error_median_m"] == 2.0


class TestLevels:
    @pytest.mark.parametrize(
        ("accepted", "expected"),
        [("right", (1, 0, "kept")), ("unknown", (0, 0, "unknown")), ("wrong", (0, 1, "exceeded"))],
    )
    def test_what_was_accepted_meanwhile_counts_at_every_level(
        self, accepted: str, expected: tuple[int, int, str]
    ) -> None:
        """0.1 s are within all levels; a balise accepted wrong in them is not (DOMAIN section 5.3)."""
        catalogue = runs(["a"], failures=1).with_columns(
            failure_hazardous_s=pl.Series([[0.1]]),
            failure_hazardous_may_s=pl.Series([[0.1]]),
            failure_accepted=pl.Series([[accepted]], dtype=ACCEPTED),
        )
        levels = campaign_levels(catalogue, CONFIG).select("within", "exceeded", "verdict").rows()
        assert set(levels) == {expected}
        detection = (
            detection_by_level(catalogue, faults([]), campaign_levels(catalogue, CONFIG))
            .select("within", "exceeded")
            .rows()
        )
        assert set(detection) == {expected[:2]}

    def test_every_run_against_every_level(self) -> None:
        given = {"evidence": ["reference", "reference", None], "failures": [2, 0, 0], "balises_accepted": [1, 1, 0]}
        catalogue = runs(["a", "b", "c"], **given).with_columns(
            failure_hazardous_s=pl.Series([[1.0, 0.2], [], []], dtype=pl.List(pl.Float64)),
            failure_hazardous_may_s=pl.Series([[1.0, 3.0], [], []], dtype=pl.List(pl.Float64)),
            failure_accepted=pl.Series([["right"] * 2, [], []], dtype=ACCEPTED),
            hazardous_max_s=pl.Series([1.0, None, None]),
        )
        found = campaign_levels(campaign_runs(catalogue, faults([]), CONFIG), CONFIG)
        shown = found.select("run_id", "service_level", "failures", "within", "exceeded", "verdict").rows()
        assert shown[:4] == [
            ("a", "npa", 2, 2, 0, "kept"),
            ("a", "lpv200", 2, 0, 1, "exceeded"),
            ("a", "egnos_observed", 2, 1, 0, "unknown"),
            ("a", "horizontal_sis", 2, 2, 0, "kept"),
        ]
        assert {row[5] for row in shown[4:8]} == {"no_failure"}
        assert {row[5] for row in shown[8:]} == {"unknown"}
        assert found["hazardous_max_s"][:5].to_list() == [1.0] * 4 + [None]
        assert found["hazardous_may_max_s"][:5].to_list() == [3.0] * 4 + [None]

    def test_a_receiver_too_slow_for_a_level_is_named(self) -> None:
        """1 Hz and one epoch for negation take 2 s, 10 Hz 0.2 s; LPV-200 allows 0.5025 s, EGNOS as observed 1.675 s."""
        catalogue = runs(["a", "b", "c"], gnss_rate_hz=[1.0, 10.0, None])
        wide = campaign_runs(catalogue, faults([]), CONFIG)
        found = campaign_levels(wide, CONFIG)
        shown = found.select("run_id", "service_level", "receiver_quick_enough").rows()
        assert [row[2] for row in shown] == [True, False, False, True] + [True] * 4 + [None] * 4
        assert found["receiver_needs_s"][0] == 2.0
        quick = campaign_levels(wide, Configuration.model_validate({"hazards": {"reaction_s": 0.1}}))
        assert quick["receiver_quick_enough"][:4].to_list() == [True, False, True, True]
