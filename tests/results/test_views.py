"""Ready-made views, on results small enough to answer each by hand."""

from pathlib import Path

import pytest

from pipeline.results import views
from pipeline.results.query import run_sql
from pipeline.results.store import write_run
from schemas.errors import UsageError
from schemas.run import RunTables
from schemas.tables import Runs
from tests.tables import NS, alarms, epochs, hazards, passages, table

PRIMARY = {"solution": "primary"}


def written(folder: Path, verdict: str = "unproven", failures: int = 0, accepted: int = 1) -> Path:
    """Run `a`: 4 s valid, a gap of 10 s, 2 s lost to alarms, 1 s of stand, 1 s that nothing explains; run `b` fails."""
    times = [0.0, 1.0, 2.0, 3.0, 4.0, 14.0, 15.0, 16.0, 17.0, 18.0]
    steps = [1.0, 1.0, 1.0, 1.0, 10.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    lost = [0.0, 0.0, 0.0, 0.0, 10.0, 1.0, 1.0, 0.0, 1.0, 0.0]
    epoch_rows = epochs(
        times,
        **PRIMARY,
        step_s=steps,
        gap=[k == 4 for k in range(10)],
        moving_s=[0.0 if k == 7 else step for k, step in enumerate(steps)],
        lost_s=lost,
        lost_to=[None, None, None, None, "no_position", "alarm", "alarm", None, None, None],
        speed_mps=[2.0, 2.0, 8.0, 8.0, 8.0, -8.0, -8.0, 0.0, 8.0, 8.0],
        netelement_id=["E1"] * 6 + ["E2"] * 4,
        measure_m=[100.0, 200.0, 499.0, 500.0, 700.0, 900.0, 1.0, 2.0, 3.0, 4.0],
    )
    found = hazards(
        3,
        **PRIMARY,
        hazard_id=[0, 1, 2],
        caused_by=[None, 0, None],
        rate_mps=[0.5, None, None],
        detected=[True, False, False],
        time_to_detect_s=[4.0, None, None],
        time_since_failure_s=[-3.0, None, None],
        within_budget=[True, None, False],
    )
    passage_rows = passages(
        4,
        **PRIMARY,
        balise_id=["VB1", "VB1", "VB2", "PB1"],
        kind=["virtual", "virtual", "virtual", "physical"],
        status=["accepted", "accepted", "rejected_window", "missed"],
        judgement=["right", "wrong", None, None],
        location_error_m=[1.0, None, None, None],
        error_low_m=[0.5, -30.0, None, None],
        error_high_m=[1.5, -20.0, None, None],
        confidence_m=[8.0, 8.0, 9.0, None],
        t_offered=[0, NS, 2 * NS, None],
    )
    good = table(
        Runs, 1, **PRIMARY, status="ok", verdict=verdict, moving_s=17.0, availability=4 / 17, lost_to=[["no_position"]],
        lost_to_share=[[10 / 17]], failures=failures, balises_accepted=accepted,
    )  # fmt: skip
    write_run(RunTables("a", found, passage_rows, alarms(), epoch_rows, good), folder, {})
    failed = table(Runs, 1, **PRIMARY, status="failed", error="damaged")
    write_run(RunTables("b", hazards(), passages(), alarms(), epochs([]), failed), folder, {})
    return folder


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("new"))


def test_stretches_follow_one_another_and_gaps_are_rows(out: Path) -> None:
    found = run_sql(out, "SELECT stretch, state, reason, seconds, lost_s FROM stretches")
    assert found.rows() == [
        (1, "valid", None, 4.0, 0.0),
        (2, "gap", "no_position", 10.0, 10.0),
        (3, "lost", "alarm", 2.0, 2.0),
        (4, "standing", None, 1.0, 0.0),
        (5, "lost", "not_validated", 1.0, 1.0),
        (6, "standing", None, 0.0, 0.0),
    ]
    times = run_sql(out, "SELECT t_begin, t_end FROM stretches")
    assert times["t_begin"].to_list()[1:] == times["t_end"].to_list()[:-1]


def test_losses_add_up_to_what_availability_lacks(out: Path) -> None:
    found = run_sql(out, "SELECT reason, lost_s, stretches, longest_s FROM losses")
    assert found.rows() == [("no_position", 10.0, 1, 10.0), ("alarm", 2.0, 1, 2.0), ("not_validated", 1.0, 1, 1.0)]
    lost, available = (run_sql(out, f"SELECT {what}").item() for what in ("SUM(share) FROM losses", AVAILABILITY))
    assert 1.0 - lost == pytest.approx(available) == pytest.approx(4 / 17)


AVAILABILITY = "1 - SUM(lost_s) / SUM(moving_s) FROM epochs"


def test_availability_by_run_speed_and_place(out: Path) -> None:
    by_run = run_sql(out, "SELECT run_id, availability, lost_s FROM availability_by_run").rows()
    assert by_run[0] == ("b", None, None) or by_run[1] == ("b", None, None)
    assert ("a", pytest.approx(4 / 17), pytest.approx(13.0)) in by_run
    by_speed = run_sql(out, "SELECT from_kmh, moving_s, lost_s, availability FROM availability_by_speed").rows()
    assert by_speed == [(0.0, 2.0, 0.0, 1.0), (20.0, 15.0, 13.0, pytest.approx(2 / 15))]
    by_place = run_sql(out, "SELECT netelement_id, from_m, moving_s, lost_s FROM availability_by_place").rows()
    assert by_place == [("E1", 0.0, 3.0, 0.0), ("E1", 500.0, 12.0, 11.0), ("E2", 0.0, 2.0, 2.0)]


def test_balises_that_were_lost_and_the_worst_error_of_those_accepted(out: Path) -> None:
    lost = run_sql(out, "SELECT balise_id, status, passages, run_ids FROM balises_lost").rows()
    assert lost == [("VB2", "rejected_window", 1, ["a"])], "a physical balise is not for the LDS to find"
    worst = run_sql(
        out, "SELECT balise_id, accepted, wrong, worst_known_m, worst_possible_m FROM worst_error_by_balise"
    )
    assert worst.rows() == [("VB1", 2, 1, 1.0, 30.0)]


def test_a_fault_counts_once_by_its_rate(out: Path) -> None:
    """The jump back of the first fault is a row of `hazards`, and no fault of its own."""
    columns = "rate, faults, detected, time_to_detect_max_s, time_since_failure_max_s, within_budget, beyond_budget"
    found = run_sql(out, f"SELECT {columns} FROM detection_by_rate").rows()
    assert found == [("4 0.3 to 1 m/s", 1, 1, 4.0, -3.0, 1, 0), ("6 step", 1, 0, None, None, 0, 1)]


def test_unsafe_runs_are_looked_at_first_and_failed_ones_next(tmp_path: Path) -> None:
    for verdict, first in (("unsafe", "a"), ("safe", "b")):
        folder = written(tmp_path / verdict, verdict)
        assert run_sql(folder, "SELECT run_id FROM look_first LIMIT 1").item() == first


def test_what_changed_needs_the_other_result(out: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"compares two results.*--with old=OUT_OLD"):
        run_sql(out, "SELECT * FROM changes")
    assert run_sql(out, "SELECT * FROM changes", others={"old": out}).height == 0
    old = written(tmp_path, "safe", failures=2)
    found = run_sql(out, "SELECT * FROM changes", others={"old": old}).row(0, named=True)
    columns = ("run_id", "verdict_old", "verdict", "failures_old", "failures")
    assert [found[name] for name in columns] == ["a", "safe", "unproven", 2, 0]


def test_a_view_of_the_other_result_has_its_name(out: Path) -> None:
    assert run_sql(out, "SELECT COUNT(*) FROM old_stretches", others={"old": out}).item() == 6


@pytest.mark.parametrize("name", list(views.views()))
def test_each_view_is_described_by_the_columns_it_answers(out: Path, name: str) -> None:
    answer = run_sql(out, f"SELECT * FROM {name}", others={"old": out})
    assert run_sql(out, f"DESCRIBE {name}")["column"].to_list() == answer.columns
    assert name in run_sql(out, "SHOW TABLES")["table"].to_list()


@pytest.mark.parametrize(
    ("sql", "near"),
    [
        ("SELECT detect_time FROM hazards", "time_to_detect_s"),
        ("SELECT run_id FROM hazards WHERE netelement = 'x'", "netelement_id"),
        ("SELECT * FROM strechtes", "stretches"),
        ("SELECT * FROM zzz", "runs"),
    ],
)
def test_of_a_name_that_is_none_the_three_nearest_are_named(out: Path, sql: str, near: str) -> None:
    with pytest.raises(UsageError) as caught:
        run_sql(out, sql)
    named = str(caught.value)
    assert near in named or sql.endswith("zzz")
    assert "solution" not in named, "and not all that there are"
