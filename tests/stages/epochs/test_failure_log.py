"""What failed first and since when, on a log of three fails worked out by hand; and shares of time."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.epochs.clock import share_of_time
from pipeline.stages.epochs.verdicts import AlarmEpisode, FailureLog, Verdicts, failure_log
from schemas.arrays import NS_PER_S

ALARMS = (AlarmEpisode(1, 2, 10, 20, ("raw", "slow"), 2.0), AlarmEpisode(4, 4, 40, 40, ("fast",), 1.5))
LOG = FailureLog(
    np.arange(0, 60, 10), np.zeros(6, dtype=np.bool_), np.array([1, 2, 4]), ("raw", "slow", "fast"), ALARMS
)


@pytest.mark.parametrize(
    ("begin", "end", "first"),
    [
        (0, 60, (10, "raw")),
        (10, 11, (10, "raw")),
        (0, 10, None),
        (11, 30, (20, "slow")),
        (21, 40, None),
        (41, 99, None),
    ],
)
def test_the_first_fail_from_the_begin_on_and_before_the_end(
    begin: int, end: int, first: tuple[int, str] | None
) -> None:
    assert LOG.first_in(begin, end) == first


@pytest.mark.parametrize(
    ("begin", "end", "start"), [(0, 60, 10), (10, 40, 10), (0, 10, None), (11, 40, None), (11, 41, 40)]
)
def test_the_first_alarm_that_began_from_the_begin_on_and_before_the_end(
    begin: int, end: int, start: int | None
) -> None:
    assert LOG.start_within(begin, end) == start


@pytest.mark.parametrize(("instant", "monitor"), [(10, None), (11, "raw"), (20, "raw"), (21, None), (41, None)])
def test_an_alarm_stands_after_its_first_fail_until_its_last(instant: int, monitor: str | None) -> None:
    assert LOG.standing_at(instant) == monitor


def test_a_negation_stands_until_the_position_returns() -> None:
    negated = FailureLog(LOG.t_ns, np.array([0, 1, 1, 1, 0, 0], dtype=np.bool_), LOG.failing, LOG.first_monitor, ALARMS)
    assert [negated.standing_at(instant) for instant in (31, 40)] == ["raw", "raw"]


def test_shares_of_less_than_a_second_and_of_no_time() -> None:
    where = np.array([True, False])
    assert share_of_time(np.array([0.1, 0.3]), where) == pytest.approx(0.25)
    assert share_of_time(np.zeros(2), where) is None


def test_fails_less_than_the_recovery_time_apart_are_one_alarm() -> None:
    """Fails at 1 s, 2 s and 31 s, one alarm; at 61 s, 30 s later, and 62 s another: 1.5 and 3 times the threshold."""
    t_s = [0, 1, 2, 31, 40, 61, 62, 70]
    failing = [False, True, True, True, False, True, True, False]
    table = pl.DataFrame(
        {
            "along_raw_state": ["fail" if fails else "pass" for fails in failing],
            "along_raw_value": [0.0, 2.0, -3.0, 2.0, 1.0, 2.0, 6.0, 9.0],
            "along_raw_threshold": [2.0] * 8,
        }
    )
    monitors = {"along_raw": Verdicts.of_table(table, "along_raw")}
    log = failure_log(np.array(t_s) * NS_PER_S, np.zeros(8, dtype=np.bool_), monitors, recovery_s=30.0)
    assert log.failing.tolist() == [1, 2, 3, 5, 6]
    assert log.first_monitor == ("along_raw",) * 5
    assert log.alarms == (
        AlarmEpisode(1, 3, NS_PER_S, 31 * NS_PER_S, ("along_raw",), 1.5),
        AlarmEpisode(5, 6, 61 * NS_PER_S, 62 * NS_PER_S, ("along_raw",), 3.0),
    )
