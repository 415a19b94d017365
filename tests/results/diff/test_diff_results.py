"""Results on disk against each other."""

import json
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline.results.diff import compare_hazards, diff_results
from pipeline.results.diff.rules import rules_of
from pipeline.results.store import table_address, write_run
from schemas.errors import UsageError
from schemas.run import RunTables
from schemas.tables import Hazards, Runs
from tests.tables import NS, alarms, epochs, hazards, passages, table


def found(**columns: Any) -> pl.DataFrame:
    plain: dict[str, Any] = {
        "solution": "primary",
        "hazard_id": [0, 1, 2],
        "hazard": ["VB_JUMP_1A", "VB_SHIFT", "VB_SHIFT"],
        "t_hazard": [100 * NS, 200 * NS, 300 * NS],
        "size_m": [50.0, 30.0, -25.0],
        "balise_ids": [["VB1", "VB2"], ["VB3"], ["VB4"]],
    }
    return hazards(3, **(plain | columns))


def tables(run_id: str = "r1", **changed: pl.DataFrame) -> RunTables:
    plain: dict[str, pl.DataFrame] = {
        "hazards": found(),
        "passages": passages(2, solution="primary", balise_id=["VB1", "VB2"], location_error_m=[0.5, 1.5]),
        "alarms": alarms(1, solution="primary", peak_ratio=3.0),
        "epochs": epochs([0, 1, 2, 3], solution="primary"),
        "runs": table(Runs, 1, solution="primary", status="ok", availability=0.9),
    }
    return RunTables(run_id, **(plain | changed))


def result(folder: Path, *runs: RunTables, software: str = "balise 1") -> Path:
    for run in runs:
        write_run(run, folder, {"software": software})
    return folder


@pytest.fixture
def a(tmp_path: Path) -> Path:
    return result(tmp_path / "a", tables())


class TestHazards:
    def changes(self, b: pl.DataFrame, a: pl.DataFrame | None = None) -> list[tuple[str, str]]:
        schema, changes = compare_hazards(found() if a is None else a, b)
        assert schema == []
        return [(item.change, item.hazard) for item in changes]

    def test_the_same(self) -> None:
        assert self.changes(found()) == []

    def test_vanished(self) -> None:
        assert self.changes(found().filter(pl.col("hazard_id") != 1)) == [("vanished", "VB_SHIFT")]
        assert self.changes(found().clear()) == [("vanished", kind) for kind in found()["hazard"]]

    def test_appeared_though_all_numbers_moved(self) -> None:
        less = found().tail(2).with_columns(hazard_id=pl.Series([0, 1]))
        assert self.changes(found(), less) == [("appeared", "VB_JUMP_1A")]

    def test_changed_values_are_named(self) -> None:
        _, (change,) = compare_hazards(found(), found(size_m=[50.0, 31.0, -25.0], detected=[False, True, False]))
        assert (change.change, change.t_hazard) == ("changed", "1970-01-01T00:03:20.000Z")
        assert [item.column for item in change.differences] == ["detected", "size_m"]
        assert "30.0 became 31.0" in str(change)

    def test_another_class_at_the_same_time_is_another_hazard(self) -> None:
        other = found(hazard=["VB_JUMP_1B", "VB_SHIFT", "VB_SHIFT"])
        assert self.changes(other) == [("vanished", "VB_JUMP_1A"), ("appeared", "VB_JUMP_1B")]

    def test_another_solution_is_another_hazard(self) -> None:
        other = found(solution=["gps", "primary", "primary"])
        assert self.changes(other) == [("vanished", "VB_JUMP_1A"), ("appeared", "VB_JUMP_1A")]

    @pytest.mark.parametrize(
        ("later_s", "expected"), [(0.1, ["changed"]), (2.0, ["changed"]), (2.1, ["vanished", "appeared"])]
    )
    def test_time_window(self, later_s: float, expected: list[str]) -> None:
        moved = found(t_hazard=[100 * NS + round(later_s * NS), 200 * NS, 300 * NS])
        assert [change for change, _ in self.changes(moved)] == expected

    def test_nearest_in_time_first(self) -> None:
        """201 s is within reach of both 200 s and 201 s and belongs to the latter."""
        alike = {"hazard": "VB_SHIFT", "size_m": 30.0, "balise_ids": [["VB1"]] * 3}
        one = found(t_hazard=[round(t * NS) for t in (200, 201, 900)], **alike)
        other = found(t_hazard=[round(t * NS) for t in (201, 203.5, 900)], **alike)
        _, changes = compare_hazards(one, other)
        listed = [(item.change, item.t_hazard[-7:]) for item in changes]
        assert listed == [
            ("vanished", "20.000Z"),
            ("appeared", "23.500Z"),
        ]

    def test_only_the_number_changed(self) -> None:
        assert self.changes(found(hazard_id=[0, 2, 1])) == [("changed", "VB_SHIFT")] * 2

    def test_a_lost_column_is_reported(self) -> None:
        schema, _ = compare_hazards(found(), found().drop("size_m"))
        assert [(item.kind, item.column) for item in schema] == [("schema", "size_m")]
        schema, changes = compare_hazards(found(), found().drop("t_hazard"))
        assert ([item.column for item in schema], changes) == (["t_hazard"], [])


class TestResults:
    def test_the_same(self, a: Path, tmp_path: Path) -> None:
        diff = diff_results(a, result(tmp_path / "b", tables()))
        assert diff.same
        assert diff.text() == "1 runs in both: all the same"

    def test_made_by_another_version_is_a_note(self, a: Path, tmp_path: Path) -> None:
        runs = table(Runs, 1, solution="primary", status="ok", availability=0.9, software="balise 2")
        diff = diff_results(a, result(tmp_path / "b", tables(runs=runs), software="balise 2"))
        assert diff.same
        assert diff.notes == ("software differs in 1 runs",)

    def test_a_lost_provenance_column_is_no_note(self, a: Path, tmp_path: Path) -> None:
        b = result(tmp_path / "b", tables())
        file = Path(table_address(b, "runs", "r1"))
        pl.read_parquet(file).drop("software").write_parquet(file)
        assert not diff_results(a, b).same

    def test_runs_on_one_side_only(self, a: Path, tmp_path: Path) -> None:
        diff = diff_results(a, result(tmp_path / "b", tables(), tables("r2")))
        assert not diff.same
        assert (diff.only_in_a, diff.only_in_b, diff.compared) == ((), ("r2",), 1)
        assert diff.text().splitlines() == ["1 runs in both: all the same, 1 only in B", "r2: only in B"]

    @pytest.mark.parametrize(
        ("name", "frame", "said"),
        [
            ("epochs", epochs([0, 1, 2, 3], solution="primary", tvb=False), "epochs.tvb: 4 of 4 rows differ"),
            ("epochs", epochs([0, 1, 2], solution="primary"), "epochs: 1 rows lost, first: solution primary, t 1970"),
            (
                "passages",
                passages(2, solution="primary", balise_id=["VB1", "VB2"]),
                "passages.location_error_m: 2",
            ),
            ("alarms", alarms(0), "alarms: 1 rows lost, first: solution primary, alarm_id 0"),
            ("runs", table(Runs, 1, solution="primary", status="ok", availability=0.8), "runs.availability: 1 of 1"),
            ("hazards", found().tail(2), "VB_JUMP_1A at 1970-01-01T00:01:40.000Z (primary) vanished"),
        ],
    )
    def test_a_change_in_any_table(self, name: str, frame: pl.DataFrame, said: str, a: Path, tmp_path: Path) -> None:
        diff = diff_results(a, result(tmp_path / "b", tables(**{name: frame})))
        assert not diff.same
        assert said in diff.text(detail=True)
        assert diff.text().splitlines()[0] == "1 runs in both: 1 changed"

    def test_what_matters_comes_first(self, a: Path, tmp_path: Path) -> None:
        other = tables(
            hazards=found().tail(2),
            passages=passages(2, solution="primary", balise_id=["VB1", "VB2"], status=["missed", "accepted"]),
            epochs=epochs([0, 1, 2, 3], solution="primary", tvb=False),
            runs=table(Runs, 1, solution="primary", status="ok", verdict="unsafe", balises_accepted=3, outages=2),
        )
        before = tables(
            passages=passages(2, solution="primary", balise_id=["VB1", "VB2"], status="accepted"),
            runs=table(Runs, 1, solution="primary", status="ok", verdict="safe", balises_accepted=15, outages=1),
        )
        diff = diff_results(result(tmp_path / "x", before), result(tmp_path / "b", other))
        lines = [line.strip() for line in diff.text().splitlines()]
        assert lines[:5] == ["1 runs in both: 1 changed", "", "Verdicts", "r1  safe became unsafe", ""]
        assert lines[5:8] == ["Hazards", "r1  VB_JUMP_1A at 1970-01-01T00:01:40.000Z (primary) vanished", ""]
        assert lines[8:11] == ["Balises", "r1  accepted 15 became 3", "r1  VB1: accepted became missed"]
        assert lines[-1] == "Other columns that changed: epochs.tvb, runs.outages. --detail shows the values."

    def test_below_the_tolerance_is_no_change(self, a: Path, tmp_path: Path) -> None:
        near = passages(2, solution="primary", balise_id=["VB1", "VB2"], location_error_m=[0.5 + 4e-7, 1.5])
        assert diff_results(a, result(tmp_path / "b", tables(passages=near))).same

    def test_as_json(self, a: Path, tmp_path: Path) -> None:
        b = result(tmp_path / "b", tables(hazards=found(size_m=[51.0, 30.0, -25.0])), tables("r2"))
        answer = json.loads(json.dumps(diff_results(a, b).as_dict()))
        assert (answer["same"], answer["compared"], answer["only_in_b"]) == (False, 1, ["r2"])
        (hazard,) = answer["runs"][0]["hazards"]
        assert (hazard["change"], hazard["differences"][0]["column"]) == ("changed", "size_m")

    def test_not_a_result(self, a: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="holds no complete run"):
            diff_results(a, tmp_path / "nothing")

    def test_a_table_taken_away(self, a: Path, tmp_path: Path) -> None:
        b = result(tmp_path / "b", tables())
        Path(table_address(b, "alarms", "r1")).unlink()
        with pytest.raises(UsageError, match=r"alarms\.parquet: is missing"):
            diff_results(a, b)


def test_all_columns_of_a_hazard_can_change() -> None:
    """Each column of the contract, but the three that say which hazard it is."""
    frame = found().head(1)
    for column in set(Hazards.columns()) - {"solution", "hazard", "t_hazard"}:
        dtype = frame.schema[column]
        other = {pl.String: "else", pl.Boolean: True, pl.Int64: 7, pl.Float64: 1.25}.get(dtype)
        if isinstance(dtype, pl.Enum):
            other = dtype.categories[-1]
        elif isinstance(dtype, pl.List):
            other = [["else"]]
        value = pl.Series(column, other if isinstance(other, list) else [1 if other is None else other], dtype=dtype)
        _, changes = compare_hazards(frame, frame.with_columns(value))
        assert [item.column for change in changes for item in change.differences] == [column]


class TestRules:
    """What may differ, and what is left out."""

    @pytest.fixture
    def b(self, tmp_path: Path) -> Path:
        changed = table(Runs, 1, solution="primary", status="ok", availability=0.9004, epochs=3)
        return result(tmp_path / "b", tables(runs=changed, epochs=epochs([0, 1, 2, 3], solution="primary", hpl_m=9.0)))

    @pytest.mark.parametrize(
        ("tolerances", "ignored", "left"),
        [
            ([], [], {"runs.availability", "runs.epochs", "epochs.hpl_m"}),
            (["availability=0.001"], ["hpl_m"], {"runs.epochs"}),
            (["runs.availability=0.001", "epochs=3"], ["epochs.hpl_m"], set()),
            (["availability=0.0003"], ["epochs.hpl_m", "runs.epochs"], {"runs.availability"}),
        ],
    )
    def test_columns_are_compared_by_the_rules(
        self, a: Path, b: Path, tolerances: list[str], ignored: list[str], left: set[str]
    ) -> None:
        compared = diff_results(a, b, rules_of(tolerances, ignored, None))
        assert {item.place for run in compared.runs for item in run.differences} == left
        assert compared.same == (not left)

    def test_a_file_holds_the_same_and_the_command_adds_to_it(self, a: Path, b: Path, tmp_path: Path) -> None:
        file = tmp_path / "diff.toml"
        file.write_text('ignore = ["epochs.hpl_m"]\n[tolerance]\navailability = 1e-9\n"runs.epochs" = 3\n')
        assert {item.place for run in diff_results(a, b, rules_of([], [], file)).runs for item in run.differences} == {
            "runs.availability"
        }
        assert diff_results(a, b, rules_of(["availability=0.01"], [], file)).same

    def test_a_verdict_that_is_not_compared_is_not_reported(self, a: Path, tmp_path: Path) -> None:
        unsafe = table(Runs, 1, solution="primary", status="ok", availability=0.9, verdict="unsafe")
        b = result(tmp_path / "b", tables(runs=unsafe))
        assert diff_results(a, b).runs[0].verdicts
        assert diff_results(a, b, rules_of([], ["verdict"], None)).same

    @pytest.mark.parametrize(
        ("tolerances", "ignored", "said"),
        [
            (["availability"], [], "is no tolerance"),
            (["availability=-1"], [], "is no tolerance"),
            (["availability=nan"], [], "is no tolerance"),
            (["verdict=1"], [], "is no number"),
            ([], ["availabilty"], "did you mean `availability`"),
            ([], ["run.availability"], "did you mean `runs.availability`"),
            ([], ["epochs.t"], "tells the rows apart"),
        ],
    )
    def test_a_rule_that_is_none_is_refused(self, tolerances: list[str], ignored: list[str], said: str) -> None:
        with pytest.raises(UsageError, match=said):
            rules_of(tolerances, ignored, None)
