"""Reactive and composite fail-safety on one run of 200 s at 1 Hz, worked by hand."""

from typing import Any

import polars as pl
import pytest

from pipeline.safety.side_by_side import redundant_uptime, side_by_side
from schemas.config import Configuration, HazardConfig
from tests.summary.tables import NS, alarms, epochs, hazards

CONFIG = Configuration()
N = 200


def run(fails: dict[str, list[int]], blind: dict[str, list[int]] | None = None, **columns: Any) -> pl.DataFrame:
    """All monitors of both architectures evaluated, failing at the seconds given."""
    blind = blind or {}
    states: dict[str, Any] = {}
    for name in ("along_raw", "channel", *fails):
        failing, out = fails.get(name, []), blind.get(name, [])
        states[f"{name}_state"] = [
            "fail" if k in failing else "not_evaluated" if k in out else "pass" for k in range(N)
        ]
    return epochs([float(k) for k in range(N)], **(states | columns))


def fault(onset: int | None, failure: int | None, end: int | None = 150, **columns: Any) -> dict[str, Any]:
    return {"t_onset": onset, "t_failure": failure, "t_end": end, "t_hazard": onset or 0, **columns}


def rows_of(*faults: dict[str, Any]) -> pl.DataFrame:
    instants = ("t_onset", "t_failure", "t_end", "t_hazard")
    columns: dict[str, Any] = {name: [None if f[name] is None else f[name] * NS for f in faults] for name in instants}
    columns["caused_by"] = [f.get("caused_by") for f in faults]
    return hazards(len(faults), budget_s=1.675, **columns)


def compared(frame: pl.DataFrame, faults: pl.DataFrame, found: pl.DataFrame | None = None, config: Any = CONFIG) -> Any:
    table = side_by_side(frame, faults, alarms() if found is None else found, config)
    return {row["architecture"]: row for row in table.iter_rows(named=True)}


def test_each_detects_with_its_own_monitors() -> None:
    frame = run({"along_ewma_0p01": [110], "channel": [101, 102]})
    found = compared(frame, rows_of(fault(100, 108)))
    assert (found["reactive"]["time_to_detect_max_s"], found["composite"]["time_to_detect_max_s"]) == (10.0, 1.0)
    assert (found["reactive"]["missed"], found["composite"]["missed"]) == (1, 0)
    assert (found["reactive"]["detected"], found["composite"]["detected"]) == (1, 1)


@pytest.mark.parametrize(("failing", "missed"), [(108, 0), (109, 1)])
def test_missed_is_later_than_the_budget(failing: int, missed: int) -> None:
    """Failure at 108 s, reaction one epoch, budget 1.675 s: a fail at 108 s is in time, at 109 s it is not."""
    frame = run({"along_raw": [failing]})
    assert compared(frame, rows_of(fault(100, 108)))["reactive"]["missed"] == missed
    quick = Configuration(hazards=HazardConfig(reaction_s=0.1))
    assert compared(frame, rows_of(fault(100, 108)), config=quick)["reactive"]["missed"] == 0


def test_never_found() -> None:
    found = compared(run({}), rows_of(fault(100, 108), fault(100, None)))["composite"]
    assert (found["hazards"], found["failures"], found["detected"], found["missed"]) == (2, 1, 0, 1)
    assert (found["time_to_detect_median_s"], found["missed_share"]) == (None, 1.0)


def test_a_fail_after_the_episode_finds_nothing() -> None:
    assert compared(run({"channel": [151]}), rows_of(fault(100, 108)))["composite"]["detected"] == 0
    assert compared(run({"channel": [150]}), rows_of(fault(100, 108)))["composite"]["detected"] == 1


def test_an_alarm_that_stands_already() -> None:
    found = compared(run({"channel": [90, 105]}), rows_of(fault(100, 108)))
    assert found["composite"]["time_to_detect_max_s"] == 0.0


def test_what_a_fault_caused_is_part_of_it() -> None:
    found = compared(run({"channel": [101]}), rows_of(fault(100, 101), fault(120, None, caused_by=0)))
    assert found["composite"]["hazards"] == 1


def test_false_alarms_have_the_verdict_of_the_alarm() -> None:
    frame = run({"along_raw": [20], "channel": [21, 100]})
    known = alarms(2, t_start=[20 * NS, 100 * NS], t_end=[21 * NS, 100 * NS], verdict=["false", "true"])
    found = compared(frame, rows_of(), known)
    assert (found["reactive"]["alarms"], found["reactive"]["false_alarms"]) == (1, 1)
    assert (found["composite"]["alarms"], found["composite"]["false_alarms"]) == (2, 1)
    assert found["reactive"]["false_alarm_rate_per_h"] == pytest.approx(3600 / 199)


def test_no_rate_of_alarms_without_verdict() -> None:
    found = compared(run({"channel": [21]}), rows_of())
    assert (found["composite"]["false_alarms"], found["composite"]["false_alarm_rate_per_h"]) == (0, None)


def test_availability_is_diagnosis_that_does_not_fail() -> None:
    """Channel blind for 20 s from 50 s and failing for 10 s from 100 s: 30 of 199 s."""
    frame = run({"channel": list(range(100, 110))}, {"channel": list(range(50, 70))})
    found = compared(frame, rows_of())
    assert found["reactive"]["availability"] == 1.0
    assert found["composite"]["availability"] == pytest.approx(1 - 30 / 199)
    assert found["reactive"]["mtbf_h"] is None
    # Up 49, 30 and 89 s from first to last good epoch of each stretch, lost twice.
    assert found["composite"]["mtbf_h"] == pytest.approx((49 + 30 - 1 + 89) / 2 / 3600)


def test_no_epochs() -> None:
    found = compared(epochs([]), rows_of())
    assert (found["reactive"]["availability"], found["composite"]["alarms"]) == (None, 0)


class TestRedundantChannels:
    def both(self, first: list[int], second: list[int], offset_s: float = 0.0) -> pl.DataFrame:
        """Two solutions at 1 Hz, each without confidence at the seconds given."""
        parts = []
        for name, lost, shift in (("gps", first, 0.0), ("galileo", second, offset_s)):
            confidence = [99.0 if k in lost else 8.0 for k in range(N)]
            parts.append(epochs([k + shift for k in range(N)], solution=name, confidence_m=confidence))
        return pl.concat(parts)

    def test_one_is_enough(self) -> None:
        found = redundant_uptime(self.both(list(range(50, 60)), list(range(100, 110))), CONFIG)
        assert (found.losses, found.up_s) == (0, 199.0)

    def test_lost_only_where_both_are(self) -> None:
        found = redundant_uptime(self.both(list(range(50, 60)), list(range(55, 65))), CONFIG)
        assert found.losses == 1
        assert found.up_s == 199.0 - 6.0
        assert found.mean_time_between_losses_h == pytest.approx(193 / 3600)

    def test_stamps_of_the_solutions_need_not_agree(self) -> None:
        found = redundant_uptime(self.both(list(range(50, 60)), list(range(100, 110)), offset_s=0.4), CONFIG)
        assert (found.losses, found.up_s) == (0, pytest.approx(199.4))
