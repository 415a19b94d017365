"""Networks with net relations (RailTopoModel, ERA RINF): kept as given, angles only where nothing is said."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pipeline.campaign.plan import make_plan
from pipeline.read.site.read import read_site
from pipeline.show.inspection import inspect_path
from schemas.errors import BaliseError, SiteError
from schemas.run import Site
from tests.make.survey.test_site_of_survey import INFRABEL, findings_text, site_of, way, written
from tests.read.site import builders

Relation = tuple[str, int, str, int, str]
LINKS = ["netelement_a", "position_a", "netelement_b", "position_b", "navigability"]


def as_register(relation: Relation) -> dict[str, Any]:
    """As registers of infrastructure export it."""
    return dict(
        zip(["netelementA", "positionOnA", "netelementB", "positionOnB", "navigability"], relation, strict=True)
    )


def as_vocabulary(relation: Relation) -> dict[str, Any]:
    """In the words of the ERA vocabulary."""
    a, a_end, b, b_end, way_of = relation
    words = "http://data.europa.eu/949/concepts/navigabilities/"
    return {
        "era:elementA": a,
        "era:isOnOriginOfElementA": a_end == 0,
        "era:elementB": b,
        "era:isOnOriginOfElementB": b_end == 0,
        "era:navigability": words + way_of.capitalize() if way_of.islower() else words + way_of,
    }


def as_railml(relation: Relation) -> dict[str, Any]:
    a, a_end, b, b_end, way_of = relation
    ends = {"positionOnA": str(a_end), "positionOnB": str(b_end)}
    return {
        "elementA": {"ref": a},
        "elementB": {"ref": b},
        **ends,
        "navigability": way_of.capitalize() if way_of.islower() else way_of,
    }


def in_words(relation: Relation) -> dict[str, Any]:
    a, a_end, b, b_end, way_of = relation
    ends = ("start", "end")
    return {
        "Net_Element_A": a,
        "Position_A": ends[a_end],
        "Net_Element_B": b,
        "Position_B": ends[b_end].upper(),
        "Navigability": way_of,
    }


def network(
    folder: Path, relations: list[Relation], spelled: Callable[[Relation], dict[str, Any]] = as_register
) -> Path:
    """Three elements in a row and one that branches off the first, with these relations."""
    lines = [one for one in builders.geojson()["features"] if one["geometry"]["type"] == "LineString"]
    points = [{"type": "Feature", "properties": spelled(one), "geometry": None} for one in relations]
    return written(folder, "network.geojson", *points, *lines)


def rows(site: Site) -> list[Relation]:
    return site.links.with_columns(pl.col("navigability").cast(pl.String)).select(LINKS).rows()


@pytest.mark.parametrize("spelled", [as_register, as_vocabulary, as_railml, in_words])
def test_relations_are_kept_as_given_however_they_are_spelled(tmp_path: Path, spelled: Any) -> None:
    """By their angles `a` leads on to both `b` and `d` in both directions: here one way, or not at all."""
    given: list[Relation] = [
        ("a", 1, "b", 0, "none"),
        ("b", 1, "c", 0, "BA"),
        ("d", 0, "a", 1, "AB"),
        ("b", 0, "d", 0, "none"),
    ]
    site = site_of(network(tmp_path, given, spelled))
    assert rows(site) == given
    assert rows(read_site(network(tmp_path, given, spelled))) == given
    assert site.track["netelement_id"].unique(maintain_order=True).to_list() == ["a", "b", "c", "d"]
    assert "angle" not in findings_text(site)


def test_elements_of_a_network_are_neither_cut_nor_joined_by_what_lies_there(tmp_path: Path) -> None:
    """`n` ends at a vertex of `m` and `x` crosses it there: relations alone say where a train can turn."""
    lines = [
        way("m", (-300, 0), (0, 0), (300, 0)),
        way("n", (0, 0), (300, 20)),
        way("x", (-50, -300), (0, 0), (50, 300)),
        way("o", (300, 0), (600, 0)),
    ]
    relation = {"type": "Feature", "properties": as_register(("m", 1, "o", 0, "both")), "geometry": None}
    for line in lines:
        line["properties"] = {}
    site = site_of(written(tmp_path, "n.geojson", *lines, relation))
    assert site.track["netelement_id"].unique(maintain_order=True).to_list() == ["m", "n", "x", "o"]
    assert rows(site) == [("m", 1, "o", 0, "both")]
    assert "track: n: end 0 lies 0.0 m from the middle of m and is not joined to it" in findings_text(site)


def test_ends_that_no_relation_names_are_joined_by_angle_with_a_warning(tmp_path: Path) -> None:
    site = site_of(network(tmp_path, [("a", 1, "b", 0, "AB"), ("a", 1, "d", 0, "none"), ("b", 0, "d", 0, "none")]))
    assert rows(site)[:3] == [("a", 1, "b", 0, "AB"), ("a", 1, "d", 0, "none"), ("b", 0, "d", 0, "none")]
    assert rows(site)[3:] == [("b", 1, "c", 0, "both")]
    (finding,) = [one for one in site.findings if "by the angles" in one.message]
    assert finding.severity == "warning"
    assert "no relation at 1 nodes (end 1 of b and end 0 of c): 1 relations" in finding.message


def test_lines_alone_are_joined_by_angle_with_a_note(tmp_path: Path) -> None:
    site = site_of(network(tmp_path, []))
    assert Counter(row[-1] for row in rows(site)) == {"both": 3, "none": 1}
    (finding,) = [one for one in site.findings if "by the angles" in one.message]
    assert finding.severity == "note"


def test_a_missing_element_and_two_words_for_one_pair_are_reported(tmp_path: Path) -> None:
    given: list[Relation] = [
        ("a", 1, "b", 0, "AB"),
        ("b", 0, "a", 1, "AB"),
        ("c", 1, "gone", 0, "both"),
        ("b", 1, "c", 0, "both"),
    ]
    site = site_of(network(tmp_path, [*given, ("c", 0, "b", 1, "both"), ("d", 0, "a", 1, "BA")]))
    assert ("c", 1, "gone", 0, "both") not in rows(site)
    assert "relation c - gone is not used: it names an element not in the track" in findings_text(site)
    # The same said from the other side is no difference.
    assert [one.message for one in site.findings if "are related as" in one.message] == [
        "end 1 of a and end 0 of b are related as AB and as BA: what either allows counts"
    ]


def test_a_network_with_relations_beside_other_lines_is_refused(tmp_path: Path) -> None:
    given = network(tmp_path, [("a", 1, "b", 0, "BA")])
    siding = written(tmp_path, "siding.geojson", way("x", (0, 0), (100, 0)))
    with pytest.raises(SiteError, match="holds net relations and stands beside lines without them"):
        site_of(siding, given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"navigability": "sideways"}, "feature 0: navigability 'sideways'; expected one of AB, BA, both, none"),
        ({"navigability": None}, "feature 0: navigability None; expected one of AB, BA, both, none"),
        ({"positionOnB": 0.5}, "feature 0: positionOnA 1, positionOnB 0.5; expected 0 or 1"),
        ({"netelementB": None}, "feature 0: netelementA 'a', netelementB None; a relation joins two elements"),
    ],
)
def test_a_relation_that_cannot_be_read_is_one_message(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = network(tmp_path, [("a", 1, "b", 0, "both")], lambda one: as_register(one) | change)
    for read in (site_of, read_site):
        with pytest.raises(SiteError) as error:
            read(path)
        assert str(error.value).count(message) == 1


@pytest.mark.skipif(not INFRABEL.exists(), reason="needs the Infrabel network")
def test_a_real_network_keeps_one_way_tracks(tmp_path: Path) -> None:
    """Every third of its relations in one direction only, by turns, the rest as it is; each named as the file does."""
    document = json.loads(INFRABEL.read_text())
    relations = [one["properties"] for one in document["features"] if one["geometry"]["type"] == "Point"]
    for number, relation in enumerate(relations):
        if number % 3 == 0:
            relation["navigability"] = ("AB", "BA", "none")[number // 3 % 3]
    path = tmp_path / "network.geojson"
    path.write_text(json.dumps(document))
    site = site_of(path)
    keys = ("netelementA", "positionOnA", "netelementB", "positionOnB", "navigability")
    assert rows(site) == [tuple(relation[key] for key in keys) for relation in relations]
    assert site.track["netelement_id"].n_unique() == 74
    assert "angles" not in findings_text(site)


def test_a_file_without_relations_is_no_site_to_replay_on(tmp_path: Path) -> None:
    path = network(tmp_path, [])
    findings = inspect_path(str(path))["Findings"]
    assert "balise site" in findings.filter(place="links")["remedy"].str.join(" ").item()
    run = tmp_path / "run"
    run.mkdir()
    pl.DataFrame({"t": [0]}).write_parquet(run / "gnss.parquet")
    with pytest.raises(BaliseError, match="no net relations") as error:
        make_plan([str(run)], str(path), str(tmp_path / "out"))
    assert "balise site" in str(error.value)


def test_a_stretch_that_two_elements_share_stays_with_both(tmp_path: Path) -> None:
    """Twice the same track is doubtful, and reported, but what the network names is not left out of it."""
    site = site_of(network(tmp_path, [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both"), ("a", 1, "d", 0, "AB")]))
    document = json.loads((tmp_path / "network.geojson").read_text())
    twin = {"type": "LineString", "coordinates": [list(point) for point in builders.POINTS["b"]]}
    document["features"].append({"type": "Feature", "properties": {"id": "b2"}, "geometry": twin})
    path = tmp_path / "twice.geojson"
    path.write_text(json.dumps(document))
    assert site_of(path).track.height == site.track.height + 2
