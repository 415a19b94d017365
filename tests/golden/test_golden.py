"""Small runs whose tables stay as they are, compared value by value; and whether they cover what can happen.

To regenerate after a change that is meant: delete `tests/golden/expected`, run the tests twice (the first run
writes the tables and fails on purpose), and give the reason under "Results change" in the changelog.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from html.parser import HTMLParser
from pathlib import Path

import polars as pl
import pytest

from datasets.motion import build_motion
from datasets.scenario import Scenario, load_scenario
from datasets.to_contract import table_of_contract
from datasets.trial import write_trial
from pipeline import replay
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from pipeline.results.diff import compare_tables
from pipeline.results.store import write_run
from pipeline.show.report import write_report
from schemas.config import Configuration, Vehicle
from schemas.enums import BaliseKind, Hazard, NotEvaluated, PassageStatus
from schemas.inputs import BaliseReads
from schemas.monitors import MONITORS
from schemas.run import RunLog, RunTables
from schemas.tables import TABLES

HERE = Path(__file__).parent
EXPECTED = HERE / "expected"
SCENARIOS = [load_scenario(HERE / name) for name in ("golden.toml", "varied.toml")]
COMPARED = ("hazards", "passages", "alarms", "runs", "epochs")
# Windows alone: nothing else may see the fault. These runs have neither ranges nor a second solution.
BANK_OFF = {"monitors": {"disabled": [name for name in MONITORS if name not in ("pseudorange", "channel")]}}
COMPLETE = {"evidence": {"survey_complete": True}}
CONFIGS = {
    "windows_only_late": BANK_OFF,
    "windows_only_early": BANK_OFF,
    "two_solutions": {"monitors": {"channel_reference": "galileo"}},
    "two_odometers": COMPLETE,
}
RUNS = [run.id for scenario in SCENARIOS for run in scenario.runs]
# Digests follow the input files' bytes, which a new version of a library may write differently.
NOT_COMPARED = ["input_digest", "config_digest", "software"]
# Computed only where asked for, and held by tests/studies/undetected.
ASKED_FOR = "^(undetected|t_undetected|physical_spacing)_.*$"


def with_reads(run: RunLog, scenario: Scenario) -> RunLog:
    """Physical balises read where the train passes them."""
    motion = build_motion(next(spec for spec in scenario.runs if spec.id == run.run_id).motion)
    assert run.odometer is not None
    start = run.odometer["t"][0]
    read = [one for one in scenario.line.balises if one.kind is BaliseKind.PHYSICAL]
    times = [start + timedelta(seconds=round(motion.time_at(one.at_m), 3)) for one in read]
    return run.with_streams(balise_reads=table_of_contract(BaliseReads, t=times, balise_id=[one.id for one in read]))


def with_radar(run: RunLog, scenario: Scenario) -> RunLog:
    """Reads, and a second odometer, 0.2 % short, every half second, that knows of no slip."""
    wheel = run.odometer
    assert wheel is not None
    at_s = (wheel["t"] - wheel["t"][0]).dt.total_nanoseconds() / 1e9
    speed = wheel["speed_mps"].rolling_median(51, center=True, min_samples=1)
    way = (speed * at_s.diff().fill_null(0.0)).cum_sum()
    radar = wheel.with_columns(
        sensor=pl.lit("radar"),
        origin=pl.lit("radar", wheel.schema["origin"]),
        speed_mps=0.998 * speed,
        distance_m=0.998 * way,
    )
    both = with_reads(run, scenario)
    sensors = pl.concat([wheel, radar.gather_every(5)]).sort("t", maintain_order=True)
    assert both.balise_reads is not None
    # Another part than that of `reads_only` lies between the first read and the last.
    return both.with_streams(odometer=sensors, balise_reads=both.balise_reads[1:])


def untidied(run: RunLog, _: Scenario) -> RunLog:
    """Two positions twice, and two that change places."""
    order = [0, 1, 2, 2, 3, 5, 4, 6, 6, *range(7, run.gnss.height)]
    return run.with_streams(gnss=run.gnss[order])


def by_radar(run: RunLog, _: Scenario) -> RunLog:
    """Another origin of the odometer."""
    assert run.odometer is not None
    return run.with_streams(odometer=run.odometer.with_columns(origin=pl.lit("radar", run.odometer.schema["origin"])))


ALTERED: dict[str, Callable[[RunLog, Scenario], RunLog]] = {
    "reads_only": with_reads,
    "two_odometers": with_radar,
    "untidy": untidied,
    "windows_only_early": by_radar,
}


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunTables]:
    tables = {}
    for scenario in SCENARIOS:
        folder = tmp_path_factory.mktemp(scenario.name)
        paths = write_trial(scenario, folder)
        site = read_site(folder / "site")
        for path, spec in zip(paths, scenario.runs, strict=True):
            config = Configuration.model_validate(CONFIGS.get(spec.id, {}))
            vehicle = scenario.vehicle if spec.vehicle and scenario.vehicle else Vehicle()
            run = read_run(path, config.ingest)
            run = ALTERED[spec.id](run, scenario) if spec.id in ALTERED else run
            tables[spec.id] = replay(run, site, vehicle, config)
    return tables


def table(tables: RunTables, name: str) -> pl.DataFrame:
    frame: pl.DataFrame = getattr(tables, name).select(pl.exclude(ASKED_FOR))
    return frame.drop(NOT_COMPARED) if name == "runs" else frame


@pytest.mark.parametrize("run_id", RUNS)
def test_tables_are_what_they_were(run_id: str, replayed: dict[str, RunTables]) -> None:
    folder = EXPECTED / run_id
    fresh = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    differences = []
    for name in COMPARED:
        frame, file = table(replayed[run_id], name), folder / f"{name}.parquet"
        if fresh:
            frame.write_parquet(file, compression="zstd", compression_level=19)
        elif not file.exists():
            differences.append(f"{name}: no expected table")
        else:
            differences += compare_tables(pl.read_parquet(file), frame, TABLES[name])
    assert not fresh, f"no expected tables for {run_id}: written now, look at them and run again"
    assert not differences


def test_every_table_keeps_the_ranges_of_its_contract(replayed: dict[str, RunTables]) -> None:
    for tables in replayed.values():
        for name, schema in TABLES.items():
            schema.validate(getattr(tables, name))


def test_every_class_status_and_monitor_happens_somewhere(replayed: dict[str, RunTables]) -> None:
    hazards, statuses, failing = set(), set(), set()
    for tables in replayed.values():
        hazards |= set(tables.hazards["hazard"])
        statuses |= set(tables.passages["status"])
        failing |= {name for name in MONITORS if (tables.epochs[f"{name}_state"] == "fail").any()}
    # A wrong track needs a world with two tracks and a truth on one of them: tests/stages/judge holds it.
    assert hazards == {item.value for item in Hazard} - {Hazard.VB_WRONG_TRACK.value}
    assert {item.value for item in PassageStatus} - statuses == set()
    assert set(MONITORS) - failing == set()


def test_every_reason_of_a_monitor_is_of_the_closed_set(replayed: dict[str, RunTables]) -> None:
    known = {reason.value for reason in NotEvaluated}
    found = {
        reason
        for tables in replayed.values()
        for name in MONITORS
        for reason in tables.epochs[f"{name}_reason"].drop_nulls().unique()
    }
    assert found <= known
    assert len(found) > 5


# Columns that hold one value, or none, in all golden runs, and why.
ALONE = {
    "hazards": {
        "solution": "faults of the second solution are negated before a hazard",
        "suspect": "an opinion: tests/stages/judge",
        "caused_by": "two rows of one run at most",
        "monitor": "a step fails the raw monitor first; drifts before a failure make no hazard row here",
        "alarm_before_onset": "tests/stages/judge",
        "budget_s": "one service level",
    },
    "passages": {"physical_before_m": "where the undetected error is asked for: tests/studies/undetected"},
    "alarms": {"hazard_id": "one hazard row with an alarm per run"},
    "epochs": {
        "link_order_threshold": "identities are counted",
        "channel_reason": "one reason for all that have no channel",
    },
    "runs": {
        "calibrated_by": "replays by `--calibrate`: tests/campaign",
        "status": "failed and partial runs: tests/campaign, tests/read/ingest",
        "error": "the same",
        "partial_until": "the same",
        "hazards_wrong_track": "tests/stages/judge",
        "contract": "one version",
        "software": "one version",
        "failures_within_budget": "a step at 1 Hz keeps no budget of 0.5 s",
        "service_levels": "the same levels for all",
        "level_allowed_s": "the same levels for all",
        "false_alarms": "an alarm of slip that contradicts the reference is unknown: tests/stages/judge",
        "false_alarm_rate_per_h": "the same",
        "false_alarm_rate_low_per_h": "the same",
        "hazardous_natural_s": "every fault here is injected: tests/stages/judge",
        "odometer_follows": "most runs have fewer steps than it needs: tests/stages/follows",
        "part_verdict": "tests/replay/test_in_use.py",
    },
}


def test_each_column_is_filled_and_varies_somewhere(replayed: dict[str, RunTables]) -> None:
    """A column of one value throughout hides a mistake in it: fill it by a run of varied.toml, or say here why not."""
    for name in COMPARED:
        whole = pl.concat([getattr(tables, name).select(pl.exclude(ASKED_FOR)) for tables in replayed.values()])
        alone = {column.name for column in whole if len({str(value) for value in column.drop_nulls()}) < 2}
        assert alone <= set(ALONE[name]), f"{name}: {sorted(alone - set(ALONE[name]))} hold one value, or none"
        assert set(ALONE[name]) <= set(whole.columns)


class Page(HTMLParser):
    """Tiles and pairs by name, and rows of the tables by id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.values: dict[str, list[str]] = {}
        self.tables: dict[str, list[list[str]]] = {}
        self.text = ""
        self._table = ""
        self._name = ""
        self._tag = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self._table = dict(attrs).get("id") or ""
        if tag == "tr":
            self.tables.setdefault(self._table, []).append([])
        if tag in ("td", "th"):
            self.tables[self._table][-1].append("")
        if tag == "dt":
            self._name = ""
        if tag == "dd":
            self.values.setdefault(self._name, []).append("")
        if tag in ("td", "th", "dt", "dd", "script", "style"):
            self._tag = tag

    def handle_endtag(self, tag: str) -> None:
        self._tag = "" if tag == self._tag else self._tag

    def handle_data(self, data: str) -> None:
        if self._tag in ("td", "th"):
            self.tables[self._table][-1][-1] += data
        elif self._tag == "dt":
            self._name += data
        elif self._tag == "dd":
            self.values[self._name][-1] += data
        elif not self._tag:
            self.text += data


def recounted(tables: RunTables) -> dict[str, str]:
    """The figures of a page of one solution, row by row from its tables."""
    virtual = [row for row in tables.passages.iter_rows(named=True) if row["kind"] == "virtual"]
    beyond = [row for row in virtual if row["t_true"] is None and row["judgement"] == "wrong"]
    passed = [row for row in virtual if row not in beyond]
    accepted = [row for row in virtual if row["status"] == "accepted"]
    found = {row["balise_id"] for row in passed if row["status"] == "accepted"}
    begins = {
        row["t_onset"] or row["t_hazard"] for row in tables.hazards.iter_rows(named=True) if row["caused_by"] is None
    }
    moving_s, lost_s = (sum(tables.epochs[name].to_list()) for name in ("moving_s", "lost_s"))
    times = f" ({len(accepted)} times in {len(passed)} passages)"
    once = (len(found), len({row["balise_id"] for row in passed}))
    judged = tables.runs["evidence"][0] is not None
    return {
        "accepted at a wrong place": "–" if not judged else str(sum(row["judgement"] == "wrong" for row in accepted)),
        "accepted, could not be checked": str(sum(row["judgement"] not in ("right", "wrong") for row in accepted)),
        "of moving time with a valid TVB": f"{1.0 - lost_s / moving_s:.1%}",
        "balises": f"{once[0]} of {once[1]} balises accepted" + (times if once != (len(accepted), len(passed)) else ""),
        "faults": str(len(begins)),
    }


def test_every_figure_of_ten_pages_is_that_of_the_tables(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    one_solution = {run: tables for run, tables in replayed.items() if tables.runs.height == 1}
    ten = dict(list(one_solution.items())[:10])
    assert len(ten) == 10
    for tables in ten.values():
        write_run(tables, tmp_path, {"software": "test"})
    write_report(tmp_path)
    listed = Page((tmp_path / "report" / "index.html").read_text(encoding="utf-8")).tables["table-runs"]
    heads, rows = listed[0], {row[1]: row for row in listed[1:]}
    for run, tables in ten.items():
        page = Page((tmp_path / "report" / "runs" / f"{run}.html").read_text(encoding="utf-8"))
        counted = recounted(tables)
        on_page = {name: page.values[name][0] for name in counted if name in page.values}
        assert on_page == {name: value for name, value in counted.items() if name in page.values}
        assert set(counted) - set(on_page) == {"balises", "faults"}
        assert counted["balises"] in page.text
        figures = {row[0]: row[1] for row in page.tables["table-all-s0"]}
        assert figures["faults"] == counted["faults"] or tables.runs["evidence"][0] is None
        for name, frame in (("hazards", tables.hazards), ("alarms", tables.alarms), ("passages", tables.passages)):
            shown = page.tables.get(f"table-{name}-s0", [[]])
            assert len(shown) - 1 == frame.height, f"{run}: {name}"
        of_campaign = dict(zip(heads, rows[run], strict=True))
        assert f"{of_campaign['balises accepted']}".split(" (")[0] + " balises" in counted["balises"]
        assert of_campaign["verdict"] == tables.runs["verdict"][0]
