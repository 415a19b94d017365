"""From surveys to sites: topology, ids, balises, recorded passes, and one message for what is no survey."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pipeline.make.survey.make import make_site, site_request, write_site
from pipeline.make.survey.network import make_network
from pipeline.make.survey.pieces import LinePiece, Survey
from pipeline.make.survey.trace import clean_traces
from pipeline.read.site.read import read_site
from pipeline.show.report.site_page import site_page
from pipeline.stages.track.geodesy import moved_deg
from pipeline.storage.parquet import without_checksums
from schemas.config import Configuration, SurveyConfig, Vehicle
from schemas.enums import TravelAlong
from schemas.errors import BaliseError, SiteError
from schemas.run import Site

INFRABEL = Path(__file__).parents[4] / "shared" / "data" / "infrabel" / "network_airport.geojson"
HOME_DEG = (50.0, 4.0)


def degrees(east_m: Any, north_m: Any) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude of metres beside one place."""
    east, north = np.asarray(east_m, dtype=float), np.asarray(north_m, dtype=float)
    ones = np.ones_like(east)
    return moved_deg(HOME_DEG[0] * ones, HOME_DEG[1] * ones, 0.0 * ones, east, north)


def way(identity: str, *points_m: tuple[float, float], kind: str = "rail") -> dict[str, Any]:
    latitude, longitude = degrees(*np.array(points_m).T)
    places = [[round(float(x), 7), round(float(y), 7)] for y, x in zip(latitude, longitude, strict=True)]
    line = {"type": "LineString", "coordinates": places}
    return {"type": "Feature", "id": identity, "properties": {"railway": kind}, "geometry": line}


def node(kind: str, east_m: float, north_m: float) -> dict[str, Any]:
    place = way("", (east_m, north_m), (0.0, 0.0))["geometry"]["coordinates"][0]
    point = {"type": "Point", "coordinates": place}
    return {"type": "Feature", "properties": {"railway": kind}, "geometry": point}


def written(folder: Path, name: str, *features: dict[str, Any]) -> Path:
    path = folder / name
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def site_of(*surveys: Path, balises: str | None = None, **wishes: Any) -> Site:
    travel = wishes.get("travel", TravelAlong.BOTH)
    request = site_request(
        list(surveys), balises, wishes.get("epsg"), wishes.get("join_m"), wishes.get("flat", False), travel
    )
    return make_site(request, Vehicle(), Configuration(survey=SurveyConfig(**wishes.get("config", {}))))


def navigable(site: Site) -> set[frozenset[tuple[str, int]]]:
    rows = site.links.filter(pl.col("navigability").cast(pl.String) == "both").iter_rows()
    return {frozenset([(a, a_end), (b, b_end)]) for a, a_end, b, b_end, _ in rows}


def findings_text(site: Site) -> str:
    return "\n".join(f"{one.place}: {one.message}" for one in site.findings)


def test_a_switch_lies_where_three_meet_and_no_train_turns_back_over_it(tmp_path: Path) -> None:
    stem = way("way/1", (-300, 0), (0, 0), (300, 0))
    branch = way("way/2", (0, 0), (30, 1.5), (300, 30))
    gone = way("way/3", (300, 0), (600, 0), kind="abandoned")
    site = site_of(written(tmp_path, "osm.geojson", stem, branch, gone))
    assert site.track["netelement_id"].unique(maintain_order=True).to_list() == ["way/1.1", "way/1.2", "way/2"]
    expected = {
        frozenset([("way/1.1", 1), ("way/1.2", 0)]),
        frozenset([("way/1.1", 1), ("way/2", 0)]),
    }
    assert navigable(site) == expected
    assert site.links.height == 3
    assert "1 lines with railway=abandoned" in findings_text(site)
    assert "the site has none" in findings_text(site)


@pytest.mark.parametrize(("named", "relations"), [("railway_crossing", 0), ("switch", 4), (None, 0)])
def test_lines_that_cross_are_linked_only_where_the_survey_names_a_switch(
    tmp_path: Path, named: str | None, relations: int
) -> None:
    lines = [way("a", (-300, 0), (0, 0), (300, 0)), way("b", (-300, -30), (0, 0), (300, 30))]
    site = site_of(written(tmp_path, "x.geojson", *lines, *([node(named, 0, 0)] if named else [])))
    assert len(navigable(site)) == relations
    assert ("cross where neither ends" in findings_text(site)) == (named is None)


def test_two_that_meet_two_are_a_crossing_unless_named(tmp_path: Path) -> None:
    arms = [
        way(name, (0, 0), end) for name, end in zip("wens", [(-300, 0), (300, 0), (300, 30), (-300, -30)], strict=True)
    ]
    straight = {frozenset([("w", 0), ("e", 0)]), frozenset([("n", 0), ("s", 0)])}
    assert navigable(site_of(written(tmp_path, "x.geojson", *arms))) == straight
    assert len(navigable(site_of(written(tmp_path, "s.geojson", *arms, node("switch", 0, 0))))) == 4


@pytest.mark.skipif(not INFRABEL.exists(), reason="needs the Infrabel network")
def test_the_topology_of_a_real_network_comes_back_from_its_lines_alone(tmp_path: Path) -> None:
    features = json.loads(INFRABEL.read_text())["features"]
    relations = [one["properties"] for one in features if one["geometry"]["type"] == "Point"]
    lines = [one for one in features if one["geometry"]["type"] == "LineString"]
    site = site_of(written(tmp_path, "lines.geojson", *lines))
    said: dict[frozenset[tuple[str, int]], set[str]] = {}
    for one in relations:
        pair = frozenset([(one["netelementA"], one["positionOnA"]), (one["netelementB"], one["positionOnB"])])
        said.setdefault(pair, set()).add(one["navigability"])
    # One pair stands there twice, as `both` and as `none`.
    expected = {pair for pair, words in said.items() if "none" not in words}
    assert navigable(site) == expected


def test_doubtful_places_are_reported(tmp_path: Path) -> None:
    kinked = way("kink", (0, 0), (100, 0), (105, 3), (200, 3))
    twice = way("twice", (0, 0.6), (99, 0.6), (198, 3.6))
    beside = way("beside", (150, 5.5), (160, 60))
    same = way("same", (100, 0), (105, 3))
    text = findings_text(site_of(written(tmp_path, "d.geojson", kinked, twice, beside, same)))
    assert "track: kink: 2 kinks" in text
    assert "track: twice: lies within 1.5 m of kink" in text or "track: kink: lies within 1.5 m of twice" in text
    assert "end 0 lies 2." in text
    assert "track: same: 1 of its 1 segments stand in the survey already" in text
    assert "no point has a height" in text


def test_trams_are_no_part_of_a_railway(tmp_path: Path) -> None:
    railway = way("way/1", (0, 0), (300, 0))
    tram = way("way/2", (300, 0), (600, 0), kind="tram")
    site = site_of(written(tmp_path, "both.geojson", railway, tram))
    assert site.track["netelement_id"].unique().to_list() == ["way/1"]
    assert "1 lines with railway=tram are left out: the railway beside them is another network" in findings_text(site)
    alone = site_of(written(tmp_path, "tram.geojson", tram))
    assert alone.track["netelement_id"].unique().to_list() == ["way/2"]


def test_surveys_have_the_headers_of_logs(tmp_path: Path) -> None:
    latitude, longitude = degrees(np.array([0.0, 300.0, 600.0]), np.zeros(3))
    path = tmp_path / "strecke.csv"
    pl.DataFrame({"Gleis": ["A"] * 3, "Geo-Breite [deg]": latitude, "Länge": longitude, "Höhe": [1.0] * 3}).write_csv(
        path
    )
    site = site_of(path)
    assert site.track["netelement_id"].unique().to_list() == ["A"]
    assert site.track["height_m"].to_list() == [1.0] * 3
    assert site.track["latitude_deg"].to_list() == pytest.approx(latitude.tolist())


def test_a_list_of_balises_has_names_and_kinds_in_german_and_says_what_it_lacks(tmp_path: Path) -> None:
    line = tmp_path / "line.csv"
    line.write_text("Breite;Länge\n50,00;14,0\n50,02;14,0\n")
    listed = tmp_path / "balisen.csv"
    listed.write_text("Balise;Breite;Länge;Art\nPB7;50,005;14,0;physisch\nV8;50,01;14,0;virtuell\n")
    made = site_of(line, balises=str(listed)).balises
    assert made.sort("measure_m").select("balise_id", "kind").rows() == [("PB7", "physical"), ("V8", "virtual")]
    listed.write_text("Breite;Länge\n50,005;14,0\n")
    site = site_of(line, balises=str(listed))
    assert site.balises.select("balise_id", "kind").rows() == [("B1", "virtual")]
    assert "names them: numbered B1 to B1" in findings_text(site)
    assert "is their kind: all are taken as virtual" in findings_text(site)


def track_csv(path: Path, east_m: np.ndarray, **columns: Any) -> Path:
    latitude, longitude = degrees(east_m, 0.0 * east_m)
    pl.DataFrame({"lat": latitude, "lon": longitude, **columns}).write_csv(path)
    return path


def test_a_missing_piece_is_reported_and_two_parallel_tracks_are_no_gap(tmp_path: Path) -> None:
    one, other = way("a", (0, 0), (500, 0)), way("b", (560, 0), (900, 0))
    beside = way("c", (0, 4.5), (500, 4.5))
    gaps = [
        line
        for line in findings_text(site_of(written(tmp_path, "g.geojson", one, other, beside))).splitlines()
        if "apart and not linked" in line
    ]
    assert len(gaps) == 1
    assert "end 1 of a and end 0 of b are 60.00 m apart and not linked" in gaps[0]


def test_a_line_over_itself_is_reported(tmp_path: Path) -> None:
    again = written(tmp_path, "a.geojson", way("a", (0, 0), (500, 0), (500.5, 0.4), (0, 0.4)))
    assert "track: a: lies within 1.5 m of itself" in findings_text(site_of(again))


def test_a_kilometre_that_a_jump_skips_or_repeats_places_no_balise(tmp_path: Path) -> None:
    east = np.arange(0.0, 2001.0, 10.0)
    wanted = tmp_path / "wanted.csv"
    for jump, km, message in ((0.5, 1.2, "no track has line kilometre 1.2"), (-0.5, 0.8, "0.8 is on twice at 800")):
        survey = track_csv(tmp_path / "twice.csv", east, km=east / 1000 + np.where(east > 1000, jump, 0.0))
        wanted.write_text(f"balise_id,km\nB1,{km}\n")
        with pytest.raises(BaliseError, match=message):
            site_of(survey, balises=str(wanted))
        wanted.write_text("balise_id,km,kind\nB1,0.25,\n")
        made = site_of(survey, balises=str(wanted)).balises
        assert made is not None
        assert made["measure_m"].to_list() == pytest.approx([250.0], abs=0.01)
        assert made["kind"].to_list() == ["virtual"]


def test_balises_keep_their_spacing_over_joints_and_follow_coordinates_and_kilometres(tmp_path: Path) -> None:
    north = np.arange(0.0, 2501.0, 100.0)
    latitude, longitude = degrees(np.zeros_like(north), north)
    table = pl.DataFrame({"track": ["A"] * 11 + ["B"] * 16, "lat": [*latitude[:11], *latitude[10:]]})
    table = table.with_columns(lon=pl.Series([*longitude[:11], *longitude[10:]]), km=pl.lit(0.0))
    km = 12.0 + np.concatenate([north[:11], north[10:]]) / 1000
    survey = tmp_path / "line.csv"
    table.with_columns(km=pl.Series(km)).write_csv(survey, separator=";")
    survey.write_text(survey.read_text().replace(".", ","))
    every = site_of(survey, balises="every 600").balises
    assert every is not None
    assert every["netelement_id"].to_list() == ["A", "B", "B", "B"]
    # A degree of latitude is as long as the ellipsoid says: 2,500 m come back to a millimetre.
    assert every["measure_m"].to_list() == pytest.approx([600.0, 200.0, 800.0, 1400.0], abs=1e-3)
    # B is surveyed back to the start.
    against = table.with_columns(km=pl.Series(km)).filter(track="B").reverse()
    table.with_columns(km=pl.Series(km)).filter(track="A").vstack(against).write_csv(tmp_path / "against.csv")
    for travel, directions in (("ahead", ["AB", "BA"]), ("back", ["BA", "AB"]), ("both", ["both", "both"])):
        one_way = site_of(tmp_path / "against.csv", balises="every 600", travel=TravelAlong(travel)).balises
        assert one_way is not None
        assert dict(one_way.select("netelement_id", "direction").iter_rows()) == dict(
            zip("AB", directions, strict=True)
        )
    wanted = tmp_path / "wanted.csv"
    place = degrees(np.array([3.0]), np.array([1250.0]))
    head = "balise_id,kind,lat,lon,km,direction"
    wanted.write_text(f"{head}\nP1,physical,{place[0][0]},{place[1][0]},,both\nV2,virtual,,,12.45,BA\n")
    listed = site_of(survey, balises=str(wanted))
    assert listed.balises is not None
    rows = listed.balises.select("balise_id", "netelement_id", "measure_m", "kind").rows()
    assert [(*row[:2], row[3]) for row in rows] == [("P1", "B", "physical"), ("V2", "A", "virtual")]
    assert [row[2] for row in rows] == pytest.approx([250.0, 450.0], abs=0.01)
    assert listed.balises["direction"].to_list() == ["both", "BA"]
    assert listed.track["line_km"].to_list() == pytest.approx(km.tolist())
    wanted.write_text(f"lat,lon\n{place[0][0]},{place[1][0] + 0.001}\n")
    with pytest.raises(BaliseError, match="balise B1: lies beside the track"):
        site_of(survey, balises=str(wanted))
    wanted.write_text("km,direction\n12.45,forwards\n")
    with pytest.raises(BaliseError, match=r"direction: .*'forwards'.*expected one of AB BA both"):
        site_of(survey, balises=str(wanted))
    wanted.write_text("km\n44\n")
    with pytest.raises(BaliseError, match="no track has line kilometre 44"):
        site_of(survey, balises=str(wanted))


def test_gpx_kml_and_kmz_give_the_same_line_and_the_same_ids_each_time(tmp_path: Path) -> None:
    latitude, longitude = degrees([0, 500, 1000], [0, 3, 9])
    points = list(zip(latitude, longitude, (100.0, 101.0, 102.0), strict=True))
    gpx = "".join(f'<trkpt lat="{a:.9f}" lon="{o:.9f}"><ele>{h}</ele></trkpt>' for a, o, h in points)
    head = '<gpx xmlns="http://www.topografix.com/GPX/1/1"><metadata><time>2025-01-01T00:00:00Z</time></metadata>'
    (tmp_path / "l.gpx").write_text(f"{head}<trk><name>Line 36</name><trkseg>{gpx}</trkseg></trk></gpx>")
    triples = " ".join(f"{o:.9f},{a:.9f},{h}" for a, o, h in points)
    line = f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{triples}</coordinates></LineString>"
    kml = f'<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>Line 36</name>{line}</Placemark></kml>'
    (tmp_path / "l.kml").write_text(kml)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("doc.kml", kml)
    (tmp_path / "l.kmz").write_bytes(packed.getvalue())
    sites = [site_of(tmp_path / name, balises="every 300") for name in ("l.gpx", "l.kml", "l.kmz")]
    assert all(site.track.equals(sites[0].track) for site in sites)
    assert sites[0].track["netelement_id"].unique().to_list() == ["Line 36"]
    assert sites[0].track["height_m"].to_list() == [100.0, 101.0, 102.0]
    for name in ("one", "two"):
        write_site(sites[0], site_page(name, sites[0]), tmp_path / name, force=False)
    files = ("track.parquet", "links.parquet", "balises.parquet")
    assert all((tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in files)
    assert not any(without_checksums((tmp_path / "one" / name).read_bytes()) for name in files)
    read = read_site(tmp_path / "one")
    assert read.balises is not None
    assert read.balises["balise_id"].to_list() == ["VB1", "VB2", "VB3"]
    assert "heights are taken as ellipsoidal" in (tmp_path / "one" / "findings.csv").read_text()
    page = (tmp_path / "one" / "site.html").read_text()
    assert all(word in page for word in ("default-src 'none'", "VB3", "Line 36"))
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "").replace(
        "https://www.openstreetmap.org/?", ""
    )  # a link, opened by a click
    with pytest.raises(BaliseError, match="holds a site"):
        write_site(sites[0], "", tmp_path / "one", force=False)


def recorded(name: str, east_m: np.ndarray, north_m: np.ndarray, rng: np.random.Generator) -> LinePiece:
    scatter = rng.normal(0.0, 0.02, (2, len(east_m)))
    latitude, longitude = degrees(east_m + scatter[0], north_m + scatter[1])
    unknown = np.full(len(east_m), np.nan)
    return LinePiece(name, latitude, longitude, unknown, unknown, np.full(len(east_m), 0.02), recorded=True)


def test_recorded_passes_make_one_line_and_a_branch_meets_it_at_a_switch() -> None:
    rng = np.random.default_rng(3)
    there = np.concatenate([np.arange(0.0, 1000.0, 5.0), np.full(300, 1000.0), np.arange(1000.0, 2000.0, 5.0)])
    travelled_m = np.concatenate([there, there[::-1]])
    main = recorded("main", travelled_m, 0.0 * travelled_m, rng)
    aside = np.arange(0.0, 1500.0, 5.0)
    # Radius 500 m from east 800 m on, until 4.5 m aside, then straight on.
    branch = recorded("branch", aside, np.clip((aside - 800.0).clip(0) ** 2 / 1000.0, 0.0, 60.0), rng)
    survey = clean_traces(Survey([main, branch]), SurveyConfig())
    assert [piece.name for piece in survey.pieces] == ["main", "branch"]
    kept = survey.pieces[0]
    # The stop is a point or two, the way back nothing, and a straight line needs few points.
    assert len(kept) < 30
    north = (kept.latitude_deg - HOME_DEG[0]) * 111_229.0
    assert np.abs(north).max() < 0.15
    network = make_network(survey, None, SurveyConfig())
    assert sorted(element.name for element in network.elements) == ["branch", "main.1", "main.2"]
    ways = network.links.filter(pl.col("navigability").cast(pl.String) == "both")
    assert ways.height == 2
    toe_m = float((survey.pieces[1].longitude_deg[0] - HOME_DEG[1]) * 71_696.0)
    assert toe_m == pytest.approx(800.0, abs=30.0)


def test_a_later_pass_goes_on_from_the_end_of_the_first() -> None:
    rng = np.random.default_rng(4)
    first, second = np.arange(0.0, 1200.0, 4.0), np.arange(1000.0, 2000.0, 4.0)
    passes = [recorded("a", first, 0.0 * first, rng), recorded("b", second, 0.0 * second, rng)]
    network = make_network(clean_traces(Survey(passes), SurveyConfig()), None, SurveyConfig())
    assert [element.name for element in network.elements] == ["a", "b"]
    track = network.track.group_by("netelement_id").agg(pl.col("measure_m").max())
    assert track["measure_m"].sum() == pytest.approx(1996.0, abs=0.5)


def test_a_jump_of_the_reference_is_reported_and_is_no_track(tmp_path: Path) -> None:
    east = np.arange(0.0, 1000.0, 4.0)
    latitude, longitude = degrees(east, np.where((east >= 400) & (east < 420), 50.0, 0.0))
    times = pl.Series((np.arange(len(east)) * 200_000_000), dtype=pl.Int64).cast(pl.Datetime("ns", "UTC"))
    points = pl.DataFrame({"t": times, "latitude_deg": latitude, "longitude_deg": longitude})
    run = tmp_path / "run"
    run.mkdir()
    points.with_columns(fix=pl.lit("sbas")).write_parquet(run / "gnss.parquet")
    points.with_columns(height_m=pl.lit(None, pl.Float64), sigma_m=pl.lit(0.02)).write_parquet(
        run / "reference.parquet"
    )
    site = site_of(run)
    assert "run: 5 positions to which no train can have come are left out" in findings_text(site)
    assert site.track["measure_m"].max() == pytest.approx(996.0, abs=0.1)


def test_a_kmz_whose_directory_lies_before_its_begin_is_one_error(tmp_path: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("doc.kml", "<kml/>")
    (tmp_path / "line.kmz").write_bytes(packed.getvalue()[4:])
    with pytest.raises(SiteError, match="cannot be unpacked"):
        site_of(tmp_path / "line.kmz")


BAD = {
    "exchanged.csv": ("# epsg: 2056\nx,y\n1260000,2683000\n1260100,2683000\n", "easting and northing may be exchanged"),
    "origin.csv": ("lat,lon\n50,4\n0,0\n", "point 2 of origin is no place on earth"),
    "entity.gpx": ('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx>&a;</gpx>', "line 1: declares a document type"),
    "half.gpx": ("<gpx><trk>", "not well-formed XML"),
    "nowhere.gpx": ('<gpx><trk><trkseg><trkpt lat="50"/></trkseg></trk></gpx>', "line 1: a coordinate cannot be read"),
    "tiny.gpx": (
        '<gpx><trk><trkseg><trkpt lat="50" lon="4"/><trkpt lat="50.000000000001" lon="4"/></trkseg></trk></gpx>',
        "nothing is left of the survey",
    ),
    "utf7.gpx": ('<?xml version="1.0" encoding="UTF-7"?><gpx/>', "not well-formed XML"),
    "digits.gpx": ('<gpx><rte><rtept lat="5_0" lon="4"/></rte></gpx>', "a coordinate cannot be read; found '5_0'"),
    "script.geojson": (
        '{"features": [{"geometry": {"type": "LineString", "coordinates": [["\\u0665", 50], [4, 51]]}}]}',
        "a coordinate cannot be read",
    ),
    "page.kml": ("<html/>", "neither GPX nor KML"),
    "text.kmz": ("text", "cannot be unpacked"),
    "overpass.json": ('{"elements": []}', "holds no line"),
    "deep.geojson": ("[" * 100_000, "not a GeoJSON"),
    "null.geojson": ('{"features": [null]}', "a feature is no object"),
    "ids.json": ('{"elements": [{"type": "way", "id": 1, "nodes": [1, 2]}]}', "without the places of their nodes"),
    "one.geojson": ('{"features": []}', "holds no line"),
    "word.csv": ("lat,lon\n50,4\n50,x\n", "column longitude_deg: row 2: cannot be read; found 'x'"),
    "plane.csv": ("x,y\n150000,170000\n150100,170000\n", "names no EPSG code"),
    "names.csv": ("a,b\n1,2\n", "has no positions; found columns a, b"),
    "swapped.csv": ("lat,lon\n140,36\n140.1,36\n", "latitude and longitude are exchanged"),
    "notes.doc": ("x", "no survey that is known"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_survey_is_one_message(tmp_path: Path, name: str) -> None:
    content, expected = BAD[name]
    (tmp_path / name).write_text(content)
    with pytest.raises(BaliseError, match=expected) as caught:
        site_of(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_what_a_survey_is_taken_for_is_configuration(tmp_path: Path) -> None:
    bent = written(tmp_path, "bent.geojson", way("bent", (0, 0), (100, 0), (200, 15)))
    assert "kinks" not in findings_text(site_of(bent))
    assert "track: bent: 1 kinks" in findings_text(site_of(bent, config={"kink_deg": 5.0}))
    apart = written(tmp_path, "apart.geojson", way("a", (0, 0), (100, 0)), way("b", (100.5, 0), (200, 0)))
    assert navigable(site_of(apart)) == set()
    joined = {frozenset([("a", 1), ("b", 0)])}
    assert navigable(site_of(apart, config={"same_place_m": 1.0})) == joined
    assert navigable(site_of(apart, join_m=1.0)) == joined


def test_overpass_json_is_read_like_its_geojson(tmp_path: Path) -> None:
    """Places of `out geom`, or in the nodes of `out skel`; a way that no train runs on is left out."""
    feature = way("way/7", (0.0, 0.0), (500.0, 0.0))
    places = [{"lon": x, "lat": y} for x, y in feature["geometry"]["coordinates"]]
    nodes = [{"type": "node", "id": number, **place} for number, place in enumerate(places)]
    tags = {"railway": "rail"}
    old = {"type": "way", "id": 8, "nodes": [0, 1], "tags": {"railway": "abandoned"}}
    plain = site_of(written(tmp_path, "line.geojson", feature))
    for name, elements in {
        "geom": [{"type": "way", "id": 7, "tags": tags, "geometry": places}],
        "skel": [{"type": "way", "id": 7, "tags": tags, "nodes": [0, 1]}, old, *nodes],
    }.items():
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"version": 0.6, "elements": elements}))
        assert site_of(path).track.equals(plain.track)
    assert plain.track["netelement_id"].unique().to_list() == ["way/7"]


@pytest.mark.parametrize(("text", "km"), [("48+050", 48.05), ("-0+120", -0.12), ("7+000.5", 7.0005), ("48.05", 48.05)])
def test_kilometres_and_metres_of_a_station(tmp_path: Path, text: str, km: float) -> None:
    latitude, longitude = degrees([0.0, 100.0], [0.0, 0.0])
    rows = [f"{y},{x},{at}" for y, x, at in zip(latitude, longitude, (text, "50+000"), strict=True)]
    path = tmp_path / "line.csv"
    path.write_text("\n".join(["latitude_deg,longitude_deg,line_km", *rows]) + "\n")
    assert site_of(path).track["line_km"][0] == pytest.approx(km, abs=1e-9)


def test_a_station_of_two_digits_of_metres_is_no_kilometre(tmp_path: Path) -> None:
    path = tmp_path / "line.csv"
    path.write_text("latitude_deg,longitude_deg,line_km\n50,4,48+05\n50,4.001,48+100\n")
    with pytest.raises(SiteError, match=r"48\+05"):
        site_of(path)


def test_an_empty_track_of_a_logger_ends_no_site(tmp_path: Path) -> None:
    def track(east_m: list[float], north_m: list[float]) -> str:
        points = zip(*degrees(east_m, north_m), strict=True)
        inside = (f'<trkpt lat="{y}" lon="{x}"><time>2025-01-01T00:00:00Z</time></trkpt>' for y, x in points)
        return f"<trk><trkseg>{''.join(inside)}</trkseg></trk>"

    east = [50.0 * number for number in range(20)]
    passes = [track(east, [0.0] * 20), track([], []), track([10.0], [5.0]), track(east, [0.0] * 10 + [40.0] * 10)]
    path = tmp_path / "log.gpx"
    path.write_text(f"<gpx>{''.join(passes)}</gpx>")
    site = site_of(path)
    assert site.track.height > 2
    assert [one.message for one in site.findings if one.place == "survey"] == [
        "2 lines with fewer than two points are left out"
    ]


@pytest.mark.parametrize(("of_all", "own", "high"), [("absolute", "", True), ("", "absolute", True), ("", "", False)])
def test_the_altitude_mode_of_a_multitrack_is_that_of_its_tracks(
    tmp_path: Path, of_all: str, own: str, high: bool
) -> None:
    def mode(text: str) -> str:
        return f"<altitudeMode>{text}</altitudeMode>" if text else ""

    latitude, longitude = degrees([0.0, 300.0], [0.0, 0.0])
    coordinates = "".join(f"<coord>{x} {y} 250</coord>" for y, x in zip(latitude, longitude, strict=True))
    track = f"<Track>{mode(own)}<when>2025-01-01</when><when>2025-01-01</when>{coordinates}</Track>"
    path = tmp_path / "log.kml"
    path.write_text(f"<kml><Placemark><MultiTrack>{mode(of_all)}{track}</MultiTrack></Placemark></kml>")
    assert (site_of(path).track["height_m"].null_count() == 0) == high


def test_a_crs_with_the_latitude_first_is_a_finding(tmp_path: Path) -> None:
    line = way("1", (0.0, 0.0), (500.0, 0.0))
    path = tmp_path / "line.geojson"
    for name, reported in {"urn:ogc:def:crs:EPSG::4326": True, "urn:ogc:def:crs:OGC:1.3:CRS84": False}.items():
        crs = {"type": "name", "properties": {"name": name}}
        path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [line]}))
        assert any("latitude first" in finding.message for finding in site_of(path).findings) == reported
