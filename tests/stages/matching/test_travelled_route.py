"""The way out of doubt: the path found as a route file, which a person corrects and hands in again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline.campaign import make_plan, run_campaign
from pipeline.read.site.read import read_site
from pipeline.read.site.route import with_route
from pipeline.results import store
from pipeline.stages.matching.match import travelled_route
from schemas.config import SiteConfig
from schemas.errors import InputError, UsageError
from schemas.run import Site
from tests.stages.matching.builders import line, matched, odometer, run, site
from tests.stages.matching.test_network import SWITCH, SWITCH_LINKS, along, branch

DOUBLE = site(
    {"a": line((0, 0), (1000, 0)), "b": line((1000, 0), (3000, 0)), "c": line((0, 4), (3000, 4))},
    [("a", 1, "b", 0, "both")],
)
X_M = np.arange(50.0, 2950.0, 20.0)


def on_disk(folder: Path, *names: str) -> tuple[Path, list[str]]:
    """The double track, and runs 1.9 m beside one track and 2.1 m beside the other."""
    home = folder / "site"
    home.mkdir()
    DOUBLE.track.write_parquet(home / "track.parquet")
    DOUBLE.links.write_parquet(home / "links.parquet")
    for name in names:
        (folder / name).mkdir()
        run(X_M, np.full(len(X_M), 1.9)).write_parquet(folder / name / "gnss.parquet")
        odometer(X_M).write_parquet(folder / name / "odometer.parquet")
    return home, [str(folder / name) for name in names]


def test_the_route_says_what_is_in_doubt_and_with_what() -> None:
    route = travelled_route(matched(run(X_M, np.full(len(X_M), 1.9)), DOUBLE, odometer(X_M)))
    assert route.select("netelement_id", "direction", "doubtful").rows() == [("a", "AB", True), ("b", "AB", True)]
    assert all(rivals.startswith("c 0.4") for rivals in route["rivals"])
    assert route["t_end"][0] < route["t_start"][1]


def test_a_ring_of_one_element_is_a_passage_per_lap() -> None:
    """Two and a half laps the other way round than it was surveyed, 1 m inside; then 100 m back."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    place = site({"r": np.column_stack([300 * np.sin(angle), 300 * np.cos(angle)])}, [("r", 1, "r", 0, "both")])
    distance = np.concatenate([np.arange(100.0, 4712.0, 10.0), np.arange(4712.0, 4612.0, -10.0)])
    angle = -distance / 300.0
    route = travelled_route(matched(run(299 * np.sin(angle), 299 * np.cos(angle)), place, odometer(distance)))
    rows = route.select("netelement_id", "direction", "doubtful", pl.col("cross_bias_m").round(1)).rows()
    assert rows == [("r", "BA", False, 1.0)] * 3
    assert route["t_start"].is_sorted()


def test_the_route_is_doubtful_wherever_the_live_belief_was() -> None:
    """Behind the switch nobody could know the branch at first; in hindsight the path is sure everywhere."""
    distance = np.arange(300.0, 1500.0, 15.0)
    x, y = along(branch("d"), distance)
    found = matched(run(x, y), site(SWITCH, SWITCH_LINKS), odometer(distance))
    route = travelled_route(found)
    assert route.select("netelement_id", "direction", "doubtful").rows() == [("s", "AB", False), ("d", "AB", True)]
    assert route["path_probability"].min() >= 0.99
    assert route["gate_probability"].to_list() == [
        found.epochs.table.filter(netelement_id=name)["gate_probability"].min() for name in ("s", "d")
    ]


def test_the_route_of_a_run_without_doubt_is_marked_nowhere() -> None:
    place = site({"a": line((0, 0), (1000, 0)), "b": line((1000, 0), (3000, 0))}, [("a", 1, "b", 0, "both")])
    route = travelled_route(matched(run(X_M, np.full(len(X_M), 1.9)), place, odometer(X_M)))
    assert route["doubtful"].to_list() == [False, False]


@pytest.mark.usefixtures("in_process")
def test_one_run_of_two_is_corrected_and_nothing_of_it_is_in_doubt(tmp_path: Path) -> None:
    home, runs = on_disk(tmp_path, "one", "two")
    routes = tmp_path / "routes"
    run_campaign(make_plan(runs, home, tmp_path / "first", write_routes=routes))
    assert sorted(path.name for path in routes.iterdir()) == ["one.csv", "two.csv"]
    assert pl.read_csv(routes / "one.csv")["netelement_id"].to_list() == ["a", "b"]
    (routes / "two.csv").unlink()
    corrected = pl.DataFrame({"netelement_id": ["c"], "direction": ["AB"], "rivals": ["none: I was there"]})
    corrected.write_csv(routes / "one.csv")
    run_campaign(make_plan(runs, home, tmp_path / "second", routes=routes))
    one, two = (store.read_table(str(tmp_path / "second"), "epochs", name).collect() for name in ("one", "two"))
    # The report takes the runs for those of this site, with a route of their own or not.
    for name, metadata in store.completed_runs(str(tmp_path / "second")).items():
        store.check_site(read_site(home), metadata["site_digest"], name)
    assert one["netelement_id"].unique().to_list() == ["c"]
    assert one["path_probability"].min() == 1.0
    assert two["path_probability"].max() < 0.99
    again = run_campaign(make_plan(runs, home, tmp_path / "second", routes=routes))
    assert all(outcome.skipped for outcome in again.outcomes)
    corrected.with_columns(direction=pl.lit("BA")).write_csv(routes / "one.csv")
    changed = run_campaign(make_plan(runs, home, tmp_path / "second", routes=routes))
    assert {outcome.run_id: outcome.skipped for outcome in changed.outcomes} == {"one": False, "two": True}


def test_a_folder_without_any_route_of_the_runs_is_refused(tmp_path: Path) -> None:
    home, runs = on_disk(tmp_path, "one")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no route for any"):
        make_plan(runs, home, tmp_path / "out", routes=tmp_path / "empty")


def test_a_run_that_turned_back_over_a_switch_takes_its_own_route_again(tmp_path: Path) -> None:
    """In from the branch, out onto the straight track: two legs, one route file."""
    inward, outward = np.arange(1400.0, 700.0, -10.0), np.arange(700.0, 1600.0, 10.0)
    (x_in, y_in), (x_out, y_out) = along(branch("d"), inward), along(branch("m"), outward)
    distance = np.concatenate([inward, outward])
    fixes = run(np.concatenate([x_in, x_out]), np.concatenate([y_in, y_out]))
    place = site(
        SWITCH | {"x": line((0, 4), (1000, 4)), "y": line((1000, 4), (2000, 4))},
        [*SWITCH_LINKS, ("x", 1, "y", 0, "both")],
    )
    first = matched(fixes, place, odometer(distance - distance[0]))
    file = tmp_path / "shunter.csv"
    travelled_route(first).write_csv(file)
    known = with_route(place, file, SiteConfig())
    assert isinstance(known, Site)
    again = matched(fixes, known, odometer(distance - distance[0]))
    assert again.path.element_names() == first.path.element_names()
    assert again.ambiguous.height <= first.ambiguous.height
    assert set(again.epochs.table["netelement_id"]) <= {"s", "m", "d"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("netelement_id,direction\nq,AB\n", "names q"),
        ("netelement_id,direction\na,up\n", "'up'"),
        ("x\n1\n", "column netelement_id: is missing"),
    ],
)
def test_a_route_that_does_not_fit_the_site_is_named(tmp_path: Path, text: str, message: str) -> None:
    home, _ = on_disk(tmp_path)
    file = tmp_path / "route.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        with_route(read_site(home), file, SiteConfig())
