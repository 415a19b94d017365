"""Alarm episodes of one solution, worked out by hand: recovery after 10 s without a fail."""

from __future__ import annotations

import polars as pl
import pytest

from pipeline.epochs.failure_log import failure_log
from tests.summary.tables import NS

FAILS_S = (0, 1, 11, 20)


def epochs(**ratios: dict[int, float]) -> pl.DataFrame:
    """25 s; of each monitor the ratio of value and threshold at its fails; it is 5 at all other epochs."""
    columns: dict[str, list[object]] = {}
    for name, found in ratios.items():
        columns[f"{name}_value"] = [-2.0 * found.get(t, 5.0) for t in range(25)]
        columns[f"{name}_threshold"] = [2.0] * 25
        columns[f"{name}_state"] = ["fail" if t in found else "pass" for t in range(25)]
    t = pl.Series("t", [second * NS for second in range(25)], dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    return pl.DataFrame({"t": t, "negated": [False] * 25, **columns})


@pytest.mark.parametrize(
    ("recovery_s", "found_s"),
    [(10.0, [(0, 1), (11, 20)]), (10.1, [(0, 20)]), (9.0, [(0, 1), (11, 11), (20, 20)])],
)
def test_an_alarm_ends_where_nothing_fails_for_the_recovery_time(
    recovery_s: float, found_s: list[tuple[int, int]]
) -> None:
    found = failure_log(epochs(along_raw=dict.fromkeys(FAILS_S, 1.5)), recovery_s).alarms
    assert [(alarm.start_ns // NS, alarm.end_ns // NS) for alarm in found] == found_s


def test_the_peak_is_the_largest_ratio_at_a_fail() -> None:
    """What stands beside a pass says nothing of the alarm, however large it is."""
    (alarm,) = failure_log(epochs(along_raw={3: 1.5, 4: 1.2}, up_raw={4: 1.7}), 10.0).alarms
    assert alarm.monitors == ("along_raw", "up_raw")
    assert alarm.peak_ratio == pytest.approx(1.7)
