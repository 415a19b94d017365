"""Reactive and composite fail-safety on one run of 200 s at 1 Hz with two solutions, worked by hand.

Both stand on the path at 20 m/s with sigma 1 m, so the comparison fails beyond 5.3267 sqrt(2) = 7.53 m.
"""

from typing import Any

import polars as pl
import pytest

from pipeline.stages.run_row.bounds import clopper_pearson
from pipeline.studies.safety.side_by_side import side_by_side
from pipeline.studies.safety.tally import COMPOSITE, REACTIVE, REDUNDANT, add_counts, architecture_figures
from schemas.config import Configuration
from schemas.tables import Runs
from tests.tables import NS, alarms, epochs, hazards, table

CONFIG = Configuration()
N = 200
WITHIN, BEYOND = 7.5, 7.6


def solution(
    name: str,
    off: dict[int, float] | None = None,
    fails: dict[str, list[int]] | None = None,
    blind: list[int] | None = None,
    **columns: Any,
) -> pl.DataFrame:
    """One solution, `off` so many metres at the seconds given, monitors failing or the along bank blind at others."""
    error = [(off or {}).get(k, 0.0) for k in range(N)]
    place = [100.0 + 20.0 * k + e for k, e in enumerate(error)]
    states: dict[str, Any] = {
        f"{monitor}_state": ["fail" if k in seconds else "pass" for k in range(N)]
        for monitor, seconds in (fails or {}).items()
    }
    for scale in ("raw", "ewma_0p1", "ewma_0p01", "ewma_0p001") if blind else ():
        states[f"along_{scale}_state"] = ["not_evaluated" if k in (blind or []) else "pass" for k in range(N)]
    plain = {"netelement_id": "ne1", "measure_m": place, "path_m": place, "sigma_along_m": 1.0}
    plain |= {"error_along_m": error, "error_low_m": error, "error_high_m": error}
    plain |= {"judgement": ["wrong" if abs(e) > 20.0 else "right" for e in error]}
    return epochs([float(k) for k in range(N)], **(plain | {"solution": name} | states | columns))


def fault(name: str, onset: int, failure: int | None, end: int | None = 150, **columns: Any) -> dict[str, Any]:
    return {"solution": name, "t_onset": onset, "t_failure": failure, "t_end": end, "t_hazard": onset, **columns}


def rows_of(*faults: dict[str, Any]) -> pl.DataFrame:
    instants = ("t_onset", "t_failure", "t_end", "t_hazard")
    columns: dict[str, Any] = {name: [None if f[name] is None else f[name] * NS for f in faults] for name in instants}
    columns["caused_by"] = [f.get("caused_by") for f in faults]
    return hazards(len(faults), budget_s=1.675, solution=[f["solution"] for f in faults], **columns)


def compared(
    *solutions: pl.DataFrame,
    faults: pl.DataFrame | None = None,
    found: pl.DataFrame | None = None,
    config: Any = CONFIG,
    evidence: str | None = "reference",
) -> Any:
    """Rows by solution and architecture."""
    names = [part["solution"][0] for part in solutions]
    runs = table(Runs, len(names), solution=names, evidence=evidence)
    known = alarms() if found is None else found
    tallies = side_by_side(pl.concat(solutions), rows_of() if faults is None else faults, known, runs, config)
    rows = architecture_figures(tallies).iter_rows(named=True)
    return {(row["solution"], row["architecture"]): row for row in rows}


def at(*seconds: int) -> list[Any]:
    return pl.Series([second * NS for second in seconds]).cast(pl.Datetime("ns", "UTC")).to_list()


def during(first: int, last: int, metres: float) -> dict[int, float]:
    return dict.fromkeys(range(first, last + 1), metres)


class TestFaults:
    def test_of_one_solution_each_architecture_finds_in_its_own_way(self) -> None:
        """A drift of 1 m/s from 100 s: beyond 7.53 m at 107 s; the slow average fails at 110 s only."""
        drift = {k: float(k - 99) for k in range(100, 150)}
        gps = solution("gps", drift, {"along_ewma_0p01": list(range(110, 150))})
        found = compared(gps, solution("galileo"), faults=rows_of(fault("gps", 100, 108)))
        reactive, composite = found["gps", REACTIVE], found["galileo", COMPOSITE]
        assert (reactive["time_to_detect_max_s"], composite["time_to_detect_max_s"]) == (10.0, 7.0)
        assert (reactive["detected"], composite["detected"]) == (1, 1)
        assert (reactive["missed"], composite["missed"]) == (1, 0)
        assert (found["galileo", REACTIVE]["hazards"], composite["hazards"], composite["common_failures"]) == (0, 1, 0)

    def test_common_to_both_the_comparison_is_blind_to(self) -> None:
        off = during(100, 149, 40.0)
        both = [solution(name, off, {"along_raw": [100]}) for name in ("gps", "galileo")]
        faults = rows_of(fault("gps", 100, 100), fault("galileo", 100, 100))
        found = compared(*both, faults=faults)
        for name in ("gps", "galileo"):
            reactive = found[name, REACTIVE]
            assert (reactive["detected"], reactive["missed"], reactive["missed_share"]) == (1, 0, 0.0)
            assert reactive["common_failures"] is None
        composite = found["galileo", COMPOSITE]
        assert (composite["hazards"], composite["failures"], composite["alarms"]) == (1, 1, 0)
        assert (composite["detected"], composite["missed"], composite["missed_share"]) == (0, 1, 1.0)
        assert (composite["common_failures"], composite["common_missed"]) == (1, 1)

    def test_that_overlap_are_one_fault_of_the_pair(self) -> None:
        """GPS fails at 108 s, 8 s after its onset; Galileo is off by as much from 105 s on and fails too."""
        gps, galileo = solution("gps", during(100, 149, 40.0)), solution("galileo", during(105, 149, 40.0))
        faults = rows_of(fault("gps", 100, 108), fault("galileo", 105, 112, 160))
        row = compared(gps, galileo, faults=faults)["galileo", COMPOSITE]
        assert (row["hazards"], row["detected"], row["failures"], row["common_failures"]) == (1, 1, 1, 1)
        assert (row["missed"], row["common_missed"], row["time_to_detect_max_s"]) == (0, 0, 0.0)

    def test_of_each_at_other_times_are_not_common(self) -> None:
        gps, galileo = solution("gps", during(50, 69, 40.0)), solution("galileo", during(100, 119, 40.0))
        faults = rows_of(fault("gps", 50, 50, 70), fault("galileo", 100, 100, 120))
        found = compared(gps, galileo, faults=faults)
        row = found["galileo", COMPOSITE]
        assert (row["hazards"], row["failures"], row["common_failures"], row["missed"]) == (2, 2, 0, 0)
        assert [found[name, REACTIVE]["missed"] for name in ("gps", "galileo")] == [1, 1]

    def test_the_odometer_alone_judges_no_share(self) -> None:
        gps, galileo = solution("gps", during(50, 69, 40.0)), solution("galileo")
        faults = rows_of(fault("gps", 50, 50, 70), fault("gps", 100, 100, 120))
        kinds = pl.Series("evidence", ["odometer", "reference"]).cast(faults.schema["evidence"])
        row = compared(gps, galileo, faults=faults.with_columns(kinds))["gps", REACTIVE]
        assert (row["failures"], row["missed"], row["failures_judged"], row["missed_judged"]) == (2, 2, 1, 1)
        assert row["missed_share_low"] == clopper_pearson(1, 1).low
        blind = faults.with_columns(pl.lit("odometer", faults.schema["evidence"]).alias("evidence"))
        row = compared(gps, galileo, faults=blind)["gps", REACTIVE]
        assert (row["missed"], row["missed_share"]) == (2, None)

    @pytest.mark.parametrize(("failing", "missed"), [(109, 0), (110, 1)])
    def test_missed_is_later_than_the_budget(self, failing: int, missed: int) -> None:
        """Failure at 108 s, budget 1.675 s: a fail at 109 s is in time, at 110 s it is not."""
        parts = solution("gps", None, {"along_raw": [failing]}), solution("galileo")
        faults = rows_of(fault("gps", 100, 108))
        assert compared(*parts, faults=faults)["gps", REACTIVE]["missed"] == missed

    def test_a_fail_after_the_episode_finds_nothing(self) -> None:
        for second, detected in ((150, 1), (151, 0)):
            off = {second: BEYOND}
            found = compared(solution("gps", off), solution("galileo"), faults=rows_of(fault("gps", 100, 108)))
            assert found["galileo", COMPOSITE]["detected"] == detected

    def test_an_alarm_that_stands_already(self) -> None:
        gps = solution("gps", {90: BEYOND, 105: BEYOND})
        found = compared(gps, solution("galileo"), faults=rows_of(fault("gps", 100, 108)))
        assert found["galileo", COMPOSITE]["time_to_detect_max_s"] == 0.0

    def test_rows_of_one_fault_and_what_it_caused_are_one(self) -> None:
        faults = rows_of(fault("gps", 100, 101), fault("gps", 100, None), fault("gps", 120, None, caused_by=0))
        found = compared(solution("gps"), solution("galileo"), faults=faults)["galileo", COMPOSITE]
        assert (found["hazards"], found["failures"], found["missed"]) == (1, 1, 1)

    def test_what_the_replay_compared_does_not_count_as_independent_diagnosis(self) -> None:
        gps = solution("gps", None, {"channel": [101]})
        found = compared(gps, solution("galileo"), faults=rows_of(fault("gps", 100, 101)))
        assert found["gps", REACTIVE]["detected"] == 0


class TestFalseAlarms:
    def test_of_the_comparison_while_both_are_right(self) -> None:
        """8 m apart for a second, each within max(5 m, 3 sigma) of the truth: 1 in 168 s, without the recovery."""
        parts = solution("gps", {60: 4.0}), solution("galileo", {60: -4.0})
        found = compared(*parts)
        row = found["galileo", COMPOSITE]
        assert (row["alarms"], row["false_alarms"]) == (1, 1)
        assert row["false_alarm_rate_per_h"] == pytest.approx(3600 / 167)
        assert (found["gps", REACTIVE]["alarms"], found["gps", REACTIVE]["false_alarm_rate_per_h"]) == (0, 0.0)

    @pytest.mark.parametrize(("apart", "alarm"), [(WITHIN, 0), (BEYOND, 1)])
    def test_threshold_of_the_comparison(self, apart: float, alarm: int) -> None:
        found = compared(solution("gps", {60: apart}), solution("galileo"))
        assert found["galileo", COMPOSITE]["alarms"] == alarm

    def test_while_the_other_is_wrong_is_none(self) -> None:
        found = compared(solution("gps"), solution("galileo", {60: 30.0}))
        assert (found["galileo", COMPOSITE]["alarms"], found["galileo", COMPOSITE]["false_alarms"]) == (1, 0)
        assert found["galileo", COMPOSITE]["false_alarm_rate_per_h"] == 0.0

    def test_of_the_diagnosis_have_the_verdict_of_the_alarm(self) -> None:
        gps = solution("gps", None, {"along_raw": [20, 100]})
        known = alarms(
            2, solution="gps", t_start=[20 * NS, 100 * NS], t_end=[21 * NS, 100 * NS], verdict=["false", "true"]
        )
        row = compared(gps, solution("galileo"), found=known)["gps", REACTIVE]
        assert (row["alarms"], row["false_alarms"]) == (2, 1)
        # From 20 s and from 100 s on it recovers for 30 s after the alarm.
        assert row["false_alarm_rate_per_h"] == pytest.approx(3600 / 137)

    def test_no_rate_where_nobody_can_tell(self) -> None:
        wide = {"error_low_m": -10.0, "error_high_m": 10.0}
        parts = solution("gps", {60: BEYOND}, **wide), solution("galileo", **wide)
        row = compared(*parts, evidence="odometer")["galileo", COMPOSITE]
        assert (row["alarms"], row["false_alarms"], row["false_alarm_rate_per_h"]) == (1, 0, None)
        blind = {name: pl.lit(None, pl.Float64) for name in ("error_low_m", "error_high_m")}
        row = compared(*(part.with_columns(**blind) for part in parts))["galileo", COMPOSITE]
        assert (row["alarms"], row["false_alarm_rate_per_h"]) == (1, None)


class TestAvailability:
    def test_diagnosis_that_judges_and_does_not_fail_and_recovers(self) -> None:
        """Bank blind for 20 s from 50 s, comparison failing for 10 s from 100 s and for 30 s after that."""
        gps = solution("gps", during(100, 109, BEYOND), blind=list(range(50, 70)))
        found = compared(gps, solution("galileo"))
        assert found["gps", REACTIVE]["availability"] == pytest.approx(1 - 20 / 199)
        assert found["galileo", COMPOSITE]["availability"] == pytest.approx(1 - 41 / 199)
        # Up 98 s, as the first epoch has none before it, and, from 140 s on, 59 s; lost once.
        assert found["galileo", COMPOSITE]["mtbf_h"] == pytest.approx((98 + 59) / 3600)
        assert found["galileo", REACTIVE]["mtbf_h"] is None
        assert found["galileo", REACTIVE]["mtbf_low_h"] == pytest.approx(199 / 3600 / 3.6889, rel=1e-4)

    def test_the_comparison_needs_both_positions(self) -> None:
        gps = solution("gps", confidence_m=[99.0 if 50 <= k < 60 else 8.0 for k in range(N)])
        found = compared(gps, solution("galileo"))
        for key in (("gps", REACTIVE), ("galileo", COMPOSITE)):
            assert found[key]["availability"] == pytest.approx(1 - (10 + (key[1] == COMPOSITE)) / 199)
        assert found["galileo", REACTIVE]["availability"] == 1.0

    def test_receivers_that_measure_at_other_times_are_compared_there(self) -> None:
        late = solution("gps", off=during(50, 60, 9.0)).with_columns(
            pl.col("t") + pl.duration(nanoseconds=400_000_000), pl.col("path_m", "measure_m") + 8.0
        )
        row = compared(solution("galileo"), late)["galileo", COMPOSITE]
        # The first epoch has none before it; recovery after the alarm takes 30 s more than the alarm.
        assert row["judged_h"] == pytest.approx((197 - (11 + 30)) / 3600)
        assert row["alarms"] == 1
        # The run goes on for 0.4 s after the last epoch of the one.
        assert row["availability"] == pytest.approx((199 - (2 + 11 + 30)) / 199.4)

    def test_no_epoch_of_the_other_no_comparison(self) -> None:
        later = solution("galileo").with_columns(pl.col("t") + pl.duration(seconds=500, time_unit="ns"))
        row = compared(solution("gps"), later)["galileo", COMPOSITE]
        assert (row["availability"], row["judged_h"], row["false_alarm_rate_per_h"]) == (0.0, 0.0, None)


class TestWrongInUse:
    """Errors beyond the failure limit count whether a virtual balise was near or not."""

    def test_offset_that_only_the_comparison_sees(self) -> None:
        """30 m off from 50 to 59 s, no hazard: 10 s in use under a diagnosis that is silent."""
        found = compared(solution("gps", during(50, 59, 30.0)), solution("galileo"))
        assert (found["gps", REACTIVE]["wrong_in_use_s"], found["galileo", COMPOSITE]["wrong_in_use_s"]) == (10.0, 0.0)
        assert found["gps", REACTIVE]["wrong_in_use_share"] == pytest.approx(10 / 199)
        assert found["galileo", REACTIVE]["wrong_in_use_s"] == 0.0
        assert found["galileo", REDUNDANT]["wrong_in_use_s"] is None

    def test_offset_of_both_that_only_the_diagnosis_sees(self) -> None:
        off = during(50, 59, 30.0)
        found = compared(*(solution(name, off, {"along_raw": [52]}) for name in ("gps", "galileo")))
        assert (found["gps", REACTIVE]["wrong_in_use_s"], found["galileo", COMPOSITE]["wrong_in_use_s"]) == (2.0, 10.0)

    def test_not_known_by_the_odometer_alone(self) -> None:
        found = compared(solution("gps", during(50, 59, 30.0)), solution("galileo"), evidence="odometer")
        assert found["gps", REACTIVE]["wrong_in_use_s"] is None


class TestRedundantChannels:
    def both(self, first: list[int], second: list[int], offset_s: float = 0.0) -> Any:
        """Two solutions at 1 Hz, each without confidence at the seconds given."""
        parts = []
        for name, lost, shift in (("galileo", first, 0.0), ("gps", second, offset_s)):
            confidence = [99.0 if k in lost else 8.0 for k in range(N)]
            shifted = pl.col("t") + pl.duration(nanoseconds=round(shift * NS))
            parts.append(solution(name, confidence_m=confidence).with_columns(shifted))
        return compared(*parts)

    def test_one_is_enough(self) -> None:
        found = self.both(list(range(50, 60)), list(range(100, 110)))
        row = found["galileo", REDUNDANT]
        assert (row["availability"], row["mtbf_h"]) == (1.0, None)
        alone = [found[name, REACTIVE]["mtbf_h"] for name in ("galileo", "gps")]
        assert alone == pytest.approx([188 / 3600] * 2)

    def test_lost_only_where_both_are(self) -> None:
        row = self.both(list(range(50, 60)), list(range(55, 65)))["galileo", REDUNDANT]
        assert row["availability"] == pytest.approx(193 / 199)
        assert row["mtbf_h"] == pytest.approx(193 / 3600)
        assert row["hazards"] is None

    def test_stamps_of_the_solutions_need_not_agree(self) -> None:
        row = self.both(list(range(50, 60)), list(range(100, 110)), offset_s=0.4)["galileo", REDUNDANT]
        assert (row["availability"], row["mtbf_h"]) == (pytest.approx(1.0), None)


class TestTime:
    """Moving time of the run with its gaps, as in `runs.availability`."""

    def test_a_gap_is_time_in_which_nothing_works(self) -> None:
        """No epoch from 80 to 101 s: of 199 s the states of 79 to 102 s, 23 s, are not known."""
        parts = [solution(name).filter(~pl.col("t").is_between(*at(80, 101))) for name in ("gps", "galileo")]
        found = compared(*parts)
        for key in (("gps", REACTIVE), ("galileo", REACTIVE), ("galileo", COMPOSITE), ("galileo", REDUNDANT)):
            assert found[key]["availability"] == pytest.approx(1 - (23 + (key[1] == COMPOSITE)) / 199)

    def test_a_tunnel_is_the_same_whether_the_log_keeps_its_rows(self) -> None:
        lost = [k in range(80, 102) for k in range(N)]
        nowhere = {"confidence_m": [99.0 if gone else 8.0 for gone in lost]}
        found = compared(*(solution(name, **nowhere) for name in ("gps", "galileo")))
        assert found["galileo", COMPOSITE]["availability"] == pytest.approx(1 - 23 / 199)

    def test_a_solution_that_comes_late_was_not_there(self) -> None:
        late = solution("gps").filter(pl.col("t") >= at(100)[0])
        found = compared(late, solution("galileo"))
        assert found["gps", REACTIVE]["availability"] == pytest.approx(99 / 199)
        assert found["galileo", COMPOSITE]["availability"] == pytest.approx(98 / 199)
        assert found["galileo", REDUNDANT]["availability"] == 1.0

    def test_standing_does_not_count_and_what_nobody_knows_counts_as_moving(self) -> None:
        """Standing for 50 s, then 30 s of which nobody knows."""
        moving = [None if 150 <= k < 180 else not 100 <= k < 150 for k in range(N)]
        found = compared(*(solution(name, moving=moving) for name in ("gps", "galileo")))
        for key in (("gps", REACTIVE), ("galileo", COMPOSITE), ("galileo", REDUNDANT)):
            assert found[key]["availability"] == pytest.approx((149 - (key[1] == COMPOSITE) - 30) / 149)
        still = compared(*(solution(name, moving=False) for name in ("gps", "galileo")))
        assert still["galileo", COMPOSITE]["availability"] is None

    def test_the_slower_receiver_says_when_is_compared(self) -> None:
        """One of two measures every other second: all of the run is compared, whichever comes first by name."""
        for slow, quick in (("gps", "galileo"), ("galileo", "gps")):
            every_other = solution(slow).gather_every(2)
            row = compared(every_other, solution(quick))["galileo", COMPOSITE]
            assert (row["availability"], row["judged_h"]) == (pytest.approx(196 / 199), pytest.approx(196 / 3600))


def test_tallies_of_runs_add_up() -> None:
    runs = table(Runs, 2, solution=["gps", "galileo"], evidence="reference")
    faults = rows_of(fault("gps", 100, 109))
    one = side_by_side(pl.concat([solution("gps", {105: BEYOND}), solution("galileo")]), faults, alarms(), runs, CONFIG)
    two = side_by_side(pl.concat([solution("gps"), solution("galileo")]), faults, alarms(), runs, CONFIG)
    counts = add_counts([one, two])
    rows = {(row["solution"], row["architecture"]): row for row in architecture_figures(counts).iter_rows(named=True)}
    total = rows["galileo", COMPOSITE]
    assert (total["runs"], total["failures"], total["missed"], total["missed_share"]) == (2, 2, 1, 0.5)
    assert (total["time_to_detect_max_s"], total["judged_h"]) == (5.0, pytest.approx((2 * 198 - 31) / 3600))
    redundant = counts.filter(architecture=REDUNDANT)
    assert redundant.select("hazards", "moving_s").rows() == [(None, 398.0)]


def test_one_solution_has_nothing_to_be_compared_with() -> None:
    assert set(compared(solution("gps"))) == {("gps", REACTIVE)}
