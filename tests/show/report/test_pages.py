"""What the pages say, without a browser."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from cli import app
from pipeline.read.site.route import route_table
from pipeline.results.store import write_run
from pipeline.results.workers import watched
from pipeline.show.report import page_name, write_page, write_report
from pipeline.show.report.campaign_page import RUN_COLUMNS
from pipeline.show.report.route_found import found_route
from schemas.campaign import STANFORD
from schemas.errors import UsageError
from schemas.monitors import MONITORS
from schemas.run import RunTables, Site
from tests.show.report.conftest import FAILED, REASON, RUNS


def text_of(out: Path, page: str) -> str:
    return (out / "report" / page).read_text(encoding="utf-8")


def data_of(out: Path, page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text_of(out, page), re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def unpacked(packed: dict[str, str]) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(packed["data"]), dtype=f"<{packed['kind']}")


class _Tags(HTMLParser):
    """Whether elements are closed in order, and which ids and addresses there are."""

    _VOID = frozenset(("meta", "link", "br", "input", "img"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        if named.get("id"):
            self.ids.append(str(named["id"]))
        self.addresses += [str(named[key]) for key in ("href", "src") if named.get(key)]
        if tag not in self._VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize("page", ["index.html", *(f"runs/{page_name(run)}" for run in (*RUNS, FAILED))])
def test_markup_is_whole_and_names_nothing_outside(out: Path, page: str) -> None:
    parser = _Tags()
    parser.feed(text_of(out, page))
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    outside = [one for one in parser.addresses if re.match(r"[a-z]+:|//|/", one) and not one.startswith("data:")]
    assert outside == []
    assert "<b>odd" not in text_of(out, page)


@pytest.mark.parametrize("page", ["index.html", "runs/jump_two.html"])
def test_no_script_runs_but_ours(out: Path, page: str) -> None:
    """The policy names the page's one script and its styles by their digest, and nothing may be fetched."""
    text = text_of(out, page)
    policy = re.findall(r'Content-Security-Policy" content="(.*?)"', text)[0]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))

    def digests(tag: str) -> list[str]:
        contents = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        return [f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'" for one in contents]

    assert rules["default-src"] == "'none'"
    assert [rules["script-src"]] == digests("script")
    assert rules["style-src"].split() == digests("style")
    assert not re.search(
        r"<script (?!type=.application/json)|\son[a-z]+=|style=", text.replace(digests("script")[0], "")
    )


def test_what_stands_on_paper_cannot_leave_its_string(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    run_id = 'a"; } body { display: none } </style><b>'
    write_run(RunTables(**{**vars(replayed["jump_two"]), "run_id": run_id}), tmp_path, {})
    write_report(tmp_path)
    (page,) = (tmp_path / "report" / "runs").glob("*.html")
    _, sheets = re.findall(r"<style>(.*?)</style>", page.read_text(), re.DOTALL)
    assert sheets.count("{") == sheets.count("}") == 4
    assert "<" not in sheets


def test_the_worst_balise_stands_first(out: Path) -> None:
    """VB04 is accepted twice at a wrong place in the run without odometer; each table says so in its first row."""
    for page in ("runs/jump_one_no_odometer.html", "index.html"):
        identity = "table-balises-s0" if page.startswith("runs") else "table-balises-s1"
        first = rows_of_table(text_of(out, page), identity)[0]
        assert (first[0], first[3]) == ("VB04", "2")


def test_the_found_route_can_be_taken_away(out: Path, site: Site, replayed: dict[str, RunTables]) -> None:
    text = text_of(out, "runs/jump_two.html")
    ((packed, name),) = re.findall(r'href="data:text/csv;base64,(.*?)" download="(.*?)"', text)[:1]
    assert name == "jump_two.csv"
    breaches: list[str] = []
    route = route_table(name, base64.b64decode(packed), breaches)
    assert route is not None
    assert breaches == []
    assert route.select("netelement_id", "direction").rows() == [("NE1", "AB"), ("NE2", "BA"), ("NE3", "AB")]
    known = replayed["jump_two"].epochs.with_columns(gate_probability=pl.lit(1.0))
    doubted = known.with_columns(
        path_probability=pl.when(pl.col("netelement_id") == "NE2").then(0.9).otherwise(pl.col("path_probability"))
    )
    found = found_route(doubted)
    assert found is not None
    assert found.filter("doubtful")["netelement_id"].to_list() == ["NE2"]
    live = known.with_columns(
        gate_probability=pl.when(pl.col("netelement_id") == "NE3").then(0.9).otherwise(pl.col("gate_probability"))
    )
    at_the_time = found_route(live)
    assert at_the_time is not None
    assert at_the_time.filter("doubtful")["netelement_id"].to_list() == ["NE3"]
    back = doubted.filter(pl.col("netelement_id") == "NE1").with_columns(path_m=pl.col("path_m") + 30_000.0)
    assert found_route(pl.concat([doubted, back])) is None


def test_every_epoch_of_a_short_run_is_there(out: Path, replayed: dict[str, RunTables]) -> None:
    time = data_of(out, "runs/jump_two.html")["solutions"]["primary"]["time"]
    epochs = replayed["jump_two"].epochs
    series = time["series"]["error_along_m"]
    np.testing.assert_array_equal(unpacked(series["y"]), epochs["error_along_m"].to_numpy().astype("<f4"))
    t_ms = epochs["t"].dt.timestamp("ms").to_numpy()
    np.testing.assert_array_equal(unpacked(time["t"]), t_ms - t_ms[0])


def test_ratios_cross_one_exactly_where_monitors_fail(out: Path, replayed: dict[str, RunTables]) -> None:
    time = data_of(out, "runs/jump_two.html")["solutions"]["primary"]["time"]
    epochs = replayed["jump_two"].epochs
    judged = 0
    for monitor in MONITORS:
        if f"ratio_{monitor}" not in time["series"]:
            assert (epochs[f"{monitor}_state"] == "not_evaluated").all()
            continue
        beyond = np.abs(unpacked(time["series"][f"ratio_{monitor}"]["y"])) > 1.0
        fails = (epochs[f"{monitor}_state"] == "fail").to_numpy()
        np.testing.assert_array_equal(beyond, fails, err_msg=monitor)
        judged += int(fails.sum())
    assert judged > 10


def test_bands_say_what_the_epochs_say(out: Path, replayed: dict[str, RunTables]) -> None:
    data = data_of(out, "runs/jump_one_no_odometer.html")["solutions"]["primary"]["time"]
    epochs = replayed["jump_one_no_odometer"].epochs
    t_ms = epochs["t"].dt.timestamp("ms").to_numpy()
    for band in data["bands"]:
        starts, codes = unpacked(band["starts"]), unpacked(band["codes"])
        drawn = [band["states"][code] for code in codes[np.searchsorted(starts, t_ms - t_ms[0], side="right") - 1]]
        if band["group"] == "monitors":
            assert drawn == epochs[f"{band['name']}_state"].to_list()
    along = next(band for band in data["bands"] if band["name"] == "along_raw")
    assert set(unpacked(along["codes"])) == {along["states"].index("not_evaluated")}


def test_an_outage_is_a_gap(out: Path, replayed: dict[str, RunTables], tmp_path: Path) -> None:
    tables = replayed["jump_two"]
    start = tables.epochs["t"][0]
    cut = tables.epochs.filter(
        ~pl.col("t").is_between(start + pl.duration(seconds=20), start + pl.duration(seconds=30))
    )
    write_run(RunTables("gap", tables.hazards, tables.passages, tables.alarms, cut, tables.runs), tmp_path, {})
    write_report(tmp_path)
    time = data_of(tmp_path, "runs/gap.html")["solutions"]["primary"]["time"]
    x, y = unpacked(time["t"]), unpacked(time["series"]["speed_mps"]["y"])
    assert len(x) == cut.height + 1
    broken = x[np.isnan(y) & (x > 10_000)]
    assert len(broken) == 1
    assert 20_000 < broken[0] < 30_000
    mode = next(band for band in time["bands"] if band["name"] == "LDS mode")
    codes, starts = unpacked(mode["codes"]), unpacked(mode["starts"])
    assert codes[np.searchsorted(starts, 25_000, side="right") - 1] == 0


def test_headline_counts_faults_with_exact_bounds(out: Path) -> None:
    """Three faults for `primary`, one of them missed; two failures in use, one within the budget."""
    text = text_of(out, "index.html")
    section = text[text.index('id="s1"') : text.index('id="architectures"')]
    assert "2 position failures in use, at a virtual balise or not: 1 in time, 1 too late" in section
    assert "No monitor found 1 of 3 faults with a failure that a truth judged" in section
    shown = {row[0]: row[1] for row in rows_of_table(text, "table-figures-s1")}
    assert shown["missed_share"] == "0.333 (95 %: 0.0084 to 0.906)"
    assert (shown["runs"], shown["runs_failed"]) == ("3", "1")


def test_allowed_times_of_every_level_are_drawn(out: Path) -> None:
    levels = dict(data_of(out, "index.html")["levels"])
    assert levels == pytest.approx({"npa": 24.12, "lpv200": 0.5025, "egnos_observed": 1.675, "horizontal_sis": 100.5})


def test_undetected_hazards_do_not_count_as_detected(out: Path, replayed: dict[str, RunTables]) -> None:
    own = data_of(out, "index.html")["solutions"]["primary"]
    hazards = pl.concat([tables.hazards for tables in replayed.values()])
    assert own["hazards"] == hazards.height == 5
    assert len(own["time_to_detect_s"]) == hazards["detected"].sum() == 3
    assert len(own["hazardous_s"]) == own["failures"] == 2


def test_location_errors_are_all_counted(out: Path, replayed: dict[str, RunTables]) -> None:
    own = data_of(out, "index.html")["solutions"]["primary"]
    known = sum(tables.passages["location_error_m"].is_not_null().sum() for tables in replayed.values())
    assert sum(count for _, _, count in own["location"]) == known


def test_availability_map_counts_moving_epochs(out: Path, replayed: dict[str, RunTables]) -> None:
    pieces = data_of(out, "index.html")["solutions"]["primary"]["map"]["pieces"]
    moving = pl.concat([tables.epochs for tables in replayed.values()]).filter(
        pl.col("moving") & pl.col("netelement_id").is_not_null()
    )
    assert sum(piece["epochs"] for piece in pieces) == moving.height
    assert sum(piece["epochs"] * piece["share"] for piece in pieces) == pytest.approx(moving["tvb"].sum(), rel=1e-3)
    assert all(len(piece["x"]) >= 2 for piece in pieces)


def test_failed_runs_come_behind_unsafe_ones_with_their_reason(out: Path) -> None:
    text = text_of(out, "index.html")
    table = text[text.index('id="table-runs"') :]
    first, second = table[table.index("<tbody>") :].split("</tr>")[:2]
    assert "jump_one_no_odometer" in first
    assert "broken &amp; &lt;b&gt;odd" in second
    assert REASON in second


def test_without_truth_no_health_is_claimed(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    tables = replayed["jump_two"]
    blind = RunTables(
        "blind",
        tables.hazards.clear(),
        tables.passages.with_columns(
            location_error_m=pl.lit(None, pl.Float64), judgement=pl.lit("unknown", tables.passages.schema["judgement"])
        ),
        tables.alarms,
        tables.epochs.with_columns(error_along_m=pl.lit(None, pl.Float64)),
        tables.runs.with_columns(
            evidence=pl.lit(None, tables.runs.schema["evidence"]), false_alarm_rate_per_h=pl.lit(None, pl.Float64)
        ),
    )
    write_run(blind, tmp_path, {})
    write_report(tmp_path)
    run, index = text_of(tmp_path, "runs/blind.html"), text_of(tmp_path, "index.html")
    assert "there was nothing to judge the positions by" in run
    figures = {row[0]: row[1] for row in rows_of_table(run, "table-all-s0")}
    names = ("unsafe_accepted", "missed_detections", "stanford_nominal", "hazards_1a", "hazards_detected")
    assert {figures[name] for name in names} == {"not known"}
    assert '<div class="tile doubt"><dt>accepted at a wrong place</dt>' in run
    (row,) = rows_of_table(index, "table-runs")
    shown = dict(zip(RUN_COLUMNS, row, strict=True))
    assert {shown[name] for name in ("hazards", "missed_detections", "unsafe_accepted")} == {"–"}
    assert shown["balises_found"] != "–"
    assert dict(row[:2] for row in rows_of_table(index, "table-figures-s0"))["false_alarm_rate_per_h"] == "not known"


def test_by_the_odometer_alone_no_hazard_is_no_health(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    tables = replayed["jump_two"]
    evidence = pl.lit("odometer", tables.runs.schema["evidence"])
    by_odometer = RunTables(
        "seen",
        tables.hazards.clear(),
        tables.passages,
        tables.alarms,
        tables.epochs,
        tables.runs.with_columns(evidence=evidence),
    )
    write_run(by_odometer, tmp_path, {})
    write_report(tmp_path)
    run, index = text_of(tmp_path, "runs/seen.html"), text_of(tmp_path, "index.html")
    assert "the odometer alone can only show that a position was wrong, never that it was right" in run
    assert "truth was taken from" not in run
    assert "Of 0 accepted virtual balises judged by a truth 0 were accepted despite a wrong position" in index


def test_the_same_result_gives_the_same_bytes(out: Path, site: Site) -> None:
    files = sorted(path for path in (out / "report").rglob("*") if path.is_file())
    assert len(files) == 1 + len(RUNS) + 1
    before = {path: path.read_bytes() for path in files}
    (out / "report" / "runs" / "gone.html").write_text("left over")
    written = write_report(out, site)
    assert written[0] == out / "report" / "index.html"
    assert sorted(written) == files
    assert {path: path.read_bytes() for path in files} == before
    assert not (out / "report" / "runs" / "gone.html").exists()


@pytest.mark.usefixtures("forked_workers")
def test_only_pages_of_what_changed_are_made_again(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    for run_id in ("kept", "cut", "changed"):
        write_run(RunTables(**{**vars(replayed["jump_two"]), "run_id": run_id}), tmp_path, {})
    progress: list[tuple[int, int]] = []
    with watched(lambda done, total: progress.append((done, total))):
        write_report(tmp_path, jobs=2)
    assert progress == [(1, 3), (2, 3), (3, 3)]
    pages = {name: tmp_path / "report" / "runs" / f"{name}.html" for name in ("kept", "cut", "changed")}
    whole = pages["cut"].read_bytes()
    pages["cut"].write_bytes(whole[:-200])
    fewer = replayed["jump_two"].alarms.clear()
    write_run(RunTables(**{**vars(replayed["jump_two"]), "run_id": "changed", "alarms": fewer}), tmp_path, {})
    before = {name: (page.stat().st_mtime_ns, page.read_bytes()) for name, page in pages.items()}
    write_report(tmp_path)
    assert pages["kept"].stat().st_mtime_ns == before["kept"][0]
    assert pages["cut"].read_bytes() == whole
    assert pages["changed"].read_bytes() != before["changed"][1]


def test_above_the_limit_pages_are_written_on_demand(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    for run_id in ("one", "two", "three"):
        write_run(RunTables(**{**vars(replayed["jump_two"]), "run_id": run_id}), tmp_path, {})
    write_report(tmp_path)
    whole = data_of(tmp_path, "index.html")
    (index,) = write_report(tmp_path, most_pages=2)
    page = index.read_text()
    assert "3 runs without a page: <code>balise report OUT --run RUN</code> (in a project without OUT)" in page
    assert "runs/two.html" not in page
    assert data_of(tmp_path, "index.html")["solutions"] == whole["solutions"]
    assert write_page(tmp_path, "two", most_pages=2) == tmp_path / "report/runs/two.html"
    assert write_report(tmp_path, most_pages=2) == [index, tmp_path / "report/runs/two.html"]
    assert "runs/two.html" in index.read_text()
    assert "2 runs without a page" in index.read_text()
    with pytest.raises(UsageError, match="has no run 'four'"):
        write_page(tmp_path, "four")


def test_a_table_that_is_gone_is_an_error_of_the_result(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    write_run(replayed["jump_two"], tmp_path, {})
    write_report(tmp_path)
    next(tmp_path.glob("alarms/*/alarms.parquet")).unlink()
    with pytest.raises(UsageError, match="jump_two"):
        write_report(tmp_path)


def test_three_hours_at_ten_hertz_stay_small(replayed: dict[str, RunTables], site: Site, tmp_path: Path) -> None:
    one = replayed["jump_two"]
    copies = -(-108_000 // one.epochs.height)

    def repeated(frame: pl.DataFrame) -> pl.DataFrame:
        times = [name for name, dtype in frame.schema.items() if isinstance(dtype, pl.Datetime)]
        parts = [frame.with_columns(pl.col(times) + pl.duration(milliseconds=411_100 * copy)) for copy in range(copies)]
        return pl.concat(parts)

    frames = {name: repeated(getattr(one, name)) for name in ("hazards", "passages", "alarms")}
    hazards = frames["hazards"].with_columns(hazard_id=pl.int_range(pl.len()))
    alarms = frames["alarms"].with_columns(alarm_id=pl.int_range(pl.len()))
    epochs = repeated(one.epochs).head(108_000)
    write_run(RunTables("long", hazards, frames["passages"], alarms, epochs, one.runs), tmp_path, {})
    total = sum(path.stat().st_size for path in write_report(tmp_path, site))
    assert total < 4_500_000
    time = data_of(tmp_path, "runs/long.html")["solutions"]["primary"]["time"]
    largest = np.nanmax(unpacked(time["series"]["error_along_m"]["y"]))
    assert largest == np.float32(epochs["error_along_m"].max())


def test_a_folder_without_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no complete run"):
        write_report(tmp_path)


def test_another_site_is_refused(replayed: dict[str, RunTables], site: Site, tmp_path: Path) -> None:
    write_run(replayed["jump_two"], tmp_path, {"site_digest": "one"})
    other = Site(site.track, site.links, site.balises, digest="two")
    with pytest.raises(UsageError, match="another site"):
        write_report(tmp_path, other)


def test_command(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    write_run(replayed["jump_two"], tmp_path, {})
    answer = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert answer.exit_code == 0, answer.output
    assert "index.html" in answer.output
    plan = data_of(tmp_path, "runs/jump_two.html")["solutions"]["primary"]["plan"]
    assert plan["geographic"] is False
    assert len(unpacked(plan["x"])) == replayed["jump_two"].epochs["path_m"].is_not_null().sum()


def rows_of_table(html: str, identity: str) -> list[list[str]]:
    """Texts of a table's body."""
    found = re.search(rf'<table class="data" id="{identity}">.*?<tbody>(.*?)</tbody>', html, re.DOTALL)
    assert found is not None
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in found[1].strip().splitlines()]
    return [[re.sub(r"<[^>]+>", "", text) for text in row] for row in cells]


def test_architectures_stand_side_by_side_where_there_are_two_solutions(out: Path) -> None:
    """The second solution is a copy of the first, so the comparison is blind to the drift of both."""
    for page, identity in (("runs/drift_early.html", "table-architectures"), ("index.html", "table-architectures")):
        rows = rows_of_table(text_of(out, page), identity)
        assert [row[0] for row in rows] == ["reactive 1oo1"] * 2 + ["composite 2oo2", "reactive 1oo2"]
        for row in rows[:2]:
            assert row[3:7] == ["1", "1", "1", "0"]
        assert rows[2][3:7] == ["1", "0", "1", "1"]
        assert rows[2][8] == "1"
        assert rows[3][3] == "–"
    assert "table-architectures" not in text_of(out, "runs/jump_two.html")


def test_levels_stand_on_the_page_of_a_run(out: Path) -> None:
    rows = rows_of_table(text_of(out, "runs/jump_two.html"), "table-levels-s0")
    assert [row[0] for row in rows] == ["npa", "lpv200", "egnos_observed", "horizontal_sis"]
    assert {row[4] for row in rows} <= {"in time", "too late", "no wrong position", "could not be checked"}


def test_stanford_counts_stand_beside_the_figures(out: Path, replayed: dict[str, RunTables]) -> None:
    row = replayed["jump_two"].runs.row(0, named=True)
    shown = {one[0]: one[1] for one in rows_of_table(text_of(out, "runs/jump_two.html"), "table-all-s0")}
    for name in [f"{prefix}_{kind}" for prefix in ("stanford", "stanford_hpl") for kind in STANFORD]:
        assert int(shown[name].replace("\u202f", "")) == row[name]


def test_places_where_the_map_is_in_doubt(replayed: dict[str, RunTables], tmp_path: Path) -> None:
    for run_id in ("a", "b"):
        tables = replayed["jump_two"]
        first = tables.alarms[:1].with_columns(
            monitors=pl.lit(["cross_raw"]),
            verdict=pl.lit("false", tables.alarms.schema["verdict"]),
            hazard_id=pl.lit(None, pl.Int64),
        )
        write_run(RunTables(**{**vars(tables), "run_id": run_id, "alarms": first}), tmp_path, {})
    write_report(tmp_path)
    assert rows_of_table(text_of(tmp_path, "index.html"), "table-map")[0][3:6] == ["cross", "2", "2"]
