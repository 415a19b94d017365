"""The `runs` row from small tables whose figures are worked by hand."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.stages.judge.judge import Judged
from pipeline.stages.judge.judged import JudgedEpochs
from pipeline.stages.prepare import Provenance
from pipeline.stages.run_row.lost_time import lost_columns
from pipeline.stages.run_row.summary import SolutionResults, failed_row, summarise
from schemas.config import Configuration, LdsConfig
from schemas.enums import Evidence, Note, VehicleFigures
from schemas.monitors import SCALES
from schemas.run import IngestNotes
from schemas.tables import CONTRACT_VERSION, Runs
from schemas.words import Remark
from tests.arrays_of_table import arrays_of_table
from tests.tables import NS, alarms, epochs, failures, hazards, passages

COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("odometer_contradicted", "duplicates", "out_of_order", "ambiguous_stretches"), 0),
    "vehicle": VehicleFigures.FILE,
    "faults_injected": False,
}
PROVENANCE = Provenance("c" * 64, "i" * 64, "balise 0.1.0")
CONFIG = Configuration()
ACCEPTED = {"status": "accepted", "judgement": "right"}
_TIMES_S = [0.0, 1.0, 2.0, 6.0, 7.0, 8.0]


def results(frame: pl.DataFrame, **fields: Any) -> SolutionResults:
    epochs = arrays_of_table(JudgedEpochs, frame)
    absent: Any = None
    suspect = np.zeros(epochs.height, dtype=np.bool_)
    tables = hazards(), alarms(), passages()
    nothing = Judged(*tables, failures(), epochs, absent, suspect, None, Evidence.REFERENCE)
    given = {name: fields.pop(name) for name in vars(nothing) if name in fields}
    own = {name: fields.pop(name) for name in ("ingest", "notes") if name in fields}
    lost = lost_columns(epochs, CONFIG)
    undetected = frame.select(pl.col("^undetected_.*$"))
    return SolutionResults("primary", lost, replace(nothing, **given), undetected, COLUMNS | fields, **own)


def row(frame: pl.DataFrame, config: Configuration = CONFIG, **fields: Any) -> dict[str, Any]:
    summary = summarise(results(frame, **fields), config, PROVENANCE)
    assert summary.height == 1
    return summary.row(0, named=True)


def seconds(count: int) -> list[float]:
    return [float(k) for k in range(count)]


def test_columns_are_those_of_the_contract_in_order() -> None:
    summary = summarise(results(epochs(seconds(3))), CONFIG, PROVENANCE)
    assert summary.columns == list(Runs.columns())
    assert summary.schema == failed_row("x", PROVENANCE).schema


def test_a_clean_minute() -> None:
    found = row(epochs(seconds(61), cross_track_m=0.4), distance_m=1200.0)
    assert (found["verdict"], found["status"], found["vehicle"]) == ("unproven", "ok", "file")  # no VB was accepted
    assert (found["share_unknown"], found["notes"]) == (0.0, None)
    assert (found["along_error_epochs"], found["cross_error_epochs"], found["location_error_count"]) == (61, 0, 0)
    assert (found["duration_s"], found["distance_m"], found["epochs"]) == (60.0, 1200.0, 61)
    assert (found["gnss_rate_hz"], found["availability"], found["outages"]) == (1.0, 1.0, 0)
    assert (found["longest_outage_s"], found["cross_bias_m"]) == (0.0, 0.4)
    assert (found["false_alarms"], found["false_alarm_rate_per_h"]) == (0, 0.0)
    assert found["false_alarm_rate_high_per_h"] == pytest.approx(3.6889 * 60, rel=1e-4)
    assert [found[f"share_p{k}"] for k in range(4)] == [1.0, 0.0, 0.0, 0.0]
    assert (found["mtbf_h"], found["continuity_15s"]) == (None, None)
    assert (found["config_digest"], found["input_digest"]) == ("c" * 64, "i" * 64)
    assert (found["software"], found["contract"]) == ("balise 0.1.0", CONTRACT_VERSION)


def test_nothing_at_all_is_a_row_without_figures() -> None:
    found = row(epochs([]), evidence=None)
    numbers = {name for name, column in Runs.columns().items() if column.dtype == pl.Float64}
    assert {name for name in numbers if found[name] is not None} == set()
    assert found["epochs"] == found["outages"] == found["alarms"] == 0
    assert found["t_start"] is None


def test_one_epoch() -> None:
    found = row(epochs([5.0]))
    assert (found["duration_s"], found["gnss_rate_hz"], found["availability"]) == (0.0, None, None)
    assert found["false_alarm_rate_per_h"] is None


def test_a_failed_run() -> None:
    found = failed_row("run.mcap: no topic /gnss", PROVENANCE).row(0, named=True)
    assert (found["verdict"], found["vehicle"], found["failure_hazardous_s"]) == (None, None, None)
    assert (found["status"], found["error"], found["solution"]) == ("failed", "run.mcap: no topic /gnss", "")
    assert (found["epochs"], found["missed_detections"], found["false_alarms"]) == (0, 0, None)
    assert found["availability"] is None


def test_damaged_input_is_partial() -> None:
    notes = IngestNotes(partial_until_ns=42 * NS, damage="chunk 7 is cut off", skipped_topics=("/diag",))
    found = row(epochs(seconds(3)), ingest=notes, notes=(Remark(Note.MISFIT, ("map 12 m off",)),))
    assert (found["status"], found["error"]) == ("partial", "chunk 7 is cut off")
    assert found["partial_until"].timestamp() == 42.0
    assert found["notes"] == "topics not used: /diag; does not fit: map 12 m off"


def test_what_the_evidence_cannot_see_is_said() -> None:
    found = row(
        epochs(seconds(3), judgement="unknown"), evidence=Evidence.ODOMETER, vehicle=VehicleFigures.LEARNED,
        odometer_contradicted=2,
    )  # fmt: skip
    assert (found["vehicle"], found["odometer_contradicted"]) == ("learned", 2)
    assert "never that it was right" in found["notes"]
    assert found["remedies"] == ["vehicle_file", "reference"]
    assert "`balise convert --stream reference`" in found["notes"]
    assert "disagrees with 2 distances" in found["notes"]
    assert "no odometer scale in a vehicle file" in found["notes"]


def test_what_cleaning_and_alignment_found() -> None:
    found = row(
        epochs(seconds(3)),
        duplicates=4,
        out_of_order=2,
        latency_s=0.08,
        latency_sigma_s=0.01,
        odometer_scale=1.004,
        odometer_scale_sigma=2e-4,
        ambiguous_stretches=3,
    )
    assert (found["duplicates"], found["out_of_order"], found["ambiguous_stretches"]) == (4, 2, 3)
    assert (found["latency_s"], found["latency_sigma_s"]) == (0.08, 0.01)
    assert (found["odometer_scale"], found["odometer_scale_sigma"]) == (1.004, 2e-4)


class TestOutages:
    def test_missing_epochs(self) -> None:
        found = row(epochs([0, 1, 2, 5, 6, 7, 27, 28]))
        assert (found["outages"], found["longest_outage_s"]) == (2, 20.0)

    def test_epochs_without_a_position_or_off_the_track(self) -> None:
        path: list[Any] = [20.0 * t for t in range(10)]
        path[3:5] = [None, None]
        on_track = [True] * 7 + [False] + [True] * 2
        found = row(epochs(seconds(10), path_m=path, on_track=on_track))
        assert (found["outages"], found["longest_outage_s"]) == (2, 3.0)

    def test_from_the_first_epoch_and_to_the_last(self) -> None:
        path = [None, None, None, 60.0, 80.0, None, None]
        found = row(epochs(seconds(7), path_m=path))
        assert (found["outages"], found["longest_outage_s"]) == (2, 3.0)

    def test_all_the_run(self) -> None:
        found = row(epochs(seconds(11), path_m=[None] * 11, tvb=False))
        assert (found["outages"], found["longest_outage_s"], found["availability"]) == (1, 10.0, 0.0)

    @pytest.mark.parametrize(("gap_s", "expected"), [(0.3, 0), (1.0, 0), (1.1, 1)])
    def test_limit_at_ten_hertz_is_one_second(self, gap_s: float, expected: int) -> None:
        t = [k / 10 for k in range(20)]
        assert row(epochs([*t, *(t[-1] + gap_s + k / 10 for k in range(20))]))["outages"] == expected

    @pytest.mark.parametrize(("gap_s", "expected"), [(7.5, 0), (7.6, 1)])
    def test_limit_of_a_slow_log_is_one_and_a_half_periods(self, gap_s: float, expected: int) -> None:
        t = [5.0 * k for k in range(10)]
        assert row(epochs([*t, *(t[-1] + gap_s + 5.0 * k for k in range(10))]))["outages"] == expected

    def test_limit_is_never_beyond_the_reset_of_the_bank(self) -> None:
        assert row(epochs([100.0 * k for k in range(4)]))["outages"] == 3


class TestAvailability:
    def test_share_of_time_not_of_epochs(self) -> None:
        """20 s at 1 Hz with a TVB, then a second at 10 Hz without one: 20/21."""
        t = [*seconds(21), *(20 + k / 10 for k in range(1, 11))]
        tvb = [True] * 20 + [False] * 11
        assert row(epochs(t, tvb=tvb))["availability"] == pytest.approx(20 / 21)

    def test_standing_does_not_count(self) -> None:
        frame = epochs(seconds(31), moving=[k < 10 for k in range(31)], tvb=[k < 5 for k in range(31)])
        assert row(frame)["availability"] == pytest.approx(0.5)

    def test_a_train_that_never_moved(self) -> None:
        assert row(epochs(seconds(9), moving=False))["availability"] is None

    def test_nobody_knows_whether_it_moved(self) -> None:
        """10 s of 40 s: they count as moving without a TVB."""
        found = row(epochs(seconds(41), moving=[None if 10 <= k < 20 else True for k in range(41)]))
        assert found["availability"] == pytest.approx(30 / 40)
        assert found["notes"].startswith("for 10 s it is not known whether the train moved")
        short = [0.0, 0.1, *(0.2 + k for k in range(41))]
        assert "not known whether" not in (row(epochs(short, moving=[True, None, *[True] * 41]))["notes"] or "")

    def test_gap_while_moving_is_without_a_tvb(self) -> None:
        assert row(epochs([*seconds(11), *(30.0 + k for k in range(11))]))["availability"] == pytest.approx(20 / 40)


class TestShares:
    def test_by_time_with_gaps_apart(self) -> None:
        """A state stands for the time since the epoch before; the 10 s gap and the first count for nothing."""
        t = [0.0, 1.0, 2.0, 3.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0]
        state = ["P0", "P0", "P1", "P3", "P2", "P2", "P2", "P2", "P3", "P0"]
        found = row(epochs(t, lds_state=state))
        assert [found[f"share_p{k}"] for k in range(4)] == [2 / 8, 1 / 8, 3 / 8, 2 / 8]

    def test_without_truth_only_the_negated_and_undiagnosed_are_known(self) -> None:
        state = [None, None, None, "P2", "P3", "P3", None, None, None]
        found = row(epochs(seconds(9), lds_state=state, judgement="unknown"), evidence=None)
        assert [found[f"share_p{k}"] for k in range(4)] == [None, None, 1 / 8, 2 / 8]

    def test_the_odometer_alone_shows_p1_and_never_p0(self) -> None:
        found = row(epochs(seconds(5), lds_state=[None, "P1", None, None, None]), evidence=Evidence.ODOMETER)
        assert [found[f"share_p{k}"] for k in range(4)] == [None, 1 / 4, 0.0, 0.0]

    def test_truth_lost_for_a_while_is_missing_from_the_sum(self) -> None:
        state = ["P0", "P0", None, None, "P0"]
        found = row(epochs(seconds(5), lds_state=state))
        assert [found[f"share_p{k}"] for k in range(4)] == [0.5, 0.0, 0.0, 0.0]


def test_errors_of_the_positions() -> None:
    errors = [-30.0, *([1.0] * 18), 2.0, None]
    found = row(epochs(seconds(21), error_along_m=errors, error_cross_m=-0.5))
    assert found["along_error_mean_m"] == pytest.approx(-0.5)
    assert found["along_error_p95_m"] == pytest.approx(2.0 + 0.05 * 28.0)
    assert (found["along_error_max_m"], found["cross_error_mean_m"]) == (30.0, -0.5)
    assert (found["cross_error_max_m"], found["up_error_max_m"]) == (0.5, None)


def test_stanford_counts_and_their_edges() -> None:
    """Limit 14 m: each row is one error with its confidence; equality is on the safe side."""
    cases = [
        (0.0, 8.0, "nominal"),
        (-8.0, 8.0, "nominal"),
        (14.0, 14.0, "nominal"),
        (-8.1, 8.0, "misleading"),
        (14.0, 8.0, "misleading"),
        (14.1, 14.0, "hazardous"),
        (-200.0, 1.0, "hazardous"),
        (0.0, 14.1, "unavailable"),
        (90.0, 14.1, "unavailable"),
        (None, 8.0, None),
        (1.0, None, None),
    ]
    found = row(epochs(seconds(11), error_along_m=[c[0] for c in cases], confidence_m=[c[1] for c in cases]))
    for region in ("nominal", "misleading", "hazardous", "unavailable"):
        assert found[f"stanford_{region}"] == sum(c[2] == region for c in cases), region


STATUS = ("accepted", "accepted", "accepted", "rejected_window", "rejected_monitor", "missed", "not_available")


class TestBalises:
    def test_counts_are_of_virtual_balises(self) -> None:
        kind = ["virtual"] * 7 + ["physical"] * 7
        found = row(epochs(seconds(3)), passages=passages(14, kind=kind, status=[*STATUS, *STATUS]))
        assert found["balises_on_path"] == 7
        assert (found["balises_accepted"], found["balises_rejected"]) == (3, 2)
        assert (found["balises_missed"], found["balises_not_available"]) == (1, 1)

    def test_an_offer_that_no_crossing_belongs_to_is_no_passage(self) -> None:
        """Judged, and no true crossing: an offer beyond. Not judged: nobody knows, so it counts as a passage."""
        frame = passages(
            4, t_offered=[1, 2, None, 4], t_true=[1, None, 3, None], judgement=["right", "wrong", None, "unknown"],
            status=["accepted", "rejected_window", "missed", "accepted"],
        )  # fmt: skip
        assert row(epochs(seconds(3)), passages=frame)["balises_on_path"] == 3

    def test_what_the_judge_says_of_acceptances_whatever_the_error(self) -> None:
        """400 m off and called right, 0.1 m off and called wrong: the judge's word counts, not the error."""
        frame = passages(
            7,
            status=["accepted"] * 6 + ["rejected_window"],
            judgement=["right", "wrong", "wrong", "unknown", "right", None, "wrong"],
            location_error_m=[400.0, 0.1, None, None, -1.0, None, 30.0],
        )
        found = row(epochs(seconds(3)), passages=frame)
        assert (found["balises_accepted"], found["accepted_judged"]) == (6, 4)
        assert (found["unsafe_accepted"], found["unproven_accepted"]) == (2, 2)
        assert (found["location_error_count"], found["location_error_max_m"]) == (3, 400.0)
        assert found["location_error_mean_m"] == pytest.approx(399.1 / 3)


class TestHazards:
    def test_classes_and_largest(self) -> None:
        frame = hazards(
            5,
            hazard=["VB_JUMP_1A", "VB_SHIFT", "VB_SHIFT", "VB_JUMP_1B", "VB_WRONG_TRACK"],
            detected=[True, True, False, True, False],
            within_budget=[True, False, None, True, None],
            time_to_detect_s=[0.0, 9.5, None, 0.0, None],
            time_since_failure_s=[-2.0, 3.0, None, None, None],
        )
        found = row(epochs(seconds(3)), hazards=frame)
        assert [found[f"hazards_{kind}"] for kind in ("1a", "1b", "shift", "wrong_track")] == [1, 1, 2, 1]
        assert (found["hazards_detected"], found["hazards_within_budget"]) == (3, 2)
        assert (found["time_to_detect_max_s"], found["time_since_failure_max_s"]) == (9.5, 3.0)

    def test_missed_detection(self) -> None:
        """Failure at 10 s, budget 1.675 s: a fail up to 11.675 s is in time, later or never is not."""
        detected = [9.0, 10.0, 11.675, 11.676, 60.0, None]
        frame = hazards(
            7,
            t_onset=[k * NS for k in range(7)],
            t_failure=[10 * NS] * 6 + [None],
            t_detected=[None if t is None else round(t * NS) for t in detected] + [None],
            time_since_failure_s=[None if t is None else t - 10.0 for t in detected] + [None],
            budget_s=1.675,
        )
        found = row(epochs(seconds(3)), hazards=frame)
        assert (found["faults"], found["missed_detections"]) == (7, 3)

    def test_a_jump_back_is_no_second_fault(self) -> None:
        """One fault that nothing saw hits two classes, and its jump back a balise."""
        late = {"t_onset": [0, 0, 60 * NS], "t_failure": [NS, NS, 60 * NS], "caused_by": [None, None, 0]}
        frame = hazards(3, hazard=["VB_JUMP_1B", "VB_SHIFT", "VB_JUMP_1B"], hazard_id=[0, 1, 2], budget_s=1.0, **late)
        found = row(epochs(seconds(3)), hazards=frame)
        assert (found["faults"], found["missed_detections"], found["hazards_1b"]) == (1, 1, 2)


class TestFailures:
    """Every failure counts, whether a hazard row belongs to it or not."""

    def test_counts_and_longest(self) -> None:
        frame = failures(
            4,
            hazardous_s=[0.4, 1.0, 60.0, 0.2],
            hazardous_may_s=[0.4, 1.0, 60.0, 3.0],
            within_budget=[True, False, False, None],
        )
        found = row(epochs(seconds(3)), failures=frame)
        assert (found["failures"], found["failures_within_budget"], found["failures_beyond_budget"]) == (4, 1, 2)
        assert found["hazardous_max_s"] == 60.0
        assert found["failure_hazardous_may_s"] == [0.4, 1.0, 60.0, 3.0]

    def test_every_service_level(self) -> None:
        """Hazardous for 1 s and for 0.4 s: within NPA, EGNOS as observed and the horizontal SIS, not within LPV-200."""
        good = passages(1, **ACCEPTED)
        found = row(
            epochs(seconds(3)), passages=good, failures=failures(2, hazardous_s=[1.0, 0.4]), faults_injected=True
        )
        assert found["service_levels"] == ["npa", "lpv200", "egnos_observed", "horizontal_sis"]
        assert found["level_allowed_s"] == pytest.approx([24.12, 0.5025, 1.675, 100.5])
        assert (found["level_within"], found["level_exceeded"]) == ([2, 1, 2, 2], [0, 1, 0, 0])
        assert found["level_verdict"] == ["kept", "exceeded", "kept", "kept"]

    def test_unknown_time_keeps_no_level_and_exceeds_none(self) -> None:
        """0.4 s for certain, up to 3 s with what is unknown: only the levels of 24 s and 100 s are kept."""
        may = failures(1, hazardous_s=[0.4], hazardous_may_s=[3.0])
        found = row(epochs(seconds(3)), passages=passages(1, **ACCEPTED), failures=may)
        assert (found["level_within"], found["level_exceeded"]) == ([1, 0, 0, 1], [0] * 4)
        assert found["level_verdict"] == ["kept", "unknown", "unknown", "kept"]

    def test_a_level_is_judged_by_the_rules_of_the_verdict(self) -> None:
        """Nothing accepted proves nothing; unknown for 4 s on end is longer than three of the levels allow."""
        assert row(epochs(seconds(3)))["level_verdict"] == ["unknown"] * 4
        good = passages(1, **ACCEPTED)
        assert row(epochs(seconds(3)), passages=good)["level_verdict"] == ["no_failure"] * 4
        found = row(epochs(seconds(101), judgement=["unknown"] * 5 + ["right"] * 96), passages=good)
        assert found["unknown_in_use_s"] == 4.0
        assert found["level_verdict"] == ["no_failure", "unknown", "unknown", "no_failure"]


class TestVerdict:
    def test_safe(self) -> None:
        assert row(epochs(seconds(3)), passages=passages(1, **ACCEPTED))["verdict"] == "safe"

    def test_a_failure_that_hit_no_balise_is_unsafe(self) -> None:
        frame = failures(1, hazardous_s=[9.0], within_budget=False)
        assert row(epochs(seconds(3)), passages=passages(1, **ACCEPTED), failures=frame)["verdict"] == "unsafe"

    def test_share_unknown_is_of_moving_time_in_use(self) -> None:
        """100 s: unknown while standing for 30 s, while negated for 20 s, and 2 s of the 50 s that are left."""
        judgement = ["unknown"] * 52 + ["right"] * 49
        frame = epochs(
            seconds(101),
            judgement=judgement,
            moving=[30 <= k < 100 for k in range(101)],
            in_use=[not 30 <= k < 50 for k in range(101)],
        )
        found = row(frame, passages=passages(1, **ACCEPTED))
        assert (found["share_unknown"], found["unknown_in_use_s"]) == (0.04, 2.0)
        assert (found["verdict"], found["reasons"]) == ("unproven", ["unknown_in_use"])
        assert "4.0% of the moving time in use could not be judged" in found["notes"]

    @pytest.mark.parametrize(("apart_s", "unknown_s"), [(29, 1.0), (31, 0.5)])
    def test_short_unknown_stretches_near_each_other_are_one(self, apart_s: int, unknown_s: float) -> None:
        """Two of half a second at 2 Hz, 29 s and 31 s apart; less than 30 s is together."""
        times = [0.5 * k for k in range(200)]
        judgement = ["unknown" if k in (20, 20 + 2 * apart_s) else "right" for k in range(200)]
        found = row(epochs(times, judgement=judgement), passages=passages(1, **ACCEPTED))
        assert found["unknown_in_use_s"] == unknown_s
        assert found["verdict"] == ("unproven" if unknown_s > 0.5025 else "safe")

    def test_positions_in_use_without_diagnosis_prove_nothing(self) -> None:
        found = row(epochs(seconds(101), undiagnosed=[True] * 101), passages=passages(1, **ACCEPTED))
        assert (found["share_undiagnosed"], found["verdict"]) == (1.0, "unproven")
        assert found["reasons"] == ["not_diagnosed"]

    def test_the_least_margin_of_what_was_right(self) -> None:
        """Errors of -4 to 6 m leave 14 m, an acceptance 11 m; what was not in use or wrong does not count."""
        frame = epochs(
            seconds(4), error_low_m=[-4.0, -19.0, 25.0, None], error_high_m=[6.0, -18.0, 26.0, None],
            judgement=["right", "right", "wrong", "unknown"], in_use=[True, False, True, True],
        )  # fmt: skip
        assert row(frame)["proof_margin_m"] == 14.0
        assert row(frame, passages=passages(1, proof_margin_m=11.0, **ACCEPTED))["proof_margin_m"] == 11.0

    def test_unknown_movement_counts_as_moving(self) -> None:
        frame = epochs(seconds(5), judgement=["right", "unknown", *["right"] * 3], moving=[True, None, *[True] * 3])
        assert row(frame)["share_unknown"] == 0.25


HOUR = seconds(3601)


class TestFalseAlarms:
    def test_rate_with_exact_bounds(self) -> None:
        found = row(epochs(HOUR), alarms=alarms(3, verdict=["false", "true", "false"]))
        assert (found["alarms"], found["false_alarms"], found["false_alarm_rate_per_h"]) == (3, 2, 2.0)
        assert found["false_alarm_rate_low_per_h"] == pytest.approx(0.2422, abs=5e-5)
        assert found["false_alarm_rate_high_per_h"] == pytest.approx(7.2247, abs=5e-5)

    def test_no_rate_where_the_along_bank_never_judged(self) -> None:
        blind = {f"along_{scale}_state": "not_evaluated" for scale in SCALES}
        found = row(epochs(HOUR, **blind), alarms=alarms(1, verdict="false"))
        assert (found["false_alarms"], found["false_alarm_rate_per_h"], found["monitored_s"]) == (1, None, 0.0)

    def test_rate_counts_the_time_judged(self) -> None:
        """The bank judged in the first half hour of the hour only, and the last 400 s of that through its average."""
        raw = ["pass"] * 1401 + ["not_evaluated"] * 2200
        blind = {f"along_{scale}_state": "not_evaluated" for scale in SCALES}
        blind["along_ewma_0p1_state"] = ["not_evaluated"] * 1401 + ["fail"] * 400 + ["not_evaluated"] * 1800
        found = row(epochs(HOUR, **(blind | {"along_raw_state": raw})), alarms=alarms(1, verdict="false"))
        assert (found["held_s"], found["monitored_s"], found["judged_s"]) == (3600.0, 1800.0, 1800.0)
        assert found["false_alarm_rate_per_h"] == 2.0

    def test_rate_counts_the_time_with_a_truth(self) -> None:
        """The position is judged in the first half hour of the hour only."""
        found = row(epochs(HOUR, judgement=["right"] * 1801 + ["unknown"] * 1800), alarms=alarms(1, verdict="false"))
        assert (found["monitored_s"], found["evidence_s"], found["judged_s"]) == (3600.0, 1800.0, 1800.0)
        assert found["false_alarm_rate_per_h"] == 2.0

    def test_not_known_without_truth(self) -> None:
        found = row(epochs(HOUR, judgement="unknown"), evidence=None, alarms=alarms(1, verdict="unknown"))
        assert (found["alarms"], found["false_alarms"], found["false_alarm_rate_per_h"]) == (1, None, None)

    def test_no_rate_while_an_alarm_is_not_judged(self) -> None:
        found = row(epochs(HOUR), alarms=alarms(2, verdict=["false", "unknown"]))
        assert (found["false_alarms"], found["false_alarm_rate_per_h"]) == (1, None)


class TestContinuity:
    def test_time_between_losses_of_trusted_positions(self) -> None:
        """Up 100 s, lost for 10 s, up 290 s, doubtful for 20 s, up 80 s: 470 s of up time over two losses."""
        confidence = [8.0 if not 100 < k < 110 else 15.0 for k in range(501)]
        probability = [1.0 if not 400 < k < 420 else 0.5 for k in range(501)]
        found = row(epochs(seconds(501), confidence_m=confidence, gate_probability=probability))
        assert found["outages"] == 0
        assert found["mtbf_h"] == pytest.approx(470 / 2 / 3600)
        assert found["continuity_15s"] == pytest.approx(math.exp(-15 / 235))

    def test_waiting_for_the_first_position_is_no_loss(self) -> None:
        confidence: list[Any] = [None] * 20 + [8.0] * 20
        found = row(epochs(seconds(40), confidence_m=confidence))
        assert found["mtbf_h"] is None

    def test_lost_to_the_end(self) -> None:
        confidence: list[Any] = [8.0] * 21 + [None] * 20
        assert row(epochs(seconds(41), confidence_m=confidence))["mtbf_h"] == pytest.approx(20 / 3600)

    def test_limit_is_configuration(self) -> None:
        strict = Configuration(lds=LdsConfig(ci_limit_m=5.0))
        assert row(epochs(seconds(41)), strict)["mtbf_h"] is None
        assert row(epochs(seconds(41)), strict)["stanford_unavailable"] == 41


def test_exposure() -> None:
    exposure = [None, *(float(k) for k in range(101))]
    found = row(epochs(seconds(102), exposure_s=exposure))
    assert (found["exposure_max_s"], found["exposure_p99_s"]) == (100.0, 99.0)


def test_begin_and_end_are_the_epochs_to_the_nanosecond() -> None:
    frame = epochs(seconds(3)).with_columns(pl.col("t") + pl.duration(nanoseconds=123))
    found = summarise(results(frame), CONFIG, PROVENANCE)
    assert found.select("t_start", "t_end").cast(pl.Int64).row(0) == tuple(frame["t"].cast(pl.Int64).gather([0, 2]))


@lru_cache(maxsize=1)
def _unmoved() -> dict[str, Any]:
    return row(epochs(_TIMES_S))


@settings(deadline=None, max_examples=20)
@given(shift=st.integers(-(10**9), 10**9))
def test_shifting_all_times_changes_nothing_else(shift: int) -> None:
    plain, moved = _unmoved(), row(epochs([x + shift for x in _TIMES_S]))
    assert {k: v for k, v in plain.items() if k not in {"t_start", "t_end"}} == {
        k: v for k, v in moved.items() if k not in {"t_start", "t_end"}
    }


@settings(deadline=None, max_examples=20)
@given(st.data())
def test_shares_and_availability_are_shares(data: st.DataObject) -> None:
    t = sorted(data.draw(st.sets(st.integers(0, 400), min_size=0, max_size=30)))
    n = len(t)
    column = lambda values: data.draw(st.lists(values, min_size=n, max_size=n))  # noqa: E731
    frame = epochs(
        [k / 4 for k in t],
        lds_state=column(st.sampled_from(["P0", "P1", "P2", "P3", None])),
        tvb=column(st.booleans()),
        path_m=column(st.none() | st.floats(-1e4, 1e4)),
        odometer_m=column(st.none() | st.floats(-1e4, 1e4)),
        confidence_m=column(st.none() | st.floats(0, 50)),
        error_along_m=column(st.none() | st.floats(-50, 50)),
    )
    found = row(frame)
    known = [found[f"share_p{k}"] for k in range(4) if found[f"share_p{k}"] is not None]
    assert sum(known) <= 1.0 + 1e-9
    assert found["availability"] is None or 0.0 <= found["availability"] <= 1.0
    both = frame.filter(pl.col("error_along_m").is_not_null() & pl.col("confidence_m").is_not_null()).height
    assert both == sum(found[f"stanford_{r}"] for r in ("nominal", "misleading", "hazardous", "unavailable"))


def test_a_figure_without_a_column_is_a_defect() -> None:
    with pytest.raises(ValueError, match=r"^table Runs: the contract has no column brakes, wheels$"):
        row(epochs(seconds(3)), wheels=4, brakes=2)
