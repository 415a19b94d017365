"""Sites in every form that users have them, and what is said of those that are broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
from polars.testing import assert_frame_equal

from pipeline.read.site.describe import describe_site
from pipeline.read.site.read import read_site
from pipeline.show.inspection import inspect_path
from schemas.errors import BaliseError, SiteError
from schemas.inputs import Balises, Links, Route, Track
from tests.read.site import builders

INFRABEL = Path(__file__).parents[4] / "shared" / "data" / "infrabel"


def messages(folder: Path) -> str:
    with pytest.raises(SiteError) as caught:
        read_site(folder)
    return str(caught.value)


def test_parquet_geojson_and_csv_give_the_same_site(tmp_path: Path) -> None:
    parquet = read_site(builders.write(tmp_path / "p", track=builders.track(), links=builders.links()))
    geojson = read_site(builders.write(tmp_path / "g", track=builders.geojson()))
    csv = builders.track().write_csv(), builders.links().write_csv()
    text = read_site(builders.write(tmp_path / "c", track=csv[0], links=csv[1]))
    for other in (geojson, text):
        assert_frame_equal(parquet.track, other.track, check_exact=True)
        assert_frame_equal(parquet.links, other.links)
    assert parquet.digest != geojson.digest
    Track.validate(parquet.track)
    Links.validate(parquet.links)


def test_a_net_element_of_geojson_may_state_the_sigma_of_its_survey(tmp_path: Path) -> None:
    document = builders.geojson()
    document["features"][0]["properties"]["sigma_m"] = 2
    track = read_site(builders.write(tmp_path / "g", track=document)).track
    stated = track.filter(pl.col("netelement_id") == document["features"][0]["properties"]["id"])
    assert stated["sigma_m"].unique().to_list() == [2.0]
    assert track["sigma_m"].null_count() == track.height - stated.height
    for wrong, said in (("2 m", "'2 m'; expected a number"), (True, "True; expected a number"), (-1.0, "sigma_m")):
        document["features"][0]["properties"]["sigma_m"] = wrong
        assert said in messages(builders.write(tmp_path / str(wrong), track=document))


def test_measures_without_declaration_are_the_geometry(tmp_path: Path) -> None:
    site = read_site(builders.write(tmp_path, track=builders.track(), links=builders.links()))
    part = site.track.filter(pl.col("netelement_id") == "a")["measure_m"].to_list()
    step = pyproj.Geod(ellps="WGS84").inv(4.0, 50.0, 4.0007, 50.0)[2]
    assert part == pytest.approx([0.0, step, 2 * step], abs=1e-6)


@pytest.mark.parametrize("form", ["epsg", "EPSG", "column", "comment", "geojson", "planar names"])
def test_a_national_grid_becomes_wgs84(tmp_path: Path, form: str) -> None:
    turn = pyproj.Transformer.from_crs(4326, 31370, always_xy=True)
    degrees = builders.track()
    x, y = turn.transform(degrees["longitude_deg"].to_numpy(), degrees["latitude_deg"].to_numpy())
    plane = degrees.with_columns(pl.Series("longitude_deg", x), pl.Series("latitude_deg", y))
    builders.write(tmp_path, links=builders.links())
    if form.lower() == "epsg":
        table = plane.to_arrow()
        pq.write_table(table.replace_schema_metadata({form: "31370"}), tmp_path / "track.parquet")
    elif form == "column":
        builders.write(tmp_path, track=plane.with_columns(epsg=pl.lit(31370)))
    elif form == "comment":
        builders.write(tmp_path, track="# epsg: 31370\n" + plane.write_csv())
    elif form == "planar names":
        named = plane.rename({"longitude_deg": "x_m", "latitude_deg": "y_m"})
        builders.write(tmp_path, track=named.with_columns(epsg=pl.lit("EPSG:31370")))
    else:
        document = builders.geojson() | {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::31370"}}}
        for feature in document["features"]:
            if feature["geometry"]["type"] == "LineString":
                pairs = [turn.transform(*point) for point in feature["geometry"]["coordinates"]]
                feature["geometry"]["coordinates"] = pairs
        (tmp_path / "links.parquet").unlink()
        builders.write(tmp_path, track=document)
    site = read_site(tmp_path)
    assert np.allclose(site.track["latitude_deg"], degrees["latitude_deg"], atol=1e-8, rtol=0)
    assert np.allclose(site.track["longitude_deg"], degrees["longitude_deg"], atol=1e-8, rtol=0)


def test_defaults_of_balises_and_words_of_routes(tmp_path: Path) -> None:
    route = pl.DataFrame({"netelement_id": ["c", "b", "a"], "direction": ["falling", "BA", "reverse"]})
    site = read_site(
        builders.write(
            tmp_path, track=builders.track(), links=builders.links(), balises=builders.balises(), route=route
        )
    )
    assert site.balises is not None
    assert site.route is not None
    Balises.validate(site.balises)
    Route.validate(site.route)
    assert site.balises["location_accuracy_m"].to_list() == [12.0, 12.0]
    assert site.balises["link_reaction"].cast(str).to_list() == ["service_brake"] * 2
    assert site.balises["direction"].cast(str).to_list() == ["both"] * 2
    assert site.route["direction"].to_list() == ["BA", "BA", "BA"]


def test_csv_balises_with_words_for_truth(tmp_path: Path) -> None:
    text = "balise_id,netelement_id,measure_m,kind,linked\nv1,a,5,virtual,true\nv2,b,6.5,physical,0\n"
    site = read_site(builders.write(tmp_path, track=builders.track(), links=builders.links(), balises=text))
    assert site.balises is not None
    assert site.balises["linked"].to_list() == [True, False]


def test_findings_name_what_is_odd(tmp_path: Path) -> None:
    frame = builders.track()
    repeated = pl.concat([frame[:2], frame[1:]])
    far = repeated.with_columns(
        longitude_deg=pl.when(pl.col("netelement_id") == "c")
        .then(pl.col("longitude_deg") + 4.0 / 71_700.0)
        .otherwise(pl.col("longitude_deg"))
    )
    short = pl.DataFrame(
        {"netelement_id": ["s", "s"], "latitude_deg": [50.01, 50.01], "longitude_deg": [4.0, 4.000005]}
    )
    near = pl.DataFrame({"netelement_id": ["n", "n"], "latitude_deg": [50.0, 50.0], "longitude_deg": [3.99, 3.99998]})
    lost = pl.concat(
        [builders.links(), pl.DataFrame([("c", 1, "nowhere", 0, "both")], schema=builders.links().schema, orient="row")]
    )
    balises = builders.balises(measure_m=[500.0, 20.0], netelement_id=["a", "missing"])
    balises = pl.concat([balises, balises.head(1).with_columns(balise_id=pl.lit("v3"), measure_m=pl.lit(20.0))])
    track = pl.concat([far, short, near], how="diagonal")
    site = read_site(builders.write(tmp_path, track=track, links=lost, balises=balises))
    said = {(finding.severity, finding.place): finding.message for finding in site.findings}
    assert "1 of 4 points repeat" in said["warning", "track.parquet: element a"]
    assert "0.36 m long" in said["warning", "track: element s"]
    assert "measure 500.0 m is off element a (0.0 to 100" in said["error", "balises: v1"]
    assert "not in the track" in said["error", "balises: v2"]
    text = "\n".join(finding.message for finding in site.findings)
    assert "end 1 of b and end 0 of c are linked but 4.0 m apart" in text
    assert "relation c - nowhere is not used: it names an element not in the track" in text
    assert "end 0 of a and end 1 of n are 1.43 m apart and not linked" in text
    assert site.links.height == 4


def test_chords_that_leave_their_curve_are_said(tmp_path: Path) -> None:
    """A curve of 300 m radius in chords of 60 m: 60²/(8·300) = 1.5 m."""
    angle = np.arange(0.0, 1.2, 0.2)
    frame = pl.DataFrame(
        {
            "netelement_id": ["arc"] * len(angle),
            "latitude_deg": 50.0 + np.degrees(300.0 * (1 - np.cos(angle)) / 6_372_956.0),
            "longitude_deg": 4.0 + np.degrees(300.0 * np.sin(angle) / (6_390_702.0 * np.cos(np.radians(50.0)))),
        }
    )
    (finding,) = read_site(builders.write(tmp_path, track=frame)).findings
    assert finding.message == "points up to 60 m apart: straight lines between them leave the curve by 1.50 m"
    assert finding.severity == "note"


def test_declared_length_against_geometry(tmp_path: Path) -> None:
    declared = builders.track().with_columns(
        measure_m=pl.when(pl.col("netelement_id") == "b").then(
            pl.col("longitude_deg").rank("dense").over("netelement_id") * 120.0 - 120.0
        )
    )
    site = read_site(builders.write(tmp_path, track=declared, links=builders.links()))
    assert any("the declared length is 120.0 m, the geometry is 100." in f.message for f in site.findings)
    assert site.track.filter(pl.col("netelement_id") == "b")["measure_m"].to_list() == [0.0, 120.0]


def test_mixed_dimensions_are_said(tmp_path: Path) -> None:
    mixed = builders.track(height=30.0).with_columns(
        height_m=pl.when(pl.col("netelement_id") == "b").then(None).otherwise(pl.col("height_m"))
    )
    site = read_site(builders.write(tmp_path, track=mixed, links=builders.links()))
    assert any("1 of 4 elements lack heights" in finding.message for finding in site.findings)
    assert describe_site(site)["dimensions"] == "mixed: 1 of 4 elements 2-D"


def test_all_breaches_come_at_once(tmp_path: Path) -> None:
    track = builders.track().with_columns(latitude_deg=pl.Series([50.0, float("nan"), *[50.0] * 7]))
    links = builders.links().with_columns(navigability=pl.lit("sideways"), position_a=pl.lit(3))
    balises = builders.balises(kind=["virtual", "imaginary"], balise_id=["v1", None], direction=["AB", "up"])
    text = messages(builders.write(tmp_path, track=track, links=links, balises=balises))
    assert "track.parquet: column latitude_deg: has values that are not finite numbers; found nan in row 1" in text
    assert "links.parquet: column position_a: is out of range; found 3 in 4 rows, first 0; expected at most 1" in text
    assert "links.parquet: column navigability: has the wrong type; found 'sideways'" in text
    assert "expected one of AB BA both none" in text
    assert "balises.parquet: column kind: has the wrong type; found 'imaginary'" in text
    wrong = "balises.parquet: column direction: has the wrong type; found 'up'; expected one of AB BA both"
    assert text.count(wrong) == 1
    assert "balises.parquet: column balise_id: has missing values; found null in row 1" in text


def test_missing_columns_wrong_types_and_falling_measures(tmp_path: Path) -> None:
    assert "track.parquet: column longitude_deg: is missing; found netelement_id" in messages(
        builders.write(tmp_path / "1", track=builders.track().drop("longitude_deg"))
    )
    listed = builders.track().with_columns(latitude_deg=pl.concat_list("latitude_deg"))
    assert "column latitude_deg: has the wrong type; found List" in messages(
        builders.write(tmp_path / "2", track=listed)
    )
    falling = builders.track().with_columns(measure_m=-pl.col("longitude_deg"))
    assert "element a does not increase at point 1" in messages(builders.write(tmp_path / "3", track=falling))
    partial = builders.track().with_columns(measure_m=pl.Series([0.0, None, *[None] * 7], dtype=pl.Float64))
    assert "element a has a measure at some points only" in messages(builders.write(tmp_path / "4", track=partial))


def test_places_not_on_earth_ask_for_the_coordinate_system(tmp_path: Path) -> None:
    plane = builders.track().with_columns(latitude_deg=pl.lit(175_000.0))
    assert "does not name its EPSG code" in messages(builders.write(tmp_path, track=plane))
    nonsense = builders.track().with_columns(epsg=pl.lit(999_999))
    assert "EPSG:999999" in messages(builders.write(tmp_path / "2", track=nonsense))


def test_gaps_that_would_move_the_path_are_refused(tmp_path: Path) -> None:
    far = builders.track().with_columns(
        longitude_deg=pl.when(pl.col("netelement_id") == "c")
        .then(pl.col("longitude_deg") + 0.001)
        .otherwise(pl.col("longitude_deg"))
    )
    text = messages(builders.write(tmp_path, track=far, links=builders.links()))
    assert "end 1 of b and end 0 of c are linked but 71.7 m apart; expected at most 20 m" in text


def test_routes_must_be_one_way_through_known_elements(tmp_path: Path) -> None:
    def refused(names: list[str], directions: list[str], name: str) -> str:
        route = pl.DataFrame({"netelement_id": names, "direction": directions})
        return messages(builders.write(tmp_path / name, track=builders.track(), links=builders.links(), route=route))

    assert "c (AB) begins" in refused(["a", "c"], ["AB", "AB"], "1")
    assert "names q, not in the track" in refused(["a", "q"], ["AB", "AB"], "2")
    assert "'up'; expected AB or BA" in refused(["a", "b"], ["AB", "up"], "3")


def test_files_that_are_not_what_they_seem(tmp_path: Path) -> None:
    assert "has no track" in messages(builders.write(tmp_path / "0"))
    (builders.write(tmp_path / "1") / "track.parquet").write_bytes(b"no parquet at all")
    assert "track.parquet: cannot be read as Parquet" in messages(tmp_path / "1")
    (builders.write(tmp_path / "2") / "track.geojson").write_text("{}")
    assert "is not a GeoJSON FeatureCollection" in messages(tmp_path / "2")
    builders.write(tmp_path / "3", track=builders.track())
    builders.write(tmp_path / "3", track=builders.geojson())
    assert "only one may be there" in messages(tmp_path / "3")
    assert "is not a folder" in messages(tmp_path / "4")
    assert "has no points" in messages(builders.write(tmp_path / "5", track=builders.track()[:0]))
    one = builders.track().filter(pl.col("netelement_id") != "b")
    dot = pl.concat([one, builders.track()[3:4]])
    assert "element b has 1 distinct point" in messages(builders.write(tmp_path / "6", track=dot))


def test_one_geojson_file_is_a_site(tmp_path: Path) -> None:
    """As registers of infrastructure export it, under its own name."""
    folder = builders.write(tmp_path / "site", track=builders.geojson())
    export = tmp_path / "network.geojson"
    export.write_bytes((folder / "track.geojson").read_bytes())
    in_folder, alone = read_site(folder), read_site(export)
    assert alone.digest == in_folder.digest
    for table in ("track", "links"):
        assert_frame_equal(getattr(alone, table), getattr(in_folder, table))
    described = inspect_path(export)
    assert described.keys() == inspect_path(folder).keys()
    export.write_text("{}")
    assert "is not a GeoJSON FeatureCollection" in messages(export)
    assert str(tmp_path / "none.geojson") in messages(tmp_path / "none.geojson")


def test_the_digest_follows_the_content_alone(tmp_path: Path) -> None:
    one = read_site(builders.write(tmp_path / "x", track=builders.geojson()))
    same = read_site(builders.write(tmp_path / "y", track=builders.geojson()))
    changed = builders.geojson()
    changed["features"][0]["geometry"]["coordinates"][0][0] = 4.00001
    other = read_site(builders.write(tmp_path / "z", track=changed))
    assert one.digest == same.digest != other.digest


def test_arrow_types_of_other_writers_are_taken(tmp_path: Path) -> None:
    table = builders.track().to_arrow()
    kinds = pa.schema(
        [
            ("netelement_id", pa.dictionary(pa.int32(), pa.string())),
            ("measure_m", pa.float32()),
            ("latitude_deg", pa.float64()),
            ("longitude_deg", pa.float64()),
            ("height_m", pa.int32()),
            ("sigma_m", pa.float32()),
        ]
    )
    pq.write_table(table.cast(kinds), tmp_path / "track.parquet")
    builders.write(tmp_path, links=builders.links().with_columns(pl.col("position_a").cast(pl.UInt8)))
    assert read_site(tmp_path).track.height == 9


@pytest.mark.skipif(not INFRABEL.exists(), reason="the shared recordings are not beside the repository")
def test_a_real_network_is_read_whole(tmp_path: Path) -> None:
    (tmp_path / "track.geojson").write_bytes((INFRABEL / "network_airport.geojson").read_bytes())
    found = describe_site(read_site(tmp_path))
    assert (found["elements"], sum(found["relations"].values()), found["parts"]) == (74, 142, 1)
    assert found["length_m"] == pytest.approx(56_008.0, abs=1.0)
    assert found["dimensions"] == "2-D"


def test_a_relation_that_turns_back_is_not_navigable(tmp_path: Path) -> None:
    """Both branches of a switch linked with each other: a train would have to turn on the spot."""
    given = pl.concat([builders.links(), builders.links()[3:].with_columns(navigability=pl.lit("both"))])
    site = read_site(builders.write(tmp_path, track=builders.track(), links=given))
    assert site.links["navigability"].to_list() == ["both", "both", "AB", "none", "none"]
    messages = [finding.message for finding in site.findings if "by more than 90" in finding.message]
    assert messages == [
        "end 0 of b and end 0 of d are linked as navigable (both), but a train would have to turn by more than 90 "
        "degrees there: taken as not navigable"
    ]


@pytest.mark.skipif(not INFRABEL.exists(), reason="the shared recordings are not beside the repository")
def test_the_wrong_relation_of_the_recorded_network_is_reported(tmp_path: Path) -> None:
    """The recorded network links the branches of one switch as `both` and as `none`."""
    folder = builders.write(tmp_path)
    (folder / "track.geojson").write_bytes((INFRABEL / "network_airport.geojson").read_bytes())
    site = read_site(folder)
    assert [finding.message for finding in site.findings if "by more than 90" in finding.message] == [
        "end 1 of 88_L_262 and end 1 of 88_L_11886 are linked as navigable (both), but a train would have to turn "
        "by more than 90 degrees there: taken as not navigable"
    ]


@pytest.mark.parametrize("address", ["nosuch://key:secret@bucket/site", "memory://key:secret@nowhere/site?X=secret"])
def test_an_address_that_cannot_be_read_is_shown_without_its_credentials(address: str) -> None:
    with pytest.raises(BaliseError) as caught:
        read_site(address)
    assert "secret" not in str(caught.value)
    assert "://" in str(caught.value)


def test_balise_list_of_another_network_is_refused(tmp_path: Path) -> None:
    builders.write(tmp_path, track=builders.track(), links=builders.links(), balises=builders.balises())
    read_site(tmp_path)
    strange = builders.balises().with_columns(netelement_id=pl.lit("elsewhere"))
    text = messages(builders.write(tmp_path, balises=strange))
    assert "balises: none lies on a net element of the track" in text
    assert "lies on element elsewhere" in text
