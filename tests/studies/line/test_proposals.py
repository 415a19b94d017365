"""Proposals, files and page, and what the runs cannot say."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import dataframely as dy
import polars as pl
import pytest

from pipeline.read.site.alike import window_findings
from pipeline.read.site.read import read_site
from pipeline.results.store import write_run
from pipeline.show.line import write_line
from pipeline.studies.line.proposals import site_balises
from pipeline.studies.line.study import LineResult, read_points, study_line
from schemas.conform import dtypes
from schemas.errors import BaliseError, UsageError
from schemas.inputs import Balises
from schemas.line import LineCriteria
from schemas.run import RunTables, Site
from schemas.tables import Alarms, Epochs, Hazards, Passages, Runs
from tests.docs.blocks import ROOT
from tests.studies.line.tables import SPLIT_M, alarms_of, epochs_of, line_site, no_passages

_FILL = {pl.String: "", pl.Boolean: False, pl.Int64: 0, pl.Int8: 0, pl.Float64: None}
# Thirty-six right passes are enough for 10 %; two runs, laid thirty times over, are one table to write.
CRITERIA = LineCriteria(loss_limit=0.6, spacings_m=(400.0, 1000.0))


def filled(frame: pl.DataFrame, table: type[dy.Schema]) -> pl.DataFrame:
    """A frame with the columns of a contract that it lacks."""
    columns = table.columns()
    lacking = {}
    for name, dtype in dtypes(table).items():
        if name in frame.columns:
            lacking[name] = pl.col(name).cast(dtype)
        elif columns[name].nullable:
            lacking[name] = pl.lit(None, dtype)
        else:
            default = dtype.categories[0] if isinstance(dtype, pl.Enum) else _FILL.get(type(dtype), [])
            lacking[name] = pl.lit(default, dtype)
    return frame.select(**lacking)


def write_tables(
    out: Path,
    number: int,
    epochs: pl.DataFrame,
    digest: str = "line",
    evidence: str = "reference",
    passages: pl.DataFrame | None = None,
) -> None:
    row = {"solution": "primary", "status": "ok", "evidence": evidence, "config_digest": f"c{number % 2}"}
    alarms = filled(alarms_of(epochs).with_columns(solution=pl.lit("primary"), t_end="t_start"), Alarms)
    hazards = pl.DataFrame(schema=dtypes(Hazards))
    tables = RunTables(
        f"r{number}",
        hazards,
        no_passages() if passages is None else passages,
        alarms,
        filled(epochs, Epochs),
        filled(pl.DataFrame([row]), Runs),
    )
    write_run(tables, out, {"site_digest": digest})


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    for number in range(10):
        write_tables(folder, number, epochs_of(number))
    return folder


@pytest.fixture(scope="module")
def site() -> Site:
    return line_site()


@pytest.fixture(scope="module")
def found(out: Path, site: Site) -> LineResult:
    points = pl.DataFrame({"name": ["S1", "S2"], "netelement_id": ["A", "A"], "measure_m": [1150.0, 1650.0]})
    result = study_line(out, site, CRITERIA, points=points)
    write_line(result, out / "line")
    return result


def test_virtual_balises_stand_on_suitable_pieces_only(found: LineResult) -> None:
    good = found.pieces.filter(pl.col("piece_class") == "suitable").select(
        "netelement_id", "from_m", "to_m", "direction"
    )
    virtual = found.balises.filter((pl.col("kind") == "virtual") & pl.col("proposal").str.starts_with("both"))
    held = virtual.join(good, on="netelement_id").filter(pl.col("measure_m").is_between("from_m", "to_m"))
    assert virtual.height > 4
    assert held.group_by("proposal", "balise_id").len()["len"].to_list() == [2] * virtual.height


def test_bad_stretches_are_bridged_with_the_odometers_confidence(found: LineResult) -> None:
    tunnel = found.balises.filter(
        (pl.col("proposal") == "both-400m")
        & (pl.col("netelement_id") == "A")
        & pl.col("measure_m").is_between(1500, 1800)
    )
    assert set(tunnel["kind"]) <= {"physical"}
    far = found.balises.filter(pl.col("distance_m").is_not_null())
    # SUBSET-041 5.3.1.1: 400 m give 25 m.
    assert far.select((pl.col("odometer_confidence_m") - 5.0 - 0.05 * pl.col("distance_m")).abs().max()).item() < 1e-9
    assert far.filter(pl.col("proposal").str.ends_with("400m"))["distance_m"].is_between(200.0, 600.0).all()
    assert found.balises["largest_undetected_m"].null_count() == found.balises.height


def test_one_direction_alone_is_a_direction_of_travel(found: LineResult) -> None:
    """Ahead is north: with the measure of A, against that of B."""
    side = pl.when(pl.col("netelement_id") == "A").then(pl.lit("growing")).otherwise(pl.lit("falling"))
    good = found.pieces.filter((pl.col("piece_class") == "suitable") & (pl.col("direction").cast(pl.String) == side))
    ahead = found.balises.filter((pl.col("proposal") == "ahead-400m") & (pl.col("kind") == "virtual"))
    held = ahead.join(good, on="netelement_id").filter(pl.col("measure_m").is_between("from_m", "to_m"))
    assert set(ahead["netelement_id"]) == {"A", "B"}
    assert held.height == ahead.height
    assert dict(ahead.select("netelement_id", "direction").iter_rows()) == {"A": "AB", "B": "BA"}
    back = found.balises.filter((pl.col("proposal") == "back-400m") & (pl.col("kind") == "virtual"))
    assert dict(back.select("netelement_id", "direction").iter_rows()) == {"A": "BA", "B": "AB"}
    rest = found.balises.filter(pl.col("proposal").str.starts_with("both") | (pl.col("kind") == "physical"))
    assert set(rest["direction"]) == {"both"}


def test_windows_are_disjoint_on_each_way(found: LineResult, site: Site) -> None:
    for _, balises in found.balises.group_by("proposal"):
        table = Balises.validate(site_balises(balises, CRITERIA).with_columns(kind=pl.lit("virtual")), cast=True)
        assert window_findings(replace(site, balises=table)) == []


def test_stations_and_signals_are_served_where_they_can_be(found: LineResult) -> None:
    proposal = found.proposals.row(by_predicate=pl.col("proposal") == "both-400m", named=True)
    assert (proposal["points"], proposal["points_served"]) == (2, 1)
    near = found.balises.filter((pl.col("near") == "S1") & (pl.col("kind") == "virtual"))
    assert near["measure_m"].is_between(1000.0, 1300.0).all()


def test_a_proposal_is_a_site_table(found: LineResult, out: Path, tmp_path: Path, site: Site) -> None:
    site.track.write_parquet(tmp_path / "track.parquet")
    site.links.write_parquet(tmp_path / "links.parquet")
    (tmp_path / "balises.csv").write_bytes((out / "line" / "ahead-400m" / "balises.csv").read_bytes())
    balises = read_site(tmp_path).balises
    assert balises is not None
    proposed = found.balises.filter(pl.col("proposal") == "ahead-400m")
    assert balises["direction"].to_list() == proposed["direction"].to_list()


def test_files_open_offline(found: LineResult, out: Path) -> None:
    page = (out / "line" / "index.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert re.search(r"(src|href)=\"(https?:)?//", page) is None
    assert 'style="' not in page
    document = json.loads((out / "line" / "line.geojson").read_text(encoding="utf-8"))
    kinds = [feature["properties"]["kind"] for feature in document["features"]]
    assert (kinds.count("piece"), kinds.count("balise")) == (found.pieces.height, found.balises.height)
    assert pl.read_csv(out / "line" / "pieces.csv").height == found.pieces.height


def test_what_cannot_be_said_is_said(found: LineResult, out: Path, site: Site) -> None:
    assert any("2 settings or vehicle files" in text for text in found.remarks)
    few = study_line(out, site, LineCriteria())
    assert any(re.search("a piece has [56] at most, and 36 without", text) for text in few.remarks)
    assert any("nothing to propose" in text for text in few.remarks)
    assert set(few.proposals["virtual"]) == set()


def test_runs_of_one_direction_without_truth(tmp_path: Path, site: Site) -> None:
    write_tables(tmp_path, 0, epochs_of(0, falling=False), evidence="odometer")
    # Only A is passed in the sense of its measure; over B the line runs against it.
    write_tables(tmp_path, 1, epochs_of(2, (), falling=False).filter(pl.col("path_m") < SPLIT_M - 100.0))
    remarks = study_line(tmp_path, site, CRITERIA).remarks
    assert any(text.startswith("1 of 2 runs have neither") for text in remarks)
    assert any("growing measure on B:" in text for text in remarks)
    assert any("falling measure on A:" in text for text in remarks)
    write_tables(tmp_path, 0, epochs_of(0, falling=False).filter(pl.col("path_m") < SPLIT_M - 100.0))
    assert any("direction of falling measure" in text for text in study_line(tmp_path, site, CRITERIA).remarks)


def test_results_of_another_site_are_refused(tmp_path: Path, site: Site) -> None:
    write_tables(tmp_path, 0, epochs_of(0), digest="elsewhere")
    with pytest.raises(UsageError, match="another site"):
        study_line(tmp_path, site, CRITERIA)


def test_points_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("name,measure_m\nS1,5\n", encoding="utf-8")
    with pytest.raises(BaliseError, match="netelement_id"):
        read_points(tmp_path / "points.csv")


def test_the_page_of_criteria_names_every_key_with_its_default() -> None:
    page = (ROOT / "docs" / "line.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+?) \| .+ \| .* \|$", page.split("## Criteria")[1], re.MULTILINE))
    assert rows == {name: str(value) for name, value in LineCriteria().model_dump().items()}


def test_an_unsafe_acceptance_and_an_undetected_error_count_at_their_place(tmp_path: Path, site: Site) -> None:
    offered = {"balise_id": "VB1", "kind": "virtual", "netelement_id": "A", "measure_m": 1025.0, "direction": "growing"}
    row = {"solution": "primary", "status": "accepted", "judgement": "wrong", "undetected_ahead_m": 12.5}
    run = epochs_of(0, ())
    unsafe = filled(pl.DataFrame([{**offered, **row, "t_offered": run["t"][40]}]), Passages)
    write_tables(tmp_path, 0, run, passages=unsafe)
    table = study_line(tmp_path, site, LineCriteria(loss_limit=0.99)).pieces.filter(pl.col("netelement_id") == "A")
    bad = table.filter((pl.col("piece_class") == "unsuitable") & (pl.col("from_m") < 2000.0))
    assert bad.select("from_m", "direction", "cause").rows() == [(1000.0, "growing", "unsafe_acceptance")]
    assert set(table.filter(pl.col("from_m") == 1000.0)["largest_undetected_m"]) == {12.5}
