"""Passes, bounds over passes and quantiles of T_D, worked by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from datasets.experiment.recorded.plan import PlannedFault, RecordedPlan
from datasets.experiment.recorded.tables import bounded_share, cells_table, independent_passes, pmd_table
from datasets.faults import FaultKind
from schemas.conform import dtypes
from schemas.experiment import ExperimentInjections

PLAN = RecordedPlan(faults=(PlannedFault(kind=FaultKind.RAMP, rates_mps=(1.0,), both_ways=False),))
(CELL,) = PLAN.cells(20.0)


def watches(*rows: tuple[str, float, float]) -> pl.DataFrame:
    """Run, onset [s] and length of each watch [s]."""
    frame = pl.DataFrame(rows, schema=["run_id", "t_onset", "watched_s"], orient="row")
    return frame.with_columns((pl.col("t_onset") * 1e9).cast(pl.Int64).cast(pl.Datetime("ns", "UTC")))


@pytest.mark.parametrize(
    ("rows", "count"),
    [
        ([("a", 0.0, 400.0), ("a", 399.0, 400.0), ("a", 400.0, 400.0)], 2),
        # Apart, but nearer than the correlation of the errors.
        ([("a", 0.0, 50.0), ("a", 100.0, 50.0), ("a", 299.0, 50.0), ("a", 300.0, 50.0)], 2),
        ([("a", 0.0, 400.0), ("b", 0.0, 400.0)], 2),
        # A long watch that three short ones fit into is the one left out.
        ([("a", 0.0, 2000.0), ("a", 100.0, 300.0), ("a", 500.0, 300.0), ("a", 900.0, 300.0)], 3),
        ([], 0),
    ],
)
def test_passes_share_no_time(rows: list[tuple[str, float, float]], count: int) -> None:
    frame = watches(*rows) if rows else watches(("a", 0.0, 1.0)).clear()
    assert independent_passes(frame, 300.0).number == count


def test_passes_of_unlike_size_are_worth_less() -> None:
    """31 injections in one pass and one in each of nine others: 40^2 / (31^2 + 9). Four in each of ten: ten."""
    lone = [("a", 1_000.0 * number, 10.0) for number in range(1, 10)]
    assert independent_passes(watches(*[("a", float(second), 10.0) for second in range(31)], *lone), 300.0) == (
        10,
        pytest.approx(1600 / 970),
    )
    even = [("a", 1_000.0 * number + second, 10.0) for number in range(10) for second in range(4)]
    assert independent_passes(watches(*even), 300.0) == (10, 10.0)


def test_bounds_are_those_of_the_passes_alone() -> None:
    """Of 100 injections in 5 passes none missed: 1 - 0.025^(1/5), not 1 - 0.025^(1/100)."""
    share = bounded_share("pmd", 0, 100, 5)
    assert share == {"pmd": 0.0, "pmd_low": 0.0, "pmd_high": pytest.approx(1.0 - 0.025 ** (1 / 5), abs=1e-12)}


def test_a_share_between_two_whole_numbers_of_passes_has_the_wider_bounds() -> None:
    """Half of 3 passes: the lower bound of one in three, the upper bound of two in three."""
    share = bounded_share("pmd", 5, 10, 3)
    assert share["pmd"] == 0.5
    assert share["pmd_low"] == pytest.approx(0.0084, abs=1e-4)
    assert share["pmd_high"] == pytest.approx(0.9916, abs=1e-4)


def injections(**given: list[object]) -> pl.DataFrame:
    """One injection per run, the columns given; the others null."""
    rows = len(given["time_to_detect_s"])
    empty: dict[str, list[object]] = {name: [None] * rows for name in ExperimentInjections.column_names()}
    known: dict[str, list[object]] = {
        "bank": ["bank"] * rows,
        "cell": [CELL.name] * rows,
        "run_id": [f"{number}" for number in range(rows)],
        "t_onset": [0] * rows,
        "watched_s": [145.0] * rows,
        "noticed": [time_s is not None for time_s in given["time_to_detect_s"]],
        "stopped": [None] * rows,
    }
    frame = pl.DataFrame({**empty, **known, **given}, schema_overrides=dtypes(ExperimentInjections))
    return frame.with_columns(pl.col("accepted_wrong", "accepted_unknown", "accepted").fill_null(0))


def test_a_position_that_may_have_failed_unnoticed_does_not_vanish() -> None:
    """Certain, noticed 15 s before; possible and never noticed; possible, noticed 3 s after; possible, 3 s before."""
    frame = injections(
        time_to_detect_s=[5.0, None, 23.0, 17.0],
        time_to_failure_s=[20.0, None, None, None],
        time_to_failure_may_s=[20.0, 20.0, 20.0, 20.0],
        time_since_failure_s=[-15.0, None, None, None],
        time_since_failure_may_s=[-15.0, None, 3.0, -3.0],
    )
    lost = pl.DataFrame(schema={"bank": pl.String, "cell": pl.String, "reason": pl.String})
    row = cells_table(frame, ["bank"], [CELL], PLAN, lost).row(0, named=True)
    assert (row["failures"], row["missed_at_failure"]) == (3, 2)
    pmd = pmd_table(frame, ["bank"], [CELL], PLAN)
    by_time = {row["time_since_failure_s"]: row for row in pmd.iter_rows(named=True)}
    assert (by_time[0.0]["trials"], by_time[0.0]["missed"], by_time[0.0]["missed_certain"]) == (3, 2, 0)
    assert next(row["missed"] for at_s, row in by_time.items() if at_s > 6.0) == 1


@pytest.mark.parametrize(("rows", "bounds"), [(5, (None, None)), (6, (1.0, 6.0))])
def test_the_median_of_five_passes_has_no_bounds(rows: int, bounds: tuple[float | None, float | None]) -> None:
    """1 - 2 / 2^5 is below 95 %, 1 - 2 / 2^6 is not."""
    frame = injections(time_to_detect_s=[float(number + 1) for number in range(rows)])
    lost = pl.DataFrame(schema={"bank": pl.String, "cell": pl.String, "reason": pl.String})
    row = cells_table(frame, ["bank"], [CELL], PLAN, lost).row(0, named=True)
    assert (row["time_to_detect_median_low_s"], row["time_to_detect_median_high_s"]) == bounds


def test_pmd_counts_late_and_never_noticed_from_where_the_position_may_have_failed() -> None:
    """Noticed 5 s before, 2 s after it may have failed (certain: 1 s before), and never."""
    least = [-6.0, -1.0, None]
    largest = [-5.0, 2.0, None]
    empty = {name: [None] * 3 for name in ExperimentInjections.column_names()}
    given = {
        "bank": ["bank"] * 3,
        "cell": [CELL.name] * 3,
        "run_id": ["a", "b", "c"],
        "t_onset": [0, 0, 0],
        "watched_s": [145.0] * 3,
        "time_to_failure_s": [20.0] * 3,
        "time_since_failure_s": least,
        "time_since_failure_may_s": largest,
    }
    frame = pl.DataFrame({**empty, **given}, schema_overrides={"t_onset": pl.Int64})
    frame = frame.with_columns(pl.col("t_onset").cast(pl.Datetime("ns", "UTC")))
    pmd = pmd_table(frame, ["bank"], [CELL], PLAN)
    by_time = {row["time_since_failure_s"]: row for row in pmd.iter_rows(named=True)}
    assert pmd["passes"].unique().to_list() == [3]
    assert (by_time[-20.0]["missed"], by_time[-20.0]["missed_certain"]) == (3, 3)
    assert (by_time[0.0]["missed"], by_time[0.0]["missed_certain"]) == (2, 1)
    assert pmd["missed"][-1] == 1
    assert np.isclose(by_time[0.0]["pmd"], 2 / 3)
